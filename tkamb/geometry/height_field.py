"""The intervals in which the lines of a structured grid run inside a closed surface.

Every triangle is compared with the lines that cross its bounding rectangle. The signs of three
areas, which are exact integers (`tkamb.geometry.winding.PlanGrid`), decide whether a line passes
through it, so that none passes between two triangles. A line that meets an edge exactly is moved by
an infinitesimal distance into each quadrant around it (simulation of simplicity, see
`tkamb.geometry.winding`). A place that is inside in any of these cases counts, so that a line along
a wall belongs to the body.

A place is inside if more entries than exits lie below it: a wall between two touching bodies does
not end an interval, and a void stays empty. A line through a hole of the mesh has unequal numbers
of entries and exits; its crossings are paired in order.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import counted
from tkamb.geometry.winding import PlanGrid

# 1: largest share of lines with an odd number of crossings. These lines are repaired; with a
# larger share the mesh is refused. Small defects of a mesh affect fewer lines.
ODD_SHARE = 0.01
# m: crossings nearer to each other belong to duplicate faces. It is above rounding.
SAME_HEIGHT = 1e-12


# m: distance below which bodies touch. Ten times the rounding of single precision.
TOUCHING_DISTANCE = 1e-7


@dataclass(frozen=True, eq=False)
class Intervals:
    """The intervals of grid lines inside a surface, sorted by line, then by height.

    Args:
        first: (m,) index of the interval's line along the axis after `axis` (cyclic: x, y, z, x).
        second: (m,) the same along the axis before it.
        lower: (m,) m, coordinate along `axis` at which the line enters; it leaves at `upper`.
        mended: number of lines with an odd number of crossings, repaired from their neighbours.
    """

    first: Index
    second: Index
    lower: Array
    upper: Array
    mended: int


def inside_intervals(surface: Surface, axis: int, first: Array, second: Array) -> Intervals:
    """Return the intervals in which lines along `axis` run inside a closed surface.

    Args:
        first: (a,) increasing coordinates (m) of the lines along axis + 1 (cyclic).
        second: (b,) the same along axis + 2.
    """
    line, height, rising, sides = _crossings(surface, axis, first, second)
    shape = (len(first), len(second))
    parts: list[tuple[Index, Array, Array]] = []
    mended = 0
    tied = np.zeros(shape[0] * shape[1], bool)
    tied[line[~(sides.all(axis=0) | ~sides.any(axis=0))]] = True
    for quadrant in range(4):
        counts = sides[quadrant] & ((quadrant == 0) | tied[line])
        lines, heights = _paired(line[counts], height[counts], rising[counts], tied.size)
        odd = np.bincount(lines, minlength=tied.size) % 2 == 1
        if quadrant == 0:
            mended = int(odd.sum())
            lines, heights = _repaired(lines, heights, odd, shape, surface.name)
        else:
            lines, heights = lines[~odd[lines]], heights[~odd[lines]]
        parts.append((lines[::2], heights[::2], heights[1::2]))
    line, lower, upper = united(
        np.concatenate([part[0] for part in parts]),
        np.concatenate([part[1] for part in parts]),
        np.concatenate([part[2] for part in parts]),
    )
    return Intervals(line // shape[1], line % shape[1], lower, upper, mended)


def united(line: Index, lower: Array, upper: Array) -> tuple[Index, Array, Array]:
    """Return the union of the closed intervals on each line, sorted."""
    ranks = np.unique(np.concatenate([lower, upper]), return_inverse=True)[1].astype(np.int64)
    low, high = ranks[: len(lower)], ranks[len(lower) :]
    order = np.lexsort((low, line))
    line, lower, upper = line[order], lower[order], upper[order]
    low, high = low[order], high[order]
    base = line * (len(ranks) + 1)
    reach = np.maximum.accumulate(base + high)
    begins = np.ones(len(line), bool)
    begins[1:] = base[1:] + low[1:] > reach[:-1]
    start = np.flatnonzero(begins)
    if not start.size:
        return line, lower, upper
    return line[start], lower[start], np.maximum.reduceat(upper, start)


def _crossings(
    surface: Surface, axis: int, first: Array, second: Array
) -> tuple[Index, Array, Mask, Mask]:
    """Return line (m,), height (m,), m, `rising` (the triangle faces along the line) and counts (4,
    m) of all crossings.

    Counts are whether the line passes through it when moved into each quadrant.
    """
    across, along = [(axis + 1) % 3, (axis + 2) % 3], axis
    flat = surface.vertices[:, across]
    corners = flat[surface.faces]
    grid = PlanGrid.over(flat)  # rounding to its steps may move a line onto the next triangle
    low, high = corners.min(axis=1) - grid.step, corners.max(axis=1) + grid.step
    a0, a1 = np.searchsorted(first, low[:, 0], "left"), np.searchsorted(first, high[:, 0], "right")
    b0, b1 = (
        np.searchsorted(second, low[:, 1], "left"),
        np.searchsorted(second, high[:, 1], "right"),
    )
    count = (a1 - a0) * (b1 - b0)
    face, rank = counted(count)
    width = (b1 - b0)[face]
    a, b = a0[face] + rank // np.maximum(width, 1), b0[face] + rank % np.maximum(width, 1)
    points = np.column_stack([first[a], second[b]])
    area, sides = _signed_areas(
        surface.faces[face], flat, points, grid.whole(flat), grid.whole(points)
    )
    through = (sides == sides[:1]).all(axis=0).any(axis=0)
    face, area, sides, a, b = (
        face[through],
        area[:, through],
        sides[:, :, through],
        a[through],
        b[through],
    )
    total = area.sum(axis=0)
    weight = np.divide(area, total, out=np.full_like(area, 1 / 3), where=total != 0.0)
    heights = surface.vertices[surface.faces[face], along]
    height = np.einsum("em,me->m", weight, heights)
    counts = (sides == sides[:1]).all(axis=0)
    # The signs give the triangle's facing in the quadrants in which the line passes through it.
    rising = (sides[0] * counts).sum(axis=0) > 0
    return a * len(second) + b, height, rising, counts


def _signed_areas(
    faces: Index, flat: Array, points: Array, whole_flat: Index, whole_points: Index
) -> tuple[Array, NDArray[np.int8]]:
    """Return twice the signed areas (3, m), m², opposite each corner, and their signs (3, 4, m).

    The second axis of the signs is the quadrant into which a point on an edge is moved. `faces` (m,
    3) and `points` (m, 2) are triangle and line of each pair; `flat` (n, 2) are the vertices in the
    plane normal to the lines. The last two are the same positions as integers.
    """
    area = np.empty((3, len(faces)))
    sides = np.empty((3, 4, len(faces)), np.int8)
    for corner in range(3):
        start, end = faces[:, (corner + 1) % 3], faces[:, (corner + 2) % 3]
        reversed_edge = start > end
        tail, head = (
            flat[np.where(reversed_edge, end, start)],
            flat[np.where(reversed_edge, start, end)],
        )
        edge, offset = head - tail, points - tail
        value = edge[:, 0] * offset[:, 1] - edge[:, 1] * offset[:, 0]
        tails, heads = (
            whole_flat[np.where(t, end, start)] for t in (reversed_edge, ~reversed_edge)
        )
        edges, offsets = heads - tails, whole_points - tails
        exact = edges[:, 0] * offsets[:, 1] - edges[:, 1] * offsets[:, 0]
        orientation = np.where(reversed_edge, -1, 1)
        area[corner] = value * orientation
        for quadrant, (u, v) in enumerate(((1, 1), (-1, 1), (1, -1), (-1, -1))):
            perturbed = np.where(edges[:, 1] != 0, -edges[:, 1] * u, edges[:, 0] * v)
            sides[corner, quadrant] = np.sign(np.where(exact == 0, perturbed, exact)) * orientation
    return area, sides


def _paired(line: Index, height: Array, rising: Mask, count: int) -> tuple[Index, Array]:
    """Return sorted line and height of all ends; a `rising` crossing is an exit."""
    step = np.where(rising, -1, 1)
    closed = (np.bincount(line, step, minlength=count) == 0)[line]
    lines, heights = _distinct(line[~closed], height[~closed], rising[~closed])
    line, height, step = line[closed], height[closed], step[closed]
    order = np.lexsort((-step, height, line))
    line, height, step = line[order], height[order], step[order]
    winding = np.cumsum(step)
    ends = np.flatnonzero((winding > 0) != (winding - step > 0))
    line, height = line[ends], height[ends]
    touching = np.zeros(len(ends), bool)
    touching[1:-1:2] = (np.diff(line)[1::2] == 0) & (np.diff(height)[1::2] <= TOUCHING_DISTANCE)
    touching[2::2] = touching[1:-1:2]
    lines = np.concatenate([lines, line[~touching]])
    heights = np.concatenate([heights, height[~touching]])
    order = np.lexsort((heights, lines))
    return lines[order], heights[order]


def _distinct(line: Index, height: Array, rising: Mask) -> tuple[Index, Array]:
    """Return the sorted crossings; duplicate faces count once."""
    order = np.lexsort((height, rising, line))
    line, height, rising = line[order], height[order], rising[order]
    keep = np.ones(len(line), bool)
    keep[1:] = (np.diff(line) > 0) | (np.diff(height) > SAME_HEIGHT) | (rising[1:] != rising[:-1])
    line, height = line[keep], height[keep]
    order = np.lexsort((height, line))
    return line[order], height[order]


def _repaired(
    line: Index, height: Array, odd: Mask, shape: tuple[int, int], name: str
) -> tuple[Index, Array]:
    if not odd.any():
        return line, height
    crossed = np.count_nonzero(np.bincount(line, minlength=odd.size))
    if odd.sum() > max(ODD_SHARE * crossed, 1):
        raise InputError(
            f"{odd.sum()} of {crossed} rays cross the surface an odd number of times: it is open",
            name,
            "close the mesh, or leave its holes smaller than a cell",
        )
    start = np.searchsorted(line, np.arange(odd.size + 1))
    lines, heights = [line[~odd[line]]], [height[~odd[line]]]
    for ray in np.flatnonzero(odd):
        heights_of_ray = height[start[ray] : start[ray + 1]]
        repaired = _completed(
            heights_of_ray, [height[start[n] : start[n + 1]] for n in _around(int(ray), odd, shape)]
        )
        if repaired is None:
            a, b = divmod(int(ray), shape[1])
            raise InputError(f"a hole wider than one cell at grid line ({a}, {b})", name)
        lines.append(np.full(len(repaired), ray))
        heights.append(repaired)
    repaired_lines, values = np.concatenate(lines), np.concatenate(heights)
    order = np.lexsort((values, repaired_lines))
    return repaired_lines[order], values[order]


def _around(ray: int, odd: Mask, shape: tuple[int, int]) -> list[int]:
    """Return those of the eight neighbours with an even number of crossings."""
    a, b = divmod(ray, shape[1])
    near = [(a + i, b + k) for i in (-1, 0, 1) for k in (-1, 0, 1) if i or k]
    inside = [n for n in near if 0 <= n[0] < shape[0] and 0 <= n[1] < shape[1]]
    return [i * shape[1] + k for i, k in inside if not odd[i * shape[1] + k]]


def _completed(crossings: Array, neighbours: list[Array]) -> Array | None:
    """Return a line's crossings (n,), n odd, with one added or removed; None if its `neighbours`
    differ; all in m.
    """
    for count in (len(crossings) + 1, len(crossings) - 1):
        fitting = [n for n in neighbours if len(n) == count]
        if len(fitting) < 2:
            continue
        mean = np.mean(fitting, axis=0)
        longer, shorter = (mean, crossings) if count > len(crossings) else (crossings, mean)
        misfit = [np.abs(np.delete(longer, i) - shorter).sum() for i in range(len(longer))]
        spare = int(np.argmin(misfit))
        return (
            np.sort(np.append(crossings, mean[spare]))
            if count > len(crossings)
            else np.delete(crossings, spare)
        )
    return None
