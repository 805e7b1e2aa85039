"""The equilibrium of a knee's patella in six degrees of freedom (`Knee.patella_equilibrium`)."""

import time as clock
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from tkamb.contact.result import ContactStatus
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import PATELLA_BODY_COORDINATES, Array, inverse, mirrored_pose
from tkamb.knee.button import ButtonPress
from tkamb.knee.canonical import se3
from tkamb.knee.ligaments import ligament_loads
from tkamb.knee.load import LinkPoint, PointForces, link_point, wrenches
from tkamb.knee.muscles import off_femur
from tkamb.knee.patella_body import (
    LARGEST_RESIDUAL,
    PLANE,
    Head,
    PatellaBalance,
    PatellaBody,
    coordinates_of,
    patella_pose,
    released_numbers,
    sides_without_head,
)
from tkamb.knee.pressed import KneePatellaResult, patella_of_user

if TYPE_CHECKING:
    from tkamb.knee.assembled import KneeData
    from tkamb.knee.knee import Knee

WHERE = "patella_equilibrium"


# 1: patellofemoral force over quadriceps' tension with which the first guess is pressed where the
# plane patella gives none. Chosen: that of a slightly bent knee.
LIGHT_PRESS = 0.3


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


@dataclass(frozen=True, eq=False)
class FoundPatella:
    """The patella of a right knee in equilibrium, in the insert frame.

    Args:
        balance: coordinates, residual and stiffness.
        press: contact of the button; None: no equilibrium.
        tensions: ligament at the patella -> tension, N.
        loads: loads of these ligaments on the links.
        flags: warnings in words, without those of the contact.
        problem: why there is no equilibrium, in words; empty: there is one.
    """

    balance: PatellaBalance
    press: ButtonPress | None = None
    tensions: dict[str, float] = field(default_factory=dict)
    loads: tuple[PointForces, ...] = ()
    flags: tuple[str, ...] = ()
    problem: str = ""


def found_patella(
    body: PatellaBody, guesses: Iterable[Callable[[], Array]], numbers: Sequence[int]
) -> FoundPatella:
    """Return the patella in equilibrium from the first guess that leads to one.

    Args:
        body: forces on the patella, with at least one head that pulls.
        guesses: functions that return initial guesses (6,).
        numbers: numbers of the released coordinates.
    """
    tensions = {head.name: head.tension for head in body.heads}
    size, balance = sum(tensions.values()), None
    for guess in guesses:
        balance = body.balance(guess(), numbers, size)
        if not balance.problem:
            break
    assert balance is not None
    insertions = {head.name: head.insertion for head in body.heads}
    flags = [
        f"patella: no head of the quadriceps pulls on the {side} side"
        for side in sides_without_head(insertions, tensions)
    ]
    if balance.problem:
        return FoundPatella(balance, flags=tuple(flags), problem=balance.problem)
    if balance.residual > LARGEST_RESIDUAL * size:
        flags.append(
            f"patella: a residual of {balance.residual:.2g} N remains: the contact's force jumps "
            "there from facet to facet, or its model's solver is no more exact"
        )
    began, button = clock.perf_counter(), body.button
    contact = button.contact.model.evaluate(
        button.contact.state, body.femur_in_button(balance.coordinates)
    )
    problem = "" if contact.status is ContactStatus.OK else contact.reason
    if not problem and not (contact.pressure > 0.0).any():
        problem = "its lines hold it off the femur: the button is not in contact"
    if problem:
        return FoundPatella(balance, flags=tuple(flags), problem=f"patella: {problem}")
    poses = body.poses | {"patella": body.patella(balance.coordinates)}
    press = ButtonPress(np.full(3, np.nan), poses["patella"] @ button.in_patella, contact)
    press = replace(press, flags=button.flags(press), seconds=clock.perf_counter() - began)
    pulls, loads = ligament_loads(body.lines, poses)
    names = [line.name for line in body.lines]
    pulled = dict(zip(names, pulls.tolist(), strict=True))
    return FoundPatella(balance, press, pulled, loads, tuple(flags))


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
    button, numbers = knee.button_contact, released_numbers(released)
    if button is None:
        raise InputError("has no patellofemoral contact model", "Knee", "give it")
    heads = _heads(knee, tensions)
    _check_strands(knee)
    kinematics = knee._kinematics(data, q)
    poses = knee._link_poses(kinematics, None)
    # Each search has its own probe: the warm start of the contact is not part of the result.
    probe, joint = button.contact.probe(), knee.chain.patella_joint_in_femur
    body = PatellaBody(button, probe, joint, heads, knee._others, poses)
    guesses: list[Callable[[], Array]] = []
    last = data.patella_coordinates
    if last is not None and len(numbers) == len(PATELLA_BODY_COORDINATES):
        guesses.append(lambda: last)

    def pressed_plane() -> Array:
        plane = knee._find_patella(kinematics, data)
        ratio = max(plane.patellofemoral_ratio, LIGHT_PRESS)
        force = sum(tensions.values()) * ratio * plane.contact_normal
        return pressed_coordinates(body, plane.coordinates, force)

    found = found_patella(body, [*guesses, pressed_plane], numbers)
    balance = found.balance
    place = joint @ patella_pose(balance.coordinates)
    contact, forces = None, pin.StdVec_Force()
    if found.press is not None:
        data.patella_coordinates = balance.coordinates
        poses |= {"patella": body.patella(balance.coordinates)}
        contact = patella_of_user(found.press, poses, button.in_patella, knee.left)
        links = _link_wrenches(found, heads, poses)
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


def pressed_coordinates(body: PatellaBody, plane: Array, force: Array) -> Array:
    """Return the coordinates (6,) of the plane patella, pressed on the femur: an initial guess.

    Args:
        body: forces on the patella.
        plane: coordinates of the plane patella, shape (3,), m and rad.
        force: patellofemoral force on the patella, insert frame, shape (3,), N.

    Raises:
        ComputationError: the button cannot be pressed there.
    """
    coordinates = np.zeros(6)
    coordinates[list(PLANE)] = plane
    press = body.button.pressed(body.poses["femur"], body.patella(coordinates), force)
    if press.problem:
        raise ComputationError(press.problem, WHERE)
    pressed = coordinates_of(
        inverse(body.poses["femur"] @ body.joint) @ press.pose @ inverse(body.button.in_patella)
    )
    coordinates[list(PLANE)] = pressed[list(PLANE)]
    return coordinates


def _heads(knee: "Knee", tensions: Mapping[str, float]) -> list[Head]:
    """Return the heads of the quadriceps on the chain, with their tensions.

    Raises:
        InputError: a muscle with a tension does not run from the femur to the patella, or no head
            pulls.
    """
    assert knee.extensor_lines is not None and knee.extensor is not None
    main, chain, heads = knee.extensor_lines.muscle, knee.chain, []
    outline = None if main.wrap is None else main.wrap.outline
    points = {main.name: main.points}
    for muscle in knee.muscles:
        if tensions.get(muscle.name, 0.0) > 0.0 or link_point(muscle.points[-1]).link == "patella":
            points[muscle.name] = tuple(
                knee.bridge.link_point(link_point(p)) for p in muscle.points
            )
    for name, path in points.items():
        tension = tensions.get(name, 0.0)
        if name == main.name and tension == 0.0:
            continue
        segment = off_femur(path, chain)
        origin, insertion = path[segment : segment + 2]
        if insertion.link != "patella" or segment + 2 != len(path):
            where = f"muscle {name}"
            raise InputError("does not run from the femur to the patella", where, "set it to 0")
        heads.append(Head(name, _on(chain, origin, "femur"), insertion.position, outline, tension))
    if not any(head.tension > 0.0 for head in heads):
        raise InputError("no head of the quadriceps pulls", WHERE, "give tensions above 0")
    return heads


def _on(chain: Any, point: LinkPoint, link: str) -> Array:
    place = chain.link_in(point.link, link)
    return np.asarray(place[:3, :3] @ point.position + place[:3, 3])


def _check_strands(knee: "Knee") -> None:
    """Raise an InputError unless a ligament joins patella and tibia."""
    if not any({"patella", "tibia"} <= set(line.links) for line in knee._others):
        raise InputError(
            "has no strand of the patellar ligament",
            WHERE,
            "give ligaments from the patella to the tibia in ligaments=",
        )


def _link_wrenches(
    found: FoundPatella, heads: Sequence[Head], poses: Mapping[str, Array]
) -> dict[str, Array]:
    """Return link -> wrench (6,) about the insert's origin of all loads at the patella."""
    assert found.press is not None
    on_patella, loads = found.press.on_patella.copy(), found.loads
    back, femur = inverse(poses["femur"]), poses["femur"]
    for head in heads:
        on_femur = back @ poses["patella"]
        insertion = on_femur[:3, :3] @ head.insertion + on_femur[:3, 3]
        force = -head.tension * (femur[:3, :3] @ head.slopes(insertion)[0])
        place = femur[:3, :3] @ insertion + femur[:3, 3]
        on_patella += np.concatenate([force, np.cross(place, force)])
    links = {"patella": on_patella, "femur": -on_patella}
    for load, wrench in zip(loads, wrenches(loads), strict=True):
        links[load.link] = links.get(load.link, np.zeros(6)) + wrench
    return links
