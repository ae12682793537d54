"""The study `noisy-inputs`."""
