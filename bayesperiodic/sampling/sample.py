"""Sampling of θ and the noise parameters with emcee."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import astuple
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic._parallel import (
    TaskPool,
    Terminated,
    WorkersLost,
    checked_executor,
    ended_by_termination,
    interrupts_deferred,
)
from bayesperiodic._printing import progress_bar
from bayesperiodic.density.log_posterior import (
    COLLAPSED,
    NATURAL,
    RIDGE_COORDINATES,
    SAMPLED,
    Evaluation,
    LogPosterior,
    SamplingCoordinates,
    collapsible,
)
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.check import with_joint
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.problem.fingerprint import digest
from bayesperiodic.sampling.chains import StoredChains
from bayesperiodic.sampling.convergence import LENGTHS, PASSES, stop_rule
from bayesperiodic.sampling.draws import Posterior, gather
from bayesperiodic.sampling.nuts import refuse_for_nuts, sample_nuts
from bayesperiodic.sampling.proposals import (
    MIXTURE_STEPS,
    MOST_FITTED_DRAWS,
    AffineTransform,
    CallCount,
    StudentMixture,
    expected_time,
    fit_mixture,
    parts,
    with_tail,
)
from bayesperiodic.sampling.robust import add_robust
from bayesperiodic.sampling.starts import (
    FROM_LAPLACE,
    STARTS,
    laplace_mixture,
    mode_of,
    sampling_axes,
    start_points,
    surrogate_of,
)

if TYPE_CHECKING:
    import xarray as xr

    from bayesperiodic.sampling.checkpoint import Checkpoint, ColumnBackend, MemoryBackend

EMCEE, NUTS = "emcee", "nuts"
FEWEST_STEPS, FEWEST_KEPT = 50, 10
# Steps between fits of the mixture, and at least between checks of the stop rule.
ROUND, CHECKED = 25, 50
# Burn-in ends when the autocorrelation time [steps] expected of the mixture is FAST_MIXTURE, when it is as long as the
# chain that the stop rule needs at that time, or after MOST_BURN_IN_ROUNDS.
FAST_MIXTURE, MOST_BURN_IN_ROUNDS = 3.0, 40
# A surrogate is tried after SURROGATE_ROUNDS, at these fractions of the steps from the mixture and by it, if the time
# expected of the mixture is then USELESS_MIXTURE.
SURROGATE_ROUNDS, TRIED, USELESS_MIXTURE = 10, [0.4, 0.4], 50.0
# Both fractions at first, numbers of proposals by the surrogate that were accepted, and made, and the expected time.
AT_FIRST: dict[str, Any] = {"shares": [MIXTURE_STEPS, 0.0], "moved": [0, 0], "expected": FAST_MIXTURE}
# It starts again, before MOST_BURN_IN_ROUNDS, if this times the time that was expected at its end is expected at the
# draws that are kept: their tails were not known yet.
SLOWER_THAN_EXPECTED = 2.0
ADAPTED = "proposals that are still adapted"
# Points of a task for an executor.
PIECE = 16
Evaluate = Callable[[np.ndarray], Evaluation]


@in_one_thread
def sample(
    problem: Problem,
    fit: MapEstimate,
    *,
    seed: int,
    ensembles: int = 4,
    walkers: int | None = None,
    max_steps: int = 20_000,
    start: str = FROM_LAPLACE,
    coordinates: str = RIDGE_COORDINATES,
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
    there. The eigenvectors of the Laplace approximation in these coordinates are the axes. Four steps in five propose
    from a mixture of Student t distributions, independently of the walkers; the others are differential-evolution [2]_
    and stretch moves within each ensemble, for what the mixture misses. The narrow axes of the mixture follow quadratic
    forms of the wider ones, where ridges are curved. It is fitted to the draws of all ensembles every 25 steps of the
    burn-in, which is removed; that ends when a tau of at most 3 is expected, when it is 50 times as long as the
    expected tau, or after 1000 steps, and the mixture is fixed. Before 1000 steps the burn-in starts again if later
    draws let twice that tau be expected. On the posterior of the damper, in six dimensions, tau is 2, with moves within
    the ensembles alone 23; on that of the landing gear's 15 parameters and two variances 2.6 and 82.

    Where a tau above 50 is expected after 250 steps, as with many positive parameters of which the data determine sums,
    trajectories on a surrogate are tried: the prior times a normal likelihood, without periodic solves [4]_. They make
    four steps in five if they are faster.

    Sampling stops if, twice in succession, the chain after the burn-in and after its first fifth is 50 times as long as
    its longest autocorrelation time, that time has changed by less than 5 %, R-hat between the ensembles is at most
    1.005 and their 5, 50 and 95 % quantiles agree within a quarter of a standard deviation; if there are several
    optima, the same holds for the fraction of draws at each. Ctrl-C or the loss of the executor's workers ends it with
    the steps so far, not converged. SIGTERM, unless your program handles it, ends the process, after the checkpoint was
    written.

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
        At least 2.
    walkers : int, optional
        Of each ensemble, even and at least twice the number of coordinates.
    max_steps : int
        A run that reaches it has not converged.
    start : "laplace", "prior" or "overdispersed"
        Draws of the Laplace approximation with twice its standard deviations, of the priors, or of the Laplace
        approximation with five times its standard deviations.
    coordinates : "ridge" or "natural"
        "natural" takes no logarithms of parameters, to show why they are taken: along the ridge of a product standard
        deviations were up to 8 % too small although the stop rule had passed, as walkers reach its tails slowly.
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
        with another executor, and returns at once if it is finished. A symbolic link stands for its file. It can
        be read by emcee's HDFBackend, in coordinates in which the Laplace approximation is a standard normal
        distribution.
    executor : None, int, Dask Client, or executor with the interface of concurrent.futures
        Executor that evaluates the proposals of a step, 16 a task. By default they are solved together on all cores of
        this process, which is fastest on one machine. A number is a number of processes; a script needs
        its calls below ``if __name__ == "__main__":``. ``mpi4py.futures.MPIPoolExecutor`` and Dask use the nodes of a
        cluster, with processors of the same kind, because others may round differently. Each worker uses one core.
    progress : bool
        Show a progress bar with tau and length in units of tau.

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
        If trajectories of "nuts" diverged, or if a chain in natural coordinates has passed the stop rule.

    References
    ----------
    .. [1] D. Foreman-Mackey, D. W. Hogg, D. Lang, J. Goodman, emcee: the MCMC hammer, PASP 125 (2013) 306-312.
    .. [2] C. J. F. ter Braak, A Markov chain Monte Carlo version of the genetic algorithm differential evolution,
       Statistics and Computing 16 (2006) 239-249.
    .. [3] M. D. Hoffman, A. Gelman, The no-U-turn sampler: adaptively setting path lengths in Hamiltonian Monte Carlo,
       Journal of Machine Learning Research 15 (2014) 1593-1623.
    .. [4] J. S. Liu, Monte Carlo Strategies in Scientific Computing, Springer, 2001 (surrogate transitions).

    Examples
    --------
    >>> draws = bp.sample(problem, fit, seed=1, ensembles=2, walkers=8, max_steps=250, progress=False)
    >>> draws.reason.split(" with ")[0], draws.failures
    ('max_steps = 250 reached', {})
    """
    from bayesperiodic.sampling.checkpoint import Checkpoint, ColumnBackend

    _checks.instance("problem", problem, Problem)
    _checks.integer("ensembles", ensembles, 2)
    _checks.integer("max_steps", max_steps, FEWEST_STEPS)
    _checks.integer("seed", seed, 0)
    _checks.one_of("start", start, STARTS)
    _checks.one_of("coordinates", coordinates, (RIDGE_COORDINATES, NATURAL))
    _checks.one_of("variances", variances, (SAMPLED, COLLAPSED))
    _checks.one_of("sampler", sampler, (EMCEE, NUTS))
    if not isinstance(fit, MapEstimate):
        raise ValueError(f"fit: must be a MapEstimate, got {type(fit).__name__}; give map_estimate(problem).")
    _checks.same_names("fit", fit.theta, problem.names)
    _checks.same_names("fit", fit.noise, problem.noise_names)
    runs = [e.name for e in problem.experiments]
    _checks.contains("fit", fit.solutions, runs, "give the estimate of this problem, map_estimate(problem)")
    problem, fit = problem.with_input_errors(fit.input_errors), with_joint(problem, fit)
    executor = checked_executor(executor)
    if variances == COLLAPSED and not collapsible(problem):
        raise ValueError(
            "variances: must be 'sampled' for this problem, got 'collapsed'; it needs an unknown variance with the "
            "prior 1/v or a flat one, of independent errors or of circulant ones with a fixed shape, and exact inputs."
        )
    if sampler == NUTS:
        refuse_for_nuts(walkers, variances, checkpoint, executor)
    size = _checked_walkers(walkers, problem, variances)
    settings = f"seed {seed}, {ensembles} ensembles of {size} walkers, {start}, {coordinates}, {variances}"
    if fit.input_errors:
        settings += f", input noise {digest([astuple(wave) for wave in fit.input_errors.values()])}"
    opened = nullcontext() if checkpoint is None else Checkpoint(checkpoint, problem, settings)
    with ended_by_termination(), opened as store:
        backend, saved = (ColumnBackend(), {}) if store is None else store.load()
        anchor = np.array(saved["anchor"]) if saved else problem.vector(fit.theta)
        guesses = saved["guesses"] if saved else {name: s.states for name, s in fit.solutions.items()}
        density = problem.anchored(anchor, guesses).density(coordinates=coordinates, variances=variances)
        if sampler == NUTS:
            return sample_nuts(density, fit, seed, ensembles, max_steps, start, progress)
        lists = {run: {state: [*map(float, x)] for state, x in states.items()} for run, states in guesses.items()}
        state = {"anchor": anchor.tolist(), "guesses": lists} | saved
        run = _EnsembleRun(density, fit, seed, start, (ensembles, size), backend, state)
        run.go(max_steps, store, executor, progress)
        posterior = run.posterior()
    if posterior.converged and coordinates == NATURAL and problem.logarithmic.any():
        warnings.warn(
            "coordinates: 'natural' can miss the tails of a ridge although the stop rule has passed, which makes "
            "standard deviations up to 8 % too small; compare with the default, 'ridge'.",
            UserWarning,
            stacklevel=3,
        )
    return posterior


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


class _EnsembleRun:
    """A sampling run: one emcee sampler for all ensembles, the fit of its mixture, and the state of the stop rule."""

    def __init__(
        self,
        density: LogPosterior,
        fit: MapEstimate,
        seed: int,
        start: str,
        shape: tuple[int, int],
        backend: ColumnBackend | MemoryBackend,
        state: dict[str, Any],
    ):
        import emcee

        self.seed, self.density, self.fit, self.backend = seed, density, fit, backend
        self.ensembles, self.walkers = shape
        self.surrogate = surrogate_of(density, fit)
        first, redraws, axes = np.random.SeedSequence(seed).spawn(3)
        self.redraws = np.random.default_rng(redraws)
        if "axes" in state:
            self.state = AT_FIRST | state  # which checkpoints of earlier versions lack
            self.transform = AffineTransform(np.array(state["origin"]), np.array(state["axes"]))
            self.calls = CallCount(state["calls"], Counter(state["failures"]))
            self.walk = backend.get_last_sample()
            return
        self.calls, generator = CallCount(), np.random.default_rng(first)
        self.transform = sampling_axes(density, fit, start, np.random.default_rng(axes))
        random = np.random.RandomState(generator.integers(2**32, size=4))
        starts = [start_points(density, fit, start, self.walkers, generator, self.calls) for _ in range(shape[0])]
        self.walk = emcee.State(self.transform.whiten(np.concatenate(starts)), random_state=random.get_state())
        first_mixture = self._first_mixture()
        self.state = AT_FIRST | state | {
            "origin": self.transform.origin.tolist(), "axes": self.transform.axes.tolist(),
            "mixture": first_mixture and first_mixture.as_lists(), "burnt": 0, "tries": [0, 0],
            "steps": 0, "next": ROUND, "passes": 0, "missing": [ADAPTED], "tau": [],
            "converged": False, "reason": "",
        }  # fmt: skip

    def _first_mixture(self) -> StudentMixture | None:
        """Return Student t distributions at the optima of the estimate, None if there is no Laplace approximation."""
        try:
            mixture, _ = laplace_mixture(self.density, self.fit)
        except ValueError:
            return None
        inverse = np.linalg.inv(self.transform.axes)
        return mixture.mapped(-inverse @ self.transform.origin, inverse)

    def go(self, max_steps: int, store: Checkpoint | None, executor: Any, progress: bool) -> None:
        """Sample until the stop rule is met, `max_steps` are reached, Ctrl-C is pressed, or workers are lost."""
        if self.state["converged"]:
            return
        try:
            if executor is None:
                self._sample(max_steps, store, partial(self.density.evaluate, threads=None), progress)
                return
            with TaskPool(executor, self.density) as pool:
                self._sample(max_steps, store, partial(_evaluate_pieces, pool), progress)
        except KeyboardInterrupt as interrupt:
            if not self._stopped("interrupted", store) or isinstance(interrupt, Terminated):
                raise
        except WorkersLost as lost:
            if not self._stopped("stopped", store, f": {lost}"):
                done = self._done
                kept = "the same call goes on from the checkpoint" if store and done else "start again"
                raise RuntimeError(f"{lost} That was after {done} steps, too few for a result; {kept}.") from lost

    @property
    def _done(self) -> int:
        """Number of steps so far."""
        return int(self.backend.iteration) if self.backend.initialized else 0

    def _stopped(self, how: str, store: Checkpoint | None, why: str = "") -> bool:
        """Save a stopped run; return whether its steps are enough for a result."""
        done = self._done
        if done >= FEWEST_STEPS:
            self.state |= {"steps": done, "reason": f"{how} after {done} steps{why}"}
        if done:
            self._save(store, now=True)
        return done >= FEWEST_STEPS

    def _sample(self, max_steps: int, store: Checkpoint | None, evaluate: Evaluate, progress: bool) -> None:
        """Advance from check to check; before the last round of adaptation a check fits the mixture."""
        state = self.state
        with progress_bar(total=max_steps, unit="step", desc="sampling", disable=not progress) as bar:
            while state["steps"] < max_steps:
                until = min(state["next"], max_steps)
                self._advance(until, evaluate, bar)
                state |= {"steps": until}
                if until == state["next"]:
                    if state["burnt"] and not self._outdated():
                        bar.set_postfix_str(self._judge(), refresh=False)
                    else:
                        self._adapt()
                self._save(store, now=state["converged"] or until == max_steps)
                if store is None:
                    self._forget()
                if state["converged"]:
                    return
        left = ", ".join(state["missing"]) or "the stop rule passed only once"
        state |= {"reason": f"max_steps = {max_steps} reached with {left}"}

    def _advance(self, until: int, evaluate: Evaluate, bar: tqdm) -> None:
        """Advance all ensembles to a number of steps."""
        import emcee

        from bayesperiodic.sampling.moves import by_surrogate, from_mixture, moves

        of_mixture, of_surrogate = self.state["shares"]
        mixture = self.state["mixture"] and from_mixture(StudentMixture.from_lists(self.state["mixture"]), of_mixture)
        surrogate = (
            by_surrogate(self.surrogate, self.transform, of_surrogate) if self.surrogate and of_surrogate else None
        )
        independent = [move for move in (mixture, surrogate) if move]
        calls = CallCount()

        def log_prob(u: np.ndarray) -> np.ndarray:
            evaluation = evaluate(self.transform.unwhiten(u))
            calls.add(evaluation.status)
            log_prob, moments = evaluation.log_prob, evaluation.moments
            return np.column_stack([log_prob, moments]) if moments.size else log_prob

        np.random.RandomState().set_state(self.walk.random_state)  # raises, where emcee would go on with another one
        sampler = emcee.EnsembleSampler(
            *self.walk.coords.shape, log_prob, moves=moves(self.ensembles, *independent), vectorize=True,
            backend=self.backend,
        )  # fmt: skip
        tries, moved, steps = self.state["tries"], self.state["moved"], until - self._done
        with interrupts_deferred() as check:
            for walk in sampler.sample(self.walk, iterations=steps, skip_initial_state_check=True):
                self.walk = walk
                self.calls, calls = self.calls + calls, CallCount()
                if mixture:
                    self.state["tries"] = [tries[0] + mixture.accepted, tries[1] + mixture.proposed]
                if surrogate:
                    self.state["moved"] = [moved[0] + surrogate.accepted, moved[1] + surrogate.proposed]
                bar.update(self._done - bar.n)
                check()

    def _forget(self) -> None:
        """Give back the memory of the steps that are not used again, whether or not the burn-in starts again."""
        burnt, steps = self.state["burnt"], self.state["steps"]
        final = self._settled and steps - burnt >= FEWEST_KEPT
        self.backend.forget(max(burnt if final else 0, steps // 5))

    def _chains(self, first: int, transform: AffineTransform | None = None) -> StoredChains:
        """Return the chains from a step on, without a transform in whitened coordinates."""
        return StoredChains(self.backend.columns_since(first), self.ensembles, transform)

    def _by_ensemble(self, values: np.ndarray) -> np.ndarray:
        """Return values (steps, all walkers, …) as (ensembles, steps, walkers, …)."""
        return values.reshape(len(values), self.ensembles, self.walkers, *values.shape[2:]).swapaxes(0, 1)

    def _adapt(self) -> None:
        """Fit the mixture to the later half of the steps, and end the burn-in when it is fast enough.

        It must be fast at the draws of the last round, which it was not fitted to, and at the later half. The mixture
        before stays if it is expected to be faster there. A burn-in as long as the chain that follows costs at most
        twice what a known best end would.
        """
        state = self.state
        half, last, first = state["steps"] // 2, state["steps"] - ROUND, self._first_mixture()
        present = state["mixture"] and StudentMixture.from_lists(state["mixture"])
        chains = self._chains(half)
        new = self._expected_time(present, last) if present else np.inf
        if min(np.ptp(chains[..., k]) for k in range(self.density.dimension)) > 0.0:
            draws = chains.thinned(MOST_FITTED_DRAWS)
            fitted = fit_mixture(draws, [] if first is None else [first])
            tried = [*filter(None, [present]), fitted, with_tail(fitted, draws.reshape(-1, draws.shape[2]))]
            state["mixture"] = min(tried, key=lambda one: self._expected_time(one, half)).as_lists()
        rounds, expected, enough = state["steps"] // ROUND, np.inf, max(FAST_MIXTURE, state["steps"] / LENGTHS)
        if present and rounds > 1 and new <= enough:
            expected = max(new, self._expected_time(StudentMixture.from_lists(state["mixture"]), half))
        fast = expected <= enough
        state["shares"] = [MIXTURE_STEPS, 0.0] if fast else self._shares(half)
        led = state["shares"][1] == MIXTURE_STEPS and rounds >= 2 * SURROGATE_ROUNDS
        done = fast or led or rounds >= MOST_BURN_IN_ROUNDS
        state |= {"moved": [0, 0], "tries": [0, 0], "next": state["steps"] + (CHECKED if done else ROUND)}
        state |= {"burnt": state["steps"] if done else 0, "missing": [] if done else [ADAPTED], "tau": [], "passes": 0}
        state["expected"] = max(expected, FAST_MIXTURE) if fast else FAST_MIXTURE

    def _shares(self, first: int) -> list[float]:
        """Return the fractions of the steps that propose from a slow mixture, and by the surrogate."""
        state = self.state
        if not self.surrogate or not state["mixture"] or state["steps"] < SURROGATE_ROUNDS * ROUND:
            return [MIXTURE_STEPS, 0.0]
        by_mixture = self._expected_time(StudentMixture.from_lists(state["mixture"]), first)
        if by_mixture < USELESS_MIXTURE:
            return [MIXTURE_STEPS, 0.0]
        accepted, proposed = state["moved"]
        if not proposed:
            return TRIED
        by_surrogate = 2.0 / max(MIXTURE_STEPS * accepted / proposed, np.finfo(float).tiny) - 1.0
        return [0.1, MIXTURE_STEPS] if by_surrogate < by_mixture else [MIXTURE_STEPS - 0.1, 0.1]

    @property
    def _settled(self) -> bool:
        """Whether the burn-in is over for good."""
        state = self.state
        return state["burnt"] > 0 and bool(state["burnt"] >= MOST_BURN_IN_ROUNDS * ROUND or state["shares"][1])

    def _outdated(self) -> bool:
        """Return whether the burn-in ended too early: the draws since then have tails that the mixture lacks."""
        if self._settled:
            return False
        mixture = StudentMixture.from_lists(self.state["mixture"])
        return self._expected_time(mixture, self._first_kept) > SLOWER_THAN_EXPECTED * self.state["expected"]

    def _expected_time(self, mixture: StudentMixture, first: int) -> float:
        """Return the autocorrelation time expected of a mixture, from the draws since a step."""
        log_density = self.backend.get_log_prob(discard=first)
        return expected_time(mixture, self._chains(first).points, log_density.ravel(), MIXTURE_STEPS)

    def _judge(self) -> str:
        """Apply the stop rule, and return an account of the run."""
        state = self.state
        steps, kept = state["steps"], self._kept()
        modes = self._modes(kept)
        tau, missing = stop_rule(kept, modes, np.array(state["tau"]), self.density.labels)
        passes = 0 if missing else state["passes"] + 1
        ahead = max(CHECKED, (steps - state["burnt"]) // 4 // CHECKED * CHECKED)
        state |= {"next": steps + ahead, "tau": tau.tolist(), "passes": passes, "missing": missing}
        if passes >= PASSES:
            shape = f"{self.ensembles} × {self.walkers} walkers"
            state |= {"converged": True, "reason": f"stop rule passed after {steps} steps of {shape}"}
        failed, slowest = sum(self.calls.failures.values()), max(tau)
        text = f"tau {slowest:.1f}, length {kept.shape[1] / slowest:.0f} tau"
        return text + (f", failed solves {failed / self.calls.points:.1%}" if failed else "")

    def _save(self, store: Checkpoint | None, *, now: bool) -> None:
        if store is not None:
            counts = {"calls": self.calls.points, "failures": dict(self.calls.failures)}
            store.save(self.backend, self.state | counts, now=now)

    @property
    def _first_kept(self) -> int:
        """First step that is kept: after the first fifth, and after the burn-in if there are steps after it."""
        burnt, steps = self.state["burnt"], self.state["steps"]
        return max(burnt if steps - burnt >= FEWEST_KEPT else 0, steps // 5)

    def _kept(self) -> StoredChains:
        """Return the kept chains."""
        return self._chains(self._first_kept, self.transform)

    def _modes(self, chains: StoredChains) -> np.ndarray | None:
        """Return the optima of draws (ensembles, steps, walkers), see `mode_of`."""
        if not self.fit.other_modes:
            return None
        modes = [mode_of(self.density, self.fit, chains.unwhitened(part)) for part in parts(len(chains.points))]
        known = [part for part in modes if part is not None]
        return chains.by_ensemble(np.concatenate(known)) if known else None

    def posterior(self) -> Posterior:
        """Return the draws, with draws of the variances that were integrated out; the run is over then."""
        import xarray as xr

        from bayesperiodic.sampling.checkpoint import ColumnBackend

        kept, first = self._kept(), self._first_kept
        log_density = self._by_ensemble(self.backend.get_log_prob(discard=first))
        modes = self._modes(kept)
        kept.unwhiten()  # in place, if there is no checkpoint
        if self.density.collapsed:
            moments = self._by_ensemble(self.backend.get_blobs(discard=first)).reshape(*kept.shape[:-1], -1)
            columns, log_density = self.density.with_variances(kept, log_density, moments, self.redraws)
            kept = kept.with_columns(columns)
        acceptance = float(np.mean(self.backend.accepted / self.backend.iteration))
        if isinstance(self.backend, ColumnBackend):
            self.backend.reset(*self.walk.coords.shape)  # its memory is given back as `gather` takes the coordinates
        posterior = gather(
            self.density.with_settings(variances=SAMPLED),
            kept,
            log_density,
            self.calls,
            modes=modes,
            converged=self.state["converged"],
            reason=self.state["reason"],
            acceptance=acceptance,
            seed=self.seed,
        )
        add_robust(posterior.tree, self.fit, len(posterior.modes))
        if self.state["mixture"]:
            posterior.tree["proposal"] = xr.DataTree(self._proposal())
        return posterior

    def _proposal(self) -> xr.Dataset:
        """Return the mixture, with the acceptance of its steps since the last fit.

        Its components are those of the coordinates u, straightened by `curvature`, of origin + axes·u.
        """
        import xarray as xr

        mixture = StudentMixture.from_lists(self.state["mixture"])
        (accepted, proposed), where = self.state["tries"], ("component", "axis")
        return xr.Dataset(
            {
                "weight": (where[:1], mixture.weights),
                "degrees": (where[:1], mixture.degrees),
                "mean": (where, mixture.means),
                "scale": ((*where, "other"), mixture.factors @ mixture.factors.swapaxes(1, 2)),
                "curvature": (("bent", "product"), np.atleast_2d(mixture.curvature)[: len(mixture.curvature)]),
                "origin": ("coordinate", self.transform.origin),
                "axes": (("coordinate", "axis"), self.transform.axes),
            },
            coords={"coordinate": list(self.density.labels)},
            attrs={"acceptance": accepted / max(proposed, 1), "burn_in": self.state["burnt"]},
        )


def _evaluate_pieces(pool: TaskPool, points: np.ndarray) -> Evaluation:
    """Return the evaluation of points (points, dimension), computed by the workers piece by piece."""
    pieces = [points[k : k + PIECE] for k in range(0, len(points), PIECE)]
    _, parts = zip(*sorted(pool.run(LogPosterior.evaluate, pieces), key=itemgetter(0)), strict=True)
    return Evaluation(*(np.concatenate(values) for values in zip(*parts, strict=True)))
