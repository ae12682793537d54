"""Problems as problem files, see `problem_file`."""

import hashlib
import json
import os
import re
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _checks, models
from bayesperiodic._files import in_folder
from bayesperiodic.likelihood.noise import NAMED, Noise
from bayesperiodic.models.model import CondensedModel, Model
from bayesperiodic.models.names import as_expression, as_text
from bayesperiodic.periodic.schemes import SCHEMES, Scheme
from bayesperiodic.priors.stored import STORABLE
from bayesperiodic.problem.description import Description
from bayesperiodic.problem.fingerprint import changed_parts, fingerprint
from bayesperiodic.problem.problem_file import DIGEST_KEY, KIND, LIBRARY, OF_SCIPY, SAVED, ProblemFile
from bayesperiodic.problem.sensors import Sensor

BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
WRAPPED_FROM, LONGEST_SHOWN = 110, 200
FIRST_LINE = "# A problem of bayesperiodic, with the arguments of bayesperiodic.Problem."
# Seed of the draws of a file that nobody has edited.
SEED = 1


def write(problem: Description, path: str | Path) -> None:
    """Write a problem file, and its experiments beside it; see `Problem.to_toml`."""
    target = in_folder(path)
    settings = problem.settings
    for argument in ("anchors", "input_errors"):
        if settings[argument]:
            raise ValueError(
                f"problem: must be without {argument} in a problem file, got those of {', '.join(settings[argument])}; "
                "write problem.replace(), from which map_estimate computes them again."
            )
    content = _content(settings)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        content["experiments"] = []
        for number, experiment in enumerate(problem.experiments, 1):
            file = Path(folder, f"{target.stem}.experiment{number}.h5")
            experiment.save(file)
            digest = hashlib.sha256(file.read_bytes()).hexdigest()
            content["experiments"].append({SAVED: file.name, DIGEST_KEY: digest})
        draft = Path(folder, target.name)
        draft.write_text(_toml(content), encoding="utf-8", newline="\n")
        _check(problem, draft)
        for file in sorted(Path(folder).iterdir(), key=lambda file: file == draft):
            os.replace(file, target.parent / file.name)


def _check(problem: Description, draft: Path) -> None:
    """Raise a ValueError unless a problem file gives the same problem."""
    try:
        again = ProblemFile(draft).build(type(problem))
    except ValueError as error:
        reason = re.sub(rf"^{re.escape(str(draft))}(:\d+)?: ", "", str(error))
        raise ValueError(f"problem: must be a problem that texts describe, got one that is refused: {reason}") from None
    if changed := changed_parts(fingerprint(problem), fingerprint(again)):
        raise ValueError(f"problem: must be a problem that texts describe, got another {', '.join(changed)}.")


def _content(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a problem as tables of plain values, without experiments."""
    content: dict[str, Any] = {"local": settings["local"], "input_noise": settings["input_noise"]}
    if (scheme := settings["scheme"]) is not None:
        content["scheme"] = scheme if isinstance(scheme, str) else _scheme(scheme)
    content["noise"] = settings["noise"] if isinstance(settings["noise"], str) else _noise(settings["noise"])
    content["model"] = _model(settings["model"])
    content["experiments"] = []
    single = {key: prior for key, prior in settings["priors"].items() if isinstance(key, str)}
    content["priors"] = {key: _prior(f"priors[{key!r}]", prior) for key, prior in single.items()}
    content["joint_priors"] = [
        {"names": key, **_prior(f"priors[{key!r}]", prior)}
        for key, prior in settings["priors"].items()
        if key not in single
    ]
    sensors = {channel: _sensor(channel, one) for channel, one in (settings["sensors"] or {}).items()}
    content |= {"fixed": settings["fixed"], "tied": settings["tied"], "sensors": sensors}
    content["sample"] = {"seed": SEED}
    return {key: value for key, value in content.items() if value or key in ("input_noise", "experiments")}


def _model(model: Model) -> dict[str, Any]:
    if library := _of_library(model):
        return library
    if isinstance(model, CondensedModel):
        raise ValueError(
            f"model: must have equations in a problem file, got {model.name!r}, which is condensed; make it with "
            "Model.from_matrices(…, condensed=False), of few degrees of freedom."
        )
    texts = [_expression(model, "equations", one) for one in model.equations]
    outputs = [_expression(model, "outputs", one) for one in model.output_expressions]
    units = dict(model.units)
    parameters: Any = model.parameters
    if all(name in units for name in parameters):
        parameters = {name: units.pop(name) for name in parameters}
    table = {
        "name": model.name, "states": model.states, "inputs": model.inputs, "parameters": parameters,
        "equations": texts,
        "outputs": dict(zip(model.outputs, outputs, strict=True)),
        "angles": model.angles, "units": units, "description": vars(model).get("__doc__", ""),
    }  # fmt: skip
    return {key: value for key, value in table.items() if value or key == "parameters"}


def _expression(model: Model, argument: str, expression: Any) -> str:
    """Return the text of an expression, if it gives the expression exactly."""
    if expression in model.texts:
        return model.texts[expression]
    spaces = (model.state_symbols, model.input_symbols, model.parameter_symbols, model.time_symbols)
    text = as_text(expression, spaces)
    try:
        reason = "" if as_expression(argument, text, spaces) == expression else "whose numbers differ from those of it"
    except ValueError as error:
        reason = f"which is refused: {error}"
    if reason:
        raise ValueError(
            f"{argument}: must be texts, or expressions that their texts give exactly, in a problem file, got one of "
            f"the text {text[:LONGEST_SHOWN]!r}, {reason.removesuffix('.')}; make the model of texts, "
            "Model(equations=[…], outputs={…})."
        )
    return text


def _of_library(model: Model) -> dict[str, Any]:
    """Return the name of a model of the library, and the arguments of its function; empty for others."""
    masses = len(model.states)
    of_functions: dict[str, tuple[str, dict[str, Any]]] = {f"chain_{masses}": ("chain", {"masses": masses})}
    of_functions |= {f"landing_gear_{drive}": ("landing_gear", {"drive": drive}) for drive in model.inputs}
    name, arguments = of_functions.get(model.name, (model.name, {}))
    entry = getattr(models, name) if name in dir(models) else None
    known = entry(**arguments) if callable(entry) and arguments else entry
    same = isinstance(known, Model) and (known.definition, known.units) == (model.definition, model.units)
    return {LIBRARY: name} | arguments if same else {}


def _prior(argument: str, prior: Any) -> dict[str, Any]:
    if STORABLE.get(type(prior).__name__) is type(prior):
        return {KIND: type(prior).__name__, **{one.name: getattr(prior, one.name) for one in fields(prior)}}
    from scipy import stats

    frozen: Any = getattr(prior, "distribution", prior)
    distribution: Any = getattr(frozen, "dist", None)
    known = getattr(stats, str(getattr(distribution, "name", "")), None)
    if isinstance(known, stats.rv_continuous) and type(known) is type(distribution):
        arguments = {"args": list(frozen.args)} if frozen.args else {}
        return {KIND: f"{OF_SCIPY}{distribution.name}", **arguments, **frozen.kwds}
    raise ValueError(
        f"{argument}: must be a prior of bayesperiodic or a named distribution of scipy.stats in a problem file, got "
        f"{_checks.shortened(prior)}."
    )


def _noise(noise: Noise) -> dict[str, Any]:
    if NAMED.get(noise.name) is not type(noise):
        raise ValueError(
            f"noise: must be one of {', '.join(map(repr, NAMED))} in a problem file, got a {type(noise).__name__}, "
            "which is a class of yours."
        )
    table = {one.name: getattr(noise, one.name) for one in fields(noise)}
    if not isinstance(noise.prior, str):
        table["prior"] = _prior("noise: prior", noise.prior)
    return {KIND: noise.name, **table}


def _scheme(scheme: Scheme) -> str:
    if SCHEMES.get(scheme.name) != scheme:
        raise ValueError(f"scheme: must be one of {', '.join(map(repr, SCHEMES))} in a problem file, got {scheme!r}.")
    return scheme.name


def _sensor(channel: str, sensor: Sensor) -> dict[str, Any]:
    entries = {"order": sensor.order, **dict(sensor.acting())}
    return {
        kind: value if isinstance(value, int | float) else _prior(f"sensors[{channel!r}]: {kind}", value)
        for kind, value in entries.items()
    }


def _toml(content: Mapping[str, Any]) -> str:
    """Return nested values as TOML, the plain ones first; numbers have all digits."""
    lines, tables = [FIRST_LINE], []
    for key, value in content.items():
        if isinstance(value, Mapping):
            tables += ["", f"[{key}]", *_entries(value)]
        elif isinstance(value, list) and all(isinstance(one, Mapping) for one in value):
            tables += [line for one in value for line in ("", f"[[{key}]]", *_entries(one))]
        else:
            lines += _entries({key: value})
    return "\n".join([*lines, *tables, ""])


def _entries(table: Mapping[str, Any]) -> Iterable[str]:
    for key, value in table.items():
        line = f"{_key(key)} = {_value(key, value)}"
        if len(line) > WRAPPED_FROM and isinstance(value, list | tuple):
            items = "".join(f"    {_value(key, item)},\n" for item in value)
            line = f"{_key(key)} = [\n{items}]"
        yield line


def _key(key: str) -> str:
    return key if BARE_KEY.fullmatch(key) else _quoted(key)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(argument: str, value: Any) -> str:
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value(argument, item) for item in value)}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_key(key)} = {_value(key, item)}' for key, item in value.items())}}}"
    raise ValueError(
        f"{argument}: must be texts, numbers and arrays of numbers in a problem file, got {_checks.shortened(value)}."
    )
