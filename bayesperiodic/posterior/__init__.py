"""Priors, noise models, and the posterior density of the parameters."""

from bayesperiodic.posterior import noise as noise
