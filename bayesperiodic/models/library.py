"""Ready-made models."""

from bayesperiodic.models.model import Model

__all__ = ["dahl", "duffing"]

duffing = Model(
    "duffing",
    states=["x"],
    inputs=["force"],
    parameters={"m": "kg", "c": "N s/m", "k": "N/m", "k3": "N/m^3"},
    units={"x": "m", "force": "N", "displacement": "m"},
    equations=lambda s, p, u: [p.m * s.ddx + p.c * s.dx + p.k * s.x + p.k3 * s.x**3 - u.force],
    outputs=lambda s, p, u: {"displacement": s.x},
)

dahl = Model(
    "dahl",
    states=["w"],
    inputs=["displacement"],
    parameters={"Kx": "N s/m", "K": "N/m", "F0": "N", "Kw": "N", "rho": "1/m"},
    units={"displacement": "m", "force": "N", "w": "1"},
    equations=lambda s, p, u: [s.dw - p.rho * (u.ddisplacement - abs(u.ddisplacement) * s.w)],
    outputs=lambda s, p, u: {"force": p.Kx * u.ddisplacement + p.K * u.displacement + p.F0 + p.Kw * s.w},
)
