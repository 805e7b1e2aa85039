"""One frame of the knee: known geometry in, every unknown load out.

15 equations (free root 6, knee 6, patella 3) and 15 unknowns: hip force and moment,
one muscle, patellar ligament, patellofemoral force (2), medial and lateral normal force,
and three residuals. A smaller model has fewer unknowns:

- no muscles: the patella is left out, the flexion moment joins the residuals;
- no contact: the knee's force and its coronal and axial moments (with muscles), or its
  whole intersegmental wrench (without), act at the femoral origin.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array, cross
from tkamb.knee import unknowns
from tkamb.knee.chain import ChainState
from tkamb.knee.contact_points import CondylePoint
from tkamb.knee.load import PointForces
from tkamb.knee.unknowns import (
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


@dataclass(frozen=True)
class EquationSettings:
    """The equations of motion of the leg."""

    residual_shift: float = 0.010
    """m: shift along y of the point where the residuals act, by which their sensitivity is
    measured."""


EQUATION = EquationSettings()


PATELLAR = ("patellar_ligament", "patellofemoral", "patellofemoral_tangential")


@dataclass(frozen=True, eq=False)
class Extensor:
    """The extensor mechanism at one frame, without the muscles' forces, insert frame.

    Args:
        patellar_ligament: loads of one newton of patellar-ligament tension.
        contact_point: (3,) m, patellofemoral contact.
        contact_normal: (3,) unit, out of the femur into the patella, sagittal.
        muscles: names of the muscles that insert on the patella, the extensor group.
        wrap: rad, angle over which they wrap the femur.
    """

    patellar_ligament: tuple[PointForces, ...]
    contact_point: Array
    contact_normal: Array
    muscles: tuple[str, ...]
    wrap: float = 0.0

    def tension(self, values: Mapping[str, float]) -> float:
        """Return the tension (N) of the extensor group among solved loads; NaN if unsolved."""
        return sum(values.get(muscle_load(name), np.nan) for name in self.muscles)


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
        muscles: one newton of tension on each muscle's line of action.
        coordinates: (6,) knee coordinates of this geometry, m and rad.
        tensions: ligament name -> N.
        share: the other muscles, with their forces, if modelled.
        post: known loads of a cam on the insert's post, if modelled.
        problems: plain words, why the equations cannot be set up; empty when all is well.
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
    """Loads from the equations of one frame; NaN where they are singular.

    Args:
        values: magnitude of each unknown, N or N·m.
        contact_force: (3,) N of the condyles on the femur, insert frame, without residuals.
        external_flexion: N·m, moment that tends to flex, about the femoral ML axis.
        external_adduction: N·m, moment that tends to adduct, about the floating axis.
        sensitivity: N, largest change of the total contact force when the residuals' point
            moves by ±10 mm along y.
        condition: condition number (unit columns).
        lifted: sides that carry nothing.
        slack: the extensor group carries nothing, because it would have to push.
        ambiguous: other load states, too, have no wrong sign.
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
    ambiguous: bool
    problems: tuple[str, ...]


def solve_knee(geometry: KneeGeometry, friction: float) -> SolvedLoads:
    """Return all loads of one frame: those of the load state without a wrong sign.

    If several states have no wrong sign, the one that leaves out fewest loads is taken, and
    `ambiguous` is true. If none has, the frame has no number. See `tkamb.knee.unknowns`.

    Args:
        geometry: the frame.
        friction: Coulomb coefficient of the femorotibial contact.
    """
    off = geometry.lifted
    extensors = geometry.extensor.muscles if geometry.extensor else ()
    first, *others = load_states(geometry.condyles, off, extensors)
    # The state in which everything carries load is tried first; most frames need no other.
    full = KneeSystem(geometry, friction, first)
    condition = full.solution.condition
    if not full.solution.regular:
        return replace(unsolved(("singular equations",)), condition=condition)
    if not wrong_signs(first, full.solution):
        return full.loads()
    # A contact that would pull, or a muscle that would push, carries nothing. All combinations are
    # solved, and the one that contradicts no sign is taken.
    systems = {first: full} | {state: KneeSystem(geometry, friction, state) for state in others}
    solutions = {state: system.solution for state, system in systems.items()}
    wrong = {state: contradictions(state, solutions, off) for state in systems}
    admissible = [system for state, system in systems.items() if not wrong[state]]
    if not admissible:
        reasons = ", ".join(f"{state.label}: {wrong[state][0]}" for state in systems)
        problem = f"no load state has all signs right ({reasons})"
        return replace(unsolved((problem,)), condition=condition)
    # More than one admissible state: the first carries most, and the frame is flagged.
    return replace(admissible[0].loads(), ambiguous=len(admissible) > 1)


def solved_unknowns(geometry: KneeGeometry, loads: SolvedLoads, friction: float) -> list[Unknown]:
    """Return the unknown loads of one frame in the load state that was found.

    Args:
        geometry: the frame.
        loads: what its equations say; without problems.
        friction: Coulomb coefficient of the femorotibial contact.
    """
    extensors = geometry.extensor.muscles if geometry.extensor else ()
    slack = frozenset(extensors if loads.slack else ())
    return KneeSystem(geometry, friction, LoadState(loads.lifted, slack)).unknowns


def unsolved(problems: Iterable[str]) -> SolvedLoads:
    """Return a frame without a number, and why."""
    nan = np.nan
    state = (frozenset[str](), False, False)
    return SolvedLoads({}, np.full(3, nan), nan, nan, nan, nan, *state, tuple(problems))


def dome_sensitivity(
    geometry: KneeGeometry, loads: SolvedLoads, friction: float
) -> tuple[float, float] | None:
    """Return the change of muscle and patellofemoral force as the button sits higher, N/m.

    The patellofemoral force passes through the button's contact with the femur, and muscle and
    patellar ligament are weighed against each other by their arms about that line. Both run
    along the patella, so a button that sits higher or lower on it (the patella's y axis) moves
    the line sideways; a button that sits deeper (x) moves the line along itself and changes little.
    The place of the button is not known to a millimetre.

    The line moves along the patella's y axis with the patella's place kept: with A x = b the
    frame's equations, dx = -A⁻¹ dA x. Measured per millimetre on the shipped knee, from extension
    to 120 deg: Q 1.6 to 5.6 % and PF 1.0 to 4.3 % along y; Q 0.1 to 2.2 % along x. A patella that
    may move to its new equilibrium turns by up to 1 deg per millimetre, which cancels most of the
    change: along y Q then changes by at most 1.6 % and PF by 1.3 % (along x: PF by 7 %, in
    extension). The value returned here is therefore an upper estimate for Q.

    Args:
        geometry: the frame.
        loads: what its equations say.
        friction: Coulomb coefficient of the femorotibial contact.

    Returns:
        Of the extensor group's tension and of the patellofemoral force, zero where it is slack.
        None without an extensor mechanism.
    """
    extensor, state = geometry.extensor, geometry.state
    if extensor is None:
        return None
    if loads.slack:
        return 0.0, 0.0
    bare = replace(geometry, share=None, ligaments=(), post=())  # known loads stay as they are
    system = KneeSystem(bare, friction, LoadState(loads.lifted, frozenset()))
    femur_ml, up = state.pose("femur")[:3, 2], state.pose("patella")[:3, 1]
    at_contact = unknowns.patellofemoral(extensor.contact_point, extensor.contact_normal, femur_ml)
    turns = [
        unknowns.moment_pair("patella", "femur", cross(up, unknown.loads[0].forces[0]))
        for unknown in at_contact
    ]
    magnitudes = np.array([loads.values[unknown.name] for unknown in at_contact])
    changes = system.response((state.generalised(turns) @ magnitudes)[:, None])[:, 0]
    slopes = dict(zip(system.names, changes.tolist(), strict=True))
    return extensor.tension(slopes), slopes["patellofemoral"]


class KneeSystem:
    """The square system of one frame under given assumptions, solved.

    Args:
        geometry: the frame.
        friction: Coulomb coefficient.
        assumed: loads that are assumed to be zero.
    """

    def __init__(self, geometry: KneeGeometry, friction: float, assumed: LoadState) -> None:
        self.geometry, self.friction = geometry, friction
        self.lifted, self.slack = assumed
        state = geometry.state
        hip = unknowns.hip(state.point("hip", np.zeros(3)))
        unknown_forces = self.unknowns = [*hip, *self._extensor(), *self._knee()]
        self.names = [unknown.name for unknown in unknown_forces]
        ground = [geometry.ground] if geometry.ground else []
        # Unit couples about x and z; by them the residual forces are shifted along y in
        # `sensitivity`.
        couples = [unknowns.moment_pair("tibia", "femur", unknowns.AXES[a]) for a in ("ap", "ml")]
        pulls = geometry.share.loads(state) if geometry.share else ()
        given_loads = (*geometry.ligaments, *geometry.post, *pulls)
        groups = [*(unknown.loads for unknown in unknown_forces), *couples, ground, given_loads]
        columns = state.generalised(groups)
        self._columns, self._couples = columns[:, :-4], columns[:, -4:-2]
        # M a - ground reaction: what hip and knee have to supply together.
        self._outside = state.inertial - columns[:, -2]
        # Known loads of the knee (ligaments, post, muscles) change sides of the equation.
        self._right = self._outside - columns[:, -1]
        self.solution = solve(self.names, self._columns, self._right)

    @property
    def carrying(self) -> list[str]:
        """Sides that carry load."""
        return [side for side in self.geometry.condyles if side not in self.lifted]

    def loads(self) -> SolvedLoads:
        """Return the loads of this set."""
        values = self.solution.values
        flexion, adduction = self.external_moments()
        return SolvedLoads(
            values | dict.fromkeys(self._zero_loads(), 0.0),
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
        """Return the change of the unknowns (k, n) per unit of each known load, columns (k, n)."""
        # Unknowns balance the added loads, hence the sign.
        return np.asarray(-np.linalg.solve(self._columns, loads))

    def sensitivity(self) -> float:
        """Return the largest change (N) of the total force as the residuals' point moves.

        A shift s along y adds the couples s y x (x, z) = s (-z, x) to the residual forces.
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

        Hip, ground, gravity and inertia require generalised forces of the knee about its flexion
        and adduction axes; the external moments are their negatives. The knee centre is the femoral
        origin, where the three axes meet.
        """
        hip = self._columns[:, :6]
        # The first six equations are those of the floating base. The knee's internal loads vanish
        # in them, so that they give the hip's six unknowns.
        at_hip = np.linalg.solve(hip[:6], self._outside[:6])
        knee = self._outside - hip @ at_hip
        rows = self.geometry.state.chain.knee_columns()
        return -float(knee[rows[5]]), -float(knee[rows[4]])

    def _zero_loads(self) -> list[str]:
        """Return the loads of the extensor mechanism that are zero, where it is slack."""
        return [*map(muscle_load, self.slack), *PATELLAR] if self.slack else []

    def _extensor(self) -> list[Unknown]:
        extensor, state = self.geometry.extensor, self.geometry.state
        if extensor is None:
            return []
        if self.slack:
            return unknowns.unloaded_patella(extensor.contact_point, state.pose("femur")[:3, 2])
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
