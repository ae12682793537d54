"""Models with closed-form answers, independent solutions, and experiments shared by the tests."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import sympy as sp
from scipy.signal import lfilter

import bayesperiodic as bp

# Weights of the central first difference of eighth order, antisymmetric.
EIGHTH_ORDER = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}


def formula_model(
    name: str, parameters: Sequence[str] | Mapping[str, str], outputs: Callable, **changes: object
) -> bp.Model:
    """Return a model whose outputs are formulas of the parameters and the input x; its state w filters x.

    `outputs` takes parameters, inputs and states.
    """
    return bp.Model(
        name,
        states=["w"],
        inputs=["x"],
        parameters=parameters,
        equations=lambda s, p, u: [s.dw + s.w - u.x],
        outputs=lambda s, p, u: outputs(p, u, s),
        **changes,
    )


# The output is linear in the parameters, so that posterior and Laplace approximation have closed forms.
LINEAR = formula_model(
    "linear",
    {"k": "N/m", "c": "N s/m", "coulomb": "N"},
    lambda p, u, s: {"force": p.k * u.x + p.c * u.dx + p.coulomb * sp.tanh(u.dx / 0.1)},
    units={"x": "m", "force": "N"},
)

# It has no equilibrium and no periodic solution.
RUNAWAY = bp.Model(
    "runaway",
    states=["x"],
    inputs=["u"],
    parameters=["a"],
    equations=lambda s, p, u: [s.dx - p.a * (1 + s.x**2) - u.u],
    outputs=lambda s, p, u: {"x": s.x},
)

# Equilibria ±√a for a > 0, none for a < 0.
SADDLE_NODE = bp.Model(
    "saddle_node",
    states=["x"],
    inputs=["u"],
    parameters=["a"],
    equations=lambda s, p, u: [s.dx - p.a + s.x**2 - u.u],
    outputs=lambda s, p, u: {"x": s.x},
)

# A cycle of radius √mu and rate omega for mu > 0, none for mu < 0.
CYCLE = bp.Model(
    "cycle",
    states=["x", "y"],
    parameters=["mu", "omega"],
    equations=lambda s, p, u: [
        s.dx - p.mu * s.x + p.omega * s.y + s.x * (s.x**2 + s.y**2),
        s.dy - p.mu * s.y - p.omega * s.x + s.y * (s.x**2 + s.y**2),
    ],
    outputs=lambda s, p, u: {"x": s.x},
)

# A consistent landing gear for eq. (9): SI units, theta11 = -1e5 theta4 (ambient pressure), nitrogen of 0.8 mol.
GEAR = {
    "theta1": 80.0, "theta2": 0.0, "theta3": 8e3, "theta4": 5e-3, "theta5": 1e6 / 293, "theta6": -2.5, "theta7": 0.0,
    "theta8": 150.0, "theta9": 1e-4, "theta10": 300.0, "theta11": -500.0, "theta12": 0.0, "theta15": 17.0,
    "theta16": 2.0, "theta17": -293.0,
}  # fmt: skip


def grid(samples: int) -> np.ndarray:
    """Return τ on a grid."""
    return np.arange(samples) / samples


def linear_regressors(x_amplitude: float, frequency: float, tau: np.ndarray) -> np.ndarray:
    """Return the columns that multiply k, c and coulomb when x = amplitude · sin(2πτ)."""
    rate = 2 * np.pi * frequency
    x, v = x_amplitude * np.sin(2 * np.pi * tau), x_amplitude * rate * np.cos(2 * np.pi * tau)
    return np.stack([x, v, np.tanh(v / 0.1)], axis=-1)


def linear_experiment(
    theta: np.ndarray, sd: float, seed: int, samples: int = 40, independent: int | None = None, name: str = "run"
) -> bp.Experiment:
    """Return an experiment of LINEAR with white noise on its samples."""
    tau = grid(samples)
    clean = linear_regressors(0.05, 2.0, tau) @ theta
    noise = sd * np.random.default_rng(seed).standard_normal(samples)
    return bp.Experiment(
        name,
        2.0,
        {"force": clean + noise},
        {"x": 0.05 * np.sin(2 * np.pi * tau)},
        samples=samples,
        independent=None if independent is None else {"force": independent},
    )


def normal_posterior(
    design: np.ndarray, values: np.ndarray, variance: float, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of θ for values = design · θ + noise and the prior N(mean, covariance)."""
    precision = np.linalg.inv(covariance)
    posterior = np.linalg.inv(design.T @ design / variance + precision)
    return posterior @ (design.T @ values / variance + precision @ mean), posterior


def difference(function: Callable, x: np.ndarray | float = 0.0, step: np.ndarray | float = 1e-2):
    """Return the first derivative by central differences of eighth order."""
    return sum(w * (function(x + k * step) - function(x - k * step)) for k, w in EIGHTH_ORDER.items()) / step


def complex_step_sensitivities(
    model: bp.Model,
    parameters: dict[str, float],
    inputs: dict[str, np.ndarray],
    frequency: float,
    samples: int,
    scheme: str,
) -> dict[str, dict[str, np.ndarray]]:
    """Return ∂output/∂parameter by complex steps through an independent dense solver of the same difference equations.

    Nothing of the package's kernels is used: SymPy's own NumPy code, dense circulant matrices and numpy.linalg.
    """
    weights = {
        "central2": ({-1: -0.5, 1: 0.5}, {-1: 1.0, 0: -2.0, 1: 1.0}),
        "backward2": ({0: 1.5, -1: -2.0, -2: 0.5}, {0: 2.0, -1: -5.0, -2: 4.0, -3: -1.0}),
        "central4": (
            {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12},
            {-2: -1 / 12, -1: 4 / 3, 0: -5 / 2, 1: 4 / 3, 2: -1 / 12},
        ),
    }[scheme]
    step = 1.0 / (samples * frequency)
    first, second = (
        sum(w * np.roll(np.eye(samples), o, axis=1) for o, w in row.items()) / step**order
        for order, row in zip((1, 2), weights, strict=True)
    )
    count = len(model.states)
    symbols = [*model.state_symbols.values(), *model.input_symbols.values(), *model.parameter_symbols.values()]
    symbols += list(model.time_symbols.values())
    q = list(model.state_symbols.values())
    residual = [sp.lambdify(symbols, e, "numpy") for e in model.equations]
    slopes = [[sp.lambdify(symbols, sp.diff(e, s), "numpy") for s in q] for e in model.equations]
    outputs = [sp.lambdify(symbols, e, "numpy") for e in model.output_expressions]
    spectral = {}
    harmonic = np.fft.fftfreq(samples, 1.0 / samples)
    for name, values in inputs.items():
        for order, prefix in enumerate(("", "d", "dd")):
            wave = np.fft.fft(values) * (2j * np.pi * frequency * harmonic) ** order
            spectral[prefix + name] = np.fft.ifft(wave).real
    ordered = [spectral[n] for n in model.input_symbols]

    def arguments(z: np.ndarray, theta: np.ndarray) -> list[np.ndarray]:
        states = [z[:, s] for s in range(count)] + [first @ z[:, s] for s in range(count)]
        states += [second @ z[:, s] for s in range(count)]
        return [*states, *ordered, *theta, grid(samples), frequency]

    def solve(theta: np.ndarray) -> np.ndarray:
        z = np.zeros((samples, count), dtype=complex)
        for _ in range(60):
            a = arguments(z, theta)
            g = np.concatenate([np.broadcast_to(f(*a), samples) for f in residual])
            blocks = [
                [
                    sum(
                        np.broadcast_to(slopes[e][order * count + s](*a), samples)[:, None] * d
                        for order, d in enumerate((np.eye(samples), first, second))
                    )
                    for s in range(count)
                ]
                for e in range(count)
            ]
            z = z - np.linalg.solve(np.block(blocks), g).reshape(count, samples).T
        return z

    base = np.array([parameters[n] for n in model.parameters], dtype=complex)
    result: dict[str, dict[str, np.ndarray]] = {name: {} for name in model.outputs}
    for index, name in enumerate(model.parameters):
        theta = base.copy()
        theta[index] += 1e-30j
        a = arguments(solve(theta), theta)
        for channel, f in zip(model.outputs, outputs, strict=True):
            result[channel][name] = np.broadcast_to(f(*a), samples).imag / 1e-30
    return result


def autoregressive(correlation):
    """Return a function of times and a generator that returns noise with this correlation of successive samples."""

    def noise(time, generator):
        white = generator.standard_normal(time.size + 6000) * np.sqrt(1 - correlation**2)
        return lfilter([1], [1, -correlation], white)[6000:]

    return noise


def one_over_f(time, generator):
    """Return noise with a spectrum 1/f down to a quarter of a line of the recording."""
    frequency = np.fft.rfftfreq(4 * time.size)
    frequency[0] = frequency[1]
    white = generator.standard_normal(frequency.size) + 1j * generator.standard_normal(frequency.size)
    noise = np.fft.irfft(white / np.sqrt(frequency), 4 * time.size)
    return noise[: time.size] / noise.std()


def hum(time, generator):
    """Return a tone of 5.0371 Hz over weak white noise."""
    tone = np.cos(2 * np.pi * 5.0371 * time + generator.uniform(0, 2 * np.pi))
    return tone + 0.1 * generator.standard_normal(time.size)


NOISES = {
    "white": lambda time, generator: generator.standard_normal(time.size),
    "autoregressive, 0.9": autoregressive(0.9),
    "autoregressive, 0.99": autoregressive(0.99),
    "autoregressive, 0.999": autoregressive(0.999),
    "1/f": one_over_f,
    "hum": hum,
}
