"""Models from modes, and factors of matrices that are expressions, against sums over modes in closed form."""

import numpy as np
import pytest

import bayesperiodic as bp

Element = bp.elements.Element
SHAPES = np.array([[0.5, 0.7, 0.2], [0.9, -0.4, 0.3]])
VALUES = {"f1": 12.0, "zeta": 0.02}
FREQUENCIES, RATIOS = np.array([12.0, 31.0, 12.0 * 6.1]), np.array([0.02, 0.02, 0.01])
POINTS = 128


def plate(condensed, **changes):
    """Return three modes; the third frequency is 6.1 times the first."""
    given = {
        "frequencies": ["f1", 31.0, "6.1*f1"], "damping_ratios": ["zeta", "zeta", 0.01], "shapes": SHAPES,
        "forces": {"force": 0}, "outputs": {"x": ((0, 1), "displacement"), "a": (1, "acceleration")},
    }  # fmt: skip
    return bp.Model.from_modes("plate", **(given | changes), condensed=condensed)


def cosine(size):
    return {"force": size * np.cos(2 * np.pi * np.arange(POINTS) / POINTS)}


@pytest.mark.parametrize("condensed", [True, False])
def test_response_is_the_sum_over_the_modes(condensed):
    model, rate = plate(condensed), 2 * np.pi * 11.3
    assert set(model.parameters) == set(VALUES)
    solution = bp.solve_periodic(model, VALUES, cosine(2.0), frequency=11.3, samples=POINTS, scheme="fourier")
    poles = 2 * np.pi * FREQUENCIES
    q = 2.0 * SHAPES[0] / (poles**2 - rate**2 + 2j * RATIOS * poles * rate)
    turning = np.exp(2j * np.pi * np.arange(POINTS) / POINTS)
    for name, amplitude in {"x": (SHAPES[0] - SHAPES[1]) @ q, "a": -(rate**2) * SHAPES[1] @ q}.items():
        np.testing.assert_allclose(solution.outputs[name], (amplitude * turning).real, atol=1e-9 * abs(amplitude))


def test_condensed_modes_with_an_element_are_those_of_the_symbolic_equations():
    """Outputs, their derivatives by frequencies and damping ratios, and multipliers."""
    values, mount = VALUES | {"mount_k3": 3e7}, [Element("mount", bp.elements.cubic, 1)]
    here, other = (
        bp.solve_periodic(
            plate(condensed, elements=mount), values, cosine(30.0), frequency=12.3, samples=POINTS, scheme="fourier"
        )
        for condensed in (True, False)
    )
    assert here.status == other.status == "converged"
    spectrum = np.abs(np.fft.rfft(here.outputs["a"]))
    assert spectrum[3] > 0.01 * spectrum[1]
    np.testing.assert_allclose(here.outputs["a"], other.outputs["a"], atol=1e-8 * np.ptp(other.outputs["a"]))
    for name in values:
        exact = other.sensitivities["a"][name]
        np.testing.assert_allclose(here.sensitivities["a"][name], exact, atol=1e-8 * np.abs(exact).max())
    np.testing.assert_allclose(sorted(np.abs(here.multipliers)), sorted(np.abs(other.multipliers)), rtol=1e-7)


def test_multipliers_are_those_of_the_lowest_modes_whatever_their_order():
    """Without elements; of twenty modes in any order those of the sixteen lowest are given."""
    count, highest = 20, 80.0
    numbers = np.random.default_rng(0).permutation(np.arange(1, count + 1))
    frequencies, texts = highest / numbers, [f"top/{number}" for number in numbers]
    model = bp.Model.from_modes(
        "many", frequencies=texts, damping_ratios=["zeta"] * count, shapes=np.ones((1, count)),
        forces={"force": 0}, outputs={"x": (0, "displacement")},
    )  # fmt: skip
    values = {"top": highest, "zeta": 0.03}
    solution = bp.solve_periodic(model, values, cosine(1.0), frequency=20.0, samples=POINTS)
    decay = np.exp(-0.03 * 2 * np.pi * np.sort(frequencies)[: len(solution.multipliers) // 2] / 20.0)
    np.testing.assert_allclose(np.sort(np.abs(solution.multipliers)), np.sort(np.repeat(decay, 2)), rtol=1e-6)


@pytest.mark.parametrize("condensed", [True, False])
def test_a_factor_may_be_any_expression_of_parameters(condensed):
    """The bending stiffness of a plate, and half of a spring; the same as with the numbers in the matrices."""
    stiff, soft = np.array([[2.0, -1.0], [-1.0, 1.0]]), np.diag([1.0, 0.0])
    common = {"forces": {"force": 0}, "outputs": {"x": (1, "displacement")}, "condensed": condensed}
    model = bp.Model.from_matrices(
        "bent", mass=np.eye(2), damping={"0.5*beta": stiff}, stiffness={"1": soft, "E*t**3/12": stiff}, **common
    )
    assert model.parameters == ("beta", "E", "t")
    numbers = bp.Model.from_matrices(
        "numbers", mass=np.eye(2), damping=0.05 * stiff, stiffness=soft + 7.0 * 0.8**3 / 12 * stiff, **common
    )
    how = {"frequency": 0.13, "samples": POINTS, "scheme": "fourier"}
    here = bp.solve_periodic(model, {"beta": 0.1, "E": 7.0, "t": 0.8}, cosine(1.0), **how)
    np.testing.assert_allclose(
        here.outputs["x"], bp.solve_periodic(numbers, {}, cosine(1.0), **how).outputs["x"], atol=1e-9
    )
    by = here.sensitivities["x"]
    np.testing.assert_allclose(0.8 * by["t"], 3 * 7.0 * by["E"], atol=1e-9 * np.abs(by["t"]).max())
    assert np.ptp(by["E"]) > 0.01


def test_frequency_and_damping_ratio_of_a_mode_are_estimated():
    """Twelve modes of which the first is unknown: within five standard deviations, which a million sets allow."""
    rng, count = np.random.default_rng(5), 12
    shapes = rng.normal(size=(2, count)) / (1 + np.arange(count))
    model = bp.Model.from_modes(
        "beam", frequencies=["f", *(20.0 * np.arange(2, count + 1) ** 1.5)], damping_ratios=["zeta"] + [0.01] * 11,
        shapes=shapes, forces={"force": 0}, outputs={"a": (1, "acceleration")},
        elements=[Element("mount", bp.elements.cubic, 1, {"k3": 1e8})],
    )  # fmt: skip
    truth, runs = {"f": 21.0, "zeta": 0.015}, []
    for frequency in (20.0, 21.5, 22.5):
        exact = bp.solve_periodic(model, truth, cosine(5.0), frequency=frequency, samples=POINTS).outputs["a"]
        noisy = exact + 0.01 * np.ptp(exact) * rng.normal(size=POINTS)
        runs.append(bp.Experiment(f"{frequency} Hz", frequency, {"a": noisy}, cosine(5.0), samples=POINTS))
    priors = {"f": bp.LogNormal(20.0, 0.1), "zeta": bp.LogNormal(0.01, 0.5)}
    fit = bp.map_estimate(bp.Problem(model, runs, priors=priors), progress=False)
    for name, sd in fit.sd.items():
        if name in truth:
            assert abs(fit.theta[name] - truth[name]) < 5.0 * sd
            assert sd < 0.05 * truth[name]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frequencies": [1.0, 2.0]}, "frequencies: must be one of each of the 3 modes"),
        ({"damping_ratios": [0.01]}, "damping_ratios: must be one of each of the 3 modes"),
        ({"damping_ratios": 2}, "damping_ratios: must be < 1, got 2; give 0.02 for two percent"),
        ({"frequencies": "f1"}, "frequencies: must be one of each"),
        ({"frequencies": [0.0, "f2", "f3"]}, "frequencies: must be > 0, got 0; give a rigid motion"),
        ({"frequencies": ["f1;", "f2", "f3"]}, "frequencies: must consist of numbers, names"),
        ({"frequencies": ["_f", "f2", "f3"]}, "must be Python identifiers"),
        ({"shapes": np.ones(3)}, r"shapes: must be a finite array \(points, modes\)"),
        ({"forces": {"force": 2}}, r"forces\['force'\]: must be below 2"),
        ({"shapes": [[0.0] * 3, [1.0] * 3]}, r"forces\['force'\]: must be moved by at least one mode, got 0"),
    ],
)
def test_wrong_modes_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        plate(None, **changes)
