"""The equations of one frame of the knee, which give all unknown loads.

The full model has 15 equations (6 of the free root, 6 of the knee, 3 of the patella) and 15
unknowns: hip force and moment (6), one muscle, patellar ligament, patellofemoral force (2), medial
and lateral normal force, and three residuals. A smaller model has other unknowns:

- Without muscles the chain has no patella, and the flexion moment is an additional residual.
- With a released patella the extensor mechanism is one unknown, the muscle's tension, as a pair of
  wrenches on tibia and femur (`tkamb.knee.patella_frame`). The femur carries the patella's weight
  and inertia.
- Without contact a force and the coronal and axial moments act at the femoral origin. Without
  muscles the flexion moment acts there, too.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array, cross
from tkamb.knee import unknowns
from tkamb.knee.chain import ChainState
from tkamb.knee.load import PointForces
from tkamb.knee.unknowns import (
    CondylePoint,
    LoadState,
    Unknown,
    contradictions,
    load_states,
    muscle_load,
    solve,
    wrong_signs,
)

if TYPE_CHECKING:
    from tkamb.knee.crossing import MuscleShare
    from tkamb.knee.patella_frame import PatellaLoads


@dataclass(frozen=True)
class EquationSettings:
    """Sensitivity of the loads to the residuals."""

    residual_shift: float = 0.010
    """m: shift along y of the point where the residuals act (`residual_sensitivity_N`)."""


EQUATION = EquationSettings()


PATELLAR = ("patellar_ligament", "patellofemoral", "patellofemoral_tangential")


@dataclass(frozen=True, eq=False)
class Extensor:
    """The extensor mechanism, insert frame.

    Args:
        patellar_ligament: loads on the links at one newton.
        contact_point: point of patellofemoral contact, (3,), m.
        contact_normal: unit normal from femur to patella, in the sagittal plane, (3,).
        muscles: names of the muscles that insert on the patella.
        wrap: angle by which the extensor group wraps the femur, rad.
        released: patella whose contact force may leave the sagittal plane; None: it moves in its
            plane.
    """

    patellar_ligament: tuple[PointForces, ...]
    contact_point: Array
    contact_normal: Array
    muscles: tuple[str, ...]
    wrap: float = 0.0
    released: "PatellaLoads | None" = None

    def tension(self, values: Mapping[str, float]) -> float:
        """Return the tension (N) of the extensor group; NaN if unsolved."""
        return sum(values.get(muscle_load(name), np.nan) for name in self.muscles)


@dataclass(frozen=True, eq=False)
class KneeGeometry:
    """Input of the equations, insert frame.

    Args:
        ground: ground reaction on the shank; None: not measured.
        condyles: side -> contact point; empty: contact is not modelled.
        lifted: sides that are lifted off the insert by their recorded gap.
        extensor: None: not modelled.
        muscles: the unknown tension of each muscle on its line of action.
        coordinates: knee coordinates of this geometry, (6,), m and rad.
        tensions: ligament name -> tension, N.
        share: the other muscles with their forces; None: not modelled.
        post: loads of a cam on the insert's post; empty: not modelled, or no contact.
        problems: reasons why the equations cannot be set up.
    """

    state: ChainState
    ground: PointForces | None = None
    ligaments: tuple[PointForces, ...] = ()
    condyles: dict[str, CondylePoint] = field(default_factory=dict)
    lifted: frozenset[str] = frozenset()
    extensor: Extensor | None = None
    muscles: tuple[Unknown, ...] = ()
    coordinates: Array = field(default_factory=lambda: np.full(6, np.nan))
    tensions: dict[str, float] = field(default_factory=dict)
    share: "MuscleShare | None" = None
    post: tuple[PointForces, ...] = ()
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class SolvedLoads:
    """Loads from the equations of one frame; NaN where there is no solution.

    Args:
        values: name of an unknown -> magnitude, N or N·m.
        contact_force: force of the condyles on the femur without residuals, insert frame, (3,), N.
        external_flexion: external flexion moment about the femoral ML axis, N·m.
        external_adduction: external adduction moment about the floating axis, N·m.
        sensitivity: largest change of the total contact force if the residuals act 10 mm higher
            or lower, N.
        condition: condition number of the matrix with unit columns.
        lifted: sides that carry no load.
        slack: whether the extensor group carries no load, because it would have to push.
        ambiguous: whether a second load state also has all signs right.
        problems: reasons why there is no solution.
    """

    values: dict[str, float]
    contact_force: Array
    external_flexion: float
    external_adduction: float
    sensitivity: float
    condition: float
    lifted: frozenset[str]
    slack: bool
    ambiguous: bool
    problems: tuple[str, ...]


def solve_knee(geometry: KneeGeometry, friction: float) -> SolvedLoads:
    """Return all loads of one frame, in the load state without a wrong sign.

    If several states have no wrong sign, the state with the fewest zero loads is used, and
    `ambiguous` is true. If every state has a wrong sign, there is no solution.

    Args:
        friction: Coulomb coefficient of the femorotibial contact.
    """
    lifted = geometry.lifted
    extensors = geometry.extensor.muscles if geometry.extensor else ()
    first, *others = load_states(geometry.condyles, lifted, extensors)
    # Most frames need only the state in which all loads act.
    full = KneeSystem(geometry, friction, first)
    condition = full.solution.condition
    if not full.solution.regular:
        return replace(unsolved(("singular equations",)), condition=condition)
    if not wrong_signs(first, full.solution):
        return full.loads()
    # A contact that would pull or a muscle that would push carries no load. All load states are
    # solved, and a state without a wrong sign is used.
    systems = {first: full} | {state: KneeSystem(geometry, friction, state) for state in others}
    solutions = {state: system.solution for state, system in systems.items()}
    wrong = {state: contradictions(state, solutions, lifted) for state in systems}
    admissible = [system for state, system in systems.items() if not wrong[state]]
    if not admissible:
        reasons = ", ".join(f"{state.label}: {wrong[state][0]}" for state in systems)
        problem = f"no load state has all signs right ({reasons})"
        return replace(unsolved((problem,)), condition=condition)
    # The first admissible state has the fewest zero loads.
    return replace(admissible[0].loads(), ambiguous=len(admissible) > 1)


def solved_unknowns(geometry: KneeGeometry, loads: SolvedLoads, friction: float) -> list[Unknown]:
    """Return the unknowns in the load state of a solution without problems."""
    extensors = geometry.extensor.muscles if geometry.extensor else ()
    slack = frozenset(extensors if loads.slack else ())
    return KneeSystem(geometry, friction, LoadState(loads.lifted, slack)).unknowns


def unsolved(problems: Iterable[str]) -> SolvedLoads:
    """Return the loads of a frame without a solution: NaN, with the reasons."""
    nan = np.nan
    state = (frozenset[str](), False, False)
    return SolvedLoads({}, np.full(3, nan), nan, nan, nan, nan, *state, tuple(problems))


def dome_sensitivity(
    geometry: KneeGeometry, loads: SolvedLoads, friction: float
) -> tuple[float, float] | None:
    """Return the change of muscle and patellofemoral force per height of the button, N/m.

    The patellofemoral force passes through the button's contact, whose position on the patella is
    known to about a millimetre. The moment arms about its line of action decide the ratio of muscle
    and patellar-ligament tension. A higher or lower button (y axis) shifts the line sideways.

    Here the line is shifted along the patella's y axis, and the patella does not move. With the
    frame's equations A x = b the change is dx = -A⁻¹ dA x. On the shipped knee, from extension to
    120 deg, the tension of the quadriceps changes by 1.6 to 5.6 % per millimetre, and the
    patellofemoral force by 1.0 to 4.3 %. If the patella rotated to its new equilibrium, the tension
    would change by 1.6 % at most. The value for the quadriceps is therefore an upper estimate.

    Args:
        geometry: the frame. A released patella is replaced by the plane one.

    Returns:
        Changes of the extensor group's tension and of the patellofemoral force, N/m; zero if the
        extensor group is slack. None without an extensor mechanism.
    """
    extensor, state = geometry.extensor, geometry.state
    if extensor is None:
        return None
    if loads.slack:
        return 0.0, 0.0
    if extensor.released is not None:
        geometry = extensor.released.plane_of(geometry)
        plane = solve_knee(geometry, friction)
        return (np.nan, np.nan) if plane.problems else dome_sensitivity(geometry, plane, friction)
    without_known_loads = replace(
        geometry, share=None, ligaments=(), post=()
    )  # known loads do not change
    system = KneeSystem(without_known_loads, friction, LoadState(loads.lifted, frozenset()))
    femur_ml, patella_axis = state.pose("femur")[:3, 2], state.pose("patella")[:3, 1]
    at_contact = unknowns.patellofemoral(extensor.contact_point, extensor.contact_normal, femur_ml)
    couples = [
        unknowns.moment_pair("patella", "femur", cross(patella_axis, unknown.loads[0].forces[0]))
        for unknown in at_contact
    ]
    magnitudes = np.array([loads.values[unknown.name] for unknown in at_contact])
    changes = system.response((state.generalised(couples) @ magnitudes)[:, None])[:, 0]
    slopes = dict(zip(system.names, changes.tolist(), strict=True))
    return extensor.tension(slopes), slopes["patellofemoral"]


class KneeSystem:
    """The linear equations of one load state, and their solution.

    Args:
        assumed: the loads that are assumed to be zero.
    """

    def __init__(self, geometry: KneeGeometry, friction: float, assumed: LoadState) -> None:
        self.geometry, self.friction = geometry, friction
        self.lifted, self.slack = assumed
        state = geometry.state
        hip = unknowns.hip(state.point("hip", np.zeros(3)))
        unknown_forces = self.unknowns = [*hip, *self._extensor(), *self._knee()]
        self.names = [unknown.name for unknown in unknown_forces]
        ground = [geometry.ground] if geometry.ground else []
        # `sensitivity` shifts the residual forces along y by these unit couples about x and z.
        couples = [unknowns.moment_pair("tibia", "femur", unknowns.AXES[a]) for a in ("ap", "ml")]
        pulls = geometry.share.loads(state) if geometry.share else ()
        known_loads = (*geometry.ligaments, *geometry.post, *pulls)
        groups = [*(unknown.loads for unknown in unknown_forces), *couples, ground, known_loads]
        columns = state.generalised(groups)
        self._columns, self._couples = columns[:, :-4], columns[:, -4:-2]
        # Generalised forces of hip and knee together: inertial forces less the ground reaction.
        self._outside = state.inertial - columns[:, -2]
        # Known loads of the knee (ligaments, post, muscles) are subtracted, too.
        self._right = self._outside - columns[:, -1]
        self.solution = solve(self.names, self._columns, self._right)

    @property
    def carrying(self) -> list[str]:
        """Names of the condyles that carry load."""
        return [side for side in self.geometry.condyles if side not in self.lifted]

    def loads(self) -> SolvedLoads:
        """Return the solution as loads, including the zero loads."""
        values = self.solution.values
        flexion, adduction = self.external_moments()
        slack = [*map(muscle_load, self.slack), *PATELLAR] if self.slack else []
        extensor = self.geometry.extensor
        if extensor is not None and extensor.released is not None and not self.slack:
            values = values | extensor.released.forces
        return SolvedLoads(
            values | dict.fromkeys(slack, 0.0),
            self.contact_force(values),
            flexion,
            adduction,
            self.sensitivity(),
            self.solution.condition,
            self.lifted,
            bool(self.slack),
            ambiguous=False,
            problems=(),
        )

    def contact_force(self, values: Mapping[str, float]) -> Array:
        """Return the femorotibial force on the femur (3,), insert frame, without residuals."""
        if not self.geometry.condyles:
            return np.array([values[f"knee_force_{axis}"] for axis in unknowns.AXES])
        forces = [
            values[f"{side}_normal"] * self.geometry.condyles[side].direction(self.friction)
            for side in self.carrying
        ]
        return np.asarray(np.sum(forces, axis=0))

    def response(self, loads: Array) -> Array:
        """Return the change of the unknowns (k, n) per unit of known loads, columns (k, n)."""
        # The sign is negative because the unknowns balance the added loads.
        return np.asarray(-np.linalg.solve(self._columns, loads))

    def sensitivity(self) -> float:
        """Return the largest change (N) of the total force if the residuals shift along y.

        A shift s along y adds the couple -s about z to a unit force along x, and the couple s
        about x to a unit force along z.
        """
        if not self.geometry.condyles:
            return 0.0
        total = np.linalg.norm(self.contact_force(self.solution.values))
        shifts = np.array([-EQUATION.residual_shift, EQUATION.residual_shift])[:, None]
        about_x, about_z = self._couples.T
        columns = np.stack([self._columns, self._columns])
        columns[:, :, self.names.index("residual_ap")] -= shifts * about_z
        columns[:, :, self.names.index("residual_ml")] += shifts * about_x
        try:
            solutions = np.linalg.solve(columns, self._right[:, None])[:, :, 0]
        except np.linalg.LinAlgError:
            return np.inf
        forces = [self.contact_force(dict(zip(self.names, x, strict=True))) for x in solutions]
        return float(np.abs(np.linalg.norm(forces, axis=1) - total).max())

    def external_moments(self) -> tuple[float, float]:
        """Return the external flexion and adduction moments, N·m.

        They are the negatives of the generalised forces that hip, ground, gravity and inertia
        require about the knee's flexion and adduction axes. The three axes meet at the femoral
        origin, the centre of the knee.
        """
        hip = self._columns[:, :6]
        # The internal loads of the knee cancel in the six equations of the free root, so these
        # equations give the six unknowns of the hip.
        at_hip = np.linalg.solve(hip[:6], self._outside[:6])
        knee = self._outside - hip @ at_hip
        rows = self.geometry.state.chain.knee_columns()
        return -float(knee[rows[5]]), -float(knee[rows[4]])

    def _extensor(self) -> list[Unknown]:
        extensor, state = self.geometry.extensor, self.geometry.state
        if extensor is None:
            return []
        if self.slack:
            return unknowns.unloaded_patella(extensor.contact_point, state.pose("femur")[:3, 2])
        if extensor.released is not None:
            origin, femur_ml = state.pose("patella")[:3, 3], state.pose("femur")[:3, 2]
            rest = unknowns.unloaded_patella(origin, femur_ml)
            return [*self.geometry.muscles, *rest]
        return [
            *self.geometry.muscles,
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
            unknowns.condyle(side, geometry.condyles[side], self.friction) for side in self.carrying
        ]
        middle = np.mean([contact.point for contact in geometry.condyles.values()], axis=0)
        return normals + unknowns.residuals(middle, len(normals) < 2, balanced)
