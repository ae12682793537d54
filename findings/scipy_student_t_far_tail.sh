#!/usr/bin/env bash
# SciPy 1.17.1: quantiles of Student's t far in the lower tail are wrong without a word. `scipy.special.stdtrit`, and with
# it `scipy.stats.t.ppf`, return half of the quantile of 3 degrees of freedom from 1e-163 on, 3/7 of that of 2.5 from
# 1e-136 on, and plus infinity, the other end of the line, for 2.5, 3, 5 and 10 at 1e-300. The inverse of the incomplete
# beta function, from which the quantile follows as well, is right there: its quantiles have the probability asked for.
#
# Seen with scipy 1.17.1, numpy 2.4.6 (the probability of the quantile over that asked for):
#     2.5 degrees of freedom: 1e-100 1.000  1e-200 8.317  1e-300 at +inf; by betaincinv 1.000 1.000 1.000
#     3.0 degrees of freedom: 1e-100 1.000  1e-200 8.000  1e-300 at +inf; by betaincinv 1.000 1.000 1.000
#     5.0 degrees of freedom: 1e-100 1.000  1e-200 1.000  1e-300 at +inf; by betaincinv 1.000 1.000 1.000
#     t.ppf the same: True
#
# Where users meet it: maps from normal scores to heavy-tailed priors, Φ(-31) = 5e-211, as in samplers that work with
# standard normal coordinates.
# What the package does: `StudentT.quantile` takes the first term of the tail.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q scipy==1.17.1 numpy==2.4.6
cd "$folder"
venv/bin/python - <<'PY'
import numpy as np
import scipy
from scipy import special, stats

print("scipy", scipy.__version__)
probabilities = (1e-100, 1e-200, 1e-300)
for freedom, wrong in ((2.5, 8.2), (3.0, 8.0), (5.0, 1.0)):
    quantiles = [float(special.stdtrit(freedom, p)) for p in probabilities]
    shares = [special.betaincinv(freedom / 2, 0.5, 2 * p) for p in probabilities]
    right = [float(-np.sqrt(freedom * (1 - x) / x)) for x in shares]
    ratios = [float(special.stdtr(freedom, t)) / p for t, p in zip(quantiles, probabilities)]
    checked = [float(special.stdtr(freedom, t)) / p for t, p in zip(right, probabilities)]
    print(
        f"{freedom} degrees of freedom: 1e-100 {ratios[0]:.3f}  1e-200 {ratios[1]:.3f}  1e-300 at {quantiles[2]:+}; "
        "by betaincinv " + " ".join(f"{ratio:.3f}" for ratio in checked)
    )
    assert np.allclose(checked, 1.0, rtol=1e-9)
    assert abs(ratios[0] - 1) < 1e-9 and abs(ratios[1] / wrong - 1) < 0.05 and quantiles[2] == np.inf
same = all(
    stats.t.ppf(p, freedom) == special.stdtrit(freedom, p) for freedom in (2.5, 3.0, 5.0) for p in probabilities
)
print("t.ppf the same:", same)
assert same
PY
