"""The patella's place in the sagittal plane when its motion was not recorded.

Three unknowns per frame, the joint coordinates patella_ap, patella_si and patella_rotation,
and three equations of a massless patella without friction:

    gap to the femoral component = 0
    length of the patellar ligament = its given length
    muscle, ligament and contact force meet in one point (moment balance in the plane)

By virtual work the third says that the muscle's length is stationary among all places
that satisfy the first two; a stable patella sits at a minimum of it. So the search turns
the patella in the direction of the unbalanced moment until that changes sign.
"""

from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq

from tkamb.body.patellofemoral import PatellarContact, PatellofemoralContact
from tkamb.body.wrapping import TautPath, path_in_link
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, inverse, rotate, transform

TOLERANCE = 1e-8
"""m, of gap and ligament length."""

TURN_TOLERANCE = 1e-7
"""rad, of the rotation at which the moment vanishes."""

FARTHEST_AHEAD = 8.0
"""Lengths of a chord that a search looks ahead along it."""

MOST_CHORDS = 10
LEAST_TURN = 1e-5
"""rad: a smaller turn says nothing of the moment's slope."""

FLATTEST = 1e-6
"""Determinant of the contact normal and the ligament's direction: less is one line."""

FIRST_STEP = np.deg2rad(0.5)
NEAR_TURN = np.deg2rad(5.0)
WIDEST_TURN = np.deg2rad(40.0)
"""rad: first step, reach of a quick look, and end of the search about the guess."""

NEAR = 5e-3
"""m: a place found farther from where the button first touched lies behind the femur."""


class PatellaStatus(Enum):
    """How the search ended: found, or which condition of the place was not met."""

    OK = "ok"
    SEVERAL = "several_solutions"
    EDGE = "contact_on_edge_of_femoral_mesh"
    NO_CONTACT = "no contact: the button meets the femoral component at no rotation"
    LINE = "a line's end lies inside what it wraps, or runs along the contact normal"
    GAP = "the gap to the femoral component does not close"
    LIGAMENT = "the patellar ligament's length is not met"
    MOMENT = "moments balance at no rotation that was tried"
    PULL = "the contact would have to pull, or the patellar ligament to push"

    @property
    def found(self) -> bool:
        """Whether there is a place; else the value says which condition failed."""
        return self in (PatellaStatus.OK, PatellaStatus.SEVERAL, PatellaStatus.EDGE)


@dataclass(frozen=True, eq=False)
class PatellaState:
    """The patella at one frame.

    Args:
        coordinates: (3,) patella_ap, patella_si (m), patella_rotation (rad); NaN if not found.
        contact_point: (3,) m, on the line of action, insert frame.
        contact_normal: (3,) unit, out of the femur into the patella, in the femur's sagittal
            plane, insert frame.
        contact_on_patella: (3,) m, the same point in the patella's frame.
        gap: m, positive when apart.
        ligament_ratio: patellar ligament tension per tension of the muscle, massless patella.
        patellofemoral_ratio: patellofemoral force per tension of the muscle, massless patella.
        shift: m along z, the mediolateral shift that is left out of the motion; first order.
        tilt: rad about y, likewise.
        status: how the search ended.
        turning: (3,) change of ap and si (m) and of the moment (m, per unit tension) per rad of
            rotation there, which shortens a search near by; None if not known.
    """

    coordinates: Array
    contact_point: Array
    contact_normal: Array
    contact_on_patella: Array
    gap: float
    ligament_ratio: float
    patellofemoral_ratio: float
    shift: float
    tilt: float
    status: PatellaStatus
    turning: Array | None = None


@dataclass(frozen=True, eq=False)
class ExtensorMechanism:
    """What stays the same over all frames.

    Args:
        contact: button against femoral component, in the patellar joint's frame.
        pose_joint_in_femur: (4, 4), the patellar joint's frame on the femur link.
        muscle_origin: (3,) m, femur link; of the stretch that leaves the femur.
        muscle_insertion: (3,) m, patella link.
        ligament_proximal: (3,) m, patella link.
        ligament_distal: (3,) m, insert frame.
        ligament_length: m.
        femoral_outline: (n, 2) m, in the femur link's x-y plane; None: no wrapping.
        insert_outline: (n, 2) m, in the insert's x-y plane; None: no wrapping.
    """

    contact: PatellofemoralContact
    pose_joint_in_femur: Array
    muscle_origin: Array
    muscle_insertion: Array
    ligament_proximal: Array
    ligament_distal: Array
    ligament_length: float
    femoral_outline: Array | None = None
    insert_outline: Array | None = None


class _Lost(ComputationError):
    """A search that ended without a place: which condition was not met."""

    def __init__(self, status: PatellaStatus) -> None:
        super().__init__(status.value)
        self.status = status


@dataclass(frozen=True, eq=False)
class _Balance:
    """Forces on the patella per unit tension of the muscle, in the joint's frame."""

    coordinates: Array
    contact: PatellarContact
    muscle: TautPath
    ligament: TautPath
    ligament_force: float
    normal_force: float
    moment: float
    turning: Array | None = None


def solve_patella(
    mechanism: ExtensorMechanism,
    pose_femur_in_insert: Array,
    guess: Array | None = None,
    turning: Array | None = None,
) -> PatellaState:
    """Return the patella's place at one frame.

    Args:
        mechanism: points, lengths, outlines and surfaces.
        pose_femur_in_insert: (4, 4) of the femur link.
        guess: (3,) coordinates of the previous frame; None searches all rotations.
        turning: its `turning`, if it has one.

    Returns:
        The state; coordinates and forces are NaN unless status is OK, SEVERAL or EDGE.
    """
    frame = _Frame(mechanism, pose_femur_in_insert)
    found, several = None, False
    if guess is not None and np.isfinite(guess).all():
        try:
            found = frame.follow(guess, turning)
        except ComputationError:
            found = None  # a guess that leads nowhere says nothing: all rotations are searched
    if found is None:
        try:
            found, several = frame.scan()
        except _Lost as lost:
            return _nothing(lost.status)
    if found.normal_force <= 0.0 or found.ligament_force <= 0.0:
        return _nothing(PatellaStatus.PULL)
    status = PatellaStatus.SEVERAL if several else PatellaStatus.OK
    if found.contact.on_edge > 0.5:
        status = PatellaStatus.EDGE
    return frame.state(found, status)


def patella_at(
    mechanism: ExtensorMechanism,
    pose_femur_in_insert: Array,
    coordinates: Array,
    contact: PatellarContact,
) -> PatellaState:
    """Return the state of a patella whose place was recorded; its gap is as recorded.

    Args:
        mechanism: the extensor mechanism.
        pose_femur_in_insert: (4, 4).
        coordinates: (3,) of the patella, m and rad.
        contact: of the button there.
    """
    frame = _Frame(mechanism, pose_femur_in_insert)
    balance = frame.balance_at(np.asarray(coordinates, float), contact)
    edge = balance.contact.on_edge > 0.5
    return frame.state(balance, PatellaStatus.EDGE if edge else PatellaStatus.OK)


class _Closing:
    """Newton's steps that close gap and ligament length in the plane, with Broyden's slopes.

    The contact's unit normal and the ligament's direction are the slopes to begin with. The
    groove's flanks make the gap's up to a fifth less steep, which Broyden's updates learn.
    """

    def __init__(self, ligament_length: float) -> None:
        self._length = ligament_length
        self._slopes: Array = np.eye(2)
        self._step: Array = np.zeros(2)
        self.errors: Array = np.full(2, np.inf)

    @property
    def closed(self) -> bool:
        return bool(np.abs(self.errors).max() < TOLERANCE)

    def step(self, balance: _Balance) -> Array:
        """Return the step (2,) in ap and si from a balance, 5 mm at most."""
        before, stretch = self.errors, balance.ligament.length - self._length
        self.errors = np.array([balance.contact.gap, stretch])
        largest, last = float(np.abs(self.errors).max()), float(np.abs(before).max())
        learns = largest < 0.5 * last < np.inf
        if learns:
            missed = self.errors - before - self._slopes @ self._step
            self._slopes += np.outer(missed, self._step) / (self._step @ self._step)
        if not learns or abs(np.linalg.det(self._slopes)) < FLATTEST:
            normal, direction = balance.contact.normal, balance.ligament.start_direction
            self._slopes = np.stack([normal[:2], -direction[:2]])
        step = np.linalg.solve(self._slopes, -self.errors)
        self._step = np.asarray(step * min(1.0, 5e-3 / max(float(np.linalg.norm(step)), 1e-12)))
        return self._step


class _Frame:
    """The mechanism at one frame, in the patellar joint's frame."""

    def __init__(self, mechanism: ExtensorMechanism, pose_femur_in_insert: Array) -> None:
        self.mechanism = mechanism
        self.in_insert = np.asarray(pose_femur_in_insert, float) @ mechanism.pose_joint_in_femur
        self.insert = inverse(self.in_insert)
        self.femur = inverse(mechanism.pose_joint_in_femur)
        self.origin = transform(self.femur, mechanism.muscle_origin)
        self.tuberosity = transform(self.insert, mechanism.ligament_distal)

    def balance(self, coordinates: Array) -> _Balance:
        """Return the forces with the force balance met and the moment left over (m)."""
        return self.balance_at(coordinates, self.mechanism.contact.at(coordinates))

    def balance_at(self, coordinates: Array, contact: PatellarContact) -> _Balance:
        """Return what `balance` does, with the contact there known already."""
        m = self.mechanism
        here = m.contact.pose(coordinates)
        muscle = path_in_link(
            self.origin, transform(here, m.muscle_insertion), m.femoral_outline, self.femur
        )
        ligament = path_in_link(
            transform(here, m.ligament_proximal), self.tuberosity, m.insert_outline, self.insert
        )
        pull, hold = -muscle.end_direction[:2], ligament.start_direction[:2]
        sides = np.column_stack([hold, contact.normal[:2]])
        if abs(np.linalg.det(sides)) < FLATTEST:
            raise ComputationError("the patellar ligament runs along the contact normal")
        ligament_force, normal_force = np.linalg.solve(sides, -pull)
        moment = (
            _cross(muscle.points[-1], pull)
            + ligament_force * _cross(ligament.points[0], hold)
            + normal_force * _cross(contact.point, contact.normal)
        )
        return _Balance(
            coordinates,
            contact,
            muscle,
            ligament,
            float(ligament_force),
            float(normal_force),
            float(moment),
        )

    def at_rotation(self, start: Array, rotation: float) -> _Balance:
        """Return the balance where gap and ligament length hold at a rotation (Newton, Broyden).

        Raises:
            ComputationError: they do not, or a line cannot run there.
        """
        closing = _Closing(self.mechanism.ligament_length)
        coordinates = np.array([start[0], start[1], rotation])
        for _ in range(40):
            balance = self.balance(coordinates)
            step = closing.step(balance)
            if closing.closed:
                return balance
            coordinates = coordinates + np.append(step, 0.0)
        worst = np.argmax(np.abs(closing.errors))
        raise _Lost((PatellaStatus.GAP, PatellaStatus.LIGAMENT)[worst])

    def follow(self, guess: Array, turning: Array | None = None) -> _Balance:
        """Return the stable balance next to a guess: turn with the moment to its zero.

        Args:
            guess: (3,) coordinates.
            turning: of a place near by; with it the zero is looked for at once.

        Raises:
            ComputationError: there is none within `WIDEST_TURN`.
        """
        if turning is not None:
            way = np.append(turning[:2], 1.0)
            found = self._mended(guess, 0.0, float(turning[2]), way, (-NEAR_TURN, NEAR_TURN))
            if found is not None:
                return found
        here = self.at_rotation(guess, float(guess[2]))
        step = FIRST_STEP
        while abs(here.coordinates[2] - guess[2]) < WIDEST_TURN:
            turn = here.coordinates[2] + np.sign(here.moment) * step
            there = self.at_rotation(here.coordinates, float(turn))
            if there.moment * here.moment <= 0.0:
                return self.between(here, there)
            ahead = self._chord(here, there, FARTHEST_AHEAD)
            if ahead is not None:
                return ahead
            here, step = there, 1.6 * step
        raise _Lost(PatellaStatus.MOMENT)

    def between(self, here: _Balance, there: _Balance) -> _Balance:
        """Return the balance at the zero of the moment between two rotations."""
        found = self._chord(here, there)
        if found is not None:
            return found
        last = here

        def moment(rotation: float) -> float:
            nonlocal last
            last = self.at_rotation(last.coordinates, rotation)
            return last.moment

        ends = (here.coordinates[2], there.coordinates[2])
        brentq(moment, *ends, xtol=TURN_TOLERANCE, rtol=1e-12)
        return last

    def _chord(self, here: _Balance, there: _Balance, reach: float = 1.0) -> _Balance | None:
        """Return the stable balance on the chord of two, at most `reach` times its length away."""
        turn = float(there.coordinates[2] - here.coordinates[2])
        way = (there.coordinates - here.coordinates) / turn
        slope = (there.moment - here.moment) / turn
        if slope >= 0.0:
            return None
        span = (min(0.0, reach * turn), max(0.0, reach * turn))
        return self._mended(here.coordinates, here.moment, slope, way, span)

    def _mended(
        self, start: Array, moment: float, slope: float, way: Array, span: tuple[float, float]
    ) -> _Balance | None:
        """Return the stable balance near a place by mending all three conditions at once.

        Each step closes gap and ligament and turns along a way as far as the moment's slope asks.
        None where that leads out of a span, to an unstable place, or does not end.

        Args:
            start: (3,) coordinates.
            moment: m, the moment there.
            slope: m per rad, of the moment along the way, negative.
            way: (3,) change of the coordinates per rad.
            span: rad, least and greatest rotation from the start.
        """
        closing, turned = _Closing(self.mechanism.ligament_length), 0.0
        coordinates, before = start - moment / slope * way, moment
        for _ in range(MOST_CHORDS):
            balance = self.balance(coordinates)
            if abs(turned) > LEAST_TURN:
                slope = (balance.moment - before) / turned
            if slope >= 0.0:
                return None
            before, turned = balance.moment, -balance.moment / slope
            step = closing.step(balance)
            if closing.closed and abs(turned) < TURN_TOLERANCE:
                return replace(balance, turning=np.append(way[:2], slope))
            coordinates = coordinates + turned * way + np.append(step, 0.0)
            if not span[0] <= coordinates[2] - start[2] <= span[1]:
                return None
        return None

    def scan(self) -> tuple[_Balance, bool]:
        """Return the stable balance with the shortest muscle, and whether there are more.

        Raises:
            _Lost: there is none; with the condition that the nearest miss did not meet.
        """
        flexion = np.arctan2(self.in_insert[1, 0], self.in_insert[0, 0])
        rotations = -0.65 * flexion + np.deg2rad(np.arange(-50.0, 50.1, 10.0))
        places: list[_Balance | None] = []
        misses = []
        for rotation in rotations:
            try:
                places.append(self.first_touch(float(rotation)))
            except ComputationError as error:
                places.append(None)
                misses.append(_condition(error))
        found = []
        for here, there in pairwise(places):
            if here and there and here.moment > 0.0 >= there.moment:
                try:
                    found.append(self.between(here, there))
                except ComputationError as error:
                    misses.append(_condition(error))
        if not found:
            misses += [PatellaStatus.MOMENT] * any(places)
            raise _Lost(max(misses, key=_CONDITIONS.index))
        return min(found, key=lambda b: b.muscle.length), len(found) > 1

    def first_touch(self, rotation: float) -> _Balance:
        """Return the balance at a rotation, the patella swung in on its ligament from in front.

        Raises:
            ComputationError: it touches nothing, or gap or length do not hold where it does.
        """
        m = self.mechanism
        turned = m.contact.pose(np.array([0.0, 0.0, rotation]))
        proximal = transform(turned, m.ligament_proximal)
        radius = np.sqrt(max(m.ligament_length**2 - (proximal[2] - self.tuberosity[2]) ** 2, 1e-8))

        def place(lean: float) -> Array:
            swing = self.insert[:2, :2] @ (radius * np.array([np.sin(lean), np.cos(lean)]))
            return np.append(self.tuberosity[:2] + swing - proximal[:2], rotation)

        leans = np.deg2rad(np.arange(75.0, -75.1, -5.0))
        touching = next((k for k, lean in enumerate(leans) if m.contact.touches(place(lean))), 0)
        if touching == 0:  # never, or from the start
            raise _Lost(PatellaStatus.NO_CONTACT)
        free, deep = leans[touching - 1], leans[touching]
        for _ in range(6):
            middle = 0.5 * (free + deep)
            free, deep = (free, middle) if m.contact.touches(place(middle)) else (middle, deep)
        found = self.at_rotation(place(free), rotation)
        if np.linalg.norm((found.coordinates - place(free))[:2]) > NEAR:
            raise _Lost(PatellaStatus.GAP)
        return found

    def state(self, balance: _Balance, status: PatellaStatus) -> PatellaState:
        """Return the result in the insert frame."""
        contact = balance.contact
        in_patella = inverse(self.mechanism.contact.pose(balance.coordinates))
        return PatellaState(
            balance.coordinates,
            transform(self.in_insert, contact.point),
            rotate(self.in_insert, contact.normal),
            transform(in_patella, contact.point),
            contact.gap,
            balance.ligament_force,
            balance.normal_force,
            contact.shift,
            contact.tilt,
            status,
            balance.turning,
        )


_CONDITIONS = (
    PatellaStatus.NO_CONTACT,
    PatellaStatus.LINE,
    PatellaStatus.LIGAMENT,
    PatellaStatus.GAP,
    PatellaStatus.MOMENT,
)
"""In the order in which a search meets them: the last that any rotation missed is named."""


def _condition(error: ComputationError) -> PatellaStatus:
    """Return the condition that a search missed; errors of the lines have no status."""
    return error.status if isinstance(error, _Lost) else PatellaStatus.LINE


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _nothing(status: PatellaStatus) -> PatellaState:
    nan, none = float("nan"), np.full(3, np.nan)
    return PatellaState(none, none, none, none, nan, nan, nan, nan, nan, status)
