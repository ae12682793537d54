"""Structural identifiability: symmetries of a model."""
