"""Compiled loops of the multifrontal factor: blocks into fronts, updates of children into parents, products.

A front is three arrays: `corner` (p, p) of its pivots, `below` (r, p) of the members after them, `update` (r, r), lower
triangles, in Fortran's order.
"""

from __future__ import annotations

from georef.estimation.adjustment.kernels.observations import kernel


@kernel
def assemble(blocks, scale, block_row, block_column, entries, row, column, turned, corner, below, update):
    """Adds the matrix's own blocks (N, 6, 6), scaled by `scale` (S, 6) on both sides, to a front that is zero."""
    pivots = corner.shape[0] // 6
    for k in range(entries.shape[0]):
        entry = entries[k]
        a, b = block_row[entry], block_column[entry]
        for i in range(6):
            for j in range(6):
                value = blocks[entry, i, j] * scale[a, i] * scale[b, j]
                y, x = (j, i) if turned[k] else (i, j)
                if column[k] >= pivots:
                    update[6 * (row[k] - pivots) + y, 6 * (column[k] - pivots) + x] = value
                elif row[k] >= pivots:
                    below[6 * (row[k] - pivots) + y, 6 * column[k] + x] = value
                else:
                    corner[6 * row[k] + y, 6 * column[k] + x] = value


@kernel
def extend(place, child, corner, below, update):
    """Adds the lower triangle of a child's update to its parent; place: where its rows stand there, rising."""
    pivots = corner.shape[0]
    for j in range(place.shape[0]):
        column = place[j]
        for i in range(j, place.shape[0]):
            row = place[i]
            if column >= pivots:
                update[row - pivots, column - pivots] += child[i, j]
            elif row >= pivots:
                below[row - pivots, column] += child[i, j]
            else:
                corner[row, column] += child[i, j]


@kernel
def times(first, column, block, x, out):
    """Product out (6 S,) of a symmetric matrix, given by its upper block triangle, and a vector."""
    for row in range(first.shape[0] - 1):
        for entry in range(first[row], first[row + 1]):
            there = column[entry]
            for i in range(6):
                total = 0.0
                for j in range(6):
                    total += block[entry, i, j] * x[6 * there + j]
                out[6 * row + i] += total
            if there == row:
                continue
            for j in range(6):
                total = 0.0
                for i in range(6):
                    total += block[entry, i, j] * x[6 * row + i]
                out[6 * there + j] += total
