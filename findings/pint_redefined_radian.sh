#!/usr/bin/env bash
# pint 0.25.3: a radian redefined as a base unit of its own dimension, so that cycles and radians cannot be mixed, is
# not taken up by the units derived from it in the default registry: rpm still converts to Hz with a factor of 2π too
# many, and mrad to deg raises.
#
# Seen with pint 0.25.3:
#     default: rpm to Hz: 0.10472
#     redefined: rpm to Hz: 0.10472
#     redefined: mrad to deg: DimensionalityError: Cannot convert from 'milliradian' ([angle]) to 'degree' ...
#
# Where users meet it: `units={"speed": ("rpm", "Hz")}`.
# What the package does: `Recording` compares the powers of the angle on both sides itself, and converts 600 rpm to 10
# Hz.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q pint==0.25.3
cd "$folder"
venv/bin/python - <<'PY'
import logging

import pint

logging.getLogger("pint").setLevel(logging.ERROR)
print("pint", pint.__version__)


def factor(registry, start, target):
    """Return how many of `target` one of `start` is, or the error."""
    try:
        return f"{registry.Quantity(1.0, start).to(target).magnitude:.6g}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"


default, redefined = pint.UnitRegistry(), pint.UnitRegistry()
redefined.define("radian = [angle] = rad")
seen = {
    "default: rpm to Hz": factor(default, "rpm", "Hz"),
    "redefined: rpm to Hz": factor(redefined, "rpm", "Hz"),
    "redefined: mrad to deg": factor(redefined, "mrad", "deg"),
}
for case, result in seen.items():
    print(f"{case}: {result}")
assert seen["default: rpm to Hz"] == seen["redefined: rpm to Hz"] == "0.10472"
assert "Error" in seen["redefined: mrad to deg"]
PY
