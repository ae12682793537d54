"""Formats of files of measurements: what each contains, before anything is made of it."""
