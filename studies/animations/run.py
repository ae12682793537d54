"""Two animations: Newton's method at an unstable orbit, which integration leaves, and an orbit found in chaos.

newton.gif: the iterates of Newton's method are whole periods and converge to an unstable periodic solution of the
Duffing oscillator; the distance of a time integration that starts on it grows by its Floquet multiplier each period.
section.gif: the section of the chaotic pendulum, an unstable orbit of period 3 that `find_orbits` finds in it, and the
points of the section that follow this orbit for a while.
"""

import argparse

from studies import common
from studies.animations import newton, section


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    paths = [options.out / "newton.gif", options.out / "section.gif"]
    with watch.part("newton", "Newton's method and time integration at an unstable orbit"):
        first = newton.make(paths[0], quick=options.quick)
    print(
        f"  largest residual {first['residuals_n'][0]:.1f} N to {first['residuals_n'][-1]:.0e} N in "
        f"{len(first['residuals_n']) - 1} iterations; the integration departs by a factor of "
        f"{first['growth_per_period']:.2f} a period, Floquet multiplier {first['multiplier']:.2f}"
    )
    with watch.part("section", "an orbit in a chaotic section"):
        second = section.make(paths[1], options.seed, quick=options.quick)
    print(
        f"  {second['points']} points, {second['passages']} of them near the first point of an orbit of period "
        f"{second['period']} with multiplier {second['multiplier']:.1f}"
    )
    results = {"newton": first, "section": second, "seed": options.seed, "quick": options.quick}
    common.finish(options.out, results, watch, paths, synthetic=True)
