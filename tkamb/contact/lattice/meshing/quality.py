"""The quality of a lattice: volume, edges, corners, shear and corrections.

A lattice can lose features thinner than a cell, and parts of a faulty mesh, which a contact does
not show. `whole_lattice` rejects a volume that differs by more than 2 %.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.meshing.cells import EDGES, cell_volumes, scaled_jacobians
from tkamb.contact.lattice.meshing.grid import (
    Lattice,
    log_corrections,
    make_grid,
    missing_part,
    solid_volume,
    volume_error,
)
from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.post import Post, find_post
from tkamb.geometry.surface import Surface
from tkamb.units import DEGREE, MILLIMETRE

_log = logging.getLogger("tkamb")


# 1: largest difference. Stiffness and pressure of an insert of 8 mm change by about
# as much.
TOLERANCE = 0.02
# 1: cell sizes that are tried in turn, relative to the desired size. The last one
# gives twice as many cells.
SIZES = (1.0, 0.95, 0.9, 0.85, 0.8)
# 1: after a larger difference no smaller cells are tried. A whole part is then
# missing, not a thin rim.
BEYOND_REFINEMENT = 0.1


def whole_lattice(insert: Surface, target_size: float) -> Lattice:
    """Return the lattice of a closed insert, with the volume of the mesh within 2 %.

    If the desired size changes it by more, somewhat smaller cells are used, with a notice: the loss
    at thin rims varies with the size. The logger "tkamb" logs smaller cells, corrected rays, and a
    post.

    Arguments as in `build_grid`.

    Raises:
        InputError: see `build_grid`; or no size keeps the volume, and the message names the
            largest missing part.
    """
    first: tuple[Lattice, float] | None = None
    for share in SIZES:
        lattice = make_grid(insert, share * target_size)
        error = volume_error(lattice.nodes, lattice.cells, insert)
        first = first or (lattice, error)
        if abs(error) <= TOLERANCE:
            if share < 1.0:
                words = _smaller_cells(target_size, share, first[1])
                _log.warning("%s: %s", insert.name, words)
                lattice = replace(lattice, size_notices=(words,))
            log_corrections(lattice, insert)
            return lattice
        if abs(first[1]) > BEYOND_REFINEMENT:
            break
    assert first is not None
    raise _volume_refusal(*first, insert, target_size)


def _smaller_cells(target_size: float, share: float, error: float) -> str:
    size = target_size / MILLIMETRE
    return (
        f"cells of {share * size:.3g} mm are used instead of {size:.3g} mm, because those would "
        f"change the volume of the part by {100 * error:+.1f} %"
    )


def _volume_refusal(
    lattice: Lattice, error: float, insert: Surface, target_size: float
) -> InputError:
    part = missing_part(lattice.nodes, lattice.cells, lattice.spacing, insert)
    lacks = f"; it lacks {part}" if error < 0 and part is not None else ""
    return InputError(
        f"the lattice of {target_size / MILLIMETRE:.3g} mm cells has {100 * abs(error):.1f} % "
        f"{'less' if error < 0 else 'more'} volume than the mesh, more than the "
        f"{100 * TOLERANCE:g} % that are allowed{lacks}",
        insert.name,
        "take smaller cells; a lattice cannot have a part that does not stand on the bottom, or is "
        "thinner than a cell",
    )


@dataclass(frozen=True)
class LatticeQuality:
    """Measures of a lattice, SI.

    Args:
        edge_ratio: longest over shortest edge of a cell: median, 95th percentile, largest.
        shear: angle between a cell's upright edges and the normal of its layer, rad: median, 95th
            percentile, largest.
        least_jacobian: least scaled Jacobian at a corner of a cell (1 for a box).
    """

    nodes: int
    cells: int
    springs: int
    volume: float
    mesh_volume: float
    edge_ratio: tuple[float, float, float]
    shear: tuple[float, float, float]
    least_jacobian: float
    notices: tuple[str, ...]
    post: Post | None

    @property
    def volume_error(self) -> float:
        """Relative error of the lattice's volume."""
        return self.volume / self.mesh_volume - 1.0

    def lines(self) -> list[str]:
        """Return the measures as lines of text, in mm, mm³ and deg."""
        shear = " ".join(f"{angle / DEGREE:.1f}" for angle in self.shear)
        ratio = " ".join(f"{value:.2f}" for value in self.edge_ratio)
        return [
            f"{self.nodes} nodes, {self.cells} cells, {self.springs} springs",
            f"volume {self.volume / MILLIMETRE**3:.0f} mm³, "
            f"mesh {self.mesh_volume / MILLIMETRE**3:.0f} mm³ ({100 * self.volume_error:+.2f} %)",
            f"edge ratio {ratio} (median, 95th percentile, largest)",
            f"shear {shear} deg (median, 95th percentile, largest)",
            f"least scaled Jacobian {self.least_jacobian:.2f}",
            *self.notices,
        ]


def measure_quality(lattice: Lattice, insert: Surface) -> LatticeQuality:
    """Return the measures of the lattice of an insert (insert frame)."""
    points = lattice.nodes[lattice.cells]
    post = find_post(insert)
    return LatticeQuality(
        nodes=len(lattice.nodes),
        cells=len(lattice.cells),
        springs=len(lattice.springs.ends),
        volume=float(cell_volumes(points).sum()),
        mesh_volume=solid_volume(insert, points.mean(axis=1)),
        edge_ratio=_spread(_edge_ratios(points)),
        shear=_spread(_shear(points)),
        least_jacobian=float(scaled_jacobians(points).min()),
        notices=(*lattice.notices, *(() if post is None else (post.notice,))),
        post=post,
    )


def _spread(values: Array) -> tuple[float, float, float]:
    median, high, largest = np.percentile(values, [50, 95, 100])
    return float(median), float(high), float(largest)


def _edge_ratios(points: Array) -> Array:
    lengths = np.linalg.norm(points[:, EDGES[:, 1]] - points[:, EDGES[:, 0]], axis=2)
    return lengths.max(axis=1) / lengths.min(axis=1)


def _shear(points: Array) -> Array:
    """Return (c,), rad, between a mean upright edge and its layer's normal."""
    edges = points[:, EDGES[:, 1]] - points[:, EDGES[:, 0]]
    along_x, upright, along_z = (edges[:, 4 * a : 4 * a + 4].mean(axis=1) for a in range(3))
    normal = np.cross(along_z, along_x)
    cosine = np.einsum("ci,ci->c", normal, upright)
    cosine /= np.linalg.norm(normal, axis=1) * np.linalg.norm(upright, axis=1)
    return np.arccos(np.clip(cosine, -1.0, 1.0))
