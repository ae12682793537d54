"""Predicted branches: linear resonance in closed form, folds of the Duffing oscillator, and their figure."""

import numpy as np
import pytest

import bayesperiodic as bp
from tests.diagnostics.test_predictive import posterior_of

TAU = np.arange(64) / 64
FORCE = {"force": np.cos(2 * np.pi * TAU)}
VARIANCE = 1e-4


def problem_of(k3: float, frequency: float, scheme: str = "fourier") -> bp.Problem:
    """Return the problem of an experiment with damping 0.2, of which the data do not matter here."""
    run = bp.Experiment("run", frequency, {"displacement": np.cos(2 * np.pi * TAU)}, FORCE, samples=64)
    return bp.Problem(
        bp.models.duffing,
        [run],
        priors={"k": bp.LogNormal(1.0, 0.3)},
        fixed={"m": 1.0, "c": 0.2, "k3": k3, "variance[displacement]": VARIANCE},
        scheme=scheme,
    )


def drawn(problem: bp.Problem, k: np.ndarray) -> bp.Posterior:
    return posterior_of(problem, k[:, None], np.full((k.size, 1), VARIANCE))


@pytest.mark.slow
def test_band_of_a_linear_resonance_is_that_of_the_closed_form():
    """The amplitude is 1/|k − ω² + i c ω|; interpolation over 1/100 of the way is 0.3 % at the peak."""
    problem, k = problem_of(0.0, 0.1), np.random.default_rng(0).normal(1.0, 0.05, 40)
    found = bp.predict_branch(problem, drawn(problem, k), "frequency", until=(0.05, 0.3), draws=40, progress=False)
    assert (found.draws, found.failed, found.incomplete, len(found.folds)) == (40, 0, 0, 0)
    band = found.band()
    assert band["value"].iloc[[0, -1]].tolist() == [0.05, 0.3]
    omega = 2 * np.pi * band["value"].to_numpy()
    amplitude = 1.0 / np.abs(k[:, None] - omega**2 + 0.2j * omega)
    expected = np.quantile(amplitude, [0.5, 0.05, 0.95], axis=0).T
    assert band[["median", "low", "high"]].to_numpy() == pytest.approx(expected, rel=0.01)
    assert band["stable"].all() and (band["fraction"] == 1.0).all() and (band["part"] == 0).all()
    assert found.band(measure="maximum")["median"].to_numpy() == pytest.approx(band["median"].to_numpy(), rel=0.01)


def test_folds_of_a_hardening_spring():
    """Equal draws: the folds of an independent harmonic balance; stable, unstable and stable between them."""
    problem = problem_of(0.5, 0.1)
    found = bp.predict_branch(problem, drawn(problem, np.ones(40)), "frequency", until=0.4, draws=3, progress=False)
    assert found.folds[["median", "low", "high"]].to_numpy() == pytest.approx(
        np.tile([[0.303382264798], [0.242089115564]], 3), abs=1e-5
    )
    assert found.folds["draws"].tolist() == [3, 3]
    band = found.band()
    by_part = band.groupby("part")
    assert by_part["stable"].mean().round(1).tolist() == [1.0, 0.0, 1.0]
    assert by_part["value"].agg(["min", "max"]).to_numpy() == pytest.approx(
        np.array([[0.1, 0.3034], [0.2421, 0.3034], [0.2421, 0.4]]), abs=1e-4
    )
    assert "fold at [Hz]" in repr(found) and "0.303382" in repr(found)
    axes = bp.plot.branch(found).axes[0]
    assert {line.get_linestyle() for line in axes.lines if len(line.get_xdata()) > 2} == {"-", "--"}
    assert len(axes.collections) >= 3
    assert axes.get_xlabel() == "frequency [Hz]"


def test_a_band_ends_where_less_than_half_of_the_draws_have_an_orbit():
    """Two of five draws are linear beyond the range: their stiffness has no fold at 0.1 to 0.4 Hz."""
    problem = problem_of(0.5, 0.1)
    k = np.repeat([1.0, 1.02, 1.04, 9.0, 9.5], 8)
    found = bp.predict_branch(problem, drawn(problem, k), "frequency", until=0.4, draws=5, progress=False)
    assert found.folds["draws"].tolist() == [3, 3]
    band = found.band()
    assert band.loc[band["part"] == 1, "fraction"].max() == pytest.approx(0.6)
    assert band["fraction"].min() >= 0.5


def test_input_that_cannot_be_followed_is_refused():
    problem = problem_of(0.0, 0.1)
    posterior = drawn(problem, np.ones(40))
    for arguments, text in (
        ({"vary": "K", "until": 2.0}, "vary: must be one of"),
        ({"vary": "frequency", "until": 0.1}, "until: must differ from the start value"),
        ({"vary": "frequency", "until": 0.2, "experiment": "rum"}, "Did you mean 'run'"),
        ({"vary": "frequency", "until": 0.2, "draws": 0}, "draws: must be"),
    ):
        with pytest.raises(ValueError, match=text):
            bp.predict_branch(problem, posterior, progress=False, **arguments)
    with pytest.raises(
        ValueError, match="posterior: must be a result of this problem, got one of .* with other constants"
    ):
        bp.predict_branch(problem_of(0.5, 0.1), posterior, "frequency", until=0.2, progress=False)
    found = bp.predict_branch(problem, posterior, "force", until=2.0, draws=1, progress=False)
    with pytest.raises(ValueError, match="measure: must be one of"):
        found.band(measure="period")
    with pytest.raises(ValueError, match="Did you mean 'displacement'"):
        found.band("displacment")
