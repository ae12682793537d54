"""The estimate, and everything that a fit tells of itself."""
