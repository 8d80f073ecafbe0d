"""Two-view geometry written out in numpy: sides, costs, and refinement with derivatives of whole arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.refinement import _linearised, tangent_basis
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, angle_between, rotation_from_rotvec, skew

BoolArray = NDArray[np.bool_]

_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def sampson_angles(essentials: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the spherical Sampson error |e| / √(|E p|² + |Eᵀ q|² − 2 e²), e = qᵀ E p, in radians.

    To first order this is the total angle by which the two rays must move to intersect.

    Args:
        essentials: (..., 3, 3) essential matrices E = [t]× R of second_from_first, of any scale.
        first: (M, 3) unit bearings p in the first image.
        second: (M, 3) unit bearings q in the second.

    Returns:
        (..., M); zero if both rays lie on the baseline.
    """
    flat = essentials.reshape(-1, 3, 3)
    # Three matrix products replace a loop: e is linear in E, the squared lengths in EᵀE and EEᵀ.
    algebraic = flat.reshape(-1, 9) @ _products(second, first).T
    squares = _symmetric(np.swapaxes(flat, 1, 2) @ flat) @ _quadratics(first).T
    squares += _symmetric(flat @ np.swapaxes(flat, 1, 2)) @ _quadratics(second).T
    squared = algebraic**2
    squares -= 2 * squared
    residuals = np.sqrt(squared / np.maximum(squares, 1e-300))
    return residuals.reshape(*essentials.shape[:-2], len(first))


def _products(second: FloatArray, first: FloatArray) -> FloatArray:
    """Return the coefficients of E's nine entries in qᵀ E p, (..., M, 9)."""
    return (second[..., :, None] * first[..., None, :]).reshape(*first.shape[:-1], 9)


def _quadratics(vectors: FloatArray) -> FloatArray:
    """Return the coefficients of a symmetric matrix's six entries in vᵀ S v, (M, 6)."""
    x, y, z = vectors.T
    return np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z], axis=1)


def _symmetric(matrices: FloatArray) -> FloatArray:
    """Return the six entries of symmetric matrices in the order of `_quadratics`, (N, 6)."""
    rows, columns = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
    entries: FloatArray = matrices[:, rows, columns]
    return entries


def poses_from_essential(essential: FloatArray) -> list[Rigid3]:
    """The four second_from_first poses, |t| = 1, that share an essential matrix (3, 3)."""
    u, _, vt = np.linalg.svd(essential)
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    rotations = (u @ _QUARTER_TURN @ vt, u @ _QUARTER_TURN.T @ vt)
    return [Rigid3(rotation, sign * u[:, 2]) for rotation in rotations for sign in (1.0, -1.0)]


def in_front(first: FloatArray, second: FloatArray, second_from_first: Rigid3) -> BoolArray:
    """Whether each pair of rays, (M, 3) and (M, 3), meets at positive range from both centres, (M,).

    The signs of `ranges_from_bearings`' numerators, with C the second centre in the first frame and q de-rotated:
    (C × q)·(p × q) = C·p − (C·q)(p·q) and (C × p)·(p × q) = (C·p)(p·q) − C·q. Parallel rays do not meet.
    """
    q = second @ second_from_first.rotation
    center = second_from_first.center
    along_p, along_q, cosine = first @ center, q @ center, np.einsum("ni,ni->n", first, q)
    front: BoolArray = (along_p > along_q * cosine) & (along_p * cosine > along_q)
    return front


def facing_pose(essential: FloatArray, first: FloatArray, second: FloatArray, threshold_rad: float) -> Rigid3:
    """The decomposition of an essential matrix with most inliers in front of both cameras."""
    inliers = sampson_angles(essential, first, second) < threshold_rad
    poses = poses_from_essential(essential)
    return max(poses, key=lambda pose: int(in_front(first[inliers], second[inliers], pose).sum()))


def plausible(first: FloatArray, second: FloatArray, pose: Rigid3, threshold_rad: float) -> BoolArray:
    """Which matches lie in front of both cameras, or so far away that noise decides their sign, (M,)."""
    far: BoolArray = angle_between(first @ pose.rotation.T, second) < 2 * threshold_rad
    return far | in_front(first, second, pose)


def agreement(
    pose: Rigid3, first: FloatArray, second: FloatArray, threshold_rad: float
) -> tuple[FloatArray, BoolArray]:
    """The Sampson errors and which matches agree."""
    residuals = sampson_angles(skew(pose.translation) @ pose.rotation, first, second)
    return residuals, (residuals < threshold_rad) & plausible(first, second, pose, threshold_rad)


def facing_costs(poses: Sequence[Rigid3], first: FloatArray, second: FloatArray, threshold_rad: float) -> FloatArray:
    """Σ min(r² / threshold², 1) for each pose, where a match behind a camera costs 1."""
    found = []
    for pose in poses:
        residuals, agreeing = agreement(pose, first, second, threshold_rad)
        found.append(np.where(agreeing, (residuals / threshold_rad) ** 2, 1.0).sum())
    return np.array(found)


def msac_costs(essentials: FloatArray, first: FloatArray, second: FloatArray, threshold_rad: float) -> FloatArray:
    """Σ min(r² / threshold², 1) over all matches, for each of the essential matrices (N, 3, 3)."""
    residuals = sampson_angles(essentials, first, second)
    costs: FloatArray = np.sum(np.minimum((residuals / threshold_rad) ** 2, 1.0), axis=-1)
    return costs


def refine_relative_pose(
    pose: Rigid3, first: FloatArray, second: FloatArray, *, scale_rad: float, max_iterations: int = 20
) -> Rigid3:
    """The pose with the least Cauchy loss of the Sampson error, by Gauss–Newton with step halving."""
    residuals, jacobian = _linearised(pose, first, second)
    cost = cauchy_loss(residuals, scale_rad)
    for _ in range(max_iterations):
        weights = 1 / (1 + (residuals / scale_rad) ** 2)
        hessian = (jacobian * weights[:, None]).T @ jacobian
        hessian += 1e-9 * np.trace(hessian) * np.eye(5)
        step = -np.linalg.solve(hessian, jacobian.T @ (weights * residuals)).astype(np.float64)
        for shrink in (1.0, 0.3, 0.1, 0.01):
            moved = moved_pose(pose, shrink * step)
            moved_residuals, moved_jacobian = _linearised(moved, first, second)
            moved_cost = cauchy_loss(moved_residuals, scale_rad)
            if moved_cost < cost:
                break
        else:
            break
        gain = cost - moved_cost
        pose, residuals, jacobian, cost = moved, moved_residuals, moved_jacobian, moved_cost
        if gain < 1e-10 * cost:
            break
    return pose


def moved_pose(pose: Rigid3, step: FloatArray) -> Rigid3:
    """The pose after a step along ω and along t's two tangents, (5,)."""
    translation = pose.translation + tangent_basis(pose.translation) @ step[3:]
    return Rigid3(rotation_from_rotvec(step[:3]) @ pose.rotation, translation / np.linalg.norm(translation))


def cauchy_loss(residuals: FloatArray, scale_rad: float) -> float:
    """Σ log(1 + r² / scale²)."""
    return float(np.sum(np.log1p((residuals / scale_rad) ** 2)))


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
