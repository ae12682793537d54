"""Solutions that the grid does not resolve, models without a solution, and the default scheme."""

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from bayesperiodic.periodic.batch import Anchor, AutonomousBatch, Batch
from bayesperiodic.periodic.compiled import NOT_RESOLVED, STATUSES
from bayesperiodic.periodic.equations import PeriodicEquations
from tests.known import CYCLE, SADDLE_NODE, grid
from tests.periodic.test_factors import SLOW_SCHEMES


def fitzhugh_nagumo(inputs=()):
    return bp.Model(
        "fitzhugh_nagumo",
        states=["v", "w"],
        inputs=inputs,
        parameters=["fast", "slow", "a", "b", "current"],
        equations=lambda s, p, u: [
            p.fast * s.dv - (s.v - s.v**3 / 3 - s.w + p.current + (u.drive if inputs else 0)),
            p.slow * s.dw - (s.v + p.a - p.b * s.w),
        ],
        outputs=lambda s, p, u: {"v": s.v},
    )


FREE, DRIVEN = fitzhugh_nagumo(), fitzhugh_nagumo(["drive"])
VALUES = {"fast": 0.08, "slow": 1.0, "a": 0.7, "b": 0.8, "current": 0.5}


def rates(drive):
    """Return the right-hand side of the FitzHugh-Nagumo equations, written out again."""

    def of(time, y):
        v, w = y
        return [(v - v**3 / 3 - w + 0.5 + drive(time)) / 0.08, v + 0.7 - 0.8 * w]

    return of


def integrated(drive, duration, start, **settings):
    return solve_ivp(rates(drive), (0.0, duration), start, method="LSODA", rtol=1e-11, atol=1e-12, **settings)


@pytest.fixture(scope="module")
def reference():
    """Return the period of the free cycle and a function of τ for its states, by SciPy."""

    def passage(time, y):
        return y[0]

    passage.direction = 1
    run = integrated(lambda t: 0.0, 60.0, [1.0, 0.0], events=passage)
    period = run.t_events[0][-1] - run.t_events[0][-2]
    cycle = integrated(lambda t: 0.0, period, run.y_events[0][-2], dense_output=True)
    return period, lambda tau: cycle.sol(tau * period)


def from_reference(reference, samples, scheme=None):
    period, cycle = reference
    v, w = cycle(grid(samples))
    return bp.solve_periodic(FREE, VALUES, frequency=1 / period, samples=samples, scheme=scheme, guess={"v": v, "w": w})


@pytest.mark.parametrize("samples", [200, 201, 300, 400, 401, 800])
def test_free_first_order_model_has_the_integrated_period_on_even_and_odd_grids_by_default(reference, samples):
    solution = from_reference(reference, samples)
    assert solution.converged and solution.scheme.name == "central4"
    assert solution.period == pytest.approx(reference[0], rel=4e-6)
    assert solution.states["v"] == pytest.approx(reference[1](grid(samples))[0], abs=5e-3)
    assert solution.error_estimate()["v"] < 1e-3


def test_log_posterior_of_a_free_first_order_model_is_finite_and_highest_near_the_truth_by_default(reference):
    period, cycle = reference
    v, w = cycle(grid(200))
    experiment = bp.Experiment(
        "run", 1 / period, {"v": v}, samples=200, guess={"v": v, "w": w}, frequency_se=1e-4 / period
    )
    problem = bp.Problem(
        FREE, [experiment], priors={"a": bp.LogNormal(0.7, 0.3)}, fixed={n: x for n, x in VALUES.items() if n != "a"}
    )
    at = np.array([0.69, 0.7, 0.71])
    shift = np.zeros(3)
    values = problem.log_posterior({"a": at, "shift[run]": shift}, {"v": np.full(3, 1e-4)})
    assert np.isfinite(values).all() and values.argmax() == 1


@pytest.mark.parametrize("samples", [100, 200, 400])
def test_driven_first_order_model_agrees_with_the_integration_by_default(samples):
    frequency, amplitude = 1 / 3.1, 0.3
    run = integrated(
        lambda t: amplitude * np.cos(2 * np.pi * frequency * t), 31 / frequency, [1.0, 0.0], dense_output=True
    )
    v, w = run.sol((30 + grid(samples)) / frequency)
    assert v == pytest.approx(run.sol((29 + grid(samples)) / frequency)[0], abs=1e-8)
    drive = amplitude * np.cos(2 * np.pi * grid(samples))
    solution = bp.solve_periodic(
        DRIVEN, VALUES, {"drive": drive}, frequency=frequency, samples=samples, guess={"v": v, "w": w}
    )
    assert solution.converged
    assert solution.states["v"] == pytest.approx(v, abs={100: 4e-2, 200: 2e-3, 400: 2e-4}[samples])


@pytest.mark.parametrize("scheme", [*SLOW_SCHEMES, "central4", "fourier"])
@pytest.mark.parametrize("samples", [32, 50, 60, 100, 101, 120, 150, 200, 300])
@pytest.mark.filterwarnings("ignore:The solution of:UserWarning")
def test_whatever_converges_has_the_integrated_period(reference, scheme, samples):
    """A coarse grid may be inaccurate, by 3 % with 32 points of backward2, but not by an alternating solution."""
    solution = from_reference(reference, samples, scheme)
    if scheme == "central2" and samples % 2 == 0:
        assert not solution.converged
    elif solution.converged:
        tolerance = {"central2": 17.0, "central4": 20.0, "backward2": 40.0, "fourier": 1.0}[scheme] / samples**2
        assert solution.period == pytest.approx(reference[0], rel=tolerance)


@pytest.mark.slow
def test_status_and_warning_of_an_unresolved_solution_name_the_cure(reference):
    with pytest.warns(UserWarning, match="is not resolved.*Take more samples than 200.*central4"):
        solution = from_reference(reference, 200, "central2")
    assert solution.status == "not resolved" and not solution.sensitivities
    assert solution.period == pytest.approx(3.0693, abs=1e-4)  # 2.8 % off: accepted before


def alternating(samples, part):
    return np.cos(2 * np.pi * grid(samples)) + part * (-1.0) ** np.arange(samples)


@pytest.mark.parametrize(
    ("values", "jagged"),
    [
        (alternating(200, 0.02), True),
        (alternating(201, 0.02), True),
        (alternating(200, 0.0) + 0.2 * (-1.0) ** np.arange(200) * np.exp(-(((np.arange(200) - 70) / 6) ** 2)), True),
        (alternating(200, 0.005), False),
        (np.sign(alternating(200, 0.001)), False),
        (np.abs(alternating(200, 0.0)), False),
        (np.random.default_rng(0).standard_normal(200), False),
        (1.0 + 1e-9 * (-1.0) ** np.arange(200), False),
    ],
    ids=["even", "odd", "burst", "small", "square wave", "kinks", "white noise", "constant"],
)
def test_only_alternation_above_one_per_cent_is_unresolved(values, jagged):
    equations = PeriodicEquations.build(CYCLE, None, frequency=1.0, samples=len(values))
    z = np.stack([np.cos(2 * np.pi * grid(len(values))), values], axis=-1)
    assert equations.kernels.is_jagged(z, equations.inputs) == jagged


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The solution of:UserWarning")
def test_batches_have_the_status_of_single_solves(reference):
    for model, scheme in ((FREE, "central2"), (FREE, "central4")):
        single = from_reference(reference, 100, scheme)
        assert single.status == "not resolved"
        equations = PeriodicEquations.build(model, None, frequency=single.frequency, samples=100, scheme=scheme)
        theta = np.array(list(VALUES.values()))
        z = np.stack(list(single.states.values()), axis=-1)
        batch = AutonomousBatch([equations], [Anchor(theta, z, single.frequency)])
        assert batch.solve(theta[None]).status[0, 0] == NOT_RESOLVED


@pytest.mark.parametrize("scheme", ["central2", "central4", "fourier"])
def test_alternation_between_two_branches_of_a_driven_model_is_unresolved_in_batches_too(scheme):
    """ẋ = 1 − x² + u: near x = ±1 the rates vanish, as does the first difference of alternating values."""
    drive = {"u": 0.1 * np.cos(2 * np.pi * grid(100))}
    guess = {"x": (-1.0) ** np.arange(100)}
    with pytest.warns(UserWarning, match="is not resolved"):
        single = bp.solve_periodic(
            SADDLE_NODE, {"a": 1.0}, drive, frequency=0.01, samples=100, scheme=scheme, guess=guess
        )
    equations = PeriodicEquations.build(SADDLE_NODE, drive, frequency=0.01, samples=100, scheme=scheme)
    theta, z = np.ones(1), np.ascontiguousarray(single.states["x"][:, None])
    status = Batch([equations], [Anchor.at(equations, theta, z)]).solve(theta[None]).status
    assert single.status == STATUSES[int(status[0, 0])] == "not resolved"


def test_response_to_a_noisy_input_is_accepted():
    """The noise of the displacement's derivative is at all harmonics, so that no grid would resolve the response."""
    theta = {"Kx": 1.0, "K": 1.0, "F0": 0.0, "Kw": 1.0, "rho": 40.0}
    noise = np.random.default_rng(0).standard_normal(200)
    for size in (1e-5, 1e-4, 1e-3):
        displacement = 0.1 * np.cos(2 * np.pi * grid(200)) + size * noise
        solution = bp.solve_periodic(bp.models.dahl, theta, {"displacement": displacement}, frequency=1.0, samples=200)
        assert solution.converged


@pytest.mark.parametrize("scheme", ["central2", "central4", "backward2", "fourier"])
@pytest.mark.parametrize("sharpness", [5.0, 50.0, 500.0])
def test_model_without_periodic_solution_does_not_converge(sharpness, scheme):
    """ẍ = exp(a x) + u with u of zero mean: the mean of ẍ is zero, that of the right-hand side positive."""
    model = bp.Model(
        "repelled",
        states=["x"],
        inputs=["u"],
        parameters=["a"],
        equations=lambda s, p, u: [s.ddx - sp.exp(p.a * s.x) - u.u],
        outputs=lambda s, p, u: {"x": s.x},
    )
    drive = np.cos(2 * np.pi * grid(200))
    solution = bp.solve_periodic(model, {"a": sharpness}, {"u": drive}, frequency=0.1, samples=200, scheme=scheme)
    assert solution.status in ("singular", "stalled", "not finite")


@pytest.mark.parametrize("scheme", ["central2", "central4", "backward2", "fourier"])
@pytest.mark.parametrize(
    "force",
    [
        lambda x: sp.exp(x),
        lambda x: 1 + sp.tanh(x),
        lambda x: sp.log(1 + sp.exp(x)),
        lambda x: 2 + sp.atan(x),
        lambda x: 1 / (3 + x),
        lambda x: sp.exp(-(x**2)),
    ],
)
def test_restoring_force_of_one_sign_holds_no_periodic_solution(force, scheme):
    """The means of ẍ, ẋ and of the drive are zero, that of the force is not; it vanishes as x tends to ±∞."""
    model = bp.Model(
        "escaping",
        states=["x"],
        inputs=["u"],
        parameters=["c"],
        equations=lambda s, p, u: [s.ddx + p.c * s.dx + force(s.x) - u.u],
        outputs=lambda s, p, u: {"x": s.x},
    )
    drive = np.cos(2 * np.pi * grid(200))
    solution = bp.solve_periodic(model, {"c": 0.1}, {"u": drive}, frequency=1.0, samples=200, scheme=scheme)
    assert solution.status in ("singular", "stalled", "not finite")


def chain(masses):
    """Return three masses in a row, the outer ones driven oppositely, or the first with the middle one fixed."""
    own = lambda s, p, x, sign, u: s["dd" + x] + p.c * s["d" + x] + s[x] ** 3 - sign * u.u  # noqa: E731
    equations = {
        1: lambda s, p, u: [own(s, p, "a", 1, u) + 2 * p.k * s.a],
        3: lambda s, p, u: [
            own(s, p, "a", 1, u) + p.k * (2 * s.a - s.b),
            s.ddb + p.c * s.db + p.k * (3 * s.b - s.a - s.d),
            own(s, p, "d", -1, u) + p.k * (2 * s.d - s.b),
        ],
    }
    return bp.Model(
        "chain",
        states=["a", "b", "d"][:masses],
        inputs=["u"],
        parameters=["c", "k"],
        equations=equations[masses],
        outputs=lambda s, p, u: {"a": s.a},
    )


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["central2", "central4", "backward2", "fourier"])
@pytest.mark.parametrize("stiffness", [1.0, 3.7, 100.3])
def test_mass_that_symmetry_keeps_at_rest_does_not_prevent_convergence(stiffness, scheme):
    """The middle of a symmetric chain whose ends are driven oppositely; its ends move like a mass on fixed springs."""
    drive = np.cos(2 * np.pi * grid(200)) + 0.3 * np.cos(4 * np.pi * grid(200) + 0.7)
    whole, part = (
        bp.solve_periodic(
            chain(masses), {"c": 0.1, "k": stiffness}, {"u": drive}, frequency=0.237, samples=200, scheme=scheme
        )
        for masses in (3, 1)
    )
    assert whole.status == part.status == "converged"
    np.testing.assert_allclose(whole.states["a"], part.states["a"], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(whole.states["d"], -part.states["a"], rtol=1e-7, atol=1e-9)
    assert np.abs(whole.states["b"]).max() < 1e-9


@pytest.mark.slow
def test_density_of_a_chain_with_a_mass_at_rest_is_that_of_half_the_chain():
    drive = np.cos(2 * np.pi * grid(100))
    y = 0.4 * np.cos(2 * np.pi * grid(100) - 0.3) + 0.01 * np.random.default_rng(3).standard_normal(100)
    data = bp.Experiment("synthetic", frequency=0.237, inputs={"u": drive}, outputs={"a": y}, samples=100)
    priors = {"c": bp.LogNormal(0.1, 1.0), "k": bp.LogNormal(1.0, 1.0)}
    points = np.array([[0.1, 1.0], [0.2, 0.9], [0.05, 3.0], [0.3, 2.0]])
    whole, half = (
        bp.Problem(chain(masses), [data], priors=priors).log_posterior(points, np.full((4, 1), 1e-4))
        for masses in (3, 1)
    )
    assert np.isfinite(half).all()
    np.testing.assert_allclose(whole, half, rtol=1e-7)


@pytest.mark.parametrize("scheme", ["central2", "central4", "backward2"])
def test_undamped_resonance_is_singular_or_said_to_depend_on_the_grid(scheme):
    force = np.cos(2 * np.pi * grid(200))
    values = {"m": 1.0, "c": 0.0, "k": 1.0, "k3": 0.0}
    with pytest.warns(UserWarning, match="so that the grid determines the solution. At resonance"):
        bp.solve_periodic(
            bp.models.duffing, values, {"force": force}, frequency=0.5 / np.pi, samples=200, scheme=scheme
        )


def test_undamped_resonance_has_no_solution_by_the_fourier_scheme():
    force = np.cos(2 * np.pi * grid(200))
    values = {"m": 1.0, "c": 0.0, "k": 1.0, "k3": 0.0}
    solution = bp.solve_periodic(
        bp.models.duffing, values, {"force": force}, frequency=0.5 / np.pi, samples=200, scheme="fourier"
    )
    assert not solution.converged


def test_default_scheme_is_of_fourth_order_for_states_of_first_order_only():
    assert bp.Problem.__init__.__kwdefaults__["scheme"] is None
    for model, name in ((CYCLE, "central4"), (bp.models.van_der_pol, "central2")):
        assert PeriodicEquations.build(model, None, frequency=1.0, samples=50).grid.scheme.name == name
