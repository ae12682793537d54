#!/usr/bin/env bash
# asammdf 8.8.28: texts of MDF 4 come as bytes that are said to be in UTF-8, whatever the type of their channel is; those
# in UTF-16 with the low byte first lack their last byte, which is zero in most languages.
#
# Seen with asammdf 8.8.28, numpy 2.4.6:
#     type 6 (latin-1): bytes [b'\xb5m', b'N'], said to be utf-8
#     type 8 (utf-16-le): bytes [b'\xb5\x00m', b'N'], said to be utf-8
#     decoded by their types: ['µm', 'N'] and 2 errors of 2
#
# Where users meet it: states, units and remarks that a logger writes as a channel of texts.
# What the package does: `Recording.from_file` and `inspect` decode by the type, with the zeros that NumPy's bytes drop.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q asammdf==8.8.28 numpy==2.4.6
cd "$folder"
PYTHONIOENCODING=utf-8 venv/bin/python - <<'PY'
import asammdf
import numpy as np

print("asammdf", asammdf.__version__)
WORDS = ["µm", "N"]


def stored(encoding):
    cells = np.array([word.encode(encoding) for word in WORDS])
    with asammdf.MDF() as mdf:
        mdf.append(asammdf.Signal(cells, np.arange(2.0), name="unit", encoding=encoding))
        path = mdf.save(f"{encoding}.mf4")
    with asammdf.MDF(path) as mdf:
        signal = mdf.get("unit")
        kind = mdf.groups[0].channels[-1].data_type
    print(f"type {kind} ({encoding}): bytes {signal.samples.tolist()}, said to be {signal.encoding}")
    assert signal.encoding == "utf-8"
    return signal.samples.tolist()


plain = [cell.decode("latin-1") for cell in stored("latin-1")]
errors = 0
for cell in stored("utf-16-le"):
    try:
        cell.decode("utf-16-le")
    except UnicodeDecodeError:
        errors += 1
print(f"decoded by their types: {plain} and {errors} errors of {len(WORDS)}")
assert plain == WORDS and errors == len(WORDS)
PY
