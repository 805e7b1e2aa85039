"""How the quadriceps' force answers to the other muscles: the flexion row of their sharing.

The equations of a frame are linear in all loads while contact points and lines stay. So the
tension that they ask of the extensor group is

    Q = Q_0 + Σ_i g_i F_i + h r,

Q_0 without the other muscles, F_i the muscles that cross the knee, r a moment on the tibia about
the insert's z. Solved for r this is the knee's row of a static optimisation,

    -Q_0/h = -(1/h) Q + Σ_i (g_i/h) F_i + r,

with contact, ligaments, patella and friction in it: -1/h is the arm of the extensor group, -Q_0/h
the moment that all muscles together have to carry.

Of a knee with released coordinates contact points and distribution follow the muscles: there the
tension of the patellar ligament, as linear in them by the tangent of contact and ligaments, gives
the row (`ReleasedForces.tension_per_wrench`), and a condyle that lifts off changes it smoothly.
"""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.body import unknowns
from tkamb.body.crossing import CrossingLines
from tkamb.body.knee import KneeGeometry, KneeSystem
from tkamb.body.load_state import LoadState
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array


@dataclass(frozen=True, eq=False)
class FlexionRow:
    """The knee's row of the muscles' sharing.

    Args:
        moment: N·m, what muscles and reserve carry together, on the tibia about the insert's z.
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
    geometry: KneeGeometry, lines: CrossingLines, friction: float, base: float, per_wrench: Array
) -> FlexionRow:
    """Return the row at one frame whose released coordinates yield to the muscles.

    Patella and patellar ligament tie the extensor group's tension to the ligament's: Q = a T + b.

    Args:
        geometry: the frame, with an extensor mechanism; its contact is not looked at.
        lines: of the muscles that cross the knee.
        friction: Coulomb coefficient, of no consequence without contact.
        base: N, tension of the patellar ligament without the other muscles.
        per_wrench: (6,) N per N and per N·m, what a wrench on the insert, about its origin,
            adds to it.

    Raises:
        ComputationError: the equations of the patella are singular.
    """
    assert geometry.extensor is not None
    alone = replace(geometry, share=None, condyles={})
    system = KneeSystem(alone, friction, LoadState(frozenset(), frozenset()))
    if not system.solution.regular:
        raise ComputationError("singular equations", "muscles")
    values, state = system.solution.values, geometry.state
    names = (unknowns.muscle_load(geometry.extensor.muscles[0]), "patellar_ligament")
    moment = unknowns.moment_pair("tibia", "femur", unknowns.AXES["ml"])
    change = system.response(state.generalised([moment]))[:, 0]
    quadriceps, ligament = (float(change[system.names.index(name)]) for name in names)
    ratio = quadriceps / ligament
    free = values[names[0]] - ratio * values[names[1]]
    gains = ratio * lines.unit_wrenches(state.pose("tibia"), state.pose("femur")) @ per_wrench
    slope = ratio * float(per_wrench[3:] @ unknowns.AXES["ml"])
    return _solved_for_reserve(ratio * base + free, gains, slope)


def _solved_for_reserve(alone: float, gains: Array, slope: float) -> FlexionRow:
    """Return the row of Q = alone + gains F + slope r."""
    return FlexionRow(-alone / slope, -1.0 / slope, np.asarray(gains / slope))
