"""Which nodes of every vertical grid line belong to the insert, by rules 7 to 9 of Sharma (2008).

A line along y runs inside the part over a set of intervals. The node nearest an interval's end
is moved onto the surface (half-cell rule); intervals thinner than a cell follow rules 8 and 9.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.contact.lattice.meshing.levels import follow_top
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.height_field import Intervals, inside_intervals
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

Nodes = tuple[Index, ...]


@dataclass(frozen=True)
class ColumnSettings:
    """The columns of nodes that a lattice stands on."""

    tie: float = 1e-6
    """Cells: a distance this near half a cell counts as half a cell. Chosen: rounding does not
    decide."""
    side_tolerance: float = 0.02
    """Cells: vertices this near the bounding box lie on its side. Chosen: the difference is noise
    of the mesh."""
    wall_normal_y: float = 0.05
    """1: a triangle whose normal has a smaller superior component (87 deg) belongs to a wall.
    Chosen: no surface that carries is as steep."""
    wall_inset: float = 0.02
    """Cells: distance that a node stays inside a wall. Chosen: rays along y miss a wall at its
    hit."""
    max_height_change: float = 0.75
    """Cells: a surface whose height changes by more from one column to the next is another surface.
    Chosen: a slope that a column of cells can follow changes by less."""


COLUMN = ColumnSettings()


@dataclass(eq=False)
class NodeField:
    """Every node of the structured grid while it is being settled; arrays are (nx, ny, nz).

    Args:
        lines: x and z coordinates (m) of the grid lines along y.
        spacing: (3,) m.
        points: (nx, ny, nz, 3) m.
        member: belongs to the part.
        lower_end: lower end of an interval of its line.
        upper_end: upper end of an interval of its line.
        top: upper end of the highest interval of its line.
        interval: number of the interval that holds the node, -1 where none does.
        mended: lines mended from their neighbours.
        closed_gaps: gaps too narrow for the grid, filled.
        thin: intervals thinner than half a cell, held by one node.
    """

    lines: tuple[Array, Array]
    spacing: Array
    points: Array
    member: Mask
    lower_end: Mask
    upper_end: Mask
    top: Mask
    interval: Index
    mended: int
    closed_gaps: int
    thin: int

    def has_top(self, nodes: tuple[Index, ...]) -> Mask:
        """Say whether the columns of nodes (i, j, k) have a top already."""
        return np.logical_or.reduce(self.top, axis=1)[nodes[0], nodes[2]]


@dataclass(frozen=True, eq=False)
class Ends:
    """First and last node of intervals, in layers.

    `single` marks an interval held by one node; of these `held` ones leave it where it is.
    """

    first: Index
    last: Index
    single: Mask
    held: Mask


def settle_columns(surface: Surface, spacing: Array) -> NodeField:
    """Return the grid over the surface's bounding box with its columns settled along y.

    Args:
        surface: closed insert in the insert frame.
        spacing: (3,) m.
    """
    x, z = (_grid_line(surface, axis, spacing[axis]) for axis in (0, 2))
    intervals = inside_intervals(surface, 1, z, x)
    i, k = intervals.second, intervals.first
    top = np.full((len(x), len(z)), np.nan)
    top[i, k] = intervals.upper
    levels = follow_top(top, surface.bounds[0, 1], spacing)
    low, high = levels.position(intervals.lower, i, k), levels.position(intervals.upper, i, k)
    intervals, low, high, closed = _without_narrow_gaps(intervals, low, high)
    field = _empty_field((x, z), spacing, levels.heights())
    field.mended, field.closed_gaps = intervals.mended, closed
    _admit(field, intervals, interval_ends(low, high, levels.count))
    return field


def interval_ends(low: Array, high: Array, count: int) -> Ends:
    """Return the nodes that hold intervals [low, high] of a line, in layers.

    With T = high - low and n nodes strictly inside, the node nearest to either end goes there.
    n = 0: two nodes for T > 1/2, else one at the mean. n = 1: left alone for T < 1/2; else,
    where one node is nearest to both ends, it goes to the nearer end and the outside node
    beyond the other end joins it.

    Args:
        low: (m,) lower ends.
        high: (m,) upper ends.
        count: number of nodes of a line.
    """
    first = np.floor(low + 0.5 + COLUMN.tie).astype(np.int64)
    last = np.ceil(high - 0.5 - COLUMN.tie).astype(np.int64)
    inside = np.ceil(high - COLUMN.tie) - np.floor(low + COLUMN.tie) - 1
    thick = high - low > 0.5 + COLUMN.tie
    single = ~thick & (inside <= 1)
    thin = single & (inside == 1)
    joined = thick & (first >= last)
    upwards = (np.abs(low - first) <= np.abs(high - first)) & (first < count - 1)
    last = np.where(joined, first + upwards, last)
    first = np.where(joined, last - 1, first)
    middle = np.where(thin, np.floor(low + COLUMN.tie) + 1, np.round(0.5 * (low + high))).astype(
        np.int64
    )
    return Ends(np.where(single, middle, first), np.where(single, middle, last), single, thin)


def _grid_line(surface: Surface, axis: int, spacing: float) -> Array:
    """Return even coordinates over the part, first and last on the inner side of its walls."""
    lower, upper = surface.bounds[:, axis]
    line = np.linspace(lower, upper, round((upper - lower) / spacing) + 1)
    values = surface.vertices[:, axis]
    line[0] = values[values <= lower + COLUMN.side_tolerance * spacing].max()
    line[-1] = values[values >= upper - COLUMN.side_tolerance * spacing].min()
    return line


def _empty_field(lines: tuple[Array, Array], spacing: Array, heights: Array) -> NodeField:
    x, z = lines
    points = np.empty((*heights.shape, 3))
    points[..., 0], points[..., 2] = x[:, None, None], z[None, None, :]
    points[..., 1] = heights
    return NodeField(
        lines=lines,
        spacing=spacing,
        points=points,
        member=np.zeros(heights.shape, bool),
        lower_end=np.zeros(heights.shape, bool),
        upper_end=np.zeros(heights.shape, bool),
        top=np.zeros(heights.shape, bool),
        interval=np.full(heights.shape, -1),
        mended=0,
        closed_gaps=0,
        thin=0,
    )


def _without_narrow_gaps(
    intervals: Intervals, low: Array, high: Array
) -> tuple[Intervals, Array, Array, int]:
    """Join neighbouring intervals of a line whose facing ends fall on the same node."""
    same = (np.diff(intervals.first) == 0) & (np.diff(intervals.second) == 0)
    joined = same & (np.floor(low[1:] + 0.5 + COLUMN.tie) <= np.ceil(high[:-1] - 0.5 - COLUMN.tie))
    begins = np.flatnonzero(np.append(True, ~joined))
    ends = np.append(begins[1:], len(low)) - 1
    merged = Intervals(
        intervals.first[begins],
        intervals.second[begins],
        intervals.lower[begins],
        intervals.upper[ends],
        intervals.mended,
    )
    return merged, low[begins], high[ends], int(joined.sum())


def _admit(field: NodeField, intervals: Intervals, ends: Ends) -> None:
    """Make the nodes of every interval members and move its ends onto the surface."""
    i, k = intervals.second, intervals.first
    count = ends.last - ends.first + 1
    owner = np.repeat(np.arange(len(count)), count)
    rank = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    run = i[owner], ends.first[owner] + rank, k[owner]
    field.member[run] = True
    field.interval[run] = owner
    mean = 0.5 * (intervals.lower + intervals.upper)
    free = ~ends.held
    lower = np.where(ends.single, mean, intervals.lower)
    upper = np.where(ends.single, mean, intervals.upper)
    field.points[i[free], ends.first[free], k[free], 1] = lower[free]
    field.points[i[free], ends.last[free], k[free], 1] = upper[free]
    field.lower_end[i, ends.first, k] = True
    field.upper_end[i, ends.last, k] = True
    same = (np.diff(intervals.first) == 0) & (np.diff(intervals.second) == 0)
    highest = np.append(~same, True) & ~ends.single
    field.top[i[highest], ends.last[highest], k[highest]] = True
    field.thin = int(ends.single.sum())


def refired_inwards(
    field: NodeField, nodes: Nodes, target: Array, inward: Array, rays: RayCaster
) -> Array:
    """Return the heights (n,) of nodes at places on walls; a miss moves the target inwards.

    A wall is rough by the mesh's noise: a vertical ray on it may pass the part. Where one
    does, it is fired again INSIDE_WALL inside the wall and the target (n, 3) is moved there.

    Args:
        field: nodes.
        nodes: which of them.
        target: (n, 3) m, where they go; y is not used.
        inward: (n, 2) along x and z into the part, of any length but 0.
        rays: of the part.
    """
    height = refired(field, nodes, target, rays)
    missed = np.flatnonzero(~np.isfinite(height))
    if missed.size:
        step = inward[missed] / np.linalg.norm(inward[missed], axis=1, keepdims=True)
        target[missed[:, None], [0, 2]] += COLUMN.wall_inset * field.spacing[[0, 2]] * step
        again = tuple(index[missed] for index in nodes)
        height[missed] = refired(field, again, target[missed], rays)
    return height


def refired(field: NodeField, nodes: Nodes, target: Array, rays: RayCaster) -> Array:
    """Return the heights (n,) of nodes at new places: on the surface for ends of intervals.

    NaN where the surface is farther than REACH from where it was.
    """
    height = field.points[..., 1][nodes]
    for end, facing in ((field.upper_end[nodes], 1.0), (field.lower_end[nodes], -1.0)):
        rows = np.flatnonzero(end)
        base = target[rows].copy()
        base[:, 1] = rays.surface.bounds[0, 1] - field.spacing[1]
        ray, t, face = rays.all(base, (0.0, 1.0, 0.0))
        right = rays.surface.face_normals[face, 1] * facing > COLUMN.wall_normal_y
        ray, y = ray[right], base[ray[right], 1] + t[right]
        off = np.abs(y - height[rows[ray]])
        order = np.lexsort((off, ray))
        with_hit, head = np.unique(ray[order], return_index=True)
        value = np.full(len(rows), np.nan)
        close = off[order][head] <= COLUMN.max_height_change * field.spacing[1]
        value[with_hit[close]] = y[order][head][close]
        height[rows] = value
    return height
