"""One frame of the knee: known geometry in, every unknown load out.

15 equations (free root 6, knee 6, patella 3) and 15 unknowns: hip force and moment,
quadriceps, patellar ligament, patellofemoral force (2), medial and lateral normal force,
and three residuals. Less is asked for when less is modelled:

- no muscles: the patella is left out, the flexion moment joins the residuals;
- no contact: the knee's force and its coronal and axial moments (with muscles), or its
  whole intersegmental wrench (without), act at the femoral origin.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from tkamb.body import unknowns
from tkamb.body.chain import ChainState
from tkamb.body.inverse_dynamics import Solution, Unknown, solve
from tkamb.body.load import PointForces
from tkamb.body.unknowns import CondylePoint
from tkamb.geometry.frames import Array

RESIDUAL_SHIFT = 0.010
"""m: how far the residuals' point is moved along y for their sensitivity."""

NAN3 = np.full(3, np.nan)


@dataclass(frozen=True, eq=False)
class Extensor:
    """The extensor mechanism at one frame, per unit tension, insert frame.

    Args:
        quadriceps: loads of one newton of quadriceps tension, wrap included.
        patellar_ligament: loads of one newton of patellar-ligament tension.
        contact_point: (3,) m, patellofemoral contact.
        contact_normal: (3,) unit, out of the femur into the patella, sagittal.
    """

    quadriceps: tuple[PointForces, ...]
    patellar_ligament: tuple[PointForces, ...]
    contact_point: Array
    contact_normal: Array


@dataclass(frozen=True, eq=False)
class KneeGeometry:
    """Everything that the equations of one frame need, insert frame.

    Args:
        state: the chain at this frame.
        ground: ground reaction on the shank, if measured.
        ligaments: known ligament loads.
        condyles: side -> contact point; empty when contact is not modelled.
        lifted: sides that are clearly off the insert.
        extensor: the extensor mechanism, if modelled.
    """

    state: ChainState
    ground: PointForces | None = None
    ligaments: tuple[PointForces, ...] = ()
    condyles: dict[str, CondylePoint] = field(default_factory=dict)
    lifted: frozenset[str] = frozenset()
    extensor: Extensor | None = None


@dataclass(frozen=True, eq=False)
class KneeLoads:
    """What the equations of one frame say; NaN where they are singular.

    Args:
        values: magnitude of each unknown, N or N·m.
        contact_force: (3,) N on the femur, insert frame, without residuals.
        external_flexion: N·m, moment that tends to flex, about the femoral ML axis.
        external_adduction: N·m, moment that tends to adduct, about the floating axis.
        sensitivity: N, largest change of the total contact force when the residuals' point
            moves by ±10 mm along y.
        condition: condition number (unit columns).
        lifted: sides that carry nothing.
        problems: plain words; empty when all is well.
    """

    values: dict[str, float]
    contact_force: Array
    external_flexion: float
    external_adduction: float
    sensitivity: float
    condition: float
    lifted: frozenset[str]
    problems: tuple[str, ...]


def unsolved(problems: Iterable[str]) -> KneeLoads:
    """Return a frame without a number, and why."""
    return KneeLoads({}, NAN3, np.nan, np.nan, np.nan, np.nan, frozenset(), tuple(problems))


def solve_knee(geometry: KneeGeometry, friction: float) -> KneeLoads:
    """Return all loads of one frame; a condyle that would have to pull is lifted off.

    Args:
        geometry: the frame.
        friction: Coulomb coefficient of the femorotibial contact.
    """
    problems: list[str] = []
    lifted = geometry.lifted
    solution = _solve(geometry, friction, lifted)
    pulling = [side for side in _touching(geometry, lifted) if _normal(solution, side) < 0]
    if pulling and len(_touching(geometry, lifted)) == 2:
        side = min(pulling, key=lambda name: _normal(solution, name))
        lifted = lifted | {side}
        solution = _solve(geometry, friction, lifted)
        pulling = [side for side in _touching(geometry, lifted) if _normal(solution, side) < 0]
    if not solution.regular:
        problems.append("singular equations")
    if pulling:
        problems.append("contact would have to pull")
    if problems:
        solution = Solution(dict.fromkeys(solution.values, np.nan), solution.condition, False)
    force = _contact_force(geometry, solution, friction, lifted)
    flexion, adduction = _external_moments(geometry)
    return KneeLoads(
        solution.values,
        force,
        flexion,
        adduction,
        _sensitivity(geometry, friction, lifted, force) if solution.regular else np.nan,
        solution.condition,
        lifted,
        tuple(problems),
    )


def _touching(geometry: KneeGeometry, lifted: frozenset[str]) -> list[str]:
    return [side for side in geometry.condyles if side not in lifted]


def _normal(solution: Solution, side: str) -> float:
    return solution.values[f"{side}_normal"]


def _solve(
    geometry: KneeGeometry, friction: float, lifted: frozenset[str], shift: float = 0.0
) -> Solution:
    found = unknowns.hip(geometry.state.point("hip", np.zeros(3)))
    extensor = geometry.extensor
    if extensor:
        found += [
            Unknown("quadriceps", extensor.quadriceps),
            Unknown("patellar_ligament", extensor.patellar_ligament),
            *unknowns.patellofemoral(
                extensor.contact_point,
                extensor.contact_normal,
                geometry.state.pose("femur")[:3, 2],
            ),
        ]
    touching = _touching(geometry, lifted)
    if geometry.condyles:
        found += [unknowns.condyle(s, geometry.condyles[s], friction) for s in touching]
        middle = np.mean([c.point for c in geometry.condyles.values()], axis=0)
        middle = middle + np.array([0.0, shift, 0.0])
        found += unknowns.residuals(middle, len(touching) < 2, extensor is not None)
    else:
        axes = {"axial": unknowns.AXES["si"], "coronal": unknowns.AXES["ap"]}
        if not extensor:
            axes["flexion"] = unknowns.AXES["ml"]
        found += unknowns.intersegmental(geometry.state.pose("femur")[:3, 3], axes)
    return solve(geometry.state, found, _known(geometry))


def _known(geometry: KneeGeometry) -> list[PointForces]:
    return [*([geometry.ground] if geometry.ground else []), *geometry.ligaments]


def _contact_force(
    geometry: KneeGeometry, solution: Solution, friction: float, lifted: frozenset[str]
) -> Array:
    """Return the femorotibial force on the femur (3,), insert frame, without residuals."""
    if not solution.regular:
        return NAN3
    if not geometry.condyles:
        return np.array([solution.values[f"knee_force_{axis}"] for axis in unknowns.AXES])
    return np.sum(
        [
            _normal(solution, side) * geometry.condyles[side].direction(friction)
            for side in _touching(geometry, lifted)
        ],
        axis=0,
    )


def _sensitivity(
    geometry: KneeGeometry, friction: float, lifted: frozenset[str], force: Array
) -> float:
    if not geometry.condyles:
        return 0.0
    changes = []
    for shift in (-RESIDUAL_SHIFT, RESIDUAL_SHIFT):
        moved = _solve(geometry, friction, lifted, shift)
        other = _contact_force(geometry, moved, friction, lifted)
        changes.append(abs(np.linalg.norm(other) - np.linalg.norm(force)))
    return float(max(changes))


def _external_moments(geometry: KneeGeometry) -> tuple[float, float]:
    """Return the external flexion and adduction moments, N·m.

    The knee's generalised forces about the flexion and adduction coordinates that hip,
    ground, gravity and inertia ask for; the external moment is their negative. The knee
    centre is the femoral origin, where the three axes meet.
    """
    state = geometry.state
    external = [geometry.ground] if geometry.ground else []
    wanted = state.inertial - sum(
        (state.generalised(load) for load in external), np.zeros(len(state.inertial))
    )
    hip = np.stack(
        [
            state.generalised(unknown.loads[0])
            for unknown in unknowns.hip(state.point("hip", np.zeros(3)))
        ],
        axis=1,
    )
    at_hip = np.linalg.solve(hip[:6], wanted[:6])
    knee = (wanted - hip @ at_hip)[state.chain.knee_columns()]
    return -float(knee[5]), -float(knee[4])
