#!/usr/bin/env bash
# npTDMS 1.13.0: `time_track` applies the interval of the last segment of a channel to all samples, needs
# `wf_start_offset`, which may be left out, and a `.tdms_index` beside the file is read in place of the file's own
# properties, also if it is that of another file.
#
# Seen with nptdms 1.13.0, numpy 2.4.6:
#     100 samples at 0.01 s, then 100 at 0.02 s: last time 3.98 s
#     without wf_start_offset: Object does not have time properties available.
#     with another index: wf_increment 9.0
#
# Where users meet it: appended measurements, waveforms of other writers, files that were renamed or copied over.
# What the package does: `Recording.from_file` refuses changed intervals and segments that do not continue the first
# one, and does not read the index.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q nptdms==1.13.0 numpy==2.4.6
cd "$folder"
venv/bin/python - <<'PY'
import os

import numpy as np
from nptdms import ChannelObject, TdmsFile, TdmsWriter, version


def write(path, *increments, **others):
    with TdmsWriter(path, index_file=True) as writer:
        for step in increments:
            writer.write_segment([ChannelObject("g", "x", np.zeros(100), {"wf_increment": step, **others})])


print("nptdms", version.__version__)
write("run.tdms", 0.01, 0.02, wf_start_offset=0.0)
last = TdmsFile.read("run.tdms")["g"]["x"].time_track()[-1]
print(f"100 samples at 0.01 s, then 100 at 0.02 s: last time {last:.4g} s")
write("short.tdms", 0.01)
try:
    TdmsFile.read("short.tdms")["g"]["x"].time_track()
except KeyError as error:
    print("without wf_start_offset:", error.args[0])
write("other.tdms", 9.0)
os.replace("other.tdms_index", "short.tdms_index")
seen = TdmsFile.read("short.tdms")["g"]["x"].properties["wf_increment"]
print("with another index: wf_increment", seen)
assert abs(last - 3.98) < 1e-9 and seen == 9.0
PY
