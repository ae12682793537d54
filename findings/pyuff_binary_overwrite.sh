#!/usr/bin/env bash
# pyuff 2.5.8: `write_sets(sets, mode="overwrite")` of a binary set (data set 58b) leaves a file of one line: the data
# are lost without an error, because the file is opened for overwriting a second and a third time while it is written.
#
# Seen with pyuff 2.5.8, numpy 2.4.6:
#     overwrite: 7 bytes
#     add: 8922 bytes
#
# Where users meet it: files that are converted to universal files before they are read here.
# What the package does: nothing, as it does not write such files; `mode="add"` is right.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q pyuff==2.5.8 numpy==2.4.6
cd "$folder"
venv/bin/python - <<'PY'
import os

import numpy as np
import pyuff

signal = {
    "type": 58, "func_type": 1, "binary": 1, "abscissa_spacing": 1, "x": np.arange(1000.0), "data": np.ones(1000),
    "rsp_node": 1, "rsp_dir": 1, "ref_node": 0, "ref_dir": 0, "orddenom_spec_data_type": 0,
}
for mode in ("overwrite", "add"):
    pyuff.UFF(f"{mode}.uff").write_sets([dict(signal)], mode=mode)
    print(f"{mode}: {os.path.getsize(f'{mode}.uff')} bytes")
assert os.path.getsize("overwrite.uff") == 7
PY
