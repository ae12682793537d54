#!/usr/bin/env bash
# SymPy 1.14.0: the derivative of the absolute value of a piecewise function of real symbols contains real and imaginary
# parts and a complex infinity if one of the pieces is a square. On the whole interval on which the function is zero, and
# its derivative too, the value by `subs` is NaN, before and after `simplify`, and `lambdify` ends with a KeyError that
# names a class of SymPy. Of a ramp without the quadratic transition the derivative is right.
#
# Seen with sympy 1.14.0 for |ramp(x)| with a ramp that is zero below -w/2, x = -1, 0.1, 1, w = 1/2:
#     derivative has re, im, zoo: True
#     by subs: nan 0.7 1, after simplify: nan 0.7 1, by differences: 0.0 0.7 1.0
#     lambdify: KeyError('ComplexInfinity')
#     without transition, x = -1, 1: 0 1
#
# Where users meet it: friction, gaps and stops in symbolic models.
# What the package does: `bp.elements` are made of separate branches, whose derivatives are finite; equations that
# cannot be compiled for this reason are refused with the expression.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q sympy==1.14.0
cd "$folder"
venv/bin/python - <<'PY'
import sympy as sp

print("sympy", sp.__version__)
x, w = sp.symbols("x w", real=True)
half, step = sp.Rational(1, 2), sp.Rational(1, 10**6)
ramp = sp.Piecewise((0, x <= -w / 2), (x, x >= w / 2), ((x + w / 2) ** 2 / (2 * w), True))
function = sp.Abs(ramp)
slope = sp.diff(function, x)
print("derivative has re, im, zoo:", slope.has(sp.re) and slope.has(sp.im) and slope.has(sp.zoo))
places = (-1, sp.Rational(1, 10), 1)
values, simplified = ([e.subs({x: p, w: half}) for p in places] for e in (slope, sp.simplify(slope)))
differences = [float((function.subs({x: p + step, w: half}) - function.subs({x: p - step, w: half})) / (2 * step)) for p in places]
print("by subs:", *(v.n(3) for v in values), " after simplify:", *(v.n(3) for v in simplified), " by differences:", *differences)
assert values[0] is sp.nan and simplified[0] is sp.nan and differences[0] == 0.0
assert all(abs(v - d) < 1e-9 for v, d in zip(values[1:], differences[1:]))
try:
    sp.lambdify((x, w), slope)
except KeyError as error:
    print("lambdify:", repr(error))
else:
    raise SystemExit("lambdify: no error any more")
plain = sp.diff(sp.Abs(sp.Piecewise((0, x <= 0), (x, True))), x)
print("without transition:", plain.subs(x, -1), plain.subs(x, 1))
assert (plain.subs(x, -1), plain.subs(x, 1)) == (0, 1)
PY
