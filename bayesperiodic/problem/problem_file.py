"""Problem files: the arguments of `Problem` in TOML, from which the same objects are built as in Python.

Texts become expressions by `_expressions`, and names are looked up in the library, the priors and the noise models, so
that no text of a file is executed.
"""

import hashlib
import inspect
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from bayesperiodic import _checks, models
from bayesperiodic._io import load
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.recording import Recording
from bayesperiodic.data.response_table import response_table
from bayesperiodic.likelihood.noise import NAMED
from bayesperiodic.models.model import Model
from bayesperiodic.priors.stored import STORABLE
from bayesperiodic.problem.sensors import Sensor

# Arguments of `Problem` that are passed on as they are, with their types, the others, and the tables of options.
PLAIN_ARGUMENTS = {"fixed": (dict,), "tied": (dict,), "local": (tuple,), "scheme": (str,), "input_noise": (str, dict)}
BUILT_ARGUMENTS = ("model", "experiments", "priors", "joint_priors", "noise", "sensors")
OPTION_TABLES = ("map_estimate", "sample")
KIND, LIBRARY, DIGEST_KEY, OF_SCIPY = "kind", "library", "sha256", "scipy.stats."
# Keys of the data file of an experiment; they say how it is read.
SAVED, RECORDING, TABLE = "saved", "recording", "table"
TYPES: dict[type, str] = {dict: "a table", tuple: "a list", str: "a text"}
# What the objects raise for values that do not fit them.
REFUSALS = (ValueError, TypeError, AttributeError, OSError, ImportError)
ARGUMENT = re.compile(r"(\w+)((?:\[(?:'.*?'|\".*?\"|\d+)\])*)")
Place = tuple[str | int, ...]


class ProblemFile:
    """The content of a problem file, and what is built from its tables; errors name the line.

    Attributes
    ----------
    path : Path
    content : dict
        As `tomllib` reads it, with tuples for lists.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        try:
            self.text = self.path.read_text(encoding="utf-8-sig")
            self.content: dict[str, Any] = _with_tuples(tomllib.loads(self.text))
        except tomllib.TOMLDecodeError as error:
            line = re.search(r"at line (\d+)", str(error))
            last = self.text.count("\n") + 1
            raise ValueError(f"{self.path}:{line[1] if line else last}: {error}.") from None
        except (UnicodeDecodeError, RecursionError) as error:
            raise ValueError(f"{self.path}: must be TOML in UTF-8, got another file ({error}).") from None
        self._experiment_names: dict[str, int] = {}

    def build(self, kind: Callable[..., Any]) -> Any:
        """Return the problem, of a class that takes the arguments of `Problem`."""
        self._check_keys(self.content, (*BUILT_ARGUMENTS, *PLAIN_ARGUMENTS, *OPTION_TABLES), ())
        for key in ("model", "experiments"):
            if key not in self.content:
                raise self._error(f"{key}: must be given, got none.", ())
        given = {key: self._plain(key, types) for key, types in PLAIN_ARGUMENTS.items() if key in self.content}
        given |= {"model": self._model(), "experiments": self._experiments(), "priors": self._priors()}
        if "noise" in self.content:
            given["noise"] = self._noise()
        if "sensors" in self.content:
            given["sensors"] = {channel: self._sensor("sensors", channel) for channel in self._table("sensors")}
        with self.located():
            return kind(**given)

    def options(self, function: Callable[..., Any], place: str, without: Iterable[str]) -> dict[str, Any]:
        """Return the arguments of a function in its table; raise a ValueError for others than it takes."""
        given = self._table(place) if place in self.content else {}
        self._check_arguments(function, given, (place,), without=without)
        return given

    def recordings(self) -> Iterator[tuple[Recording, dict[str, Any]]]:
        """Yield the recordings of the file, and the arguments with which each is folded."""
        for i, _ in enumerate(self._entries("experiments")):
            if RECORDING in self._table("experiments", i):
                yield from self._recordings("experiments", i)

    @contextmanager
    def located(self, *place: str | int) -> Iterator[None]:
        """Raise errors as ValueErrors with the line of the argument that they name, in a table or the whole file."""
        try:
            yield
        except REFUSALS as error:
            message = str(error)
            if not isinstance(error, ValueError | OSError | ImportError):
                table = _written(place) or "problem file"
                message = f"{table}: must have values of the types in Python, got others: {error}."
            raise self._error(message, (*place, *self._named(str(error), place))) from error

    def _error(self, message: str, place: Place) -> ValueError:
        line = self._line(place)
        return ValueError(f"{self.path}{f':{line}' if line else ''}: {message}")

    def _named(self, message: str, place: Place) -> Place:
        """Return the entry of a table that a message begins with, or the experiment that it contains."""
        if message.startswith("priors[("):
            return ("joint_priors",)
        start, got = ARGUMENT.match(message), re.search(r", got '([^']+)'", message)
        if start and _at(self.content, (*place, start[1])) is not None:
            keys = re.findall(r"\[(?:'(.*?)'|\"(.*?)\"|\d+)\]", start[2])
            within = (start[1], *(one or other for one, other in keys if one or other))
            refused = got is not None and _at(self.content, (*place, *within, got[1])) is not None
            return (*within, got[1]) if got and refused else within
        numbers = [i for name, i in self._experiment_names.items() if not place and repr(name) in message]
        if numbers:
            return ("experiments", numbers[0])
        return _place_of(got[1], _at(self.content, place)) if got and place else ()

    def _line(self, place: Place) -> int:
        """Return the line at which the statement begins that defines a place, or what contains it; 0 without any.

        It is the first one after which the lines above, as far as they are a file, do not contain the place.
        """
        while place and _at(self.content, place) is None:
            place = place[:-1]
        lines, complete = self.text.split("\n"), 0
        for count in range(1, len(lines) + 1) if place else ():
            with suppress(tomllib.TOMLDecodeError):
                if _at(tomllib.loads("\n".join(lines[:count])), place) is not None:
                    return complete + 1
                complete = count
        return 0

    def _check_keys(self, given: Mapping[str, Any], allowed: Iterable[str], place: Place) -> None:
        names = list(allowed)
        for key in given:
            try:
                _checks.one_of(_written(place) or "problem file", key, names)
            except ValueError as error:
                raise self._error(str(error), (*place, key)) from None

    def _table(self, *place: str | int) -> dict[str, Any]:
        if not isinstance(value := _at(self.content, place), dict):
            raise self._error(f"{_written(place)}: must be a table, got {_checks.shortened(value)}.", place)
        return dict(value)

    def _plain(self, key: str, types: tuple[type, ...]) -> Any:
        value = self.content[key]
        if not isinstance(value, types) or value == "":
            wanted = " or ".join(TYPES[one] for one in types)
            raise self._error(f"{key}: must be {wanted}, got {_checks.shortened(value)}.", (key,))
        return value

    def _entries(self, key: str) -> tuple[Any, ...]:
        entries = self.content.get(key, ())
        if not isinstance(entries, tuple):
            shown = _checks.shortened(entries)
            raise self._error(f"{key}: must be tables that begin with [[{key}]], got {shown}.", (key,))
        return entries

    def _call(self, function: Callable[..., Any], given: dict[str, Any], place: Place, also: Iterable[str] = ()) -> Any:
        """Return what a function returns for the entries of a table, which may contain others `also`."""
        self._check_arguments(function, given, place, also=also)
        with self.located(*place):
            return function(**given)

    def _check_arguments(
        self,
        function: Callable[..., Any],
        given: Mapping[str, Any],
        place: Place,
        *,
        also: Iterable[str] = (),
        without: Iterable[str] = (),
    ) -> None:
        """Raise a ValueError unless a table has arguments of a function, all that are required; some are not its."""
        parameters = {n: one for n, one in inspect.signature(function).parameters.items() if n not in without}
        self._check_keys(given, (*also, *parameters), place)
        for name, parameter in parameters.items():
            if parameter.default is parameter.empty and name not in given:
                listed = f", got only {', '.join(map(repr, given))}" if given else ""
                raise self._error(f"{_written(place)}: must have {name!r}{listed}.", place)

    def _chosen(self, key: str, allowed: Iterable[str], place: Place) -> str:
        """Return a name in a table that chooses a class or a model."""
        value = self._table(*place).get(key)
        try:
            _checks.one_of(f"{_written(place)}: {key}", value, allowed)
        except ValueError as error:
            raise self._error(str(error), (*place, key)) from None
        return str(value)

    def _model(self) -> Any:
        given = self._table("model")
        if LIBRARY not in given:
            return self._call(Model, given, ("model",), also=(LIBRARY,))
        names = [name for name in dir(models) if not inspect.ismodule(getattr(models, name))]
        entry = getattr(models, self._chosen(LIBRARY, names, ("model",)))
        del given[LIBRARY]
        if not isinstance(entry, Model):
            return self._call(entry, given, ("model",), also=(LIBRARY,))
        self._check_keys(given, (LIBRARY,), ("model",))
        return entry

    def _priors(self) -> dict[Any, Any]:
        priors: dict[Any, Any] = {}
        if "priors" in self.content:
            priors |= {name: self._prior("priors", name) for name in self._table("priors")}
        for i, _ in enumerate(self._entries("joint_priors")):
            names = self._table("joint_priors", i).get("names")
            if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names):
                raise self._error(
                    f"joint_priors[{i}]: must have names, a list of texts, got {_checks.shortened(names)}.",
                    ("joint_priors", i, "names"),
                )
            priors[names] = self._prior("joint_priors", i, without="names")
        return priors

    def _prior(self, *place: str | int, without: str = "") -> Any:
        given = self._table(*place)
        given.pop(without, None)
        if str(given.get(KIND)).startswith(OF_SCIPY):
            return self._of_scipy(given, place)
        kind = STORABLE[self._chosen(KIND, STORABLE, place)]
        del given[KIND]
        return self._call(kind, given, place, also=(KIND,))

    def _of_scipy(self, given: dict[str, Any], place: Place) -> Any:
        from scipy import stats  # slow

        name = given.pop(KIND).removeprefix(OF_SCIPY)
        distribution = getattr(stats, name, None) if name.isidentifier() else None
        if not isinstance(distribution, stats.rv_continuous):
            message = f"{KIND}: must be a continuous distribution of scipy.stats, got {name!r}."
            raise self._error(message, (*place, KIND))
        with self.located(*place):
            return distribution(*given.pop("args", ()), **given)

    def _noise(self) -> Any:
        if isinstance(self.content["noise"], str):
            return self.content["noise"]
        given = self._table("noise")
        kind = NAMED[self._chosen(KIND, NAMED, ("noise",))]
        del given[KIND]
        if isinstance(given.get("prior"), dict):
            given["prior"] = self._prior("noise", "prior")
        return self._call(kind, given, ("noise",), also=(KIND,))

    def _sensor(self, *place: str | int) -> Sensor:
        given = self._table(*place)
        entries = {key: self._prior(*place, key) if isinstance(value, dict) else value for key, value in given.items()}
        return self._call(Sensor, entries, place)

    def _experiments(self) -> list[Experiment]:
        experiments: list[Experiment] = []
        for i, _ in enumerate(self._entries("experiments")):
            for experiment in self._read("experiments", i):
                self._experiment_names.setdefault(experiment.name, i)
                experiments.append(experiment)
        return experiments

    def _read(self, *place: str | int) -> Iterator[Experiment]:
        given = self._table(*place)
        kinds = [kind for kind in (SAVED, RECORDING, TABLE) if kind in given]
        if len(kinds) != 1:
            raise self._error(
                f"{_written(place)}: must have one of '{SAVED}', '{RECORDING}' and '{TABLE}', the data file, got "
                f"{', '.join(map(repr, kinds or given)) or 'nothing'}.",
                place,
            )
        if kinds == [RECORDING]:
            for recording, fold in self._recordings(*place):
                yield self._call(recording.fold, fold, (*place, "fold"))
            return
        file = self._data_file(kinds[0], place)
        for key in (DIGEST_KEY, kinds[0]):
            given.pop(key, None)
        if kinds == [TABLE]:
            by_harmonic = {key: _by_harmonic(given[key]) for key in ("outputs", "phases") if key in given}
            yield from self._call(partial(response_table, file), given | by_harmonic, place, also=(TABLE, DIGEST_KEY))
            return
        self._check_keys(given, (SAVED, DIGEST_KEY), place)
        with self.located(*place, SAVED):
            experiment = load(file)
            _checks.instance(SAVED, experiment, Experiment)
        yield experiment

    def _recordings(self, *place: str | int) -> Iterator[tuple[Recording, dict[str, Any]]]:
        """Yield the recordings of an entry, several if it is split, and the arguments of `fold`."""
        given, file = self._table(*place), self._data_file(RECORDING, place)
        others = (RECORDING, DIGEST_KEY, "between", "fold")
        arguments = {key: value for key, value in given.items() if key not in others}
        read = self._call(partial(Recording.from_file, file), arguments, place, also=others)
        fold = self._table(*place, "fold") if "fold" in given else {}
        part = given.get("between")
        if "between" in given and not (isinstance(part, tuple) and len(part) == 2):
            raise self._error(f"between: must be [start, stop] in seconds, got {part!r}.", (*place, "between"))
        for recording in read if isinstance(read, list) else [read]:
            if part:
                with self.located(*place, "between"):
                    recording = recording.between(*part)
            yield recording, fold

    def _data_file(self, kind: str, place: Place) -> Path:
        """Return the path of a data file, relative to the problem file; raise a ValueError if it has changed."""
        table = self._table(*place)
        with self.located(*place, kind):
            file = self.path.parent / _checks.text(kind, table[kind])
            content = file.read_bytes() if file.is_file() else None
        if content is None:
            raise self._error(f"{kind}: must be an existing file, got {str(file)!r}.", (*place, kind))
        digest = hashlib.sha256(content).hexdigest()
        if (stated := table.get(DIGEST_KEY, digest)) != digest:
            raise self._error(
                f"{DIGEST_KEY}: must be that of {str(file)!r}, {digest}, got {stated!r}; the data have changed since "
                "the problem file was written.",
                (*place, DIGEST_KEY),
            )
        return file


def _with_tuples(value: Any) -> Any:
    """Return nested tables with tuples for lists, as pairs of units and channels of groups are given in Python."""
    if isinstance(value, dict):
        return {key: _with_tuples(item) for key, item in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value


def _by_harmonic(columns: Any) -> Any:
    """Return the columns of a response table with numbers of harmonics, which are texts in TOML."""
    if not isinstance(columns, dict):
        return columns
    return {
        name: {int(h) if h.isdecimal() else h: key for h, key in each.items()} if isinstance(each, dict) else each
        for name, each in columns.items()
    }


def _at(content: Any, place: Place) -> Any:
    """Return what is at a place in nested tables, or None."""
    for key in place:
        try:
            content = content[key]
        except (KeyError, IndexError, TypeError):
            return None
    return content


def _place_of(text: str, content: Any) -> Place:
    """Return the place of the only entry of nested tables that is a text; empty for none and for several."""
    if not isinstance(content, dict | tuple):
        return ()
    items = content.items() if isinstance(content, dict) else enumerate(content)
    places = [(key, *_place_of(text, item)) for key, item in items if item == text or _place_of(text, item)]
    return places[0] if len(places) == 1 else ()


def _written(place: Place) -> str:
    """Return a place as in messages, such as ``priors['m']``."""
    return "".join(f"[{key!r}]" if number else str(key) for number, key in enumerate(place))
