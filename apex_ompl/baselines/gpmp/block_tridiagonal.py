"""Symmetric block-tridiagonal matrices, and the solution of linear equations with them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from apex_ompl.types import Array


class BlockTridiagonal(NamedTuple):
    """A symmetric matrix A of n x n blocks of b x b, zero but for its diagonal blocks D_i and their neighbors.

    Attributes:
        diagonal: Diagonal blocks D_i = A_i,i, symmetric, shape (n, b, b).
        upper: Blocks U_i = A_i,i+1, shape (n - 1, b, b); A_i+1,i is their transpose.
    """

    diagonal: Array
    upper: Array

    def dense(self) -> Array:
        """Return the matrix, shape (n b, n b)."""
        n, b, _ = self.diagonal.shape
        found = np.zeros((n, b, n, b))
        for i in range(n):
            found[i, :, i] = self.diagonal[i]
        for i in range(n - 1):
            found[i, :, i + 1], found[i + 1, :, i] = self.upper[i], self.upper[i].T
        return found.reshape(n * b, n * b)

    def damped(self, share: float) -> BlockTridiagonal:
        """Return the matrix with its diagonal larger by a share of itself (Marquardt 1963)."""
        diagonal = self.diagonal.copy()
        k = np.arange(diagonal.shape[1])
        diagonal[:, k, k] *= 1.0 + share
        return BlockTridiagonal(diagonal, self.upper)

    def solve(self, right: Array) -> Array:
        """Return x of A x = right, both of shape (n, b), by block elimination (Thomas), in O(n b^3).

        Raises:
            numpy.linalg.LinAlgError: A block of the elimination is singular.
        """
        n, b, _ = self.diagonal.shape
        gains, found = np.empty((max(n - 1, 0), b, b)), np.empty((n, b))
        block, rest = self.diagonal[0], right[0]
        for i in range(n - 1):
            solved = np.linalg.solve(block, np.concatenate([self.upper[i], rest[:, None]], axis=1))
            gains[i], found[i] = solved[:, :b], solved[:, b]
            block = self.diagonal[i + 1] - self.upper[i].T @ gains[i]
            rest = right[i + 1] - self.upper[i].T @ found[i]
        found[-1] = np.linalg.solve(block, rest)
        for i in range(n - 2, -1, -1):
            found[i] -= gains[i] @ found[i + 1]
        return found
