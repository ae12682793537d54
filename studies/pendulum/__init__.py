"""The study `pendulum`."""
