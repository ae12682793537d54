"""The posterior density and its periodic responses."""
