"""Recordings and experiments."""

from bayesperiodic.data import measurements as measurements
