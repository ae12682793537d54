"""Response tables of nonlinear resonances."""
