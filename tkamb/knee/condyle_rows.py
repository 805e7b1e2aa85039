"""The normal forces of the condyles as functions of the muscle forces, by frontal equilibrium.

Contact, ligaments, muscles, patellar ligament and the load from outside balance on the shank. Let
W be the wrench of all loads but contact, about a point at the height of the contact. With the
condyles' contact points at z_m and z_l, superior-inferior force and frontal moment give

    N_m + N_l = W_y,    z_m N_m + z_l N_l = -W_x,   W_x: moment about AP.

W is affine in the forces of the muscles, and so are N_m and N_l. A static optimisation that knows
only the flexion moment lets a condyle lift off as soon as the load from outside allows it. Measured
knees do not: the medial condyle carries 60 to 80 % of the load in walking (PMC2965044, with
references). With a least share s of each condyle, the optimisation has two more rows,

    N_side - s (N_m + N_l) >= 0.

Reference: Winby et al., J Biomech 42:2294 (2009), doi:10.1016/j.jbiomech.2009.06.019 (muscles, not
ligaments, keep the lateral condyle loaded in walking).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import SIDES, Array, knee_coordinates
from tkamb.knee.crossing import CrossingLines, tension_by_ligament
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.load import PointForces, wrench_of
from tkamb.knee.released_forces import external_wrench, patellar_line


@dataclass(frozen=True, eq=False)
class CondyleRows:
    """The normal forces of the medial and the lateral condyle, affine in the muscle forces.

    Args:
        constant: forces without muscles, N, shape (2,).
        extensor: change per newton of the extensor group, shape (2,).
        arms: change per newton of the crossing muscles, shape (2, c).
    """

    constant: Array
    extensor: Array
    arms: Array

    def above_share(self, share: float) -> "CondyleRows":
        """Return N_side - share (N_m + N_l) for both sides."""
        change = np.eye(2) - share
        return CondyleRows(change @ self.constant, change @ self.extensor, change @ self.arms)


def condyle_rows(
    geometry: KneeGeometry, lines: CrossingLines, points: Mapping[str, Array]
) -> CondyleRows | None:
    """Return the condyles' normal forces; None: no condyle is in contact, or no patella was found.

    The contact point of a condyle that is off the insert is the mirror image of the other one about
    the femoral component's centre.

    Args:
        geometry: the frame with an extensor mechanism; its contact and muscle forces are not used.
        lines: lines of action of the muscles that cross the knee.
        points: side -> contact point (3,), m, insert frame, for each condyle in contact.
    """
    if not points or geometry.extensor is None:
        return None
    try:
        ratio, constant = tension_by_ligament(geometry)
    except ComputationError:
        return None
    state, chain = geometry.state, geometry.state.chain
    coordinates = knee_coordinates(state.pose("femur"))
    known = external_wrench(geometry, coordinates)
    for load in (*geometry.ligaments, *geometry.post):
        if chain.on_shank(load.link):
            known = known + _wrench(load)
    # the extensor group of tension Q pulls the patellar ligament with (Q - constant) / ratio
    line = patellar_line(geometry, coordinates).wrench(state.pose("femur"))
    known = known - constant / ratio * line
    pulls = lines.unit_wrenches(state.pose("tibia"), state.pose("femur"))
    split = _split(points, float(coordinates[2]))
    return CondyleRows(split @ known, split @ line / ratio, split @ pulls.T)


def _wrench(load: PointForces) -> Array:
    total = np.asarray(wrench_of(load.points, load.forces).sum(axis=0))
    total[3:] += load.moment
    return total


def _split(points: Mapping[str, Array], centre: float) -> Array:
    """Return the matrix (2, 6) from W about the insert's origin to N of both sides."""
    height = float(np.mean([point[1] for point in points.values()]))
    one, other = SIDES
    z = {side: float(point[2]) for side, point in points.items()}
    z_m, z_l = (z.get(a, 2.0 * centre - z.get(b, 0.0)) for a, b in ((one, other), (other, one)))
    along = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    about = np.array([0.0, 0.0, -height, 1.0, 0.0, 0.0])
    return np.array([z_l * along + about, -z_m * along - about]) / (z_l - z_m)
