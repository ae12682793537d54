"""Orbit and Orbits: unstable periodic orbits as they were found in a section, and polished with a model."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.orbits.as_experiment import orbit_experiment
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.store import Result

if TYPE_CHECKING:
    import pandas as pd

_COLUMNS = (
    "name", "period", "winding", "returns", "quality", "multiplier", "multiplier_sd", "contraction", "contraction_sd",
    "estimated", "modulus", "sd_first", "sd_second", "partner", "equilibrium", "rejected",
)  # fmt: skip


@dataclass(frozen=True)
class Orbit(Result):
    """One periodic orbit of a section.

    Attributes
    ----------
    name : str
        Unique among the orbits of a section, such as ``"period 3, winding 1, orbit 2"``.
    coordinates : tuple of str
        The two outputs of the model that the section shows.
    angles : tuple of str
        The coordinates that are angles.
    frequency : float
        Of the forcing [Hz].
    period : int
        Prime period in forcing periods.
    winding : int or None
        Turns of the angle per response period; None where the section cannot tell, 0 where no coordinate is an angle.
    points : array (period, 2)
        Section values at tau = 0, 1, …, angles in (−π, π].
    joint_covariance : array (2·period + 2, 2·period + 2)
        Of the points, point by point, and of log|eigenvalue|, largest first; NaN for eigenvalues that are not
        estimated.
    eigenvalues : array (2,)
        Of the linearised return map over the period, largest modulus first, real or complex.
    eigenvalue_bias : array (2,)
        Estimated bias of log|eigenvalue|, which was not taken off.
    returns : int
        Measured close returns behind the orbit.
    quality : float
        P-value of the returns under the orbit and its linearised map; small where there is no orbit.
    partner : int or None
        Position of the orbit with all signs changed among the orbits; its own where it is symmetric.
    cycle : mapping of str to array (samples·period,) or None
        The closest measured cycle by coordinate, angles running on without jumps; None where the section is of points
        alone.
    solution : PeriodicSolution or None
        The model's orbit, once polished.
    equilibrium : bool
        Whether it is a state of rest, which says little of the parameters.
    synthetic : bool
        True if the data were simulated.

    Examples
    --------
    The fixed point of the Hénon map, x = (√6.09 − 0.7)/2.8; its multipliers are the roots of μ² + 2.8 x μ = 0.3:

    >>> import numpy as np, bayesperiodic as bp
    >>> x = np.zeros((2000, 2))
    >>> for k in range(1999):
    ...     x[k + 1] = 1 - 1.4 * x[k, 0] ** 2 + x[k, 1], 0.3 * x[k, 0]
    >>> section = bp.PoincareSection.from_points(x[100:], ("x", "y"), frequency=1.0)
    >>> orbit = bp.find_orbits(section, periods=[1])[0]
    >>> orbit.points.round(4).tolist(), orbit.eigenvalues.round(3).tolist()
    ([[0.6314, 0.1894]], [-1.924, 0.156])
    """

    name: str
    coordinates: tuple[str, str]
    angles: tuple[str, ...]
    frequency: float
    period: int
    winding: int | None
    points: np.ndarray
    joint_covariance: np.ndarray
    eigenvalues: np.ndarray
    eigenvalue_bias: np.ndarray
    returns: int
    quality: float
    partner: int | None = None
    cycle: Mapping[str, np.ndarray] | None = None
    solution: PeriodicSolution | None = None
    equilibrium: bool = False
    synthetic: bool = False

    def __repr__(self) -> str:
        kind = ", at rest" if self.equilibrium else ""
        large = self.eigenvalues[0]
        shown = f"{large.real:.5g}" if np.isreal(large) else f"{large.real:.4g} ± {abs(large.imag):.4g}i"
        sd = self.eigenvalue_sd[0]
        error = f"sd {sd:.2g}" if np.isfinite(sd) else "sd not estimated"
        return f"Orbit({self.name!r}{kind}: eigenvalue {shown} ({error}), {self.returns} returns)"

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the points, (2·period, 2·period), point by point."""
        size = self.points.size
        return self.joint_covariance[:size, :size]

    @property
    def eigenvalue_sd(self) -> np.ndarray:
        """Standard deviations of the eigenvalues' moduli, (2,); NaN where not estimated."""
        size = self.points.size
        return np.abs(self.eigenvalues) * np.sqrt(np.diag(self.joint_covariance)[size:])

    def experiment(
        self,
        *,
        samples: int = 800,
        multipliers: bool = False,
        whole: bool = False,
        states: Mapping[str, str] | None = None,
    ) -> Experiment:
        """Return the orbit as an experiment: its section points at tau = 0, 1, …, as in de Kraker et al. (1997).

        Their covariance is known up to one factor, the noise parameter "scale", common to all orbits of a problem.

        Parameters
        ----------
        samples : int
            Grid points per forcing period.
        multipliers : bool
            Compare the unstable eigenvalues too, as log|μ| with fixed sign and with the covariance they share with the
            points. One that is complex, not estimated, or whose bias exceeds half its standard deviation is left out,
            and so is every smaller one.
        whole : bool
            Compare all samples of the measured cycle instead, with a variance per channel. A cycle that is but a close
            return does not close; the gap counts as noise.
        states : mapping of str to str, optional
            Which coordinate is which state of the model, such as ``{"phi": "angle"}``: the first solve then starts from
            the measured cycle. By default it starts from the polished solution.

        Returns
        -------
        Experiment

        Raises
        ------
        ValueError
            If the orbit is not polished and `states` or the winding are not known, if `whole` or `states` are given and
            there is no measured cycle, if `samples` is no multiple of the cycle's.

        Warns
        -----
        UserWarning
            If an unstable eigenvalue is left out.
        """
        return orbit_experiment(self, samples=samples, multipliers=multipliers, whole=whole, states=states)


@dataclass(frozen=True)
class Orbits(Result):
    """The orbits found in a section, and what was not taken.

    Attributes
    ----------
    orbits : tuple of Orbit
    rejected : tuple of (Orbit, str)
        With the reason.
    values : int
        Numbers in the recording or section from which they were found.
    method : str
        "chained" or "boxes", see `find_orbits`.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> x = np.zeros((2000, 2))
    >>> for k in range(1999):
    ...     x[k + 1] = 1 - 1.4 * x[k, 0] ** 2 + x[k, 1], 0.3 * x[k, 0]
    >>> section = bp.PoincareSection.from_points(x[100:], ("x", "y"), frequency=1.0)
    >>> orbits = bp.find_orbits(section, periods=[1, 2])
    >>> len(orbits), orbits[1].name, orbits.rejected
    (2, 'period 2, winding 0, orbit 1', ())
    >>> orbits.table[["period", "modulus"]].round(3)
       period  modulus
    0       1    1.924
    1       2    3.010
    """

    orbits: tuple[Orbit, ...]
    rejected: tuple[tuple[Orbit, str], ...] = field(default=())
    values: int = 0
    method: str = ""

    @property
    def table(self) -> "pd.DataFrame":
        """One row an orbit, those not taken below with their reason.

        Columns: name, period, winding (missing where unknown), returns, quality, multiplier and contraction (the two
        eigenvalues), their standard deviations (NaN: not estimated), `estimated` (whether that of the multiplier is),
        modulus of the multiplier, largest standard deviation of a point in the first and in the second coordinate,
        the partner's name, equilibrium, rejected (the reason, empty for orbits that were taken).
        """
        import pandas as pd

        names = [orbit.name for orbit in self.orbits]
        rows = [_row(orbit, names, "") for orbit in self.orbits]
        rows += [_row(orbit, names, reason) for orbit, reason in self.rejected]
        table = pd.DataFrame(rows, columns=list(_COLUMNS))
        return table.astype({"winding": "Int64"})

    def __repr__(self) -> str:
        if not self.orbits:
            return f"Orbits(none, {len(self.rejected)} rejected)"
        counts = [(p, sum(o.period == p for o in self.orbits)) for p in sorted({o.period for o in self.orbits})]
        listed = ", ".join(f"{count} of period {period}" for period, count in counts)
        return (
            f"Orbits({listed}; {len(self.rejected)} rejected; method {self.method!r}, from {self.values:,} numbers)\n"
            f"{self.table.drop(columns=['rejected']).head(len(self.orbits)).to_string(index=False)}"
        )

    def __len__(self) -> int:
        return len(self.orbits)

    def __getitem__(self, index: int) -> Orbit:
        return self.orbits[index]

    def __iter__(self) -> Iterator[Orbit]:
        return iter(self.orbits)


def _row(orbit: Orbit, names: list[str], reason: str) -> tuple[Any, ...]:
    sds = np.sqrt(np.diag(orbit.covariance)).reshape(-1, 2).max(axis=0)
    multiplier, contraction = (value.real if np.isreal(value) else value for value in orbit.eigenvalues)
    partner = "" if orbit.partner is None or orbit.partner >= len(names) else names[orbit.partner]
    return (
        orbit.name,
        orbit.period,
        orbit.winding,
        orbit.returns,
        orbit.quality,
        multiplier,
        orbit.eigenvalue_sd[0],
        contraction,
        orbit.eigenvalue_sd[1],
        bool(np.isfinite(orbit.eigenvalue_sd[0])),
        float(abs(orbit.eigenvalues[0])),
        *sds,
        partner,
        orbit.equilibrium,
        reason,
    )
