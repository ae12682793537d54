"""Sources of the compiled functions of models."""
