"""Compiled loops over arrays; each has a torch form that gives the same."""
