"""Models: equations, compiled functions, and a library of models (the attributes of this package)."""

from bayesperiodic.models import elements as elements
from bayesperiodic.models.library import (
    chain,
    dahl,
    duffing,
    flutter,
    landing_gear,
    pendulum,
    rl_diode,
    silverbox,
    van_der_pol,
)

__all__ = ["chain", "dahl", "duffing", "flutter", "landing_gear", "pendulum", "rl_diode", "silverbox", "van_der_pol"]
