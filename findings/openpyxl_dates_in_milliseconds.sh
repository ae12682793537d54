#!/usr/bin/env bash
# openpyxl 3.1.5: dates and times of day are rounded to milliseconds without a word, although the number that Excel
# stores has a resolution of 0.6 microseconds: samples at 51.2 kHz get one of few times, those at 60 Hz uneven ones.
#
# Seen with openpyxl 3.1.5:
#     samples: 50 times: 2
#     steps at 60 Hz [ms]: [16.0, 17.0]
#
# Where users meet it: date columns of data loggers in workbooks.
# What the package does: `Recording.from_file` converts the stored numbers.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q openpyxl==3.1.5
cd "$folder"
venv/bin/python -W error - <<'PY'
import openpyxl

print("openpyxl", openpyxl.__version__)


def times(rate):
    """Return the dates of 50 samples that a workbook stores as days."""
    book = openpyxl.Workbook()
    for k in range(50):
        cell = book.active.cell(k + 1, 1, 46093.5 + k / rate / 86_400)
        cell.number_format = "yyyy-mm-dd hh:mm:ss.000"
    book.save("run.xlsx")
    return [row[0] for row in openpyxl.load_workbook("run.xlsx").active.iter_rows(values_only=True)]


distinct = len(set(times(51_200)))
print("samples: 50 times:", distinct)
dates = times(60)
steps = sorted({round((b - a).total_seconds() * 1e3, 3) for a, b in zip(dates, dates[1:])})
print("steps at 60 Hz [ms]:", steps)
assert distinct < 5 and len(steps) > 1
PY
