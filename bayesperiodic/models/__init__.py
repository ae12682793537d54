"""What we believe: symbolic models, compiled to kernels; the ready-made ones are attributes here."""

from bayesperiodic.models.library import dahl, duffing

__all__ = ["dahl", "duffing"]
