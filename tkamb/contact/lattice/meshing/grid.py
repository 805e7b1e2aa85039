"""From any closed insert to a lattice: nodes, cells, springs and the contact surface.

After Sharma (2008), section 4.1: a grid over the bounding box, as cubic as the box permits;
rays along its lines; nodes moved onto the surface by at most half a cell; classes; connectivity.
Pieces that stand on nothing, and crumbs of the rim, are left out.
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
from tkamb.contact.lattice.meshing.columns import NodeField, settle_columns
from tkamb.contact.lattice.meshing.walls import settle_walls
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.height_field import inside_intervals
from tkamb.geometry.post import find_post
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE


@dataclass(frozen=True)
class PieceSettings:
    """Separate pieces of a lattice."""

    least_piece_share: float = 0.01
    """1: a piece with a smaller share of the largest piece's cells is a crumb of the rim, and left
    out. Chosen: a body of an insert is larger."""
    line_spacing: float = 2.5e-4
    """m: distance of the lines that measure the volume of overlapping bodies. Chosen: the volume is
    then within 0.1 %."""


PIECE = PieceSettings()

LOWER_FACE = 2
"""Row of `FACES` that holds a cell's lower corners."""
OUTER_SKIN_TURNED = (0, 3, 4)
"""Rows of `FACES` whose corners run clockwise as seen from outside."""


def connected_pieces(cells: Index) -> Index:
    """Return the piece (c,) of each cell (c, 8); the cells of a piece share whole faces."""
    face, joined = _sorted_faces(cells)
    a, b = face[:-1][joined] // len(FACES), face[1:][joined] // len(FACES)
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(len(cells), len(cells)))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def standing_pieces(cells: Index, bottom: Mask) -> Mask:
    """Say which cells (c, 8) belong to a piece that stands on the bottom and is no crumb.

    A piece that stands on nothing has no fixed node, so that no load could be carried by it.

    Args:
        cells: (c, 8) nodes.
        bottom: (n,) whether a node lies in the flat bottom.
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
    return (standing & (size >= PIECE.least_piece_share * largest))[piece]


@dataclass(frozen=True)
class MissingPart:
    """The largest part of a mesh that its lattice does not hold, insert frame.

    Args:
        volume: m³.
        extents: (3,) m, along x, y and z.
        centre: (3,) m, of its bounding box.
    """

    volume: float
    extents: tuple[float, ...]
    centre: tuple[float, ...]

    def __str__(self) -> str:
        """Return its size and place in words."""
        size = " x ".join(f"{value / MILLIMETRE:.3g}" for value in self.extents)
        where = ", ".join(f"{value / MILLIMETRE:.1f}" for value in self.centre)
        return f"a part of {size} mm at ({where}) mm of the insert frame"


def missing_part(nodes: Array, cells: Index, spacing: Array, insert: Surface) -> MissingPart | None:
    """Return the largest connected part of the mesh that no cell holds; None if there is none.

    It is sought on a grid of points, two to a cell along each axis.

    Args:
        nodes: (n, 3) m.
        cells: (c, 8).
        spacing: (3,) m.
        insert: the mesh, closed, insert frame.
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
    """Return the closed skin of the cells, two triangles to a face, outward."""
    rings = cells[:, FACES].copy()
    rings[:, OUTER_SKIN_TURNED] = rings[:, OUTER_SKIN_TURNED, ::-1]
    face, joined = _sorted_faces(cells)
    outer = np.append(True, ~joined) & np.append(~joined, True)
    quads = rings.reshape(-1, 4)[face[outer]]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Surface(nodes, triangles, "lattice", merged=True)


def solid_volume(insert: Surface, centres: Array) -> float:
    """Return the volume (m³) that the mesh's bodies fill; where two overlap, it counts once.

    Args:
        insert: closed.
        centres: (c, 3) m, points within it, a few to a cubic millimetre.
    """
    if not (insert.winding.at(centres) > 1).any():
        return insert.volume
    low, high = insert.bounds
    lines = [
        np.arange(low[a] + PIECE.line_spacing / 2, high[a], PIECE.line_spacing) for a in (2, 0)
    ]
    intervals = inside_intervals(insert, 1, *lines)
    return float((intervals.upper - intervals.lower).sum() * PIECE.line_spacing**2)


def volume_error(nodes: Array, cells: Index, insert: Surface) -> float:
    """Return by how much the cells' volume differs from the mesh's, as a share of it."""
    corners = nodes[cells]
    return float(cell_volumes(corners).sum() / solid_volume(insert, corners.mean(axis=1)) - 1.0)


def _sorted_faces(cells: Index) -> tuple[Index, Mask]:
    """Return the cells' faces (6c,), 6 cell + row of `FACES`, equal ones one after the other.

    Also which (6c - 1,) are the same face as the next one. The smallest and the largest of its
    nodes name a face of a grid.
    """
    ends = np.sort(cells[:, FACES].reshape(-1, 4), axis=1)[:, [0, 3]]
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends = ends[order]
    return order, (ends[1:] == ends[:-1]).all(axis=1)


_log = logging.getLogger("tkamb")


INTERNAL, CONTACT, BOTTOM, OTHER = 0, 1, 2, 3
"""Node classes: inside, top surface, flat bottom, any other surface (walls, underside)."""


@dataclass(frozen=True)
class GridSettings:
    """The regular grid of a lattice."""

    max_edge_ratio: float = 1.4
    """1: longest over shortest edge of a grid cell. Chosen: flatter hexahedra are too stiff in
    bending."""
    bottom_tolerance: float = 5e-5
    """m: nodes this near the plane of the flat bottom lie in it. Chosen: what meshes of flat
    bottoms vary by."""
    max_cells: int = 1_000_000
    """Cells of a grid over the bounding box. Chosen: a knee's at 0.35 mm, which takes more than
    fifty gigabytes."""
    least_jacobian: float = 0.05
    """1: a surface cell with a smaller scaled Jacobian is left out. Chosen: its stiffness would be
    ill-conditioned."""
    least_edge: float = 0.2
    """Share of the spacing, 1: a surface cell with a shorter edge is left out. Chosen: its
    stiffness would be ill-conditioned."""


GRID = GridSettings()


@dataclass(frozen=True, eq=False)
class Lattice:
    """Nodes and cells of an insert, insert frame, SI.

    Args:
        nodes: (n, 3) m.
        index: (n, 3) index (i, j, k) in the structured grid.
        node_class: (n,) INTERNAL, CONTACT, BOTTOM or OTHER.
        spacing: (3,) m, of the undistorted grid.
        origin: (3,) m, of the grid's node (0, 0, 0).
        cells: (c, 8) nodes in the order of VTK's hexahedron.
        contact_triangles: (k, 3) nodes, outward, over the contact nodes.
        dropped_nodes: members of the part that belong to no cell, left out.
        dropped_cells: cells left out (inverted, bridging a gap, or loose).
        mended_rays: (3,) lines along x, y, z mended from their neighbours.
        closed_gaps: gaps narrower than a cell, filled.
        thin_intervals: parts thinner than half a cell, left out or held by one node.
        size_notices: notices about the cells' size, in words.
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
        """What was mended, filled or left out, in plain words; empty when nothing was."""
        counts = (
            (self.mended_rays, "{} rays with an odd number of crossings mended from neighbours"),
            (self.closed_gaps, "{} gaps narrower than a cell filled"),
            (self.thin_intervals, "{} intervals thinner than half a cell held by one node"),
            (self.dropped_cells, "{} cells left out: flat, inverted, across a gap, or loose"),
            (self.dropped_nodes, "{} nodes left out that no cell holds"),
        )
        counted = (phrase.format(count) for count, phrase in counts if count)
        return (*self.size_notices, *counted)

    @cached_property
    def springs(self) -> Springs:
        """Springs that join each cell's nodes, each once."""
        return join_springs(self.cells, len(self.nodes))

    @cached_property
    def piece_of_node(self) -> Index:
        """Piece (n,) of each node; two pieces share no cell face."""
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
    """Return the lattice of a closed insert, whatever its volume; see `whole_lattice`.

    Mended rays and a post (cam-post contact is not modelled) are logged, by the logger "tkamb".

    Args:
        insert: closed surface in the insert frame (flat bottom in y = 0 facing -y).
        target_size: wanted edge of a cell, m.

    Raises:
        InputError: the surface is open beyond mending, thinner than the cells, or they are
            more than `GRID.max_cells`.
    """
    lattice = make_grid(insert, target_size)
    tell_repairs(lattice, insert)
    return lattice


def tell_repairs(lattice: Lattice, insert: Surface) -> None:
    """Log mended rays and a post."""
    if lattice.mended_rays:
        _log.warning(
            "%s: %d rays through gaps in the mesh mended", insert.name, lattice.mended_rays
        )
    post = find_post(insert)
    if post is not None:
        _log.warning("%s: %s", insert.name, post.notice)


def make_grid(insert: Surface, target_size: float) -> Lattice:
    """Return what `build_grid` does, and log nothing."""
    extent = insert.bounds[1] - insert.bounds[0]
    spacing = grid_spacing(extent, target_size)
    # Checked before any array is made: a mesh in millimetres would ask for 1e9 times as many cells.
    count = float((extent / spacing).prod())
    if count > GRID.max_cells:
        raise InputError(
            f"cells of {target_size / MILLIMETRE:g} mm make {count:.2g} of them",
            insert.name,
            f"take larger ones ({GRID.max_cells:.0e} at most), and check the mesh's unit",
        )
    field = settle_columns(insert, spacing)
    settle_walls(field, insert)
    cells, dropped_cells = _sound_cells(field, insert)
    if not len(cells):
        raise InputError(
            f"no cell of {target_size / MILLIMETRE:g} mm fits into the part",
            insert.name,
            "use smaller cells",
        )
    return _assemble(field, cells, dropped_cells)


def grid_spacing(extent: Array, target_size: float) -> Array:
    """Return the edges (3,) of the grid cells that divide a box (3,) evenly, m.

    The target is kept unless the box is so thin that the edge ratio would pass 1.4; then the
    nearest size (by ratio) that keeps it is taken.
    """
    if target_size <= 0.0:
        raise InputError(
            f"a cell size of {target_size / MILLIMETRE:g} mm", hint="give a positive size"
        )
    # Sizes are tried outwards from the target until all three spacings fit near-cubic cells.
    for percent in range(400):
        for size in (target_size / 1.01**percent, target_size * 1.01**percent):
            spacing = extent / np.maximum(np.round(extent / size), 1.0)
            if spacing.max() / spacing.min() <= GRID.max_edge_ratio:
                return spacing
    raise InputError(
        f"a box of {np.round(extent / MILLIMETRE, 3)} mm cannot be divided into near-cubic cells"
    )


def _sound_cells(field: NodeField, insert: Surface) -> tuple[Index, int]:
    """Return the cells (c, 8) by flat grid number that fill the part, and how many were left."""
    shape = field.member.shape
    corner = np.argwhere(_all_corners(field.member))
    grid = corner[:, None, :] + CORNERS
    cells = np.ravel_multi_index(tuple(np.moveaxis(grid, -1, 0)), shape)
    total = len(cells)
    cells = cells[~_bridges_gap(field, cells)]
    points = field.points.reshape(-1, 3)
    cells = cells[scaled_jacobians(points[cells]) > GRID.least_jacobian]
    cells = cells[shortest_edges(points[cells]) > GRID.least_edge * field.spacing.min()]
    cells = cells[insert.winding.inside(points[cells].mean(axis=1))]
    cells = cells[standing_pieces(cells, _on_bottom(field))]
    return cells, total - len(cells)


def _all_corners(member: Mask) -> Mask:
    whole = member[:-1] & member[1:]
    whole = whole[:, :-1] & whole[:, 1:]
    return whole[:, :, :-1] & whole[:, :, 1:]


def _bridges_gap(field: NodeField, cells: Index) -> Mask:
    """Say which cells have an upright edge whose ends lie in different intervals of a line."""
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
    """Return the class of every grid node (flat); a node in fewer than 8 cells is outside."""
    outside = np.bincount(cells.ravel(), minlength=field.member.size) < 8
    result = np.where(outside, OTHER, INTERNAL).astype(np.int8)
    result[field.top.ravel()] = CONTACT
    result[_on_bottom(field)] = BOTTOM
    return result


def _on_bottom(field: NodeField) -> Mask:
    """Say which grid nodes (flat) lie in the flat bottom."""
    height = field.points[..., 1].ravel()
    flat = np.abs(height) <= max(GRID.bottom_tolerance, 0.02 * field.spacing[1])
    return field.lower_end.ravel() & flat


def _contact_triangles(index: Index, node_class: NDArray[np.int8], shape: tuple) -> Index:
    """Return outward triangles over squares of four contact columns without a cliff."""
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
