import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic import arclength
from tests.known import CYCLE, SADDLE_NODE, grid
from tests.problems import DUFFING, DUFFING_PRIORS, duffing_run

DRAWS = 400


def saddle_node(prior) -> bp.Problem:
    generator = np.random.default_rng(1)
    runs = [
        bp.Experiment(name, 1.0, {"x": 1.0 + 0.01 * generator.standard_normal(40)}, {"u": np.zeros(40)}, samples=40)
        for name in ("run 1", "run 2")
    ]
    return bp.Problem(SADDLE_NODE, runs, priors={"a": prior})


def test_fraction_without_an_orbit_equals_the_prior_mass_beyond_the_fold():
    """Φ(−1) = 15.9 % of Normal(1, 1) is negative, where ẋ = a − x² has no equilibrium; draw by draw.

    Within 1/256 of the way from the fold the solver may fail, which is told apart.
    """
    problem = saddle_node(bp.Normal(1.0, 1.0))
    found = bp.prior_predictive(problem, draws=DRAWS, seed=3, progress=False)
    negative = np.mean(problem.sample_prior(DRAWS, 3)["a"] < 0.0)
    for row in ("run 1", "run 2", "all"):
        assert found.table.loc[row, "no orbit"] == negative
        assert found.table.loc[row, ["converged", "solver failed", "no orbit"]].sum() == pytest.approx(1.0)
        assert found.table.loc[row, "solver failed"] <= 0.005
    ends = {cause: share for cause, share in found.causes.items() if cause.startswith("no orbit")}
    assert sum(ends.values()) == pytest.approx(negative)
    assert all(cause.endswith("ends in a fold") for cause in ends)


def test_outputs_have_the_quantiles_of_the_prior():
    """The output √a with a ~ LogNormal(1, 0.5) has the quantiles e^(∓0.411); 4 errors of quantiles of 400 draws."""
    found = bp.prior_predictive(saddle_node(bp.LogNormal(1.0, 0.5)), draws=DRAWS, seed=1, progress=False)
    assert found.table.loc["all", "converged"] == 1.0
    for band, score in ((found.outputs.low, -1.6449), (found.outputs.median, 0.0), (found.outputs.high, 1.6449)):
        assert np.log(band["run 1"]["x"]) == pytest.approx(np.full(40, 0.25 * score), abs=0.1)
    assert found.table.loc["run 1", "inside"] == 1.0


def test_measured_values_outside_the_prior_are_seen():
    found = bp.prior_predictive(saddle_node(bp.LogNormal(9.0, 0.1)), draws=50, progress=False)
    assert found.table.loc["run 1", "inside"] == 0.0


def test_fraction_of_prior_draws_without_a_cycle_is_reported():
    """The cycle of radius √mu exists for mu > 0 only."""
    tau = grid(100)
    states = {"x": np.cos(2 * np.pi * tau), "y": np.sin(2 * np.pi * tau)}
    noisy = states["x"] + 0.01 * np.random.default_rng(1).standard_normal(100)
    run = bp.Experiment("run", 0.5, {"x": noisy}, samples=100, frequency_se=0.001, guess=states)
    priors = {"mu": bp.Normal(1.0, 1.0), "omega": bp.Normal(np.pi, 0.01)}
    problem = bp.Problem(CYCLE, [run], priors=priors)
    found = bp.prior_predictive(problem, draws=60, seed=2, progress=False)
    negative = np.mean(problem.joint_prior.sample(60, np.random.default_rng(2))[:, 0] < 0.0)
    assert 0.05 < negative == found.table.loc["run", "no orbit"]
    assert any("shrinks to an equilibrium" in cause for cause in found.causes)


def test_solver_failures_are_distinguished_from_missing_orbits(monkeypatch):
    problem = saddle_node(bp.Normal(1.0, 1.0))
    monkeypatch.setattr("bayesperiodic.density.responses.path_outcome", lambda *_: arclength.ARRIVED)
    found = bp.prior_predictive(problem, draws=40, progress=False)
    assert found.table["no orbit"].max() == 0.0 < found.table.loc["all", "solver failed"]


def test_well_behaved_prior_gives_no_warnings():
    problem = bp.Problem(bp.models.duffing, [duffing_run()], priors=DUFFING_PRIORS, fixed={"m": DUFFING["m"]})
    found = bp.prior_predictive(problem, draws=40, progress=False)
    assert found.table.loc["all", "converged"] == 1.0 and not found.causes
    assert "failed solves" not in repr(found)


def test_orbits_on_another_branch_are_distinguished_from_missing_ones():
    """With a wide prior of k near resonance, two of 50 draws belong to another branch."""
    force, truth = {"force": np.cos(2 * np.pi * grid(32))}, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}
    noise = {"displacement": 0.01}
    recording = bp.simulate(
        bp.models.duffing, truth, force, frequency=0.2, duration=200, sampling_rate=8, noise=noise, seed=1
    )
    priors = {"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 1.5)}
    fixed = {"m": 1, "k3": 0.5}
    problem = bp.Problem(bp.models.duffing, [recording.fold(32)], priors=priors, fixed=fixed, scheme="fourier")
    found = bp.prior_predictive(problem, draws=50, progress=False)
    assert found.table.loc["all", ["converged", "other orbit", "no orbit"]].tolist() == [0.96, 0.04, 0.0]
    assert list(found.causes) == [
        "other orbit (stalled): the branch folds back to another orbit at the same parameters"
    ]


def test_error_names_the_bad_argument_or_the_prior_without_orbits():
    with pytest.raises(ValueError, match="draws: must be .*got 5"):
        bp.prior_predictive(saddle_node(bp.Normal(1.0, 1.0)), draws=5)
    with pytest.raises(RuntimeError, match="none of 20 draws from its priors has a periodic solution"):
        bp.prior_predictive(saddle_node(bp.Normal(-9.0, 1.0)), draws=20, progress=False)


def test_result_is_saved_and_loaded(tmp_path):
    found = bp.prior_predictive(saddle_node(bp.Normal(1.0, 1.0)), draws=40, progress=False)
    found.save(tmp_path / "prior.h5")
    again = bp.load(tmp_path / "prior.h5")
    assert repr(again) == repr(found)
    assert np.array_equal(again.outputs.high["run 1"]["x"], found.outputs.high["run 1"]["x"])
