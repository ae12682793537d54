"""The trivial multiplier of autonomous orbits, which shows whether a grid resolves them, and what follows from it."""

import warnings

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp

MODEL = bp.models.van_der_pol


def period_of(mu):
    """Return the period of van der Pol's cycle, by SciPy."""

    def passage(time, y):
        return y[0]

    passage.direction = 1
    run = solve_ivp(
        lambda t, y: [y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]],
        (0, 60 + 6 * mu),
        [2.0, 0.0],
        method="LSODA",
        rtol=1e-9,
        atol=1e-11,
        events=passage,
    )
    return run.t_events[0][-1] - run.t_events[0][-2]


def solved(mu, samples, scheme=None):
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        orbit = bp.solve_periodic(MODEL, {"mu": mu, "omega": 1.0}, frequency=0.1, samples=samples, scheme=scheme)
    return orbit, " ".join(str(warning.message) for warning in given)


@pytest.mark.parametrize(("mu", "samples"), [(5.0, 100), (10.0, 400), (10.0, 800)])
def test_a_relaxation_oscillation_on_a_coarse_grid_has_no_stability_and_a_warning_that_names_the_cure(mu, samples):
    orbit, said = solved(mu, samples)
    assert orbit.converged and abs(orbit.period / period_of(mu) - 1.0) > 0.01
    assert orbit.stable is None and not orbit.resolved and orbit.trivial_error > 0.5
    assert "not resolved" in said and 'scheme="fourier"' in said
    assert "stability unknown" in repr(orbit) and "trivial multiplier" in orbit.stability_unknown
    cured, said = solved(mu, samples, "fourier")
    assert cured.stable is True and cured.resolved and not said
    assert cured.period == pytest.approx(period_of(mu), rel=2e-3)


@pytest.mark.parametrize("scheme", ["central2", "central4", "backward2", "fourier"])
@pytest.mark.parametrize("mu", [0.5, 1.0, 3.0])
def test_a_resolved_cycle_is_stable_without_a_warning(mu, scheme):
    orbit, said = solved(mu, 801, scheme)
    assert orbit.resolved and orbit.stable is True and not said
    assert orbit.period == pytest.approx(period_of(mu), rel=1e-3)


def test_every_cycle_that_counts_as_resolved_has_its_period_right_to_half_a_per_cent():
    for mu in (2.0, 5.0, 10.0):
        right = period_of(mu)
        for scheme in ("central2", "central4", "backward2", "fourier"):
            for samples in (100, 201, 400):
                orbit, _ = solved(mu, samples, scheme)
                if orbit.converged and orbit.resolved:
                    assert orbit.period == pytest.approx(right, rel=5e-3)


def test_a_driven_orbit_has_no_trivial_multiplier():
    force = {"force": np.cos(2 * np.pi * np.arange(64) / 64)}
    orbit = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0}, force, frequency=0.1, samples=64)
    assert np.isnan(orbit.trivial_error) and orbit.resolved and orbit.stable is True


def test_a_branch_names_the_orbits_that_are_not_resolved_and_has_no_special_points_there():
    start, _ = solved(2.0, 400)
    with pytest.warns(UserWarning, match="orbits of the branch are not resolved"):
        branch = bp.continue_periodic(MODEL, start, "mu", until=8.0, progress=False)
    unknown = [orbit.stable is None for orbit in branch]
    assert not unknown[0] and unknown[-1] and not branch.period_doublings
    assert np.array_equal(~branch.data["stability_known"].to_numpy(), unknown)
    labels = bp.plot.branch(branch).axes[0].get_legend().get_texts()
    assert [text.get_text() for text in labels] == ["stable", "stability unknown"]


@pytest.mark.slow
def test_a_fit_on_orbits_that_are_not_resolved_says_so_and_the_cure_recovers_the_truth():
    """Period and amplitudes of a cycle with mu = 5, by SciPy; the false-alarm rate of 4 standard deviations is 1e-4."""
    time = np.arange(0.0, 30 * period_of(5.0), 0.05)
    run = solve_ivp(
        lambda t, y: [y[1], 5 * (1 - y[0] ** 2) * y[1] - y[0]],
        (0.0, 60.0 + time[-1]),
        [2.0, 0.0],
        method="LSODA",
        rtol=1e-9,
        atol=1e-10,
        t_eval=60.0 + time,
    )
    noise = 0.02 * np.random.default_rng(0).standard_normal(time.size)
    recording = bp.Recording.from_arrays(time, {"displacement": run.y[0] + noise})
    priors = {"mu": bp.LogNormal(5.0, 0.3), "omega": bp.LogNormal(1.0, 0.3)}
    for scheme, samples, right in (("central2", 101, False), ("fourier", 151, True)):
        problem = bp.Problem(MODEL, [recording.fold(samples, origin="crossing")], priors=priors, scheme=scheme)
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always")
            fit = bp.map_estimate(problem, progress=False)
        said = any("is not resolved" in str(warning.message) for warning in given)
        assert said != right
        assert (abs(fit.theta["omega"] - 1.0) < 4 * fit.sd["omega"]) == right
