"""Coverage of intervals where time itself is uncertain: frequencies with an error, phases that wander.

``--replicates N`` records each case N times (default 200). A z is the deviation of an estimate from the truth in units
of its standard deviation.
"""

import argparse

from scipy import stats

from studies import common
from studies.clocks import frequency, loggers, sampling

REPLICATES, QUICK, FALSE_ALARM = 200, 3, 0.01
# Each part has tasks, replicate, source, summary, checks, table and draw.
PARTS = {"frequency": frequency}


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch, count = common.Stopwatch(), QUICK if options.quick else options.replicates or REPLICATES
    # A share of `count` data sets, with the probability of the nominal one to lie outside by chance.
    low, high = stats.binom.interval(1.0 - FALSE_ALARM, count, frequency.COVERED)
    band = float(low) / count, float(high) / count
    found, figures, checks = {}, {}, []
    for name, part in PARTS.items():
        tasks = part.tasks(count, options.seed)
        with watch.part(name, f"estimates from {len(tasks)} recordings"):
            lines = common.resumed(
                options.out / "parts" / f"{name}.jsonl",
                tasks,
                part.replicate,
                lambda line: (line["case"], line["number"], line["seed"]),
                part.source(),
            )
        found[name] = part.summary(lines)
        figures[name] = part.draw(found[name], band)
        checks += part.checks(found[name], band)
        print("\n" + part.table(found[name]))
    with watch.part("sampling", "gaps, missing samples, slow sampling"):
        checks += sampling.coverage(count)
    with watch.part("loggers", "two clocks, lost samples, two rates"):
        found |= {"loggers": loggers.loggers(options.seed, count), "rates": loggers.rates(options.seed, count)}
        one_clock = found["loggers"]["0 ppm"]
        alone = one_clock.get("silent", 0) / sum(one_clock.values())
        checks.append(common.row("one clock: recordings without an alarm", alone, 0.99, None))
        checks.append(
            common.row("two rates: 90 % intervals of c that contain it", found["rates"]["coverage of c"], *band)
        )
    with watch.part("figures", "drawing"):
        paths = common.save_figures(options.out, figures)
    print("\n" + common.table_of_rows(checks) + "\n")
    results = {"replicates": count, "seed": options.seed, "band": list(band), "checks": checks} | found
    common.finish(options.out, results, watch, paths, synthetic=True)
