"""Compilation of models and solver kernels."""
