"""What we believe: symbolic models, compiled to kernels; the ready-made ones are attributes here."""

from bayesperiodic.models.library import chain, dahl, duffing, flutter, landing_gear, pendulum, silverbox, van_der_pol

__all__ = ["chain", "dahl", "duffing", "flutter", "landing_gear", "pendulum", "silverbox", "van_der_pol"]
