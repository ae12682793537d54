"""What we conclude: priors, posterior density, estimates, samples."""
