import contextlib
import io
import json
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from matplotlib.text import Text
from scipy import integrate, optimize, stats

import bayesperiodic as bp
from studies import common
from studies.__main__ import main
from studies.landing_gear import force, missing, quality
from studies.landing_gear import run as landing_gear
from studies.landing_gear.drop import MASS, drop
from studies.landing_gear.identification import FORCE, PRIORS, estimate, fold
from studies.landing_gear.quality import FAULTS
from studies.landing_gear.rig import (
    CYCLES,
    GEAR,
    NOISE,
    RECORDED,
    RUNS,
    SPEED_LIMIT,
    TRUTHS,
    Run,
    integrate_steady,
    measure,
    steady,
)

SMALL = next(run for run in RUNS if run.name == "6 Hz 4 mm")


def test_the_rig_keeps_its_power_limit_and_varies_the_amplitude_at_equal_frequency():
    assert len(RUNS) == len({run.name for run in RUNS}) == 14
    assert max(run.speed for run in RUNS) <= SPEED_LIMIT
    frequencies = [run.frequency for run in RUNS]
    assert sum(frequencies.count(f) > 1 for f in set(frequencies)) >= 2
    assert RUNS[0].stroke == max(run.stroke for run in RUNS) and RUNS[0].frequency == min(frequencies)


def test_truth_a_satisfies_equation_9():
    """The rig's time integration against the periodic solver on the ready-made model, at its order of accuracy."""
    cycle = integrate_steady(SMALL, TRUTHS["A"], 1600)
    solved = bp.solve_periodic(
        bp.models.landing_gear("displacement"), GEAR, cycle.inputs, frequency=SMALL.frequency, samples=1600,
        scheme="central4",
    )  # fmt: skip
    for channel in ("force", "pressure"):
        size = np.ptp(cycle.outputs[channel])
        assert cycle.outputs[channel] == pytest.approx(solved.outputs[channel], abs=1e-5 * size)


def test_the_rig_is_steady():
    """The gas of truth B ends a cycle as warm as it began: what it lacks would add up to less than 3 mK."""
    for run in (SMALL, Run(0.5, 60e-3)):
        cycle = integrate_steady(run, TRUTHS["B"], 2000).outputs["temperature"]
        drift = 3 * cycle[-1] - 3 * cycle[-2] + cycle[-3] - cycle[0]
        assert abs(drift) < 0.003 * (1.0 - np.exp(-0.7 * GEAR["theta16"] / GEAR["theta15"] / run.frequency))


def test_the_recording_does_not_repeat_its_phases_and_has_the_stated_noise():
    recording, clean = measure(SMALL, TRUTHS["A"], 3), steady(SMALL, TRUTHS["A"])
    phases = np.round((recording.time * SMALL.frequency % 1.0) * RECORDED).astype(int) % RECORDED
    assert np.unique(phases).size == RECORDED and recording.synthetic
    assert np.ptp(recording.time) * SMALL.frequency == pytest.approx(CYCLES, abs=0.01)
    for channel, sd in NOISE.items():
        noise = {**recording.inputs, **recording.outputs}[channel] - {**clean.inputs, **clean.outputs}[channel]
        assert noise.std() == pytest.approx(sd, rel=0.03)


def compression(psi: float) -> float:
    return np.hypot(0.58, 1.16) - np.hypot(2.02 * np.cos(psi) - 2.6, 1.16 - 2.02 * np.sin(psi))


def lever(psi: float) -> float:
    """Return the distance of the pivot, at (0, 1.16), from the gear's axis through the floor joint at (2.6, 0)."""
    axis = np.array([2.02 * np.cos(psi) - 2.6, 1.16 - 2.02 * np.sin(psi)])
    return abs(axis[0] * 1.16 + axis[1] * 2.6) / np.hypot(*axis)


def test_drop_agrees_with_equations_written_by_hand():
    """Moments about the pivot and eq. (9), integrated by SciPy's Radau."""
    g = GEAR

    def rates(_, y):
        psi, turning, temperature = y
        q, arm = compression(psi), lever(psi)
        v, bend = arm * turning, (lever(psi + 1e-5) - lever(psi - 1e-5)) / 2e-5
        p = g["theta5"] * temperature / (1 + g["theta6"] * q)
        still = g["theta3"] * v * abs(v) + g["theta4"] * p + g["theta11"]
        still += (g["theta8"] + g["theta9"] * p) * np.arctan(g["theta10"] * v) + g["theta1"] * bend * turning**2
        inertia = MASS * 2.02**2 + g["theta1"] * arm**2
        heat = (g["theta4"] * p + g["theta11"]) * v - g["theta16"] * (1 + g["theta6"] * q) * (temperature - 293.0)
        return [turning, (MASS * 9.81 * 2.02 * np.cos(psi) - still * arm) / inertia, heat / g["theta15"]]

    found = drop(GEAR, duration=3.0)
    start = optimize.brentq(lambda psi: compression(psi) - 0.02, 0.0, 0.1)
    path = integrate.solve_ivp(rates, (0, 3), [start, 0, 293], "Radau", found.time, rtol=1e-9, atol=1e-10)
    assert found.outputs["displacement"] == pytest.approx([compression(psi) for psi in path.y[0]], abs=1e-6)
    pressure = g["theta5"] * path.y[2] / (1 + g["theta6"] * found.outputs["displacement"])
    assert found.outputs["pressure"] == pytest.approx(pressure, rel=1e-5)


def test_the_dropped_gear_comes_to_the_balance_of_moments():
    """Without friction, after ten minutes, the gas as warm as the room."""
    free = GEAR | {"theta8": 0.0, "theta9": 0.0}
    psi = optimize.brentq(
        lambda psi: MASS * 9.81 * 2.02 * np.cos(psi) - lever(psi) * (5e3 / (1 - 2.5 * compression(psi)) - 500.0), 0, 0.2
    )
    assert drop(free, duration=600.0).outputs["displacement"][-1] == pytest.approx(compression(psi), abs=1e-5)


@pytest.mark.parametrize("slope", force.SLOPES)
def test_steep_friction_is_solved_and_a_coarse_grid_gives_a_warning(slope):
    """The arctan changes over within 2/slope of velocity: 3 steps and more of the grid at 300 s/m, not at 1000."""
    for run in (SMALL, Run(1.0, 18e-3)):
        found, warned = force.solve(run, slope, "force")
        assert found.converged and warned == (slope >= 1000.0)
        assert force.solve(run, slope, "displacement")[0].converged


def fundamental(signal: np.ndarray) -> complex:
    return complex(np.fft.rfft(signal)[1])


def lag(effects: set[str], run: Run) -> float:
    """Return by how much more than eq. (9) says the pressure lags the displacement, as a phase [rad]."""
    one, other = (integrate_steady(run, frozenset(e), 400).outputs["pressure"] for e in (set(), effects))
    return float(np.angle(fundamental(one) / fundamental(other)))


def test_a_line_lags_by_its_delay():
    for run in (SMALL, Run(1.0, 18e-3)):
        assert lag({"line"}, run) == pytest.approx(2 * np.pi * run.frequency * 1e-4, rel=0.01)


def test_lost_motion_lags_the_more_the_smaller_the_stroke():
    """A friction of 450 N behind 9e-8 m/N loses 0.04 mm either way, 4/π of it in the fundamental."""
    large, small = (lag({"flexure"}, Run(0.3, stroke)) for stroke in (60e-3, 12e-3))
    assert small / large == pytest.approx(5.0, rel=0.3)
    assert small == pytest.approx(4 / np.pi * 9e-8 * 450 / 12e-3, rel=0.2)


def test_convection_leads_and_friction_warms():
    run = Run(0.5, 60e-3)
    assert lag({"convection"}, run) < -1e-4
    warm, cold = (integrate_steady(run, frozenset(e), 400).outputs["temperature"] for e in ({"friction_heat"}, set()))
    assert 0.1 < warm.mean() - cold.mean() < 2.0


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Return the figures, the results and the printed account of a quick run."""
    return run_quickly(tmp_path_factory.mktemp("landing_gear"))


def linear(truth, priors, seed):
    """Return problem and draws of parameters that outputs are proportional to, each known to a thousandth of its size.

    They stand for those of a gear, whose draws take minutes.
    """
    model = bp.Model(
        "linear", states=["w"], inputs=["u"], parameters=list(priors), equations=["0.01*dw + w - u"],
        outputs={f"seen_{name}": f"{name}*w" for name in priors},
    )  # fmt: skip
    turn, generator = np.exp(2j * np.pi * np.arange(16) / 16), np.random.default_rng(seed)
    wave, sds = np.real(turn / (1.0 + 0.02j * np.pi)), {name: 3e-3 * abs(truth[name]) for name in priors}
    noisy = {f"seen_{name}": truth[name] * wave + sd * generator.standard_normal(16) for name, sd in sds.items()}
    one = bp.Experiment("run", 1.0, noisy, {"u": turn.real}, samples=16)
    known = {f"variance[seen_{name}]": sd**2 for name, sd in sds.items()}
    problem = bp.Problem(model, [one], priors=priors, fixed=known, scheme="fourier", input_noise="exact")
    fit = bp.map_estimate(problem, progress=False)
    return problem, bp.sample(problem, fit, seed=seed, **quality.SAMPLING)


@pytest.fixture(scope="module")
def populations(tmp_path_factory):
    """Return those of a quick run of populations, of linear models in place of gears.

    theta16 is 2 W/K in all experiments of truth A, and changes with the square of the stroke in those of truth B.
    """

    def gear(kind, seed):
        return linear({**GEAR, **quality.CHANGES[kind]}, quality.PRIORS, seed)

    def experiment(run, truth, seed):
        value = GEAR["theta16"] if truth == "A" else GEAR["theta16"] + 2e3 * (run.stroke - 0.04) ** 2
        return linear({"theta16": value}, {"theta16": quality.WIDE["theta16"]}, seed + round(1e4 * run.stroke))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quality, "examine", gear)
        patch.setattr(quality, "drawn_run", experiment)
        patch.setattr(common, "each", lambda work, tasks, **_: [work(*task) for task in tasks])
        return run_quickly(tmp_path_factory.mktemp("populations"), "--populations")


def run_quickly(out, *arguments):
    """Return the figures, the results and the printed account of a quick run with these arguments."""
    drawn, save, folder = {}, common.save_figures, out / "populations" if arguments else out

    def saved(folder, figures):
        drawn.update(figures)
        return save(folder, figures)

    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setattr(common, "save_figures", saved)
        assert main(["landing-gear", "--quick", *arguments, "--out", str(out)]) == 0
    assert {path.stem for path in folder.glob("*.png")} == set(drawn)
    assert max(path.stat().st_size for path in folder.glob("*.png")) < 200_000
    return drawn, json.loads((folder / "results.json").read_text(encoding="utf-8")), printed.getvalue()


@pytest.mark.slow
def test_quick_run_distinguishes_the_right_model_from_the_wrong_one(quick):
    _, results, printed = quick
    assert "SYNTHETIC" in printed and results["study"]["synthetic"] and results["study"]["quick"]
    assert results["A"]["misspecified"] == [] and results["A"]["signs"]["negative"] == []
    assert set(results["B"]["misspecified"]) == {run.name for run in landing_gear.QUICK}
    for truth in "AB":
        for one in results[truth]["experiments"].values():
            assert one["failures"] == {} and one["p_negative"] == pytest.approx(
                one["p_negative_laplace"]["theta16"], abs=0.08
            )
    small = results["B"]["experiments"][landing_gear.SMALL]["map"]["theta16"]
    assert small < results["A"]["experiments"][landing_gear.SMALL]["map"]["theta16"] - 4.0


@pytest.mark.slow
def test_the_force_given_its_noise_leaves_the_sign_open(quick):
    _, results, _ = quick
    given = results["A"]["force_given"]
    (one,) = given["experiments"].values()
    assert one["sign"] == "undetermined" and not one["misspecified"]
    value, sd = one["map"]["theta16"], one["laplace_sd"]["theta16"]
    assert abs(value - GEAR["theta16"]) < 3.0 * sd
    (exact,) = given["force_taken_for_exact"].values()
    assert exact["laplace_sd"]["theta16"] < 0.4 * sd


@pytest.mark.campaign
def test_with_the_force_given_standard_deviations_are_those_of_the_errors():
    """Errors of 20 campaigns in units of their standard deviations, at a false-alarm rate of 1 % for three parameters.

    Those of a force that is taken as exact are several times as large for theta16.
    """
    run, count = next(run for run in RUNS if run.name == landing_gear.SMALL), 20
    errors: dict[str, list[list[float]]] = {"measured": [], "exact": []}
    for seed in range(count):
        experiments = [fold(measure(run, (), seed), FORCE)]
        for kind, every in errors.items():
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "The noise of the measured inputs")
                fit = estimate(experiments, FORCE, input_noise=kind).fit
            every.append([(fit.theta[name] - GEAR[name]) / fit.sd[name] for name in PRIORS])
    squares = np.mean(np.square(errors["measured"]), axis=0)
    low, high = stats.chi2.ppf([0.005 / 3, 1 - 0.005 / 3], count) / count
    assert np.all((low < squares) & (squares < high))
    assert np.all(np.abs(np.mean(errors["measured"], axis=0)) < stats.norm.isf(0.005 / 3) / np.sqrt(count))
    assert np.mean(np.square(errors["exact"]), axis=0)[[*PRIORS].index("theta16")] > 4.0


@pytest.mark.slow
def test_quality_control_names_the_fault(populations):
    """One linear model of each kind, five parameters and four references; a false alarm comes in 1 % of them."""
    drawn, results, printed = populations
    assert set(drawn) == {"quality", "theta16"}
    kinds = results["quality"]["kinds"]
    named = {kind: {n for n, count in one["called_different"].items() if count} for kind, one in kinds.items()}
    assert named.pop("leaking oil") >= {"theta5"}  # that of theta6 is no larger than four references show
    assert named == {"good": set(), "low gas charge": {"theta5"}, "worn friction": {"theta8"}}
    assert kinds["worn friction"]["deviates"]["theta8"][0] < -5.0
    assert results["quality"]["reference"]["converged"] and "no importance sample" not in printed
    assert all(one["units_with_all_verdicts_right"] == 1 for kind, one in kinds.items() if kind != "leaking oil")
    assert kinds["good"]["error_rate"]["interval_95"] == pytest.approx([0.0, 0.975], abs=1e-3)
    assert "quality control" in printed
    for figure in drawn.values():
        assert any("synthetic" in text.get_text().lower() for text in figure.findobj(Text))


@pytest.mark.slow
def test_theta16_has_a_spread_over_the_experiments_only_where_it_differs(populations):
    """Four experiments: without a spread a Bayes factor above 20 for one comes in 5 % at most."""
    _, results, _ = populations
    assert set(results["theta16"]) == {"A", "B"} and all(one["converged"] for one in results["theta16"].values())
    verdicts = {truth: one["verdicts"]["theta16"] for truth, one in results["theta16"].items()}
    assert "not explained by noise" not in verdicts["A"] and "not explained by noise" in verdicts["B"]


@pytest.mark.slow
def test_model_with_lost_motion_has_lower_held_out_error(quick):
    """Each of the two experiments from the other; the score's gain is the fall of ln(rms) times independent values."""
    _, results, printed = quick
    models = results["repair"]["models"]
    paper, lost = models["eq. (9)"], models["lost motion"]
    assert lost["experiments_predicted_better"] == 2 and lost["gain_over_eq_9"][0] > 20.0
    gains = []
    for name, errors in paper["errors_held_out"].items():
        ratio = {channel: errors[channel] / lost["errors_held_out"][name][channel] for channel in errors}
        gains.append(121 * np.log(ratio["force"]) + 41 * np.log(ratio["pressure"]))
    assert lost["gain_over_eq_9"][0] == pytest.approx(np.mean(gains))
    assert "gain over eq. (9)" in printed


def test_a_faulty_gear_has_the_gas_law_of_its_fault():
    """A charge lower by 2 % has a pressure lower by as much; oil that leaves makes room for the gas."""

    def mean_pressure(kind):
        cycle = integrate_steady(SMALL, TRUTHS["A"], 400, FAULTS[kind])
        return cycle.outputs["pressure"].mean()

    assert mean_pressure("low gas charge") / mean_pressure("good") == pytest.approx(0.98, abs=1e-4)
    # p ∝ 1/(1 + ε − A q/V): at q = 0.12 m the gas has 0.7 of its volume.
    assert mean_pressure("leaking oil") / mean_pressure("good") == pytest.approx(0.7 / 0.71, abs=1e-3)
    assert mean_pressure("worn friction") / mean_pressure("good") == pytest.approx(1.0, abs=1e-9)


@pytest.mark.slow
def test_every_figure_is_drawn_and_labelled_synthetic(quick):
    drawn, _, _ = quick
    corners = {f"corner_{stroke}_{truth}" for stroke in ("large", "small") for truth in "AB"}
    assert set(drawn) == {"histories", "theta16", "theta16_force", "drop", "loops", "repair"} | corners
    for figure in drawn.values():
        assert any("synthetic" in text.get_text().lower() for text in figure.findobj(Text))


def test_campaigns_are_counted_and_resumed(tmp_path, monkeypatch):
    """Made-up campaigns: of 14 experiments each, one interval misses in every second campaign."""
    done = []

    def fake(task):
        done.append(task)
        truth, seed = task
        one = {
            "mcmc_covers": dict.fromkeys(("theta4", "theta6", "theta16"), True),
            "laplace_covers": dict.fromkeys(("theta4", "theta6", "theta16"), True),
            "sd": dict.fromkeys(("theta4", "theta6", "theta16"), 1.0),
            "sign": "positive",
            "misspecified": False,
            "map_converged": True,
            "stop_rule": False,
        }
        experiments = {run.name: one for run in RUNS}
        if seed % 2:
            experiments[SMALL.name] = one | {"sign": "negative", "mcmc_covers": one["mcmc_covers"] | {"theta6": False}}
        return {
            "truth": truth, "seed": seed, "source": landing_gear.source(), "experiments": experiments
        }  # fmt: skip

    monkeypatch.setattr(common, "workers", lambda: ThreadPoolExecutor(1))
    monkeypatch.setattr(landing_gear, "campaign", fake)
    landing_gear.campaigns(tmp_path, 2, 1)
    lines = landing_gear.campaigns(tmp_path, 4, 1)
    assert len(done) == len(lines) == 4
    found = landing_gear.account(lines)
    assert found["covered"]["mcmc"] == {"theta4": 56, "theta6": 54, "theta16": 56} and found["called_negative"] == 2
    assert found["covered_by_experiment"][SMALL.name]["theta6"] == 2
    tail = 0.005 / 3
    assert found["band"] == [stats.binom.ppf(tail, 56, 0.9), stats.binom.ppf(1 - tail, 56, 0.9)]
    assert "called negative 2 times" in landing_gear.table(found)


def test_terms_are_compared_with_the_effects_that_the_truth_has():
    """The heat of friction, nearly a constant force, is abs(ddisplacement); a short lag is the delay."""
    runs = [run for run in RUNS if run.name in ("3 Hz 4 mm", "1 Hz 18 mm")]
    experiments = [fold(measure(run, TRUTHS["B"], 1), "displacement") for run in runs]
    start = estimate(experiments, "displacement", one_conduction=True, scheme="central4")
    text, lagging = "abs(ddisplacement)", "lag(pressure) - pressure"
    ranked = [("equation of T", text, np.nan), ("pressure", lagging, 1e-3)]
    moved = missing.columns(start, ranked)
    assert len(moved["parameters"]) == 3 and len(moved["terms"]) == 2 and len(moved["effects"]) == 5
    found = missing.compare(start, ranked, ranked[1:])
    assert found["friction_heat"]["best"] == f"{text} in equation of T" and found["friction_heat"]["best_share"] > 0.9
    assert found["line"]["best"] == f"{lagging} in pressure" and found["line"]["all_steps_share"] > 0.99
    assert found["line"]["steps_shares"] == [found["line"]["best_share"]] and found["line"]["first_share"] < 0.9
