"""Fingerprints of problems, by which results are recognised as those of a problem."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from bayesperiodic.likelihood.input_noise import EXACT, same
from bayesperiodic.periodic.schemes import find_scheme
from bayesperiodic.problem.description import Description

# What makes or computes each kind of result again.
RESULTS = {"MapEstimate": "map_estimate(problem)", "Posterior": "sample(problem, fit)"}
# Fields of experiments that no density depends on, and those that are left out where they are empty.
LABELS, LATER_FIELDS = ("synthetic", "left_out", "units"), ("middle", "phase_diffusion", "condition")


def fingerprint(problem: Description) -> str:
    """Return digests of all that the density depends on, part by part: "model:… experiments:… priors:… …"."""
    parts = {
        "model": problem.model.definition,
        "experiments": [_content(e) for e in problem.experiments],
        "priors": repr(problem.priors),
        "constants": [problem.fixed, problem.tied, problem.likelihood.fixed],
        "noise": repr(problem.noise),
        "scheme": repr(find_scheme(problem.scheme)),
    }
    if problem.input_noise != EXACT:
        parts["input_noise"] = [problem.input_noise]
    if problem.sensors.given:
        parts["sensors"] = repr(problem.sensors.given)
    return " ".join(f"{part}:{digest(value)}" for part, value in parts.items())


def _content(experiment: Any) -> list[Any]:
    """Return the values of an experiment that a density depends on."""
    values = {f.name: getattr(experiment, f.name) for f in fields(experiment) if f.name not in LABELS}
    return [value for name, value in values.items() if name not in LATER_FIELDS or value]


def digest(value: Any) -> str:
    """Return a digest of nested mappings, sequences, arrays and single values."""
    return hashlib.sha256(b"".join(_bytes(value))).hexdigest()[:12]


def _bytes(value: Any) -> Iterator[bytes]:
    """Yield the content of nested mappings, sequences, arrays and single values."""
    if isinstance(value, np.ndarray):
        yield f"array {value.dtype} {value.shape} ".encode() + np.ascontiguousarray(value).tobytes()
    elif isinstance(value, Mapping | list | tuple):
        yield f"{len(value)} items ".encode()
        for item in value.items() if isinstance(value, Mapping) else value:
            yield from _bytes(item)
    else:
        number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        yield repr(float(value) if number else value).encode("utf-8", "backslashreplace") + b";"


def changed_parts(made_for: str, here: str) -> list[str]:
    """Return the parts in which two fingerprints differ."""
    there = dict(part.partition(":")[::2] for part in made_for.split())
    return [name for name, _, digest in (part.partition(":") for part in here.split()) if there.get(name) != digest]


def check_results(problem: Any, **results: Any) -> Any:
    """Return the problem as an estimate `fit` and draws `posterior` have it, with the errors of its inputs.

    A ValueError is raised unless they were computed from the problem: model's equations, experiments with their data,
    priors, constants, noise model and scheme must be the same.
    """
    if not isinstance(problem, Description):
        raise ValueError(f"problem: must be a Problem, got {type(problem).__name__}.")
    here = ""
    for argument, result in results.items():
        here = here or fingerprint(problem)
        check_fingerprint(argument, result, here)
    first, *others = [result.input_errors for result in results.values()]
    if any(not same(first, other) for other in others):
        raise ValueError(
            "posterior: must be draws from the density of `fit`, got draws with other errors of the inputs, which "
            f"another estimate determined; give {RESULTS['Posterior']}."
        )
    given: Any = problem
    return given.with_input_errors(first)


def check_fingerprint(argument: str, result: Any, here: str) -> None:
    """Raise a ValueError unless an estimate, or draws if the argument is `posterior`, are of the problem `here`."""
    kind = "Posterior" if argument == "posterior" else "MapEstimate"
    if type(result).__name__ != kind:
        raise ValueError(f"{argument}: must be a {kind}, got {type(result).__name__}; give {RESULTS[kind]}.")
    if changed := changed_parts(result.fingerprint, here):
        raise ValueError(
            f"{argument}: must be a result of this problem, got one of a problem with other {', '.join(changed)}; give "
            f"{RESULTS[kind]}."
        )
