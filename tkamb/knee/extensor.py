"""The extensor mechanism: its lines of action, and the patella in all frames of a motion."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol, overload

import numpy as np
from scipy.interpolate import PchipInterpolator

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array, inverse, knee_coordinates, transform
from tkamb.geometry.polygons import sagittal_outline
from tkamb.geometry.surface import Surface
from tkamb.knee.chain import Chain
from tkamb.knee.equations import Extensor
from tkamb.knee.load import PointForces, scaled
from tkamb.knee.muscles import Line, Muscle, PatellarLigament, Wrap, muscle_line, off_femur
from tkamb.knee.patella import ExtensorMechanism, PatellaFrame, PatellaState, patella_at
from tkamb.knee.patella_search import solve_patella
from tkamb.knee.patellofemoral import PatellarContact, PatellofemoralContact
from tkamb.knee.unknowns import Unknown, muscle_load
from tkamb.knee.wrapping import TautPath, is_inside
from tkamb.units import DEGREE

Rates = Callable[[Array, Array], tuple[Array, Array, Array]]


@dataclass(frozen=True, eq=False)
class ExtensorParts:
    """The parts of the extensor mechanism of a knee.

    Surfaces are in the frame of their link (femur, patella, insert). Without the insert's surface
    the ligament is straight.
    """

    muscle: Muscle
    ligament: PatellarLigament
    chain: Chain
    femoral: Surface
    button: Surface
    insert: Surface | None


class Posed(Protocol):
    """Poses of the links at one instant."""

    def pose(self, link: str) -> Array:
        """Return pose_link_in_insert (4, 4)."""


class ExtensorLines:
    """Muscle, patella and patellar ligament of a knee, at any pose of the femur.

    Objects with the same surfaces share the `prepared` patellofemoral contact.
    """

    def __init__(self, parts: ExtensorParts) -> None:
        self._parts, self._chain = parts, parts.chain
        self.muscle = muscle_line(parts.muscle, parts.chain, parts.femoral)
        self.ligament = self._ligament_line()
        self._check_fixed_ends()
        self.mechanism, self.prepared = self._build_mechanism()

    def given(
        self, pose: Array, coordinates: Array, contact: PatellarContact | None = None
    ) -> PatellaState:
        """Return the patella at given coordinates (3,) with the femur at a pose (4, 4).

        Without a `contact` there (m and rad) it is computed.
        """
        contact = self.mechanism.contact.at(coordinates) if contact is None else contact
        return patella_at(self.mechanism, pose, coordinates, contact)

    def solved(
        self, pose: Array, guess: PatellaState | None = None, near: Array | None = None
    ) -> PatellaState:
        """Return the patella in equilibrium.

        `guess` is the patella at a similar pose, or else `near` its coordinates (3,), m and rad, as
        initial guess. Without either the search covers all rotations.
        """
        if guess is None or not guess.status.found:
            return solve_patella(self.mechanism, pose, near)
        return solve_patella(self.mechanism, pose, guess.coordinates, guess.slopes)

    def loads(
        self, flexion: float, state: Posed, patella: PatellaState
    ) -> tuple[Extensor, Unknown]:
        """Return the mechanism and its muscle, for the equations of one frame.

        `flexion` (rad) is for messages.

        Raises:
            ComputationError: the patella was not found, or an end of a line lies inside the
                outline that it wraps.
        """
        if not patella.status.found:
            raise ComputationError(
                f"patella lost at {flexion / DEGREE:.1f} deg of flexion: {patella.status.value}"
            )
        muscle, ligament = self.paths(state)
        extensor = Extensor(
            tuple(_on_tibia(load) for load in self.ligament.loads(ligament)),
            patella.contact_point,
            patella.contact_normal,
            (self.muscle.name,),
            muscle.wrap_angle,
        )
        return extensor, Unknown(muscle_load(self.muscle.name), self.muscle.loads(muscle))

    def pull(
        self,
        poses: Mapping[str, Array],
        patella: PatellaState,
        flexion: float,
        tension: float,
        patellar_tension: float | None = None,
    ) -> list[PointForces]:
        """Return the loads of a muscle tension on femur, patella and tibia.

        The patella is massless: the patellofemoral force balances the two tensions (N). Without a
        `patellar_tension` the patella's equilibrium gives it. `poses` (4, 4) are in the insert
        frame; `flexion` (rad) is for messages.

        Raises:
            ComputationError: the patella was not found, or its equilibrium has a force of the wrong
                sign.
        """
        extensor, muscle = self.loads(flexion, _Poses(poses), patella)
        pulls = scaled(muscle.loads, tension)
        if patellar_tension is None:
            if not (patella.ligament_ratio > 0.0 and patella.patellofemoral_ratio > 0.0):
                raise ComputationError(
                    "the contact would have to pull, or the patellar ligament to push", "extensor"
                )
            pulls += scaled(extensor.patellar_ligament, tension * patella.ligament_ratio)
            force = tension * patella.patellofemoral_ratio * patella.contact_normal
        else:
            pulls += scaled(extensor.patellar_ligament, patellar_tension)
            pull = sum(load.forces.sum(axis=0) for load in pulls if load.link == "patella")
            # The contact has no force along the femur's ML axis: the patella stays in its plane.
            across = poses["femur"][:3, 2]
            force = -(pull - (pull @ across) * across)
        point = patella.contact_point[None]
        return [
            *pulls,
            PointForces("patella", point, force[None]),
            PointForces("femur", point, -force[None]),
        ]

    def paths_at(self, poses: Mapping[str, Array]) -> tuple[TautPath, TautPath]:
        """Return the result of `paths` from link -> pose (4, 4) in the insert frame."""
        return self.paths(_Poses(poses))

    def paths(self, state: Posed) -> tuple[TautPath, TautPath]:
        """Return the taut paths of muscle and patellar ligament, in the insert frame.

        Raises:
            ComputationError: an end of a line lies inside the outline that it wraps.
        """
        links = {point.link for line in (self.muscle, self.ligament) for point in line.points}
        poses = {link: state.pose(link) for link in links | {"femur"}} | {"insert": np.eye(4)}
        return self.muscle.path(poses), self.ligament.path(poses)

    def _ligament_line(self) -> Line:
        parts, wrap = self._parts, None
        ligament = parts.ligament
        if ligament.wrap is not None and parts.insert is not None:
            tuberosity = transform(self._tibia_in_insert(), ligament.distal.position)
            outline = ligament.wrap.outline(parts.insert, float(tuberosity[2]))
            wrap = Wrap("insert", outline)
        return Line("patellar_ligament", (ligament.proximal, ligament.distal), wrap)

    def _tibia_in_insert(self) -> Array:
        on_tibia = self._chain.link_in(self._parts.ligament.distal.link, "tibia")
        return inverse(self._chain.insert_in_tibia) @ on_tibia

    def _check_fixed_ends(self) -> None:
        ends, name = [], self.muscle.name
        if self.muscle.wrap is not None:
            last = self.muscle.points[self.muscle.wrap.segment]
            origin = transform(self._chain.link_in(last.link, "femur"), last.position)
            low, high = self._parts.femoral.bounds[:, 2]
            femoral_outline = sagittal_outline(
                [self._parts.femoral], 0.95 * np.linspace(low, high, 15)
            )
            ends.append((f"the origin of {name}", origin, femoral_outline, "femur"))
        if self.ligament.wrap is not None:
            tuberosity = transform(self._tibia_in_insert(), self.ligament.points[1].position)
            outline = self.ligament.wrap.outline
            ends.append(("[patellar_ligament] distal", tuberosity, outline, "insert"))
        for where, point, outline, bone in ends:
            if is_inside(point, outline):
                raise InputError(
                    f"lies inside the outline of the {bone} that the line wraps",
                    where,
                    "move the point, or set wrap = false",
                )

    def _build_mechanism(self) -> tuple[ExtensorMechanism, PatellofemoralContact]:
        parts, chain = self._parts, self._chain
        segment = off_femur(self.muscle.points, chain)
        origin, insertion = self.muscle.points[segment : segment + 2]
        joint, (proximal, distal) = chain.patella_joint_in_femur, self.ligament.points
        prepared = _patellar_contact(parts.femoral, parts.button, joint.tobytes())
        mechanism = ExtensorMechanism(
            prepared.unused(),
            joint,
            transform(chain.link_in(origin.link, "femur"), origin.position),
            transform(chain.link_in(insertion.link, "patella"), insertion.position),
            transform(chain.link_in(proximal.link, "patella"), proximal.position),
            transform(self._tibia_in_insert(), distal.position),
            parts.ligament.length,
            None if self.muscle.wrap is None else self.muscle.wrap.outline,
            None if self.ligament.wrap is None else self.ligament.wrap.outline,
        )
        return mechanism, prepared


class ExtensorFrames:
    """The patella over the frames of a motion.

    Args:
        poses: pose_femur_in_insert, (f, 4, 4).
        recorded: patella coordinates, rates and accelerations, (f, 3, 3); None: the patella
            is solved.
        rates: function of time (n,) and coordinates (n, 3). It returns the filtered coordinates and
            their first and second derivatives.

    Attributes:
        states: the patella at each frame; a recorded patella is evaluated at first use.
    """

    def __init__(
        self, lines: ExtensorLines, time: Array, poses: Array, recorded: Array | None, rates: Rates
    ) -> None:
        self.lines = lines
        self._contacts: _RecordedContacts | None = None
        self._equilibria: dict[int, tuple[PatellaState, float]] = {}
        self.states: Sequence[PatellaState]
        if recorded is not None:
            self._joints = recorded
            self._contacts = _recorded_contacts(lines.prepared, recorded[:, 0].tobytes())
            self.states = _RecordedStates(lines.mechanism, poses, self._contacts)
        else:
            self.states = _solve_all(lines.mechanism, poses)
            self._joints = self._differentiate(time, poses, rates)

    def moved(
        self,
        lines: ExtensorLines,
        poses: Array,
        frames: Sequence[int],
        recorded: Array | None = None,
    ) -> "ExtensorFrames":
        """Return the patella for slightly changed lines or poses of the femur.

        In the given frames the equilibrium is solved again, from the last one. A solved patella
        moves there. A recorded one moves from `recorded` (f, 3), possibly changed coordinates, by
        the change of the equilibrium. It is lost if one of the two equilibria does not exist. The
        rates and all other frames do not change.
        """
        other = copy.copy(self)
        other.lines, other._joints = lines, self._joints.copy()
        if recorded is not None:
            other._joints[:, 0] = recorded
        solutions = {}
        for k in frames:
            state, length = self._equilibrium(k)
            mechanism = replace(lines.mechanism, ligament_length=length)
            solution = solve_patella(mechanism, poses[k], state.coordinates, state.slopes)
            other._joints[k, 0] += solution.coordinates - state.coordinates
            solutions[k] = solution if state.status.found else state
        if recorded is None:
            other.states = [solutions.get(k, state) for k, state in enumerate(self.states)]
            return other
        coordinates = np.ascontiguousarray(other._joints[:, 0])
        lost = {k: state for k, state in solutions.items() if not state.status.found}
        other._contacts = _RecordedContacts(lines.prepared.unused(), coordinates)
        other.states = _RecordedStates(lines.mechanism, poses, other._contacts, lost)
        return other

    def _equilibrium(self, k: int) -> tuple[PatellaState, float]:
        """Return the patella in equilibrium in frame k, and the length of the ligament, m.

        A ligament without a given length has that of the recorded pose.
        """
        mechanism, states = self.lines.mechanism, self.states
        if not isinstance(states, _RecordedStates):
            return states[k], mechanism.ligament_length
        if k not in self._equilibria:
            length = mechanism.ligament_length
            if np.isnan(length):
                length = states.ligament_length(k)
                mechanism = replace(mechanism, ligament_length=length)
            found = solve_patella(mechanism, states.poses[k], self._joints[k, 0])
            self._equilibria[k] = found, length
        return self._equilibria[k]

    def joints(self, k: int) -> Array:
        """Return patella coordinates, rates and accelerations (3, 3) of frame k; NaN if lost."""
        return np.asarray(self._joints[k])

    def at(self, k: int) -> "PatellaOfFrame":
        """Return the patella finder of frame k."""
        return PatellaOfFrame(self, k)

    def patella(self, k: int, pose: Array, guess: PatellaState | None = None) -> PatellaState:
        """Return the patella of frame k with the femur at another pose (4, 4).

        A recorded patella keeps its coordinates; a solved one is solved again, from `guess` or the
        recorded pose.
        """
        mechanism = self.lines.mechanism
        frame_state = self.states[k]
        if self._contacts is not None and not frame_state.status.found:
            return frame_state
        if self._contacts is not None:
            return patella_at(mechanism, pose, self._contacts.coordinates[k], self._contacts[k])
        if guess is not None and frame_state.status.found:
            # If the search from a distant guess fails, the search from the solution at the recorded
            # pose may converge.
            coordinates = guess.coordinates
            solution = solve_patella(mechanism, pose, coordinates, guess.slopes, anywhere=False)
            if solution.status.found:
                return solution
            guess = None
        initial_state = frame_state if guess is None else guess
        return solve_patella(mechanism, pose, initial_state.coordinates, initial_state.slopes)

    def _differentiate(self, time: Array, poses: Array, rates: Rates) -> Array:
        """Return the solved coordinates with their rates (f, 3, 3); NaN: the patella is lost.

        Only rates and accelerations are filtered: at filtered coordinates the button would not
        touch the femur and the moments would not balance. In lost frames, which the filter needs, a
        shape-preserving cubic interpolates. An error of 1 m/s² changes the inertial force of a
        patella of 0.1 kg by 0.1 N.
        """
        coordinates = np.array([state.coordinates for state in self.states])
        solved_frames = np.flatnonzero(np.isfinite(coordinates).all(axis=1))
        if len(solved_frames) < 2:
            flexion = knee_coordinates(poses)[:, KNEE_COORDINATES.index("flexion")] / DEGREE
            raise InputError(
                f"the patella is not found in {len(coordinates) - len(solved_frames)} of "
                f"{len(coordinates)} frames; first: {self.states[0].status.value}",
                "[patella]",
                "check the button's mesh, the points of the lines, length_mm, and angle_unit of "
                "[motion]: "
                f"flexion is read as {flexion.min():.3g} to {flexion.max():.3g} deg",
            )
        span = slice(solved_frames[0], solved_frames[-1] + 1)
        interpolated = PchipInterpolator(time[solved_frames], coordinates[solved_frames])(
            time[span]
        )
        _, velocity, acceleration = rates(time[span], interpolated)
        result = np.full((len(coordinates), 3, 3), np.nan)
        result[span, 1], result[span, 2] = velocity, acceleration
        result[:, 0] = coordinates
        result[np.isnan(coordinates).any(axis=1)] = np.nan
        return result


@dataclass(frozen=True, eq=False)
class PatellaOfFrame:
    """Finds the patella in one frame k of a motion."""

    frames: ExtensorFrames
    k: int

    @property
    def lines(self) -> ExtensorLines:
        """The extensor mechanism."""
        return self.frames.lines

    def patella(self, pose: Array | None = None, guess: PatellaState | None = None) -> PatellaState:
        """Return the patella with the femur at a pose (4, 4); None: at the recorded pose."""
        if pose is None:
            return self.frames.states[self.k]
        return self.frames.patella(self.k, pose, guess)


@lru_cache(maxsize=1)
def _patellar_contact(femoral: Surface, button: Surface, joint: bytes) -> PatellofemoralContact:
    """Return the prepared contact, cached by the surfaces' identity for a scene's samples.

    They are in the frames of the links; `joint` are bytes of pose_joint_in_femur (4, 4).
    """
    joint_in_femur = np.frombuffer(joint).reshape(4, 4)
    return PatellofemoralContact(femoral.moved(inverse(joint_in_femur)), button)


class _RecordedContacts:
    """The patellofemoral contact at recorded coordinates (f, 3), computed at first use.

    `contact` is without stored distances.
    """

    def __init__(self, contact: PatellofemoralContact, coordinates: Array) -> None:
        self.coordinates, self._contact = coordinates, contact
        self._cache: dict[int, PatellarContact] = {}

    def __getitem__(self, k: int) -> PatellarContact:
        if k not in self._cache:
            self._cache[k] = self._contact.at(self.coordinates[k])
        return self._cache[k]


@lru_cache(maxsize=1)
def _recorded_contacts(prepared: PatellofemoralContact, coordinates: bytes) -> _RecordedContacts:
    """Return the contacts at recorded coordinates (bytes), whatever the knee's pose.

    The cache compares the identity of the prepared contact.
    """
    return _RecordedContacts(prepared.unused(), np.frombuffer(coordinates).reshape(-1, 3))


class _RecordedStates(Sequence[PatellaState]):
    """The recorded patella at recorded poses of the femur (f, 4, 4).

    `lost` has the states of frames without a patella.
    """

    def __init__(
        self,
        mechanism: ExtensorMechanism,
        poses: Array,
        contacts: _RecordedContacts,
        lost: Mapping[int, PatellaState] | None = None,
    ) -> None:
        self._mechanism, self.poses, self._contacts = mechanism, poses, contacts
        self._cache = dict(lost or {})

    def ligament_length(self, k: int) -> float:
        frame = PatellaFrame(self._mechanism, self.poses[k])
        coordinates, contact = self._contacts.coordinates[k], self._contacts[k]
        return float(frame.balance_at(coordinates, contact).ligament.length)

    def __len__(self) -> int:
        return len(self.poses)

    @overload
    def __getitem__(self, k: int) -> PatellaState: ...
    @overload
    def __getitem__(self, k: slice) -> list[PatellaState]: ...
    def __getitem__(self, k: int | slice) -> PatellaState | list[PatellaState]:
        if isinstance(k, slice):
            return [self[one] for one in range(len(self))[k]]
        k = range(len(self))[k]
        if k not in self._cache:
            coordinates, contact = self._contacts.coordinates[k], self._contacts[k]
            self._cache[k] = patella_at(self._mechanism, self.poses[k], coordinates, contact)
        return self._cache[k]


def _solve_all(mechanism: ExtensorMechanism, poses: Array) -> list[PatellaState]:
    states: list[PatellaState] = []
    for pose in poses:
        initial_guess = (states[-1].coordinates, states[-1].slopes) if states else ()
        states.append(solve_patella(mechanism, pose, *initial_guess))
    return states


class _Poses:
    def __init__(self, poses: Mapping[str, Array]) -> None:
        self._poses = poses

    def pose(self, link: str) -> Array:
        return self._poses[link]


def _on_tibia(load: PointForces) -> PointForces:
    """Replace the link "insert" by "tibia", to which it is fixed."""
    return replace(load, link="tibia") if load.link == "insert" else load
