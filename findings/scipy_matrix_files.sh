#!/usr/bin/env bash
# scipy 1.17.1: mmread doubles the values beside the diagonal of a file that is marked symmetric and has both triangles, and
# reads a file of places without values as ones. load_npz reads a sparse matrix whose places are beyond its size, and
# toarray writes them beyond its memory. The first two give a stiffness that is wrong without a word.
#
# Seen with scipy 1.17.1, numpy 2.4.6.
# Where users meet it: mass and stiffness matrices of programs of finite elements, exported to MatrixMarket by a script that
# writes all entries below the head "symmetric". `read_matrix` refuses all three.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python -W error - <<'PY'
import pathlib
import subprocess
import sys

import numpy as np
import scipy
import scipy.io
import scipy.sparse

print("scipy", scipy.__version__)
head = "%%MatrixMarket matrix coordinate {} symmetric\n2 2 {}\n"
pathlib.Path("both.mtx").write_text(head.format("real", 4) + "1 1 2\n2 1 -1\n1 2 -1\n2 2 2\n")
both = scipy.io.mmread("both.mtx").toarray()
print("both triangles of [[2, -1], [-1, 2]]:", both.tolist())
assert both.tolist() == [[2.0, -2.0], [-2.0, 2.0]]
pathlib.Path("places.mtx").write_text(head.format("pattern", 2) + "1 1\n2 1\n")
places = scipy.io.mmread("places.mtx").toarray()
print("places without values:", places.tolist())
assert places.tolist() == [[1.0, 1.0], [1.0, 0.0]]
scipy.sparse.save_npz("far.npz", scipy.sparse.csr_array(np.eye(3)), compressed=False)
arrays = dict(np.load("far.npz"))
arrays["indices"] += 10**6
np.savez("far.npz", **arrays)
far = scipy.sparse.load_npz("far.npz")
print("places beyond the size are read:", far.shape, far.indices.tolist())
code = subprocess.run([sys.executable, "-c", "import scipy.sparse as s; s.load_npz('far.npz').toarray()"]).returncode
print("toarray ends with", code)
assert code != 0
PY
