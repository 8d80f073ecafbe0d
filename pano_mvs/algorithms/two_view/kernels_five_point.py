"""Compiled: the essential matrices through five pairs of bearings (Nistér 2004).

E = x X + y Y + z Z + W over the null space of the five equations qᵀ E p = 0. The ten cubic constraints are reduced to
three equations that are linear in x, y and 1 with polynomials in z as coefficients. Their determinant is a polynomial
of degree ten in z. Sturm's theorem separates its real roots in [-1, 1]; those of the reversed polynomial in (-1, 1)
are the inverses of the others.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import kernel

_DEGREE = 10
_MAX_INTERVALS = 64
Monomials = tuple[tuple[int, ...], ...]


def _monomials(text: str) -> Monomials:
    """Return the exponents of x, y and z of monomials, such as (2, 0, 1) of "xxz"."""
    return tuple(tuple(name.count(variable) for variable in "xyz") for name in text.split())


# Cubic monomials: the ten that are eliminated, then x (z², z, 1), y (z², z, 1) and (z³, z², z, 1).
_LINEAR = _monomials("x y z 1")
_QUADRATIC = _monomials("xx xy yy xz yz zz x y z 1")
_CUBIC = _monomials("xxx yyy xxy xyy xxz xx yyz yy xyz xy xzz xz x yzz yz y zzz zz z 1")


def _product_idx(left: Monomials, right: Monomials, products: Monomials) -> NDArray[np.int64]:
    """Return the position among `products` of the product of each two monomials."""
    return np.array([[products.index(tuple(i + j for i, j in zip(a, b, strict=True))) for b in right] for a in left])


_SQUARES = _product_idx(_LINEAR, _LINEAR, _QUADRATIC)
_CUBES = _product_idx(_QUADRATIC, _LINEAR, _CUBIC)


@kernel
def _null_space(first: FloatArray, second: FloatArray, basis: FloatArray) -> bool:
    """Write four orthonormal solutions of the five equations, (4, 9), by Householder reflections."""
    columns = np.empty((5, 9))
    for n in range(5):
        for i in range(3):
            for j in range(3):
                columns[n, 3 * i + j] = second[n, i] * first[n, j]
    for n in range(5):
        squared = 0.0
        for k in range(n, 9):
            squared += columns[n, k] * columns[n, k]
        length = math.sqrt(squared)
        if length < 1e-9:
            return False
        head = columns[n, n]
        columns[n, n] = head + length if head > 0 else head - length
        # The column now holds the reflection's vector, with |v|² = 2.
        factor = 1.0 / math.sqrt(length * (length + abs(head)))
        for k in range(n, 9):
            columns[n, k] *= factor
        for m in range(n + 1, 5):
            along = 0.0
            for k in range(n, 9):
                along += columns[n, k] * columns[m, k]
            for k in range(n, 9):
                columns[m, k] -= along * columns[n, k]
    basis[:] = 0.0
    for row in range(4):
        basis[row, 5 + row] = 1.0
        for n in range(4, -1, -1):
            along = 0.0
            for k in range(n, 9):
                along += columns[n, k] * basis[row, k]
            for k in range(n, 9):
                basis[row, k] -= along * columns[n, k]
    return True


@kernel
def _add_square(a: FloatArray, b: FloatArray, sign: float, out: FloatArray) -> None:
    for i in range(4):
        for j in range(4):
            out[_SQUARES[i, j]] += sign * a[i] * b[j]


@kernel
def _add_cube(a: FloatArray, b: FloatArray, sign: float, out: FloatArray) -> None:
    for i in range(10):
        for j in range(4):
            out[_CUBES[i, j]] += sign * a[i] * b[j]


@kernel
def cubic_equations(basis: FloatArray, equations: FloatArray) -> None:
    """Write the coefficients (10, 20) of 2 E Eᵀ E − tr(E Eᵀ) E = 0 and det E = 0 in the monomials `_CUBIC`."""
    linear = np.empty((3, 3, 4))
    for i in range(3):
        for j in range(3):
            for k in range(4):
                linear[i, j, k] = basis[k, 3 * i + j]
    squares = np.zeros((3, 3, 10))
    for i in range(3):
        for j in range(i + 1):
            for k in range(3):
                _add_square(linear[i, k], linear[j, k], 2.0, squares[i, j])
    for k in range(10):
        half_trace = 0.5 * (squares[0, 0, k] + squares[1, 1, k] + squares[2, 2, k])
        for i in range(3):
            squares[i, i, k] -= half_trace
            for j in range(i):
                squares[j, i, k] = squares[i, j, k]
    equations[:] = 0.0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                _add_cube(squares[i, k], linear[k, j], 1.0, equations[3 * i + j])
    minor = np.empty(10)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        minor[:] = 0.0
        _add_square(linear[1, j], linear[2, k], 1.0, minor)
        _add_square(linear[1, k], linear[2, j], -1.0, minor)
        _add_cube(minor, linear[0, i], 1.0, equations[9])


@kernel
def _eliminate(equations: FloatArray) -> bool:
    """Reduce the first ten columns to the identity as far as rows 4 to 9 need it; return False if they are singular."""
    for column in range(10):
        pivot = column
        for row in range(column + 1, 10):
            if abs(equations[row, column]) > abs(equations[pivot, column]):
                pivot = row
        if abs(equations[pivot, column]) < 1e-14:
            return False
        if pivot != column:
            for k in range(column, 20):
                equations[column, k], equations[pivot, k] = equations[pivot, k], equations[column, k]
        inverse = 1.0 / equations[column, column]
        for k in range(column, 20):
            equations[column, k] *= inverse
        for row in range(column + 1, 10):
            factor = equations[row, column]
            for k in range(column, 20):
                equations[row, k] -= factor * equations[column, k]
    for column in range(9, 4, -1):
        for row in range(4, column):
            factor = equations[row, column]
            for k in range(10, 20):
                equations[row, k] -= factor * equations[column, k]
    return True


@kernel
def _coefficients_in_z(equations: FloatArray, table: FloatArray) -> None:
    """Write B(z), (3, 3, 5), ascending powers, with B (x, y, 1)ᵀ = 0: rows 4, 6, 8 less z times rows 5, 7, 9."""
    table[:] = 0.0
    for n in range(3):
        upper, lower = equations[4 + 2 * n], equations[5 + 2 * n]
        for which in range(3):
            start, size = 10 + 3 * which, 3 if which < 2 else 4
            for power in range(size):
                table[n, which, power] += upper[start + size - 1 - power]
                table[n, which, power + 1] -= lower[start + size - 1 - power]


@kernel
def _add_determinant(table: FloatArray, polynomial: FloatArray) -> None:
    """Write det B(z), ascending powers, (11,)."""
    polynomial[:] = 0.0
    minor = np.empty(7)
    for n in range(3):
        j, k = (n + 1) % 3, (n + 2) % 3
        minor[:] = 0.0
        for a in range(4):
            for b in range(4):
                minor[a + b] += table[j, 0, a] * table[k, 1, b] - table[k, 0, a] * table[j, 1, b]
        for a in range(7):
            for b in range(5):
                polynomial[a + b] += minor[a] * table[n, 2, b]


@kernel
def _value(polynomial: FloatArray, degree: int, z: float) -> float:
    value: float = polynomial[degree]
    for power in range(degree - 1, -1, -1):
        value = value * z + polynomial[power]
    return value


@kernel
def _bracketed_root(polynomial: FloatArray, low: float, high: float, low_value: float) -> float:
    """Return the root between two points of different sign: Newton's method, bisection when it leaves the bracket."""
    z = 0.5 * (low + high)
    for _ in range(80):
        value, derivative = polynomial[_DEGREE], 0.0
        for power in range(_DEGREE - 1, -1, -1):
            derivative = derivative * z + value
            value = value * z + polynomial[power]
        if (value < 0.0) == (low_value < 0.0):
            low = z
        else:
            high = z
        moved = z - value / derivative if derivative != 0.0 else low
        if not low < moved < high:
            moved = 0.5 * (low + high)
        step = abs(moved - z)
        z = moved
        if step < 1e-14 or high - low < 1e-15:
            break
    return z


@kernel
def _sturm_chain(polynomial: FloatArray, chain: FloatArray) -> int:
    """Write the Sturm chain (polynomial, derivative, negated remainders); return its number of members.

    Member n is of degree 10 − n. All are scaled to coefficients of at most 1, which does not change the signs.
    """
    chain[0, _DEGREE] = polynomial[_DEGREE]
    for power in range(_DEGREE):
        chain[0, power] = polynomial[power]
        chain[1, power] = (power + 1) * polynomial[power + 1]
    for n in range(_DEGREE + 1):
        degree = _DEGREE - n
        if n > 1:
            upper, lower = chain[n - 2], chain[n - 1]
            lead = upper[degree + 2] / lower[degree + 1]
            next_lead = (upper[degree + 1] - lead * lower[degree]) / lower[degree + 1]
            for power in range(degree + 1):
                below = lower[power - 1] if power > 0 else 0.0
                chain[n, power] = lead * below + next_lead * lower[power] - upper[power]
        largest = 0.0
        for power in range(degree + 1):
            largest = max(largest, abs(chain[n, power]))
        if not abs(chain[n, degree]) > 1e-14 * largest:
            return n
        for power in range(degree + 1):
            chain[n, power] /= largest
    return _DEGREE + 1


@kernel
def _sign_changes(chain: FloatArray, members: int, z: float) -> int:
    changes = 0
    negative = _value(chain[0], _DEGREE, z) < 0.0
    for n in range(1, members):
        sign = _value(chain[n], _DEGREE - n, z) < 0.0
        if sign != negative:
            changes += 1
        negative = sign
    return changes


@kernel
def roots_within_one(polynomial: FloatArray, roots: FloatArray) -> int:
    """Write the real roots in [-1, 1] where a polynomial of degree ten changes sign; return their number.

    Sturm's theorem counts the roots in an interval; intervals are halved until each holds one.
    """
    chain = np.empty((_DEGREE + 1, _DEGREE + 1))
    members = _sturm_chain(polynomial, chain)
    if members < 2:
        return 0
    bounds = np.empty((_MAX_INTERVALS, 2))
    changes = np.empty((_MAX_INTERVALS, 2), np.int64)
    bounds[0, 0], bounds[0, 1] = -1.0, 1.0
    changes[0, 0], changes[0, 1] = _sign_changes(chain, members, -1.0), _sign_changes(chain, members, 1.0)
    waiting, found = 1, 0
    while waiting > 0:
        waiting -= 1
        low, high = bounds[waiting]
        at_low, at_high = changes[waiting]
        if at_low == at_high or high - low < 1e-12:
            continue
        if abs(at_low - at_high) == 1:
            low_value, high_value = _value(chain[0], _DEGREE, low), _value(chain[0], _DEGREE, high)
            if (low_value < 0.0) != (high_value < 0.0):
                roots[found] = _bracketed_root(chain[0], low, high, low_value)
                found += 1
                continue
        if waiting + 2 > _MAX_INTERVALS or found == _DEGREE:
            break
        middle = 0.5 * (low + high)
        at_middle = _sign_changes(chain, members, middle)
        bounds[waiting, 0], bounds[waiting, 1] = low, middle
        changes[waiting, 0], changes[waiting, 1] = at_low, at_middle
        bounds[waiting + 1, 0], bounds[waiting + 1, 1] = middle, high
        changes[waiting + 1, 0], changes[waiting + 1, 1] = at_middle, at_high
        waiting += 2
    return found


@kernel
def _write_essential(basis: FloatArray, table: FloatArray, z: float, essential: FloatArray) -> bool:
    """Write the matrix of norm √2 for a root z, with (x, y, 1) normal to the rows of B(z); return whether it exists."""
    rows = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            rows[i, j] = _value(table[i, j], 4, z)
    best = 0.0
    x, y = 0.0, 0.0
    for n in range(3):
        a, b = rows[n], rows[(n + 1) % 3]
        u, v, w = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        if abs(w) > best:
            best = abs(w)
            x, y = u / w, v / w
    if best == 0.0:
        return False
    squared = 0.0
    for k in range(9):
        entry = x * basis[0, k] + y * basis[1, k] + z * basis[2, k] + basis[3, k]
        essential[k // 3, k % 3] = entry
        squared += entry * entry
    scale = math.sqrt(2.0 / squared)
    for k in range(9):
        essential[k // 3, k % 3] *= scale
    return True


@kernel
def solve_five(
    first: FloatArray,
    second: FloatArray,
    samples: NDArray[np.int64],
    essentials: FloatArray,
    sample_idx: NDArray[np.int64],
) -> int:
    """Write all essential matrices through the samples, and return their number.

    Args:
        first: (M, 3) unit bearings.
        second: (M, 3) unit bearings.
        samples: (N, 5) positions of matches.
        essentials: (10 N, 3, 3), written.
        sample_idx: (10 N,) int64, written: the sample of each.
    """
    basis, equations, table = np.empty((4, 9)), np.empty((10, 20)), np.empty((3, 3, 5))
    polynomial, roots = np.empty(_DEGREE + 1), np.empty(_DEGREE + 1)
    p, q = np.empty((5, 3)), np.empty((5, 3))
    count = 0
    for n in range(len(samples)):
        for row in range(5):
            for i in range(3):
                p[row, i], q[row, i] = first[samples[n, row], i], second[samples[n, row], i]
        if not _null_space(p, q, basis):
            continue
        cubic_equations(basis, equations)
        if not _eliminate(equations):
            continue
        _coefficients_in_z(equations, table)
        _add_determinant(table, polynomial)
        for inverted in range(2):
            found = roots_within_one(polynomial[::-1].copy() if inverted else polynomial, roots)
            for k in range(found):
                if inverted and (abs(roots[k]) < 1e-9 or abs(roots[k]) >= 1.0):
                    continue
                z = 1.0 / roots[k] if inverted else roots[k]
                if count < len(essentials) and _write_essential(basis, table, z, essentials[count]):
                    sample_idx[count] = n
                    count += 1
    return count
