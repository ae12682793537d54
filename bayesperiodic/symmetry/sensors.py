"""Sensors in the symbolic system whose symmetries are searched for."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np
import sympy as sp

from bayesperiodic.models.sensed import CUTOFF, DELAY, GAIN, OFFSET, SHIFT, sensor_name, sensor_symbol
from bayesperiodic.symmetry.determining import System

DELAY_OF = "delay of "
DAMPING_DENOMINATOR = 1000


def with_sensors(
    system: System, unknown: Mapping[str, Sequence[str]], orders: Mapping[str, int], shifted: bool = False
) -> System:
    """Return the system whose outputs pass through sensors with unknown parameters, the kinds by channel.

    Gain and offset change the measured output; a filter of the given order has states of its own. Of delays, inputs
    included, only the differences between channels can be seen, and those from a channel whose time is known; these
    are further outputs. With `shifted` all outputs have one more delay.
    """
    symbols, parameters = dict(system.symbols), dict(system.parameters)
    state_orders, equations, outputs = dict(system.orders), list(system.equations), dict(system.outputs)
    for channel, kinds in unknown.items():
        new = {kind: sensor_symbol(kind, channel) for kind in kinds}
        if channel in outputs:
            parameters |= {sensor_name(kind, channel): symbol for kind, symbol in new.items()}
            signal = outputs[channel]
            if CUTOFF in new:
                for section, damping in enumerate(_dampings(orders[channel])):
                    state, time = f"filter {section} of {channel}", 1 / (2 * sp.pi * new[CUTOFF])
                    jet = [sp.Symbol(f"{'d' * k}filter_{section}_{channel}", real=True) for k in range(3)]
                    symbols |= {"d" * k + state: symbol for k, symbol in enumerate(jet)}
                    state_orders[state] = 1 if damping is None else 2
                    behind = jet[0] + time * jet[1] * (1 if damping is None else damping) - signal
                    equations.append(behind if damping is None else behind + time**2 * jet[2])
                    signal = jet[0]
            outputs[channel] = new.get(GAIN, 1) * signal + new.get(OFFSET, 0)
        elif DELAY in new:
            parameters[sensor_name(DELAY, channel)] = new[DELAY]
    late: dict[str, sp.Expr] = {c: sp.S.Zero for c in (*system.outputs, *system.inputs)}
    late |= {c: sensor_symbol(DELAY, c) for c, kinds in unknown.items() if DELAY in kinds}
    if shifted:
        parameters[SHIFT] = sp.Symbol("sensor_shift", real=True)
        late |= {c: late[c] + parameters[SHIFT] for c in system.outputs}
    if symbols["tau"] in system.used:
        late["tau"] = sp.S.Zero
    first = next((delay for delay in late.values() if delay == 0), next(iter(late.values())))
    outputs |= {f"{DELAY_OF}{c}": delay - first for c, delay in late.items() if delay != first}
    return replace(
        system, symbols=symbols, parameters=parameters, orders=state_orders, equations=tuple(equations), outputs=outputs
    )


def _dampings(order: int) -> list[sp.Rational | None]:
    """Return twice the damping ratio of each pair of poles of a Butterworth filter, None for a single pole."""
    angles = np.pi * (2 * np.arange(order // 2) + 1) / (2 * order)
    pairs = [Fraction(2.0 * float(np.sin(a))).limit_denominator(DAMPING_DENOMINATOR) for a in angles]
    return [sp.Rational(p.numerator, p.denominator) for p in pairs] + [None] * (order % 2)
