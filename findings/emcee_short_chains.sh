#!/usr/bin/env bash
# emcee 3.1.6: `integrated_time` of many walkers is a fifth too small for chains 50 autocorrelation times long, the
# length that it asks for itself, and without the warning that shorter ones get. More walkers do not help, since the
# mean of each walker's own values is subtracted: that takes about `(2*window + 1)/steps` of the sum of autocorrelations
# away (U. Wolff, Computer Physics Communications 156 (2004) 143-153), and the window is 5 autocorrelation times.
#
# Seen with emcee 3.1.6, numpy 2.4.6, scipy 1.17.1, on 2000 independent first-order autoregressive walkers with the
# known time 9:
#     50 times long: 7.48 (0.83 of the known time); times 1 + (2*window + 1)/steps: 8.73 (0.97)
#     100 times long: 8.21 (0.91 of the known time); times 1 + (2*window + 1)/steps: 8.97 (1.00)
#
# Where users meet it: Monte Carlo errors from `sampler.get_autocorr_time()` of just long enough chains are 10 % too
# small, and the time seems to grow with the length.
# What the package does: `sample` and `population` multiply the time by `1 + (2*window + 1)/steps`.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q emcee==3.1.6 numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python -W error - <<'PY'
import emcee
import numpy as np
from scipy.signal import lfilter

print("emcee", emcee.__version__)
r, walkers = 0.8, 2000
known = (1 + r) / (1 - r)
for length, expected in ((50, 0.83), (100, 0.91)):
    steps = int(length * known)
    noise = np.random.default_rng(1).standard_normal((steps, walkers))
    noise[1:] *= np.sqrt(1 - r**2)
    chain = lfilter([1.0], [1.0, -r], noise, axis=0)[:, :, None]
    # The default tolerance of 50 times the estimate raises an error for chains that are too short: it does not here.
    time = emcee.autocorr.integrated_time(chain, tol=50, has_walkers=True)[0]
    corrected = time * (1 + (2 * 5 * time + 1) / steps)
    print(
        f"{length} times long: {time:.3g} ({time / known:.2f} of the known time); "
        f"times 1 + (2*window + 1)/steps: {corrected:.3g} ({corrected / known:.2f})"
    )
    assert abs(time / known - expected) < 0.02 and abs(corrected / known - 1) < 0.04
PY
