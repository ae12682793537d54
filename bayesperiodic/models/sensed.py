"""Names and filters of sensors, and models that are driven by what sensors of their inputs have measured."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from functools import lru_cache

import sympy as sp

from bayesperiodic.models.model import Model
from bayesperiodic.models.names import DERIVATIVES

GAIN, OFFSET, DELAY, CUTOFF = "gain", "offset", "delay", "cutoff"
SENSOR_KINDS = (GAIN, OFFSET, DELAY, CUTOFF)
# The delay of all outputs of an experiment.
SHIFT = "shift"


def sensor_name(kind: str, channel: str) -> str:
    """Return what a parameter of the sensor of a channel is called, such as ``gain[force]``."""
    return f"{kind}[{channel}]"


def of_a_channel(name: str) -> bool:
    """Return whether a parameter of a problem is a delay or acts on channels only, such as ``shift[run 1]``."""
    return name.partition("[")[0] in (SHIFT, *SENSOR_KINDS) and ("[" in name or name == SHIFT)


def sensor_symbol(kind: str, channel: str) -> sp.Symbol:
    """Return the symbol of a parameter of a sensor, whose name is an identifier."""
    return sp.Symbol(f"sensor_{kind}_{channel}", real=True)


@lru_cache
def butterworth(order: int) -> tuple[float, ...]:
    """Return the coefficients b of B(s) = Σ_k b_k sᵏ, the denominator of a Butterworth filter of cutoff 1 rad/s."""
    angle, result = math.pi / (2 * order), [1.0]
    for k in range(1, order + 1):
        result.append(result[-1] * math.cos((k - 1) * angle) / math.sin(k * angle))
    return tuple(result)


def with_sensed_inputs(
    model: Model, unknown: Mapping[str, Sequence[str]], orders: Mapping[str, int], gains: Mapping[str, float]
) -> Model:
    """Return the model of measured inputs, with unknown gains, offsets and cutoffs as further parameters.

    `unknown` are the kinds by input, `orders` those of the filters, `gains` known ones by which the measured inputs are
    divided already, but not their offsets. A filter without zeros has an inverse that is a sum of time derivatives.
    """
    changed: dict[sp.Symbol, sp.Expr] = {}
    symbols: dict[str, sp.Symbol] = {}
    for name, kinds in unknown.items():
        new = {k: sensor_symbol(k, name) for k in kinds if k != DELAY and sensor_name(k, name) not in model.parameters}
        highest = model.input_derivatives()[name]
        weights = butterworth(orders[name]) if CUTOFF in new else (1.0,)
        if len(weights) > 1 and highest + orders[name] > 2:
            used = f" whose derivative of order {highest} the model uses" if highest else ""
            raise ValueError(
                f"sensors[{name!r}]: order must be at most {2 - highest} for an unknown cutoff of an input{used}, got "
                f"{orders[name]}; give the cutoff as a number."
            )
        inputs, rate = [model.input_symbols[d + name] for d in DERIVATIVES], 2 * sp.pi * new.get(CUTOFF, 1)
        for order in range(highest + 1) if new else ():
            total = sum(b / rate**k * inputs[order + k] for k, b in enumerate(weights))
            total = total - new.get(OFFSET, 0) / gains.get(name, 1.0) if order == 0 else total
            changed[inputs[order]] = total / new.get(GAIN, 1)
        symbols |= {sensor_name(kind, name): symbol for kind, symbol in new.items()}
    if not symbols:
        return model
    other = copy(model)
    other.parameters = (*model.parameters, *symbols)
    other.parameter_symbols = {**model.parameter_symbols, **symbols}
    other.equations = tuple(e.xreplace(changed) for e in model.equations)
    other.output_expressions = tuple(e.xreplace(changed) for e in model.output_expressions)
    return other
