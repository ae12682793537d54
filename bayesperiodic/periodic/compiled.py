"""Compiled functions of the periodic solver: their arguments, status codes and loading.

The functions are in the sources in `_kernels`, which import the definitions below. Loops over states and over the
offsets of the scheme are unrolled for small models: the sizes are constants of the module that is compiled.
"""

import gc
import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numba import types

from bayesperiodic._compile.cache import declare, is_stored, load
from bayesperiodic._compile.expectations import internals_expected
from bayesperiodic._parallel import available_cores

STATUSES = ("converged", "stalled", "singular", "not finite", "other orbit", "not resolved")
CONVERGED, STALLED, SINGULAR, NOT_FINITE, OTHER_ORBIT, NOT_RESOLVED = range(len(STATUSES))
MAX_SEGMENTS = 12
NO_FACTORS = -1
MOST_NEWTON_STEPS = 50
HALVINGS = 20
STEP_TOLERANCE = 1e-9
UNROLLED_STATES = 3
SAME_REPETITIONS = 1e-6  # largest difference of repetitions, in units of the range
SHRUNK = 1e-6  # largest range of an equilibrium, in units of the guess's
ABSENT = 1e-6  # largest relative amplitude of an absent harmonic

FLAG, COUNT, NUMBER = types.boolean, types.int64, types.float64
VECTOR, MATRIX, CUBE, GAINS = (types.Array(NUMBER, dimensions, "C") for dimensions in (1, 2, 3, 4))
PLACES, INDICES = (types.Array(COUNT, dimensions, "C") for dimensions in (1, 2))


class Functions(NamedTuple):
    """Addresses of a model's grid functions; `grid_function_at` makes functions of them in compiled code."""

    residual: int
    residual_jacobian: int
    outputs: int
    derivatives: int

    @classmethod
    def of(cls, kernels: Any) -> "Functions":
        """Return the addresses of `Model.kernels`."""
        return cls(*(getattr(kernels, name).address for name in cls._fields))


class Grid(NamedTuple):
    """The arrays of a `schemes.CyclicGrid`."""

    first: np.ndarray  # (offsets,), weights of the first derivative with respect to tau
    second: np.ndarray  # (offsets,), of the second derivative
    neighbours: np.ndarray  # (points, offsets), index of the point at each offset
    shift: np.ndarray  # (points, offsets), distance to it in the folded order
    place: np.ndarray  # (points,), of each point in the folded order
    tau: np.ndarray  # (points,), in forcing periods
    half_width: int  # of the folded band, in points
    lead: int  # offset of the newest point of a march, −1 where the scheme cannot be marched


class Setting(NamedTuple):
    """Arguments of the equations besides the states."""

    inputs: np.ndarray  # (points, 3·inputs)
    parameters: np.ndarray  # (parameters,)
    frequency: float  # [Hz]
    drift: np.ndarray  # (states,), mean rate of each state per forcing period, not zero for a winding angle


class Factors(NamedTuple):
    """Factors of ∂g/∂z: of the folded band, or of its segments with their interface, see `_kernels/linear.py`."""

    band: np.ndarray
    pivots: np.ndarray
    inverses: np.ndarray
    gains: np.ndarray
    transfer: np.ndarray
    ends: np.ndarray
    interface: np.ndarray
    interface_pivots: np.ndarray


class Border(NamedTuple):
    """The border of [∂g/∂z, B; C, D] and its factors."""

    columns: np.ndarray  # (borders + 1, size): B, overwritten by the factors; the last row deflates ∂g/∂z
    rows: np.ndarray  # (borders, size): C
    corner: np.ndarray  # (borders, borders): D
    small: np.ndarray  # (borders + 1, 3·borders + 1)
    pivots: np.ndarray  # (borders + 1,)

    @classmethod
    def empty(cls, borders: int, size: int) -> "Border":
        """Return a border of zeros."""
        return cls(
            np.zeros((borders + 1, size)),
            np.zeros((borders, size)),
            np.zeros((borders, borders)),
            np.empty((borders + 1, 3 * borders + 1)),
            np.empty(borders + 1, dtype=np.int64),
        )


class Unknowns(NamedTuple):
    """Further scalar unknowns of the equations, and the conditions C·z + D·values = targets that fix them."""

    values: np.ndarray  # (unknowns,)
    targets: np.ndarray  # (unknowns,)
    scales: np.ndarray  # (unknowns,); steps are measured in these, or in the values if those are larger
    parameters: np.ndarray  # (unknowns, parameters), change of the parameters per unit of each
    inputs: np.ndarray  # (unknowns, points, 3·inputs), change of the inputs per unit of each
    frequency: int  # index of the unknown that is the frequency, or −1


NO_UNKNOWNS = Unknowns(np.empty(0), np.empty(0), np.empty(0), np.empty((0, 0)), np.empty((0, 0, 0)), -1)
NO_BORDER = Border.empty(0, 0)


class Workspace(NamedTuple):
    """Arrays that the Newton iteration overwrites."""

    states: np.ndarray
    columns: np.ndarray  # of the model's function `residual_jacobian`
    derivatives: np.ndarray
    factors: Factors


class Sets(NamedTuple):
    """Input sets of a batch."""

    inputs: np.ndarray  # (sets, points, 3·inputs)
    frequency: np.ndarray  # (sets,) [Hz]
    drift: np.ndarray  # (sets, states)


class Anchors(NamedTuple):
    """Anchors of the input sets of a driven batch, arrays (sets, …); see `batch.Anchor`."""

    parameters: np.ndarray
    z: np.ndarray
    sensitivities: np.ndarray
    amplitude: np.ndarray  # (sets, states), largest absolute value of each state
    stiffness_gradient: np.ndarray  # (sets, parameters), of left · (∂g/∂z) · right along the solutions
    along: np.ndarray  # (sets, parameters), the parts of the sensitivities along `right`
    near: np.ndarray  # (sets,), length of the path of chord steps in amplitudes below which an orbit cannot be far
    factors: Factors  # of ∂g/∂z; the first of `ends` is −1 where there are none
    left: np.ndarray  # (sets, points, states), see `prepare_anchor` of `_kernels/batch.py`
    right: np.ndarray
    moving: np.ndarray  # (moving,), indices of the parameters that the prediction of second order depends on
    curvature: np.ndarray  # (sets, pairs, points, states), its coefficients; the pairs i ≤ j in the order of i, then j


class CycleAnchors(NamedTuple):
    """Anchors of an autonomous batch, arrays (sets, …); see `batch.Anchor`."""

    parameters: np.ndarray
    z: np.ndarray
    frequency: np.ndarray
    sensitivities: np.ndarray
    frequency_sensitivities: np.ndarray
    band: np.ndarray  # with the next two, factors of the equations bordered by the phase condition
    pivots: np.ndarray
    border: Border
    target: np.ndarray  # (sets,), value of the phase condition
    orientation: np.ndarray  # (sets,), of the factors; 0 for a guess without factors


class BatchSolution(NamedTuple):
    """Solutions of a batch."""

    z: np.ndarray  # (sets, solves, points, states), periodic parts; without entries unless requested
    outputs: np.ndarray  # (sets, solves, points, channels)
    frequency: np.ndarray  # (sets, solves) [Hz]
    status: np.ndarray  # (sets, solves), index into `STATUSES`
    iterations: np.ndarray  # (sets, solves), steps with the anchor's factors and Newton iterations


class SpecialAnchors(NamedTuple):
    """Anchors of a batch of special points, arrays (sets, …); see `special_batch`."""

    parameters: np.ndarray
    z: np.ndarray
    values: np.ndarray  # (sets, unknowns)
    vectors: np.ndarray  # (sets, points, states), null vectors of folds
    z_slopes: np.ndarray  # (sets, parameters, points, states)
    value_slopes: np.ndarray  # (sets, parameters, unknowns)
    vector_slopes: np.ndarray
    band: np.ndarray  # with the next two, factors of the bordered equations
    pivots: np.ndarray
    border: Border
    bends: np.ndarray  # (sets, points, states·(1 + 3·states)), change of ∂g/∂(q, q̇, q̈) along the null vector
    bend: np.ndarray  # (sets, points, states), derivative of ∂g/∂z · v by the unknown of a fold
    bent: np.ndarray  # (sets, points, states), change of the null vector along the branch
    curvature: np.ndarray  # (sets,), of the unknown along the branch; zero if it is no fold
    rows: np.ndarray  # (sets, unknowns, points, channels), conditions on the outputs
    targets: np.ndarray  # (sets, unknowns)
    inputs: np.ndarray  # (sets, unknowns, points, 3·inputs), change of the inputs per unit of each unknown
    known: np.ndarray  # int (sets,), 0 for a guess without factors


class SpecialSolution(NamedTuple):
    """Solutions of a batch of special points."""

    z: np.ndarray  # (sets, solves, points, states)
    outputs: np.ndarray  # (sets, solves, points, channels)
    values: np.ndarray  # (sets, solves, unknowns)
    status: np.ndarray  # (sets, solves), index into `STATUSES`
    iterations: np.ndarray  # (sets, solves)


ADDRESSES = types.NamedUniTuple(COUNT, len(Functions._fields), Functions)
GRID = types.NamedTuple([VECTOR, VECTOR, INDICES, INDICES, PLACES, VECTOR, COUNT, COUNT], Grid)
SETTING = types.NamedTuple([MATRIX, VECTOR, NUMBER, VECTOR], Setting)
FACTORS = types.NamedTuple([MATRIX, PLACES, CUBE, GAINS, CUBE, PLACES, VECTOR, PLACES], Factors)
BORDER = types.NamedTuple([MATRIX, MATRIX, MATRIX, MATRIX, PLACES], Border)
UNKNOWNS = types.NamedTuple([VECTOR, VECTOR, VECTOR, MATRIX, CUBE, COUNT], Unknowns)
WORKSPACE = types.NamedTuple([MATRIX, MATRIX, MATRIX, FACTORS], Workspace)
SETS = types.NamedTuple([CUBE, VECTOR, MATRIX], Sets)
ALL_FACTORS = types.NamedTuple(
    [CUBE, INDICES, GAINS, types.Array(NUMBER, 5, "C"), GAINS, INDICES, MATRIX, INDICES], Factors
)
ANCHORS = types.NamedTuple(
    [MATRIX, CUBE, GAINS, MATRIX, MATRIX, MATRIX, VECTOR, ALL_FACTORS, CUBE, CUBE, PLACES, GAINS], Anchors
)
ALL_BORDERS = types.NamedTuple([CUBE, CUBE, CUBE, CUBE, INDICES], Border)
CYCLE_ANCHORS = types.NamedTuple(
    [MATRIX, CUBE, VECTOR, GAINS, MATRIX, CUBE, INDICES, ALL_BORDERS, VECTOR, VECTOR], CycleAnchors
)
SOLUTION = types.NamedTuple([GAINS, GAINS, MATRIX, INDICES, INDICES], BatchSolution)
SPECIAL_ANCHORS = types.NamedTuple(
    [MATRIX, CUBE, MATRIX, CUBE, GAINS, CUBE, GAINS, CUBE, INDICES, ALL_BORDERS, CUBE, CUBE, CUBE, VECTOR]
    + [GAINS, MATRIX, GAINS, PLACES],
    SpecialAnchors,
)
SPECIAL_SOLUTION = types.NamedTuple([GAINS, GAINS, CUBE, INDICES, INDICES], SpecialSolution)


DIGEST = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()  # of the definitions above, which sources import
# What each module of compiled functions is compiled from: the source, and the module whose names are defined in it.
SOURCES = {
    "linear": ("linear", None),
    "border": ("border", "linear"),
    "newton": ("newton", "linear"),
    "bordered newton": ("newton", "border"),
    "batch": ("batch", "newton"),
    "adjoint": ("adjoint", "batch"),
    "autonomous": ("autonomous", "bordered newton"),
    "special": ("special", "bordered newton"),
}


def kernels(name: str, states: int, stencil: tuple[int, int, int]) -> ModuleType:
    """Return one of `SOURCES` for a number of states and a `schemes.CyclicGrid.stencil`."""
    sizes = (states, *stencil) if states <= UNROLLED_STATES and any(stencil) else (0, 0, 0, 0)
    return _kernels(name, sizes)


@cache
def _kernels(name: str, sizes: tuple[int, ...]) -> ModuleType:
    text, base = SOURCES[name]
    if not base:
        return load(source(text), _constants(name, sizes))
    with _other_process(name, sizes):
        shared = _kernels(base, sizes)
    return load(source(text), _constants(name, sizes), shared)


def _constants(name: str, sizes: tuple[int, ...]) -> dict[str, Any]:
    route = "internals" if internals_expected() else "njit"
    return {"SIZES": sizes, "BORDERED": SOURCES[name][1] == "border", "DEFINITIONS": DIGEST, "COMPILED_BY": route}


@contextmanager
def _other_process(name: str, sizes: tuple[int, ...]) -> Iterator[None]:
    """Compile one of `SOURCES` in another process, while this one compiles the one that it is based on.

    Neither needs what the other compiles before it runs. If the other process cannot be started or fails, its entry is
    missing in the cache, and is compiled here.
    """
    base = SOURCES[name][1] or ""
    alone = SOURCES[base][1] or not Path(sys.executable or "").stem.startswith("python") or available_cores() < 2
    if alone or is_stored(source(SOURCES[base][0]), _constants(base, sizes)):
        yield
        return
    call = f"from {__name__} import compile_alone; compile_alone({name!r}, {sizes!r})"
    command = [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; {call}"]
    with ExitStack() as stack:
        with suppress(OSError):
            silent = subprocess.DEVNULL
            process = stack.enter_context(subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent))
            stack.push(lambda error, *_: process.kill() if error else None)
        yield


def compile_alone(name: str, sizes: tuple[int, ...]) -> None:
    """Compile one of `SOURCES` for the cache without the one that it is based on, and end the process."""
    text, base = SOURCES[name]
    gc.disable()
    declared = declare(source(SOURCES[base or ""][0]), _constants(base or "", sizes))
    load(source(text), _constants(name, sizes), declared)
    os._exit(0)  # without clearing the memory, which takes half a second


def source(name: str) -> str:
    """Return the text of a source in `_kernels`."""
    return Path(__file__).with_name("_kernels").joinpath(f"{name}.py").read_text(encoding="utf-8")
