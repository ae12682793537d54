#!/usr/bin/env bash
# pandas 3.0.1: `thousands="."` on a file with decimal points reads 1.25 as 125 without a word, as the places of the
# signs are not checked; a separator at the end of the rows, but not of the header, makes the first column the index and
# shifts the names of all columns by one.
#
# Seen with pandas 3.0.1, numpy 2.4.6:
#     1.25 with thousands='.': 125
#     column t of "t;x", "0;1.5;": 1.5
#
# Where users meet it: one call for files of several programs.
# What the package does: `Recording.from_csv` refuses such signs, and keeps the names of columns beside a separator at
# the end of the rows.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q pandas==3.0.1 numpy==2.4.6
cd "$folder"
venv/bin/python -W error - <<'PY'
import io

import pandas as pd

print("pandas", pd.__version__)
value = pd.read_csv(io.StringIO("t;x\n0;1.25\n"), sep=";", thousands=".")["x"][0]
print("1.25 with thousands='.':", value)
shifted = pd.read_csv(io.StringIO("t;x\n0;1.5;\n"), sep=";")["t"].iloc[0]
print('column t of "t;x", "0;1.5;":', shifted)
assert value == 125 and shifted == 1.5
PY
