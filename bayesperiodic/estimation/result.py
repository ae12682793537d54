"""Results: the MAP point with its Laplace approximations, and the checks of an estimate."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._expressions import Expression, parse_all
from bayesperiodic._io import Result, Storable
from bayesperiodic._printing import as_text
from bayesperiodic.estimation.conflict import PriorConflict
from bayesperiodic.estimation.intervals import carried_covariance, log_normal_interval, shortest_interval
from bayesperiodic.estimation.laplace import JointLaplace, sds
from bayesperiodic.estimation.modes import Mode, notable
from bayesperiodic.likelihood.input_noise import InputErrors
from bayesperiodic.likelihood.noise import Relative
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.priors.joint import MultivariateNormal
from bayesperiodic.problem.parameters import checked_key, in_experiment, local_hint, local_names

if TYPE_CHECKING:
    import pandas as pd

# Fraction of a channel's variance below which its residual consists of rounding errors of the periodic solves.
ROUNDING_VARIANCE = 1e-16
# Standard deviation of a frequency, relative to that of its measurement, below which it is printed, and how many are.
UPDATED, MOST_FREQUENCIES = 0.8, 3
ROBUST_TAKEN = (
    "Intervals are those of the robust sd: the model is misspecified, and the Laplace sd takes its error for noise "
    "that is independent from value to value."
)
# Difference of the logarithms of two estimates, in standard deviations, up to which they are taken as the same value.
SAME_VALUE = 0.5
# Degrees of freedom from which Student's t is the normal distribution.
MOST_FREEDOM = 1e9


@dataclass(frozen=True)
class Whiteness(Storable):
    """Test by M. S. Bartlett (An Introduction to Stochastic Processes, 1955) of a residual that repeats every period.

    `p` is the probability, for white residuals, of a cumulative periodogram at least as far from a straight line: the
    Kolmogorov-Smirnov distance of the kept harmonics, exact for independent normal values. `lag1` is the circular
    autocorrelation at the distance of two independent values, one period / (2·harmonics + 1). Both are of what the
    parameters leave of the residual: a harmonic of which they take up one component or two is left out. NaN where fewer
    than two harmonics remain, so that nothing can be tested.
    """

    p: float
    lag1: float


@dataclass(frozen=True)
class NoiseSplit(Storable):
    """Standard deviations of one value of a channel's mean period, in the channel's units.

    `measurement` follows from the scatter of the measured cycles, NaN if unknown; `total` is that of the residual,
    corrected for the number of free parameters as in eq. (7); `model` is √(total² − measurement²), or zero.
    """

    measurement: float
    model: float
    total: float


@dataclass(frozen=True)
class FitCheck(Result):
    """Checks of an estimate, made by `check`.

    Attributes
    ----------
    robust_sd : dict of str to float
        Standard deviations that are valid for residuals that deviate from the noise model (sandwich covariance with the
        residual's smoothed spectrum); if they differ much from `MapEstimate.sd`, the noise model is wrong.
    whiteness : dict of str to Whiteness
        Of the residuals in units of the noise model, by channel; with several experiments p is the smallest, corrected
        for their number, lag1 the mean. NaN where no experiment can be tested.
    noise_split : dict of str to NoiseSplit
        Measurement noise and model error of each channel.
    input_noise : dict of str to float
        Standard deviation that the noise of the measured inputs causes in each channel.
    input_nonlinearity : dict of str to float
        By what each estimate is changed by the part of the outputs that is not linear in the errors of the inputs, in
        standard deviations: root mean square over errors drawn given the estimate. NaN if a solve fails.
    doubling_shift : dict of str to float
        Change of each estimate on twice as many points, in standard deviations; NaN if those solves fail.
    prior_conflict : PriorConflict
        Test of the prior against the estimate by the data alone, with its p-values and, if there is one, the conflict
        in words (``text``).
    undetermined : tuple of str
        Changes of parameters, in words, that change no output, confirmed by a change of 10 %, or "a combination of …"
        where only a small change leaves the outputs as they are; in these directions the posterior equals the prior.
    robust_covariance : DataFrame (names × names), optional
        That of `robust_sd`, in natural values; None in files of earlier versions.
    misfit : str, optional
        Why the model is misspecified, by the tests of `predict` at the estimate, or where the data alone are fitted
        best if the prior is in conflict with them; "" if no test rejects it, None in files of earlier versions.

    Examples
    --------
    >>> fit.checks.whiteness["displacement"].p > 0.01, fit.checks.undetermined
    (True, ())
    """

    robust_sd: dict[str, float]
    whiteness: dict[str, Whiteness]
    noise_split: dict[str, NoiseSplit]
    input_noise: dict[str, float]
    input_nonlinearity: dict[str, float]
    doubling_shift: dict[str, float]
    prior_conflict: PriorConflict
    undetermined: tuple[str, ...]
    robust_covariance: pd.DataFrame | None = None
    misfit: str | None = None

    def __repr__(self) -> str:
        columns = ["robust sd", "shift on twice the points"]
        rows = {name: (f"{sd:.3g}", f"{self.doubling_shift[name]:.3g}") for name, sd in self.robust_sd.items()}
        lines = ["FitCheck", as_text(rows, columns)]
        if channels := self.by_channel():
            lines += ["Residuals", as_text(channels)]
        return "\n".join([*lines, *self.remarks()])

    def by_channel(self) -> dict[str, dict[str, str]]:
        """Return the split of the noise and the test of whiteness of each channel, as printed."""
        rows = {}
        for channel, white in self.whiteness.items():
            split = self.noise_split.get(channel, NoiseSplit(np.nan, np.nan, np.nan))
            known = np.isfinite(split.measurement)
            rows[channel] = {
                "measurement noise": f"{split.measurement:.3g}" if known else "-",
                "model error": f"{split.model:.3g}" if known else "-",
                "whiteness p": f"{white.p:.2g}" if np.isfinite(white.p) else "-",
            }
        return rows

    def remarks(self) -> list[str]:
        """Return sentences on a wrong model, a conflict with the prior, what is not tested or not determined."""
        remarks = [f"{self.misfit}."] if self.misfit else []
        remarks += [f"{self.prior_conflict.text}."] if self.prior_conflict.text else []
        if untested := [repr(channel) for channel, white in self.whiteness.items() if not np.isfinite(white.p)]:
            named = ", ".join(untested)
            remarks.append(f"Whiteness of {named} is not tested: the parameters leave fewer than two harmonics.")
        return [*remarks, *(f"Not determined by the data: {text}." for text in self.undetermined)]


@dataclass(frozen=True)
class NoiseEstimate(Storable):
    """Noise parameters of an estimate, see `MapEstimate`."""

    values: dict[str, float]
    prior: str
    independent: dict[str, float]


@dataclass(frozen=True)
class TrueInputs(Storable):
    """Estimated true inputs, see `MapEstimate`."""

    values: dict[str, dict[str, np.ndarray]]
    sd: dict[str, dict[str, np.ndarray]]
    errors: dict[str, InputErrors]
    frequencies: pd.DataFrame | None = None


@dataclass(frozen=True)
class Search(Storable):
    """How an estimate was found, see `MapEstimate`."""

    history: np.ndarray
    starts: tuple[dict[str, float], ...]
    at_ends: tuple[str, ...]
    other_orbits: dict[str, str]
    other_modes: tuple[Mode, ...]
    supports: dict[str, tuple[float, float]] = field(default_factory=dict)


def _part(group: str, name: str) -> Any:
    """Return a property that reads a field of a group, and raises a ValueError if the estimate is without it."""

    def read(self: MapEstimate) -> Any:
        if (values := getattr(self, group)) is None:
            raise ValueError(
                f"{group}: must be computed before {name!r} is used, got an estimate with checks=False; take "
                "map_estimate(problem, start=fit.theta), or for the checks replace(fit, checks=bp.check(problem, fit))."
            )
        return getattr(values, name)

    return property(read, doc=f"``{group}.{name}``, see the attribute ``{group}``.")


@dataclass(frozen=True)
class MapEstimate(Result):
    """Maximum of the posterior density, and the normal approximation around it.

    The density is that over natural values with the variances of eq. (7), whose maximum is not that over the logarithm:
    of ``LogNormal(median, spread)`` alone it is median·exp(−spread²), the mode, and not the median. The two differ
    little for parameters that the data determine; see `over_logarithm` for the others.

    Attributes
    ----------
    status : str
        "converged", "stalled" (no step increased the objective, though one of more than a thousandth of a standard
        deviation was left), "iterations" (their limit was reached), "singular" or "other orbit" (see `other_orbits`).
    theta : dict of str to float
        Estimates, in natural values and the parameters' units.
    covariance : DataFrame (names × names)
        Inverse of H of eq. (8) at these variances, increased where unknown ones make the weights of channels and priors
        uncertain (Kenward and Roger); for `Circulant` noise, with its unknown correlation integrated out.
    degrees_of_freedom : dict of str to float
        Of Student's t of each parameter: the values that determine the variances its standard deviation rests on, less
        what the estimate takes up of them (Satterthwaite); infinite if that rests on known variances and the prior.
    joint : JointLaplace, optional
        `joint_mode`, the mode in sampling coordinates, in natural values of parameters and free noise parameters, and
        `joint_covariance`, the inverse of the exact Hessian there; NaN if it is no maximum. Sampling coordinates are
        the logarithms of noise parameters and of parameters whose prior's support is (0, ∞), and the other parameters.
        None with one optimum and ``map_estimate(checks=False)``; `sample` and `compare` compute it then.
    noise_estimate : NoiseEstimate
        `noise`, all noise parameters by their full names; `noise_prior`, the prior of the variances, in words; and
        `independent`, the independent values behind each variance.
    solutions : dict of str to PeriodicSolution
        By experiment.
    residuals : dict of str to dict of str to array (points,)
        y − ŷ within the kept harmonics, by experiment and channel, with the estimated `inputs`.
    rms, fvu : dict of str to float
        Root mean square of each channel's residuals, and the fraction of the measured variance that they are.
    true_inputs : TrueInputs
        `inputs` (points,) by experiment and input, in their units: the measured ones where ``Problem(input_noise=…)``
        takes them as exact; `input_sd` (points,) given the estimate, zero if exact; and by experiment with noisy inputs
        `input_errors`: independent standard normal errors, `expected` (errors,), what they cause in the predicted
        components, `caused` (components,), and the derivatives of the residual by them, `loadings` L (components,
        errors), at the estimate; L·Lᵀ is what they add to the covariance of the residual.
    search : Search
        `history` (iterations,), the objective before each step and at the end; `starts`, of every start the "objective"
        reached (−inf: none) and the estimates; `at_ends`, parameters that the data act upon and whose estimate lies at
        the end of their support; `other_orbits`, experiments whose fitted orbit is not the measured one (prime period,
        turns of angles, or order of the forcing periods), with the reason in words; and `other_modes`, separate optima
        whose objective is lower by less than 30, see `modes`; `supports`, the ends of the support of each prior.
    tied : dict of str to dict of str to float
        Derivatives of the tied parameters by the free ones at the estimate; NaN where experiments differ.
    fingerprint : str
        Digests of the problem, by which results of another problem are refused.
    frequencies : DataFrame, optional
        A row for each experiment whose frequency was measured with an error: ``measured`` and its standard error ``se``
        [Hz], the ``estimate`` by data and model, and its standard deviation ``sd``. The estimates of the parameters
        take the error into account.
    checks : FitCheck, optional
        What `check` gives, whose fields are attributes of the estimate too; None with ``map_estimate(checks=False)``.

    Examples
    --------
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> for name, value in fit.theta.items():
    ...     print(f"{name} = {value:.3f} ± {fit.sd[name]:.3f}")
    c = 0.199 ± 0.001
    k = 1.001 ± 0.001
    >>> low, high = fit.interval(0.9)["k"]
    >>> fit.misspecified
    False
    >>> low < 1.0 < high, fit.whiteness["displacement"].p > 0.01
    (True, True)
    """

    status: str
    theta: dict[str, float]
    covariance: pd.DataFrame
    degrees_of_freedom: dict[str, float]
    joint: JointLaplace | None
    noise_estimate: NoiseEstimate
    solutions: dict[str, PeriodicSolution]
    residuals: dict[str, dict[str, np.ndarray]]
    rms: dict[str, float]
    fvu: dict[str, float]
    true_inputs: TrueInputs
    search: Search
    tied: dict[str, dict[str, float]]
    fingerprint: str
    checks: FitCheck | None = None

    joint_mode, joint_covariance = _part("joint", "mode"), _part("joint", "covariance")
    noise, noise_prior = _part("noise_estimate", "values"), _part("noise_estimate", "prior")
    independent = _part("noise_estimate", "independent")
    inputs, input_sd = _part("true_inputs", "values"), _part("true_inputs", "sd")
    input_errors, frequencies = _part("true_inputs", "errors"), _part("true_inputs", "frequencies")
    history, starts, at_ends, other_orbits, other_modes, supports = (
        _part("search", part.name) for part in fields(Search)
    )
    robust_sd, whiteness, noise_split, input_noise, input_nonlinearity, doubling_shift, prior_conflict, undetermined = (
        _part("checks", part.name) for part in fields(FitCheck)[:8]
    )
    robust_covariance, misfit = _part("checks", "robust_covariance"), _part("checks", "misfit")

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviations, from `covariance`."""
        return sds(self.covariance)

    @property
    def variances(self) -> dict[str, float]:
        """Noise variance of each channel (or "channel, experiment"), and "scale"; by eq. (7) or fixed.

        As the noise model defines it: for `Independent` noise that of one measured sample.
        """
        return {name: self.noise.get(f"variance[{name}]", self.noise.get(name)) for name in self.independent}

    @property
    def converged(self) -> bool:
        """True if the status is "converged"."""
        return self.status == "converged"

    @property
    def modes(self) -> pd.DataFrame:
        """Separate optima, the estimate first: objective, fraction of the mass by Laplace, and parameters."""
        import pandas as pd

        best = {"objective": float(self.history[-1]), "mass": 1.0 - sum(mode.mass for mode in self.other_modes)}
        rows = [{"objective": mode.objective, "mass": mode.mass} | mode.theta for mode in self.other_modes]
        return pd.DataFrame([best | self.theta, *rows])

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
    def over_logarithm(self) -> dict[str, float]:
        """Values at `joint_mode` of positive parameters whose estimates differ by more than half a standard deviation.

        The standard deviation is that of the logarithm. The data do not determine such a parameter to better than half
        of its value; without `joint` there are none.
        """
        result = {}
        for name, (low, high) in self.supports.items() if self.joint and self.joint_mode else ():
            if (low, high) == (0.0, np.inf) and self.theta[name] > 0.0:
                other, variance = self.joint_mode[name], self.joint_covariance.loc[name, name]
                if np.log(other / self.theta[name]) ** 2 > SAME_VALUE**2 * variance:
                    result[name] = other
        return result

    @property
    def correlations(self) -> pd.DataFrame:
        """Correlations of the parameters, from `covariance`."""
        sd = np.sqrt(np.diag(self.covariance))
        return self.covariance.div(np.outer(sd, sd))

    @property
    def misspecified(self) -> bool:
        """Whether tests reject the model, see ``FitCheck.misfit``; robust intervals are the valid ones then."""
        return bool(self.checks and self.checks.misfit)

    def interval(self, probability: float = 0.9, *, robust: bool | None = None) -> dict[str, tuple[float, float]]:
        """Return the interval of each parameter, by Student's t with `degrees_of_freedom`, within its prior's support.

        It is symmetric about the estimate, or about the logarithm at `joint_mode` for those of `over_logarithm` whose
        density is nearer to a log-normal than to a normal one, such as a LogNormal prior that the data leave as it is.
        Near an end of the support Student's t is restricted to the support, and where the symmetric interval would
        leave it, the interval ends there and is one-sided.

        Parameters
        ----------
        probability : float
            Between 0 and 1.
        robust : bool, optional
            Take `robust_sd` instead of `sd`; by default where the model is `misspecified`.

        Returns
        -------
        dict of str to (float, float)
            In the parameters' units; the support where the standard deviation is infinite.

        Raises
        ------
        ValueError
            If the probability is not between 0 and 1.
        """
        if not 0.0 < _checks.finite_number("probability", probability) < 1.0:
            raise ValueError(f"probability: must be between 0 and 1, got {probability!r}.")
        sds = self.robust_sd if (self.misspecified if robust is None else robust) else self.sd
        result, logarithms = dict[str, tuple[float, float]](), self.over_logarithm
        for name, value in self.theta.items():
            freedom, sd = min(self.degrees_of_freedom[name], MOST_FREEDOM), sds[name]
            low, high = self.supports.get(name, (-np.inf, np.inf))
            if not np.isfinite(sd):
                result[name] = (low, high) if sd == np.inf else (np.nan, np.nan)
                continue
            ends = None
            if name in logarithms:
                spread, both = float(self.joint_covariance.loc[name, name]) ** 0.5, (value, logarithms[name])
                ends = log_normal_interval(freedom, probability, both, spread, sd / self.sd[name])
            below, above = shortest_interval(freedom, probability, (low - value) / sd, (high - value) / sd)
            result[name] = ends or (max(value + sd * below, low), min(value + sd * above, high))
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
        damping_ratio  0.0996  0.0003
        """
        import pandas as pd

        if experiment is not None:
            _checks.one_of("experiment", experiment, self.solutions)
        named = in_experiment(self.theta, experiment)
        values = self._fixed(experiment) | {plain: self.theta[name] for plain, name in named.items()}
        hint, local = local_hint(self.theta, self.solutions, experiment), local_names(self.theta, self.solutions)
        quantities = parse_all("expressions", expressions, values, local, hint)
        at = {name: float(quantity.value(values)) for name, quantity in quantities.items()}
        for name, value in at.items():
            if not np.isfinite(value):
                raise ValueError(
                    f"expressions[{name!r}]: must be finite at the estimate, got {value} for {quantities[name].text!r}."
                )
        gradients = [self._gradient(quantity, values, named) for quantity in quantities.values()]
        covariance = carried_covariance(self.covariance.to_numpy(), gradients)
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
        free = {*self.theta, *(local_names(self.theta, self.solutions) if experiment is None else ())}
        first, *others = (solution.parameters for run, solution in self.solutions.items() if experiment in (None, run))
        return {
            name: value
            for name, value in first.items()
            if name not in free and all(other.get(name) == value for other in others)
        }

    @property
    def noisy_inputs(self) -> bool:
        """Whether errors of inputs are part of the covariance of the residual."""
        return any(sd.any() for name in self.input_errors for sd in self.input_sd[name].values())

    def _on_frequencies(self) -> list[str]:
        """Return a sentence on frequencies that the model determines better than the recording."""
        table = self.frequencies
        if table is None or not self.input_errors or not len(table := table[table["sd"] < UPDATED * table["se"]]):
            return []
        rows = [
            f"{row.estimate:.9g} ± {row.sd:.2g} Hz in {name!r} (recording: {row.measured:.9g} ± {row.se:.2g} Hz)"
            for name, row in table.iloc[:MOST_FREQUENCIES].iterrows()
        ]
        more = f" and {len(table) - len(rows)} more" if len(table) > len(rows) else ""
        return [f"Frequencies by data and model: {', '.join(rows)}{more}."]

    @property
    def without_noise(self) -> tuple[str, ...]:
        """Channels of unknown variance whose residuals are rounding errors: no standard deviation follows from them.

        None where errors of the inputs may explain all of the residuals.
        """
        explained = any(errors.loadings.any() for errors in self.input_errors.values())
        names = {name.partition(", ")[0] for name in self.independent if not explained}
        return tuple(c for c, part in self.fvu.items() if names & {c, Relative.pooled} and part < ROUNDING_VARIANCE)

    def __repr__(self) -> str:
        status = self.status if self.converged else f"NOT CONVERGED: {self.status}; try another start, or starts=8"
        if self.without_noise:
            status = f"{self.status}; {', '.join(self.without_noise)} without noise"
        spreads = {"Laplace sd": self.sd} | ({"robust sd": self.checks.robust_sd} if self.checks else {})
        columns = ["estimate", *(sorted(spreads, reverse=True) if self.misspecified else spreads)]
        rows = {
            name: (f"{value:.6g}", *(f"{spreads[column][name]:.3g}" for column in columns[1:]))
            for name, value in self.theta.items()
        } | {name: (f"{value:.4g}", *"-" * len(spreads)) for name, value in self.noise.items()}
        more = self.checks.by_channel() if self.checks else {}
        channels = {
            channel: {"rms": f"{rms:.4g}", "unexplained variance": f"{self.fvu[channel]:.2%}"} | more.get(channel, {})
            for channel, rms in self.rms.items()
        }
        lines = [f"MapEstimate ({status})", as_text(rows, columns)]
        lines += [ROBUST_TAKEN] if self.misspecified else []
        lines += ["Residuals", as_text(channels)] if channels else []
        lines += [f"The noise has the {self.noise_prior}."] if self.noise else []
        if self.noisy_inputs and self.checks:
            caused = ", ".join(f"{sd:.3g} in {channel}" for channel, sd in self.checks.input_noise.items())
            lines.append(f"The noise of the inputs, included in the covariance, causes {caused}.")
        lines += self._on_frequencies()
        lines += [
            f"The orbit is another one than the recorded one in {name!r}: {text}."
            for name, text in self.other_orbits.items()
        ]
        lines += self.checks.remarks() if self.checks else ["Not checked, see bp.check(problem, fit)."]
        lines += [
            f"Not determined to a single value: {name}. The density has its maximum at {self.theta[name]:.4g} over the "
            f"value and at {other:.4g} over the logarithm (fit.joint_mode); sample it."
            for name, other in self.over_logarithm.items()
        ]
        lines += [f"Another optimum: {mode!r}." for mode in notable(self.other_modes)]
        return "\n".join(lines)


def orbit_advice(fit: MapEstimate) -> str:
    """Return what to do first if orbits of a fit are not the measured ones; empty otherwise."""
    runs = ", ".join(map(repr, fit.other_orbits))
    return f"first fit the measured orbit of {runs}, see fit.other_orbits" if runs else ""
