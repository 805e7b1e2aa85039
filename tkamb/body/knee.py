"""One frame of the knee: known geometry in, every unknown load out.

15 equations (free root 6, knee 6, patella 3) and 15 unknowns: hip force and moment,
quadriceps, patellar ligament, patellofemoral force (2), medial and lateral normal force,
and three residuals. Less is asked for when less is modelled:

- no muscles: the patella is left out, the flexion moment joins the residuals;
- no contact: the knee's force and its coronal and axial moments (with muscles), or its
  whole intersegmental wrench (without), act at the femoral origin.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from tkamb.body import unknowns
from tkamb.body.chain import ChainState
from tkamb.body.inverse_dynamics import Solution, Unknown, solve
from tkamb.body.load import PointForces
from tkamb.body.unknowns import CondylePoint
from tkamb.geometry.frames import Array

RESIDUAL_SHIFT = 0.010
"""m: how far the residuals' point is moved along y for their sensitivity."""

EXTENSOR = ("quadriceps", "patellar_ligament", "patellofemoral", "patellofemoral_tangential")


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
        slack: the quadriceps would have had to push, so it carries nothing.
        problems: plain words; empty when all is well.
    """

    values: dict[str, float]
    contact_force: Array
    external_flexion: float
    external_adduction: float
    sensitivity: float
    condition: float
    lifted: frozenset[str]
    slack: bool
    problems: tuple[str, ...]


def solve_knee(geometry: KneeGeometry, friction: float) -> KneeLoads:
    """Return all loads of one frame.

    A muscle cannot push: where the quadriceps would have to, the extensor mechanism is slack
    and the flexion moment that flexors would have to carry becomes a residual. A condyle
    cannot pull: it is lifted off and the coronal moment becomes a residual.

    Args:
        geometry: the frame.
        friction: Coulomb coefficient of the femorotibial contact.
    """
    system = _System(geometry, friction, geometry.lifted, slack=False)
    solution = system.solve()
    if solution.values.get("quadriceps", 0.0) < 0:
        system = replace(system, slack=True)
        solution = system.solve()
    pulling = _pulling(system, solution)
    if pulling and len(system.touching) == 2:
        side = min(pulling, key=lambda name: solution.values[f"{name}_normal"])
        system = replace(system, lifted=system.lifted | {side})
        solution = system.solve()
        pulling = _pulling(system, solution)
    problems = ["contact would have to pull"] if pulling else []
    if not solution.regular:
        problems.append("singular equations")
    if problems:
        return replace(unsolved(problems), condition=solution.condition)
    flexion, adduction = _external_moments(geometry)
    return KneeLoads(
        solution.values | (dict.fromkeys(EXTENSOR, 0.0) if system.slack else {}),
        system.contact_force(solution),
        flexion,
        adduction,
        _sensitivity(system, solution),
        solution.condition,
        system.lifted,
        system.slack,
        (),
    )


def unsolved(problems: Iterable[str]) -> KneeLoads:
    """Return a frame without a number, and why."""
    nan = np.nan
    return KneeLoads({}, np.full(3, nan), nan, nan, nan, nan, frozenset(), False, tuple(problems))


@dataclass(frozen=True, eq=False)
class _System:
    """The square system of one frame under given assumptions.

    Args:
        geometry: the frame.
        friction: Coulomb coefficient.
        lifted: sides that carry nothing.
        slack: the extensor mechanism carries nothing.
        shift: m, of the residuals' point along y.
    """

    geometry: KneeGeometry
    friction: float
    lifted: frozenset[str]
    slack: bool
    shift: float = 0.0

    @property
    def touching(self) -> list[str]:
        """Sides that carry load."""
        return [side for side in self.geometry.condyles if side not in self.lifted]

    def solve(self) -> Solution:
        """Solve for all unknown loads."""
        geometry = self.geometry
        hip = unknowns.hip(geometry.state.point("hip", np.zeros(3)))
        known = [*([geometry.ground] if geometry.ground else []), *geometry.ligaments]
        return solve(geometry.state, [*hip, *self._extensor(), *self._knee()], known)

    def contact_force(self, solution: Solution) -> Array:
        """Return the femorotibial force on the femur (3,), insert frame, without residuals."""
        if not self.geometry.condyles:
            return np.array([solution.values[f"knee_force_{axis}"] for axis in unknowns.AXES])
        forces = [
            solution.values[f"{side}_normal"]
            * self.geometry.condyles[side].direction(self.friction)
            for side in self.touching
        ]
        return np.asarray(np.sum(forces, axis=0))

    def _extensor(self) -> list[Unknown]:
        extensor, state = self.geometry.extensor, self.geometry.state
        if extensor is None:
            return []
        if self.slack:
            return unknowns.riding_patella(extensor.contact_point, state.pose("femur")[:3, 2])
        return [
            Unknown("quadriceps", extensor.quadriceps),
            Unknown("patellar_ligament", extensor.patellar_ligament),
            *unknowns.patellofemoral(
                extensor.contact_point, extensor.contact_normal, state.pose("femur")[:3, 2]
            ),
        ]

    def _knee(self) -> list[Unknown]:
        geometry = self.geometry
        balanced = geometry.extensor is not None and not self.slack
        if not geometry.condyles:
            axes = {"axial": unknowns.AXES["si"], "coronal": unknowns.AXES["ap"]}
            if not balanced:
                axes["flexion"] = unknowns.AXES["ml"]
            return unknowns.intersegmental(geometry.state.pose("femur")[:3, 3], axes)
        normals = [
            unknowns.condyle(side, geometry.condyles[side], self.friction) for side in self.touching
        ]
        middle = np.mean([contact.point for contact in geometry.condyles.values()], axis=0)
        middle = middle + np.array([0.0, self.shift, 0.0])
        return normals + unknowns.residuals(middle, len(normals) < 2, balanced)


def _pulling(system: _System, solution: Solution) -> list[str]:
    return [side for side in system.touching if solution.values[f"{side}_normal"] < 0]


def _sensitivity(system: _System, solution: Solution) -> float:
    if not system.geometry.condyles:
        return 0.0
    total = np.linalg.norm(system.contact_force(solution))
    changes = []
    for shift in (-RESIDUAL_SHIFT, RESIDUAL_SHIFT):
        moved = replace(system, shift=shift)
        changes.append(abs(np.linalg.norm(moved.contact_force(moved.solve())) - total))
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
