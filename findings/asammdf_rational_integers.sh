#!/usr/bin/env bash
# asammdf 8.8.28: a rational conversion of integers, `(P1*X**2 + P2*X + P3)/(P4*X**2 + P5*X + P6)`, computes `X**2` in
# 32 bits, so that the physical values of counts above 46340 are wrong, and may be negative.
#
# Seen with asammdf 8.8.28, numpy 2.4.6:
#     counts: [100, 46340, 50000] squares: [10000.0, 2147395600.0, -1794967296.0]
#
# Where users meet it: sensors with a quadratic characteristic that are recorded with 16 bits.
# What the package does: `Recording.from_file` converts the counts to floats first.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q asammdf==8.8.28 numpy==2.4.6
cd "$folder"
venv/bin/python - <<'PY'
import asammdf
import numpy as np

print("asammdf", asammdf.__version__)
counts = np.array([100, 46_340, 50_000], dtype="uint16")
square = {"P1": 1.0, "P2": 0.0, "P3": 0.0, "P4": 0.0, "P5": 0.0, "P6": 1.0}
with asammdf.MDF() as mdf:
    mdf.append(asammdf.Signal(counts, np.arange(3.0), name="x", conversion=square))
    path = mdf.save("run.mf4")
with asammdf.MDF(path) as mdf:
    squares = mdf.get("x").samples
print("counts:", counts.tolist(), "squares:", squares.tolist())
assert squares[2] != 50_000.0**2
PY
