"""Sources of the compiled functions of the periodic solver."""
