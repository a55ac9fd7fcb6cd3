"""Linear algebra of 3x3 matrices, against numpy's."""

from __future__ import annotations

import numpy as np
from support import normal

from torchcrf_scan.loops import solve


def test_small_systems_are_solved() -> None:
    root = normal(3, 3).numpy()
    a = root @ root.T + np.eye(3)
    b = normal(3, seed=1).numpy()
    found = solve.solve(a[0, 0], a[0, 1], a[0, 2], a[1, 1], a[1, 2], a[2, 2], *b)
    np.testing.assert_allclose(found, np.linalg.solve(a, b))


def test_small_matrices_are_inverted_and_taken_apart() -> None:
    for seed in range(5):
        root = normal(3, 3, seed=seed).numpy()
        symmetric = root @ root.T
        np.testing.assert_allclose(solve.inverse_of(symmetric), np.linalg.inv(symmetric), rtol=1e-8)
        values, vectors = solve.axes_of(symmetric)
        np.testing.assert_allclose(values, np.linalg.eigvalsh(symmetric), atol=1e-12)
        np.testing.assert_allclose(vectors.T @ np.diag(values) @ vectors, symmetric, atol=1e-12)
