"""The models of the library and their elements; `bayesperiodic.models` imports each at its first use."""

from . import elements as elements
from .library import chain as chain
from .library import dahl as dahl
from .library import duffing as duffing
from .library import flutter as flutter
from .library import landing_gear as landing_gear
from .library import pendulum as pendulum
from .library import rl_diode as rl_diode
from .library import silverbox as silverbox
from .library import van_der_pol as van_der_pol
