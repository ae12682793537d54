"""Problem, priors, noise models and the posterior density."""
