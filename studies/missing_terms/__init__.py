"""The study `missing-terms`."""
