"""Structural identifiability: what equations and measured channels can determine at all, before any data."""
