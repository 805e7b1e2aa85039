"""The pieces of a lattice: which are kept, and what a lattice lacks of its mesh."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label as label_regions
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tkamb.contact.lattice.meshing.cells import FACES, cell_volumes
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.height_field import inside_intervals
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
