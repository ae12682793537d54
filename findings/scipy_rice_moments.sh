#!/usr/bin/env bash
# SciPy 1.17.1: mean and variance of the distribution of Rice are infinite for true amplitudes of 37.6 standard
# deviations and NaN from 40 on. They are computed as a product of `exp(-b^2/2)` and a confluent hypergeometric
# function, one of which underflows while the other overflows. The median, random numbers and the density are right
# there; the mean is `b + 1/(2b)` and the variance 1 to a thousandth.
#
# Seen with scipy 1.17.1, numpy 2.4.6:
#     b = 30.0: mean 30.0167, variance 0.9994, median 30.0167
#     b = 37.6: mean inf, variance inf, median 37.6133
#     b = 40.0: mean nan, variance nan, median 40.0125
#
# Where users meet it: expected values of measured amplitudes (lock-in amplifiers, frequency response functions) with
# errors of two per cent and less.
# What the package does: `measurements.Amplitude` takes logarithms of the density with a scaled Bessel function, and
# replicates by quantiles of the noncentral chi-square distribution, or by the normal limit.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q scipy==1.17.1 numpy==2.4.6
cd "$folder"
venv/bin/python -W ignore - <<'PY'
import numpy as np
import scipy
from scipy import stats

print("scipy", scipy.__version__)
for b in (30.0, 37.6, 40.0):
    mean, variance = (float(m) for m in stats.rice.stats(b, moments="mv"))
    median = float(stats.rice.median(b))
    print(f"b = {b}: mean {mean:.6g}, variance {variance:.4g}, median {median:.6g}")
    drawn = stats.rice.rvs(b, size=200_000, random_state=1)
    assert abs(drawn.mean() - b - 0.5 / b) < 0.01 and abs(median - b - 0.5 / b) < 1e-3
    assert np.isfinite(stats.rice.logpdf(b, b))
    expected = {30.0: np.isfinite, 37.6: np.isinf, 40.0: np.isnan}[b]
    assert expected(mean) and expected(variance)
PY
