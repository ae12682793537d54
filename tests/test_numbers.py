"""Numbers in README.md and docs/**/*.md: each is that in figures/*/results.json, or listed with the reason why not.

A function below yields the phrases of one page with the stored numbers filled in, rounded as they are printed; each
must occur on that page. Every other number in the text must be part of a phrase in `WITHOUT_RESULTS`. If a study is run
again, its phrases change, and the test prints the new ones. Numbers in code, addresses and formulas are settings.
"""

import json
import re
from functools import cache
from pathlib import Path
from statistics import median

import numpy as np
import pytest

from studies.benchmark import large
from studies.coverage import run as study_of_coverage
from studies.diode import held_out, prediction
from studies.diode import run as study_of_diode
from tests.numbers_without_results import WITHOUT_RESULTS

ROOT = Path(__file__).parents[1]
DOCUMENTS = ("README.md", *(path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs").rglob("*.md"))))
# Its numbers are those of the scripts of which it is made.
DOCUMENTS = tuple(page for page in DOCUMENTS if page != "docs/reference/neighbours.md")
# Code, formulas, addresses and the titles of the paper's equations and figures contain no measured numbers.
NO_TEXT = (
    r"^```.*?^```", r"`[^`]*`", r"\$\$.*?\$\$|\$[^$]*\$", r"\]\([^)]*\)", r"^(## |\| )?\d+(\. | \| )", r"\(8\)",
    r"\b(eq\.|figures?|tables?|section)\s[\d(), and]*\d\)?",
)  # fmt: skip
NUMBER = re.compile(r"(?<![\w.,])\d[\d.,]*(?:e-?\d+)?")
WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
WORDS += ("thirteen", "fourteen")


def text(document):
    """Return a document in one line, without what NO_TEXT describes."""
    found = (ROOT / document).read_text("utf-8")
    for pattern in NO_TEXT:
        found = re.sub(pattern, "]" if pattern.startswith(r"\]") else " ", found, flags=re.DOTALL | re.MULTILINE)
    return " ".join(found.split())


SUBJECTS = []


def on(page):
    """Register a function whose phrases are on this page."""
    return lambda subject: SUBJECTS.append((page, subject)) or subject


@cache
def results(study):
    """Return results.json of a study."""
    return json.loads((ROOT / "figures" / study / "results.json").read_text("utf-8"))


def percents(values, digits):
    """Return fractions as "a, b and c", in percent."""
    *first, last = (f"{100 * abs(value):.{digits}f}" for value in values)
    return f"{', '.join(first)} and {last}"


def listed(values):
    """Return texts as "a, b and c"."""
    *first, last = map(str, values)
    return f"{', '.join(first)} and {last}"


@on("docs/studies/pendulum.md")
def pendulum():
    d, table = results("pendulum"), results("pendulum/table")
    m_and_l, k3 = (d["estimates"][which]["parameters"] for which in ("m and l", "k3"))
    start, used = d["start_errors"], d["data_reduction"]
    yield (
        f"From {d['recording']['drive_periods']:,} drive periods, {used['numbers_in_the_recording'] / 1e6:.1f} million "
        f"numbers with noise of {100 * d['noise']:.1f} % of the attractor, {used['numbers_used']} numbers are left: "
        f"the section points of {WORDS[len(d['selected'])]} unstable orbits."
    )
    yield (
        f"From a start that is {100 * start['m']:.0f} % off in m and {100 * start['l']:.1f} % in l, m comes out "
        f"{100 * abs(m_and_l['m']['relative_error']):.3f} % and l {100 * abs(m_and_l['l']['relative_error']):.3f} % "
        f"off the truth, and k3, from a start {100 * start['k3']:.0f} % off, "
        f"{100 * abs(k3['k3']['relative_error']):.3f} %."
    )
    low, high = table["table"]["0.001"], table["table"]["0.01"]
    names = ("m", "l", "k3")
    covered = [[one[n]["covered"]["cover"] for n in names] for one in (low, high)]
    band = low["m"]["covered"]
    yield f"Over {low['recordings']} recordings"
    yield f"Errors of m, l and k3 over {low['recordings']} recordings"
    yield (
        f"the median errors of m, l and k3 are {percents([low[n]['median_error'] for n in names], 3)} %, and the 90 % "
        f"intervals contain {listed(covered[0])} true values"
    )
    yield (
        f"with noise of 1 % they are {percents([high[n]['median_error'] for n in names], 2)} %, and contain "
        f"{listed(covered[1])}"
    )
    inside = all(band["band_low"] <= cover <= band["band_high"] for both in covered for cover in both)
    assert inside, "the sentence on the band says that all are inside"
    yield f"All are within the 99 % band, {band['band_low']:.0f} to {band['band_high']:.0f}."
    bars = low["eigenvalue_bars"]
    yield f"The error bars of the unstable eigenvalues contain {bars['cover']:,} of {bars['bars']:,} at 0.1 %."
    paper = d["paper_errors"]
    yield f"The errors of the paper's experiment are {percents([paper[n] for n in names], 1)} %."


@on("docs/explanation/paper.md")
def paper_table():
    paper, low = results("pendulum")["paper_errors"], results("pendulum/table")["table"]["0.001"]
    yield f"table 1: m {100 * paper['m']:.1f} %, l {100 * paper['l']:.1f} %, k3 {100 * paper['k3']:.1f} %"
    medians = ", ".join(f"{100 * low[n]['median_error']:.3f}" for n in ("m", "l", "k3"))
    yield f"medians {medians} % (synthetic, noise 0.1 %)"


@on("docs/studies/landing_gear.md")
def landing_gear():
    d = results("landing_gear")
    a, b = d["A"], d["B"]
    fast = [name for name in b["signs"]["negative"] if float(name.split()[0]) >= 2.0]
    forced = b["force_given"]["signs"]["negative"]
    assert len(fast) == len(b["signs"]["negative"]) and set(forced) <= set(fast)
    assert not a["signs"]["negative"] and not a["force_given"]["signs"]["negative"]
    assert len(b["misspecified"]) == len(b["force_given"]["misspecified"]) == 14
    assert not a["misspecified"] and not a["force_given"]["misspecified"]
    exact = a["force_given"]["force_taken_for_exact"].values()
    signs = sum(one["p_negative_laplace"]["theta16"] > 0.975 for one in exact)
    yield f"a fit that takes the force as exact calls {WORDS[signs]} signs negative"
    yield (
        f"it comes out negative with confidence in all {WORDS[len(fast)]} experiments from 2 Hz up with the "
        f"displacement given, in {WORDS[len(forced)]} of them with the force given"
    )
    yield "Either way all fourteen residuals call the model misspecified, and none calls the right one so"
    effects = d["repair"]["models"]
    force = {model: one["rms_error"]["force"] for model, one in effects.items()}
    yield f"the force is predicted to {force['all four']:.1f} N instead of {force['eq. (9)']:.0f} N"
    fits = [status for one in effects.values() for status in one["status"]]
    fits += [one["status"] for one in d["repair"]["theta16"].values()]
    yield f"({fits.count('converged')} of the {len(fits)} fits converged)"
    early = {truth: one["drop"]["displacement"] for truth, one in (("A", a), ("B", b))}
    share = {truth: 100 * one["share_within_the_band"]["0 to 2.5 s"] for truth, one in early.items()}
    off = {truth: 1e3 * one["largest_error_of_the_median"] for truth, one in early.items()}
    yield (
        f"stays within {off['A']:.3f} mm of the prediction, and within its 90 % band for {share['A']:.0f} % of the "
        f"first 2.5 s; for the other the error reaches {off['B']:.2f} mm, and the band contains it for "
        f"{share['B']:.1f} %."
    )


@on("docs/studies/landing_gear.md")
def landing_gear_populations():
    d = results("landing_gear/populations")
    of = d["theta16"]
    a, b = of["A"], of["B"]
    assert a["converged"] and b["converged"] and not a["remarks"]
    assert "6 Hz 4 mm lies outside" in b["remarks"][0] and "misspecified in 14 of 14" in b["remarks"][1]
    assert "No spread of theta16 is seen" in a["verdicts"]["theta16"]
    assert "not explained by noise, but perhaps by the error of the model" in b["verdicts"]["theta16"]
    factor = {
        truth: float(re.search(r"at least ([\d.e+]+)\)", one["verdicts"]["theta16"])[1]) for truth, one in of.items()
    }
    mean, slope, spread = ({truth: one["summary"][name] for truth, one in of.items()} for name in LABELS)
    yield (
        f"below {spread['A']['q95']:.2f} W/K with a probability of 95 %, the Bayes factor for no spread is at least "
        f"{factor['A']:.0f}, and the mean is {mean['A']['mean']:.2f} ± {mean['A']['sd']:.2f} W/K"
    )
    yield (
        f"it is {spread['B']['mean']:.1f} ± {spread['B']['sd']:.1f} W/K beside a trend of "
        f"{1e-2 * slope['B']['mean']:.1f} ± {1e-2 * slope['B']['sd']:.1f} W/K per centimetre of amplitude, and noise "
        f"does not explain it (Bayes factor for a spread at least {factor['B']:,.0f})"
    )
    q = d["quality"]
    kinds, good = q["kinds"], q["kinds"]["good"]
    assert q["reference"]["converged"] and not q["reference"]["remarks"]
    assert all(one["units_with_all_verdicts_right"] == one["units"] for one in kinds.values())
    (faulty,) = {one["units"] for kind, one in kinds.items() if kind != "good"}
    most = 100 * good["error_rate"]["interval_95"][1]
    yield (
        f"are named in all {WORDS[faulty]} gears that have them, and {good['units_with_any']} of {good['units']} good "
        f"gears are called different (95 % interval of the rate: 0 to {most:.0f} %)"
    )


LABELS = "mean[theta16]", "slope[theta16, amplitude]", "spread[theta16]"


def cost_of_the_gear():
    """Return largest errors and ratios to the time of a log-posterior, by drive and scheme."""
    cost = results("landing_gear")["cost"]
    schemes = {(drive, scheme): one for drive in cost for scheme, one in cost[drive]["schemes"].items()}
    names = ("compiled from static equilibrium", "compiled from the steady state at the estimate")
    static, near = (
        {key: one["ratios"][f"{name} / warm"]["median"] for key, one in schemes.items()} for name in names
    )  # fmt: skip
    worst = {key: max(e["error"] for e in one["experiments"].values()) for key, one in schemes.items()}
    lsoda = schemes[FORCE]["ratios"]["LSODA from static equilibrium / warm"]["median"]
    return static, near, worst, lsoda


FORCE, SECOND, FOURTH = ("force", "central4"), ("displacement", "central2"), ("displacement", "central4")


@on("docs/explanation/paper.md")
def paper_cost():
    static, near, _, _ = cost_of_the_gear()
    yield (
        f"{near[FORCE]:.0f} to {static[FORCE]:.0f} times with the force given, {near[SECOND]:.1f} to "
        f"{static[FOURTH]:.0f} with the displacement"
    )


@on("docs/studies/landing_gear.md")
def landing_gear_cost():
    static, near, worst, lsoda = cost_of_the_gear()
    yield (
        f"the force given it costs {static[FORCE]:.0f} times less than from static equilibrium and "
        f"{near[FORCE]:.0f} times less than from the steady state at the estimate, {lsoda:,.0f} times less than "
        "SciPy's LSODA."
    )
    yield (
        f"With the displacement given one smooth equation is left: {static[SECOND]:.1f} and {near[SECOND]:.1f} times "
        f"less at errors of {worst[SECOND]:.0e} of the range".replace("e-0", "e-")
    )
    yield f"{static[FOURTH]:.0f} and {near[FOURTH]:.0f} times less at {worst[FOURTH]:.0e}".replace("e-0", "e-")
    rows = ratios("landing gear, force given")
    yield (
        f"has {rows[STEADY + ' from equilibrium']:.0f} and {rows[STEADY + chr(32) + ESTIMATE]:.0f} for the same two "
        "comparisons"
    )


@on("docs/studies/landing_gear.md")
def landing_gear_campaigns():
    d = results("landing_gear/campaigns")
    low, high = d["band"]
    yield (
        f"the 90 % intervals of theta4, theta6 and theta16 cover {listed(d['covered']['mcmc'].values())} of "
        f"{d['experiments']} times (99 % band {low:.0f} to {high:.0f})"
    )
    yield f"Over {d['campaigns']} campaigns of the first truth"
    yield (
        f"theta16 is called negative {d['called_negative'] or 'no'} times and the model misspecified "
        f"{d['called_misspecified']} times, at a level of 1 %"
    )
    assert d["stop_rule_passed"] == 0, "the sentence on the stop rule is about none"
    yield f"Laplace's intervals, which need no draws, cover {listed(d['covered']['laplace'].values())} times"


@on("docs/how_to/populations.md")
def cost_of_stored_units():
    d, unit = results("population/stored"), results("population/scaling")["unit"]["seconds"]
    stages, last = ("reading", "chains", "shrinkage", "evidence"), list(d["units"].values())[-1]
    assert list(d["units"]) == ["10", "100", "1000"] and all(one["converged"] for one in d["units"].values())
    for count, one in d["units"].items():
        cells = [f"{one[stage]:.0f}" if one[stage] > 9.5 else f"{one[stage]:.2g}" for stage in stages]
        yield f"| {count} | {' | '.join(cells)} |"
        shares = [one[stage] / int(count) / (last[stage] / 1000) for stage in stages]
        assert count != "100" or max(abs(np.log(shares))) < np.log(2.0), "stages are not proportional to the units"
    yield f"{unit:.1f} s each for springs with three parameters, {unit * 1e4 / 3600:.0f} hours on 100 cores"
    yield f"{last['total'] / 60:.0f} minutes of one core and {last['memory'] / 1000:.1f} GB"
    test = d["tests"]["seconds_each"]
    yield f"{1000 * test:.0f} ms each, {test * 1e4 / 60:.0f} minutes on 100 cores"
    rest = sum(last[stage] for stage in stages[1:])
    yield f"would take {rest / 86.4:.0f} days after the files are read, and 48 GB"
    error = {name: last["summary"][name]["sd"] for name in last["summary"]}
    assert all(abs(last["summary"][n]["mean"] - true) < 3.0 * error[n] for n, true in d["truth"].items())


@on("docs/studies/population.md")
def population_cost():
    d = results("population/scaling")
    counts, end = list(d["joint"]), d["extrapolated"]
    ratios = [f"{one['times_fewer_evaluations']:.1f}" for one in d["joint"].values()]
    yield (
        f"takes {listed(ratios)} times more evaluations of a spring's density for {listed(counts)} springs. A power "
        f"law through these gives {end['times_fewer_evaluations']:.0f} times for {end['units']}"
    )
    stopped = [n for n, one in d["joint"].items() if not one["converged"]]
    yield f"The joint chains of {listed(stopped)} springs ended before the stop rule had passed"


@on("docs/studies/population.md")
def dampers_predicted():
    d = results("population")["dampers"]
    inside, predicted = d["inside_90"], d["predicted"]
    assert all(all(one["inside"].values()) for one in predicted.values() if one["member"] is not None)
    assert not any(one["member"] is False for one in predicted.values())
    words = {11: "eleven", 10: "ten", 2: "two"}
    undecided = [name.split("_")[2:] for name, one in predicted.items() if one["member"] is None]
    count, less = words[len(predicted)], words[len(predicted) - 1]
    yield f"Each of the {count} tests is predicted from the {less} others. The 90 % interval of a new"
    yield f"in {inside['Kw']} of {len(predicted)} tests for the friction force"
    yield f"in {inside['rho']} of {len(predicted)} for the sharpness"
    yield f"expected, {0.9 * len(predicted):.1f} on average"
    (first, *case), (second, *same) = undecided
    assert case == same == ["1Hz", "1.5in"]
    yield f"belongs to {words[len(undecided)]} tests, {first[:2]} lb and {second[:2]} lb at 1 Hz and 1.5 in, whose"
    yield f"The data of {words[len(undecided)]} tests determine"


@on("docs/studies/damper.md")
def damper():
    d = results("damper")
    laplace, robust, tried = d["laplace_sd"], d["robust_sd"], d["harmonics"]
    assert [name for name, verdict in d["comparison"].items() if verdict != "fine"] == ["rho"]
    yield f"identified from {d['cycles']} measured cycles"
    end = d["map"]["rho"] + 1.645 * laplace["rho"]
    short = (d["posterior"]["rho"]["q95"] - end) / d["posterior"]["rho"]["sd"]
    yield f"the upper end of Laplace's 90 % interval is {short:.1f} standard deviations too low"
    split = d["noise_split"]
    yield f"of {split['total']:.1f} N the scatter of the cycles explains {split['measurement']:.2f} N"
    ratio = {name: robust[name] / laplace[name] for name in laplace}
    yield (
        f"{ratio['rho']:.1f} times as large for rho, {ratio['Kw']:.1f} for Kw, {ratio['Kx']:.1f} for Kx, "
        f"{ratio['K']:.1f} for K and {ratio['F0']:.0f} for F0"
    )
    kept, exact, noisy = ([tried[i][key] for i in (0, -2, -1)] for key in ("kept", "rho_exact", "rho"))
    yield (
        f"rho is {listed(f'{one:,.0f}' for one in exact)} 1/m with {listed(kept)} displacement harmonics, at a "
        f"standard deviation of {laplace['rho']:,.0f} 1/m"
    )
    shown = listed(f"{one:,.0f}" for one in noisy)
    yield f"With the displacement's noise integrated out it is {shown} 1/m"
    first, second, third = d["missing_terms"]
    assert [one["term"] for one in (first, second)] == ["w*displacement**2", "ddisplacement**3"]
    assert third["term"] == "w*abs(ddisplacement)" and third["verdict"] == "misspecified"
    assert "w*displacement in force" in first["alternatives"]
    yield f"in the equation of w, makes it {100 * third['unexplained']:.2f} %"
    yield f"lowers the unexplained variance from {100 * d['fvu']:.2f} % to {100 * first['unexplained']:.2f} %"
    yield f"do not distinguish it from {len(first['alternatives'])} other terms"
    yield (
        f"in the equation of w it is {100 * second['unexplained']:.2f} %, and still no white noise "
        f"(p = {second['p_white']:.3f})"
    )


@on("docs/studies/silverbox.md")
def silverbox():
    d = results("silverbox")
    repeats = d["repetition"]
    yield f"{WORDS[d['cycles']]} measured periods with {d['input_harmonics']} lines"
    yield (
        f"leaves {100 * d['residual_fraction']:.3f} % of the response's standard deviation. The part that repeats "
        f"in every period is {repeats['repeats'] / repeats['does_not']:.1f} times the rest"
    )
    yield f"{100 * d['beyond_drive']['share_of_residual_power']:.0f} % of its power lies above the drive's last line"
    independent, circulant = (
        [d["robust_sd"][noise][name] / sd for name, sd in d["sd"][noise].items()]
        for noise in ("independent", "circulant")
    )
    yield (
        f"robust ones are {min(independent):.1f} to {max(independent):.1f} times as large with independent noise, "
        f"{min(circulant):.3f} to {max(circulant):.1f} times with circulant noise"
    )
    terms = [f"`{step['term']}`" for step in d["missing_terms"][1:]]
    last = d["missing_terms"][-1]
    assert last["verdict"] == "misspecified" and last["p_white"] < 0.01
    yield f"{terms[0]} and {terms[1]} in the response,"
    yield (
        f"{terms[2]} in the equation lower the residual to {100 * last['unexplained'] ** 0.5:.3f} % of the response's "
        "standard deviation"
    )


@on("docs/studies/flutter.md")
def flutter():
    d = results("flutter")
    yield (
        f"fitted amplitudes miss the {WORDS[len(d['errors'])]} measured ones by {100 * d['errors_rms']:.1f} % "
        f"(rms), those of the authors' values by {100 * d['authors_errors_rms_where_a_cycle_exists']:.0f} % where "
        "they have a cycle at all"
    )
    model, noise = d["misfit"]["model_error"], d["misfit"]["measurement_noise"]
    yield (
        f"wrong, by {model['heave']:.4f} in heave and {model['pitch']:.4f} in pitch (sensor units), "
        f"{model['heave'] / noise['heave']:.0f} and {model['pitch'] / noise['pitch']:.0f} times the measurement's noise"
    )
    missed = {
        case: [
            abs(one[channel]["error"]) for one in rows.values() if one["cycle_at_map"] for channel in ("heave", "pitch")
        ]
        for case, rows in d["predictions"].items()
    }
    lost = {case for case, rows in d["predictions"].items() if not all(one["cycle_at_map"] for one in rows.values())}
    assert lost == {"unstable from stable", "stable from unstable", "without 14.9 m/s"}
    yield (
        "Without the cycles at 16.4 and 16.5 m/s these are predicted within "
        f"{100 * max(missed['without 16.4 and 16.5 m/s']):.0f} %, without those at 17.2 and 17.3 m/s up to "
        f"{100 * max(missed['without 17.2 and 17.3 m/s']):.0f} % too small; neither kind alone, nor all without 14.9 "
        "m/s"
    )
    for order, name in (("quadratic", "k_alpha2 at gain 1"), ("cubic", "k_alpha3 at gain 1")):
        spring, by_kind = d["springs"][name], d["contraction"][name]
        stable, unstable, both = (by_kind[kind]["estimate"] for kind in ("stable", "unstable", "both"))
        sds = listed(f"{100 * value:.2g}" for value in spring["relative_sd"].values())
        low, high = spring["interval_with_model_error"]
        yield (
            f"the {order} one is {stable:,.0f} from the stable cycles, {unstable:,.0f} from the unstable ones and "
            f"{both:,.0f} from both, with standard deviations of {sds} %"
        )
        yield f"the {order} one lies between {max(low, 0.0):,.0f} and {high:,.0f}"
    apart = listed(f"{one['largest_difference_in_sds']:.0f}" for one in d["springs"].values())
    yield f"These estimates are up to {apart} of their standard deviations apart."
    missing = d["missing_terms"]
    models, terms = missing["models"], [f"`{step['term']}`" for step in missing["steps"]]
    assert [step["place"] for step in missing["steps"]][:3] == ["equation of alpha", "equation of w", "equation of w"]
    assert {step["verdict"] for step in missing["steps"]} == {"misspecified"}
    fitted, left_out = ([f"{100 * model[key]:.1f}" for model in models] for key in ("errors_rms", "left_out_rms"))
    yield f"of {missing['candidates']} candidates in the equations: with {terms[0]} in the moment,"
    yield f"{terms[1]} and {terms[2]} in the equation of the wake, fitted amplitudes miss by {fitted[3]} % and those of"
    yield (
        f"left out by {left_out[3]} %, where the given model misses these by {left_out[0]} % and lacks "
        f"{models[0]['without_a_cycle']} of them"
    )
    assert models[3]["without_a_cycle"] == 0 and float(fitted[4]) > float(fitted[3])
    yield f"A fourth term makes it worse, {fitted[4]} and {left_out[4]} %."
    yield f"first two terms alone predict no better than {left_out[2]} %"


@on("docs/studies/flutter.md")
def flutter_campaigns():
    account = results("flutter/campaigns")["account"]
    covered = {account["covered"][name] for name in ("k_alpha2", "k_alpha3")}
    low, high = account["band"]
    assert account["kept_apart"] == account["campaigns"] and not account["failures"]
    yield (
        f"the 90 % intervals of the two springs cover {' and '.join(map(str, sorted(covered)))} of "
        f"{account['campaigns']} times (99 % band {low:.0f} to {high:.0f})"
    )


@on("docs/studies/solver.md")
def solver():
    first = results("solver")["pendulum"]["rotations"]["first"]
    errors = {scheme: f"{one['relative_difference']:.0e}".replace("e-0", "e-") for scheme, one in first.items()}
    yield f"right to {errors['central4']} instead of {errors['central2']} with {first['central4']['samples']} points"


STEADY, ESTIMATE = "Runge-Kutta until steady", "from the estimate's orbit"
COLUMNS = (
    "landing gear, force given", "landing gear, displacement given", "Duffing, damping ratio 0.5 %", "damper",
    "Silverbox",
)  # fmt: skip
ROWS = {
    "compiled Runge-Kutta from equilibrium": f"{STEADY} from equilibrium",
    "the same from the estimate's orbit": f"{STEADY} {ESTIMATE}",
    "compiled shooting from the predicted orbit": "shooting from the predicted orbit",
    "SciPy's LSODA from the estimate's orbit": f"LSODA {ESTIMATE}",
    "SciPy's solve_bvp from the estimate's orbit": f"solve_bvp {ESTIMATE}",
    "diffrax from the estimate's orbit": f"diffrax {ESTIMATE}",
    "diffrax, one shooting step from the predicted orbit": "diffrax shooting from the predicted orbit",
    "a package for harmonic balance": f"harmonic balance {ESTIMATE}",
    "this package, 64 walkers at once": "this package, batched, all cores, central4",
    "this package, cold": "this package, cold, central4",
}


def ratios(problem):
    """Return the ratios of all methods to one warm log-posterior of a problem of the benchmark."""
    rows = results("benchmark")["problems"][problem]["rows"]
    return {row["name"]: row["ratio"]["median"] if isinstance(row["ratio"], dict) else row["ratio"] for row in rows}


def cell(value):
    """Return a ratio with two digits, or all that are before the point."""
    if value is None:
        return "-"
    if value >= 1000.0:
        return f"{round(value, -1):,.0f}"
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}" if value >= 0.995 else f"{value:.2f}"


@on("docs/benchmarks.md")
def cold_start():
    d = json.loads((ROOT / "figures" / "benchmark" / "cold_start.json").read_text("utf-8"))
    ways, installed = d["first_results"].values(), d["installation"]
    targets = {row["what"]: row for row in d["targets"]}

    def seconds(stage):
        return " | ".join(f"{way[stage]:.2g}" for way in ways)

    def target(*names):
        return " and ".join(f"{targets[f'{name} [s]']['high']:g}" for name in names)

    yield f"installation takes {installed['s']:.0f} s: {installed['packages']} packages, {installed['MB']:.0f} MB"
    yield f"| import | {seconds('import')} | - |"
    first = target("first solve, empty cache"), target("new model's first solve")
    yield f"a Duffing oscillator | {seconds('first solve')} | {first[0]} with the import, {first[1]} for a new model |"
    estimate = target("new model's first MAP")
    yield f"| first MAP estimate | {seconds('first MAP')} | {estimate} for a new model |"
    yield f"| first draws | {seconds('first draws')} | - |"
    for name, key in (("first command", "first_command"), ("tests", "tests")):
        both = " | ".join(f"{median(d[key][way]):.0f}" for way in ("empty", "full"))
        yield f"{name} | {both} | - | {target(*(f'{name}, {way} cache' for way in ('empty', 'full')))} |"
    for name, peer in d["peers"].items():
        size = f"{peer['installation s']:.0f} | {peer['installation MB']:.0f}"
        yield f"| {name} | {size} | {peer['import']:.2g} | {peer['first posterior evaluation']:.2g} |"
    limits = {"fold": large.FOLD_TARGET[2], "orbits": large.ORBIT_TARGET[2]}
    for what, size, joined in (("fold", 5_000_000, "with"), ("orbits", 500_000, "and")):
        sizes = d["large"][what]
        at = sizes["sizes"].index(size)
        limit = f"(target {target(f'{what}, {size:,}')} s and {limits[what]:g} GB)"
        assert sizes["GB"][at] <= limits[what]
        yield f"{sizes['s'][at]:.2g} s {joined} {sizes['GB'][at]:.2f} GB {limit}"
    yield f"in a section of {size:,} points"
    compared = d["compared"]
    yield f"they took {compared['fold']['GB']['before']:.2f} GB"
    yield f"in a loop of pure Python take {compared['ten million additions [s]']:.2f} s"
    command = compared["first command"]
    before, after = (command["processor s"][when] for when in ("before", "after"))
    for way in ("empty", "full"):
        ratio, limit = after[way] / before[way], command["target ratio"]
        assert ratio > limit, f"the page says that the target is missed, but the ratio with an {way} cache is {ratio}"
        yield f"| {way} cache | {before[way]:.1f} | {after[way]:.1f} | {ratio:.2f} | {limit:.2f} |"
    yield " and ".join(f"{d['large'][what]['exponent']:.2f}" for what in ("fold", "orbits"))
    missed = [row["what"] for row in d["targets"] if not row["met"]]
    assert not missed, f"the page names no missed target, but {missed} are"


@on("docs/benchmarks.md")
def benchmark_table():
    problems = [ratios(problem) for problem in COLUMNS]
    for label, name in ROWS.items():
        yield f"| {label} | {' | '.join(cell(rows.get(name)) for rows in problems)} |"
    gradients = [results("benchmark")["problems"][problem]["gradient_ratio"] for problem in COLUMNS]
    medians = (one["median"] if isinstance(one, dict) else one for one in gradients)
    yield f"| compiled shooting's value and gradient / ours | {' | '.join(map(cell, medians))} |"


@on("docs/benchmarks.md")
def benchmark():
    d, floor = results("benchmark"), {}
    for problem in (*COLUMNS[:1], *COLUMNS[2:3]):
        schemes = d["floor"][f"{problem}, folded"]["schemes"]
        floor[problem] = {
            part: [f"{schemes[scheme]['ratio'][part]['median']:.2g}" for scheme in ("central2", "central4")]
            for part in ("near", "batched", "gradient")
        }
    gear, duffing = floor.values()
    batched = {f"{float(value):.2f}" for value in gear["batched"]}
    assert len(batched) == 1 and len(set(duffing["batched"])) == 1
    yield f"then takes {gear['near'][0]} ( ) and {gear['near'][1]} ( ) of it on one core and {batched.pop()} in a batch"
    yield f"value and gradient take {' and '.join(gear['gradient'])}."
    yield (
        f"the ratios are {' and '.join(duffing['near'])}, {duffing['batched'][0]}, {' and '.join(duffing['gradient'])}."
    )
    checks = {one["what"]: one for one in d["checks"]}
    (gain,) = (one["value"] for what, one in checks.items() if "emcee around the fastest" in what)
    yield f"has {gain:.1f} times the effective samples per second of emcee around the fastest"
    step = [ratios(problem)["diffrax shooting from the predicted orbit"] for problem in COLUMNS[1:3]]
    yield f"one shooting step of diffrax takes {cell(min(step))} and {cell(max(step))} times a warm log-posterior"
    gradient = d["problems"][COLUMNS[1]]["gradient_ratio"]["median"]
    yield f"with the displacement given takes {gradient:.1f} times ours"
    seconds = checks["import with the names of an identification [s]"]["value"]
    yield f"the import of the names of an identification takes {seconds:.1f} s"
    yield f"It takes about {WORDS[round(d['seconds']['total'] / 60)]} minutes"
    missed, of_damper = (
        [what for what, one in checks.items() if not one["met"]],
        [w for w in checks if w[:6] == "damper"],
    )
    others = [what for what in missed if what not in of_damper]
    assert len(others) == 4, f"the README names four missed targets beside the damper's, not {others}"
    assert 2 * (len(missed) - len(others)) > len(of_damper), "it says that the damper misses most of its rows"


@on("docs/studies/calibration.md")
def calibration():
    d = results("calibration")
    count = d["study"]["replicates"]
    cases = ("duffing", "damper", "landing_gear", "miscounted", "two_optima")
    assert all(d[case]["replicates"] == count and not d[case]["failures"] for case in cases[:4])
    (failed,) = d["two_optima"]["failures"].values()
    yield f"Over {count} replicates each, of which {failed} of the last row and no others failed"
    labels = {
        "duffing": "Duffing: c, k, k3, variance", "damper": "damper: Kx, Kw, rho, variance",
        "landing_gear": "landing gear: theta4, theta6, theta16, two variances",
        "miscounted": "Duffing, variance a fifth too small: c, k, k3, variance",
        "two_optima": "gain 1.5 + (a − 2)², two optima: a, variance",
    }  # fmt: skip
    for case, label in labels.items():
        rows = [row for row in d[case]["table"] if row["method"] == "mcmc"]
        least = [min(row[test] for test in ("p_dispersion", "p_ecdf", "p_chi_square")) for row in rows]
        p = ", ".join(f"{value:.1g}".replace("e-0", "e-") for value in least)
        if case != "miscounted":
            p = f"{min(least):.2g}"
        cover, dispersion = (
            ", ".join(f"{row[key]:.{digits}f}" for row in rows)
            for key, digits in (("coverage_90", 3), ("dispersion", 2))
        )
        yield f"| {label} | {cover} | {dispersion} | {p} |"
    rejected = [
        (case, row["quantity"])
        for case in cases[:3]
        for row in d[case]["table"]
        if row["method"] == "laplace" and row["verdict"] != "calibrated"
    ]
    assert len(rejected) == 3 and ("landing_gear", "variance[force]") not in rejected
    assert all(quantity.startswith("variance") for _, quantity in rejected)
    own, laplace = (next(r for r in d["two_optima"]["table"] if r["method"] == m) for m in ("mcmc", "laplace"))
    assert own["quantity"] == laplace["quantity"] == "a"
    yield f"cover a in {laplace['coverage_90']:.0%} of the cases with two optima"
    yield f"those of MCMC in {own['coverage_90']:.0%}."
    assert sum(d[case]["stop_rule_passed"] for case in cases) == 1
    draws = [d[case]["independent_draws"] for case in cases]
    yield (
        f"Each rank is among {min(draws):.0f} to {max(draws):.0f} draws (medians of the cases) that are five "
        "autocorrelation times apart, so that its position has a Monte Carlo error of at most "
        f"{d['duffing']['largest_error_of_a_position']:.2f}; R-hat of these chains is at most "
        f"{max(d[case]['largest_rhat'] for case in cases):.3f}."
    )
    yield f"Chains of {d['study']['steps']} steps"


@on("docs/studies/verdicts.md")
def verdicts():
    found = results("verdicts/replicates")["cases"]
    right = found["linear"]
    faulty = {name: one for name, one in found.items() if name != "linear"}
    assert all(one["data"]["named"] == one["data"]["replicates"] for one in faulty.values())
    assert not any(one["sampler"]["verdicts_that_flip"] for one in found.values())
    wrong = {name: sum(one["data"]["wrong"].values()) for name, one in faulty.items() if one["data"]["wrong"]}
    assert wrong == {"two_modes": 1}, "the sentence in brackets is about one wrong verdict"
    yield (
        f"of {right['data']['replicates']} problems without a fault {WORDS[right['data']['warned']]} gets a "
        f"warning, of {faulty['two_modes']['data']['replicates']} with each fault all are named (one of those with two "
        f"modes is also falsely called misspecified), and over {right['sampler']['replicates']} seeds of the "
        "sampler no verdict changes"
    )


@on("docs/studies/sampling.md")
def sampling():
    d = results("sampling")
    yield f"{d['seconds']['total'] / 60:.0f} minutes on two cores; what several cores gain"
    force, displacement = (d["cost"]["vectorised"][drive] for drive in ("force", "displacement"))
    yield (
        f"Calls of {d['cost']['vectorised']['walkers']} walkers of the landing gear take {force['milliseconds']:.0f} "
        f"and {displacement['milliseconds']:.0f} ms, so short that two cores gain {force['gain']:.2f} and "
        f"{displacement['gain']:.2f} times on them, and {force['plain']:.2f} times on a plain loop"
    )
    pools = d["cost"]["pools"]
    process, dask = (100 * (pools["ratios"][name]["median"] - 1) for name in ("process", "dask"))
    yield (
        f"At {pools['milliseconds']['wall']:.0f} ms a density a pool of one process costs {process:.0f} %, one of Dask "
        f"{dask:.0f} %"
    )
    pairs = {
        name: f"{entry['ess_per_1000']:.0f}{{}} and {entry['ess_per_second']:.0f}{{}}"
        for name, entry in d["efficiency"]["damper"]["samplers"].items()
    }
    own, nuts = pairs["bp.sample"].format(" effective samples per 1000 densities", " a second"), pairs["NUTS"]
    others = {"dynesty": "dynesty", "zeus": "zeus", "PINTS, population": "PINTS' population MCMC"}
    yield f"`bp.sample` draws {own}; NUTS {nuts.format(' per 1000 gradients', '')}"
    yield ", ".join(f"{text} {pairs[name].format('', '')}" for name, text in others.items())
    yield f"emcee's default move {pairs['emcee'].format('', '')}"


@on("docs/studies/noisy_inputs.md")
def noisy_inputs():
    d = results("noisy_inputs")
    by_kind = d["cases"]["damper"]["3%"]
    exact, noisy = (100 * by_kind[kind]["coverage"]["rho"] for kind in ("exact", "measured"))
    yield (
        "Of 90 % intervals of a simulated damper's rho, with noise of 3 % of the displacement's rms, "
        f"{exact:.4g} % contain the truth if the displacement is taken as exact, and {noisy:.4g} % otherwise"
    )
    yield f"{d['replicates']} recordings a point"


@on("docs/explanation/frequency_error.md")
def frequency_error():
    d = results("clocks")
    light, less = (
        [100 * d["frequency"][f"Q = {q}, 20 cycles"][kind]["coverage"]["k"] for kind in ("ignored", "estimated")]
        for q in (200, 50)
    )
    yield f"{light[0]:.0f} % of the recordings if the error is ignored, and in {light[1]:.0f} % if it is not"
    yield f"and 20 cycles in {less[0]:.0f} % and {less[1]:.0f} %"
    low, high = d["band"]
    yield f"With {d['replicates']} recordings, a share from {100 * low:.0f} % to {100 * high:.0f} % is compatible"


@on("docs/studies/clocks.md")
def clocks():
    d = results("clocks")
    resonances = [one for case, one in d["frequency"].items() if case.startswith("Q")]
    kept, ignored = ([100 * one[kind]["coverage"]["k"] for one in resonances] for kind in ("estimated", "ignored"))
    yield f"Of 90 % intervals of the stiffness, {min(kept):.0f} to {max(kept):.0f} % contain the truth in all cases"
    yield f"and {min(ignored):.0f} to {max(ignored):.0f} % if it is ignored. Each case has {d['replicates']} recordings"
    limit = [
        100 * s
        for c, one in d["frequency"].items()
        if c.startswith("van")
        for s in one["estimated"]["coverage"].values()
    ]
    yield f"{min(limit):.0f} to {max(limit):.0f} % of the intervals of the van der Pol oscillator contain the truth"
    outside = [row["value"] * d["replicates"] for row in d["checks"] if "intervals" in row["what"] and not row["met"]]
    assert len(outside) == 1
    worst = f"(the stiffness at $Q$ = 200 and 20 cycles, {outside[0]:.0f} of {d['replicates']})"
    yield f"Of the 26 shares one is outside the band, by one recording {worst}"
    sampled = [100 * row["value"] for row in d["checks"] if "coverage of amplitudes" in row["what"]]
    yield f"their intervals in {min(sampled):.0f} to {max(sampled):.0f} % of the cases"
    yield f"two sampling rates in {100 * d['rates']['coverage of c']:.0f} %"
    for case, one in d["loggers"].items():
        yield f"| {case} | {' | '.join(str(one.get(what, 0)) for what in ('refused', 'warned', 'silent'))} |"
    first, *others = (sum(one.values()) for one in d["loggers"].values())
    assert {*others} == {d["replicates"]}
    yield f"Each row has {others[0]} recordings"
    yield f"at their nominal rates, the first {first}."


@on("docs/studies/recordings.md")
def faults_of_recordings():
    d = results("recordings")
    alarms = d["false_alarms"]
    met = {row["what"]: row["met"] for row in d["checks"]}
    assert met["good recordings with serious findings, or refused"] and alarms["refused"] == 0.0
    yield f"{d['recordings']} good recordings"
    yield f"{d['each']} of each size"
    serious, warned, kept = (100 * alarms[key] for key in ("serious", "warned", "kept_mean"))
    yield f"are in {serious:.1f} % of the good recordings, warnings in {warned:.1f} %, and none is refused"
    yield f"On average, {kept:.0f} % of the cycles"
    for fault, one in d["faults"].items():
        yield f"| {fault} | {one['found']:.2g} | {one['biased']:.2g} | {one['hidden']:.2f} |"


@on("docs/studies/resonance.md")
def resonance():
    d = results("resonance")
    assert d["replicates"] == 200 and all(row["met"] for row in d["checks"])
    kinds = {name: one for name, one in d.items() if isinstance(one, dict) and "posterior" in one}
    assert len(kinds) == 6 and all(one["converged"] == 1.0 for name, one in kinds.items() if name != "amplitudes")
    low, high = (100 * end for end in d["band"])
    shares = [100 * share for one in kinds.values() for share in one["posterior"].values()]
    yield f"All {len(shares)} shares are within the 99 % band of {low:.0f} to {high:.0f} %"
    yield f"from {min(shares):.1f} to {max(shares):.1f} %; they are those of the posterior"
    alone, closed = kinds["amplitudes"], d["averaged equation"]["k3"]
    yield f"from amplitudes alone, {100 * alone['Laplace approximation']['c']:.1f} % contain it"
    yield f"{round((1 - alone['converged']) * d['replicates'])} of the 200 estimates from amplitudes alone"
    left = {kind: d[kind]["sd over that of the prior"]["c"] for kind in ("amplitudes and phases", "amplitudes")}
    with_phases, without = (100 * share for share in left.values())
    yield f"of the damping to {with_phases:.0f} % of the prior's, amplitudes alone to {without:.0f} %"
    yield f"off by {closed['median of z']:.1f} standard deviations, and its 90 % intervals"
    yield f"cover {100 * closed['coverage']:.0f} %. Single"


# Rows of the table of coverage that are outside of the band, for reasons that the page gives.
EXPLAINED = {"ten levels", "missing cubic term", "3 cycles", "AR(0.9), measured", "frequency estimated"}


@on("docs/studies/coverage.md")
def coverage():
    d = results("coverage")
    table = study_of_coverage.page_rows(d["cases"], d["bands"])
    outside = {row.split(" | ")[0].removeprefix("| ") for row in table if "**" in row}
    assert outside <= EXPLAINED
    yield from table
    (low, high), drawn = ([100 * end for end in d["bands"][kind]] for kind in ("laplace", "draws"))
    yield f"{d['data_sets']['laplace']} data sets by Laplace and robust, {low:.0f} to {high:.0f} %"
    yield f"and {d['data_sets']['draws']} by draws, {drawn[0]:.0f} to {drawn[1]:.0f} %"


@on("docs/studies/coverage.md")
def repeated_tests():
    plain, robust = (results("coverage")["repeats"][kind] for kind in ("sd", "robust_sd"))
    yield f"{plain['far']} of {plain['of']} pairs of estimates by Laplace and in {robust['far']} by the robust ones"
    yield f"between {100 * robust['share'][0]:.0f} and {100 * robust['share'][1]:.0f} %"
    yield f"is {plain['rms']:.1f} by Laplace and {robust['rms']:.1f} by the robust ones"


@on("docs/how_to/wrong_model.md")
def repeated_tests_of_a_wrong_model():
    d = results("coverage")["repeats"]
    plain, robust = (d[kind] for kind in ("sd", "robust_sd"))
    left = [100 * value for value in d["unexplained"]]
    yield f"leaves {min(left):.0f} to {max(left):.0f} % of the variance of the force"
    yield f"than 1.96 standard deviations in {plain['far']} of {plain['of']} cases by Laplace and in {robust['far']} by"
    yield f"the root mean square of the differences is {plain['rms']:.1f} and {robust['rms']:.1f} of"
    ends = [100 * end for end in robust["share"]]
    yield f"{robust['far']} of {robust['of']} is compatible with {ends[0]:.0f} to {ends[1]:.0f} %"


@on("docs/studies/missing_terms.md")
def missing_terms():
    d = results("missing_terms")
    cases = d["cases"].values()
    found = [100 * one["shares"]["right term first"] for one in cases if one["missing"]]
    left_alone = [100 * one["shares"]["none"] for one in cases if not one["missing"]]
    yield f"In {d['replicates']} data sets a case the true term comes first in {span(found)} %"
    yield f"where nothing is missing no term is found in {span(left_alone)} %"


@on("docs/studies/landing_gear.md")
def landing_gear_missing():
    d = results("landing_gear/missing_terms")
    one, (*_, last) = d["B"], d["B"]["steps"]
    assert d["A"]["steps"] == [] and d["A"]["before"]["verdict"] == "adequate" and last["verdict"] == "misspecified"
    assert [step["term"].split("(")[0] for step in one["steps"]] == [
        "displacement*abs", "lag", "displacement in pressure",
    ]  # fmt: skip
    heat, convection, flexure, line = (
        one["effects"][name] for name in ("friction_heat", "convection", "flexure", "line")
    )
    yield f"explains {100 * heat['steps_shares'][0]:.1f} % of the friction heat's effect"
    force, pressure = (
        [100 * model["unexplained"][channel] for model in (one["before"], last)] for channel in ("force", "pressure")
    )
    yield f"of the pressure falls from {pressure[0]:.4f} % to {pressure[1]:.4f} %"
    yield f"that of the force only from {force[0]:.2f} % to {force[1]:.2f} %"
    best = [f"{100 * effect['best_share']:.0f} %" for effect in (heat, convection, flexure, line)]
    yield (
        f"of the first {len(one['ranking'])} candidates the best explains {best[0]} of the effect of friction heat, "
        f"{best[1]} of that of convection, {best[2]} of that of lost motion and {best[3]} of that of the pressure line"
    )
    counts = results("landing_gear/missing_terms_replicates")["truths"]
    count, heat_first = counts["B"]["count"], counts["B"]["which"]["friction_heat"]
    yield (
        f"In {count} data sets of each truth (`--missing --replicates {count}`) nothing is added to the right model "
        f"{counts['A']['nothing']} times, and the first term added to the other is the friction heat's {heat_first} "
        f"times."
    )


@on("docs/studies/diode.md")
def diode():
    d = results("diode")
    first, *_, last = d["steps"].values()
    low, high = ([f"{100 * f(own['unexplained'].values()):.2f}" for own in (first, last)] for f in (min, max))
    frequencies = [row["frequency_Hz"] / 1e3 for row in d["records"]]
    yield (
        f"{len(frequencies)} records by an 8-bit oscilloscope between {min(frequencies):.0f} and "
        f"{max(frequencies):.0f} kHz"
    )
    yield f"is {d['internal_resistance']:.2f} of the resistor"
    *some, longest = sorted({row["tested_period"] for row in d["records"] if row["used"]})
    yield f"of {', '.join(map(str, some))} and {longest} periods of the source"
    unseen = d["score"]["largest_unexplained"]["not_used"]
    yield (
        f"The first model leaves {low[0]} to {high[0]} % of the variance of the resistor's voltage, with three further "
        f"terms {low[1]} to {high[1]} %, no more than the cycles of a record differ by, and at most "
        f"{100 * unseen:.2f} % of periodic records that were not fitted."
    )
    first, second, third = d["missing_terms"]
    yield f"which is number {first['rank_of_chosen']} of the {first['candidates']} candidates of `bp.missing_terms`"
    yield (
        f"stray capacitance of the instrument, number {second['rank_of_chosen']} of {second['candidates']} in the "
        f"search for what the second model lacks"
    )
    yield f"number {third['rank_of_chosen']} of {third['candidates']} in the search for what the third model lacks"
    before, after = list(d["steps"].values())[-2:]
    yield f"{100 * after['map']['bypass']:.0f} % of the current"
    smaller = max(before["robust_sd"][n] / after["robust_sd"][n] for n in before["map"] if "[" not in n)
    yield f"up to {smaller:.1f} times smaller"
    *most, one = (
        f"{row['frequency_Hz'] / 1e3:.0f}" for row in d["records"]
        if row["measured_period"] is None and row["predicted"].get("4", 0.0) > 0.5
    )  # fmt: skip
    yield f"predicted at {', '.join(most)} and {one} kHz too"
    right = d["score"]["right"]
    yield (
        f"The most probable motion over the draws is the measured one in {right['periodic'][0]} of "
        f"{right['periodic'][1]} periodic records and in {right['others'][0]} of {right['others'][1]} others."
    )
    one, two, three = (
        f"{1e-3 * row['interval_Hz'][0]:.0f} to {1e-3 * row['interval_Hz'][1]:.0f}" for row in d["doublings"]
    )
    yield (
        f"Periods double at {one} kHz (90 %; the records bracket it by 110 and 120), {two} kHz (170 and 185) and "
        f"{three} kHz (230 and 240)."
    )
    orbits = d["unstable_orbits"]
    least, *_, most = sorted(abs(o["multiplier"]) for o in orbits)
    yield f"{len(orbits)} unstable orbits of 1 to 4 periods, with multipliers of {least:.1f} to {most:.0f}"
    nearest, usual = ([100 * o[key] for o in orbits] for key in ("nearest", "median"))
    yield (
        f"within {min(nearest):.2f} to {max(nearest):.2f} % of the variance, where half of its parts are more than "
        f"{min(usual):.1f} to {max(usual):.0f} % away"
    )
    yield f"In the {len({o['frequency_Hz'] for o in orbits})} records without a period"


@on("docs/studies/diode.md")
def diode_forecasts():
    d = results("diode")
    rows, scores = d["records"], d["log_scores"]
    yield f"the {sum(not row['used'] for row in rows)} records outside the fit"
    draws, longest = study_of_diode.DRAWS, prediction.LONGEST
    yield (
        f'From the numbers n of {draws} draws, the motions "period 1" to "period {longest}" and "chaos" have the '
        f"probabilities (n + 1/2)/{draws + len(held_out.CLASSES) * held_out.ADDED}"
    )
    texts = {
        "posterior": "Laplace's covariance, as if the model were true", "robust": "Robust covariance",
        "next record": "Robust covariance, model error of the next record",
        "neighbours": "Two neighbouring records on each side, no model",
        "all others": "Frequencies of the motions in all other records",
    }  # fmt: skip
    for name, words in texts.items():
        own = scores[name]
        less = "" if name == "posterior" else f"{own['difference']:.1f} ± {own['difference_sd']:.1f} "
        line = (
            f"| {words} | {own['sum']:.1f} | {own['expected']:.1f} ± {own['expected_sd']:.1f} | {less}| "
            f"{own['right']} of {len(rows)} |"
        )
        yield line.replace("-", "−")
    drives = d["effective_drives"].values()
    frequency, amplitude = (
        100 * np.sqrt(np.mean([own[key] ** 2 for own in drives])) for key in ("frequency", "amplitude")
    )
    yield f"differ from the measured ones by {frequency:.1f} and {amplitude:.1f} % (rms)"
    # Each step makes the score better, by less than two standard errors; what is expected.
    steps = [scores[name]["sum"] for name in ("posterior", "robust", "next record")]
    assert steps == sorted(steps)
    assert all(0.0 < own["difference"] < 2 * own["difference_sd"] for own in (scores["robust"], scores["next record"]))
    over = [(own["expected"] - own["sum"]) / own["expected_sd"] for own in map(scores.get, texts)]
    assert 0.5 < min(over[:2]) < max(over[:2]) < 1.5
    assert abs(over[2]) < 0.1
    better = np.log([row["held_out"]["next record"] / row["held_out"]["neighbours"] for row in rows])
    yield f"better by {better.sum():.1f} ± {np.sqrt(better.size) * better.std(ddof=1):.1f}"
    by_model = ("posterior", "robust", "next record")
    *most, one = (
        f"{row['frequency_Hz'] / 1e3:.0f}" for row in rows
        if row["measured_period"] is None and max(row["held_out"][name] for name in by_model) < 0.1
    )  # fmt: skip
    yield f"give less than 0.1 to the chaos of the records at {', '.join(most)} and {one} kHz"


def span(values):
    """Return "a to b", or one number if all are equal."""
    low, high = (f"{value:.0f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


@on("docs/studies/elements.md")
def rounded_slider():
    errors = {
        row["width"]: {of: 100 * error for of, error in row["error"].items()} for row in results("elements")["widths"]
    }
    wide, middle = errors[0.3], errors[0.1]
    assert min(wide["stiffness"], wide["limit"], -wide["c"]) > 0.0
    yield (
        f"With a width of 0.3 the stiffness of the slider is estimated {wide['stiffness']:.1f} % and the limit force "
        f"{wide['limit']:.1f} % too large, and the damping {-wide['c']:.1f} % too small."
    )
    yield (
        f"With 0.1 these errors are {middle['stiffness']:.1f}, {middle['limit']:.1f} and {-middle['c']:.1f} %, "
        f"with 0.02 at most {max(map(abs, errors[0.02].values())):.2f} %."
    )


@on("docs/reference/still_wrong.md")
def still_wrong():
    checks = results("benchmark")["checks"]
    missed = [check["what"] for check in checks if not check["met"]]
    assert sum("import" in what for what in missed) == 1
    yield f"{len(missed)} of {len(checks)} are missed: {WORDS[len(missed) - 1]} ratios"
    yield f"with a joint and a stop, takes {results('structure')['processor_seconds']:.0f} s"


@on("docs/studies/structure.md")
def beam_with_joint_and_stop():
    given = results("structure")
    rows = {
        "alpha": ("damping α [1/s]", 1.0, 4), "joint_stiffness": ("stiffness of the joint [N/m]", 1.0, 0),
        "joint_limit": ("limit of the joint [N]", 1.0, 4), "stop_k": ("stiffness of the stop [N/m]", 1.0, 1),
        "stop_clearance": ("clearance of the stop [mm]", 1e3, 4),
    }  # fmt: skip
    for name, (label, unit, digits) in rows.items():
        low, _, high = (unit * value for value in given["intervals"][name])
        yield f"| {label} | {unit * given['truth'][name]:g} | {low:.{digits}f} to {high:.{digits}f} |"
    yield (
        f"Estimate and posterior take {given['processor_seconds']:.0f} s of processor time, and the study "
        f"{given['memory_GB']:.1f} GB of memory."
    )
    chains = results("structure/scaling")["chains"]
    yield f"| degrees of freedom | {' | '.join(chains)} |"
    for label, name in (
        ("two first solves, with multipliers [s]", "two first solves, with multipliers [s]"),
        ("estimate [s]", "estimate [s]"),
        ("log-likelihood of a parameter vector [ms]", "a log-likelihood [ms]"),
    ):
        yield f"| {label} | " + " | ".join(f"{chain[name]:.1f}" for chain in chains.values()) + " |"


@on("docs/studies/harvester.md")
def measured_chaos():
    given = results("harvester")
    orbits, delays = given["orbits"], given["delays"]
    used = [one for one in orbits if one["used"]]
    first, last = orbits[0]["period"], orbits[-1]["period"]
    yield f"{len(orbits)} orbits of periods {first} to {last} are found, and {len(used)} are"
    for name in ("velocity", "voltage"):
        yield f"{name} {1e3 * delays['seconds'][name]:.2f} ± {1e3 * delays['sd'][name]:.2f} ms"
    for one in given["models"]:
        left = [f"{100 * one['unexplained'][name]:.2f} %" for name in ("velocity", "voltage")]
        alone = np.mean([np.mean([*shares.values()]) for shares in one["alone"].values()])
        ran = f"{100 * alone:.2f} % | {one['left']} of {one['runs']}"
        yield f"| {one['degree']} | {one['orbits']} of {len(used)} | {left[0]} | {left[1]} | {ran} |"
    for degree, terms in given["missing"].items():
        if not terms:
            yield f"model of degree {degree} it names no term"
        for term, _, place in (text.partition(" in ") for text in terms):
            yield f"model of degree {degree} it names `{term}` in the {place}"
    for orbit in used:
        if orbit["name"] in given["multipliers"] and orbit["sections"] > 2:
            model = float(given["multipliers"][orbit["name"]])
            measured = f"{orbit['eigenvalue'][0]:.1f}" + (f" ± {sd:.1f}" if (sd := orbit["eigenvalue_sd"]) else "")
            yield f"| {orbit['period']} | {orbit['returns']} | {measured} | {model:.1f} |"
    tests, exponents = given["left_out"]["tests"], given["left_out"]["exponents"]
    density, exponent = tests["density"], tests["Lyapunov exponent"]
    chance = f"{density['low']:.3f} to {density['high']:.3f}"
    yield f"The distance of the densities is {density['model']:.3f}, by chance {chance}"
    yield f"a joint p of {tests['all']['p']:.3f} where {0.01} is the limit"
    yield f"{given['left_out']['left']} of {given['left_out']['runs']} runs leave the region"
    yield f"exponent is {exponent['model']:.2f} 1/s, by chance {exponent['low']:.2f} to {exponent['high']:.2f}"
    yield f"that of two neighbouring runs {exponents['model']['exponent']:.2f} ± {exponents['model']['sd']:.2f} 1/s"
    for name, digits in (("f1", 0), ("drive_gain", 2), ("decay", 2)):
        value, robust, laplace = given["estimates"][name]
        yield f"| `{name}` | {value:.{digits}f} | {robust:.2g} | {laplace:.2g} |"


@on("docs/studies/harvester.md")
def known_orbits():
    given = results("harvester/orbits")
    new, old = given["integrated"], given["delayed"]
    for k, (one, other) in enumerate(zip(new["recordings"], old["recordings"], strict=True)):
        yield f"| {k + 1} | {len(one['orbits'])} | {one['found']} ({other['found']}) |"
    yield f"| all | {new['of']} | {new['found']} ({old['found']}) |"
    missed = [row for one in new["recordings"] for row in one["orbits"] if not row["found"]]
    (period,) = {row["period"] for row in missed}
    multipliers = " and ".join(f"{row['multiplier']:.1f}" for row in missed)
    returns = " and ".join(f"{row['returns']}" for row in missed)
    yield f"have period {period}, multipliers of {multipliers}, and {returns} close returns"
    covered, delayed = new["covered"], old["covered"]
    inside = f"contain {covered['count']} of {covered['of']} true values of the voltage at the points"
    low, high = covered["band"]
    yield f"{inside} (99 % band {low} to {high}"
    yield f"with delays {delayed['count']} of {delayed['of']} ({delayed['band'][0]} to {delayed['band'][1]})"


@on("docs/studies/harvester.md")
def known_parameters():
    given = results("harvester/parameters")
    yield f"{given['estimated']} of {len(given['recordings'])} recordings"
    for one in given["counts"]:
        kind = {"each": "intervals", "joint": "regions"}[one["kind"]]
        low, high = one["band"]
        yield f"| {kind} of {100 * one['level']:.0f} % | {one['count']} of {one['of']} | {low} to {high} |"


@on("docs/studies/harvester.md")
def multiple_shooting():
    orbits = results("harvester")
    rows = {f"{one['periods']:g} periods": one for one in results("harvester/shooting")["lengths"]}
    for name, one in (rows | {"orbits": orbits["left_out"] | {"unexplained": orbits["unexplained"]}}).items():
        left = " | ".join(f"{100 * one['unexplained'][channel]:.2f} %" for channel in ("velocity", "voltage"))
        density, exponent = one["tests"]["density"]["model"], one["exponents"]["model"]["exponent"]
        ran = f"{one['left']} of {one['runs']} | {one['settled']}"
        yield f"| {name} | {left} | {ran} | {density:.3f} | {exponent:.2f} |"


@on("docs/reference/files.md")
def formats():
    """Yield the number of damaged files, and each row of the table, whose tests must exist."""
    sources = [path.read_text("utf-8") for path in sorted((ROOT / "tests/data").rglob("test_*.py"))]
    known = {name for source in sources for name in re.findall(r"^def (test_\w+)", source, re.MULTILINE)}
    yield "with one error: 200 and more of each"
    rows = [line for line in (ROOT / "docs/reference/files.md").read_text("utf-8").splitlines() if line[:2] == "| "]
    for row in rows[1:]:
        tests = re.findall(r"`(test_\w+)`", row)
        assert tests and known.issuperset(tests), row
        yield row


@pytest.mark.parametrize(("page", "subject"), SUBJECTS, ids=[subject.__name__ for _, subject in SUBJECTS])
def test_numbers_of_a_page_are_those_of_the_results(page, subject):
    printed = text(page)
    missing = [phrase for phrase in map(without_code, subject()) if phrase not in printed]
    assert not missing, f"{page} should say:\n" + "\n".join(missing)


def without_code(phrase):
    """Return a phrase as it is compared with the text of a document."""
    for pattern in NO_TEXT[1:]:
        phrase = re.sub(pattern, " ", phrase)
    return " ".join(phrase.split())


def test_pages_with_subjects_or_reasons_exist():
    assert {page for page, _ in SUBJECTS} | WITHOUT_RESULTS.keys() <= set(DOCUMENTS)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_other_number_has_a_reason(document):
    left = text(document)
    phrases = [without_code(phrase) for page, subject in SUBJECTS if page == document for phrase in subject()]
    for phrase in (p for reasoned in WITHOUT_RESULTS.get(document, {}).values() for p in map(without_code, reasoned)):
        assert phrase in left, f"no longer in {document}: {phrase}"
        phrases.append(phrase)
    for phrase in sorted(phrases, key=len, reverse=True):
        left = left.replace(phrase, " … ")
    untied = [left[max(found.start() - 60, 0) : found.end() + 30] for found in NUMBER.finditer(left)]
    assert not untied, "\n".join(untied)
