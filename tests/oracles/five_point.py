"""The five-point problem by the action matrix: all samples at once, in numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray

_SAMPLE = 5
# Exponents of x, y, z in the twenty monomials up to degree three. The last ten are a basis of what is left of all
# polynomials once the ten cubic ones before them are expressed by them.
MONOMIALS = (
    (3, 0, 0),
    (2, 1, 0),
    (1, 2, 0),
    (0, 3, 0),
    (2, 0, 1),
    (1, 1, 1),
    (0, 2, 1),
    (1, 0, 2),
    (0, 1, 2),
    (0, 0, 3),
    (2, 0, 0),
    (1, 1, 0),
    (0, 2, 0),
    (1, 0, 1),
    (0, 1, 1),
    (0, 0, 2),
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
    (0, 0, 0),
)
# x times a basis monomial: one of the cubic monomials (its row among the first ten), or another of the basis.
_CUBIC_ROWS = (0, 1, 2, 4, 5, 7)
_BASIS_ROWS = ((6, 0), (7, 1), (8, 3), (9, 6))
_REAL = 1e-7  # imaginary part of a root, relative to its size, that rounding explains


def essentials_by_eigenvectors(first: FloatArray, second: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return all essential matrices for which five pairs of bearings meet: qᵀ E p = 0.

    E = x X + y Y + z Z + W over the null space of the five equations; det E = 0 and 2 E Eᵀ E − tr(E Eᵀ) E = 0 are ten
    cubic equations in x, y, z (Nistér 2004, "An efficient solution to the five-point relative pose problem"); they are
    solved as the eigenvectors of the multiplication by x (Stewénius, Engels & Nistér 2006, "Recent developments on
    direct relative orientation"). Points on a plane are no special case.

    Args:
        first: (N, 5, 3) unit bearings p of N samples.
        second: (N, 5, 3) unit bearings q.

    Returns:
        (K, 3, 3) matrices of Frobenius norm √2, at most ten for each sample, and the sample of each, (K,), ascending.
        Samples whose equations depend on one another have none.
    """
    products = (second[..., :, None] * first[..., None, :]).reshape(-1, _SAMPLE, 9)
    null_space = np.linalg.qr(np.swapaxes(products, 1, 2), mode="complete")[0][:, :, _SAMPLE:]
    basis = np.swapaxes(null_space, 1, 2).reshape(-1, 4, 3, 3)
    actions, sample_idx = _multiplications_by_x(cubic_equations(basis))
    roots, vectors = np.linalg.eig(actions)
    scale = vectors[:, 9]
    real = (np.abs(roots.imag) < _REAL * (1 + np.abs(roots.real))) & (np.abs(scale) > 1e-12 * np.abs(vectors).max(1))
    row, column = np.nonzero(real)
    unknowns = (vectors[row, 6:, column] / scale[row, column, None]).real  # x, y, z, 1
    essentials = np.einsum("na,naij->nij", unknowns, basis[sample_idx[row]])
    essentials *= np.sqrt(2) / np.linalg.norm(essentials, axis=(1, 2), keepdims=True)
    return essentials, sample_idx[row]


def cubic_equations(basis: FloatArray) -> FloatArray:
    """Return the ten equations' coefficients of the twenty monomials, (N, 10, 20), for bases (N, 4, 3, 3).

    Each is Σ_abc c_a c_b c_c T_abc with c = (x, y, z, 1): T is computed first, equal products of c added up next.
    """
    squares = np.einsum("naij,nbkj->nabik", basis, basis)  # E_a E_bᵀ
    cubes = 2 * np.einsum("nabik,nckj->nabcij", squares, basis)
    cubes -= np.einsum("nabii,ncjk->nabcjk", squares, basis)
    normals = np.cross(basis[:, :, None, 1], basis[:, None, :, 2])
    determinants = np.einsum("nai,nbci->nabc", basis[:, :, 0], normals)
    tensor = np.concatenate([cubes.reshape(-1, 64, 9), determinants.reshape(-1, 64, 1)], axis=2)
    equations: FloatArray = np.swapaxes(tensor, 1, 2) @ _PRODUCTS
    return equations


def _multiplications_by_x(equations: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return the matrices that multiply the basis monomials by x, (M, 10, 10), and which of the N samples they are."""
    cubic, basis = equations[:, :, :10], equations[:, :, 10:]
    regular = np.flatnonzero(np.abs(np.linalg.det(cubic)) > 1e-30)
    reduced = -np.linalg.solve(cubic[regular], basis[regular])
    actions = np.zeros_like(reduced)
    actions[:, : len(_CUBIC_ROWS)] = reduced[:, _CUBIC_ROWS]
    for row, column in _BASIS_ROWS:
        actions[:, row, column] = 1.0
    return actions, regular


def _monomial_of_products() -> FloatArray:
    """Return which monomial each product c_a c_b c_c of c = (x, y, z, 1) is, (64, 20)."""
    table = np.zeros((4, 4, 4, len(MONOMIALS)))
    powers = np.eye(4, 3, dtype=np.int64)
    for a, b, c in np.ndindex(4, 4, 4):
        table[a, b, c, MONOMIALS.index(tuple(int(n) for n in powers[a] + powers[b] + powers[c]))] = 1.0
    return table.reshape(64, -1)


_PRODUCTS = _monomial_of_products()
