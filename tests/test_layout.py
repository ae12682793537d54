"""Limits of the sizes that ``python -m tests.layout`` prints."""

import re
from pathlib import Path
from statistics import median

from tests import layout

LONGEST_FILE = 600
MOST_PARAMETERS = 8
REASONS = {
    "Experiment": "one field per measured quantity; four are required, the rest are keywords with defaults",
    "Recording.fold": "the grid, the frequency, the response period, the clocks; all have defaults",
    "sample": "settings of the sampler; two arguments and the seed are required, the rest are keywords with defaults",
    "resonance_point": "what was measured, with standard deviations; four are required, the rest have defaults",
    "Finding": "one field per fact about a fault; made by `Recording.check`",
    "Model": "the definition of a model: name, variables, equations, outputs, units; five are required",
    "Model.from_matrices": "the definition of a structure; mass, stiffness, outputs and the name are required",
    "Model.from_modes": "the same for modes; frequencies, damping ratios, shapes, outputs and the name are required",
    "Problem": "model, experiments, parameters and noise; two and the priors are required, the rest are keywords",
    "Recording.from_file": "the meaning of the channels, and what a text does not show; two arguments are required",
    "population": "what the population is, and settings with defaults; units, names and the seed are required",
    "response_table": "what the columns of a table mean; three arguments are required",
    "FileChannel": "a row of a table; only `inspect` makes it",
    "calibrate": "the settings of a campaign and of the estimates in it; three are required",
    "plot.corner": "options of a figure, those of the package corner among them; one argument is required",
    "plot.branch": "options of a figure; one argument is required",
    "missing_terms": "settings of the search; two arguments are required, the rest are keywords with defaults",
    "report": "results that are computed where they are not given; four arguments are required, the rest are keywords",
    "simulate": "a problem (model, parameters, inputs, frequency), a time grid, and the noise",
    "solve_periodic": "a problem (model, parameters, inputs, frequency), a grid, and a guess",
}


def test_files_stay_readable():
    too_long = {name: count for name, count in layout.lines("bayesperiodic").items() if count > LONGEST_FILE}
    assert not too_long


def test_the_median_file_has_one_idea():
    assert 120 <= median(layout.lines("bayesperiodic").values()) <= 320


def test_functions_fit_on_a_screen():
    too_long = {name: length for name, length in layout.longest_functions().items() if length > 60}
    assert not too_long


def test_public_functions_have_few_parameters_or_a_reason():
    many = {name for name, count in layout.public_parameters().items() if count > MOST_PARAMETERS}
    assert many == REASONS.keys()


def test_every_campaign_has_passed_and_its_result_is_kept():
    kept = Path("figures/campaigns.txt").read_text(encoding="utf-8")
    marked = r"@pytest\.mark\.campaign\n(?:@.*\n)*def (\w+)"
    names = [f"{p}::{name}" for p in Path("tests").rglob("*.py") for name in re.findall(marked, p.read_text("utf-8"))]
    assert names and all(name in kept for name in names)
    assert re.search(r"^\d+ passed.* in ", kept, re.MULTILINE)
