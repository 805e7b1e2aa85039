"""Which grid nodes belong to the insert, and which of them are moved onto its surface.

Along every grid line the part is a set of intervals. The node nearest an interval's end, at
most half a cell away, is moved onto the surface (the source's half-cell rule); intervals
thinner than a cell follow the source's rules 8 and 9. Lines along y come first and settle the
contact surface and the bottom; lines along z and x then settle the walls that y misses, and
never move a node that is on the surface already.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.geometry.height_field import Intervals, inside_intervals
from tkamb.geometry.surface import Surface

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

TIE = 1e-6
"""Cells: a distance this near half a cell counts as half a cell."""
WALL = 1e-7
"""m: vertices this near the bounding box are on its side (single-precision meshes)."""


@dataclass(eq=False)
class NodeField:
    """Every node of the structured grid while it is being settled.

    Args:
        lines: three increasing coordinate arrays, m.
        spacing: (3,) m.
        points: (nx, ny, nz, 3) m.
        member: (nx, ny, nz) belongs to the part.
        snapped: (nx, ny, nz) lies on the surface.
        interval: (3, nx, ny, nz) number of the interval along each axis that holds the node,
            -1 where none does.
        top: (nx, ny, nz) upper end of the highest interval of its line along y.
        mended: lines mended per axis.
        closed_gaps: gaps narrower than a cell that the grid cannot show.
        thin: intervals thinner than half a cell, left out or held by one node.
    """

    lines: tuple[Array, Array, Array]
    spacing: Array
    points: Array
    member: Mask
    snapped: Mask
    interval: Index
    top: Mask
    mended: list[int] = field(default_factory=lambda: [0, 0, 0])
    closed_gaps: int = 0
    thin: int = 0


@dataclass(frozen=True, eq=False)
class Ends:
    """Intervals in grid terms: first and last node, where these are moved to, and how.

    `single` marks an interval held by one node only, `held` one whose node stays put.
    """

    first: Index
    last: Index
    lower: Array
    upper: Array
    single: Mask
    held: Mask


def settle_nodes(surface: Surface, spacing: Array) -> NodeField:
    """Return the nodes of the grid over the surface's bounding box, settled along y, z, x."""
    nodes = _empty_field(surface, spacing)
    for axis in (1, 2, 0):
        others = nodes.lines[(axis + 1) % 3], nodes.lines[(axis + 2) % 3]
        intervals = inside_intervals(surface, axis, *others)
        nodes.mended[axis] = intervals.mended
        intervals, closed = _without_narrow_gaps(intervals, nodes.lines[axis], spacing[axis])
        ends = interval_ends(intervals.lower, intervals.upper, nodes.lines[axis], spacing[axis])
        if axis == 1:
            nodes.closed_gaps, nodes.thin = closed, int(ends.single.sum())
            _admit_columns(nodes, intervals, ends)
        else:
            _settle_walls(nodes, axis, intervals, ends)
        _number_intervals(nodes, axis, intervals, ends)
    return nodes


def interval_ends(lower: Array, upper: Array, line: Array, spacing: float) -> Ends:
    """Return the nodes that hold each interval of a line, by the half-cell rules.

    With T the thickness in cells and n the nodes strictly inside: the nearest node to either
    end is moved onto it. n = 0: two nodes for T > 1/2, else one at the mean. n = 1: left alone
    for T < 1/2; else, where one node is nearest to both ends, it goes to the nearer end and
    the outside node beyond the other end joins it.
    """
    low, high = (lower - line[0]) / spacing, (upper - line[0]) / spacing
    first = np.floor(low + 0.5 + TIE).astype(np.int64)
    last = np.ceil(high - 0.5 - TIE).astype(np.int64)
    inside = np.ceil(high - TIE) - np.floor(low + TIE) - 1
    thick = high - low > 0.5 + TIE
    single, held = ~thick & (inside <= 1), ~thick & (inside == 1)
    middle = np.where(held, np.floor(low + TIE) + 1, np.round(0.5 * (low + high))).astype(np.int64)
    joined = thick & (first >= last)
    upwards = (middle_distance(low, first) <= middle_distance(high, first)) & (
        first < len(line) - 1
    )
    last = np.where(joined, first + upwards, np.where(single, middle, last))
    first = np.where(joined, last - 1, np.where(single, middle, first))
    mean = np.where(held, line[np.clip(middle, 0, len(line) - 1)], 0.5 * (lower + upper))
    return Ends(
        first, last, np.where(single, mean, lower), np.where(single, mean, upper), single, held
    )


def middle_distance(position: Array, node: Index) -> Array:
    """Return the distance in cells from a position on a line to a node of it."""
    return np.asarray(np.abs(position - node))


def _empty_field(surface: Surface, spacing: Array) -> NodeField:
    lower, upper = surface.bounds
    counts = np.round((upper - lower) / spacing).astype(int) + 1
    lines = []
    for axis in range(3):
        line = np.linspace(lower[axis], upper[axis], counts[axis])
        values = surface.vertices[:, axis]
        line[0] = values[values <= lower[axis] + WALL].max()
        line[-1] = values[values >= upper[axis] - WALL].min()
        lines.append(line)
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    empty = np.zeros(tuple(counts), bool)
    numbers = np.full((3, *counts), -1)
    return NodeField(
        (lines[0], lines[1], lines[2]),
        spacing,
        points,
        empty,
        empty.copy(),
        numbers,
        empty.copy(),
    )


def _without_narrow_gaps(
    intervals: Intervals, line: Array, spacing: float
) -> tuple[Intervals, int]:
    """Join neighbouring intervals of a line whose facing ends fall on the same node."""
    low = np.floor((intervals.lower - line[0]) / spacing + 0.5 + TIE)
    high = np.ceil((intervals.upper - line[0]) / spacing - 0.5 - TIE)
    same = (np.diff(intervals.first) == 0) & (np.diff(intervals.second) == 0)
    joined = same & (low[1:] <= high[:-1])
    begins = np.flatnonzero(np.append(True, ~joined)) if len(low) else np.zeros(0, np.int64)
    ends = np.append(begins[1:], len(low)) - 1 if len(low) else begins
    merged = Intervals(
        intervals.first[begins],
        intervals.second[begins],
        intervals.lower[begins],
        intervals.upper[ends],
        intervals.mended,
    )
    return merged, int(joined.sum())


def _nodes_of(axis: int, intervals: Intervals, along: Index, chosen: Mask | Index) -> tuple:
    """Return the (i, j, k) index arrays of one node per chosen interval."""
    index: list[Index] = [along] * 3
    index[(axis + 1) % 3] = intervals.first[chosen]
    index[(axis + 2) % 3] = intervals.second[chosen]
    return tuple(index)


def _runs(axis: int, intervals: Intervals, ends: Ends) -> tuple[tuple, Index]:
    """Return (i, j, k) of every node from first to last of every interval, and its interval."""
    count = np.maximum(ends.last - ends.first + 1, 0)
    owner = np.repeat(np.arange(len(count)), count)
    rank = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return _nodes_of(axis, intervals, ends.first[owner] + rank, owner), owner


def _admit_columns(nodes: NodeField, intervals: Intervals, ends: Ends) -> None:
    """Make the nodes of every interval along y members and move its ends onto the surface."""
    run, _ = _runs(1, intervals, ends)
    nodes.member[run] = True
    every = np.ones(len(ends.first), bool)
    lower, upper = (_nodes_of(1, intervals, e, every) for e in (ends.first, ends.last))
    nodes.points[(*lower, 1)] = ends.lower
    nodes.points[(*upper, 1)] = ends.upper
    moved = ~ends.single
    nodes.snapped[tuple(i[moved] for i in lower)] = True
    nodes.snapped[tuple(i[moved] for i in upper)] = True
    same = (np.diff(intervals.first) == 0) & (np.diff(intervals.second) == 0)
    highest = np.append(~same, True)[: len(moved)] & moved
    nodes.top[tuple(i[highest] for i in upper)] = True


def _settle_walls(nodes: NodeField, axis: int, intervals: Intervals, ends: Ends) -> None:
    """Move the nodes nearest the ends of intervals along z or x onto the wall there."""
    chosen = ~ends.single
    for along, position in ((ends.first, ends.lower), (ends.last, ends.upper)):
        index = _nodes_of(axis, intervals, along[chosen], chosen)
        free = ~nodes.snapped[index]
        index = tuple(i[free] for i in index)
        nodes.points[(*index, axis)] = position[chosen][free]
        nodes.member[index] = True
        nodes.snapped[index] = True


def _number_intervals(nodes: NodeField, axis: int, intervals: Intervals, ends: Ends) -> None:
    run, owner = _runs(axis, intervals, ends)
    nodes.interval[(axis, *run)] = owner
