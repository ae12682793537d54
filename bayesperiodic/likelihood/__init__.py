"""Comparison of predicted responses with data."""

from bayesperiodic.likelihood import noise as noise
