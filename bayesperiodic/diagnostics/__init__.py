"""Identifiability, checks of the Laplace approximation, model adequacy and calibration."""
