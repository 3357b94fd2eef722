# SPDX-License-Identifier: Apache-2.0
"""Kernels that cluster points on the ground plane by density, on a hashed grid; exact, not approximate.

A grid cell's diagonal is just under the neighbourhood radius, so all points of one cell are neighbours: a cell with
enough points needs no distance at all, and clusters are unions of cells (Gunawan 2013; Gan and Tao, SIGMOD 2015).
Work grows with the number of points, hardly with their density. Distances are float64 without fastmath, so decisions
equal those of ``edge/reference/clustering.py`` bit for bit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from edge.kernels_arrays import Float64, Int32, Int64

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "cache": True}
CELL_SHARE = (1.0 - 1e-6) / np.sqrt(2.0)  # cell side / radius: rounding cannot put one cell's points out of reach
REACH = 2  # cells to either side that a neighbourhood can touch
BLOCK = 2 * REACH + 1
EXTENT_DIRECTIONS = 16


class Grid(NamedTuple):
    """Working memory of one clustering: arrays with room for ``n`` points, of which the kernels fill a part.

    table: int32 [2^k >= 2 n], hash slot -> cell or -1.  cell_xy: int64 [n, 2].  first: int32 [n + 1], cell -> its place
    in ``order``.  order: int32 [n], points cell by cell, ascending inside each.  cell_of: int32 [n], point -> cell.
    core: uint8 [n], the points that count.  box: float64 [n, 4], cell -> bounds of its points that count, x min,
    x max, y min, y max (min > max: none).  parent: int32 [n], union-find over cells.  label: int32 [n], root -> label.
    """

    table: NDArray[np.int32]
    cell_xy: NDArray[np.int64]
    first: NDArray[np.int32]
    order: NDArray[np.int32]
    cell_of: NDArray[np.int32]
    core: NDArray[np.uint8]
    box: NDArray[np.float64]
    parent: NDArray[np.int32]
    label: NDArray[np.int32]


def make_grid(capacity: int) -> Grid:
    """Working memory for up to ``capacity`` points."""
    slots = 1 << max(4, (2 * capacity - 1).bit_length())
    return Grid(
        np.empty(slots, np.int32),
        np.empty((capacity, 2), np.int64),
        np.empty(capacity + 1, np.int32),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.uint8),
        np.empty((capacity, 4), np.float64),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.int32),
    )


@njit(**OPTIONS)
def _slot(grid: Grid, ix: int, iy: int) -> int:
    """Hash slot that holds cell (ix, iy), or the free one where it belongs (Teschner et al. 2003, linear probing)."""
    mask = len(grid.table) - 1
    slot = ((ix * 73856093) ^ (iy * 19349663)) & mask
    while True:
        cell = grid.table[slot]
        if cell < 0 or (grid.cell_xy[cell, 0] == ix and grid.cell_xy[cell, 1] == iy):
            return slot
        slot = (slot + 1) & mask


@njit(**OPTIONS)
def build_grid(xy: Float64, side: float, grid: Grid) -> int:
    """Sort points into cells.

    Args:
        xy: float64 [n, 2], metres, finite.
        side: cell side, metres.
        grid: receives table, cell_xy, first, order, cell_of.
    Returns:
        Cells that hold points.
    """
    n, cells = len(xy), 0
    grid.table[:] = -1
    grid.first[: n + 1] = 0
    for p in range(n):
        ix, iy = int(np.floor(xy[p, 0] / side)), int(np.floor(xy[p, 1] / side))
        slot = _slot(grid, ix, iy)
        if grid.table[slot] < 0:
            grid.table[slot] = cells
            grid.cell_xy[cells, 0], grid.cell_xy[cells, 1] = ix, iy
            cells += 1
        grid.cell_of[p] = grid.table[slot]
        grid.first[grid.cell_of[p] + 1] += 1
    for cell in range(cells):
        grid.first[cell + 1] += grid.first[cell]
    for p in range(n):  # first[c] walks to the end of cell c ...
        cell = grid.cell_of[p]
        grid.order[grid.first[cell]] = p
        grid.first[cell] += 1
    for cell in range(cells, 0, -1):  # ... and is moved back
        grid.first[cell] = grid.first[cell - 1]
    grid.first[0] = 0
    return cells


@njit(**OPTIONS)
def _mark_core(xy: Float64, radius2: float, core_points: int, cells: int, grid: Grid) -> None:
    """Find the core points."""
    for cell in range(cells):
        start, end = grid.first[cell], grid.first[cell + 1]
        for k in range(start, end):
            p = grid.order[k]
            near = end - start
            for block in range(BLOCK * BLOCK):
                if near >= core_points:
                    break
                ix, iy = grid.cell_xy[cell, 0] + block // BLOCK - REACH, grid.cell_xy[cell, 1] + block % BLOCK - REACH
                other = grid.table[_slot(grid, ix, iy)]
                if other < 0 or other == cell:
                    continue
                for m in range(grid.first[other], grid.first[other + 1]):
                    q = grid.order[m]
                    dx, dy = xy[p, 0] - xy[q, 0], xy[p, 1] - xy[q, 1]
                    near += dx * dx + dy * dy <= radius2
            grid.core[p] = near >= core_points


@njit(**OPTIONS)
def _bound(xy: Float64, grid: Grid) -> None:
    """Bounds of every cell's points that count."""
    n = len(xy)
    grid.box[:n, 0::2], grid.box[:n, 1::2] = np.inf, -np.inf
    for p in range(n):
        if grid.core[p]:
            cell = grid.cell_of[p]
            for axis in range(2):
                grid.box[cell, 2 * axis] = min(grid.box[cell, 2 * axis], xy[p, axis])
                grid.box[cell, 2 * axis + 1] = max(grid.box[cell, 2 * axis + 1], xy[p, axis])


@njit(**OPTIONS)
def _root(parent: Int32, cell: int) -> int:
    """Representative of a cell's cluster, halving the path."""
    while parent[cell] != cell:
        parent[cell] = parent[parent[cell]]
        cell = parent[cell]
    return cell


@njit(**OPTIONS)
def _touch(xy: Float64, a: int, b: int, radius2: float, grid: Grid) -> bool:
    """Whether a core point of cell a and one of cell b are neighbours."""
    gap2 = 0.0
    for axis in range(2):
        low, high = 2 * axis, 2 * axis + 1
        gap = max(0.0, grid.box[a, low] - grid.box[b, high], grid.box[b, low] - grid.box[a, high])
        gap2 += gap * gap
    if gap2 > radius2:
        return False
    for k in range(grid.first[a], grid.first[a + 1]):
        p = grid.order[k]
        if not grid.core[p]:
            continue
        for m in range(grid.first[b], grid.first[b + 1]):
            q = grid.order[m]
            dx, dy = xy[p, 0] - xy[q, 0], xy[p, 1] - xy[q, 1]
            if grid.core[q] and dx * dx + dy * dy <= radius2:
                return True
    return False


@njit(**OPTIONS)
def _join(xy: Float64, radius2: float, cells: int, grid: Grid) -> None:
    """Unite the cells whose core points are neighbours."""
    for cell in range(cells):
        grid.parent[cell] = cell
    for cell in range(cells):
        if grid.box[cell, 0] > grid.box[cell, 1]:
            continue
        for block in range(BLOCK * BLOCK // 2):  # half of the block: every pair of cells once
            ix, iy = grid.cell_xy[cell, 0] + block // BLOCK - REACH, grid.cell_xy[cell, 1] + block % BLOCK - REACH
            other = grid.table[_slot(grid, ix, iy)]
            if other < 0 or grid.box[other, 0] > grid.box[other, 1]:
                continue
            a, b = _root(grid.parent, cell), _root(grid.parent, other)
            if a != b and _touch(xy, cell, other, radius2, grid):
                grid.parent[max(a, b)] = min(a, b)


@njit(**OPTIONS)
def dbscan(xy: Float64, radius: float, core_points: int, grid: Grid, labels: Int32) -> int:
    """Label points by density, as ``edge.reference.clustering.dbscan`` defines it.

    Args:
        xy: float64 [n, 2], metres, finite.
        radius: of the neighbourhood, metres.
        core_points: neighbours, itself included, that make a core point.
        grid: working memory for n points; afterwards the grid of these points, for ``nearest_labels``.
        labels: int32 [n], receives the labels; clusters numbered by their first core point, -1 in none.
    Returns:
        Clusters found.
    """
    cells = build_grid(xy, radius * CELL_SHARE, grid)
    _mark_core(xy, radius * radius, core_points, cells, grid)
    _bound(xy, grid)
    _join(xy, radius * radius, cells, grid)
    clusters = 0
    grid.label[:cells] = -1
    for p in range(len(xy)):
        labels[p] = -1
        if grid.core[p]:
            root = _root(grid.parent, grid.cell_of[p])
            if grid.label[root] < 0:
                grid.label[root] = clusters
                clusters += 1
            labels[p] = grid.label[root]
    for p in range(len(xy)):
        if not grid.core[p]:
            q = _nearest(xy[p, 0], xy[p, 1], xy, radius, grid)
            labels[p] = labels[q] if q >= 0 else -1
    return clusters


@njit(**OPTIONS)
def _nearest(x: float, y: float, xy: Float64, radius: float, grid: Grid) -> int:
    """Nearest point that counts within ``radius`` of (x, y), the first of equally near ones; -1 when there is none.

    Cells whose bounds are farther than the best so far are passed over; rounding is monotonic, so none is missed.
    """
    side = radius * CELL_SHARE
    ix, iy = int(np.floor(x / side)), int(np.floor(y / side))
    best, best2 = -1, radius * radius
    for turn in range(BLOCK * BLOCK):
        block = (turn + BLOCK * BLOCK // 2) % (BLOCK * BLOCK)  # own cell first
        cell = grid.table[_slot(grid, ix + block // BLOCK - REACH, iy + block % BLOCK - REACH)]
        if cell < 0:
            continue
        gap_x = max(0.0, grid.box[cell, 0] - x, x - grid.box[cell, 1])
        gap_y = max(0.0, grid.box[cell, 2] - y, y - grid.box[cell, 3])
        gap2 = gap_x * gap_x + gap_y * gap_y
        if gap2 > best2:
            continue
        for m in range(grid.first[cell], grid.first[cell + 1]):
            q = grid.order[m]
            dx, dy = x - xy[q, 0], y - xy[q, 1]
            d2 = dx * dx + dy * dy
            if grid.core[q] and (d2 < best2 or (d2 == best2 and (best < 0 or q < best))):
                best, best2 = q, d2
                if d2 == gap2:  # nothing in this cell is nearer, and the first comes first
                    break
    return best


@njit(**OPTIONS)
def nearest_labels(query: Float64, xy: Float64, radius: float, grid: Grid, labels: Int32, found: Int32) -> None:
    """Label of the nearest labelled point within ``radius`` of each query point.

    Args:
        query: float64 [m, 2], metres, finite.
        xy, radius, labels: as ``dbscan`` had them.
        grid: as ``dbscan`` left it; all labelled points count afterwards.
        found: int32 [m], receives the labels, -1 where no labelled point is near.
    """
    for p in range(len(xy)):
        grid.core[p] = labels[p] >= 0
    _bound(xy, grid)
    for k in range(len(query)):
        q = _nearest(query[k, 0], query[k, 1], xy, radius, grid)
        found[k] = labels[q] if q >= 0 else -1


@njit(**OPTIONS)
def measure(xy: Float64, labels: Int32, direction: Float64, count: Int64, span: Float64, extent: Float64) -> None:
    """Size of every cluster.

    Args:
        xy: float64 [n, 2], metres.
        labels: int32 [n].
        direction: float64 [d, 2], unit vectors over half a turn.
        count: int64 [clusters], receives the points.
        span: float64 [clusters, d, 2], scratch.
        extent: float64 [clusters], receives the largest width over all directions, metres.
    """
    count[:], extent[:] = 0, 0.0
    span[:, :, 0], span[:, :, 1] = np.inf, -np.inf
    for p in range(len(xy)):
        if labels[p] >= 0:
            count[labels[p]] += 1
            for d in range(len(direction)):
                along = xy[p, 0] * direction[d, 0] + xy[p, 1] * direction[d, 1]
                span[labels[p], d, 0] = min(span[labels[p], d, 0], along)
                span[labels[p], d, 1] = max(span[labels[p], d, 1], along)
    for label in range(len(count)):
        for d in range(len(direction)):
            extent[label] = max(extent[label], span[label, d, 1] - span[label, d, 0])
