"""Muscles across the knee, other than the extensor group, in the equations of one frame.

A taut line runs from the shank at p to the thigh or pelvis at q, both ends fixed to their links. A
force F pulls the shank at p along u = (q - p)/|q - p|, and the thigh at q along -u. Foot and shank
are one body: a line that ends on the foot pulls it where the line leaves the foot. The force of a
line from the pelvis acts on the femur, and the hip loads balance it.

With fixed contact points and lines the equations are linear in all loads. This has two uses.

1. The tension Q of the extensor group is linear in the forces F_i of the other muscles and in a
   moment r on the tibia about the insert's z (docs/muscles.md). Solved for r, this is the knee's
   row of a static optimisation (`flexion_row`),

       -Q_0/h = -(1/h) Q + sum_i (g_i/h) F_i + r.

   It includes contact, ligaments, patella and friction. -1/h is the moment arm of the extensor
   group, and -Q_0/h the moment that all muscles together supply. If coordinates are released,
   the row comes from the tension of the patellar ligament (`yielding_flexion_row`).

2. A normal force is the sum of the contributions of all loads (`condyle_contributions`),

       N_side = N_side(weight, inertia and ground) + N_side(ligaments) + sum_i N_side(muscle i),

   plus N_side(post) if a cam on the insert's post is modelled. Each term has all other muscles and
   ligaments at zero force, and a moment about the insert's z balances its flexion moment; over all
   terms these moments add up to the knee's reserve. As in every frame, residuals balance the AP and
   ML force and the axial moment. The extensor group is one muscle here.

References: Winby et al., J Biomech 42:2294 (2009), doi:10.1016/j.jbiomech.2009.06.019;
Sasaki & Neptune, J Biomech 43:2780 (2010), doi:10.1016/j.jbiomech.2010.06.011.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, inverse, transform
from tkamb.knee import unknowns
from tkamb.knee.equations import KneeGeometry, KneeSystem, SolvedLoads
from tkamb.knee.load import PointForces, wrench_of
from tkamb.knee.unknowns import LoadState

if TYPE_CHECKING:
    from tkamb.knee.chain import ChainState


@dataclass(frozen=True, eq=False)
class CrossingLines:
    """Lines from the shank to the thigh at one frame.

    Args:
        shank: points where the lines leave the shank or foot, tibia frame, (c, 3), m.
        thigh: points where they arrive at the thigh or pelvis, femur frame, (c, 3), m.
        knee: pose of the femur in the tibia for which they were computed, (4, 4); None: unknown.
    """

    shank: Array
    thigh: Array
    knee: Array | None = None

    def turned(self, state: "ChainState") -> float:
        """Return the rotation of the knee since the points were computed, rad; NaN: unknown.

        The end of a line that wraps a bone or passes a via point moves as the knee rotates, but
        here it is fixed. The error of the direction is at most about this rotation.
        """
        if self.knee is None:
            return float("nan")
        pose = inverse(state.pose("tibia")) @ state.pose("femur")
        change = Rotation.from_matrix(self.knee[:3, :3].T @ pose[:3, :3])
        return float(change.magnitude())

    def unit_wrenches(self, tibia: Array, femur: Array) -> Array:
        """Return the wrenches (..., c, 6) on the insert at one newton in each line.

        `tibia` (4, 4) and `femur` (..., 4, 4) are poses of the links in the insert frame.
        """
        start = transform(tibia, self.shank)
        directions = np.einsum("...ij,cj->...ci", femur[..., :3, :3], self.thigh)
        directions = directions + femur[..., None, :3, 3] - start
        directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        return wrench_of(start, directions)

    def unit_loads(self, state: "ChainState") -> list[tuple[PointForces, ...]]:
        """Return the loads on tibia and femur at one newton in each line, insert frame."""
        return [
            (PointForces("tibia", p[None], u[None]), PointForces("femur", q[None], -u[None]))
            for p, q, u in zip(*self._ends(state), strict=True)
        ]

    def loads(self, state: "ChainState", force: Array) -> tuple[PointForces, PointForces]:
        """Return the loads on tibia and femur at forces (c,), N, insert frame."""
        start, end, directions = self._ends(state)
        pulls = force[:, None] * directions
        return PointForces("tibia", start, pulls), PointForces("femur", end, -pulls)

    def _ends(self, state: "ChainState") -> tuple[Array, Array, Array]:
        """Return starts, ends and unit directions (c, 3), insert frame."""
        start = transform(state.pose("tibia"), self.shank)
        end = transform(state.pose("femur"), self.thigh)
        directions = end - start
        return start, end, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


@dataclass(frozen=True, eq=False)
class MuscleShare:
    """The force of each muscle of a leg at one frame.

    Args:
        activation: activations, 0 to 1, (m,).
        force: muscle forces, (m,), N.
        moment: joint moments that muscles and reserves supply together, (n,), N·m.
        reserve: moments that no muscle supplies, a part of `moment`, (n,), N·m.
        flexion: index of the knee's flexion among the coordinates.
        crossing: indices of the c muscles across the knee, without the extensor group, (c,).
        both_loaded: whether the forces keep the least share of load on each condyle, if required.
    """

    muscles: tuple[str, ...]
    activation: Array
    force: Array
    coordinates: tuple[str, ...]
    moment: Array
    reserve: Array
    flexion: int
    crossing: np.ndarray
    lines: CrossingLines
    status: str = "ok"
    both_loaded: bool = True

    def loads(self, state: "ChainState") -> tuple[PointForces, ...]:
        """Return the crossing muscles' and the reserve's loads on tibia and femur."""
        line_loads = self.lines.loads(state, self.force[self.crossing])
        return (*line_loads, *unknowns.moment_pair("tibia", "femur", self._knee_reserve))

    def wrench(self, tibia: Array, femur: Array) -> Array:
        """Return the wrench (..., 6) of these loads on the insert; see `unit_wrenches`."""
        units = self.lines.unit_wrenches(tibia, femur)
        total = np.einsum("i,...ij->...j", self.force[self.crossing], units)
        total[..., 3:] += self._knee_reserve
        return np.asarray(total)

    @property
    def _knee_reserve(self) -> Array:
        """The knee's reserve moment on the tibia about the insert's z, (3,), N·m."""
        return self.reserve[self.flexion] * unknowns.AXES["ml"]


@dataclass(frozen=True, eq=False)
class FlexionRow:
    """The knee's row of the static optimisation.

    Args:
        moment: moment on the tibia about the insert's z from muscles and reserve together, N·m.
        extensor_arm: moment arm of the extensor group, m.
        arms: moment arms of the crossing muscles, (c,), m.
    """

    moment: float
    extensor_arm: float
    arms: Array


def flexion_row(
    geometry: KneeGeometry, lines: CrossingLines, friction: float, lifted: frozenset[str]
) -> FlexionRow:
    """Return the knee's row of the static optimisation, with a taut extensor mechanism.

    `geometry` has an extensor mechanism (its other muscle forces are not used), `lifted` the sides
    without load.

    Raises:
        ComputationError: the patella was not found, or the equations are singular.
    """
    if geometry.extensor is None:
        raise ComputationError("; ".join(geometry.problems) or "no patella", "muscles")
    # The forces of the other muscles are the unknowns of the row, so the equations exclude them.
    without_muscles = replace(geometry, share=None)
    system = KneeSystem(without_muscles, friction, LoadState(lifted, frozenset()))
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
    """Return the row if coordinates are released.

    By the patella's equilibrium Q = a T + b, with the tension T of the patellar ligament.

    `geometry` has an extensor mechanism; its contact is not used. `base` is T without the other
    muscles, N, and `per_wrench` (6,), 1 and 1/m, its change per wrench on the insert.

    Raises:
        ComputationError: the equations of the patella are singular.
    """
    state = geometry.state
    ratio, constant = tension_by_ligament(geometry)
    gains = ratio * lines.unit_wrenches(state.pose("tibia"), state.pose("femur")) @ per_wrench
    slope = ratio * float(per_wrench[3:] @ unknowns.AXES["ml"])
    return _solved_for_reserve(ratio * base + constant, gains, slope)


def tension_by_ligament(geometry: KneeGeometry) -> tuple[float, float]:
    """Return a (1) and b (N) of Q = a T + b from the three equations of the patella.

    A released patella has the ratio a of its equilibrium.
    """
    extensor, state = geometry.extensor, geometry.state
    assert extensor is not None
    if extensor.released is not None:
        return extensor.released.tension / extensor.released.forces["patellar_ligament"], 0.0
    femur_ml = state.pose("femur")[:3, 2]
    contact_forces = unknowns.patellofemoral(
        extensor.contact_point, extensor.contact_normal, femur_ml
    )
    unknown_forces = [geometry.muscles[0], *contact_forces]
    loads = [
        *(unknown.loads for unknown in unknown_forces),
        extensor.patellar_ligament,
        geometry.ligaments,
    ]
    columns = state.generalised(loads)[state.chain.patella_columns()]
    matrix, ligament, constants = columns[:, :3], columns[:, 3], columns[:, 4]
    names = [unknown.name for unknown in unknown_forces]
    solution = unknowns.solve(
        names, matrix, state.inertial[state.chain.patella_columns()] - constants
    )
    if not solution.regular:
        raise ComputationError("singular equations", "muscles")
    return -float(np.linalg.solve(matrix, ligament)[0]), solution.values[names[0]]


def _solved_for_reserve(constant: float, gains: Array, slope: float) -> FlexionRow:
    """Return the row of Q = constant + gains F + slope r."""
    return FlexionRow(-constant / slope, -1.0 / slope, np.asarray(gains / slope))


EXTERNAL, LIGAMENTS, POST, EXTENSORS = "external", "ligaments", "post", "quadriceps"
"""Names of the contributions of weight, inertia and ground reaction, all ligaments, the post and
the extensor group.
"""


def condyle_contributions(
    geometry: KneeGeometry, loads: SolvedLoads, friction: float
) -> dict[str, dict[str, float]]:
    """Return side -> load -> its contribution to that side's normal force, N.

    They add up to the force; a lifted side has none. `geometry` has contact, extensor mechanism and
    the other muscles.
    """
    share, extensor = geometry.share, geometry.extensor
    if share is None or extensor is None or loads.problems:
        return {}
    slack = frozenset(extensor.muscles) if loads.slack else frozenset[str]()
    # Without the other loads, the solution is the contribution of weight, inertia and ground.
    without_known_loads = replace(geometry, share=None, ligaments=(), post=())
    system = KneeSystem(without_known_loads, friction, LoadState(loads.lifted, slack))
    lines = share.lines.unit_loads(geometry.state)
    moment = unknowns.moment_pair("tibia", "femur", unknowns.AXES["ml"])
    constants = {LIGAMENTS: geometry.ligaments} | ({POST: geometry.post} if geometry.post else {})
    unit = system.response(geometry.state.generalised([*constants.values(), *lines, moment]))
    external = np.array([system.solution.values[name] for name in system.names])
    force = share.force[share.crossing]
    magnitudes = np.concatenate([np.ones(len(constants)), force])
    contributions = np.column_stack([external, unit[:, :-1] * magnitudes])
    from_extensors = np.zeros(len(external))
    if not slack:
        # The extensor group is a known load here. A flexion moment replaces it as unknown.
        row = system.names.index(unknowns.muscle_load(extensor.muscles[0]))
        per_extensor_newton = unit[:, -1] / unit[row, -1]
        contributions = contributions - np.outer(per_extensor_newton, contributions[row])
        from_extensors = per_extensor_newton * extensor.tension(loads.values)
    names = [EXTERNAL, *constants, *(share.muscles[i] for i in share.crossing), EXTENSORS]
    contributions = np.column_stack([contributions, from_extensors])
    return {
        side: dict(
            zip(names, contributions[system.names.index(f"{side}_normal")].tolist(), strict=True)
        )
        for side in system.carrying
    }
