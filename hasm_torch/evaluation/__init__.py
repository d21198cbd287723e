"""Rollouts in simulation and what is measured of them."""
