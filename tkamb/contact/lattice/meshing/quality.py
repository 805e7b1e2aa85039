"""Quality of a lattice: volume compared with the mesh, edges, corners, shear, and repairs."""

from dataclasses import dataclass

import numpy as np

from tkamb.contact.lattice.meshing.cells import EDGES, cell_volumes, scaled_jacobians
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.geometry.frames import Array
from tkamb.geometry.post import Post, find_post
from tkamb.geometry.surface import Surface
from tkamb.units import DEGREE, MILLIMETRE


@dataclass(frozen=True)
class LatticeQuality:
    """Measures of a lattice; lengths and volumes in SI, angles in rad.

    Args:
        nodes: number of nodes.
        cells: number of cells.
        springs: number of springs.
        volume: m³, of all cells.
        mesh_volume: m³, enclosed by the surface.
        edge_ratio: longest over shortest edge of a cell: median, 95th percentile, largest.
        shear: angle of a cell's upright edges to the normal of its layer: median, 95th
            percentile, largest.
        least_jacobian: least scaled Jacobian at a corner of a cell (1 for a box).
        notices: what was mended or left out, in plain words.
        post: a post whose contact with a cam is not modelled, if there is one.
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
        mesh_volume=insert.volume,
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
    """Return the angle (c,) between a cell's mean upright edge and its layer's normal, rad."""
    edges = points[:, EDGES[:, 1]] - points[:, EDGES[:, 0]]
    along_x, upright, along_z = (edges[:, 4 * a : 4 * a + 4].mean(axis=1) for a in range(3))
    # Shear is the angle between the upright edges and the normal of the cell's plan.
    normal = np.cross(along_z, along_x)
    cosine = np.einsum("ci,ci->c", normal, upright)
    cosine /= np.linalg.norm(normal, axis=1) * np.linalg.norm(upright, axis=1)
    return np.arccos(np.clip(cosine, -1.0, 1.0))
