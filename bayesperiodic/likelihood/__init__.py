"""Comparison of predicted responses with data."""
