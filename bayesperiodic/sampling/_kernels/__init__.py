"""Sources of the compiled functions of the samplers."""
