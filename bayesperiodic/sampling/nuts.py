"""Sampling of θ and the noise parameters with nutpie's no-U-turn sampler, which uses the gradient."""

import time
import warnings
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from tqdm import tqdm

from bayesperiodic._parallel import Terminated
from bayesperiodic._printing import progress_bar
from bayesperiodic.density.log_posterior import SAMPLED, LogPosterior
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.problem.parameters import CHAIN, DRAW
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.chains import StoredChains
from bayesperiodic.sampling.convergence import PASSES, stop_rule
from bayesperiodic.sampling.draws import Posterior, gather
from bayesperiodic.sampling.proposals import AffineTransform, CallCount
from bayesperiodic.sampling.robust import add_robust
from bayesperiodic.sampling.starts import mode_of, sampling_axes, start_points

TUNE = 300
# Draws between checks of the stop rule.
DRAWS_BETWEEN_CHECKS = 250
PAUSE = 0.01
POSITION = "u"
# Statistics of nutpie by their names in ArviZ's schema.
STATISTICS = {
    "diverging": "diverging",
    "energy": "energy",
    "tree_depth": "depth",
    "n_steps": "n_steps",
    "step_size": "step_size",
    "acceptance_rate": "mean_tree_accept",
}


def refuse_for_nuts(walkers: int | None, variances: str, checkpoint: str | Path | None, executor: Any) -> None:
    """Raise a ValueError for arguments of `sample` that the no-U-turn sampler does not take."""
    for argument, value, default, hint in (
        ("walkers", walkers, None, "a chain has no walkers, so leave it out, and see ensembles"),
        ("variances", variances, SAMPLED, "integrated variances have no gradient, so sample them"),
        ("checkpoint", checkpoint, None, "its chains cannot be resumed, so leave it out"),
        ("executor", executor, None, "its chains run in threads of this process, so leave it out"),
    ):
        if value is not default and value != default:
            raise ValueError(f"{argument}: must be {default!r} with sampler='nuts', got {value!r}; {hint}.")


def sample_nuts(
    density: LogPosterior, fit: MapEstimate, seed: int, ensembles: int, max_steps: int, start: str, progress: bool
) -> Posterior:
    """Sample a density with independent chains of the no-U-turn sampler, each an ensemble of one walker.

    Start points and axes are those of emcee's walkers; the gradient of the density comes from a transposed solve. The
    chains run concurrently and are checked every 250 draws, so that the result depends on the seed alone, not on the
    progress of each chain. `Posterior.failures` are fractions of all points of all trajectories, tuning included.
    """
    nutpie = _nutpie()
    sequences = np.random.SeedSequence(seed).spawn(ensembles + 2)
    axes = sampling_axes(density, fit, start, np.random.default_rng(sequences[ensembles]))
    starts = start_points(density, fit, start, ensembles, np.random.default_rng(sequences[ensembles + 1]))
    run = _Chains(density, fit, axes)
    try:
        for u, sequence in zip(axes.whiten(starts), sequences, strict=False):
            chain_seed = int(sequence.generate_state(1, np.uint64)[0])
            run.chains.append(_Chain(nutpie, density, axes, u, chain_seed, max_steps))
        run.go(max_steps, progress)
    except BaseException:
        for chain in run.chains:
            with suppress(RuntimeError):  # of a chain that failed
                chain.sampler.cancel()
        raise
    return run.posterior(nutpie.__version__, seed)


def _nutpie() -> ModuleType:
    """Return the nutpie module, imported without the notice of ArviZ."""
    convergence.arviz()
    try:
        import nutpie
        import nutpie.compiled_pyfunc
    except ImportError as error:
        raise ImportError(
            f"sampler: 'nuts' needs the package nutpie, which cannot be imported ({error}). Install it with "
            'pip install "bayesperiodic[nuts]".'
        ) from error
    return nutpie


class _Chain:
    """One chain, which nutpie runs in a thread."""

    def __init__(
        self, nutpie: ModuleType, density: LogPosterior, axes: AffineTransform, u: np.ndarray, seed: int, most: int
    ):
        self.density, self.axes = density, axes
        self.draws: list[np.ndarray] = []
        self.calls = CallCount()
        self.accounts: list[CallCount] = []
        self.error: Exception | None = None
        model = nutpie.compiled_pyfunc.from_pyfunc(
            density.dimension,
            make_logp_fn=lambda: self._value_and_gradient,
            make_expand_fn=lambda *_: self._keep,
            expanded_dtypes=[np.dtype(float)],
            expanded_shapes=[(density.dimension,)],
            expanded_names=[POSITION],
            make_initial_point_fn=lambda _: np.ascontiguousarray(u),
        )
        self.sampler = nutpie.sample(
            model, chains=1, cores=1, tune=TUNE, draws=most + 1, seed=seed, progress_bar=False, blocking=False
        )

    def _value_and_gradient(self, u: np.ndarray) -> tuple[float, np.ndarray]:
        try:
            value, gradient, status = self.density.value_and_gradient(self.axes.unwhiten(u))
            self.calls.add(np.array([status]))
        except Exception as error:
            self.error = error
            raise
        return value, gradient @ self.axes.axes

    def _keep(self, u: np.ndarray) -> dict[str, np.ndarray]:
        """Keep a draw, and the count of calls so far."""
        self.accounts.append(CallCount() + self.calls)
        self.draws.append(np.array(u))
        return {POSITION: u}

    @property
    def done(self) -> int:
        """Number of draws since the end of tuning, without the last one, which nutpie may not have stored yet."""
        return max(0, len(self.draws) - TUNE - 1)

    def check(self) -> None:
        """Raise the error that ended the chain."""
        if self.error is not None:
            raise self.error
        with suppress(TimeoutError):  # raised by a running chain
            _ = self.sampler.is_finished


class _Chains:
    """The chains, their number of draws, and the result of the stop rule."""

    def __init__(self, density: LogPosterior, fit: MapEstimate, axes: AffineTransform):
        self.density, self.fit, self.axes = density, fit, axes
        self.chains: list[_Chain] = []
        self.steps, self.converged, self.reason = 0, False, ""

    def go(self, max_steps: int, progress: bool) -> None:
        """Wait until the stop rule is passed twice in succession, `max_steps` are reached, or Ctrl-C."""
        try:
            self._judge(max_steps, progress)
        except KeyboardInterrupt as interrupt:
            if isinstance(interrupt, Terminated):
                raise
            self.steps = min(chain.done for chain in self.chains)
            if self.steps < DRAWS_BETWEEN_CHECKS:
                raise
            self.reason = f"interrupted after {self.steps} draws"

    def _judge(self, max_steps: int, progress: bool) -> None:
        passes, tau = 0, np.empty(0)
        with progress_bar(total=max_steps, unit="draw", desc="sampling", disable=not progress) as bar:
            for steps in (*range(DRAWS_BETWEEN_CHECKS, max_steps, DRAWS_BETWEEN_CHECKS), max_steps):
                self._wait(steps, bar)
                self.steps, kept = steps, self.kept(steps)
                tau, missing = stop_rule(kept, mode_of(self.density, self.fit, kept), tau, self.density.labels)
                bar.set_postfix_str(f"tau {tau.max():.1f}, length {steps / tau.max():.0f} tau", refresh=False)
                passes = 0 if missing else passes + 1
                if passes >= PASSES:
                    self.converged = True
                    self.reason = f"stop rule passed after {steps} draws of {len(self.chains)} chains"
                    return
        left = ", ".join(missing) or "the stop rule passed only once"
        self.reason = f"max_steps = {max_steps} reached with {left}"

    def _wait(self, steps: int, bar: tqdm) -> None:
        """Wait until every chain has a number of draws."""
        while (done := min(chain.done for chain in self.chains)) < steps:
            bar.update(done - bar.n)
            for chain in self.chains:
                chain.check()
            time.sleep(PAUSE)
        bar.update(steps - bar.n)

    def kept(self, steps: int) -> np.ndarray:
        """Return the chains (chains, steps, 1, coordinates) without tuning."""
        walked = np.array([chain.draws[TUNE : TUNE + steps] for chain in self.chains])
        return self.axes.unwhiten(walked)[:, :, None, :]

    def posterior(self, version: str, seed: int) -> Posterior:
        """End the chains and return their draws with nutpie's statistics."""
        import xarray as xr

        statistics = [chain.sampler.abort()["sample_stats"] for chain in self.chains]
        stats = {
            ours: np.stack([np.asarray(one[theirs])[0, : self.steps] for one in statistics])
            for ours, theirs in STATISTICS.items()
        }
        log_density = np.stack([np.asarray(one["logp"])[0, : self.steps] for one in statistics])
        if diverged := int(stats["diverging"].sum()):
            lost = f"{diverged} of {log_density.size} trajectories diverged"
            self.reason += f", {lost}"
            warnings.warn(
                f"{lost}: they reached points where the log-posterior is not finite, such as the ends of a prior's "
                "support or failed solves, or its curvature is too large. The draws may miss a part of the posterior; "
                "compare them with those of sampler='emcee'.",
                stacklevel=5,
            )
        accounts = [chain.accounts[TUNE + self.steps - 1] for chain in self.chains]
        kept = self.kept(self.steps)
        result = gather(
            self.density,
            StoredChains.of(kept),
            log_density[:, :, None],
            sum(accounts, CallCount()),
            modes=mode_of(self.density, self.fit, kept),
            converged=self.converged,
            reason=self.reason,
            acceptance=float(stats["acceptance_rate"].mean()),
            seed=seed,
        )
        described = {name: ((CHAIN, DRAW), values) for name, values in stats.items()}
        result.tree["sample_stats"] = xr.DataTree(result.tree["sample_stats"].to_dataset().assign(described))
        result.tree.attrs["nutpie"] = version
        add_robust(result.tree, self.fit, len(result.modes))
        return result
