"""Structure: what `structure` finds, as plain data that print themselves."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from bayesperiodic.store import Result


@dataclass(frozen=True)
class Symmetry:
    """A change of parameters, and of states that are not measured, that leaves all measured outputs as they are.

    Attributes
    ----------
    kind : {"scaling", "shift", "other"}
        "shift" adds a constant to a parameter or a state, and may transform others along with it.
    parameters : tuple of str
        Those that change: knowing any one of them removes the symmetry.
    generator : dict of str to str
        Parameter or state -> its infinitesimal change.
    transformation : dict of str to str
        Parameter or state -> its image under the finite transformation, whose amount is `amount`; confirmed by exact
        substitution in the equations. Empty if no closed form was found.
    amount : str
        Name of the amount: a factor > 0 of scalings, otherwise a number that is 0 where nothing changes.
    factor : tuple of tuple of str
        The matrix that the transformation multiplies the equations by.
    no_help : tuple of str
        Determined or other parameters that enter the same combinations, but do not remove the symmetry if known.
    """

    kind: str
    parameters: tuple[str, ...]
    generator: dict[str, str]
    transformation: dict[str, str]
    amount: str
    factor: tuple[tuple[str, ...], ...]
    no_help: tuple[str, ...]

    def __repr__(self) -> str:
        if self.transformation:
            return f"{self.kind}: {', '.join(f'{name} → {image}' for name, image in self.transformation.items())}"
        changes = ", ".join(f"d({name}) = {move}" for name, move in self.generator.items())
        return f"{self.kind}: {changes} (infinitesimally; no closed form found)"


@dataclass(frozen=True)
class Structure(Result):
    """Which parameters, and which combinations of them, equations and measured outputs determine at all.

    Attributes
    ----------
    model : str
        Its name.
    outputs : tuple of str
        What is measured.
    known : tuple of str
        Parameters taken as known.
    table : DataFrame
        A row a parameter that is not known. verdict: "determined", "only in combination", "not determined" (no
        combination with it either) or "does not appear"; enters: the combinations (of a determined parameter: the
        coefficients without undetermined ones) by which it enters; fix: the numbers, from 1, of the symmetries that
        knowing it removes; partners: others that determine it once one of them is known.
    combinations : tuple of str
        Independent combinations that are determined, of the parameters that are not; texts that `derive` takes. With
        directions that are `unexplained`, confirmed along these at random values only.
    symmetries : tuple of Symmetry
        Independent of each other.
    to_fix : tuple of str
        The first parameters, in the model's order, that leave no symmetry once they are known.
    rank : int or None
        Number of directions of the parameters (without those that do not appear) that the outputs react to, the rank
        of exact sensitivities at random values of the parameters; None where it could not be computed.
    points : int
        Number of these random values.
    unexplained : tuple of str
        Parameters in directions that no output reacted to and that no symmetry found explains.

    Examples
    --------
    >>> import bayesperiodic as bp
    >>> found = bp.structure(bp.models.duffing, fixed=["k"])
    >>> found.complete, found.table["verdict"].to_dict()
    (True, {'m': 'determined', 'c': 'determined', 'k3': 'determined'})
    >>> swing = bp.structure(bp.models.pendulum, fixed=["a", "g", "v0"])
    >>> swing.symmetries
    (scaling: m → m*t, k1 → k1*t, k2 → k2*t, k3 → k3*t,)
    """

    model: str
    outputs: tuple[str, ...]
    known: tuple[str, ...]
    table: pd.DataFrame
    combinations: tuple[str, ...]
    symmetries: tuple[Symmetry, ...]
    to_fix: tuple[str, ...]
    rank: int | None
    points: int
    unexplained: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """True if the rank confirms that there is no symmetry but those found."""
        return self.rank is not None and not self.unexplained

    def __repr__(self) -> str:
        known = f"; known: {', '.join(self.known)}" if self.known else ""
        lines = [f"Structure of {self.model}, measured: {', '.join(self.outputs)}{known}"]
        lines += self._verdicts() + self._changes()
        return "\n".join([*lines, f"  {self._confirmation()}"])

    def _verdicts(self) -> list[str]:
        named = {v: list(self.table.index[self.table["verdict"] == v]) for v in self.table["verdict"].unique()}
        lines = []
        if names := named.get("determined"):
            lines.append(f"  Determined: {', '.join(map(self._through, names))}.")
        if names := named.get("only in combination"):
            missing = len(names) - len(self.to_fix) - len(self.combinations)
            more = f" and {missing} more without a closed form" * (missing > 0)
            forms = f", which enter only by {', '.join(self.combinations)}{more}" if self.combinations else ""
            lines.append(f"  Only in combination: {', '.join(names)}{forms}.")
        for verdict in ("not determined", "does not appear"):
            if names := named.get(verdict):
                lines.append(f"  {verdict.capitalize()}: {', '.join(names)}.")
        return lines

    def _through(self, name: str) -> str:
        """Return a determined parameter, with what determines it if it enters a combination with others too."""
        terms = str(self.table.at[name, "enters"])
        shared = any(name in symmetry.no_help for symmetry in self.symmetries)
        return f"{name} through {_listed(terms.split('; '), 'and')}" if shared and terms else name

    def _changes(self) -> list[str]:
        if not self.symmetries:
            return []
        lines = ["  Changes that leave the equations and the outputs as they are, confirmed by exact substitution:"]
        for number, symmetry in enumerate(self.symmetries, 1):
            wanted = "" if len(symmetry.parameters) == 1 else "one of "
            helpless = f"; fixing {_listed(symmetry.no_help, 'or')} does not help" if symmetry.no_help else ""
            lines += [f"    {number}. {symmetry!r}", f"       Fix {wanted}{', '.join(symmetry.parameters)}{helpless}."]
        if len(self.to_fix) == 1:
            return lines
        lines.append(f"  {len(self.to_fix)} parameters must be fixed, for example {_listed(self.to_fix, 'and')}.")
        order = list(self.table.index)
        groups = {tuple(sorted((n, *p.split(", ")), key=order.index)) for n, p in self.table["partners"].items() if p}
        if groups:
            told = [", ".join(group) for group in sorted(groups, key=lambda g: order.index(g[0]))]
            lines.append(f"  Knowing one of a group determines the rest of it: {'; '.join(told)}.")
        return lines

    def _confirmation(self) -> str:
        if self.rank is None:
            return "The rank of exact sensitivities is not available, so further symmetries are not ruled out."
        appearing = int((self.table["verdict"] != "does not appear").sum())
        if not appearing:
            return "No unknown parameter appears."
        said = f"Rank of exact sensitivities at {self.points} random parameter values: {self.rank} of {appearing}"
        if self.unexplained:
            return f"{said}; further changes, for which no form was found, involve {', '.join(self.unexplained)}."
        return f"{said}, so no other change leaves the outputs as they are."


def _listed(names: Sequence[str], conjunction: str) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {conjunction} {names[-1]}"
