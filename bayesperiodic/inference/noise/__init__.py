"""What is assumed of the residuals."""
