"""Samplers and their draws."""
