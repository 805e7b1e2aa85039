"""From a closed insert to a lattice: nodes, cells and the contact surface.

The steps follow Sharma (2008), section 4.1: a grid of nearly cubic cells over the bounding box;
rays along its lines; nodes moved onto the surface by at most half a cell; classes of nodes; cells.
Pieces that do not stand on the bottom, and very small ones at the rim, are omitted.
"""

import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label as label_regions
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tkamb.contact.lattice.meshing.cells import (
    CORNERS,
    FACES,
    Springs,
    cell_volumes,
    join_springs,
    scaled_jacobians,
    shortest_edges,
)
from tkamb.contact.lattice.meshing.columns import NodeField, place_columns
from tkamb.contact.lattice.meshing.walls import move_to_walls
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.height_field import inside_intervals
from tkamb.geometry.post import find_post
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

# 1: smallest number of cells of a piece, relative to the largest piece. Smaller pieces are
# omitted. They are fragments of the rim.
LEAST_PIECE_SHARE = 0.01
# m: distance of the lines that measure the volume of overlapping bodies. The error
# of the volume is then below 0.1 %.
LINE_SPACING = 2.5e-4


LOWER_FACE = 2
"""Row of `FACES` with a cell's lower corners."""
OUTER_SKIN_TURNED = (0, 3, 4)
"""Rows of `FACES` with corners in clockwise order, seen from outside."""


def connected_pieces(cells: Index) -> Index:
    """Return the piece (c,) of each cell (c, 8); whole faces join its cells."""
    face, joined = _sorted_faces(cells)
    a, b = face[:-1][joined] // len(FACES), face[1:][joined] // len(FACES)
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(len(cells), len(cells)))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def standing_pieces(cells: Index, bottom: Mask) -> Mask:
    """Return whether cells (c,) are in large pieces that stand on the bottom.

    Any other piece has no fixed node and a singular stiffness. If no piece stands on the nodes
    `bottom` (n,), the largest one is kept.
    """
    if not len(cells):
        return np.ones(0, bool)
    piece = connected_pieces(cells)
    size = np.bincount(piece)
    standing = np.zeros(len(size), bool)
    standing[piece[bottom[cells[:, FACES[LOWER_FACE]]].all(axis=1)]] = True
    if not standing.any():
        standing[size.argmax()] = True
    largest = size[standing].max()
    return (standing & (size >= LEAST_PIECE_SHARE * largest))[piece]


@dataclass(frozen=True)
class MissingPart:
    """The largest part of a mesh that its lattice lacks: m³, m, insert frame."""

    volume: float
    extents: tuple[float, ...]
    centre: tuple[float, ...]

    def __str__(self) -> str:
        size = " x ".join(f"{value / MILLIMETRE:.3g}" for value in self.extents)
        where = ", ".join(f"{value / MILLIMETRE:.1f}" for value in self.centre)
        return f"a part of {size} mm at ({where}) mm of the insert frame"


def missing_part(nodes: Array, cells: Index, spacing: Array, insert: Surface) -> MissingPart | None:
    """Return the largest connected part of the mesh outside of all cells; None if there is none.

    The search grid has half the lattice's `spacing` (3,), m.
    """
    step = spacing / 2.0
    lines = [
        np.arange(low + each / 2.0, high, each)
        for low, high, each in zip(*insert.bounds, step, strict=True)
    ]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    flat = points.reshape(-1, 3)
    missing = insert.winding.inside(flat) & ~outer_skin(nodes, cells).winding.inside(flat)
    regions, count = label_regions(missing.reshape(points.shape[:3]))
    if not count:
        return None
    largest = regions == 1 + int(np.bincount(regions.ravel())[1:].argmax())
    part_points = points[largest]
    low, high = part_points.min(axis=0) - step / 2.0, part_points.max(axis=0) + step / 2.0
    return MissingPart(
        float(largest.sum() * step.prod()), tuple(high - low), tuple((low + high) / 2.0)
    )


def outer_skin(nodes: Array, cells: Index) -> Surface:
    """Return the closed outer surface of the cells, two triangles per face."""
    rings = cells[:, FACES].copy()
    rings[:, OUTER_SKIN_TURNED] = rings[:, OUTER_SKIN_TURNED, ::-1]
    face, joined = _sorted_faces(cells)
    outer = np.append(True, ~joined) & np.append(~joined, True)
    quads = rings.reshape(-1, 4)[face[outer]]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Surface(nodes, triangles, "lattice", merged=True)


def solid_volume(insert: Surface, centres: Array) -> float:
    """Return the volume of the mesh's bodies, m³; overlaps count once.

    `centres` (c, 3), m, are points throughout the bodies, a few per cubic millimetre.
    """
    if not (insert.winding.at(centres) > 1).any():
        return insert.volume
    low, high = insert.bounds
    lines = [np.arange(low[a] + LINE_SPACING / 2, high[a], LINE_SPACING) for a in (2, 0)]
    intervals = inside_intervals(insert, 1, *lines)
    return float((intervals.upper - intervals.lower).sum() * LINE_SPACING**2)


def volume_error(nodes: Array, cells: Index, insert: Surface) -> float:
    """Return the relative error of the cells' volume."""
    corners = nodes[cells]
    return float(cell_volumes(corners).sum() / solid_volume(insert, corners.mean(axis=1)) - 1.0)


def _sorted_faces(cells: Index) -> tuple[Index, Mask]:
    """Return the faces of all cells, with the two copies of an inner face next to each other.

    The smallest and the largest node identify a face of a grid. Each is 6 cell + row of `FACES`,
    (6c,); also returns whether it is the same face as the next one, (6c - 1,).
    """
    ends = np.sort(cells[:, FACES].reshape(-1, 4), axis=1)[:, [0, 3]]
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends = ends[order]
    return order, (ends[1:] == ends[:-1]).all(axis=1)


_log = logging.getLogger("tkamb")


INTERNAL, CONTACT, BOTTOM, OTHER = 0, 1, 2, 3
"""Node classes: inside, top surface, flat bottom, other surfaces (walls, underside)."""


# 1: longest over shortest edge of a grid cell. Flatter hexahedra are too stiff in
# bending.
MAX_EDGE_RATIO = 1.4
# m: nodes this near to the plane of the flat bottom lie in it. Flat bottoms of
# meshes vary by as much.
BOTTOM_TOLERANCE = 5e-5
# Largest number of cells of a grid over the bounding box. A knee has as many at
# 0.35 mm, which take more than 50 GB.
MAX_CELLS = 1_000_000
# 1: a cell with a smaller scaled Jacobian is omitted. Its stiffness would be ill-
# conditioned.
LEAST_JACOBIAN = 0.05
# 1: a cell with a shorter edge, relative to the smallest spacing, is omitted. Its
# stiffness would be ill-conditioned.
LEAST_EDGE = 0.2


@dataclass(frozen=True, eq=False)
class Lattice:
    """Nodes and cells of an insert, insert frame, SI.

    Args:
        nodes: m, (n, 3).
        index: index (i, j, k) of each node in the structured grid, (n, 3).
        node_class: INTERNAL, CONTACT, BOTTOM or OTHER, (n,).
        spacing: spacing of the undistorted grid, m, (3,).
        origin: position of the grid's node (0, 0, 0), m, (3,).
        cells: nodes of the cells in the order of VTK's hexahedron, (c, 8).
        contact_triangles: nodes of outward triangles over the contact nodes, (k, 3).
        dropped_nodes: number of omitted nodes, which belong to no cell. The omitted cells
            (`dropped_cells`) are inverted, across a gap, or in a loose piece.
        mended_rays: number of vertical lines with crossings corrected from their neighbours.
        closed_gaps: number of filled gaps, narrower than a cell.
        thin_intervals: number of intervals thinner than half a cell, with one node.
    """

    nodes: Array
    index: Index
    node_class: NDArray[np.int8]
    spacing: Array
    origin: Array
    cells: Index
    contact_triangles: Index
    dropped_nodes: int
    dropped_cells: int
    mended_rays: int
    closed_gaps: int
    thin_intervals: int
    size_notices: tuple[str, ...] = ()

    @property
    def notices(self) -> tuple[str, ...]:
        """Notices of corrections and omissions, in words."""
        counts = (
            (self.mended_rays, "{} rays with an odd number of crossings mended from neighbours"),
            (self.closed_gaps, "{} gaps narrower than a cell filled"),
            (self.thin_intervals, "{} intervals thinner than half a cell held by one node"),
            (self.dropped_cells, "{} cells left out: flat, inverted, across a gap, or loose"),
            (self.dropped_nodes, "{} nodes left out: in no cell"),
        )
        counted = (phrase.format(count) for count, phrase in counts if count)
        return (*self.size_notices, *counted)

    @cached_property
    def springs(self) -> Springs:
        """Springs between the nodes of each cell, each spring once."""
        return join_springs(self.cells, len(self.nodes))

    @cached_property
    def piece_of_node(self) -> Index:
        """Number (n,) of each node's piece; two pieces share no cell face."""
        piece = np.zeros(len(self.nodes), np.int64)
        piece[self.cells] = connected_pieces(self.cells)[:, None]
        return piece

    @property
    def contact_nodes(self) -> Index:
        """Numbers of the contact nodes."""
        return np.flatnonzero(self.node_class == CONTACT)

    @property
    def bottom_nodes(self) -> Index:
        """Numbers of the nodes in the flat bottom."""
        return np.flatnonzero(self.node_class == BOTTOM)


def build_grid(insert: Surface, target_size: float) -> Lattice:
    """Return the lattice of a closed insert without a check of its volume; see `whole_lattice`.

    The logger "tkamb" logs corrected rays, and a post (cam-post contact is not modelled).

    `target_size` is the desired edge of a cell, m; the flat bottom of the insert is y = 0.

    Raises:
        InputError: the surface has too large holes, no cell fits into it, or there would be more
            than `MAX_CELLS` cells.
    """
    lattice = make_grid(insert, target_size)
    log_corrections(lattice, insert)
    return lattice


def log_corrections(lattice: Lattice, insert: Surface) -> None:
    """Log corrected rays and a post."""
    if lattice.mended_rays:
        _log.warning(
            "%s: %d rays through gaps in the mesh mended", insert.name, lattice.mended_rays
        )
    post = find_post(insert)
    if post is not None:
        _log.warning("%s: %s", insert.name, post.notice)


def make_grid(insert: Surface, target_size: float) -> Lattice:
    """Return the lattice of `build_grid` without logging."""
    extent = insert.bounds[1] - insert.bounds[0]
    spacing = grid_spacing(extent, target_size)
    # This check comes before any array, because a mesh in millimetres would have 1e9 times as many
    # cells.
    count = float((extent / spacing).prod())
    if count > MAX_CELLS:
        raise InputError(
            f"{count:.2g} cells of {target_size / MILLIMETRE:g} mm are too many",
            insert.name,
            f"give a larger resolution (at most {MAX_CELLS:.0e} cells), and check the unit "
            "of the mesh",
        )
    field = place_columns(insert, spacing)
    move_to_walls(field, insert)
    cells, dropped_cells = _sound_cells(field, insert)
    if not len(cells):
        raise InputError(
            f"no cell of {target_size / MILLIMETRE:g} mm fits into the part",
            insert.name,
            "use smaller cells",
        )
    return _assemble(field, cells, dropped_cells)


def grid_spacing(extent: Array, target_size: float) -> Array:
    """Return the edges (3,), m, of cells that divide a box (3,) evenly.

    They are near the target size, but with a ratio of at most `MAX_EDGE_RATIO`.
    """
    if target_size <= 0.0:
        raise InputError(
            f"the cell size is {target_size / MILLIMETRE:g} mm", hint="give a positive size"
        )
    # Smaller and larger sizes are tried until the cells are nearly cubic.
    for percent in range(400):
        for size in (target_size / 1.01**percent, target_size * 1.01**percent):
            spacing = extent / np.maximum(np.round(extent / size), 1.0)
            if spacing.max() / spacing.min() <= MAX_EDGE_RATIO:
                return spacing
    raise InputError(
        f"a box of {np.round(extent / MILLIMETRE, 3)} mm cannot be divided into near-cubic cells"
    )


def _sound_cells(field: NodeField, insert: Surface) -> tuple[Index, int]:
    shape = field.member.shape
    corner = np.argwhere(_all_corners(field.member))
    grid = corner[:, None, :] + CORNERS
    cells = np.ravel_multi_index(tuple(np.moveaxis(grid, -1, 0)), shape)
    total = len(cells)
    cells = cells[~_bridges_gap(field, cells)]
    points = field.points.reshape(-1, 3)
    cells = cells[scaled_jacobians(points[cells]) > LEAST_JACOBIAN]
    cells = cells[shortest_edges(points[cells]) > LEAST_EDGE * field.spacing.min()]
    cells = cells[insert.winding.inside(points[cells].mean(axis=1))]
    cells = cells[standing_pieces(cells, _on_bottom(field))]
    return cells, total - len(cells)


def _all_corners(member: Mask) -> Mask:
    whole = member[:-1] & member[1:]
    whole = whole[:, :-1] & whole[:, 1:]
    return whole[:, :, :-1] & whole[:, :, 1:]


def _bridges_gap(field: NodeField, cells: Index) -> Mask:
    """Return cells with a vertical edge between different intervals of a line."""
    number = field.interval.ravel()[cells]
    low, high = number[:, [0, 1, 4, 5]], number[:, [3, 2, 7, 6]]
    return ((low >= 0) & (high >= 0) & (low != high)).any(axis=1)


def _assemble(field: NodeField, cells: Index, dropped_cells: int) -> Lattice:
    shape = field.member.shape
    used = np.zeros(field.member.size, bool)
    used[cells] = True
    number = np.cumsum(used) - 1
    flat = np.flatnonzero(used)
    node_class = _classes(field, cells)[flat]
    index = np.column_stack(np.unravel_index(flat, shape))
    return Lattice(
        nodes=field.points.reshape(-1, 3)[flat],
        index=index,
        node_class=node_class,
        spacing=field.spacing,
        origin=np.array([field.lines[0][0], 0.0, field.lines[1][0]]),
        cells=number[cells],
        contact_triangles=_contact_triangles(index, node_class, shape),
        dropped_nodes=int(field.member.sum() - len(flat)),
        dropped_cells=dropped_cells,
        mended_rays=field.mended,
        closed_gaps=field.closed_gaps,
        thin_intervals=field.thin,
    )


def _classes(field: NodeField, cells: Index) -> NDArray[np.int8]:
    """Return the class of every node; inner nodes belong to 8 cells."""
    on_surface = np.bincount(cells.ravel(), minlength=field.member.size) < 8
    result = np.where(on_surface, OTHER, INTERNAL).astype(np.int8)
    result[field.top.ravel()] = CONTACT
    result[_on_bottom(field)] = BOTTOM
    return result


def _on_bottom(field: NodeField) -> Mask:
    height = field.points[..., 1].ravel()
    flat = np.abs(height) <= max(BOTTOM_TOLERANCE, 0.02 * field.spacing[1])
    return field.lower_end.ravel() & flat


def _contact_triangles(index: Index, node_class: NDArray[np.int8], shape: tuple) -> Index:
    """Return outward triangles over contact columns at most one layer apart."""
    number = np.full((shape[0], shape[2]), -1)
    height = np.zeros((shape[0], shape[2]), np.int64)
    contact = np.flatnonzero(node_class == CONTACT)
    number[index[contact, 0], index[contact, 2]] = contact
    height[index[contact, 0], index[contact, 2]] = index[contact, 1]
    corner = np.argwhere(_all_corners(number[:, None, :].repeat(2, axis=1) >= 0)[:, 0])
    i, k = corner.T
    square = np.stack([number[i, k], number[i, k + 1], number[i + 1, k + 1], number[i + 1, k]])
    levels = np.stack([height[i, k], height[i, k + 1], height[i + 1, k + 1], height[i + 1, k]])
    square = square[:, np.ptp(levels, axis=0) <= 1].T
    return np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]])
