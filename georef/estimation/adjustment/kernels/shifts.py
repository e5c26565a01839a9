"""Compiled loops of the search for coherent blocks: over all runs of segments, and over neighbours of given points."""

from __future__ import annotations

import numpy as np

from georef.estimation.adjustment.kernels.observations import kernel

_EASED = 1e-9  # of the trace of what a run would have by itself: a normal matrix that rounding leaves is none


@kernel
def squared(matrix, vector):
    """vector' matrix^-1 vector of a symmetric positive (3, 3)."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    x, y, z = vector[0], vector[1], vector[2]
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    whole = a * aa + b * ab + c * ac
    bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
    return (aa * x * x + bb * y * y + cc * z * z + 2.0 * (ab * x * y + ac * x * z + bc * y * z)) / whole


@kernel
def best_run(information, right, first, last, shared):
    """The run [begin, end) of segments between first and last whose common shift s = M^-1 b is most significant against
    a variance that right ones may share: s' (M^-1 + shared I)^-1 s = b' (M + shared M M)^-1 b, which a datum that rests
    on the tested ones alone leaves finite. information (3 n, 3 n), right (3 n,)."""
    column = np.zeros((last, 3, 3))  # sums of a column of blocks, from the row `begin` to the diagonal
    m, b, eased = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    begin_found, end_found, best = first, last, -1.0
    for begin in range(last - 1, first - 1, -1):
        m[:], b[:], own = 0.0, 0.0, 0.0
        for end in range(begin, last):
            for i in range(3):
                b[i] += right[3 * end + i]
                for j in range(3):
                    column[end, i, j] += information[3 * begin + i, 3 * end + j]
            for i in range(3):
                for j in range(3):
                    m[i, j] += column[end, i, j] + column[end, j, i] - information[3 * end + i, 3 * end + j]
                own += information[3 * end + i, 3 * end + i]
            ease = _EASED * own + 1e-12
            for i in range(3):
                for j in range(3):
                    eased[i, j] = m[i, j] + (ease if i == j else 0.0)
                    for k in range(3):
                        eased[i, j] += shared * m[i, k] * m[k, j]
            found = squared(eased, b)
            if found > best:
                begin_found, end_found, best = begin, end + 1, found
    return begin_found, end_found, best


@kernel
def agreeing(shift, cov, reach, tolerance, limit, before, after, compared):
    """How many of the `reach` neighbours before and after each shift (K, 3) with covariance (K, 3, 3) agree with it
    within a variance `tolerance`, and how many there are on one side: before (K,), after (K,), compared (K, 2)."""
    count = shift.shape[0]
    both, off = np.empty((3, 3)), np.empty(3)
    for k in range(count):
        for other in range(k + 1, min(k + 1 + reach, count)):
            for i in range(3):
                off[i] = shift[k, i] - shift[other, i]
                for j in range(3):
                    both[i, j] = cov[k, i, j] + cov[other, i, j] + (tolerance if i == j else 0.0)
            compared[k, 1] += 1
            compared[other, 0] += 1
            if squared(both, off) <= limit:
                after[k] += 1
                before[other] += 1
