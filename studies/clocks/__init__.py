"""Clocks, rates and delays: coverage of amplitudes and parameters."""
