"""Sideways moves of nodes onto walls, which vertical rays do not meet, and into notches.

Walls: if a node has no cell beside it, a ray along x or z finds the wall. Within half a cell the
node is moved onto it; otherwise the next node outside is moved inwards onto it.

Notches: a grid follows an oblique surface in steps, and each leaves a wedge that belongs to no
cell. The node outside of it is moved into the corner of the part, or on a straight surface almost
onto the line between its two neighbours.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.contact.lattice.meshing.columns import (
    COLUMN_TIE,
    NodeField,
    Nodes,
    refired,
    refired_inwards,
)
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.height_field import inside_intervals
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

# 1: a node is moved towards the line between its neighbours, except for this share of the way.
# On the line the cell's corner would be flat.
CORNER_MARGIN = 0.1
# 1: a node is moved to the corner of the part, and from there inwards by this share of the way to
# the node across the diagonal. Vertical rays then meet the part.
CORNER_INSET = 1e-3
# Cells: distance below the top, or above the bottom, of points that are tested for being inside
# the part. Above the rounding of a mesh and within the cell.
RAY_START_CELLS = 0.1
# Diagonals of a cell's face: largest move of a node. A larger move would invert the
# cell.
MAX_MOVE_DIAGONALS = 0.75


def fill_notches(field: NodeField, before: Array, rays: RayCaster) -> None:
    """Make the fourth node of a grid square a member, if the other three are members.

    Steps of the outline in a layer come first, then steps between layers. `before` (nx, ny, nz, 3),
    m, are the nodes before moves onto walls.
    """
    for axes in ((0, 2), (0, 1), (2, 1)):
        member = field.member.copy()
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            u, v = np.zeros(3, int), np.zeros(3, int)
            u[axes[0]], v[axes[1]] = signs
            notch = _shifted(member, u) & _shifted(member, v) & _shifted(member, u + v)
            node = np.argwhere(notch & ~field.member)
            if len(node):
                _fill(
                    field,
                    Notch(axes, *(tuple(n.T) for n in (node, node + u, node + v, node + u + v))),
                    before,
                    rays,
                )


def _shifted(mask: Mask, step: Index) -> Mask:
    padded = np.pad(mask, 1)
    window = tuple(slice(1 + d, 1 + d + n) for d, n in zip(step, mask.shape, strict=True))
    return padded[window]


@dataclass(frozen=True, eq=False)
class Notch:
    """Squares of the grid that lack one node.

    Args:
        axes: the two axes of the squares.
        node: missing nodes; `first` and `second` are neighbours along these axes.
    """

    axes: tuple[int, int]
    node: Nodes
    first: Nodes
    second: Nodes
    across: Nodes


def _fill(field: NodeField, notch: Notch, before: Array, rays: RayCaster) -> None:
    """Move missing nodes into the corner of the part, or between their neighbours."""
    first, second, across = (field.points[n] for n in (notch.first, notch.second, notch.across))
    start, middle = before[notch.node], 0.5 * (first + second)
    flat = notch.axes == (0, 2)
    upper, lower = (
        e[notch.first] & e[notch.second] & flat for e in (field.upper_end, field.lower_end)
    )
    if flat:
        middle[:, 1] = np.where(upper | lower, middle[:, 1], start[:, 1])
    corner = middle.copy()
    corner[:, notch.axes[0]], corner[:, notch.axes[1]] = (
        second[:, notch.axes[0]],
        first[:, notch.axes[1]],
    )
    within = (
        np.where(upper, -RAY_START_CELLS, np.where(lower, RAY_START_CELLS, 0.0)) * field.spacing[1]
    )
    corner = _towards(corner, across, CORNER_INSET, 0.0)
    winding = rays.surface.winding
    is_corner = winding.inside(_towards(corner, across, 0.0, within))
    usable = is_corner | winding.inside(_towards(middle, across, 0.1, within))
    target = np.where(is_corner[:, None], corner, middle + CORNER_MARGIN * (start - middle))
    if flat:
        probe = np.where(is_corner[:, None], corner, middle)
        field.points[..., 1][notch.node] = middle[:, 1]
        field.upper_end[notch.node], field.lower_end[notch.node] = upper, lower
        target[:, 1] = refired(field, notch.node, probe, rays)
    max_move = MAX_MOVE_DIAGONALS * np.linalg.norm(field.spacing[list(notch.axes)])
    usable &= np.linalg.norm((target - start)[:, notch.axes], axis=1) <= max_move
    _add_members(field, notch, target, usable, flat)


def _towards(point: Array, goal: Array, share: float, rise: Array | float) -> Array:
    """Return points moved sideways by a share of the way, and up by `rise`, m."""
    result = point + share * (goal - point)
    result[:, 1] = point[:, 1] + rise
    return result


def _add_members(field: NodeField, notch: Notch, target: Array, usable: Mask, flat: bool) -> None:
    """Make the usable nodes members.

    In a horizontal square, one between two top nodes becomes a top node. Otherwise forces on the
    other nodes of its cell's upper face would be too large.
    """
    rejected, added = (tuple(n[mask] for n in notch.node) for mask in (~usable, usable))
    field.upper_end[rejected] = field.lower_end[rejected] = False
    field.points[added] = target[usable]
    field.member[added] = True
    is_top = field.top[notch.first] & field.top[notch.second] & flat
    is_top &= ~field.has_top(notch.node)
    field.top[added] = is_top[usable]


STEPS = ((0, 1), (0, -1), (2, 1), (2, -1))
"""Axis and sign of the four sideways directions."""


# 1: distance inside the wall of a node that is moved to it, relative to the move.
# Vertical rays then meet the part.
WALL_INSET = 1e-6
# Cells: distance inside the surface at which sideways rays of end nodes begin. Above the
# rounding of a mesh and within the cell.
WALL_NODE_RAY_START_CELLS = 0.1


@dataclass(frozen=True, eq=False)
class WallHits:
    """The walls beside the nodes of the grid in one of the four directions.

    Args:
        open: mask of the members without a cell on this side, (nx, ny, nz). For the end of
            an interval, the next node inside the interval must be such a member too.
        distance: distance to the wall, m, (nx, ny, nz); inf if there is none.
    """

    open: Mask
    distance: Array


def move_to_walls(field: NodeField, surface: Surface) -> None:
    """Move nodes of `field` sideways onto the walls, and add nodes from outside (in place)."""
    rays = surface.rays
    before = field.points.copy()
    firing = _firing_points(field)
    hits = _walls_beside(field, firing, rays, surface)
    _move_out(field, firing, hits, rays)
    _pull_in(field, before, hits, rays)
    fill_notches(field, before, rays)


def _firing_points(field: NodeField) -> Array:
    """Return where sideways rays begin: at ends of intervals inside."""
    result = field.points.copy()
    height = field.points[..., 1]
    for end, step in ((field.upper_end, -1), (field.lower_end, 1)):
        i, j, k = np.nonzero(end & ~(field.upper_end & field.lower_end))
        result[i, j, k, 1] += WALL_NODE_RAY_START_CELLS * (height[i, j + step, k] - height[i, j, k])
    return result


def _filled_cells(field: NodeField, surface: Surface) -> Mask:
    member, y = field.member, field.points[..., 1]
    complete = np.ones(tuple(n - 1 for n in member.shape), bool)
    centre = np.zeros(complete.shape)
    for i, j, k in np.ndindex(2, 2, 2):
        corner = tuple(slice(o, o + n) for o, n in zip((i, j, k), complete.shape, strict=True))
        complete &= member[corner]
        centre += y[corner] / 8.0
    x, z = ((line[1:] + line[:-1]) / 2.0 for line in field.lines)
    intervals = inside_intervals(surface, 1, z, x)
    filled = np.zeros_like(complete)
    a, b = intervals.second, intervals.first
    rank = np.arange(len(a)) - np.searchsorted(b * len(x) + a, b * len(x) + a)
    for r in range(int(rank.max(initial=-1)) + 1):
        at = rank == r
        low, high = np.full((len(x), len(z)), np.inf), np.full((len(x), len(z)), -np.inf)
        low[a[at], b[at]], high[a[at], b[at]] = intervals.lower[at], intervals.upper[at]
        filled |= (centre > low[:, None]) & (centre < high[:, None])
    return complete & filled


def _walls_beside(
    field: NodeField, firing: Array, rays: RayCaster, surface: Surface
) -> list[WallHits]:
    """Return the walls in each direction of STEPS."""
    cells = np.pad(_filled_cells(field, surface), 1)
    result = []
    for axis, sign in STEPS:
        beside = cells[1:] if sign > 0 else cells[:-1]
        if axis == 2:
            beside = cells[:, :, 1:] if sign > 0 else cells[:, :, :-1]
        cross_axis = 2 - axis
        joined = beside[:, 1:] | beside[:, :-1]
        joined = np.moveaxis(joined, cross_axis, 0)
        joined = np.moveaxis(joined[1:] | joined[:-1], 0, cross_axis)
        free = field.member & ~joined
        above, below = np.zeros_like(free), np.zeros_like(free)
        above[:, :-1], below[:, 1:] = free[:, 1:], free[:, :-1]
        free &= ~(field.upper_end & ~below) & ~(field.lower_end & ~above)
        distance = np.full(free.shape, np.inf)
        direction = np.zeros(3)
        direction[axis] = sign
        t, face = rays.first(firing[free], direction)
        leaving = rays.surface.face_normals[face][:, axis] * sign > 0.0
        distance[free] = np.where(leaving, t, np.inf)
        result.append(WallHits(free, distance))
    return result


def _move_out(field: NodeField, firing: Array, hits: list[WallHits], rays: RayCaster) -> None:
    move = np.zeros((*field.member.shape, 2))
    for column, axis in ((0, 0), (1, 2)):
        forward, backward = hits[axis : axis + 2]
        ahead, behind = forward.distance, backward.distance
        tie = COLUMN_TIE * field.spacing[axis]
        near = np.minimum(ahead, behind) <= 0.5 * field.spacing[axis] + tie
        is_ahead = ahead <= behind + tie
        step = np.where(is_ahead, ahead, -behind)
        move[..., column] = np.where(near & (np.abs(step) > tie), step, 0.0)
        # These walls now have a node. In a thin part, the opposite wall still needs the node
        # outside.
        forward.distance[near & is_ahead] = np.inf
        backward.distance[near & ~is_ahead] = np.inf
    nodes: Nodes = np.nonzero((move != 0.0).any(axis=-1))
    target = _corner_or_wall(firing[nodes], move[nodes], rays)
    height = refired_inwards(field, nodes, target, -move[nodes], rays)
    valid = np.isfinite(height)
    nodes = tuple(index[valid] for index in nodes)
    target[:, 1] = height
    field.points[nodes] = target[valid]


def _corner_or_wall(start: Array, move: Array, rays: RayCaster) -> Array:
    """Return new positions (n, 3), m; `move` is as in `_add_at`.

    Between two walls it is their corner if this lies in the part, else `_foot`.
    """
    move = move * (1.0 - WALL_INSET)
    corner = start.copy()
    corner[:, [0, 2]] += move
    with_two_walls = np.flatnonzero((move != 0.0).all(axis=1))
    if with_two_walls.size:
        tested = corner[with_two_walls].copy()
        tested[:, [0, 2]] -= 1e-3 * move[with_two_walls]
        cut = with_two_walls[~rays.surface.winding.inside(tested)]
        u, w = move[cut].T
        foot = np.column_stack([u * w**2, w * u**2]) / (u**2 + w**2)[:, None]
        corner[cut[:, None], [0, 2]] = start[cut][:, [0, 2]] + foot
    return corner


def _pull_in(field: NodeField, before: Array, hits: list[WallHits], rays: RayCaster) -> None:
    """Move nodes outside of the part onto the wall before a member, and add them."""
    move = np.zeros((*field.member.shape, 2))
    upper, lower, top = (np.ones(field.member.shape, bool) for _ in range(3))
    height = np.full(field.member.shape, np.nan)
    for (axis, sign), hit in zip(STEPS, hits, strict=True):
        spacing = field.spacing[axis]
        tie = COLUMN_TIE * spacing
        near = hit.open & (hit.distance < spacing + tie)
        i, j, k = np.nonzero(near)
        beside = [i, j, k]
        beside[axis] = beside[axis] + sign
        in_grid = (beside[axis] >= 0) & (beside[axis] < field.member.shape[axis])
        node: Nodes = (i[in_grid], j[in_grid], k[in_grid])
        added: Nodes = (beside[0][in_grid], beside[1][in_grid], beside[2][in_grid])
        outside = ~field.member[added]
        node, added = tuple(n[outside] for n in node), tuple(n[outside] for n in added)
        column = 0 if axis == 0 else 1
        move[..., column][added] = -sign * np.maximum(spacing - hit.distance[node], tie)
        upper[added] &= field.upper_end[node]
        lower[added] &= field.lower_end[node]
        top[added] &= field.top[node]
        height[added] = before[..., 1][node]
    nodes = np.nonzero((move != 0.0).any(axis=-1))
    _add_at(field, nodes, before, move[nodes], (lower, upper, top), height, rays)


def _add_at(
    field: NodeField,
    nodes: Nodes,
    before: Array,
    move: Array,
    ends: tuple[Mask, Mask, Mask],
    height: Array,
    rays: RayCaster,
) -> None:
    """Move nodes onto walls and make them members, if their rays meet the part.

    `move` (n, 2), m, are vectors to the walls along x and z, 0 without a wall. `ends` are masks of
    future lower ends, upper ends and top nodes, and `height` has the heights, m, of these ends.
    """
    start = before[nodes]
    target = start.copy()
    target[:, [0, 2]] += _foot(move)
    field.lower_end[nodes], field.upper_end[nodes] = ends[0][nodes], ends[1][nodes]
    at_end = field.lower_end[nodes] | field.upper_end[nodes]
    field.points[..., 1][nodes] = np.where(at_end, height[nodes], start[:, 1])
    new_height = refired_inwards(field, nodes, target, move, rays)
    valid = np.isfinite(new_height)
    rejected = tuple(n[~valid] for n in nodes)
    field.lower_end[rejected] = field.upper_end[rejected] = False
    nodes = tuple(n[valid] for n in nodes)
    target[:, 1] = new_height
    field.points[nodes] = target[valid]
    field.member[nodes] = True
    field.top[nodes] = ends[2][nodes] & ~field.has_top(nodes)


def _foot(move: Array) -> Array:
    """Return the moves (n, 2), m, onto walls at `move` along x and z.

    Between two walls it is the foot of the perpendicular on the line through the hits.
    """
    move = move * (1.0 + WALL_INSET)
    with_two_walls = (move != 0.0).all(axis=1)
    result = move.copy()
    u, w = move[with_two_walls].T
    result[with_two_walls] = np.column_stack([u * w**2, w * u**2]) / (u**2 + w**2)[:, None]
    return result
