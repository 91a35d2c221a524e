"""Cholesky factors of many small matrices at once, written out entry by entry.

A batch of ten thousand 4 x 4 matrices is ten thousand calls of LAPACK, but ten vector operations in this form, and it
differentiates into the same.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Matrix = Float[Array, "*batch p p"]
Vector = Float[Array, "*batch p"]


class Cholesky:
    """A = L L^T of positive definite matrices with a small, static size p; not a pytree, lives within one function."""

    def __init__(self, A: Matrix) -> None:
        rows: list[list[Array]] = []
        for i in range(A.shape[-1]):
            row: list[Array] = []
            for j in range(i):
                row.append((A[..., i, j] - _dot(row, rows[j])) / rows[j][j])
            rows.append([*row, jnp.sqrt(A[..., i, i] - _dot(row, row))])
        self.rows, self.size = rows, len(rows)

    def log_det(self) -> Float[Array, "*batch"]:
        """log det A."""
        return 2 * sum((jnp.log(self.rows[i][i]) for i in range(self.size)), jnp.zeros(()))

    def forward(self, b: Vector) -> Vector:
        """L^-1 b."""
        x: list[Array] = []
        for i, row in enumerate(self.rows):
            x.append((b[..., i] - _dot(x, row)) / row[i])
        return jnp.stack(x, -1)

    def backward(self, b: Vector) -> Vector:
        """L^-T b; of a standard normal vector, a draw with covariance A^-1."""
        x: list[Array] = []
        for i in reversed(range(self.size)):
            column = [row[i] for row in self.rows[i + 1 :]]
            x.insert(0, (b[..., i] - _dot(x, column)) / self.rows[i][i])
        return jnp.stack(x, -1)

    def solve(self, b: Vector) -> Vector:
        """A^-1 b."""
        return self.backward(self.forward(b))

    def inverse(self) -> Matrix:
        """A^-1."""
        eye = jnp.eye(self.size)
        columns = [self.solve(jnp.broadcast_to(eye[i], (*self.rows[0][0].shape, self.size))) for i in range(self.size)]
        return jnp.stack(columns, -1)


def _dot(x: Sequence[Array], y: Sequence[Array]) -> Array:
    """The sum of products, as far as the shorter one goes."""
    return sum((a * b for a, b in zip(x, y, strict=False)), jnp.zeros(()))


def eliminate(
    gram: Matrix, own: Sequence[int], precision: Float[Array, "*batch o"], mean: Float[Array, "*batch o"] | float = 0.0
) -> tuple[Float[Array, "*batch r r"], Float[Array, "*batch"]]:
    r"""Integrate numbers with a normal prior out of a Gaussian likelihood: a Schur complement.

    With the design matrix X of a linear model y = X x + noise of variance 1, and the Gram matrix of [X, y],

    .. math:: \int e^{-\frac12 \|y - X_o x_o - X_r x_r\|^2}\, N(x_o;\, m, P^{-1})\, dx_o
        = e^{L - \frac12 (x_r, -1)^T G' (x_r, -1)}

    The data are the last column of `gram`; those of `own` are integrated out, under `precision` P and `mean` m of each.
    Returned are G', over the columns that are left, and L.
    """
    inside = np.asarray(own)
    rest = np.asarray([k for k in range(gram.shape[-1]) if k not in own])
    mean = jnp.broadcast_to(jnp.asarray(mean), precision.shape)
    inner = gram[..., inside[:, None], inside[None]] + jnp.vectorize(jnp.diag, signature="(n)->(n,n)")(precision)
    border = gram[..., inside[:, None], rest[None]].at[..., -1].add(precision * mean)
    factor = Cholesky(inner[..., None, :, :])
    half = jnp.swapaxes(factor.forward(jnp.swapaxes(border, -1, -2)), -1, -2)
    log_det = factor.log_det()[..., 0]
    left = gram[..., rest[:, None], rest[None]] - jnp.einsum("...pi,...pj->...ij", half, half)
    left = left.at[..., -1, -1].add(jnp.sum(precision * mean**2, -1))
    return left, 0.5 * (jnp.sum(jnp.log(precision), -1) - log_det)
