"""Sampling of θ and the noise parameters with emcee."""

from collections import Counter
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic._parallel import TaskPool, WorkersLost, checked_executor, interrupted_by_termination
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.posterior.density import (
    COLLAPSED,
    NATURAL,
    RIDGE,
    SAMPLED,
    LogPosterior,
    SamplingCoordinates,
    collapsible,
)
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.posterior.simulator import Simulator
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.checkpoint import Checkpoint, Saved
from bayesperiodic.sampling.convergence import BLOCK, PASSES, unmet_criteria
from bayesperiodic.sampling.ensemble import (
    AffineTransform,
    CallCount,
    ChainSegment,
    Ensemble,
    LockstepPool,
    SamplingTarget,
    advance,
)
from bayesperiodic.sampling.nuts import refuse_for_nuts, sample_nuts
from bayesperiodic.sampling.posterior import Posterior, gather
from bayesperiodic.sampling.starts import LAPLACE, STARTS, sampling_axes, start_points

EMCEE, NUTS = "emcee", "nuts"
FEWEST_STEPS = 50


@in_one_thread
def sample(
    problem: Problem,
    fit: MapEstimate,
    *,
    seed: int,
    ensembles: int = 4,
    walkers: int | None = None,
    max_steps: int = 20_000,
    start: str = LAPLACE,
    coordinates: str = RIDGE,
    variances: str = SAMPLED,
    sampler: str = EMCEE,
    checkpoint: str | Path | None = None,
    executor: Any = None,
    progress: bool = True,
) -> Posterior:
    """Sample the posterior of θ and the free noise parameters with emcee's affine-invariant ensembles.

    Several independent ensembles [1]_ start from draws of the Laplace approximation with doubled standard deviations,
    at every optimum of `MapEstimate.modes` in proportion to its mass. Parameters with positive support and the noise
    parameters are sampled in their logarithms, where ridges of products are straight; Jeffreys' prior 1/v is constant
    there. The eigenvectors of the Laplace approximation in these coordinates are the axes. Seven steps in ten are
    differential-evolution moves [2]_, which mix three times faster than stretch moves on a normal target of six
    dimensions (tau 21 against 67), two are stretch moves, and one is a differential-evolution move of full length,
    which can jump between modes.

    Sampling stops if, twice in succession, the chain is 50 autocorrelation times long after its first fifth was
    removed, that time has changed by less than 5 %, R-hat between the ensembles is at most 1.005 and their 5, 50 and 95
    % quantiles agree within a quarter of a standard deviation. Ctrl-C, SIGTERM or the loss of the executor's workers
    ends it with the steps so far, not converged.

    ``sampler="nuts"`` checks the result: it samples the same density by its gradient, with the no-U-turn sampler [3]_
    of nutpie. Each ensemble is then a single chain with 300 tuning draws, which are removed, and must be 500
    autocorrelation times long; start, axes, Ctrl-C and the rest of the stop rule are the same.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
        Anchor of the periodic solves, and start of the walkers.
    seed : int
        The same seed gives the same draws, bit for bit, for all executors and numbers of threads.
    ensembles : int
        At least 2; also the largest number of busy workers of an executor.
    walkers : int, optional
        Of each ensemble, even and at least twice the number of coordinates.
    max_steps : int
        A run that reaches it has not converged.
    start : "laplace", "prior" or "overdispersed"
        Draws of the Laplace approximation with twice its standard deviations, of the priors, or of the Laplace
        approximation with five times its standard deviations.
    coordinates : "ridge" or "natural"
        "natural" takes no logarithms of parameters.
    variances : "sampled" or "collapsed"
        "collapsed" integrates the unknown variances out and draws them exactly afterwards: the same posterior in fewer
        dimensions. Only with the prior 1/v or a flat one, for independent errors or circulant ones with fixed length
        scale and floor.
    sampler : "emcee" or "nuts"
        "nuts" requires ``pip install "bayesperiodic[nuts]"`` and takes no walkers, checkpoint, executor or collapsed
        variances; `max_steps` does not include its tuning, `acceptance` is that of its trajectories, and
        ``sample_stats`` contains its statistics. Diverged trajectories are counted in `reason`.
    checkpoint : path, optional
        An HDF5 file that contains the run so far at any time; after an interruption the same call resumes the run, also
        with another executor, and returns at once if it is finished. It can be read by emcee's HDFBackend, in
        coordinates in which the Laplace approximation is a standard normal distribution.
    executor : None, int, Dask Client, or executor with the interface of concurrent.futures
        Executor that advances the ensembles. By default all ensembles advance in this process, with their proposals
        solved together on all cores, which is fastest on one machine. A number is a number of processes; a script needs
        its calls below ``if __name__ == "__main__":``. ``mpi4py.futures.MPIPoolExecutor`` and Dask use the nodes of a
        cluster, with processors of the same kind, because others may round differently. Each worker uses one core.
    progress : bool
        Show a progress bar with acceptance, tau and length in units of tau.

    Returns
    -------
    Posterior

    Raises
    ------
    ValueError
        For too few or an odd number of walkers, a start without a finite log-posterior, variances that cannot be
        integrated out, a checkpoint that is damaged, in use or of another problem, an invalid executor, an argument
        that "nuts" does not take.
    OSError
        If the checkpoint cannot be written, as on a full disk; an earlier one is intact.
    RuntimeError
        If the executor's workers were lost after fewer than 50 steps; the checkpoint contains these.
    ImportError
        For "nuts" without nutpie.

    Warns
    -----
    UserWarning
        If trajectories of "nuts" diverged.

    References
    ----------
    .. [1] D. Foreman-Mackey, D. W. Hogg, D. Lang, J. Goodman, emcee: the MCMC hammer, PASP 125 (2013) 306-312.
    .. [2] C. J. F. ter Braak, A Markov chain Monte Carlo version of the genetic algorithm differential evolution,
       Statistics and Computing 16 (2006) 239-249.
    .. [3] M. D. Hoffman, A. Gelman, The no-U-turn sampler: adaptively setting path lengths in Hamiltonian Monte Carlo,
       Journal of Machine Learning Research 15 (2014) 1593-1623.

    Examples
    --------
    >>> draws = bp.sample(problem, fit, seed=1, ensembles=2, walkers=8, max_steps=250, progress=False)
    >>> draws.reason.split(" with ")[0], draws.failures
    ('max_steps = 250 reached', {})
    """
    _checks.instance("problem", problem, Problem)
    _checks.integer("ensembles", ensembles, 2)
    _checks.integer("max_steps", max_steps, BLOCK)
    _checks.integer("seed", seed, 0)
    _checks.one_of("start", start, STARTS)
    _checks.one_of("coordinates", coordinates, (RIDGE, NATURAL))
    _checks.one_of("variances", variances, (SAMPLED, COLLAPSED))
    _checks.one_of("sampler", sampler, (EMCEE, NUTS))
    if not isinstance(fit, MapEstimate):
        raise ValueError(f"fit: must be a MapEstimate, got {type(fit).__name__}; give map_estimate(problem).")
    _checks.same_names("fit", fit.theta, problem.names)
    _checks.same_names("fit", fit.noise, problem.noise_names)
    runs = [e.name for e in problem.experiments]
    _checks.contains("fit", fit.solutions, runs, "give the estimate of this problem, map_estimate(problem)")
    executor = checked_executor(executor)
    if variances == COLLAPSED and not collapsible(problem):
        raise ValueError(
            "variances: must be 'sampled' for this problem, got 'collapsed'; it needs an unknown variance with the "
            "prior 1/v or a flat one, of independent errors or of circulant ones with a fixed shape."
        )
    if sampler == NUTS:
        refuse_for_nuts(walkers, variances, checkpoint, executor)
    size = _checked_walkers(walkers, problem, variances)
    settings = f"seed {seed}, {ensembles} ensembles of {size} walkers, {start}, {coordinates}, {variances}"
    opened = nullcontext() if checkpoint is None else Checkpoint(checkpoint, problem, settings)
    with interrupted_by_termination(), opened as store:
        saved = None if store is None else store.load()
        anchor = np.array(saved.state["anchor"]) if saved else problem.vector(fit.theta)
        guesses = saved.state["guesses"] if saved else {name: s.states for name, s in fit.solutions.items()}
        anchored = Simulator.start(problem, anchor, guesses)
        density = LogPosterior(problem, anchored, coordinates=coordinates, variances=variances)
        if sampler == NUTS:
            return sample_nuts(density, fit, seed, ensembles, max_steps, start, progress)
        lists = {run: {state: [*map(float, x)] for state, x in states.items()} for run, states in guesses.items()}
        state = {"anchor": anchor.tolist(), "guesses": lists}
        run = _Run(density, fit, seed, start, size, ensembles, saved, state)
        run.go(max_steps, store, executor, progress)
        return run.posterior()


def _checked_walkers(walkers: int | None, problem: Problem, variances: str) -> int:
    labels = SamplingCoordinates(problem, variances=variances).labels
    needed = 2 * len(labels)
    if walkers is None:
        return max(32, needed + needed % 2)
    if _checks.integer("walkers", walkers, 1) < needed or walkers % 2:
        raise ValueError(
            f"walkers: must be even and at least twice the dimension, {needed} for {', '.join(labels)}, got {walkers}."
        )
    return walkers


class _Run:
    """A sampling run: its ensembles, their progress and the state of the stop rule."""

    def __init__(
        self,
        density: LogPosterior,
        fit: MapEstimate,
        seed: int,
        start: str,
        walkers: int,
        ensembles: int,
        saved: Saved | None,
        state: dict[str, Any],
    ):
        self.seed, self.density = seed, density
        sequences = np.random.SeedSequence(seed).spawn(ensembles + 2)
        self.redraws = np.random.default_rng(sequences[ensembles])
        if saved:
            self.state = saved.state
            self.transform = AffineTransform(np.array(self.state["origin"]), np.array(self.state["axes"]))
            counts = zip(self.state["calls"], self.state["failures"], strict=True)
            self.ensembles = [
                Ensemble(backend, backend.get_last_sample(), CallCount(points, Counter(failures)))
                for backend, (points, failures) in zip(saved.backends, counts, strict=True)
            ]
            return
        self.transform = sampling_axes(density, fit, start, np.random.default_rng(sequences[ensembles + 1]))
        self.state = state | {
            "origin": self.transform.origin.tolist(), "axes": self.transform.axes.tolist(),
            "steps": 0, "checked": 0, "passes": 0, "missing": [], "tau": [np.inf] * density.dimension,
            "converged": False, "reason": "",
        }  # fmt: skip
        self.ensembles = [
            self._started(fit, start, walkers, np.random.default_rng(sequence)) for sequence in sequences[:ensembles]
        ]

    def _started(self, fit: MapEstimate, start: str, walkers: int, generator: np.random.Generator) -> Ensemble:
        steps, calls = np.random.RandomState(generator.integers(2**32, size=4)), CallCount()
        points = start_points(self.density, fit, start, walkers, generator, calls)
        return Ensemble.at(self.transform.whiten(points), steps, calls)

    def go(self, max_steps: int, store: Checkpoint | None, executor: Any, progress: bool) -> None:
        """Sample until the stop rule is met, `max_steps` are reached, Ctrl-C is pressed, or workers are lost."""
        if self.state["converged"]:
            return
        try:
            if executor is None:
                evaluate = partial(self.density.evaluate, threads=None)
                self._sample(max_steps, store, LockstepPool(SamplingTarget(evaluate, self.transform)), progress)
                return
            with TaskPool(executor, SamplingTarget(self.density.evaluate, self.transform)) as pool:
                self._sample(max_steps, store, pool, progress)
        except KeyboardInterrupt:
            if not self._stopped("interrupted", store):
                raise
        except WorkersLost as lost:
            if not self._stopped("stopped", store, f": {lost}"):
                kept = "the same call goes on from the checkpoint" if store and self._done else "start again"
                raise RuntimeError(f"{lost} That was after {self._done} steps, too few for a result; {kept}.") from lost

    @property
    def _done(self) -> int:
        """Number of steps of the shortest ensemble."""
        return min(ensemble.steps for ensemble in self.ensembles)

    def _stopped(self, how: str, store: Checkpoint | None, why: str = "") -> bool:
        """Save a stopped run; return whether its steps are enough for a result."""
        enough = self._done >= FEWEST_STEPS
        if enough:
            self.state |= {"steps": self._done, "converged": False, "reason": f"{how} after {self._done} steps{why}"}
        if self._done:
            self._save(store, now=True)
        return enough

    def _sample(self, max_steps: int, store: Checkpoint | None, pool: TaskPool | LockstepPool, progress: bool) -> None:
        state = self.state
        with tqdm(total=max_steps, unit="step", desc="sampling", disable=not progress) as bar:
            for steps in range(state["checked"] + BLOCK, max_steps + 1, BLOCK):
                self._advance(steps, pool, bar)
                kept = self._kept(steps)
                tau = convergence.autocorrelation_time(kept)
                missing = unmet_criteria(kept, tau, np.array(state["tau"]), self.density.labels)
                passes = 0 if missing else state["passes"] + 1
                state |= {"steps": steps, "checked": steps, "tau": tau.tolist(), "passes": passes, "missing": missing}
                bar.set_postfix_str(self._account(kept, tau))
                if passes >= PASSES:
                    shape = f"{len(self.ensembles)} × {self.ensembles[0].backend.shape[0]} walkers"
                    reason = f"stop rule passed after {steps} steps of {shape}"
                    state |= {"converged": True, "reason": reason}
                    self._save(store, now=True)
                    return
                self._save(store, now=steps + BLOCK > max_steps)
        left = ", ".join(state["missing"]) or "the stop rule passed only once"
        state |= {"steps": state["checked"], "reason": f"max_steps = {max_steps} reached with {left}"}

    def _advance(self, steps: int, pool: TaskPool | LockstepPool, bar: tqdm) -> None:
        """Advance all ensembles to a number of steps, segment by segment."""
        behind = [number for number, ensemble in enumerate(self.ensembles) if ensemble.steps < steps]

        def then(task: int, segment: ChainSegment) -> Any:
            number = behind[task]
            self.ensembles[number] = self.ensembles[number].extended(segment)
            return self.ensembles[number].next_task(steps)

        for _ in pool.run(advance, [self.ensembles[number].next_task(steps) for number in behind], then):
            bar.update(self._done - bar.n)

    @property
    def _calls(self) -> CallCount:
        return sum((e.calls for e in self.ensembles), CallCount())

    def _account(self, kept: np.ndarray, tau: np.ndarray) -> str:
        text = f"acceptance {self._acceptance():.2f}, tau {tau.max():.0f}, length {kept.shape[1] / tau.max():.0f} tau"
        failed = sum(self._calls.failures.values())
        return text + (f", failed solves {failed / self._calls.points:.1%}" if failed else "")

    def _save(self, store: Checkpoint | None, *, now: bool) -> None:
        if store is not None:
            calls = [e.calls.points for e in self.ensembles]
            failures = [dict(e.calls.failures) for e in self.ensembles]
            backends = [e.backend for e in self.ensembles]
            store.save(backends, self.state | {"calls": calls, "failures": failures}, now=now)

    def _kept(self, steps: int) -> np.ndarray:
        """Return the chains (ensembles, steps, walkers, coordinates) up to a step, without their first fifth."""
        chains = np.stack([e.backend.get_chain()[steps // 5 : steps] for e in self.ensembles])
        return self.transform.unwhiten(chains)

    def _acceptance(self) -> float:
        return float(np.mean([e.backend.accepted / e.steps for e in self.ensembles]))

    def posterior(self) -> Posterior:
        """Return the draws, with draws of the variances that were integrated out."""
        steps = self.state["steps"]
        kept, part = self._kept(steps), slice(steps // 5, steps)
        log_density = np.stack([e.backend.get_log_prob()[part] for e in self.ensembles])
        if self.density.collapsed:
            moments = np.stack([e.backend.get_blobs()[part] for e in self.ensembles])
            moments = moments.reshape(*kept.shape[:-1], -1)
            kept, log_density = self.density.with_variances(kept, log_density, moments, self.redraws)
        return gather(
            self.density.with_settings(variances=SAMPLED),
            kept,
            log_density,
            self._calls,
            converged=self.state["converged"],
            reason=self.state["reason"],
            acceptance=self._acceptance(),
            seed=self.seed,
        )
