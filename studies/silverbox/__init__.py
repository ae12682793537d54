"""The study `silverbox`."""
