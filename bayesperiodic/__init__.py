"""Bayesian identification of nonlinear systems from their periodic equilibrium states.

Given a model (equations) and recordings of its periodic responses, estimate the parameters with their uncertainty, and
find which parameters, or combinations of them, the data determine.

The public names are listed in ``__init__.pyi`` and imported at their first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
