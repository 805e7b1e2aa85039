"""Notches that steps of the grid leave under a surface, filled.

A grid that meets a surface at an angle follows it in steps, and each step leaves a wedge that
belongs to no cell. The node outside the wedge is drawn into the corner of the part, or, where
the surface runs straight on, almost onto the line between its two neighbours.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.contact.lattice.meshing.columns import NodeField, Nodes, refired
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.rays import RayCaster


@dataclass(frozen=True)
class NotchSettings:
    """Nodes that are moved into notches of the surface."""

    corner_margin: float = 0.1
    """1: share of the way that a node stays short of the line between its neighbours. Chosen: on
    the line the cell's corner would be flat."""
    corner_inset: float = 1e-3
    """1: share of the way inwards by which a node stays inside its corner. Chosen: rays along y
    hit."""
    ray_start_cells: float = 0.1
    """Cells below a node on the top, or above one underneath, at which rays ask what is inside.
    Chosen: above the rounding of a mesh, within the cell."""
    max_move_diagonals: float = 0.75
    """Diagonals of a cell's face: largest move of a node. Chosen: a larger one would turn the cell
    inside out."""


NOTCH = NotchSettings()


def fill_notches(field: NodeField, before: Array, rays: RayCaster) -> None:
    """Admit nodes outside a step of the surface: three corners of their square are members.

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
    """Draw missing nodes into the corner of the part, or onto the line between neighbours."""
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

    In a flat notch, a node between two nodes of the top is one of the top itself. Otherwise the
    upper face of its cell would carry no contact, and the face's other nodes too much.
    """
    dropped, chosen = (tuple(n[mask] for n in notch.node) for mask in (~keep, keep))
    field.upper_end[dropped] = field.lower_end[dropped] = False
    field.points[chosen] = target[keep]
    field.member[chosen] = True
    both = field.top[notch.first] & field.top[notch.second] & flat
    both &= ~field.has_top(notch.node)
    field.top[chosen] = both[keep]
