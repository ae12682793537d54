"""Frequencies of experiments as data and model determine them together, against normal distributions by hand."""

from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from tests.known import LINEAR, linear_experiment

# Amplitude, frequency, samples and standard deviation of the noise of the experiments.
AMPLITUDE, FREQUENCY, SAMPLES, SD = 0.05, 2.0, 40, 0.5
C, SE = 40.0, 0.02


def fitted(prior_sd, names=("run",), se=SE):
    """Return a fit of c alone, whose force c·dx/dt is in proportion to the frequency."""
    clean = np.array([900.0, C, 25.0])
    runs = [replace(linear_experiment(clean, SD, seed=k, name=name), frequency_se=se) for k, name in enumerate(names)]
    problem = bp.Problem(
        LINEAR, runs, priors={"c": bp.Normal(C, prior_sd)},
        fixed={"k": 900.0, "coulomb": 25.0, "variance[force]": SD**2}, input_noise="measured",
    )  # fmt: skip
    return bp.map_estimate(problem, progress=False)


def force_slopes():
    """Return the derivatives of the force by c and by the frequency at all samples."""
    phase = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
    velocity = 2 * np.pi * FREQUENCY * AMPLITUDE * np.cos(phase)
    friction = 25.0 * (1.0 - np.tanh(velocity / 0.1) ** 2) / 0.1
    return velocity, (C + friction) * velocity / FREQUENCY


@pytest.mark.parametrize("prior_sd", [1e-6, 2.0, 40.0])
def test_deviation_of_a_frequency_is_that_of_the_joint_normal_density(prior_sd):
    by_c, by_frequency = force_slopes()
    slopes = np.array([by_c, by_frequency])
    precision = slopes @ slopes.T / SD**2 + np.diag([prior_sd**-2.0, SE**-2.0])
    expected = np.sqrt(np.linalg.inv(precision)[1, 1])
    table = fitted(prior_sd).frequencies
    assert [*table.columns] == ["measured", "se", "estimate", "sd"] and [*table.index] == ["run"]
    row = table.loc["run"]
    assert (row["measured"], row["se"]) == (FREQUENCY, SE) and row["sd"] == pytest.approx(expected, rel=0.02)
    assert abs(row["estimate"] - FREQUENCY) < 4.0 * SE


def test_each_experiment_with_an_uncertain_frequency_has_a_row():
    table = fitted(1e-6, ("a", "b")).frequencies
    assert [*table.index] == ["a", "b"] and table.dtypes.unique().tolist() == [np.dtype(float)]
    assert fitted(1e-6, se=0.0).frequencies.empty
