"""All that a report is about, gathered before a word is written."""

from dataclasses import dataclass

import numpy as np

from bayesperiodic import checks
from bayesperiodic.diagnosis.comparison import Comparison, compare
from bayesperiodic.diagnosis.identifiability import Identifiability, identifiability
from bayesperiodic.diagnosis.predictive import Prediction, predict
from bayesperiodic.inference import labels
from bayesperiodic.inference.estimation.estimate import MapEstimate
from bayesperiodic.inference.parameters import SHIFT
from bayesperiodic.inference.problem import Problem
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.reporting import text


@dataclass(frozen=True)
class Evidence:
    """A problem, what was found, and the verdicts; draws, and what rests on them, may be lacking.

    Attributes
    ----------
    unpredicted : str
        Why there is no prediction although there are draws; "" otherwise.
    """

    problem: Problem
    fit: MapEstimate
    posterior: Posterior | None
    identifiability: Identifiability
    comparison: Comparison | None
    prediction: Prediction | None
    unpredicted: str

    @classmethod
    def of(
        cls,
        problem: Problem,
        fit: MapEstimate,
        posterior: Posterior | None,
        found: Identifiability | None,
        comparison: Comparison | None,
        prediction: Prediction | None,
    ) -> "Evidence":
        """Return the evidence, with verdicts that were not given computed.

        Raises
        ------
        ValueError
            If the fit, the posterior or a verdict is of another problem.
        """
        checks.same_names("fit", fit.theta, problem.names)
        checks.same_names("fit", fit.residuals, [e.name for e in problem.experiments])
        if posterior is not None and not _is_of(posterior, problem):
            raise ValueError("posterior: it is not allowed; it is of other parameters or data than the problem's.")
        unpredicted = ""
        if posterior is not None and comparison is None:
            comparison = compare(problem, fit, posterior)
        if posterior is not None and prediction is None:
            try:
                prediction = predict(problem, posterior)
            except RuntimeError as error:
                unpredicted = str(error)
        found = identifiability(problem, fit, posterior, profile=False) if found is None else found
        checks.same_names("identifiability", dict.fromkeys(found.table.index), problem.names)
        if comparison is not None:
            remedy = "give the one of this problem, compare(problem, fit, posterior)"
            checks.holds("comparison", comparison.table.index, problem.names, remedy)
        if prediction is not None:
            checks.same_names("prediction", prediction.median, [e.name for e in problem.experiments])
        return cls(problem, fit, posterior, found, comparison, prediction, unpredicted)

    @property
    def synthetic(self) -> bool:
        """Whether any of the data were simulated."""
        return any(e.synthetic for e in self.problem.experiments)

    def unit(self, name: str) -> str:
        """Return the unit of a parameter, a channel or a noise parameter, by its full name, as it is read."""
        units, (plain, _, place) = self.problem.model.units, name.partition("[")
        if plain == SHIFT:
            return "s"
        if name in self.problem.noise_names:
            channel = units.get(place.rstrip("]").partition(",")[0], "")
            return text.unit(labels.squared(channel) if plain == "variance" and channel else "")
        return text.unit(units.get(plain, ""))


def _is_of(posterior: Posterior, problem: Problem) -> bool:
    """Return whether draws are of a problem's parameters, and were made from its data."""
    if set(posterior.names) != {*problem.names, *problem.free_noise}:
        return False
    data = posterior.data["observed_data"]
    measured = {f"{e.name} {channel}": values for e in problem.experiments for channel, values in e.outputs.items()}
    return set(data.data_vars) == set(measured) and all(
        np.array_equal(data[name].to_numpy(), values) for name, values in measured.items()
    )
