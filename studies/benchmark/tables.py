"""The benchmark's results as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def problem(name: str, found: Mapping[str, Any]) -> str:
    """Return the contenders of one problem."""
    kind = "SYNTHETIC data" if found["synthetic"] else "measured data"
    experiments = "1 experiment" if found["experiments"] == 1 else f"{found['experiments']} experiments"
    lines = [
        f"{name} ({kind}, {experiments}, {found['samples']} samples; |Δ log-posterior| ≤ {found['allowed']:g} at "
        f"{found['draws']} draws, reference uncertain by {found['reference_uncertainty']:.0e})",
        f"  {'contender':52s}{'ms':>10s}{'/ warm (least … largest)':>34s}{'error':>9s}  settings",
    ]
    return "\n".join([*lines, *(_row(entry) for entry in found["rows"])])


def _row(entry: Mapping[str, Any]) -> str:
    error = "-" if entry["error"] is None else f"{entry['error']:.0e}"
    time = "-" if entry["milliseconds"] is None else f"{entry['milliseconds']['median']:.3g}"
    return f"  {entry['name']:52s}{time:>10s}{between(entry['ratio']):>34s}{error:>9s}  {entry['note']}"


def between(values: Mapping[str, float] | None) -> str:
    """Return a median with its range."""
    return "-" if values is None else f"{values['median']:.3g} ({values['least']:.3g} … {values['largest']:.3g})"


def posterior(found: Mapping[str, Any]) -> str:
    """Return samplers, and emcee around the contenders."""
    lines = ["Effective samples a second, Duffing (SYNTHETIC data), the smallest of any parameter"]
    for name, entry in found["samplers"].items():
        value = f"{entry['ess_per_second']:.3g}" if "ess_per_second" in entry else "-"
        lines.append(f"  {name:60s}{value:>10s}  {entry.get('note', '')}")
    lines.append(f"  {found['split']['best']} over emcee around:  ratio = sampler × solver")
    for name, entry in found["split"]["against"].items():
        lines.append(f"    {name:58s}{entry['ratio']:>10.3g} = {entry['sampler']:.3g} × {entry['solver']:.3g}")
    return "\n".join(lines)


def floor(name: str, found: Mapping[str, Any]) -> str:
    """Return floor and stages of one problem."""
    lines = [f"{name}: the floor, and what a warm log-posterior takes on one core [µs]"]
    for scheme, entry in found["schemes"].items():
        parts = ", ".join(f"{part} {value['median']:.0f}" for part, value in entry["floor_us"].items() if part != "sum")
        stages = ", ".join(f"{stage} {value:.0f}" for stage, value in entry["stages_us"].items())
        lines.append(f"  {scheme}: floor {entry['floor_us']['sum']['median']:.0f} ({parts})")
        lines.append(f"    stages: {stages}")
        ratios = "; ".join(f"{what} {between(value)}" for what, value in entry["ratio"].items())
        lines.append(f"    over the floor: {ratios}")
    lines.append(
        f"  memory {between(found['bandwidth_gb_per_s'])} GB/s on one core; emcee itself {between(found['emcee_us'])} "
        "µs a log-posterior"
    )
    return "\n".join(lines)
