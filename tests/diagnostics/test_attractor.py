"""Free runs against recordings of a driven piezoelectric beam with two wells, by a Runge-Kutta method of the tests."""

from dataclasses import replace
from math import comb

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from bayesperiodic.diagnostics import free_runs
from bayesperiodic.diagnostics.attractor_statistics import Statistics
from bayesperiodic.orbits.lyapunov import growth_of_pieces
from studies.shooting import PENDULUM
from tests.orbits import chaos, wells

FREQUENCY = 1.0 / wells.PERIOD
TRUTH = {"c": 0.2, "k": 0.5, "coupling": 0.1}
HIDDEN = ("y", "v", "y[-0.25]")
MODEL = bp.Model(
    "wells",
    states=["x", "v"],
    inputs=["force"],
    parameters=["c", "k", "coupling"],
    equations=lambda s, p, u: [
        s.ddx + p.c * s.dx - p.k * s.x * (1 - s.x**2) - p.coupling * s.v - u.force,
        s.dv + 0.088 * s.v + 0.5 * s.dx,
    ],
    outputs=lambda s, p, u: {"x": s.x, "y": s.dx, "v": s.v},
    units={"y": "m/s", "v": "V"},
)


def force(time):
    return 0.3 * np.cos(0.8 * time)


def section_of(number=0, periods=900, names=("x", "y", "v"), noise=0.002):
    """Return the section of one of several successive parts of the motion, with white noise."""
    first = number * (periods + 1) * wells.SAMPLES
    clean = wells.motion(24 * 901)[first : first + periods * wells.SAMPLES]
    noisy = clean + noise * np.ptp(clean, axis=0) * np.random.default_rng([number, 3]).standard_normal(clean.shape)
    time = np.arange(len(clean)) * wells.PERIOD / wells.SAMPLES
    kept = [name for name in wells.CHANNELS if name in {one.split("[")[0] for one in names}]
    outputs = {name: noisy[:, wells.CHANNELS.index(name)] for name in kept}
    recording = bp.Recording(time, outputs, {"force": force(time)}, synthetic=True)
    return bp.PoincareSection.from_recording(recording, names, frequency=FREQUENCY)


@pytest.fixture(scope="module")
def fitted():
    """Return a problem of one unstable orbit, and its estimate, with parameters exactly the true ones."""
    points = wells.motion(3000)[:: wells.SAMPLES]
    nearest = np.argmin(np.abs(points[1:] - points[:-1]).max(axis=1))
    known = wells.orbit(points[nearest : nearest + 1])
    path = wells.flow(known.states[0], 1, wells.SAMPLES, wells.STEPS)[:-1]
    noisy = path + 1e-3 * np.random.default_rng(0).standard_normal(path.shape)
    tau = np.arange(wells.SAMPLES) / wells.SAMPLES
    run = bp.Experiment(
        "orbit", FREQUENCY, dict(zip(wells.CHANNELS, noisy.T, strict=True)), {"force": force(wells.PERIOD * tau)},
        samples=wells.SAMPLES, guess={"x": path[:, 0], "v": path[:, 2]},
    )  # fmt: skip
    priors = {name: bp.LogNormal(value, 0.3) for name, value in TRUTH.items()}
    problem = bp.Problem(MODEL, [run], priors=priors, scheme="central4")
    return problem, replace(bp.map_estimate(problem, progress=False), theta=dict(TRUTH))


def predicted(fitted, section, **changed):
    problem, fit = fitted
    return bp.predict_attractor(problem, replace(fit, theta=fit.theta | changed), section, progress=False)


@pytest.fixture(scope="module")
def right(fitted):
    return predicted(fitted, section_of(names=HIDDEN))


def variational_growth(start, periods):
    """Return the logarithm of growth of small differences in each period, by the variational equations and SciPy."""

    def slope(time, y):
        x, rate, v = y[:3]
        jacobian = np.array([[0, 1, 0], [0.5 * (1 - 3 * x**2), -0.2, 0.1], [0, -0.5, -0.088]])
        motion = [rate, force(time) - 0.2 * rate + 0.5 * x * (1 - x**2) + 0.1 * v, -0.088 * v - 0.5 * rate]
        return np.concatenate([motion, jacobian @ y[3:]])

    growth, y = [], np.append(start, np.full(3, 3**-0.5))
    for period in range(periods):
        span = np.array([period, period + 1]) * wells.PERIOD
        y = solve_ivp(slope, span, y, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        length = np.linalg.norm(y[3:])
        growth.append(np.log(length))
        y[3:] /= length
    return np.array(growth)


def known_exponent(periods=4000):
    """Return the exponent [1/s] of the motion of the tests, by two neighbouring states, to 1 %."""
    y, direction, growths = wells.motion(900)[-wells.SAMPLES], np.full(3, 3**-0.5), []
    for _ in range(periods):
        one, other = (wells.flow(state, 1, 1, 640)[-1] for state in (y, y + 1e-7 * direction))
        length = np.linalg.norm(other - one) / 1e-7
        y, direction = one, (other - one) / (1e-7 * length)
        growths.append(np.log(length))
    return np.mean(growths) * FREQUENCY


def test_growth_of_a_run_is_that_of_the_variational_equations():
    start, periods = wells.motion(900)[0], 12
    runner = free_runs.Runner(MODEL, FREQUENCY, 512)
    time = np.arange(2 * 512 * periods + 2) / (1024 * FREQUENCY)
    table = np.stack([force(time), 0 * time, 0 * time], axis=1)
    # The states of the model are x, v, and the rate of x.
    theta = np.array([*TRUTH.values()])
    run = free_runs.free_run(runner, theta, start[[0, 2, 1]], table, periods, np.ones(3))
    assert np.abs(run.growth - variational_growth(start, periods))[:8] == pytest.approx(0.0, abs=2e-3)


def test_exponent_of_the_henon_map_from_its_points():
    """The published exponent is 0.4192 (Sprott, Chaos and Time-Series Analysis, 2003)."""
    x = np.zeros((20100, 2))
    for k in range(20099):
        x[k + 1] = 1 - 1.4 * x[k, 0] ** 2 + x[k, 1], 0.3 * x[k, 0]
    pieces = x[100:].reshape(500, 40, 2) / np.ptp(x[100:], axis=0)
    growth = growth_of_pieces(pieces, np.zeros(2), np.full(2, np.inf))
    assert growth.mean == pytest.approx(0.4192, rel=0.02)
    assert abs(growth.mean - 0.4192) < 3.0 * growth.sd


def test_exponent_of_the_ikeda_map_from_its_points():
    """The other exponent is that of two neighbouring orbits of the map, over the same points."""

    def following(z):
        return 1.0 + 0.9 * z * np.exp(1j * (0.4 - 6.0 / (1.0 + abs(z) ** 2)))

    z, direction, points, growths = 0.3 + 0.2j, 1.0, [], []
    for _ in range(20100):
        away = (following(z + 1e-8 * direction) - following(z)) / 1e-8
        growths.append(np.log(abs(away)))
        points.append((z.real, z.imag))
        z, direction = following(z), away / abs(away)
    points = np.array(points)[100:]
    pieces = points.reshape(500, 40, 2) / np.ptp(points, axis=0)
    growth = growth_of_pieces(pieces, np.zeros(2), np.full(2, np.inf))
    assert growth.mean == pytest.approx(np.mean(growths[100:]), rel=0.03)


def test_multipliers_of_orbits_of_period_three_and_more(fitted):
    """Newton's method on the flow gives the orbits, without noise."""
    section = section_of(names=("x", "y", "v"))
    orbits = [one for one, _ in wells.known_orbits(3000, 4) if len(one.states) > 2][:3]
    measured = []
    for number, one in enumerate(orbits):
        path = np.concatenate([wells.flow(state, 1, wells.SAMPLES, wells.STEPS)[:-1] for state in one.states])
        size = one.states.size
        measured.append(
            bp.Orbit(
                name=str(number), coordinates=section.coordinates, angles=(), frequency=FREQUENCY,
                period=len(one.states), winding=0, points=one.states, joint_covariance=1e-6 * np.eye(size + 3),
                eigenvalues=one.multipliers, eigenvalue_bias=np.zeros(3), returns=10, quality=1.0,
                cycle=dict(zip(wells.CHANNELS, path[::2].T, strict=True)),
            )
        )  # fmt: skip
    problem, fit = fitted
    result = bp.predict_attractor(problem, fit, section, runs=20, orbits=measured, progress=False)
    assert len(orbits) > 0 and result.missing_orbits == []
    for name, one in zip(result.orbit_table.index, orbits, strict=True):
        assert result.orbit_table.loc[name, "predicted"] == pytest.approx(one.multipliers[0].real, rel=0.03)


def test_hidden_state_is_that_of_the_recording():
    section = section_of(names=HIDDEN, noise=0.0)
    recorded = free_runs.Recorded(section, MODEL, 20)
    theta, runner = np.array([*TRUTH.values()]), free_runs.Runner(MODEL, FREQUENCY, 128)
    some = recorded.starts[:: len(recorded.starts) // 30]
    library = free_runs.library_of(recorded, runner, theta, [np.array([1.0, 0.0, 0.0])], some)
    clean = wells.motion(24 * 901)[:: wells.SAMPLES]
    for start in some:
        table = recorded.table(start, runner.steps)
        y, misfit = free_runs.explained_state(recorded, runner, theta, library, recorded.first_period(start), table)
        number = round(section.instants[start] * FREQUENCY)
        assert misfit < 1e-3
        assert y == pytest.approx(clean[number, [0, 2, 1]], abs=2e-3)


def test_right_model_with_a_hidden_state_is_consistent(right):
    """False-alarm rate 1 %; seed and recording are fixed."""
    assert right.verdict == "consistent"
    assert (right.left, right.settled) == (0, 0)
    assert right.unfitted <= 2 and right.misfit < 0.02
    assert "No test distinguishes" in repr(right)


def test_exponents_agree_with_the_known_one(right):
    """Within 3 standard errors, which fails by chance in 0.3 %; seed and recording are fixed."""
    exact = known_exponent()
    away = (right.exponents["exponent"] - exact) / right.exponents["sd"]
    assert np.abs(away).max() < 3.0
    assert right.exponents.loc["model", "sd"] < 0.04 * exact


@pytest.mark.parametrize(
    ("changed", "different"),
    [({"c": 0.3}, {"density", "Lyapunov exponent"}), ({"k": 0.55}, {"density"}), ({"c": 0.1}, {"runs that leave"})],
)
def test_wrong_model_is_different(fitted, changed, different):
    result = predicted(fitted, section_of(names=HIDDEN), **changed)
    table = result.table.drop("all")
    assert result.verdict == "different"
    assert different <= {*table.index[table["verdict"] == "different"]}
    assert all(name in repr(result) for name in different)
    assert "does not predict" in repr(result)


def test_runs_that_settle_are_counted(fitted):
    result = predicted(fitted, section_of(), c=0.35)
    assert result.settled > 50
    assert result.table.loc["runs that settle", "verdict"] == "different"


def test_share_of_runs_is_tested_by_counting():
    """With 30 pieces of the recording without, 9 of 100 runs are no evidence: p is a ratio of binomial coefficients."""
    left = np.arange(100) < 9
    _, share, low, high, p = Statistics.share(left, np.zeros(30, dtype=bool))
    assert p == pytest.approx(comb(100, 9) / comb(130, 9), rel=1e-9)
    # The end of the interval of a fraction of which 30 of 30 have none: (1 − q)³⁰ = 5 %.
    assert (share, low) == (0.0, 0.0) and high == pytest.approx(1 - 0.05 ** (1 / 30))


def test_pendulum_that_turns_is_predicted_without_inputs():
    """False-alarm rate 1 %; the recording, by a method of the tests, and the seed are fixed."""
    recording = chaos.recording(1500)
    section = bp.PoincareSection.from_recording(
        recording, ("angle", "rate"), frequency=chaos.FREQUENCY, angles=["angle"]
    )
    inertia = PENDULUM["length"] ** 2
    known = {f"k{i}": PENDULUM[f"c{i}"] * inertia for i in (1, 2, 3)}
    known |= {"a": PENDULUM["lift"], "g": PENDULUM["g"], "v0": PENDULUM["width"]}
    orbits = bp.find_orbits(section, periods=[1])
    problem = bp.Problem(
        bp.models.pendulum, [orbit.experiment(states={"phi": "angle"}) for orbit in orbits if not orbit.equilibrium],
        priors={"m": bp.LogNormal(1.0, 0.1), "l": bp.LogNormal(PENDULUM["length"], 0.1)}, fixed=known,
    )  # fmt: skip
    fit = bp.map_estimate(problem, checks=False, progress=False)
    result = bp.predict_attractor(problem, fit, section, progress=False)
    assert result.verdict == "consistent" and result.left == 0
    assert np.abs(result.model_section[..., 0]).max() <= np.pi
    wrong = bp.predict_attractor(problem, replace(fit, theta=fit.theta | {"m": 0.5}), section, progress=False)
    assert wrong.verdict == "different"


@pytest.fixture(scope="module")
def orbits():
    return bp.find_orbits(section_of(periods=2400, noise=0.001), periods=[1, 2], waveforms=True)


def test_orbits_of_the_right_model_are_those_of_newtons_method_on_the_flow(fitted, orbits):
    """Points and multipliers are within four standard errors; chance exceeds them in 0.3 % of cases, of 40 values."""
    problem, fit = fitted
    result = bp.predict_attractor(problem, fit, section_of(periods=2400, noise=0.001), orbits=orbits, progress=False)
    assert len(orbits) > 1 and result.missing_orbits == []
    assert f"the model has {len(orbits)} near the measured points.\n" in repr(result) + "\n"
    table = result.orbit_table
    assert table[["z_points", "z_multiplier"]].abs().max(axis=None) < 4.0
    known = [one for one, _ in wells.known_orbits(3000, 2)]
    for orbit in orbits:
        moduli = [one.multipliers[0].real for one in known if len(one.states) == orbit.period]
        assert np.abs(np.array(moduli) - table.loc[orbit.name, "predicted"]).min() < 0.02 * abs(orbit.eigenvalues[0])


@pytest.mark.parametrize("late", [1, 11, 23])
def test_orbits_of_a_section_at_another_phase_are_refused(fitted, orbits, late):
    """Waveforms begin by 1/24 of the forcing period and more later."""
    problem, fit = fitted
    turned = []
    for orbit in orbits:
        by = -late * (len(orbit.waveform.values["force"]) // orbit.period) // 24
        values = {name: np.roll(one, by) for name, one in orbit.waveform.values.items()}
        turned.append(replace(orbit, waveform=replace(orbit.waveform, values=values)))
    with pytest.raises(ValueError, match=r"orbits\[0\]: must be of a section at the phase of `section`, got 'period"):
        bp.predict_attractor(problem, fit, section_of(), orbits=turned, progress=False)


def test_orbits_of_a_wrong_model_are_missing_or_far(fitted, orbits):
    problem, fit = fitted
    section = section_of(periods=2400, noise=0.001)
    orbits = list(orbits)[:3]
    names = [orbit.name for orbit in orbits]
    for changed in ({"c": 0.3}, {"k": 0.55}):
        wrong = replace(fit, theta=fit.theta | changed)
        result = bp.predict_attractor(problem, wrong, section, runs=20, orbits=orbits, progress=False)
        scores = result.orbit_table[["z_points", "z_multiplier"]].abs().max(axis=1)
        assert {*result.missing_orbits, *scores.index[scores > 4.0]} == {*names}
        assert all(name in repr(result) for name in names)
    with pytest.raises(ValueError, match=r"orbits\[0\]: must be of a section of a recording with the coordinates"):
        bp.predict_attractor(problem, fit, section_of(names=HIDDEN), orbits=orbits)


@pytest.mark.slow
def test_false_alarms_are_as_rare_as_stated(fitted):
    """Of 24 recordings of 900 periods, 3 or more are falsely called different with a probability of 0.2 %."""
    results = [predicted(fitted, section_of(number, names=HIDDEN)) for number in range(24)]
    assert sum(result.verdict == "different" for result in results) < 3
    p = np.array([result.table.loc["density", "p"] for result in results])
    # 9 or more of 24 below 10 % have a probability below 0.1 %.
    assert np.sum(p < 0.1) < 9


def test_draws_of_a_posterior(fitted):
    """False-alarm rate 1 %; seeds are fixed."""
    problem, fit = fitted
    posterior = bp.sample(problem, fit, seed=1, max_steps=250, ensembles=2, progress=False)
    result = bp.predict_attractor(problem, posterior, section_of(), runs=40, progress=False)
    assert result.verdict == "consistent" and result.runs == 40


def test_result_is_repeatable_and_saved(right, fitted, tmp_path):
    again = predicted(fitted, section_of(names=HIDDEN))
    assert repr(again) == repr(right)
    right.save(tmp_path / "attractor.h5")
    loaded = bp.load(tmp_path / "attractor.h5")
    assert repr(loaded) == repr(right)
    np.testing.assert_array_equal(loaded.model_section, right.model_section)


def test_figure(right):
    figure = bp.plot.attractor(replace(right, orbits={"one": right.section[:1], "two": right.section[1:3]}))
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert labels == ["y [m/s]", "y [m/s]", "y [m/s]", "v [V]"]
    assert "consistent, synthetic data" in figure.get_suptitle()
    plt.close(figure)


def test_figure_without_runs_that_stay(right):
    figure = bp.plot.attractor(replace(right, model_section=right.model_section[:0], left=100))
    assert figure.axes[1].get_title() == "model (0 points)"
    assert "100 of 100 runs leave" in figure.get_suptitle()
    plt.close(figure)


def test_what_cannot_be_compared_is_refused(fitted):
    problem, fit = fitted
    section = section_of()
    points = bp.PoincareSection.from_points(section.points, section.coordinates, frequency=FREQUENCY)
    with pytest.raises(ValueError, match="section: must be of a recording, got points alone"):
        bp.predict_attractor(problem, fit, points)
    with pytest.raises(ValueError, match="at least 300 points with 30 later ones"):
        bp.predict_attractor(problem, fit, section_of(periods=300))
    with pytest.raises(ValueError, match="section: inputs of the model"):
        bp.predict_attractor(problem, fit, replace(section, inputs=()))
    with pytest.raises(ValueError, match="runs: must be"):
        bp.predict_attractor(problem, fit, section, runs=10)
    with pytest.raises(ValueError, match="periods: must be"):
        bp.predict_attractor(problem, fit, section, periods=10)
    time = section.instants + 0.1 * np.arange(len(section)) % 0.3
    with pytest.raises(ValueError, match="once a forcing period, got crossings"):
        bp.predict_attractor(problem, fit, replace(section, instants=time))
    other = bp.Problem(MODEL, problem.experiments, priors=problem.priors | {"c": bp.Normal(1, 1)}, scheme="central4")
    with pytest.raises(ValueError, match="fit"):
        bp.predict_attractor(other, fit, section)


def test_model_that_explains_no_period_is_refused(fitted):
    section = section_of()
    mirrored = replace(section, signals=section.signals * np.array([1.0, -1.0, 1.0, 1.0]))
    with pytest.raises(RuntimeError, match="of 100 starts with a misfit below 50%"):
        predicted(fitted, mirrored)
