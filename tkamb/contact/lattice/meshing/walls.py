"""Nodes moved sideways onto walls, which rays along y cannot see, and into notches.

Walls: where a node has no cell beside it, a ray along z or x from the node finds the wall. If the
wall is nearer than half a cell, the node is moved onto it. If it is farther, the node outside is
moved inwards onto it.

Notches: a grid follows an oblique surface in steps, and each step leaves a wedge that belongs to
no cell. The node outside the wedge is moved into the corner of the part. Where the surface runs
straight on, the node is moved almost onto the line between its two neighbours.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.contact.lattice.meshing.columns import COLUMN, NodeField, Nodes, refired, refired_inwards
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.height_field import inside_intervals
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface


@dataclass(frozen=True)
class NotchSettings:
    """Nodes that are moved into notches of the surface."""

    corner_margin: float = 0.1
    """1: share of the way that a node stays short of the line between its neighbours. Chosen: on
    the line the cell's corner would be flat."""
    corner_inset: float = 1e-3
    """1: distance of a node from its corner, as a share of the way to the node across the diagonal.
    Chosen: rays along y then hit the part."""
    ray_start_cells: float = 0.1
    """Cells: depth below the top, or height above the bottom, of the points that are tested for
    being inside the part. Chosen: above the rounding of a mesh, within the cell."""
    max_move_diagonals: float = 0.75
    """Diagonals of a cell's face: largest move of a node. Chosen: a larger one would turn the cell
    inside out."""


NOTCH = NotchSettings()


def fill_notches(field: NodeField, before: Array, rays: RayCaster) -> None:
    """Admit nodes outside a step of the surface, where a grid square has three members.

    Steps of the outline in a layer come first, then steps between layers.
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
    """Return mask[i + di, j + dj, k + dk], False outside."""
    padded = np.pad(mask, 1)
    window = tuple(slice(1 + d, 1 + d + n) for d, n in zip(step, mask.shape, strict=True))
    return padded[window]


@dataclass(frozen=True, eq=False)
class Notch:
    """Squares of the grid that lack one node.

    Args:
        axes: the plane of the squares.
        node: the nodes that are missing.
        first: their neighbours along the first axis.
        second: their neighbours along the second axis.
        across: the nodes across the diagonal.
    """

    axes: tuple[int, int]
    node: Nodes
    first: Nodes
    second: Nodes
    across: Nodes


def _fill(field: NodeField, notch: Notch, before: Array, rays: RayCaster) -> None:
    """Move missing nodes into the corner of the part, or onto the line between neighbours."""
    first, second, across = (field.points[n] for n in (notch.first, notch.second, notch.across))
    own, middle = before[notch.node], 0.5 * (first + second)
    flat = notch.axes == (0, 2)
    upper, lower = (
        e[notch.first] & e[notch.second] & flat for e in (field.upper_end, field.lower_end)
    )
    if flat:
        middle[:, 1] = np.where(upper | lower, middle[:, 1], own[:, 1])
    corner = middle.copy()
    corner[:, notch.axes[0]], corner[:, notch.axes[1]] = (
        second[:, notch.axes[0]],
        first[:, notch.axes[1]],
    )
    within = (
        np.where(upper, -NOTCH.ray_start_cells, np.where(lower, NOTCH.ray_start_cells, 0.0))
        * field.spacing[1]
    )
    corner = _towards(corner, across, NOTCH.corner_inset, 0.0)
    winding = rays.surface.winding
    is_corner = winding.inside(_towards(corner, across, 0.0, within))
    keep = is_corner | winding.inside(_towards(middle, across, 0.1, within))
    target = np.where(is_corner[:, None], corner, middle + NOTCH.corner_margin * (own - middle))
    if flat:
        probe = np.where(is_corner[:, None], corner, middle)
        field.points[..., 1][notch.node] = middle[:, 1]
        field.upper_end[notch.node], field.lower_end[notch.node] = upper, lower
        target[:, 1] = refired(field, notch.node, probe, rays)
    reach = NOTCH.max_move_diagonals * np.linalg.norm(field.spacing[list(notch.axes)])
    keep &= np.linalg.norm((target - own)[:, notch.axes], axis=1) <= reach
    _settle(field, notch, target, keep, flat)


def _towards(point: Array, other: Array, share: float, rise: Array | float) -> Array:
    """Return points moved sideways towards others by a share of the way, and up by `rise`."""
    result = point + share * (other - point)
    result[:, 1] = point[:, 1] + rise
    return result


def _settle(field: NodeField, notch: Notch, target: Array, keep: Mask, flat: bool) -> None:
    """Admit the nodes to keep.

    In a flat notch, a node between two nodes of the top belongs to the top itself. Otherwise the
    upper face of its cell would carry no contact, and the face's other nodes would carry too much.
    """
    dropped, chosen = (tuple(n[mask] for n in notch.node) for mask in (~keep, keep))
    field.upper_end[dropped] = field.lower_end[dropped] = False
    field.points[chosen] = target[keep]
    field.member[chosen] = True
    both = field.top[notch.first] & field.top[notch.second] & flat
    both &= ~field.has_top(notch.node)
    field.top[chosen] = both[keep]


STEPS = ((0, 1), (0, -1), (2, 1), (2, -1))
"""Axis and sign of the four ways sideways."""


@dataclass(frozen=True)
class WallSettings:
    """Nodes that are moved onto side walls."""

    wall_inset: float = 1e-6
    """Cells: distance that a node stays inside the wall it is moved to. Chosen: rays along y still
    hit."""
    ray_start_cells: float = 0.1
    """Cells: depth below the node's surface at which rays sideways begin. Chosen: above the
    rounding of a mesh, within the cell."""


WALL_NODE = WallSettings()


@dataclass(frozen=True, eq=False)
class WallHits:
    """Cells and walls beside the nodes of the grid in one of the four directions.

    Args:
        open: (nx, ny, nz) the node is a member without a cell on this side. At an end of an
            interval, the next node inside the interval must be one too.
        distance: (nx, ny, nz) m, distance to the wall; inf: there is none.
    """

    open: Mask
    distance: Array


def settle_walls(field: NodeField, surface: Surface) -> None:
    """Move nodes of `field` sideways onto the walls, and admit nodes outside (in place)."""
    rays = surface.rays
    before = field.points.copy()
    firing = _firing_points(field)
    hits = _walls_beside(field, firing, rays, surface)
    _move_out(field, firing, hits, rays)
    _pull_in(field, before, hits, rays)
    fill_notches(field, before, rays)


def _firing_points(field: NodeField) -> Array:
    """Return the nodes' points, those at the ends of intervals moved into the part."""
    result = field.points.copy()
    height = field.points[..., 1]
    for end, step in ((field.upper_end, -1), (field.lower_end, 1)):
        i, j, k = np.nonzero(end & ~(field.upper_end & field.lower_end))
        result[i, j, k, 1] += WALL_NODE.ray_start_cells * (height[i, j + step, k] - height[i, j, k])
    return result


def _filled_cells(field: NodeField, surface: Surface) -> Mask:
    """Say which cells have eight members and their centre in the part (before walls)."""
    m, y = field.member, field.points[..., 1]
    whole = np.ones(tuple(n - 1 for n in m.shape), bool)
    centre = np.zeros(whole.shape)
    for i, j, k in np.ndindex(2, 2, 2):
        corner = tuple(slice(o, o + n) for o, n in zip((i, j, k), whole.shape, strict=True))
        whole &= m[corner]
        centre += y[corner] / 8.0
    x, z = ((line[1:] + line[:-1]) / 2.0 for line in field.lines)
    intervals = inside_intervals(surface, 1, z, x)
    filled = np.zeros_like(whole)
    a, b = intervals.second, intervals.first
    rank = np.arange(len(a)) - np.searchsorted(b * len(x) + a, b * len(x) + a)
    for r in range(int(rank.max(initial=-1)) + 1):
        at = rank == r
        low, high = np.full((len(x), len(z)), np.inf), np.full((len(x), len(z)), -np.inf)
        low[a[at], b[at]], high[a[at], b[at]] = intervals.lower[at], intervals.upper[at]
        filled |= (centre > low[:, None]) & (centre < high[:, None])
    return whole & filled


def _walls_beside(
    field: NodeField, firing: Array, rays: RayCaster, surface: Surface
) -> list[WallHits]:
    """Return, for each of STEPS, which members have no cell that way and where the wall is."""
    cells = np.pad(_filled_cells(field, surface), 1)
    result = []
    for axis, sign in STEPS:
        beside = cells[1:] if sign > 0 else cells[:-1]
        if axis == 2:
            beside = cells[:, :, 1:] if sign > 0 else cells[:, :, :-1]
        other = 2 - axis
        joined = beside[:, 1:] | beside[:, :-1]
        joined = np.moveaxis(joined, other, 0)
        joined = np.moveaxis(joined[1:] | joined[:-1], 0, other)
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
    """Move members that have a wall within half a cell onto it."""
    move = np.zeros((*field.member.shape, 2))
    for column, axis in ((0, 0), (1, 2)):
        forth, back = (hit.distance for hit in hits[axis : axis + 2])
        tie = COLUMN.tie * field.spacing[axis]
        chosen = np.minimum(forth, back) <= 0.5 * field.spacing[axis] + tie
        forwards = forth <= back + tie
        way = np.where(forwards, forth, -back)
        move[..., column] = np.where(chosen & (np.abs(way) > tie), way, 0.0)
        _leave_far_side(hits[axis : axis + 2], chosen & ~forwards, chosen & forwards)
    nodes: Nodes = np.nonzero((move != 0.0).any(axis=-1))
    target = _corner_or_wall(firing[nodes], move[nodes], rays)
    height = refired_inwards(field, nodes, target, -move[nodes], rays)
    good = np.isfinite(height)
    nodes = tuple(index[good] for index in nodes)
    target[:, 1] = height
    field.points[nodes] = target[good]


def _leave_far_side(pair: list[WallHits], forth_left: Mask, back_left: Mask) -> None:
    """Drop the walls onto which nodes are moved.

    In a thin part, the wall on the other side remains for the node outside it.
    """
    pair[0].distance[back_left] = np.inf
    pair[1].distance[forth_left] = np.inf


def _corner_or_wall(start: Array, move: Array, rays: RayCaster) -> Array:
    """Return the new positions (n, 3) of nodes with walls at `move` (n, 2) along x and z; 0: none.

    With two walls, a node moves to their corner if this lies in the part. Otherwise it moves to the
    foot of its perpendicular on the line through the two hits.
    """
    move = move * (1.0 - WALL_NODE.wall_inset)
    corner = start.copy()
    corner[:, [0, 2]] += move
    both = np.flatnonzero((move != 0.0).all(axis=1))
    if both.size:
        tested = corner[both].copy()
        tested[:, [0, 2]] -= 1e-3 * move[both]
        cut = both[~rays.surface.winding.inside(tested)]
        u, w = move[cut].T
        foot = np.column_stack([u * w**2, w * u**2]) / (u**2 + w**2)[:, None]
        corner[cut[:, None], [0, 2]] = start[cut][:, [0, 2]] + foot
    return corner


def _pull_in(field: NodeField, before: Array, hits: list[WallHits], rays: RayCaster) -> None:
    """Admit nodes outside the part onto the wall between them and a member beside them."""
    move = np.zeros((*field.member.shape, 2))
    upper, lower, top = (np.ones(field.member.shape, bool) for _ in range(3))
    height = np.full(field.member.shape, np.nan)
    for (axis, sign), hit in zip(STEPS, hits, strict=True):
        spacing = field.spacing[axis]
        tie = COLUMN.tie * spacing
        near = hit.open & (hit.distance < spacing + tie)
        i, j, k = np.nonzero(near)
        to = [i, j, k]
        to[axis] = to[axis] + sign
        fits = (to[axis] >= 0) & (to[axis] < field.member.shape[axis])
        node: Nodes = (i[fits], j[fits], k[fits])
        goal: Nodes = (to[0][fits], to[1][fits], to[2][fits])
        outside = ~field.member[goal]
        node, goal = tuple(n[outside] for n in node), tuple(g[outside] for g in goal)
        column = 0 if axis == 0 else 1
        move[..., column][goal] = -sign * np.maximum(spacing - hit.distance[node], tie)
        upper[goal] &= field.upper_end[node]
        lower[goal] &= field.lower_end[node]
        top[goal] &= field.top[node]
        height[goal] = before[..., 1][node]
    pulled = np.nonzero((move != 0.0).any(axis=-1))
    _admit_at(field, pulled, before, move[pulled], (lower, upper, top), height, rays)


def _admit_at(
    field: NodeField,
    nodes: Nodes,
    before: Array,
    move: Array,
    ends: tuple[Mask, Mask, Mask],
    height: Array,
    rays: RayCaster,
) -> None:
    start = before[nodes]
    target = start.copy()
    target[:, [0, 2]] += _foot(move)
    field.lower_end[nodes], field.upper_end[nodes] = ends[0][nodes], ends[1][nodes]
    at_end = field.lower_end[nodes] | field.upper_end[nodes]
    field.points[..., 1][nodes] = np.where(at_end, height[nodes], start[:, 1])
    settled = refired_inwards(field, nodes, target, move, rays)
    good = np.isfinite(settled)
    bad = tuple(n[~good] for n in nodes)
    field.lower_end[bad] = field.upper_end[bad] = False
    nodes = tuple(n[good] for n in nodes)
    target[:, 1] = settled
    field.points[nodes] = target[good]
    field.member[nodes] = True
    field.top[nodes] = ends[2][nodes] & ~field.has_top(nodes)


def _foot(move: Array) -> Array:
    """Return the moves (n, 2) of nodes onto their only hit or between their two hits.

    With two hits, a node moves to the foot of its perpendicular on the line through them.
    """

    move = move * (1.0 + WALL_NODE.wall_inset)
    both = (move != 0.0).all(axis=1)
    result = move.copy()
    u, w = move[both].T
    result[both] = np.column_stack([u * w**2, w * u**2]) / (u**2 + w**2)[:, None]
    return result
