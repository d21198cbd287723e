"""Measurements that are reproduced by ``python -m benchmarks.<name>``."""
