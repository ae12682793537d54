"""Experiments from a table of frequencies, amplitudes and phases, or from frequency response functions."""

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.formats.contents import Key
from bayesperiodic.data.measurements import Amplitude, Measurement, PeakToPeak, Phase, RootMeanSquare
from bayesperiodic.data.sweep import DOWN, RESOLUTION, UP, Sweep
from bayesperiodic.data.table_columns import TableColumns, check_phases, contents_of, warn_of_leads
from bayesperiodic.data.units import Units

# Values in the table over the amplitude of the fundamental.
AMPLITUDES_IN = {"peak": 1.0, "rms": np.sqrt(0.5), "peak to peak": 2.0}
# Values that are of the whole signal, and what inputs, which are sines, are divided by.
OF_SIGNAL = {"rms of signal": (RootMeanSquare, "rms"), "peak to peak of signal": (PeakToPeak, "peak to peak")}
SIZE_KINDS = (*AMPLITUDES_IN, *OF_SIGNAL)
PHASE_UNITS = {"deg": np.pi / 180.0, "rad": 1.0}
# A column, or columns by harmonic.
Columns = Key | Mapping[int, Key]


def response_table(
    table: Any,
    *,
    outputs: Mapping[str, Columns],
    inputs: Mapping[str, float | Key],
    frequency: Key | None = None,
    phases: Mapping[str, Columns] | None = None,
    sd: Mapping[str, float | Key] | None = None,
    phase_sd: Mapping[str, float | Key] | None = None,
    per: str | None = None,
    size: str = "peak",
    phase_unit: str = "deg",
    lag: bool = False,
    against: Mapping[str, str] | None = None,
    derivatives: Mapping[str, int] | None = None,
    units: Units | None = None,
    sweep: str | None = None,
    resolution: float = RESOLUTION,
    samples: int | None = None,
) -> list[Experiment]:
    """Return one experiment for each frequency of a table of measured responses.

    The response is Re c exp(iωt) with the amplitude \\|c\\| and the phase arg c against the first input, a cosine: a
    phase that lags is negative. Sine inputs give the same phases. Only the harmonics in the table are data: the mean
    and other harmonics are not compared, and an output without phases is compared by its amplitude alone.

    Parameters
    ----------
    table : pandas.DataFrame, mapping of str to array (rows,), or path
        Of a file in any format of `Recording.from_file`; of a universal file with frequency response functions these,
        whose abscissa is the frequency. Units in names such as "x [mm]" are converted to SI.
    outputs : mapping of str to str, int or (group, name), or to a mapping of int to these
        Column of the amplitudes of each channel, or of complex amplitudes; or columns by harmonic, {1: "A1", 3: "A3"}.
    inputs : mapping of str to float, str, int or (group, name)
        Amplitude of each input in SI, or its column. Inputs are sines.
    frequency : str, int or (group, name), optional
        Column of the frequencies [Hz]; not for frequency response functions.
    phases : mapping of str to str, int or (group, name), or to a mapping of int to these, optional
        Column of the phase of each output; not for complex amplitudes.
    sd : mapping of str to float, str, int or (group, name), optional
        Standard deviation of the amplitudes of an output, in their unit; its column; or a share, such as "0.5%". By
        default it is unknown, one for each channel: with phases that of the real and imaginary parts of c.
    phase_sd : mapping of str to float, str, int or (group, name), optional
        Standard deviation of the phases, or its column; by default that of the amplitude over the amplitude.
    per : str, optional
        Input per whose amplitude the outputs are given, as in frequency response functions.
    size : str
        What the amplitudes of outputs and inputs are: "peak", "rms" or "peak to peak", all of sines as a lock-in
        amplifier or analyser shows them, or "rms of signal" (about the mean) or "peak to peak of signal", of outputs
        with all of their harmonics, as a meter shows them.
    phase_unit : "deg" or "rad"
    lag : bool
        Whether phases are lags, positive where the response is late (complex amplitudes: of exp(−iωt)).
    against : mapping of str to str, optional
        Output against whose phase that of another output was measured, in place of the first input's.
    derivatives : mapping of str to int, optional
        How many times what is in the table is the time derivative of the output: 1 for a mobility and 2 for an
        inertance if the output is a displacement.
    units : mapping of str to float, unit or (from, to), optional
        As for `Recording.from_file`, by channel or "frequency"; of outputs with `per` for the quotient.
    sweep : "up", "down" or None
        Direction in which the frequency was stepped: the response stays on its branch up to a fold, and jumps there.
        None: each row was measured by itself. Of a sweep up and one down make a table each. See `Sweep`.
    resolution : float
        Standard deviation of the frequencies, relative to them. A row that was measured beyond the fold of the model's
        branch is compared with the orbit at the fold, and the distance to it, over this standard deviation, is one
        more residual.
    samples : int, optional
        Grid points per period, by default 64, or 32 for each harmonic up to the highest in the table. With the default
        scheme of tables, "central4", this is enough for smooth responses; `check` tells what twice as many change.

    Returns
    -------
    list of Experiment
        In the order of the table, each with its `sweep`.

    Raises
    ------
    FileNotFoundError, ImportError, ValueError
        As for `Recording.from_file`, and for negative amplitudes, levels in dB, phases that are missing, beyond 720°
        or folded into ±90°, and frequencies ≤ 0.

    Warns
    -----
    UserWarning
        If phases in degrees are probably radians, or of the other sign: rising over a peak.

    Examples
    --------
    >>> f = np.array([0.10, 0.14, 0.18])
    >>> omega = 2 * np.pi * f
    >>> c = 0.5 / (1.0 - omega**2 + 0.2j * omega)
    >>> table = {"f": f, "A": 1e3 * abs(c), "phi": np.degrees(np.angle(c))}
    >>> runs = bp.response_table(
    ...     table, frequency="f", outputs={"displacement": "A"}, phases={"displacement": "phi"},
    ...     inputs={"force": 0.5}, units={"displacement": ("mm", "m")},
    ... )
    >>> [run.name for run in runs], runs[0].independent
    (['0.1 Hz', '0.14 Hz', '0.18 Hz'], {'displacement': 2})

    Amplitudes alone, known to half a per cent:

    >>> runs = bp.response_table(
    ...     table, frequency="f", outputs={"displacement": "A"}, inputs={"force": 0.5}, sd={"displacement": "0.5%"},
    ...     units={"displacement": ("mm", "m")}, sweep="up",
    ... )
    >>> [one.label for one in runs[0].measurements]
    ['amplitude of displacement']
    """  # noqa: D301
    if not len(_checks.mapping("outputs", outputs, EXAMPLE)):
        raise ValueError(f"outputs: must have at least one, such as {EXAMPLE}, got none.")
    _checks.mapping("inputs", inputs, "{'force': 0.5}")
    of_outputs = {"phases": phases, "sd": sd, "phase_sd": phase_sd, "against": against, "derivatives": derivatives}
    given = {
        argument: _checks.optional_mapping(argument, one, "{'displacement': …}")
        for argument, one in (of_outputs | {"units": units}).items()
    }
    phases, sd, phase_sd, against, derivatives, units = given.values()
    amplitudes, angles = ({n: _by_harmonic(one) for n, one in of_each.items()} for of_each in (outputs, phases))
    _checks.one_of("size", size, SIZE_KINDS)
    _checks.one_of("phase_unit", phase_unit, PHASE_UNITS)
    if sweep not in (None, UP, DOWN):
        raise ValueError(
            f"sweep: must be 'up', 'down' or None, got {sweep!r}; make a table of each sweep, or give None: each row "
            "is then on the stable branch that fits it best."
        )
    if per is not None:
        _checks.one_of("per", per, inputs)
    for argument, one in given.items():
        for key in one:
            _checks.one_of(argument, key, ("frequency", *outputs, *inputs) if argument == "units" else outputs)
    columns: list[Any] = [*inputs.values(), frequency, *sd.values(), *phase_sd.values()]
    columns += [key for each in (*amplitudes.values(), *angles.values()) for key in each.values()]
    columns = [key for key in columns if isinstance(key, str | tuple) and not str(key).strip().endswith("%")]
    label, contents = contents_of(table, columns)
    source = TableColumns(label, contents, units)
    first = [contents.find(label, key) for each in amplitudes.values() for key in each.values()]
    at, factor = source.frequencies(first, frequency), AMPLITUDES_IN[OF_SIGNAL.get(size, (None, size))[1]]
    drive = {name: source.drive(name, value, at.size) / factor for name, value in inputs.items()}
    orders = {name: _checks.integer(f"derivatives[{name!r}]", order, 0) for name, order in derivatives.items()}
    reader = _Reader(source, at, drive, size, PHASE_UNITS[phase_unit], lag, per, orders)
    read = {
        name: reader.output(
            _Output(name, to=against.get(name, "")), columns, angles.get(name, {}),
            [each.get(name) for each in (sd, phase_sd)],
        )
        for name, columns in amplitudes.items()
    }  # fmt: skip
    numbers = [at, *drive.values(), *(sizes for each in read.values() for sizes in each.size.values())]
    of_table = Sweep(_table_name(label, amplitudes, inputs, numbers), sweep, resolution)
    first_columns = {name: columns[min(columns)] for name, columns in amplitudes.items()}
    known = {name: source.unit(name, key) for name, key in {**first_columns, **inputs}.items()}
    known |= {name: reader.unit(name, known) for name in amplitudes}
    samples = samples or max(
        FEWEST_TABLE_POINTS, POINTS_A_HARMONIC * max(h for each in amplitudes.values() for h in each)
    )
    return [
        replace(
            Experiment.from_harmonics(
                name, float(at[k]), {channel: each.harmonics(k) for channel, each in read.items() if each.whole},
                {channel: [0.0, level[k]] for channel, level in drive.items()}, samples=samples,
            ),
            measurements=[one for each in read.values() if not each.whole for one in each.measurements(k)],
            sweep=of_table, units={channel: unit for channel, unit in known.items() if unit},
        )
        for k, name in enumerate(_names(at))
    ]  # fmt: skip


# Default numbers of grid points: least, and for each harmonic up to the highest one in a table.
FEWEST_TABLE_POINTS, POINTS_A_HARMONIC = 64, 32
EXAMPLE = "{'displacement': 'the column of its amplitudes'}"


@dataclass(frozen=True)
class _Output:
    """What a table says of one output, (rows,) by harmonic."""

    channel: str
    kind: Any = Amplitude
    size: dict[int, np.ndarray] = field(default_factory=dict)  # in the channel's unit
    phase: dict[int, np.ndarray] = field(default_factory=dict)  # [rad]
    sd: dict[int, np.ndarray] = field(default_factory=dict)
    phase_sd: dict[int, np.ndarray] = field(default_factory=dict)
    to: str = ""

    @property
    def whole(self) -> bool:
        """Whether it is compared as complex amplitudes of unknown variance."""
        return bool(self.phase) and not self.phase_sd

    def harmonics(self, row: int) -> Any:
        """Return the complex amplitudes of harmonics 0, 1, …, None where there is none."""
        result: list[complex | None] = [None] * (1 + max(self.size))
        for h, sizes in self.size.items():
            result[h] = complex(sizes[row] * np.exp(1j * self.phase[h][row]))
        return result

    def measurements(self, row: int) -> list[Measurement]:
        """Return the measurements, if it is not compared as complex amplitudes."""
        result: list[Measurement] = []
        for h, sizes in self.size.items():
            more = {"harmonic": h} if self.kind is Amplitude else {}
            sd = float(self.sd[h][row]) if self.sd else None
            result.append(self.kind(self.channel, float(sizes[row]), sd=sd, **more))
            if h in self.phase:
                angle, error = float(self.phase[h][row]), float(self.phase_sd[h][row])
                result.append(Phase(self.channel, angle, to=self.to, sd=error, harmonic=h))
        return result


@dataclass(frozen=True)
class _Reader:
    """The conventions of a table, by which outputs are read."""

    source: TableColumns
    frequency: np.ndarray
    drive: dict[str, np.ndarray]
    size: str
    radian: float
    lag: bool
    per: str | None
    orders: dict[str, int]  # of the time derivatives that are in the table

    def output(self, one: _Output, columns: dict[int, Key], phases: dict[int, Key], given: list[Any]) -> _Output:
        """Return what the table says of an output, with the given standard deviations of amplitudes and phases."""
        name, rows, (sd, phase_sd) = one.channel, self.frequency.size, given
        sizes, angles, errors = {}, {}, {}
        kind, order = OF_SIGNAL.get(self.size, (Amplitude,))[0], self.orders.get(name, 0)
        turn = 0.5 * np.pi * (order - self.orders.get(one.to, 0))
        if kind is not Amplitude and (order or self.per or set(columns) != {1}):
            raise ValueError(
                f"size: must be of sines, {', '.join(map(repr, AMPLITUDES_IN))}, with per, derivatives or harmonics, "
                f"got {self.size!r}."
            )
        for h, key in columns.items():
            values = self.source.amplitude(name, key, rows, self.per)
            # A meter's values are compared as they are.
            scale = self.drive[self.per] if self.per else np.full(rows, 1.0 / AMPLITUDES_IN.get(self.size, 1.0))
            scale = scale / (2 * np.pi * h * self.frequency) ** order
            sizes[h] = np.abs(values) * scale
            if sd is not None:
                errors[h] = self.source.deviations(name, sd, key, values) * scale
            if (angle := self._angles(name, values, phases.get(h))) is not None:
                angles[h] = angle - turn
                if h == 1 and not one.to:
                    order_of_rows = np.argsort(self.frequency, kind="stable")
                    warn_of_leads(name, self.source.label, angle[order_of_rows], sizes[h][order_of_rows], self.lag)
        self._check_phases(name, columns, phases, angles)
        if phase_sd is not None and not angles:
            raise ValueError(f"phase_sd: must be of outputs with phases, got one for {name!r}.")
        spread = {}
        if angles and (sd is not None or phase_sd is not None or one.to or kind is not Amplitude):
            if phase_sd is None and (sd is None or kind is not Amplitude):
                raise ValueError(
                    f"phase_sd: must be given for {name!r}, whose phases are not those of complex amplitudes of "
                    "unknown variance."
                )
            for h, values in sizes.items():
                spread[h] = (
                    errors[h] / values if phase_sd is None
                    else self.source.phase_deviations(name, phase_sd, self.radian, rows)
                )  # fmt: skip
        return _Output(name, kind, sizes, angles, errors, spread, one.to or next(iter(self.drive), ""))

    def unit(self, name: str, known: Mapping[str, str]) -> str:
        """Return the unit of an output, from those of the columns; empty if it is not known."""
        unit, order = known[name], self.orders.get(name, 0)
        if not unit or (self.per and not known[self.per]):
            return ""
        unit = f"({unit})*({known[self.per]})" if self.per else unit
        return f"({unit})*s**{order}" if order else unit

    def _angles(self, name: str, values: np.ndarray, phase: Key | None) -> np.ndarray | None:
        """Return the phases [rad] of one harmonic, those of a column or of complex amplitudes; None without any."""
        sign = -1.0 if self.lag else 1.0
        if values.dtype.kind == "c":
            if phase is not None:
                raise ValueError(f"phases: must be left out for complex amplitudes, got one for {name!r}.")
            return sign * np.angle(values)
        if phase is None:
            return None
        angles = self.source.sized(f"phases[{name!r}]", self.source.angles(phase, self.radian), values.size)
        order = np.argsort(self.frequency, kind="stable")
        check_phases(f"phases[{name!r}]", self.source.label, angles[order], values[order])
        return sign * angles

    def _check_phases(self, name: str, columns: dict[int, Key], phases: dict[int, Key], angles: dict[int, Any]) -> None:
        """Raise a ValueError if only some harmonics have a phase."""
        if not set(phases) <= set(columns) or (angles and set(angles) != set(columns)):
            raise ValueError(
                f"phases[{name!r}]: must have the harmonics of the amplitudes, {sorted(columns)}, got "
                f"{sorted(phases or angles)}."
            )


def _by_harmonic(columns: Columns) -> dict[int, Key]:
    """Return columns by harmonic; one column is that of the fundamental."""
    if not isinstance(columns, Mapping):
        return {1: columns}
    for harmonic in columns:
        _checks.integer("harmonic", harmonic, 1)
    if not columns:
        raise ValueError("outputs: must have a column for each channel, got {}.")
    return dict(columns)


def _table_name(
    label: str,
    outputs: Mapping[str, Mapping[int, Key]],
    inputs: Mapping[str, float | Key],
    values: Iterable[np.ndarray],
) -> str:
    """Return a name of the table that tells it from others: its file, columns and levels, and a sum of its values."""
    parts = [f"{name} {', '.join(map(str, columns.values()))}" for name, columns in outputs.items()]
    parts += [f"{name} {level}" for name, level in inputs.items()]
    return f"{label}: {'; '.join(parts)} [{zlib.crc32(np.concatenate([*values]).tobytes()):08x}]"


def _names(frequencies: np.ndarray) -> list[str]:
    """Return different names of experiments."""
    texts = [f"{value:.6g} Hz" for value in frequencies]
    return [text if texts.count(text) == 1 else f"{k}: {text}" for k, text in enumerate(texts, 1)]
