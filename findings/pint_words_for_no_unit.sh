#!/usr/bin/env bash
# pint 0.25.3: words that programs write in a row of units where a channel has none are units: N/A is newton per ampere,
# "na" a nanoyear, the German "k.A." (no statement) ampere times Boltzmann's constant, "EU" (engineering units) an
# exaenzyme unit, "pk" (peak) a volume and "pp" (peak to peak) a length of 0.35 mm.
#
# Seen with pint 0.25.3:
#     N/A: newton / ampere
#     na: nanoyear
#     k.A.: ampere * boltzmann_constant
#     EU: exaenzyme_unit
#     pk: peck
#     pp: point
#
# Where users meet it: rows of units in CSV and Excel files.
# What the package does: `Recording.from_file` converts only units on a list and asks for the others, and takes a row of
# nothing but N/A below the names for a first sample that is missing.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q pint==0.25.3
cd "$folder"
venv/bin/python - <<'PY'
import logging

import pint

logging.getLogger("pint").setLevel(logging.ERROR)
print("pint", pint.__version__)
registry = pint.UnitRegistry()
wanted = {
    "N/A": "newton / ampere",
    "na": "nanoyear",
    "k.A.": "ampere * boltzmann_constant",
    "EU": "exaenzyme_unit",
    "pk": "peck",
    "pp": "point",
}
for word, unit in wanted.items():
    seen = str(registry.parse_units(word))
    print(f"{word}: {seen}")
    assert seen == unit
print(f"1 pp is {registry.Quantity(1, 'pp').to('mm').magnitude:.4f} mm")
assert abs(registry.Quantity(1, "pp").to("mm").magnitude - 25.4 / 72) < 1e-3
PY
