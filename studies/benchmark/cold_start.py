"""How long a newcomer waits: installation, import, first results, and the README's two commands, in new environments.

Each measurement is a process of its own. "Empty" is a run with an empty kernel cache, "full" one with what an empty run
left. Other packages are installed into environments of their own, and evaluate for the first time the log-posterior of
a Duffing oscillator, integrated in time; here its first evaluation solves for the periodic state.
"""

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from studies import common
from studies.benchmark import large

ROOT = Path(__file__).parents[2]
FILE = "cold_start.json"
REPEATS, QUICK_REPEATS = 3, 1
# Targets [s].
TARGETS = {
    "first command, empty cache": 60.0,
    "first command, full cache": 35.0,
    "tests, empty cache": 240.0,
    "tests, full cache": 180.0,
    "first solve, empty cache": 5.0,
    "new model's first solve": 1.5,
    "new model's first MAP": 3.0,
    f"fold, {large.FOLD_TARGET[0]:,}": large.FOLD_TARGET[1],
    f"orbits, {large.ORBIT_TARGET[0]:,}": large.ORBIT_TARGET[1],
}
# What the first command took before its cost was to be halved and after, and folding of the largest recording of
# `large`: each measured side by side on one machine, whose speed is that of ten million additions, see `additions`.
COMPARED = {
    "first command": {
        "processor s": {"before": {"empty": 127.7, "full": 93.5}, "after": {"empty": 76.9, "full": 52.0}},
        "target ratio": 0.5,
    },
    "fold": {"GB": {"before": 0.89, "after": 0.53}, "target GB": large.FOLD_TARGET[2]},
    "ten million additions [s]": 0.18,
}
ADDITIONS = 10_000_000
DATA = """
import json, time
start = time.perf_counter()
seconds = {}
def passed(stage):
    global start
    seconds[stage] = time.perf_counter() - start
    start = time.perf_counter()
"""
OURS = (
    DATA
    + """
import numpy as np
import bayesperiodic as bp
bp.models.duffing
passed("import")
force = {"force": np.cos(2 * np.pi * np.arange(64) / 64)}
true = {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}
solution = bp.solve_periodic(MODEL, true, force, frequency=0.1, samples=64)
passed("first solve")
noise = 0.01 * np.random.default_rng(1).standard_normal(64)
measured = {name: values + noise for name, values in solution.outputs.items()}
experiment = bp.Experiment(name="run", frequency=0.1, inputs=force, outputs=measured, samples=64)
priors = {name: bp.LogNormal(value, 1.0) for name, value in true.items() if name != "m"}
problem = bp.Problem(MODEL, [experiment], priors=priors, fixed={"m": 1.0})
fit = bp.map_estimate(problem)
passed("first MAP")
bp.sample(problem, fit, seed=1, ensembles=2, max_steps=100, progress=False)
passed("first draws")
print(json.dumps(seconds))
"""
)
# A model that the cache does not know: its number makes its expression new.
NEW = """bp.Model(
    "new", states=["x"], inputs=["force"], parameters=["m", "c", "k", "k3"],
    equations=["m*ddx + c*dx + k*x + k3*x**3 + NUMBER*x**5 - force"], outputs={"displacement": "x"},
)"""
PEERS = {
    "PyMC": ("pymc", DATA + """
import numpy as np, pymc as pm
from pymc.ode import DifferentialEquation
passed("import")
t = np.linspace(0.0, 100.0, 641)[1:]
def rates(y, t, p):
    return [y[1], pm.math.cos(0.2 * np.pi * t) - p[0] * y[1] - p[1] * y[0] - p[2] * y[0] ** 3]
ode = DifferentialEquation(func=rates, times=t, n_states=2, n_theta=3, t0=0.0)
with pm.Model() as model:
    p = [pm.LogNormal(n, mu=0.0, sigma=1.0) for n in ("c", "k", "k3")]
    sd = pm.HalfNormal("sd", 1.0)
    pm.Normal("y", mu=ode(y0=[0.0, 0.0], theta=p)[-64:, 0], sigma=sd, observed=np.cos(0.2 * np.pi * t[-64:]))
model.compile_logp()(model.initial_point())
passed("first posterior evaluation")
print(json.dumps(seconds))
"""),
    "PINTS": ("pints", DATA + """
import numpy as np, pints
from scipy.integrate import odeint
passed("import")
t = np.linspace(0.0, 100.0, 641)[1:]
class Duffing(pints.ForwardModel):
    def n_parameters(self):
        return 3
    def simulate(self, p, times):
        rates = lambda y, t: [y[1], np.cos(0.2 * np.pi * t) - p[0] * y[1] - p[1] * y[0] - p[2] * y[0] ** 3]
        return odeint(rates, [0.0, 0.0], np.append(0.0, t))[-64:, 0]
problem = pints.SingleOutputProblem(Duffing(), t[-64:], np.cos(0.2 * np.pi * t[-64:]))
prior = pints.ComposedLogPrior(*[pints.LogNormalLogPrior(0.0, 1.0)] * 3, pints.HalfCauchyLogPrior(0.0, 1.0))
pints.LogPosterior(pints.GaussianLogLikelihood(problem), prior)([0.2, 1.0, 0.5, 0.1])
passed("first posterior evaluation")
print(json.dumps(seconds))
"""),
    "diffrax": ("diffrax", DATA + """
import jax, jax.numpy as jnp, diffrax
jax.config.update("jax_enable_x64", True)
passed("import")
t = jnp.linspace(0.0, 100.0, 641)[1:]
def rates(t, y, p):
    return jnp.array([y[1], jnp.cos(0.2 * jnp.pi * t) - p[0] * y[1] - p[1] * y[0] - p[2] * y[0] ** 3])
def log_posterior(q):
    p, sd = jnp.exp(q[:3]), jnp.exp(q[3])
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(rates), diffrax.Tsit5(), 0.0, 100.0, 0.01, jnp.zeros(2), p,
        saveat=diffrax.SaveAt(ts=t[-64:]), stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-8),
        max_steps=100000,
    )
    residual = (found.ys[:, 0] - jnp.cos(0.2 * jnp.pi * t[-64:])) / sd
    return -0.5 * jnp.sum(residual**2) - 64 * q[3] - 0.5 * jnp.sum(q**2)
jax.jit(log_posterior)(jnp.zeros(4)).block_until_ready()
passed("first posterior evaluation")
print(json.dumps(seconds))
"""),
}  # fmt: skip


def run(options: argparse.Namespace) -> None:
    """Measure in new environments and write cold_start.json."""
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # which a newcomer does not have
    watch, repeats = common.Stopwatch(), QUICK_REPEATS if options.quick else REPEATS
    found: dict[str, Any] = {"cores": len(os.sched_getaffinity(0)), "python": platform.python_version()}
    found["load_average_before"] = [*os.getloadavg()]
    found |= {"ten million additions [s]": additions(), "compared": COMPARED}
    folder = Path(tempfile.mkdtemp(prefix="cold-start-"))
    try:
        # First, because the tests compare the numbers of the documentation with the stored results.
        if not options.quick:
            with watch.part("tests", "the README's second command"):
                tester, found["installation_of_tests"] = _environment(folder / "tests", ["-e", f"{ROOT}[dev]"])
                found["tests"] = _both_ways([str(tester), "-m", "pytest", "-q"], folder, 1)
        with watch.part("installation", "installing into a new environment"):
            python, found["installation"] = _environment(folder / "ours", [str(ROOT)])
        with watch.part("first results", f"first results, {repeats} times with an empty cache and with a full one"):
            found["first_results"] = _first_results(python, folder, repeats)
        with watch.part("commands", f"the README's first command, {repeats} times each way"):
            command = [str(python), "-m", "studies", "pendulum", "--out", str(folder / "figures")]
            found["first_command"] = _both_ways(command, folder, repeats)
        found["peers"] = {}
        for name, (package, code) in PEERS.items():
            with watch.part(name, f"installing {name}, and its first evaluation of a posterior, {repeats} times"):
                found["peers"][name] = _peer(folder / package, package, code, repeats)
        with watch.part("large", "folding long recordings, and orbits in large sections"):
            found["large"] = large.measure(quick=options.quick)
        paths = common.save_figures(options.out, {"large": large.draw(found["large"])})
        print(f"figures (synthetic data): {paths[0]}")
        _write(options.out / FILE, found, watch)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def additions() -> float:
    """Return the processor seconds of ten million additions in a loop of pure Python: the speed of the machine."""
    begin, total = time.process_time(), 0
    for _ in range(ADDITIONS):
        total += 1
    return time.process_time() - begin


def _write(path: Path, found: dict[str, Any], watch: common.Stopwatch) -> None:
    """Print and write what was measured so far."""
    found["targets"] = _targets(found)
    print(common.table_of_rows(found["targets"]))
    print(common.shown("other packages", found["peers"]))
    path.write_text(json.dumps(found | {"seconds": watch.total(), "versions": common.versions()}, indent=2) + "\n")
    print(f"results: {path}")


def _environment(folder: Path, packages: list[str]) -> tuple[Path, dict[str, Any]]:
    """Return the Python of a new environment with packages, and what the installation took."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    python = folder / "bin" / "python"
    subprocess.run([str(python), "-m", "pip", "install", "-q", *packages], check=True)
    seconds = time.perf_counter() - begin
    site = next(folder.glob("lib/python*/site-packages"))
    size = sum(path.stat().st_size for path in site.rglob("*") if path.is_file() and not path.is_symlink())
    return python, {"s": seconds, "MB": size / 1e6, "packages": len(list(site.glob("*.dist-info")))}


def _timed(command: list[str], cache: Path) -> tuple[float, float, str]:
    """Return the seconds and processor seconds of a command with a kernel cache, and what it printed."""
    begin, before = time.perf_counter(), _of_processes()
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"BAYESPERIODIC_CACHE": str(cache)}, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[:4])} ended with {done.returncode}: {done.stderr[-2000:]}")
    return time.perf_counter() - begin, _of_processes() - before, done.stdout


def _of_processes() -> float:
    """Return the processor seconds of all processes that this one has started and that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def _both_ways(command: list[str], folder: Path, repeats: int) -> dict[str, list[float]]:
    """Return seconds and processor seconds of a command with an empty kernel cache, and again with what it left."""
    seconds: dict[str, list[float]] = {"empty": [], "full": [], "empty, processor": [], "full, processor": []}
    for number in range(repeats):
        cache = folder / f"cache-{len(list(folder.iterdir()))}-{number}"
        for way in ("empty", "full"):
            wall, processor, _ = _timed(command, cache)
            seconds[way].append(wall)
            seconds[f"{way}, processor"].append(processor)
    return seconds


def _first_results(python: Path, folder: Path, repeats: int) -> dict[str, dict[str, float]]:
    """Return the median seconds of import, first solve, MAP and draws: empty cache, full cache, and new model."""
    measured: dict[str, list[dict[str, float]]] = {"empty": [], "full": [], "new model": []}
    for number in range(repeats):
        cache = folder / f"first-{number}"
        known = OURS.replace("MODEL", "bp.models.duffing")
        new = OURS.replace("MODEL", NEW.replace("NUMBER", f"0.00{number + 1}"))
        for kind, code in zip(measured, (known, known, new), strict=True):
            measured[kind].append(json.loads(_timed([str(python), "-c", code], cache)[-1].splitlines()[-1]))
    return {kind: _medians(rows) for kind, rows in measured.items()}


def _peer(folder: Path, package: str, code: str, repeats: int) -> dict[str, Any]:
    """Return what the installation of a package took, and the seconds of its first steps; an error as text."""
    try:
        python, installed = _environment(folder, [package])
        rows = [json.loads(_timed([str(python), "-c", code], folder)[-1].splitlines()[-1]) for _ in range(repeats)]
    except (subprocess.CalledProcessError, RuntimeError, ValueError) as error:
        return {"error": re.sub(r"\s+", " ", str(error))[-300:]}
    return {f"installation {key}": value for key, value in installed.items()} | _medians(rows)


def _medians(rows: list[dict[str, float]]) -> dict[str, float]:
    return {stage: median(row[stage] for row in rows) for stage in rows[0]}


def _targets(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return each target with its measured value."""
    first = found["first_results"]
    values = {
        "first command, empty cache": median(found["first_command"]["empty"]),
        "first command, full cache": median(found["first_command"]["full"]),
        "first solve, empty cache": first["empty"]["import"] + first["empty"]["first solve"],
        "new model's first solve": first["new model"]["first solve"],
        "new model's first MAP": first["new model"]["first MAP"],
    }
    for what in ("fold", "orbits"):
        sizes = dict(zip(found["large"][what]["sizes"], found["large"][what]["s"], strict=True))
        values |= {name: sizes[n] for n in sizes if (name := f"{what}, {n:,}") in TARGETS}
    if "tests" in found:
        values |= {f"tests, {way} cache": found["tests"][way][0] for way in ("empty", "full")}
    return [common.row(f"{what} [s]", value, 0.0, TARGETS[what]) for what, value in values.items()]
