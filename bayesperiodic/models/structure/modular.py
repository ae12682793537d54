"""Linear algebra modulo a prime: exact ranks of matrices of polynomials, at random values of their symbols."""

import math

import numpy as np
import sympy as sp
from sympy.polys.matrices import DomainMatrix

PRIME = 2_147_483_629


def reduced(matrix: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Return the reduced row echelon form of an integer matrix modulo the prime, and its pivot columns."""
    rows = np.array(matrix, dtype=np.int64) % PRIME
    pivots: list[int] = []
    for column in range(rows.shape[1]):
        top = len(pivots)
        below = np.flatnonzero(rows[top:, column])
        if not below.size:
            continue
        rows[[top, top + below[0]]] = rows[[top + below[0], top]]
        rows[top] = rows[top] * pow(int(rows[top, column]), -1, PRIME) % PRIME
        others = np.flatnonzero(rows[:, column])
        others = others[others != top]
        rows[others] = (rows[others] - rows[others, column, None] * rows[top] % PRIME) % PRIME
        pivots.append(column)
    return rows[: len(pivots)], pivots


def rank(matrix: np.ndarray) -> int:
    """Return the rank modulo the prime."""
    return len(reduced(matrix)[1])


def nullspace(matrix: np.ndarray) -> np.ndarray:
    """Return vectors (nullity, columns) that span the null space modulo the prime."""
    rows, pivots = reduced(matrix)
    columns = matrix.shape[1]
    free = [c for c in range(columns) if c not in pivots]
    vectors = np.zeros((len(free), columns), dtype=np.int64)
    for vector, column in zip(vectors, free, strict=True):
        vector[column] = 1
        vector[pivots] = -rows[:, column] % PRIME
    return vectors


def independent_rows(matrix: np.ndarray) -> list[int]:
    """Return the indices of rows that span all rows."""
    return reduced(np.asarray(matrix).T)[1]


def circuits(vectors: np.ndarray, weights: np.ndarray, tries: int = 200) -> list[tuple[int, ...]]:
    """Return supports of combinations of the vectors that contain no smaller support, the lightest first.

    Every reduced echelon form consists of such combinations; forms for `tries` random orders of the columns are taken,
    from a fixed seed.
    """
    random = np.random.default_rng(0)
    found: set[tuple[int, ...]] = set()
    columns = vectors.shape[1]
    for trial in range(tries if len(vectors) > 1 else 1):
        # Heavy columns come first as pivots, so that each appears in one row only.
        order = np.lexsort((random.permutation(columns), -weights)) if trial % 2 else random.permutation(columns)
        for row in reduced(vectors[:, order])[0]:
            found.add(tuple(sorted(int(c) for c in order[np.flatnonzero(row)])))
    return sorted(found, key=lambda support: (weights[list(support)].sum(), support))


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the matrix product modulo the prime."""
    total = np.zeros((len(a), b.shape[1]), dtype=np.int64)
    for column, row in zip(a.T, b, strict=True):
        total = (total + column[:, None] % PRIME * (row % PRIME)[None] % PRIME) % PRIME
    return total


def whole_circuits(vectors: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
    """Return the combinations of whole-number vectors of `circuits`, in the smallest whole numbers."""
    found = []
    for support in circuits(vectors, weights) if len(vectors) else []:
        rest = [c for c in range(vectors.shape[1]) if c not in support]
        exact = DomainMatrix.from_Matrix(sp.Matrix(vectors[:, rest].T.tolist() or [[0] * len(vectors)]))
        combination = whole(exact.convert_to(sp.QQ).nullspace())[0]
        vector = combination @ vectors
        sign = np.sign(np.sign(vector).sum()) or np.sign(vector[support[0]])
        found.append(sign * vector // np.gcd.reduce(vector))
    return found


def whole(matrix: DomainMatrix) -> np.ndarray:
    """Return the rows of a rational matrix, each times the smallest number that makes it whole."""
    rows = matrix.to_Matrix()
    result = np.zeros(rows.shape, dtype=np.int64)
    for i in range(rows.shape[0]):
        row = list(rows.row(i))
        common = math.lcm(*(int(v.q) for v in row))
        result[i] = [int(v * common) for v in row]
        result[i] //= np.gcd.reduce(result[i])
    return result
