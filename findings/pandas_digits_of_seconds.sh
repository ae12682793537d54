#!/usr/bin/env bash
# pandas 3.0.1: dates after ISO 8601 with more than nine decimals of a second, as instruments with picoseconds write
# them, lose the further digits without a word, so that times 0.4 ns apart become equal; the comma, which ISO 8601
# allows as decimal sign, is refused by the format "ISO8601".
#
# Seen with pandas 3.0.1, numpy 2.4.6:
#     different texts: 3 different times: 1
#     comma: ValueError: Time data 2026-01-01T00:00:00,5 is not ISO8601 format. ...
#
# Where users meet it: time columns of oscilloscopes and of clocks synchronised by PTP.
# What the package does: `Recording` refuses such texts and asks for seconds as numbers.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q pandas==3.0.1 numpy==2.4.6
cd "$folder"
venv/bin/python -W error - <<'PY'
import pandas as pd

print("pandas", pd.__version__)
texts = ["2026-01-01T00:00:00.1234567890", "2026-01-01T00:00:00.1234567894", "2026-01-01T00:00:00.1234567898"]
times = pd.to_datetime(texts, format="ISO8601")
print("different texts:", len(set(texts)), "different times:", times.nunique())
try:
    comma = str(pd.to_datetime(["2026-01-01T00:00:00,5"], format="ISO8601")[0])
except ValueError as error:
    comma = f"ValueError: {error}"
print("comma:", comma)
assert times.nunique() == 1
assert comma.startswith("ValueError")
PY
