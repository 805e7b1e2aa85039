"""The released patella of a knee on a user's model: its heads, forces and derivatives."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import pinocchio as pin

from tkamb.errors import ComputationError, InputError, real_number
from tkamb.geometry.frames import (
    PATELLA_BODY_COORDINATES,
    Array,
    cross_matrix,
    mirrored_pose,
    transform,
)
from tkamb.knee.canonical import KneePose, force_cross, se3
from tkamb.knee.found_patella import (
    LIGHT_PRESS,
    FoundPatella,
    first_balance,
    found_patella,
    pressed_coordinates,
)
from tkamb.knee.ligaments import DISTAL, PROXIMAL, BundleArrays
from tkamb.knee.load import LinkPoint, link_point, wrench_of, wrenches
from tkamb.knee.muscles import off_femur
from tkamb.knee.patella_body import PatellaBody, patella_pose, released_numbers
from tkamb.knee.patella_frame import HeadShare, PatellaMethod, tibial_wrench
from tkamb.knee.pressed import KneePatellaResult, patella_of_user

if TYPE_CHECKING:
    from tkamb.knee.assembled import AssembledKnee, KneeData
    from tkamb.knee.knee import Knee

WHERE = "patella_equilibrium"


@dataclass(frozen=True, eq=False)
class PatellaEquilibrium:
    """Result of `Knee.patella_equilibrium`.

    Args:
        coordinates: name in `PATELLA_BODY_COORDINATES` -> value, m and rad
            (`tkamb.knee.patella_body`).
        pose: `pin.SE3`, pose of the frame "patella" in the frame "femoral".
        contact: contact of the button; None: no equilibrium.
        tensions: ligament at the patella -> tension, N; strands and retinacula.
        forces: `pin.StdVec_Force` of quadriceps, ligaments at the patella and contact, one per
            joint in its joint's frame, as `Knee.external_forces`; empty: no equilibrium.
        residual: largest residual force on a released coordinate, N (moments over 15 mm).
        stiffness: stiffness of the n released coordinates, shape (n, n), N/m (rotations times
            15 mm).
        flags: warnings in words.
        reason: why there is no equilibrium, in words; empty: there is one.
        trials: number of evaluations of the forces.
    """

    coordinates: dict[str, float]
    pose: Any
    contact: KneePatellaResult | None
    tensions: dict[str, float]
    forces: Any
    residual: float
    stiffness: Array
    flags: tuple[str, ...]
    reason: str
    trials: int

    @property
    def failed(self) -> bool:
        """Whether there is no equilibrium."""
        return bool(self.reason)


def find_equilibrium(
    knee: "Knee",
    q: Array,
    tensions: Mapping[str, float],
    released: Sequence[str],
    data: "KneeData",
) -> PatellaEquilibrium:
    """Return the result of `Knee.patella_equilibrium`.

    Raises:
        InputError: see there.
        ComputationError: see there.
    """
    body, found = find_at(knee, knee._kinematics(data, q), tensions, released, data)
    balance, button = found.balance, body.button
    place = body.joint @ patella_pose(balance.coordinates)
    contact, forces = None, pin.StdVec_Force()
    if found.press is not None:
        contact = patella_of_user(found.press, found.poses, button.in_patella, knee.left)
        links = _link_wrenches(found, body)
        forces = knee.bridge.joint_forces(data.data, links)
    return PatellaEquilibrium(
        dict(zip(PATELLA_BODY_COORDINATES, balance.coordinates.tolist(), strict=True)),
        se3(mirrored_pose(place) if knee.left else place),
        contact,
        found.tensions,
        forces,
        balance.residual,
        balance.stiffness,
        (*found.flags, *(found.press.flags if found.press else ())),
        found.problem,
        balance.trials,
    )


def find_at(
    knee: "Knee",
    kinematics: "KneePose",
    tensions: Mapping[str, float],
    released: Sequence[str],
    data: "KneeData",
    bones: Mapping[str, Array] | None = None,
) -> tuple[PatellaBody, FoundPatella]:
    """Return the forces on the patella at a pose of the knee, and its equilibrium.

    `bones` is that of `PatellaMethod.body_of_heads`, the other arguments and the errors are those
    of `Knee.patella_equilibrium`.
    """
    numbers = released_numbers(released)
    body, guesses = _search(knee, kinematics, tensions, len(numbers) == 6, data, bones)
    found = found_patella(body, guesses, numbers)
    if found.press is not None:
        data.patella_coordinates = found.balance.coordinates
    return body, found


def _search(
    knee: "Knee",
    kinematics: "KneePose",
    tensions: Mapping[str, float],
    warm: bool,
    data: "KneeData",
    bones: Mapping[str, Array] | None = None,
) -> tuple[PatellaBody, list[Callable[[], Array]]]:
    """Return the forces on the patella at the pose of q, and functions that return initial guesses.

    Args:
        tensions: head -> tension, N.
        warm: whether the last equilibrium is the first guess.

    Raises:
        InputError: the knee has no patellofemoral contact model or no strand, another muscle has a
            tension, or no head pulls.
    """
    button, poses = knee.button_contact, knee._link_poses(kinematics, None)
    if button is None:
        raise InputError("has no patellofemoral contact model", "Knee", "give it")
    method = knee.patella
    if method is None:
        method = patella_method(knee, None, PATELLA_BODY_COORDINATES)
    _check_pull(method, tensions)
    # Each search has its own probe: the warm start of the contact is not part of the result.
    body = method.body_of_heads(poses, tensions, bones=bones)
    guesses: list[Callable[[], Array]] = []
    last = data.patella_coordinates
    if last is not None and warm:
        guesses.append(lambda: last)

    def pressed_plane() -> Array:
        plane = knee._find_patella(kinematics, data)
        ratio = max(plane.patellofemoral_ratio, LIGHT_PRESS)
        force = sum(tensions.values()) * ratio * plane.contact_normal
        return pressed_coordinates(body, plane.coordinates, force)

    return body, [*guesses, pressed_plane]


def _check_pull(method: PatellaMethod, tensions: Mapping[str, float]) -> None:
    """Raise an InputError unless heads pull, no other muscle does, and there is a strand."""
    names = {head.name for head in method.heads}
    for name, tension in tensions.items():
        if tension > 0.0 and name not in names:
            where = f"muscle {name}"
            raise InputError("does not run from the femur to the patella", where, "set it to 0")
    if not any(tension > 0.0 for tension in tensions.values()):
        raise InputError("no head of the quadriceps pulls", WHERE, "give tensions above 0")
    _check_strands(method)


def _check_strands(method: PatellaMethod) -> None:
    """Raise an InputError unless a ligament joins patella and tibia."""
    if not any({"patella", "tibia"} <= set(line.links) for line in method.lines):
        raise InputError(
            "has no strand of the patellar ligament",
            WHERE,
            "give ligaments from the patella to the tibia in ligaments=",
        )


def patella_method(
    knee: "AssembledKnee", shares: Mapping[str, float] | None, released: Sequence[str]
) -> PatellaMethod:
    """Return how the patella of a knee is found, with its ligaments that end on the patella.

    Args:
        knee: a knee with a patellofemoral contact model.
        shares: head -> share of the quadriceps' tension; None: not known, tensions are given.
        released: names of the released coordinates.

    Raises:
        InputError: a share is not that of a head, or the shares do not sum to 1.
    """
    lines, button = knee.extensor_lines, knee.button_contact
    assert lines is not None and button is not None
    main, ends = lines.muscle, _head_ends(knee)
    outline = None if main.wrap is None else main.wrap.outline
    for name, share in (shares or {}).items():
        if name not in ends:
            hint = f"heads of the quadriceps: {', '.join(ends)}"
            raise InputError(f"no head '{name}'", "head_shares", hint)
        if not 0.0 <= real_number(share, f"head_shares: {name}", "give 0 to 1") <= 1.0:
            raise InputError(f"share {share} of '{name}'", "head_shares", "give 0 to 1")
    if shares is not None and abs(sum(shares.values()) - 1.0) > 1e-6:
        raise InputError("the shares do not sum to 1", "head_shares")
    # A muscle on the patella pulls it also without a share. With shares, the name of a quadriceps
    # that has none is that of the whole.
    shared = shares or {}
    heads = tuple(
        HeadShare(name, *end, shared.get(name, 0.0))
        for name, end in ends.items()
        if shares is None or name in shared or name != main.name
    )
    return PatellaMethod(button, knee.chain, heads, knee._others, outline, tuple(released))


def released_method(
    knee: "AssembledKnee", released: Sequence[str], shares: Mapping[str, float] | None
) -> PatellaMethod:
    """Return how the patella of a knee with `released_patella` is found.

    Args:
        knee: the knee.
        released: names of the released coordinates.
        shares: head -> share of the quadriceps' tension; None: the quadriceps is the only head.

    Raises:
        InputError: the knee has no patellofemoral contact model or no strand; a name is unknown;
            ap, si or flexion is missing; or the shares do not fit.
    """
    released_numbers(released)
    if not {"ap", "si", "flexion"} <= set(released):
        words = "needs ap, si and flexion: the quadriceps moves them"
        raise InputError(words, "released_patella")
    if knee.button_contact is None or knee.extensor is None:
        raise InputError("needs patellofemoral_contact=", "released_patella", "give it to the knee")
    shares = {knee.extensor.quadriceps.name: 1.0} if shares is None else shares
    method = patella_method(knee, shares, released)
    _check_strands(method)
    heads = {head.name for head in method.heads}
    for muscle in knee.muscles:
        links = [link_point(point).link for point in muscle.points]
        if muscle.name not in heads and any(_is_on_patella(knee, link) for link in links):
            raise InputError(
                "touches the patella, but does not run from the femur to it",
                f"muscle {muscle.name}",
                "the released patella would not feel it",
            )
    return method


def _is_on_patella(knee: "AssembledKnee", frame: str) -> bool:
    """Return whether a frame of the user's model is fixed to the patella."""
    patella = knee.anatomy.patella
    if patella is None:
        return frame == "patella"
    return bool(knee.anatomy.frame(frame).joint == patella.joint)


def _head_ends(knee: "AssembledKnee") -> dict[str, tuple[LinkPoint, LinkPoint]]:
    """Return head -> last point on the femur, and insertion on the patella, links of the chain."""
    assert knee.extensor_lines is not None
    main, ends = knee.extensor_lines.muscle, {}
    points = {main.name: main.points}
    for muscle in knee.muscles:
        if _is_on_patella(knee, link_point(muscle.points[-1]).link):
            points[muscle.name] = tuple(
                knee.bridge.link_point(link_point(p)) for p in muscle.points
            )
    for name, path in points.items():
        segment = off_femur(path, knee.chain)
        origin, insertion = path[segment : segment + 2]
        if insertion.link == "patella" and segment + 2 == len(path):
            place = transform(knee.chain.link_in(origin.link, "femur"), origin.position)
            ends[name] = LinkPoint("femur", place), insertion
    return ends


def _link_wrenches(found: FoundPatella, body: PatellaBody) -> dict[str, Array]:
    """Return link -> wrench (6,) about the insert's origin of all loads at the patella."""
    assert found.press is not None
    loads = found.loads
    heads = wrench_of(*body.head_forces(found.balance.coordinates)).sum(axis=0)
    on_patella = found.press.on_patella + heads
    links = {"patella": on_patella, "femur": -on_patella}
    for load, wrench in zip(loads, wrenches(loads), strict=True):
        links[load.link] = links.get(load.link, np.zeros(6)) + wrench
    return links


def pulled_tibia(
    knee: "Knee", kinematics: KneePose, tensions: Mapping[str, float], data: "KneeData"
) -> tuple[Array, PatellaBody, Array]:
    """Return the wrench (6,) of a released patella on the tibia, about the insert's origin.

    The wrench on the femur is opposite.

    Args:
        knee: a knee with a released patella.
        kinematics: pose of the knee.
        tensions: head -> tension, N.
        data: data of the knee.

    Returns:
        Wrench; forces on the patella; its coordinates (6,).

    Raises:
        ComputationError: there is no equilibrium.
    """
    method = knee.patella
    assert method is not None
    body, guesses = _search(knee, kinematics, tensions, True, data)
    balance = first_balance(body, guesses, released_numbers(method.released))
    if balance.problem:
        raise ComputationError(balance.problem.removeprefix("patella: "), "patella")
    data.patella_coordinates = balance.coordinates
    return tibial_wrench(body, balance.coordinates), body, balance.coordinates


@dataclass(frozen=True, eq=False)
class PulledTibiaSlopes:
    """Derivatives of the wrench w of a released patella on the tibia, about the insert's origin.

    A displacement xi of the femur against the insert carries the patella along, and the patella
    moves by dc to its new equilibrium. Parameters of its lines change w by dw_p and the generalised
    forces by dg_p at a fixed patella. With the stiffness K of the patella, and K_t of the ligaments
    to the tibia about the insert's origin,

        dw = K_t (xi + A dc) + dw_p,    K dc = A^T (xi x* w - K_t xi) + dg_p,

    where A dc is the displacement of the patella, and xi x* w turns w with the femur.

    Args:
        body: forces on the patella.
        coordinates: its coordinates in equilibrium, shape (6,).
        rows: numbers of the n released coordinates.
        wrench: w, shape (6,).
        tangent: K_t, shape (6, 6).
        moves: A, shape (6, n).
        response: K_t A K^-1, shape (6, n).
    """

    body: PatellaBody
    coordinates: Array
    rows: tuple[int, ...]
    wrench: Array
    tangent: Array
    moves: Array
    response: Array

    @classmethod
    def of(cls, body: PatellaBody, coordinates: Array, released: Sequence[str]) -> Self:
        """Return the derivatives at an equilibrium.

        Args:
            body: forces on the patella.
            coordinates: its coordinates in equilibrium, shape (6,).
            released: names of the n released coordinates.

        Raises:
            InputError: a ligament from patella to tibia wraps the femur, or the contact model of
                the button has no exact tangent.
        """
        if any({"femur", "tibia"} <= set(line.links) for line in body.lines):
            where = "derivatives"
            raise InputError("a ligament from patella to tibia wraps the femur", where)
        rows = released_numbers(released)
        patella = body.patella(coordinates)
        button = patella @ body.button.in_patella
        placed = {"patella": (PROXIMAL, np.eye(4)), "tibia": (DISTAL, body.poses["tibia"])}
        shank = [line.on_links(placed) for line in body.lines if "tibia" in line.links]
        lines = BundleArrays.between(shank)
        tangent, wrench = lines.tangent(patella), lines.wrench(patella)
        turn = button[:3, :3]
        to_insert = np.block([[turn, cross_matrix(button[:3, 3]) @ turn], [np.zeros((3, 3)), turn]])
        moves = to_insert @ body.twists(coordinates)[:, list(rows)]
        stiffness = body.exact_stiffness(coordinates, rows)
        response = tangent @ moves @ np.linalg.inv(stiffness)
        return cls(body, coordinates, rows, wrench, tangent, moves, response)

    def by_displacement(self) -> Array:
        """Return the derivative (6, 6) by a displacement of the femur."""
        forces = self.moves.T @ (force_cross(np.eye(6), self.wrench) - self.tangent)
        return np.asarray(self.tangent + self.response @ forces)

    def between(self, ahead: PatellaBody, behind: PatellaBody) -> Array:
        """Return the change (6,) from one to another near body, whose heads and lines differ."""
        at = self.coordinates
        twists = self.body.twists(at)[:, list(self.rows)]
        forces = twists.T @ (ahead.pull(at) - behind.pull(at))
        change = tibial_wrench(ahead, at) - tibial_wrench(behind, at)
        return np.asarray(change + self.response @ forces)
