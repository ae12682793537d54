"""Machine code of functions of a whole grid, from Python functions of one of its points.

A function (states, inputs, parameters, tau, frequency, out, sums, columns) sets the entries of its row of `out`, and
the terms of `sums` over the grid. It is run once, with `Value` objects, whose operators append instructions for LLVM.
The default of its last argument are the numbers of entries of states, inputs, out and sums. Numba, whose passes
optimise the code, would compile the same loop from Python in five times the time.
"""

import hashlib
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import llvmlite.binding
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.registry import cpu_target

from bayesperiodic._compile.cache import load
from bayesperiodic._compile.grid_function import GRID_SIGNATURE

NO_GATHER, FIRST_LLVM = "+prefer-no-gather", 17  # and the first version of LLVM that has this feature
LLVM_NUMBER, LLVM_TRUTH, INTEGER = ir.DoubleType(), ir.IntType(1), ir.IntType(64)
MOST_FACTORS = 64
INTRINSICS = {"sin", "cos", "sqrt", "log", "log2", "log10", "floor", "ceil", "copysign", "pow", "fabs"}
FROM_C = {"tan", "asin", "acos", "sinh", "cosh", "asinh", "acosh", "atanh", "atan2", "hypot", "expm1", "log1p"}
FROM_C |= {"erf", "erfc", "lgamma", "tgamma"}
RENAMED = {"gamma": "tgamma"}
# ln 2 in two parts, the first with few bits, so that its multiples are exact.
LOG2_HIGH, LOG2_LOW = 6.93145751953125e-1, 1.42860682030941723212e-6


Operation = Callable[[Any, Any], Any]


def _arithmetic(instruction: str) -> tuple[Operation, Operation]:
    """Return an operation and the same of exchanged operands."""

    def operation(self: "Value", other: Any) -> "Value":
        return Value(self.builder, getattr(self.builder, instruction)(self.value, self.of(other)))

    def reflected(self: "Value", other: Any) -> "Value":
        return Value(self.builder, getattr(self.builder, instruction)(self.of(other), self.value))

    return operation, reflected


def _comparison(relation: str) -> Operation:
    def operation(self: "Value", other: Any) -> "Value":
        builder, compare = self.builder, self.builder.fcmp_ordered
        if self.value.type == LLVM_TRUTH:
            compare = builder.icmp_unsigned
        elif relation == "!=":
            compare = builder.fcmp_unordered
        return Value(builder, compare(relation, self.value, self.of(other)))

    return operation


class Value:
    """A number or truth value of the compiled function."""

    def __init__(self, builder: ir.IRBuilder, value: ir.Value):
        self.builder, self.value = builder, value

    def of(self, number: Any) -> ir.Value:
        """Return a number or another value as an operand."""
        if self.value.type == LLVM_NUMBER or isinstance(number, Value):
            return _number(number)
        return ir.Constant(LLVM_TRUTH, int(number))

    __add__, __radd__ = _arithmetic("fadd")
    __sub__, __rsub__ = _arithmetic("fsub")
    __mul__, __rmul__ = _arithmetic("fmul")
    __truediv__, __rtruediv__ = _arithmetic("fdiv")
    __and__, __rand__ = _arithmetic("and_")
    __or__, __ror__ = _arithmetic("or_")
    __lt__, __le__, __gt__, __ge__ = map(_comparison, ("<", "<=", ">", ">="))
    __eq__, __ne__ = map(_comparison, ("==", "!="))
    __hash__ = None  # type: ignore[assignment]

    def __neg__(self) -> "Value":
        return Value(self.builder, self.builder.fneg(self.value))

    def __pos__(self) -> "Value":
        return self

    def __abs__(self) -> "Value":
        return called("fabs", self)

    def __pow__(self, exponent: Any) -> "Value":
        if isinstance(exponent, Value) or exponent != int(exponent) or abs(exponent) > MOST_FACTORS:
            return called("pow", self, exponent)
        result, square, left = None, self, abs(int(exponent))
        while left:
            if left % 2:
                result = square if result is None else result * square
            left //= 2
            square = square * square if left else square
        one = Value(self.builder, _number(1.0))
        return one if result is None else (result if exponent > 0 else one / result)

    def __rpow__(self, base: float) -> "Value":
        return called("pow", base, self)

    def __mod__(self, other: Any) -> "Value":
        rest = Value(self.builder, self.builder.frem(self.value, self.of(other)))
        return where((rest != 0.0) & ((rest < 0.0) != (other < 0.0)), rest + other, rest)

    def __rmod__(self, other: float) -> "Value":
        return Value(self.builder, _number(other)) % self


def where(condition: Any, one: Any, other: Any) -> Any:
    """Return one where the condition holds, else the other."""
    if not isinstance(condition, Value):
        return one if condition else other
    return Value(condition.builder, condition.builder.select(condition.value, _number(one), _number(other)))


def minimum(first: Any, *others: Any) -> Any:
    """Return the smallest of numbers."""
    for other in others:
        first = where(other < first, other, first)
    return first


def maximum(first: Any, *others: Any) -> Any:
    """Return the largest of numbers."""
    for other in others:
        first = where(other > first, other, first)
    return first


def called(name: str, *arguments: Any) -> Any:
    """Return a function of the module `math`."""
    value = next((argument for argument in arguments if isinstance(argument, Value)), None)
    if value is None:
        return getattr(math, name)(*arguments)
    if name in APPROXIMATED:
        return APPROXIMATED[name](*arguments)
    name, kind = RENAMED.get(name, name), ir.FunctionType(LLVM_NUMBER, [LLVM_NUMBER] * len(arguments))
    if name in INTRINSICS:
        function = value.builder.module.declare_intrinsic(f"llvm.{name}", [LLVM_NUMBER], kind)
    elif name in FROM_C:
        function = cgutils.get_or_insert_function(value.builder.module, kind, name)
    else:
        raise ValueError(f"equations or outputs: must be elementary functions, got {name}, which cannot be compiled.")
    return Value(value.builder, value.builder.call(function, list(map(_number, arguments))))


# Elementary functions as plain arithmetic, so that loops over the grid that call them are vectorised: a call of the C
# library's function keeps such a loop scalar and costs more than all the rest of a model. The rational approximations
# are those of S. L. Moshier, Cephes Mathematical Library (1989): errors are of one or two units in the last place.


def _power_of_two(exponent: Value) -> Value:
    """Return 2**exponent for a whole number from −1022 to 1023, by its bits."""
    builder = exponent.builder
    whole = builder.add(builder.fptosi(exponent.value, INTEGER), ir.Constant(INTEGER, 1023))
    return Value(builder, builder.bitcast(builder.shl(whole, ir.Constant(INTEGER, 52)), LLVM_NUMBER))


def _exp(x: Value) -> Value:
    """Return exp(x), by exp(r)·2**n with |r| ≤ ln(2)/2."""
    within = minimum(maximum(x, -750.0), 750.0)
    n = called("floor", within / math.log(2.0) + 0.5)
    r = (within - n * LOG2_HIGH) - n * LOG2_LOW
    square = r * r
    p = r * ((1.26177193074810590878e-4 * square + 3.02994407707441961300e-2) * square + 1.0)
    q = (3.00198505138664455042e-6 * square + 2.52448340349684104192e-3) * square + 2.27265548208155028766e-1
    half = called("floor", 0.5 * n)
    value = (1.0 + 2.0 * (p / (q * square + 2.0 - p))) * _power_of_two(half) * _power_of_two(n - half)
    return where(x == x, value, x)


def _tanh(x: Value) -> Value:
    """Return tanh(x), by a rational function near zero and by exp(2|x|) elsewhere."""
    square = x * x
    p = (-9.64399179425052238628e-1 * square - 9.92877231001918586564e1) * square - 1.61468768441708447952e3
    q = (square + 1.12811678491632931402e2) * square + 2.23548839060100448583e3
    near = x + x * (square * (p / (q * square + 4.84406305325125486048e3)))
    far = called("copysign", 1.0 - 2.0 / (_exp(2.0 * minimum(abs(x), 30.0)) + 1.0), x)
    return where(abs(x) < 0.625, near, where(x == x, far, x))


def _atan(x: Value) -> Value:
    """Return atan(x), by a rational function of |x|, (|x| − 1)/(|x| + 1) or −1/|x|."""
    size = abs(x)
    middle, large = size > 0.66, size > math.tan(0.375 * math.pi)
    numerator = where(large, -1.0, where(middle, size - 1.0, size))
    denominator = where(large, size, where(middle, size + 1.0, 1.0))
    start = where(large, 0.5 * math.pi, where(middle, 0.25 * math.pi, 0.0))
    rounding = where(large, 6.123233995736766e-17, where(middle, 3.061616997868383e-17, 0.0))
    t = numerator / denominator
    square = t * t
    p = (-8.750608600031904122785e-1 * square - 1.615753718733365076637e1) * square - 7.500855792314704667340e1
    p = (p * square - 1.228866684490136173410e2) * square - 6.485021904942025371773e1
    q = (square + 2.485846490142306297962e1) * square + 1.650270098316988542046e2
    q = ((q * square + 4.328810604912902668951e2) * square + 4.853903996359136964868e2) * square
    value = t * (square * (p / (q + 1.945506571482613964425e2))) + t + rounding
    return called("copysign", start + value, x)


APPROXIMATED: dict[str, Callable[[Any], Any]] = {"exp": _exp, "tanh": _tanh, "atan": _atan}


class _Functions:
    """The module `math` of a compiled text."""

    def __getattr__(self, name: str) -> Any:
        constant = getattr(math, name, None)
        return constant if isinstance(constant, float) else lambda *arguments: called(name, *arguments)


SCOPE = {"math": _Functions(), "where": where, "min": minimum, "max": maximum}


class _Row:
    """The numbers from a place of an array on, loaded by one builder and used by another."""

    def __init__(self, builder: ir.IRBuilder, data: ir.Value, start: ir.Value, user: ir.IRBuilder | None = None):
        self._builder, self._data, self._start, self._user = builder, data, start, user or builder

    def __getitem__(self, column: int) -> Value:
        return Value(self._user, self._builder.load(self._place(column)))

    def __setitem__(self, column: int, value: Any) -> None:
        self._builder.store(_number(value), self._place(column))

    def _place(self, column: int) -> ir.Value:
        index = self._builder.add(self._start, ir.Constant(INTEGER, column))
        return self._builder.gep(self._data, [index], inbounds=True)


class _Sums:
    """Sums over the grid, in any order."""

    def __init__(self, builder: ir.IRBuilder, count: int, before: ir.IRBuilder):
        self._builder = builder
        self.totals = [cgutils.alloca_once_value(before, _number(0.0)) for _ in range(count)]

    def __setitem__(self, number: int, term: Any) -> None:
        total, builder = self.totals[number], self._builder
        builder.store(builder.fadd(builder.load(total), _number(term), flags=("reassoc",)), total)


def _number(value: Any) -> ir.Value:
    return value.value if isinstance(value, Value) else ir.Constant(LLVM_NUMBER, float(value))


def compiled(source: str) -> ModuleType:
    """Return the addresses of the functions of a text, by their names, compiled or from the cache."""
    digest = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    return load(f"# {digest}\n{source}", run=_compile)


def _compile(source: str, path: Path, module: ModuleType) -> None:
    """Define the addresses of a text's functions in a module, from the machine code beside `path` or compiled."""
    scope = dict(SCOPE)
    exec(compile(source, str(path), "exec"), scope)
    functions = {name: f for name, f in scope.items() if isinstance(f, FunctionType) and name not in SCOPE}
    stored, codegen = path.parent / "__pycache__" / "functions.nbc", cpu_target.target_context.codegen()
    if module.CACHE and stored.exists():
        library = codegen.unserialize_library(pickle.loads(stored.read_bytes()))
    else:
        library = codegen.create_library(module.__name__)
        llvm = library.create_ir_module(module.__name__)
        for name, function in functions.items():
            _append(llvm, f"{module.__name__}.{name}", function)
        if module.CACHE:
            library.enable_object_caching()
        library.add_ir_module(llvm)
        library.finalize()
        if module.CACHE:
            stored.parent.mkdir(exist_ok=True)
            stored.write_bytes(pickle.dumps(library.serialize_using_object_code()))
    module.__dict__["library"] = library
    for name in functions:
        module.__dict__[name] = library.get_pointer_to_function(f"{module.__name__}.{name}")


def _append(module: ir.Module, symbol: str, function: FunctionType) -> None:
    """Append the loop over the grid of a function, with the calling convention of `types.FunctionType`."""
    context, kinds = cpu_target.target_context, GRID_SIGNATURE.args
    result = context.get_value_type(types.none)
    code = ir.Function(module, ir.FunctionType(result, [context.get_value_type(kind) for kind in kinds]), symbol)
    _forbid_gathers(code)
    blocks = [code.append_basic_block(name) for name in ("before", "loop", "after")]
    before, body, after = map(ir.IRBuilder, blocks)
    arrays = [context.make_array(kinds[k])(context, before, code.args[k]) for k in (0, 1, 2, 3, 5)]
    states, inputs, parameters, tau, out = (array.data for array in arrays)
    points = before.extract_value(arrays[0].shape, 0)
    first, point = ir.Constant(INTEGER, 0), body.phi(INTEGER)
    columns = function.__defaults__[0]  # type: ignore[index]

    def row(builder: ir.IRBuilder, data: ir.Value, number: ir.Value, size: int) -> _Row:
        return _Row(builder, data, builder.mul(number, ir.Constant(INTEGER, size)))

    sums = _Sums(body, columns[3], before)
    function(
        row(body, states, point, columns[0]), row(body, inputs, point, columns[1]),
        _Row(before, parameters, first, body), _Row(body, tau, point)[0], Value(body, code.args[4]),
        row(body, out, point, columns[2]), sums,
    )  # fmt: skip
    following = body.add(point, ir.Constant(INTEGER, 1), flags=("nuw", "nsw"))
    point.add_incoming(first, before.block)
    point.add_incoming(following, body.block)
    body.cbranch(body.icmp_signed("<", following, points), *blocks[1:])
    before.cbranch(before.icmp_signed(">", points, first), *blocks[1:])
    last = row(after, out, points, columns[2])
    for number, total in enumerate(sums.totals):
        last[number] = Value(after, after.load(total))
    after.ret(ir.Constant(result, None))


def _forbid_gathers(code: ir.Function) -> None:
    """Have strided columns loaded one number at a time.

    Gathers are slow on most Intel processors since the mitigation of gather data sampling (Intel, advisory 00828,
    2023): without them the sweeps of a landing gear over its grid take a third of the time.
    """
    features = cpu_target.target_context.codegen().magic_tuple()[2]
    if "+avx2" in features.split(",") and llvmlite.binding.llvm_version_info[0] >= FIRST_LLVM:
        set.add(code.attributes, f'"target-features"="{features},{NO_GATHER}"')  # `add` accepts only a few names.
