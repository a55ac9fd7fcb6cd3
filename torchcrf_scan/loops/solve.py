"""Linear algebra of 3x3 matrices: solution of a positive definite system, inverse, product, eigenvectors."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.loops.jit import Array, kernel

SWEEPS = 30  # of Jacobi's method, more than are ever needed


@kernel
def solve(a: float, b: float, c: float, d: float, e: float, f: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Solves ((a, b, c), (b, d, e), (c, e, f)) v = (x, y, z), positive definite, by elimination without square roots (LDL)."""
    l1, l2 = b / a, c / a
    d, e = d - l1 * b, e - l1 * c
    l3 = e / d
    f = f - l2 * c - l3 * e
    y = y - l1 * x
    third = (z - l2 * x - l3 * y) / f
    second = y / d - l3 * third
    return x / a - l1 * second - l2 * third, second, third


@kernel
def inverse_of(matrix: Array) -> Array:
    """(3, 3) inverse of a matrix (3, 3), by elimination with pivots."""
    left, right = matrix.copy(), np.eye(3)
    for k in range(3):
        pivot = k
        for r in range(k + 1, 3):
            if abs(left[r, k]) > abs(left[pivot, k]):
                pivot = r
        for d in range(3):
            left[k, d], left[pivot, d] = left[pivot, d], left[k, d]
            right[k, d], right[pivot, d] = right[pivot, d], right[k, d]
        share = 1 / left[k, k]
        for d in range(3):
            left[k, d], right[k, d] = left[k, d] * share, right[k, d] * share
        for r in range(3):
            factor = left[r, k]
            if r != k and factor != 0:
                for d in range(3):
                    left[r, d] -= factor * left[k, d]
                    right[r, d] -= factor * right[k, d]
    return right


@kernel
def product(a: Array, b: Array) -> Array:
    """(3, 3) matrix product of two matrices (3, 3)."""
    found = np.zeros((3, 3))
    for r in range(3):
        for d in range(3):
            found[r, d] = a[r, 0] * b[0, d] + a[r, 1] * b[1, d] + a[r, 2] * b[2, d]
    return found


@kernel
def jacobi_rotation(matrix: Array, vectors: Array, p: int, q: int) -> None:
    """Jacobi's rotation that makes matrix[p, q] 0, in place. matrix: (3, 3) symmetric; vectors: (3, 3), a row each."""
    if matrix[p, q] == 0:
        return
    tilt = (matrix[q, q] - matrix[p, p]) / (2 * matrix[p, q])
    t = (1.0 if tilt >= 0 else -1.0) / (abs(tilt) + math.sqrt(tilt * tilt + 1))
    c = 1 / math.sqrt(t * t + 1)
    s = t * c
    r = 3 - p - q
    matrix[p, p] -= t * matrix[p, q]
    matrix[q, q] += t * matrix[p, q]
    a, b = matrix[r, p], matrix[r, q]
    matrix[r, p] = matrix[p, r] = c * a - s * b
    matrix[r, q] = matrix[q, r] = s * a + c * b
    matrix[p, q] = matrix[q, p] = 0.0
    for d in range(3):
        a, b = vectors[p, d], vectors[q, d]
        vectors[p, d], vectors[q, d] = c * a - s * b, s * a + c * b


@kernel
def axes_of(symmetric: Array) -> tuple[Array, Array]:
    """(3,) eigenvalues, ascending, and (3, 3) unit eigenvectors, a row each. symmetric: (3, 3)."""
    matrix, vectors = symmetric.copy(), np.eye(3)
    for _ in range(SWEEPS):
        aside = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if aside <= 1e-18 * (abs(matrix[0, 0]) + abs(matrix[1, 1]) + abs(matrix[2, 2])):
            break
        for r in range(3):
            jacobi_rotation(matrix, vectors, r, (r + 1) % 3)
    values = np.empty(3)
    for k in range(3):
        values[k] = matrix[k, k]
    for k in (0, 1, 0):  # sorts three
        if values[k] > values[k + 1]:
            values[k], values[k + 1] = values[k + 1], values[k]
            for d in range(3):
                vectors[k, d], vectors[k + 1, d] = vectors[k + 1, d], vectors[k, d]
    return values, vectors
