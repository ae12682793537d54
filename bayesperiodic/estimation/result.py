"""MapEstimate: the MAP point, its Laplace approximations, and tests of the residual."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from bayesperiodic import _checks
from bayesperiodic._expressions import Expression, parse_all
from bayesperiodic._io import Result
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.conflict import PriorConflict
from bayesperiodic.estimation.gauss_newton import Iterate
from bayesperiodic.estimation.modes import Mode, notable
from bayesperiodic.likelihood.input_noise import InputErrors
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.priors.joint import MultivariateNormal
from bayesperiodic.problem.parameters import checked_key, in_experiment, local_hint, local_names

# Fraction of a channel's variance below which its residual consists of rounding errors of the periodic solves.
ROUNDING = 1e-16


@dataclass(frozen=True)
class Whiteness:
    """Test by M. S. Bartlett (An Introduction to Stochastic Processes, 1955) of a residual that repeats every period.

    `p` is the probability, for white residuals, of a cumulative periodogram at least as far from a straight line: the
    Kolmogorov-Smirnov distance of the kept harmonics, exact for independent normal values; NaN if not tested. `lag1` is
    the circular autocorrelation at the distance of two independent values, one period / (2·harmonics + 1).
    """

    p: float
    lag1: float


def of_periodogram(power: np.ndarray) -> Whiteness:
    """Test whether the squared amplitudes of harmonics 1, 2, … are those of white noise (Bartlett 1955)."""
    from scipy.stats import kstest

    if power.size < 2 or power.sum() == 0.0:
        return Whiteness(1.0, 0.0)
    harmonic = np.arange(1, power.size + 1)
    cumulative = np.cumsum(power)[:-1] / power.sum()
    lag = 2.0 * np.pi / (2 * power.size + 1)
    return Whiteness(
        float(kstest(cumulative, "uniform").pvalue), float(np.sum(power * np.cos(lag * harmonic)) / power.sum())
    )


@dataclass(frozen=True)
class NoiseSplit:
    """Standard deviations of one value of a channel's mean period, in the channel's units.

    `measurement` follows from the scatter of the measured cycles, NaN if unknown; `total` is that of the residual,
    corrected for the number of free parameters as in eq. (7); `model` is √(total² − measurement²), or zero.
    """

    measurement: float
    model: float
    total: float


def noise_split(
    problem: Problem, residuals: Sequence[np.ndarray], log_variance_factor: float | np.ndarray
) -> dict[str, NoiseSplit]:
    """Return the split of every channel with compared time histories; the factor is 1 − p/n of eq. (7)."""
    sums = {channel: np.zeros(4) for channel in problem.channels}
    blocks = problem.likelihood.blocks
    factors = np.broadcast_to(log_variance_factor, len(blocks))
    for block, r, one in zip(blocks, residuals, factors, strict=True):
        if block.timed:
            square = block.weight * float(r @ r)
            sums[block.channel] += [block.count, block.count * one, square, block.count * block.measured]
    result = {}
    for channel, (count, left, square, measured) in sums.items():
        if count:
            total, measurement = square / left, measured / count
            result[channel] = NoiseSplit(*np.sqrt([measurement, max(total - measurement, 0.0), total]).tolist())
    return result


def channel_whiteness(problem: Problem, estimate: Iterate) -> dict[str, Whiteness]:
    """Return `MapEstimate.whiteness`; NaN where only single points were compared."""
    white = problem.likelihood.whitened(estimate.here.residuals, estimate.noise)
    tests: dict[str, list[Whiteness]] = {channel: [] for channel in problem.channels}
    for block, r in zip(problem.likelihood.blocks, white, strict=True):
        if block.spectral:
            complete = np.bincount(block.harmonic) == 2
            tests[block.channel].append(of_periodogram(np.bincount(block.harmonic, r**2)[complete]))
    return {
        channel: Whiteness(min(1.0, len(found) * min(t.p for t in found)), float(np.mean([t.lag1 for t in found])))
        if found
        else Whiteness(np.nan, np.nan)
        for channel, found in tests.items()
    }


@dataclass(frozen=True)
class MapEstimate(Result):
    """Maximum of the posterior density, and the normal approximation around it.

    Attributes
    ----------
    status : str
        "converged", "stalled" (no step increased the objective, though one of more than a thousandth of a standard
        deviation was left), "iterations" (their limit was reached), "singular" or "other orbit" (see `other_orbits`).
    theta, sd : dict of str to float
        Estimates and their standard deviations, in natural values and the parameters' units.
    robust_sd : dict of str to float
        Standard deviations that are valid for residuals that deviate from the noise model (sandwich covariance with the
        residual's smoothed spectrum); if they differ much from `sd`, the noise model is wrong.
    variances : dict of str to float
        Noise variance of each channel (or "channel, experiment") as the noise model defines it, for `Independent` noise
        that of one measured sample, and "scale"; by eq. (7) or fixed.
    noise : dict of str to float
        All noise parameters by their full names.
    noise_prior : str
        Prior of the variances, in words.
    covariance : DataFrame (names × names)
        Inverse of H of eq. (8) at these variances, increased where unknown ones make the weights of channels and priors
        uncertain (Kenward and Roger); for `Circulant` noise, with its unknown correlation integrated out.
    joint_mode : dict of str to float
        Mode of the density in sampling coordinates: natural values of parameters and free noise parameters.
    joint_covariance : DataFrame
        Inverse of the exact Hessian there; NaN if it is no maximum. Sampling coordinates are the logarithms of noise
        parameters and of parameters whose prior's support is (0, ∞), and the other parameters.
    degrees_of_freedom : dict of str to float
        Of Student's t of each parameter: the values that determine the variances its standard deviation rests on, less
        what the estimate takes up of them (Satterthwaite); infinite if that rests on known variances and the prior.
    independent : dict of str to float
        Independent values behind each variance.
    solutions : dict of str to PeriodicSolution
        By experiment.
    residuals : dict of str to dict of str to array (points,)
        y − ŷ within the kept harmonics, by experiment and channel.
    rms, fvu : dict of str to float
        Root mean square of each channel's residuals, and the fraction of the measured variance that they are.
    whiteness : dict of str to Whiteness
        Of the residuals in units of the noise model, by channel; with several experiments p is the smallest, corrected
        for their number, lag1 the mean.
    noise_split : dict of str to NoiseSplit
        Measurement noise and model error of each channel.
    input_noise : dict of str to float
        Standard deviation that the noise of the measured inputs causes in each channel.
    inputs, input_sd : dict of str to dict of str to array (points,)
        By experiment and input, the estimated true inputs and their standard deviations given the estimate, in the
        inputs' units; the measured ones and zero where ``Problem(input_noise=…)`` takes them as exact. `residuals`,
        `rms`, `fvu` and `noise_split` are those with the estimated inputs.
    input_errors : dict of str to InputErrors
        By experiment with noisy inputs: independent standard normal errors of the inputs, `expected` (errors,), what
        they cause in the predicted components, `caused` (components,), and the derivatives of the residual by them,
        `loadings` L (components, errors), at the estimate; L·Lᵀ is what they add to the covariance of the residual.
    input_nonlinearity : dict of str to float
        By what each estimate is changed by the part of the outputs that is not linear in the errors of the inputs, in
        standard deviations: root mean square over errors drawn given the estimate. NaN if a solve fails.
    doubling_shift : dict of str to float
        Change of each estimate on twice as many points, in standard deviations; NaN if those solves fail.
    at_ends : tuple of str
        Parameters that the data act upon and whose estimate lies at the end of their prior's support.
    other_orbits : dict of str to str
        Experiments whose fitted orbit is not the measured one (prime period, turns of angles, or order of the forcing
        periods), with the reason in words.
    prior_conflict : PriorConflict
        Test of the prior against the estimate by the data alone, with its p-values and, if there is one, the conflict
        in words (``text``).
    undetermined : tuple of str
        Changes of parameters, in words, that change no output, confirmed by a change of 10 %, or "a combination of …"
        where only a small change leaves the outputs as they are; in these directions the posterior equals the prior.
    history : array (iterations,)
        The objective before each step and at the end.
    starts : tuple of dict of str to float
        Of every start, the objective reached (−inf: none) under "objective", and the estimates.
    other_modes : tuple of Mode
        Separate optima other than the estimate whose objective is lower by less than 30, see `modes`.
    fingerprint : str
        Digests of the problem, by which results of another problem are refused.
    tied : dict of str to dict of str to float
        Derivatives of the tied parameters by the free ones at the estimate; NaN where experiments differ.

    Examples
    --------
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> for name, value in fit.theta.items():
    ...     print(f"{name} = {value:.3f} ± {fit.sd[name]:.3f}")
    c = 0.200 ± 0.001
    k = 1.000 ± 0.001
    >>> low, high = fit.interval(0.9)["k"]
    >>> low < 1.0 < high, fit.whiteness["displacement"].p > 0.01
    (True, True)
    """

    status: str
    theta: dict[str, float]
    sd: dict[str, float]
    robust_sd: dict[str, float]
    variances: dict[str, float]
    noise: dict[str, float]
    noise_prior: str
    covariance: pd.DataFrame
    joint_mode: dict[str, float]
    joint_covariance: pd.DataFrame
    degrees_of_freedom: dict[str, float]
    independent: dict[str, float]
    solutions: dict[str, PeriodicSolution]
    residuals: dict[str, dict[str, np.ndarray]]
    rms: dict[str, float]
    fvu: dict[str, float]
    whiteness: dict[str, Whiteness]
    noise_split: dict[str, NoiseSplit]
    input_noise: dict[str, float]
    inputs: dict[str, dict[str, np.ndarray]]
    input_sd: dict[str, dict[str, np.ndarray]]
    input_errors: dict[str, InputErrors]
    input_nonlinearity: dict[str, float]
    doubling_shift: dict[str, float]
    at_ends: tuple[str, ...]
    other_orbits: dict[str, str]
    prior_conflict: PriorConflict
    undetermined: tuple[str, ...]
    history: np.ndarray
    starts: tuple[dict[str, float], ...]
    other_modes: tuple[Mode, ...]
    fingerprint: str
    tied: dict[str, dict[str, float]]

    if not TYPE_CHECKING:
        # Fields that take long and that few users need are functions until they are used.
        def __getattribute__(self, name: str) -> Any:
            value = super().__getattribute__(name)
            if isinstance(value, partial):
                value = value()
                object.__setattr__(self, name, value)
            return value

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def converged(self) -> bool:
        """True if the status is "converged"."""
        return self.status == "converged"

    @property
    def modes(self) -> pd.DataFrame:
        """Separate optima, the estimate first: objective, fraction of the mass by Laplace, and parameters."""
        own = {"objective": float(self.history[-1]), "mass": 1.0 - sum(mode.mass for mode in self.other_modes)}
        rows = [{"objective": mode.objective, "mass": mode.mass} | mode.theta for mode in self.other_modes]
        return pd.DataFrame([own | self.theta, *rows])

    def other_values(self, name: str) -> list[float]:
        """Return the values of a parameter at other optima with more than 1 % of the mass, where they differ.

        Parameters
        ----------
        name : str

        Returns
        -------
        list of float
            Those further from the estimate than the smaller one of the two standard deviations.
        """
        value, sd = self.theta[name], self.sd[name]
        return [mode.theta[name] for mode in notable(self.other_modes) if mode.differs(name, value, sd)]

    @property
    def correlations(self) -> pd.DataFrame:
        """Correlations of the parameters, from `covariance`."""
        sd = np.sqrt(np.diag(self.covariance))
        return pd.DataFrame(self.covariance / np.outer(sd, sd))

    def interval(self, probability: float = 0.9, *, robust: bool = False) -> dict[str, tuple[float, float]]:
        """Return the equal-tailed interval of each parameter, by Student's t with `degrees_of_freedom`.

        Parameters
        ----------
        probability : float
            Between 0 and 1.
        robust : bool
            Take `robust_sd` instead of `sd`.

        Returns
        -------
        dict of str to (float, float)
            In the parameters' units.

        Raises
        ------
        ValueError
            If the probability is not between 0 and 1.
        """
        if not 0.0 < _checks.finite_number("probability", probability) < 1.0:
            raise ValueError(f"probability: must be between 0 and 1, got {probability!r}.")
        sd, result = self.robust_sd if robust else self.sd, {}
        for name, value in self.theta.items():
            half = float(stdtrit(min(self.degrees_of_freedom[name], 1e9), 0.5 + 0.5 * probability)) * sd[name]
            result[name] = value - half, value + half
        return result

    def derive(self, expressions: Mapping[str, str], *, experiment: str | None = None) -> pd.DataFrame:
        """Return quantities derived from the parameters, with standard deviations by the delta method.

        The standard deviation is √(gᵀ C g) with the exact gradient g by the free parameters and the `covariance` C:
        exact for linear combinations, otherwise accurate if the expression is nearly linear within the uncertainty.

        Parameters
        ----------
        expressions : mapping of str to str
            By new name: numbers, names of parameters (free, fixed or tied), pi, + - * / ** and sqrt, exp, log, sin,
            cos, tan, atan, sinh, cosh, tanh, abs.
        experiment : str, optional
            Its local parameters and fixed values are named without brackets: with "run 7" ``theta16`` is
            ``theta16[run 7]``. Without it, expressions contain only parameters that all experiments share.

        Returns
        -------
        DataFrame
            Columns value and sd, one row per quantity; ``attrs["covariance"]`` holds the covariances between the
            quantities as a dict of dict of floats. The sd is NaN where a tied parameter depends on a local one.

        Raises
        ------
        ValueError
            For an invalid expression or one without a finite value at the estimate, a new name that is no identifier or
            the name of a parameter, an unknown experiment.

        Examples
        --------
        >>> fit.derive({"damping_ratio": "c/(2*sqrt(k))"}).round(4)
                        value      sd
        damping_ratio  0.0998  0.0005
        """
        if experiment is not None:
            _checks.one_of("experiment", experiment, self.solutions)
        named = in_experiment(self.theta, experiment)
        values = self._fixed(experiment) | {plain: self.theta[name] for plain, name in named.items()}
        hint = local_hint(self.theta, experiment)
        quantities = parse_all("expressions", expressions, values, local_names(self.theta), hint)
        at = {name: float(quantity.value(values)) for name, quantity in quantities.items()}
        for name, value in at.items():
            if not np.isfinite(value):
                raise ValueError(
                    f"expressions[{name!r}]: must be finite at the estimate, got {value} for {quantities[name].text!r}."
                )
        gradients = [self._gradient(quantity, values, named) for quantity in quantities.values()]
        covariance = _carried(self.covariance.to_numpy(), gradients)
        with np.errstate(invalid="ignore"):
            sd = np.sqrt(np.diag(covariance))
        table = pd.DataFrame({"value": list(at.values()), "sd": sd}, index=list(at))
        table.attrs["covariance"] = {
            name: dict(zip(at, row, strict=True)) for name, row in zip(at, covariance.tolist(), strict=True)
        }
        return table

    def as_prior(self, names: tuple[str, ...]) -> MultivariateNormal:
        """Return the normal approximation of these parameters, as the prior of another problem.

        Parameters
        ----------
        names : tuple of str
            Free parameters, local ones as ``theta16[run 7]``, in the order of the prior's.

        Returns
        -------
        MultivariateNormal
            With the estimate as mean and the part of `covariance`; see `Posterior.as_prior`.

        Raises
        ------
        ValueError
            For anything else than a tuple of different free parameters with finite standard deviations.

        Warns
        -----
        UserWarning
            If the estimate has not converged.

        Examples
        --------
        >>> priors = {("c", "k"): fit.as_prior(("c", "k"))}
        >>> bp.Problem(bp.models.duffing, [run], priors=priors, fixed={"m": 1, "k3": 0.5}).median().round(2).tolist()
        [0.2, 1.0]
        """
        key = checked_key(names, self.theta, self.noise)
        if not self.converged:
            warnings.warn(
                f"The estimate has not converged ({self.status}), and the prior is unreliable. Try map_estimate from "
                "another start, or from several.",
                stacklevel=2,
            )
        mean = np.array([self.theta[name] for name in key])
        covariance = self.covariance.loc[[*key], [*key]].to_numpy()
        if lost := [name for name, variance in zip(key, np.diag(covariance), strict=True) if not np.isfinite(variance)]:
            raise ValueError(
                f"names: must be parameters with a finite standard deviation, got {', '.join(map(repr, lost))}, which "
                "the data do not determine. Leave it out, or fix a parameter, see fit.undetermined."
            )
        return MultivariateNormal(mean, covariance)

    def _gradient(self, quantity: Expression, values: dict[str, float], named: dict[str, str]) -> np.ndarray:
        """Return the derivatives by the free parameters (names,), those through tied ones included."""
        total = dict.fromkeys(self.theta, 0.0)
        for plain, slope in quantity.gradient(values).items():
            if plain in named:
                total[named[plain]] += float(slope)
            for name, through in self.tied.get(plain, {}).items():
                total[name] += float(slope) * through
        return np.array(list(total.values()))

    def _fixed(self, experiment: str | None) -> dict[str, float]:
        """Return the fixed and tied parameters of one experiment, or those with the same value in all."""
        free = {*self.theta, *(local_names(self.theta) if experiment is None else ())}
        first, *others = (solution.parameters for run, solution in self.solutions.items() if experiment in (None, run))
        return {
            name: value
            for name, value in first.items()
            if name not in free and all(other.get(name) == value for other in others)
        }

    @property
    def without_noise(self) -> tuple[str, ...]:
        """Channels of unknown variance whose residuals are rounding errors: no standard deviation follows from them."""
        names = {name.partition(", ")[0] for name in self.independent}
        return tuple(c for c, fraction in self.fvu.items() if c in names and fraction < ROUNDING)

    def __repr__(self) -> str:
        status = self.status if self.converged else f"NOT CONVERGED: {self.status}; try another start, or starts=8"
        if self.without_noise:
            status = f"{self.status}; {', '.join(self.without_noise)} without noise"
        rows = {
            name: (f"{value:.6g}", f"{self.sd[name]:.3g}", f"{self.robust_sd[name]:.3g}")
            for name, value in self.theta.items()
        } | {name: (f"{value:.4g}", "-", "-") for name, value in self.noise.items()}
        estimates = pd.DataFrame.from_dict(rows, orient="index", columns=["estimate", "Laplace sd", "robust sd"])
        channels = {}
        for channel, rms in self.rms.items():
            split = self.noise_split.get(channel, NoiseSplit(np.nan, np.nan, np.nan))
            known, p = np.isfinite(split.measurement), self.whiteness[channel].p
            channels[channel] = {
                "rms": f"{rms:.4g}",
                "unexplained variance": f"{self.fvu[channel]:.2%}",
                "measurement noise": f"{split.measurement:.3g}" if known else "-",
                "model error": f"{split.model:.3g}" if known else "-",
                "whiteness p": f"{p:.2g}" if np.isfinite(p) else "-",
            }
        residuals = pd.DataFrame.from_dict(channels, orient="index")
        lines = [f"MapEstimate ({status})", estimates.to_string(), "Residuals", residuals.to_string()]
        lines += [f"The noise has the {self.noise_prior}."] if self.noise else []
        if self.input_errors:
            caused = ", ".join(f"{sd:.3g} in {channel}" for channel, sd in self.input_noise.items())
            lines.append(f"The noise of the inputs, included in the covariance, causes {caused}.")
        lines += [
            f"The orbit is another one than the recorded one in {name!r}: {text}."
            for name, text in self.other_orbits.items()
        ]
        lines += [f"{self.prior_conflict.text}."] if self.prior_conflict.text else []
        lines += [f"Not determined by the data: {text}." for text in self.undetermined]
        lines += [f"Another optimum: {mode!r}." for mode in notable(self.other_modes)]
        return "\n".join(lines)


def orbit_advice(fit: MapEstimate) -> str:
    """Return what to do first if orbits of a fit are not the measured ones; empty otherwise."""
    runs = ", ".join(map(repr, fit.other_orbits))
    return f"first fit the measured orbit of {runs}, see fit.other_orbits" if runs else ""


def _carried(matrix: np.ndarray, gradients: list[np.ndarray]) -> np.ndarray:
    """Return the covariance of quantities with these gradients; parameters of gradient 0 may have an infinite sd."""
    result = np.zeros((len(gradients), len(gradients)))
    with np.errstate(invalid="ignore", over="ignore"):
        for (i, a), (j, b) in product(enumerate(gradients), repeat=2):
            result[i, j] = a[a != 0.0] @ matrix[np.ix_(a != 0.0, b != 0.0)] @ b[b != 0.0]
    return result
