"""Simultaneous fit of orbits and parameters, from starts at which the orbits differ or do not exist."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.density import initial_orbits
from bayesperiodic.density.initial_orbits import experiments_guesses, simultaneous_fit
from tests.known import LINEAR, linear_experiment
from tests.pendulum import FREQUENCY, GENTLE, PENDULUM, measured, section_problem
from tests.problems import cycle_run

PHI = {"phi": "angle"}
PAPER = {"m": 1.51 * PENDULUM["m"], "l": 1.189 * PENDULUM["l"], "k3": 2 * PENDULUM["k3"]}


@cache
def runs(noise: float, seed: int) -> tuple[bp.Experiment, ...]:
    """Return all nine orbits with multipliers below 50 as section points, to be started from their measured cycles."""
    return tuple(measured(k, noise=noise, seed=seed).experiment(samples=200, states=PHI) for k in GENTLE)


def estimate(names: tuple[str, ...], noise: float, seed: int) -> bp.MapEstimate:
    problem = section_problem(list(runs(noise, seed)), *names)
    return bp.map_estimate(problem, start={name: PAPER[name] for name in names}, progress=False)


@pytest.mark.parametrize("names", [("m", "l"), ("k3",)], ids=["m and l", "k3"])
@pytest.mark.parametrize(("noise", "accuracy"), [(1e-3, 0.01), (1e-2, 0.1)])
def test_the_papers_start_leads_to_the_truth_with_all_nine_orbits(names, noise, accuracy):
    """Within 4 standard deviations for three seeds (false-alarm rate 0.08 %), every orbit still the measured one."""
    for seed in range(3):
        fit = estimate(names, noise, seed)
        assert fit.converged
        for name in names:
            assert abs(fit.theta[name] - PENDULUM[name]) < 4 * fit.sd[name] < 4 * accuracy * PENDULUM[name]
        for k, solution in zip(GENTLE, fit.solutions.values(), strict=True):
            assert solution.converged and solution.periods == len(k.section)
            change = np.log(np.abs(solution.multipliers[0] / k.multipliers[0]))
            assert abs(change) < 50 * noise and np.sign(solution.multipliers[0].real) == np.sign(k.multipliers[0].real)


@pytest.mark.filterwarnings("ignore:A smooth sign")
def test_at_the_start_some_of_the_orbits_do_not_exist():
    """The start of k3: Newton's method stalls for three of the nine, so that continuing from there would lose them."""
    lost = 0
    for k, run in zip(GENTLE, runs(1e-3, 0), strict=True):
        solution = bp.solve_periodic(
            bp.models.pendulum,
            PENDULUM | {"k3": PAPER["k3"]},
            frequency=FREQUENCY,
            samples=200,
            scheme="central4",
            periods=len(k.section),
            winding=k.winding,
            guess=run.guess,
        )
        lost += not solution.converged
    assert lost >= 3


@pytest.mark.filterwarnings("ignore:A smooth sign")
def test_all_orbits_but_one_survive_a_continuation_to_the_papers_start_and_back():
    """40 steps to +51 % in m and +18.9 % in l, 40 back: the same orbit. That of period 4 merges with its period 2."""
    start = {name: PENDULUM[name] for name in ("m", "l")}
    far = {name: PAPER[name] for name in start}
    ways = [{n: start[n] + share * (far[n] - start[n]) for n in start} for share in np.linspace(0, 1, 41)]
    orbits = bp.polish_orbits(bp.models.pendulum, [measured(k) for k in GENTLE], PENDULUM, samples=200)
    assert len(orbits) == 9
    for orbit in orbits:
        path = [orbit.solution]
        for change in [*ways, *ways[::-1]]:
            found = bp.solve_periodic(
                bp.models.pendulum,
                PENDULUM | change,
                frequency=FREQUENCY,
                samples=200,
                scheme="central4",
                periods=orbit.period,
                winding=orbit.winding,
                guess=path[-1],
            )
            if not found.converged:
                break
            path.append(found)
        if orbit.period == 4:
            assert found.status == "other orbit" and len(path) < 25
        else:
            assert found.states["phi"] == pytest.approx(orbit.solution.states["phi"], abs=1e-8)
            assert np.ptp([solution.states["phi"] for solution in path], axis=0).max() > 0.05


@pytest.mark.slow
def test_only_combinations_of_the_five_pendulum_parameters_are_well_determined():
    """The combinations in the equations, k/(m l²), are determined far better than the parameters themselves."""
    names = ("m", "l", "k1", "k2", "k3")
    problem = bp.Problem(
        bp.models.pendulum,
        runs(1e-3, 1),
        priors={name: bp.LogNormal(1.3 * PENDULUM[name], 0.5) for name in names},
        fixed={name: value for name, value in PENDULUM.items() if name not in names},
        scheme="central4",
    )
    with pytest.warns(UserWarning, match="The data do not change under"):
        fit = bp.map_estimate(problem, start=PAPER | {"k1": 2.7e-4, "k2": 2e-4}, progress=False)
    drag = fit.derive({"c3": "k3/(m*l**2)"})
    assert fit.converged and abs(fit.theta["l"] - 0.3) < 4 * fit.sd["l"] < 4e-3
    assert fit.sd["m"] / fit.theta["m"] > 0.1
    mean, sd = drag.loc["c3", "value"], drag.loc["c3", "sd"]
    assert abs(mean - 0.05) < 4 * sd < 4 * 0.05 * 0.05


def test_log_likelihood_at_the_truth_is_chi_squared_distributed():
    """At the truth −2 log-likelihood is χ² distributed with 46 degrees of freedom; others would give thousands."""
    problem = section_problem(list(runs(1e-3, 2)), "m", "l")
    truth = {"m": PENDULUM["m"], "l": PENDULUM["l"]}
    assert 15 < -2 * float(problem.log_likelihood(truth, {"scale": 1.0})) < 95


def test_error_names_the_experiment_that_is_no_orbit():
    """One candidate that is no orbit of the pendulum, among four that are."""
    tau = np.arange(300) / 100
    angle = 2.0 * np.sin(2 * np.pi * tau / 3) + np.sin(14 * np.pi * tau)
    like = measured(next(k for k in GENTLE if len(k.section) == 3))
    points = np.stack([angle[::100], np.array([20.0, -20.0, 20.0])], axis=-1)
    false = replace(like, name="false", winding=0, points=points, cycle={"angle": angle, "rate": 0 * angle})
    experiments = [*runs(1e-3, 0)[:4], false.experiment(samples=200, states=PHI)]
    where = "parameters at which the other experiments' orbits are"
    with pytest.raises(ValueError, match=f"start: must be .*'false' cannot be followed from its guess to {where}"):
        bp.map_estimate(section_problem(experiments, "m", "l"), start={"m": 0.15, "l": 0.35}, progress=False)


def test_simultaneous_fit_needs_guesses_and_a_forced_model():
    linear = bp.Problem(
        LINEAR,
        [linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)],
        priors={"k": bp.Normal(800.0, 60.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)},
    )
    assert simultaneous_fit(linear, linear.median()) is None
    cycle = bp.Problem(
        bp.models.van_der_pol, [cycle_run()], priors={"mu": bp.LogNormal(1, 1), "omega": bp.Normal(1, 1)}
    )
    assert simultaneous_fit(cycle, cycle.median()) is None


OSCILLATOR = bp.Model(
    "oscillator", states=["x"], inputs=["F"], parameters=["c", "k"], equations=["ddx + c*dx + k*x - F"],
    outputs={"x": "x"},
)  # fmt: skip


def motion(frequency, k):
    """Return x (32,) under a cosine of this frequency [Hz] for c = 0.3, by its closed form."""
    w, phase = 2.0 * np.pi * frequency, 2.0 * np.pi * np.arange(32) / 32
    return (np.exp(1j * phase) / (k - w**2 + 0.3j * w)).real


def oscillators(k, guesses):
    """Return the problem of measured motions of a stiffness k at several frequencies, from guesses of the states."""
    generator, drive, runs = np.random.default_rng(1), np.cos(2.0 * np.pi * np.arange(32) / 32), []
    for frequency, guess in guesses.items():
        x = motion(frequency, k) + 1e-4 * generator.standard_normal(32)
        runs.append(bp.Experiment(f"{frequency} Hz", frequency, {"x": x}, {"F": drive}, samples=32, guess=guess))
    priors = {"c": bp.LogNormal(0.3, 0.5), "k": bp.LogNormal(4.0, 0.5)}
    return bp.Problem(OSCILLATOR, runs, priors=priors, scheme="fourier")


def test_orbits_that_solve_the_equations_at_a_start_are_left_there():
    """The data have k = 5, and the guesses, by the closed form, k = 4. Guesses one percent off are fitted with θ."""
    exact = {frequency: {"x": motion(frequency, 4.0)} for frequency in (0.2, 0.25)}
    start = np.array([0.3, 4.0])
    fit = simultaneous_fit(oscillators(5.0, exact), start)
    assert fit.theta.tolist() == start.tolist()
    for frequency, guess in exact.items():
        np.testing.assert_allclose(fit.states[f"{frequency} Hz"]["x"], guess["x"], atol=1e-12)
    off = {frequency: {"x": 1.01 * guess["x"]} for frequency, guess in exact.items()}
    assert simultaneous_fit(oscillators(5.0, off), start).theta == pytest.approx([0.3, 5.0], rel=1e-2)


def test_an_orbit_is_found_from_the_data_without_finding_known_ones_again(monkeypatch):
    """Of three experiments one has known states, one those found from its data, and one none."""
    sought, measured_orbit = [], initial_orbits._SimultaneousFit.measured_orbit
    monkeypatch.setattr(
        initial_orbits._SimultaneousFit,
        "measured_orbit",
        lambda fit, name, theta: sought.append(name) or measured_orbit(fit, name, theta),
    )
    given = oscillators(4.0, {0.2: {"x": motion(0.2, 4.0)}, 0.25: "data", 0.3: {}})
    guesses = experiments_guesses(given, np.array([0.3, 4.0]))
    assert {*sought} == {"0.25 Hz", "0.3 Hz"}
    assert guesses["0.3 Hz"] == {}
    np.testing.assert_array_equal(guesses["0.2 Hz"]["x"], motion(0.2, 4.0))
    np.testing.assert_allclose(guesses["0.25 Hz"]["x"], motion(0.25, 4.0), atol=1e-3)
