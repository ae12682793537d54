#!/usr/bin/env bash
# pyuff 2.5.8: universal files (data set 58) that are valid after the specification come back with other times and with
# other numbers of samples, without a word.
#   1. Numbers of the header and abscissas in texts have six digits, so that an even axis of 51.2 kHz is 2.6 ppm long,
#      and uneven times of 1 kHz at 1000 s become a staircase.
#   2. Fortran writes whole lines of six values (Addendum B of the specification); pyuff returns the filling as samples,
#      although the header says how many there are, and fewer values than it says for a file that is cut off.
#   3. The last data set is dropped if the closing mark has 80 columns and no line end follows.
#
# Seen with pyuff 2.5.8, numpy 2.4.6:
#     interval: 1.95313e-05 instead of 1.953125e-05 s
#     different times of 2000 samples: 201
#     samples: 6 header says 4
#     data sets: 1 of 2
#
# Where users meet it: universal files of measurement programs, in which numbers have six digits.
# What the package does: `Recording.from_file` names the interval with its error, refuses the staircase, takes as many
# values as the header says, and refuses the file of which a set would be lost.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q pyuff==2.5.8 numpy==2.4.6
cd "$folder"
venv/bin/python - <<'PY'
import numpy as np
import pyuff


def function(**arguments):
    data = {"type": 58, "func_type": 1, "rsp_node": 1, "rsp_dir": 1, "ref_node": 0, "ref_dir": 0, "binary": 0}
    return data | {"orddenom_spec_data_type": 0, "z_axis_value": 0} | arguments


def read(name, sets):
    pyuff.UFF(name).write_sets(sets, mode="overwrite", force_double=False)
    return pyuff.UFF(name).read_sets()


even = np.arange(100) / 51200
back = read("even.uff", function(x=even, data=even, abscissa_spacing=1, ord_data_type=2))
print("interval:", float(back["x"][1]), "instead of", float(even[1]), "s")
late = 1000.0 + 1e-3 * np.arange(2000)
back = read("late.uff", function(x=late, data=late, abscissa_spacing=0, ord_data_type=2))
print("different times of 2000 samples:", np.unique(back["x"]).size)
assert np.unique(back["x"]).size < 300

read("line.uff", function(x=np.arange(4.0), data=np.arange(4.0), abscissa_spacing=1, ord_data_type=2))
text = open("line.uff").read()
lines = text.splitlines()
lines[-2] = lines[-2] + "  9.00000e+00  9.00000e+00"
open("line.uff", "w").write("\n".join(lines) + "\n")
back = pyuff.UFF("line.uff").read_sets()
print("samples:", back["data"].size, "header says", back["num_pts"])
assert back["data"].size == 6 and back["num_pts"] == 4

open("two.uff", "w").write(text + text.rstrip() + " " * 74)
print("data sets:", pyuff.UFF("two.uff").get_n_sets(), "of 2")
assert pyuff.UFF("two.uff").get_n_sets() == 1
PY
