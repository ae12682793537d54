#!/usr/bin/env bash
# scipy.io.wavfile.read, SciPy 1.17.1: a WAV file whose samples are cut off is read without a warning if the size in its
# first line is that of the file, as after a repair or a copy by a tool that sets it; and of a file with two chunks of
# samples only the last one is returned. Samples of 24 bits are returned as 32 (as documented): 256 times larger than
# the integers that were written.
#
# Seen with scipy 1.17.1, numpy 2.4.6:
#     header says 1000 samples, read: 400, warnings: 0
#     24 bits: written 1000, read 256000
# `Recording.from_file` checks the structure first: the file is refused, and 24 bits are divided by their full scale.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q scipy==1.17.1 numpy==2.4.6
cd "$folder"
venv/bin/python - <<'PY'
import struct
import warnings
import wave

import numpy as np
from scipy.io import wavfile

wavfile.write("run.wav", 8000, np.arange(1000, dtype=np.int16))
content = open("run.wav", "rb").read()[:-1200]
open("run.wav", "wb").write(content[:4] + struct.pack("<I", len(content) - 8) + content[8:])
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    samples = wavfile.read("run.wav")[1]
print("header says 1000 samples, read:", f"{samples.size}, warnings: {len(caught)}")
assert samples.size == 400 and not caught
with wave.open("deep.wav", "wb") as file:
    file.setnchannels(1)
    file.setsampwidth(3)
    file.setframerate(8000)
    file.writeframes((1000).to_bytes(3, "little"))
print("24 bits: written 1000, read", wavfile.read("deep.wav")[1][0])
assert wavfile.read("deep.wav")[1][0] == 256_000
PY
