#!/usr/bin/env bash
# corner 2.3.0: a truth that is marked in a plot of one quantity raises a TypeError that names neither the truth nor the
# shape, and two quantiles, which are enough for the lines, are refused as soon as titles are shown.
#
# Seen with corner 2.3.0, matplotlib 3.11.2, numpy 2.4.6:
#     one quantity, no truth: 1 panel
#     one quantity, truth: TypeError: 'Axes' object is not subscriptable
#     two quantities, truths: 4 panels
#     two quantiles, titles: ValueError: 'title_quantiles' must contain exactly three values; ...
#
# Where users meet it: a corner plot of a posterior with one parameter and its true value.
# What the package does: `bp.plot.corner` with `style="corner"` draws the line of the truth, and the titles, itself.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q corner==2.3.0 matplotlib==3.11.2 numpy==2.4.6
cd "$folder"
MPLBACKEND=agg venv/bin/python - <<'PY'
import corner
import numpy as np

print("corner", corner.__version__)
draws = np.random.default_rng(1).standard_normal((2000, 2))


def outcome(columns, **options):
    """Return the number of panels, or the error."""
    try:
        return f"{len(corner.corner(draws[:, :columns], **options).axes)} panels"
    except (TypeError, ValueError) as error:
        return f"{type(error).__name__}: {error}"


seen = {
    "one quantity, no truth": outcome(1),
    "one quantity, truth": outcome(1, truths=[0.0]),
    "two quantities, truths": outcome(2, truths=[0.0, 0.0]),
    "two quantiles, titles": outcome(2, quantiles=[0.05, 0.95], show_titles=True),
}
for case, result in seen.items():
    print(f"{case}: {result}")
assert seen["one quantity, no truth"] == "1 panels" and seen["two quantities, truths"] == "4 panels"
assert seen["one quantity, truth"] == "TypeError: 'Axes' object is not subscriptable"
assert seen["two quantiles, titles"].startswith("ValueError: 'title_quantiles' must contain exactly three values")
PY
