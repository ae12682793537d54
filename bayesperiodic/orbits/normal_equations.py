"""Normal equations of local polynomials, with regressors corrected for noise in the arguments."""

from functools import cache
from itertools import combinations_with_replacement
from math import comb
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.special import factorial

MOST_LEVERAGE = 0.9
# Eigenvalues of normal equations below this fraction of the largest one are left out.
NEARLY_SINGULAR = 1e-10
# Distance over which a slope changes by its prior standard deviation, in more than two coordinates.
CURVATURE_LENGTH = 0.1


@cache
def monomials(coordinates: int, degree: int) -> np.ndarray:
    """Return the powers (terms, coordinates) of all monomials up to a degree, such as 1, u, v, uu, uv, vv."""
    factors = (one for n in range(degree + 1) for one in combinations_with_replacement(range(coordinates), n))
    return np.array([np.bincount(np.array(one, dtype=int), minlength=coordinates) for one in factors])


class Terms(NamedTuple):
    """Terms of polynomials of one degree, and where their products are.

    A product of two terms is a monomial of the other coordinates times a power of the last one.
    """

    powers: np.ndarray  # (terms, d)
    factorials: np.ndarray  # products of the factorials of the powers, (terms,)
    row: np.ndarray  # of the product of two terms, among monomials of the other coordinates, (terms, terms)
    column: np.ndarray  # power of the last coordinate in it, (terms, terms)
    sizes: list[int]  # number of monomials of the other coordinates that each power of the last one goes with
    belongs: csr_array  # which product two terms have, by the power and then the monomial, (terms·terms, products)


@cache
def terms_of(coordinates: int, degree: int) -> Terms:
    """Return the terms of polynomials of a degree."""
    powers, others = monomials(coordinates, degree), monomials(coordinates - 1, 2 * degree)
    sums = powers[:, None] + powers
    row, column = np.argmax(np.all(sums[..., None, :-1] == others, axis=-1), axis=-1), sums[..., -1]
    # Monomials are in the order of their degree: those that a power goes with are the first ones.
    sizes = [comb(coordinates - 1 + rest, rest) for rest in range(2 * degree, -1, -1)]
    place = (np.cumsum(sizes) - sizes)[column] + row
    pairs = np.arange(place.size)
    belongs = csr_array((np.ones(place.size), (pairs, place.ravel())), shape=(place.size, sum(sizes)))
    return Terms(powers, factorial(powers).prod(1), row, column, sizes, belongs)


class NormalEquations(NamedTuple):
    """Normal equations of local polynomials about m centres, with n neighbours each."""

    regressors: np.ndarray  # the terms, (m, terms, n)
    rows: np.ndarray  # monomials of all coordinates but the last up to twice the degree, (m, rows, n)
    last: np.ndarray  # powers of the last coordinate, (m, powers, n)
    terms: Terms
    normal: np.ndarray  # (m, terms, terms)
    inverse: np.ndarray  # of the same, or with shrinkage
    scale: np.ndarray  # derivatives over coefficients, (m, terms, 1)
    effective: np.ndarray  # effective number of neighbours, (m,)

    @classmethod
    def of(cls, by_coordinate: list[np.ndarray], bandwidth: np.ndarray, degree: int) -> "NormalEquations":
        """Return those of `deconvoluted` powers of each coordinate, in units of the bandwidths (m,)."""
        d, weight = len(by_coordinate), by_coordinate[0][:, 0]
        terms = terms_of(d, degree)
        rows = products(by_coordinate[:-1], 2 * degree) if d > 1 else np.ones((1, 1, weight.shape[1]))
        regressors = with_last(rows, by_coordinate, degree)
        # The sums of products by powers of the last coordinate: one matrix product.
        table = rows @ by_coordinate[-1].mT
        normal = table[:, terms.row, terms.column]
        effective = weight.sum(1) ** 2 / (weight**2).sum(1)
        scale = (terms.factorials / bandwidth[:, None] ** terms.powers.sum(1))[..., None]
        return cls(regressors, rows, by_coordinate[-1], terms, normal, inverse_of(normal), scale, effective)

    def shrunk(self, target: np.ndarray, bandwidth: np.ndarray, steepest: float) -> "NormalEquations":
        """Return the same with the shrinkage that the residuals of targets (m, n, values) ask for.

        Targets are in units of their size, and `steepest` is the prior standard deviation of slopes. With one or two
        coordinates there is no shrinkage.
        """
        orders, weight = self.terms.powers.sum(1), self.regressors[:, 0]
        if self.terms.powers.shape[1] <= 2:
            return self
        sums = self.regressors @ target
        rest = np.einsum("mn,mnc->mc", weight, target**2) - (self.inverse @ sums * sums).sum(1)
        free = np.maximum(self.effective - len(orders), 1.0) / self.effective
        variance = np.maximum(rest, 0.0).max(1) / weight.sum(1) / free
        prior = steepest * bandwidth[:, None] * (bandwidth[:, None] / CURVATURE_LENGTH) ** (orders - 1.0)
        shrinkage = np.where(orders > 0, variance[:, None] / prior**2, 0.0)
        return self._replace(inverse=inverse_of(self.normal + shrinkage[:, :, None] * np.eye(len(orders))))

    def solve(self, target: np.ndarray) -> np.ndarray:
        """Return the coefficients (m, terms, values) of polynomials through targets (m, n, values)."""
        return self.inverse @ (self.regressors @ target)

    def influence(self, target: np.ndarray, solution: np.ndarray, orders: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the contribution (m, k, n) of each neighbour to the errors of k combinations of the coefficients.

        Each is a combination of value and slopes, `orders` (…, k, 1 or 1 + d), of a combination of the fitted values,
        `values` (…, k, values).
        """
        # Residuals of each neighbour's normal equations at the solution, corrected for its leverage.
        some = slice(orders.shape[-1])
        first, coefficients = orders @ (self.scale[:, some] * self.inverse[:, some]), values @ solution.mT
        residual = (first @ self.regressors) * (values @ target.mT)
        residual -= self._of_products(np.einsum("mka,mkb->mkab", first, coefficients))
        residual /= 1.0 - np.clip(self._of_products(self.inverse[:, None]), 0.0, MOST_LEVERAGE)
        return residual

    def _of_products(self, weights: np.ndarray) -> np.ndarray:
        """Return sums (m, k, n) of the products of two terms with weights (m, k, terms, terms)."""
        m, k = weights.shape[:2]
        by_product = np.asarray(weights.reshape(m * k, -1) @ self.terms.belongs).reshape(m, k, -1)
        result, start = np.zeros((m, k, self.last.shape[-1])), 0
        for power, size in enumerate(self.terms.sizes):
            part = by_product[..., start : start + size] @ self.rows[:, :size]
            part *= self.last[:, power, None]
            result += part
            start += size
        return result


def deconvoluted(away: np.ndarray, noise: np.ndarray, highest: int) -> list[np.ndarray]:
    """Return, by coordinate, functions (m, power, n) whose expectations are the powers, the first times the kernel.

    The noise is that of each neighbour (m, n, d), or of all (m, 1, d).

    x^a exp(−x²/2) is the expectation, over noise of variance s², of the Gaussian of variance 1 − s² times the a-th
    moment of a normal distribution with mean x/(1 − s²) and the negative variance −s²/(1 − s²).
    """
    left, moments = 1.0 - noise**2, []
    exponent, divisor = np.zeros(away.shape[:2]), np.sqrt(left.prod(axis=-1))
    for k, rest in enumerate(np.moveaxis(left, -1, 0)):
        mean, variance = away[..., k] / rest, (rest - 1.0) / rest
        exponent -= 0.5 * rest * mean**2
        rows = np.empty((len(away), highest + 1, away.shape[1]))
        rows[:, 0], rows[:, 1] = 1.0, mean
        for order in range(2, highest + 1):
            np.multiply(mean, rows[:, order - 1], out=rows[:, order])
            rows[:, order] += (order - 1) * variance * rows[:, order - 2]
        moments.append(rows)
    moments[0] *= (np.exp(exponent) / divisor)[:, None]
    return moments


def inverse_of(normal: np.ndarray) -> np.ndarray:
    """Return the inverses of symmetric matrices (m, k, k), without the smallest eigenvalues where they are singular."""
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(normal, rcond=NEARLY_SINGULAR, hermitian=True)
    # Frobenius norms bound the ratio of the largest and smallest eigenvalue.
    condition = np.linalg.norm(normal, axis=(1, 2)) * np.linalg.norm(inverse, axis=(1, 2))
    singular = ~(condition < 1.0 / NEARLY_SINGULAR)
    if singular.any():
        inverse[singular] = np.linalg.pinv(normal[singular], rcond=NEARLY_SINGULAR, hermitian=True)
    return inverse


def products(by_coordinate: list[np.ndarray], degree: int) -> np.ndarray:
    """Return products (m, terms, n) of the functions of each coordinate with the powers of all monomials."""
    if not by_coordinate:
        return np.ones((1, 1, 1))
    return with_last(products(by_coordinate[:-1], degree), by_coordinate, degree)


def with_last(rows: np.ndarray, by_coordinate: list[np.ndarray], degree: int) -> np.ndarray:
    """Return the same, given those of all coordinates but the last."""
    row, column = _nested(len(by_coordinate), degree)
    result = by_coordinate[-1][:, column]
    result *= rows[:, row]
    return result


@cache
def _nested(coordinates: int, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where each monomial is among those of all coordinates but the last, and the power of the last."""
    powers, others = monomials(coordinates, degree), monomials(coordinates - 1, degree)
    return np.argmax(np.all(powers[:, None, :-1] == others, axis=-1), axis=-1), powers[:, -1]
