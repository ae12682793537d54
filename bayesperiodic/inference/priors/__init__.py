"""What is believed before the data."""
