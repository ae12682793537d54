"""Recordings and experiments."""
