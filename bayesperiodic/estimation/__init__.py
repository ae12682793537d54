"""MAP estimate, Laplace approximation and profiles."""
