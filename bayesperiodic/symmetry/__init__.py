"""Structural identifiability by symmetries of the equations."""
