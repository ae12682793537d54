#!/usr/bin/env bash
# asammdf 8.8.28: an uncompressed MDF file whose name ends in .gzip or .bz2 is deleted when it is closed, or when the
# object that read it is collected. The files that are meant are temporary copies of compressed ones.
#
# Seen with asammdf 8.8.28, numpy 2.4.6:
#     before: ['run.gzip'] samples: 3
#     after: []
#
# Where users meet it: a file that was unpacked and kept its name.
# What the package does: `Recording.from_file` gives asammdf the contents without a name.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q asammdf==8.8.28 numpy==2.4.6
mkdir "$folder/work"
cd "$folder/work"
../venv/bin/python - <<'PY'
import os

import asammdf
import numpy as np

print("asammdf", asammdf.__version__)
with asammdf.MDF() as mdf:
    mdf.append(asammdf.Signal(np.arange(3.0), np.arange(3.0), name="x"))
    mdf.save("run.mf4")
os.rename("run.mf4", "run.gzip")
with asammdf.MDF("run.gzip") as mdf:
    print("before:", os.listdir(), "samples:", mdf.get("x").samples.size)
print("after:", os.listdir())
assert os.listdir() == []
PY
