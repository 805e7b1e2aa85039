"""How the quadriceps' force depends on the other muscles: the flexion row of the sharing.

The equations of a frame are linear in all loads while contact points and lines are fixed. The
tension of the extensor group that they require is therefore

    Q = Q_0 + Σ_i g_i F_i + h r,

Q_0 without the other muscles, F_i the muscles that cross the knee, r a moment on the tibia about
the insert's z. Solved for r this is the knee's row of a static optimisation,

    -Q_0/h = -(1/h) Q + Σ_i (g_i/h) F_i + r,

with contact, ligaments, patella and friction in it: -1/h is the arm of the extensor group, -Q_0/h
the moment that all muscles together have to carry.

With released coordinates, contact points and the medial-lateral split depend on the muscles. The
row then comes from the tension of the patellar ligament, which is linear in the muscle forces by
the tangent of contact and ligaments (`ReleasedForces.tension_per_wrench`). A condyle that lifts
off changes that row smoothly.
"""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array
from tkamb.knee import unknowns
from tkamb.knee.crossing import CrossingLines
from tkamb.knee.equations import KneeGeometry, KneeSystem
from tkamb.knee.load_state import LoadState


@dataclass(frozen=True, eq=False)
class FlexionRow:
    """The knee's row of the muscles' sharing.

    Args:
        moment: N·m on the tibia about the insert's z, which muscles and reserve supply together.
        extensor_arm: m, of the extensor group.
        arms: (c,) m, of the crossing muscles.
    """

    moment: float
    extensor_arm: float
    arms: Array


def flexion_row(
    geometry: KneeGeometry, lines: CrossingLines, friction: float, lifted: frozenset[str]
) -> FlexionRow:
    """Return the row at one frame, the extensor mechanism taut.

    Args:
        geometry: the frame, with an extensor mechanism; the forces of other muscles in it do
            not enter.
        lines: of the muscles that cross the knee.
        friction: Coulomb coefficient of the femorotibial contact.
        lifted: sides that carry nothing.

    Raises:
        ComputationError: the patella has no place there, or the equations are singular.
    """
    if geometry.extensor is None:
        raise ComputationError("; ".join(geometry.problems) or "no patella", "muscles")
    alone = replace(geometry, share=None)
    system = KneeSystem(alone, friction, LoadState(lifted, frozenset()))
    if not system.solution.regular:
        raise ComputationError("singular equations", "muscles")
    moment = unknowns.moment_pair("tibia", "femur", unknowns.AXES["ml"])
    groups = [*lines.unit_loads(geometry.state), moment]
    name = unknowns.muscle_load(geometry.extensor.muscles[0])
    change = system.response(geometry.state.generalised(groups))[system.names.index(name)]
    gains, slope = change[:-1], float(change[-1])
    return _solved_for_reserve(system.solution.values[name], gains, slope)


def yielding_flexion_row(
    geometry: KneeGeometry, lines: CrossingLines, base: float, per_wrench: Array
) -> FlexionRow:
    """Return the row at one frame whose released coordinates yield to the muscles.

    The patella's equilibrium relates the extensor group's tension to the ligament's: Q = a T + b.

    Args:
        geometry: the frame, with an extensor mechanism; its contact is not used.
        lines: of the muscles that cross the knee.
        base: N, tension of the patellar ligament without the other muscles.
        per_wrench: (6,) N per N and per N·m, what a wrench on the insert, about its origin,
            adds to it.

    Raises:
        ComputationError: the equations of the patella are singular.
    """
    state = geometry.state
    ratio, free = _tension_by_ligament(geometry)
    gains = ratio * lines.unit_wrenches(state.pose("tibia"), state.pose("femur")) @ per_wrench
    slope = ratio * float(per_wrench[3:] @ unknowns.AXES["ml"])
    return _solved_for_reserve(ratio * base + free, gains, slope)


def _tension_by_ligament(geometry: KneeGeometry) -> tuple[float, float]:
    """Return a and b (N) of the extensor group's tension Q = a T + b, T the ligament's.

    They follow from the patella's own three equations, which contain no other load of the leg.
    """
    extensor, state = geometry.extensor, geometry.state
    assert extensor is not None
    femur_ml = state.pose("femur")[:3, 2]
    pressed = unknowns.patellofemoral(extensor.contact_point, extensor.contact_normal, femur_ml)
    unknown_forces = [geometry.muscles[0], *pressed]
    loads = [
        *(unknown.loads for unknown in unknown_forces),
        extensor.patellar_ligament,
        geometry.ligaments,
    ]
    columns = state.generalised(loads)[state.chain.patella_columns()]
    matrix, ligament, constants = columns[:, :3], columns[:, 3], columns[:, 4]
    names = [unknown.name for unknown in unknown_forces]
    alone = unknowns.solve(names, matrix, state.inertial[state.chain.patella_columns()] - constants)
    if not alone.regular:
        raise ComputationError("singular equations", "muscles")
    return -float(np.linalg.solve(matrix, ligament)[0]), alone.values[names[0]]


def _solved_for_reserve(alone: float, gains: Array, slope: float) -> FlexionRow:
    """Return the row of Q = alone + gains F + slope r."""
    return FlexionRow(-alone / slope, -1.0 / slope, np.asarray(gains / slope))
