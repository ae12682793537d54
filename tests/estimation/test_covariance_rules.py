"""Covariance with uncertain noise, and the variances of residuals, against matrices by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic import noise
from bayesperiodic.estimation import covariance
from bayesperiodic.estimation.covariance import VariancePart
from bayesperiodic.likelihood.likelihood import Likelihood
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.multipliers import Multipliers

C = np.array([[4.0, 0.6], [0.6, 0.25]])
HARMONIC = np.array([0, 1, 2, 1, 2])
LOADING = np.random.default_rng(2).standard_normal((10, 2))


def block(channel="y", kind=MeanPeriod, count=5.0, measured=np.nan):
    return kind("run", channel, count, 5, HARMONIC, np.zeros(0), 16, 50.0, measured)


def problem_of(model, blocks, fixed=(), loadings=None):
    likelihood = Likelihood(model, blocks, dict(fixed), loadings)
    return SimpleNamespace(likelihood=likelihood, noise=model, free_noise=likelihood.free, names=("a", "b"))


def part(added, freedom=7.0, left=3.0):
    return VariancePart(np.zeros((2, 2)), added, left, freedom)


def test_unknown_variances_add_four_times_their_part_per_degree_of_freedom():
    problem = problem_of(noise.Independent(), [block(), block("z")])
    one, two = np.array([[0.3, 0.1], [0.1, 0.2]]), np.array([[0.2, -0.05], [-0.05, 0.1]])
    parts = {"variance[y]": part(one), "variance[z]": part(two, 5.0)}
    found = covariance.with_uncertain_noise(problem, None, C, parts)
    assert found == pytest.approx(C + 4.0 / 7.0 * one + 4.0 / 5.0 * two)
    # Of a part with a negative eigenvalue, in units of the sds, only the other one is added.
    sd = np.array([2.0, 0.5])
    turned = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
    mixed = turned @ np.diag([0.3, -0.2]) @ turned.T * np.outer(sd, sd)
    kept = turned @ np.diag([0.3, 0.0]) @ turned.T * np.outer(sd, sd)
    assert covariance.with_uncertain_noise(problem, None, C, {"variance[y]": part(mixed)}) == pytest.approx(
        C + 4.0 / 7.0 * kept
    )
    lost = np.diag([1.0, 0.0])
    assert covariance.with_uncertain_noise(problem, None, lost, parts) is lost
    assert covariance.with_uncertain_noise(problem, None, C, {}) == pytest.approx(C)


def test_unknown_shapes_of_the_spectrum_add_what_their_mixtures_do(monkeypatch):
    """In units of the least squares; a negative eigenvalue of the sum is left out."""
    model = noise.Circulant(kernel="exponential")
    problem = problem_of(model, [block(), block("z"), block("w")], {"lengthscale[w]": 0.1})
    scale, mixtures = np.array([2.0, 0.5]), {"y": np.diag([1.5, 1.2]), "z": np.array([[1.1, 0.3], [0.3, 1.4]])}
    asked = []

    def mixture(one, estimate, fit, shaped):
        (variance, _), members, left = shaped
        asked.append((one is problem, estimate, fit.scale is scale, members, left))
        return mixtures[variance[9]]

    monkeypatch.setattr(covariance, "_mixture", mixture)
    monkeypatch.setattr(covariance, "_with_errors", lambda *_: SimpleNamespace(scale=scale))
    parts = {
        "variance[y]": part(0.1 * C, 4.0, 3.5),
        "variance[z]": part(0.0 * C, 8.0, 2.5),
        "variance[w]": part(0.0 * C),
    }
    found = covariance.with_uncertain_noise(problem, "estimate", C, parts)
    each = [m * np.outer(scale, scale) - C for m in mixtures.values()]
    assert found == pytest.approx(C + 4.0 / 4.0 * 0.1 * C + sum(each))
    assert asked == [(True, "estimate", True, [0], 3.5), (True, "estimate", True, [1], 2.5)]
    asked.clear()
    del parts["variance[z]"]
    assert covariance.with_uncertain_noise(problem, "estimate", C, parts) == pytest.approx(1.1 * C + each[0])
    mixtures["y"] = np.zeros((2, 2))
    small = covariance.with_uncertain_noise(problem, "estimate", C, {"variance[y]": part(0.0 * C)})
    assert small == pytest.approx(np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("model", "kind", "fixed", "shaped"),
    [
        (noise.Circulant(kernel="exponential"), MeanPeriod, (), True),
        (noise.Circulant(kernel="exponential"), MeanPeriod, ("lengthscale[y]",), False),
        (noise.Circulant(kernel="exponential"), MeanPeriod, ("variance[y]",), False),
        (noise.Independent(), MeanPeriod, (), False),
    ],
)
def test_a_shape_is_uncertain_if_all_parameters_are_unknown(model, kind, fixed, shaped):
    problem = problem_of(model, [block(kind=kind)], dict.fromkeys(fixed, 0.1))
    ((group, members),) = problem.likelihood.groups()
    assert covariance._is_shaped(problem, group, members) is shaped
    if shaped:
        problem.likelihood.blocks = [SimpleNamespace(spectral=False)]
        assert covariance._is_shaped(problem, group, members) is False


@pytest.mark.parametrize("loadings", [None, {"run": LOADING}])
def test_least_squares_with_the_errors_eliminated_have_the_information_of_the_whole(monkeypatch, loadings):
    """Prior + J (V + L Lᵀ)⁻¹ Jᵀ, in units of the sds, as the Schur complement of the errors."""
    problem = problem_of(noise.Independent(), [block(), block("z", count=2.5)], loadings=loadings)
    prior = np.array([[0.3, 0.1], [0.1, 2.0]])
    problem.joint_prior = SimpleNamespace(curvature=lambda theta: prior * theta[0])
    jacobian = np.random.default_rng(3).standard_normal((2, 2, 5))
    values = np.array([2.0, 3.0])
    here = SimpleNamespace(jacobian=list(jacobian))
    estimate = SimpleNamespace(theta=np.array([1.5, 0.0]), here=here, noise=values)
    monkeypatch.setattr(covariance, "estimated_inputs", lambda *_: SimpleNamespace(residuals=["r"]))
    fit = covariance._with_errors(problem, estimate, C)
    sd = np.sqrt(np.diag(C))
    assert fit.scale == pytest.approx(sd) and fit.residuals == ["r"]
    # A variance of one sample, of which 50 are behind the 5 values; the second block has half a value a component.
    noise_variance = np.diag(np.repeat([2.0 * 5 / 50, 3.0 * 5 / 50 / 0.5], 5))
    whole = noise_variance if loadings is None else noise_variance + LOADING @ LOADING.T
    slopes = np.concatenate(jacobian, axis=1)
    count = len(fit.hessian)
    assert count == (2 if loadings is None else 4)
    inside, beside, errors = fit.hessian[:2, :2], fit.hessian[:2, 2:], fit.hessian[2:, 2:]
    complement = inside - beside @ np.linalg.solve(errors, beside.T) if count > 2 else inside
    expected = (prior * 1.5 + slopes @ np.linalg.solve(whole, slopes.T)) * np.outer(sd, sd)
    assert complement == pytest.approx(expected)
    moved = np.concatenate([part[2:] for part in fit.changes], axis=1)
    assert moved.T @ moved == pytest.approx(np.zeros((10, 10)) if loadings is None else LOADING @ LOADING.T)
    for b in range(2):
        assert fit.changes[b][:2] == pytest.approx(jacobian[b] * sd[:, None])


@pytest.mark.parametrize("loadings", [None, {"run": LOADING}])
def test_variance_that_errors_of_inputs_cause_is_their_part_of_the_whitened_covariance(loadings):
    """The trace of S⁻¹ L Lᵀ, with S = V + L Lᵀ; zero for blocks that have none."""
    blocks = [block(), block("z")]
    if loadings:
        blocks.append(Multipliers("other", "multipliers", 3.0, 3))
    problem = problem_of(noise.Independent(), blocks, loadings=loadings)
    values = np.array([2.0, 3.0])
    found = covariance._caused_variances(problem.likelihood, values)
    assert [part.shape for part in found] == [(one.size,) for one in blocks]
    if loadings is None:
        assert not np.concatenate(found).any()
        return
    caused = LOADING @ LOADING.T
    whole = np.diag(np.repeat([0.2, 0.3], 5)) + caused
    assert np.sum(found[0]) + np.sum(found[1]) == pytest.approx(np.trace(np.linalg.solve(whole, caused)))
    assert not found[2].any() and all(np.all(part > 0.0) for part in found[:2])


def test_residual_variances_are_one_zero_or_estimated_and_at_least_what_inputs_cause(monkeypatch):
    blocks = [block(), block("z"), Multipliers("other", "multipliers", 3.0, 3)]
    likelihood = problem_of(noise.Independent(), blocks).likelihood
    given = []

    def estimated(one, s, r, unit, information):
        given.append((one.channel, s, r.tolist(), unit.tolist(), information))
        return np.array([0.5, 2.0, 2.0, 0.1, 0.3])

    least = [np.full(5, 0.4), np.array([0.0, 0.0, 0.7, 0.0, 0.0]), np.zeros(3)]
    monkeypatch.setattr(covariance, "_residual_variance", estimated)
    monkeypatch.setattr(covariance, "_caused_variances", lambda one, values: least)
    residuals = [np.arange(5.0), np.zeros(5), np.ones(3)]
    found = covariance.residual_variances(likelihood, ["s", "t", "u"], residuals, np.array([2.0, 3.0]), "information")
    assert found[0].tolist() == [0.5, 2.0, 2.0, 0.4, 0.4]
    assert found[1].tolist() == [0.0, 0.0, 0.7, 0.0, 0.0] and found[2].tolist() == [1.0] * 3
    (arguments,) = given
    unit = (np.ones(5) / np.sqrt(0.2)).tolist()
    assert arguments[:3] == ("y", "s", [0.0, 1.0, 2.0, 3.0, 4.0]) and arguments[4] == "information"
    assert arguments[3] == pytest.approx(unit)


@pytest.mark.parametrize("held", [None, np.array([True, False])])
def test_robust_covariance_is_the_sandwich_of_scores_and_prior(monkeypatch, held):
    """Parameters that are held take up nothing of the residual, but their scores count."""
    problem = problem_of(noise.Independent(), [block(), block("z")])
    problem.joint_prior = SimpleNamespace(curvature=lambda theta: np.diag([0.3, 0.2]))
    generator = np.random.default_rng(5)
    jacobian, residuals = generator.standard_normal((2, 2, 5)), list(generator.standard_normal((2, 5)))
    values = np.array([2.0, 3.0])
    variances = [np.array([1.0, 2.0, 0.5, 0.3, 4.0]), np.array([0.2, 0.3, 3.0, 0.6, 1.0])]
    estimate = SimpleNamespace(theta=np.ones(2), noise=values, here=SimpleNamespace(jacobian=list(jacobian),
                                                                                    residuals=residuals))  # fmt: skip
    white = jacobian / np.sqrt([0.2, 0.3])[:, None, None]

    def given(likelihood, changes, rest, noise_values, information):
        free = slice(0, 2) if held is None else slice(1, 2)
        assert likelihood is problem.likelihood and noise_values is values
        assert changes == pytest.approx(white[:, free])
        assert rest == pytest.approx(np.array(residuals) / np.sqrt([0.2, 0.3])[:, None])
        whole = np.diag([0.3, 0.2]) + sum(s @ s.T for s in white)
        assert information == pytest.approx(whole[free, free])
        return variances

    monkeypatch.setattr(covariance, "residual_variances", given)
    middle = np.diag([0.3, 0.2]) + sum((s * v) @ s.T for s, v in zip(white, variances, strict=True))
    found = covariance.robust_covariance(problem, estimate, C, held)
    assert found == pytest.approx(C @ middle @ C)


@pytest.mark.parametrize("value", [0.4, 3.0])
def test_values_that_the_prior_of_a_variance_is_worth(value):
    """Of InverseGamma(a, b) 2a; of the flat one −2; of Jeffreys' none; a variance at an end is held there."""
    estimate = SimpleNamespace(noise=np.array([1.7, value]))

    def worth(prior, one=1.0):
        problem = problem_of(noise.Independent(prior=prior), [block("z", measured=0.3), block(measured=0.2)])
        return covariance._worth(problem, estimate, "variance[y]", one)

    assert worth(bp.InverseGamma(2.5, 1.3)) == pytest.approx(5.0, rel=1e-4)
    assert (worth("jeffreys", 0.7), worth("flat", 0.7)) == (0.0, pytest.approx(-2.0 * 0.7))
    assert worth(bp.Uniform(value, 9.0)) == np.inf


def test_degrees_of_freedom_are_satterthwaites():
    """Shares s of C in C F C of two variances: 1/Σ s²/ν; infinite where none of them matters."""
    parts = {
        "a": VariancePart(np.diag([2.0, 0.1]), C, 3.0, 6.0),
        "b": VariancePart(np.diag([1.0, 0.0]), C, 3.0, 4.0),
    }
    found = covariance.degrees_of_freedom(C, parts)
    assert found == pytest.approx([1.0 / (0.25 / 6.0 + 0.0625 / 4.0), 1.0 / (0.16 / 6.0)])
    assert covariance.degrees_of_freedom(C, {}).tolist() == [np.inf, np.inf]
    del parts["a"]
    assert covariance.degrees_of_freedom(np.diag([4.0, 0.0]), parts).tolist() == [64.0, np.inf]


def test_step_for_changed_residuals_is_in_standard_deviations():
    problem = problem_of(noise.Independent(), [block(), block("z")])
    generator = np.random.default_rng(5)
    jacobian, moved = generator.standard_normal((2, 2, 5)), list(generator.standard_normal((2, 5)))
    estimate = SimpleNamespace(here=SimpleNamespace(jacobian=list(jacobian)), noise=np.array([2.0, 3.0]))
    right = jacobian[0] @ moved[0] / 0.2 + jacobian[1] @ moved[1] / 0.3
    assert covariance._shift(problem, estimate, moved, C) == pytest.approx(C @ right / [2.0, 0.5])
