"""The study `harvester`."""
