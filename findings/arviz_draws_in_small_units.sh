#!/usr/bin/env bash
# ArviZ 0.23.4: draws that lie within 1e-15 of each other are taken for constant in some statistics and not in others,
# whatever their unit is. Of the same chains in units so small, `ess(method="mean")` becomes the number of all draws, and
# the Monte Carlo error of the mean, also in `summary`, is that of independent draws; "bulk" and R-hat, which take ranks,
# are as before.
#
# Seen with arviz 0.23.4, numpy 2.3.5 (4 chains of 500 draws, correlated by 0.95 from one to the next; the error in units
# of that times 1):
#     times 1e-12: ess mean 30.2 bulk 30.6  error 0.5997 in summary 0.5997
#     times 1e-16: ess mean 30.2 bulk 30.6  error 0.5997 in summary 0.5997
#     times 1e-17: ess mean 2000.0 bulk 30.6  error 0.0737 in summary 0.0737
#
# Where users meet it: parameters of small systems in SI units, as masses of resonators in kg, charges in C and
# capacitances of junctions in F: the stated error of the posterior mean is eight times too small here.
# What the package does: `Posterior.summary` divides draws by their standard deviation before ArviZ has them.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q arviz==0.23.4 numpy==2.3.5 scipy==1.16.3 xarray==2025.12.0 pandas==2.3.3
cd "$folder"
venv/bin/python - <<'PY'
import warnings

import numpy as np

warnings.filterwarnings("ignore", category=FutureWarning)
import arviz as az

print("arviz", az.__version__)
steps = np.random.default_rng(1).normal(size=(4, 500))
chains = steps.copy()
for i in range(1, chains.shape[1]):
    chains[:, i] = 0.95 * chains[:, i - 1] + steps[:, i]
for scale, wrong in ((1e-12, False), (1e-16, False), (1e-17, True)):
    data = az.convert_to_dataset({"x": scale * chains})
    mean, bulk = (float(az.ess(data, method=method)["x"]) for method in ("mean", "bulk"))
    error = float(az.mcse(data, method="mean")["x"]) / scale
    table = float(az.summary(data, kind="diagnostics", round_to="none")["mcse_mean"].iloc[0]) / scale
    print(f"times {scale:.0e}: ess mean {mean:.1f} bulk {bulk:.1f}  error {error:.4f} in summary {table:.4f}")
    assert abs(bulk - 30.6) < 0.1 and abs(table - error) < 1e-3 * error
    assert (mean == chains.size and error < 0.08) if wrong else (abs(mean - 30.2) < 0.1 and error > 0.59)
PY
