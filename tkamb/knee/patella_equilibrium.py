"""The equilibrium of a knee's patella in six degrees of freedom (`Knee.patella_equilibrium`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.result import ContactStatus
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import PATELLA_BODY_COORDINATES, Array, inverse, mirrored_pose
from tkamb.knee.button import ButtonPress
from tkamb.knee.canonical import KneePose, se3
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
    heads, size = _heads(knee, tensions), sum(tensions.values())
    _check_strands(knee)
    kinematics = knee._kinematics(data, q)
    poses = knee._link_poses(kinematics, None)
    joint = knee.chain.patella_joint_in_femur
    # Each search has its own probe: the warm start of the contact is not part of the result.
    body = PatellaBody(button, button.contact.probe(), joint, heads, knee._others, poses)
    found = None
    if data.patella_coordinates is not None and len(numbers) == len(PATELLA_BODY_COORDINATES):
        found = body.balance(data.patella_coordinates, numbers, size)
    if found is None or found.problem:
        found = body.balance(_first_guess(knee, kinematics, data, size), numbers, size)
    flags = [
        f"patella: no head of the quadriceps pulls on the {side} side"
        for side in sides_without_head({head.name: head.insertion for head in heads}, tensions)
    ]
    if found.residual > LARGEST_RESIDUAL * size and not found.problem:
        flags.append(
            f"patella: a residual of {found.residual:.2g} N remains, because the force of the "
            "contact jumps there from facet to facet"
        )
    if found.problem:
        return _result(knee, found, None, {}, [], flags)
    data.patella_coordinates = found.coordinates
    patella = poses["femur"] @ joint @ patella_pose(found.coordinates)
    poses["patella"] = patella
    place = body.femur_in_button(found.coordinates)
    contact = button.contact.model.evaluate(button.contact.state, place)
    press = ButtonPress(np.full(3, np.nan), patella @ button.in_patella, contact)
    press = replace(press, flags=button.flags(press))
    pulls, loads = ligament_loads(knee._others, poses)
    names = [line.name for line in knee._others]
    links = _link_wrenches(press, heads, poses, loads)
    forces = knee.bridge.joint_forces(data.data, links)
    result = patella_of_user(press, poses, button.in_patella, knee.left)
    if contact.status is not ContactStatus.OK:
        found = replace(found, problem=f"patella: {contact.reason}")
        return _result(knee, found, None, {}, [], flags)
    tension = dict(zip(names, pulls.tolist(), strict=True))
    return _result(knee, found, result, tension, forces, [*flags, *press.flags])


def _result(
    knee: "Knee",
    found: PatellaBalance,
    contact: KneePatellaResult | None,
    tensions: dict[str, float],
    forces: Any,
    flags: Sequence[str],
) -> PatellaEquilibrium:
    place = knee.chain.patella_joint_in_femur @ patella_pose(found.coordinates)
    return PatellaEquilibrium(
        dict(zip(PATELLA_BODY_COORDINATES, found.coordinates.tolist(), strict=True)),
        se3(mirrored_pose(place) if knee.left else place),
        contact,
        tensions,
        forces,
        found.residual,
        found.stiffness,
        tuple(flags),
        found.problem,
        found.trials,
    )


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


def _first_guess(knee: "Knee", kinematics: KneePose, data: "KneeData", size: float) -> Array:
    """Return the coordinates (6,) of the plane patella, pressed on the femur.

    Raises:
        ComputationError: the plane patella is lost.
    """
    button = knee.button_contact
    assert button is not None
    plane = knee._find_patella(kinematics, data)
    coordinates = np.zeros(6)
    coordinates[list(PLANE)] = plane.coordinates
    joint = kinematics.pose @ knee.chain.patella_joint_in_femur
    ratio = plane.patellofemoral_ratio
    force = size * (ratio if ratio > LIGHT_PRESS else LIGHT_PRESS) * plane.contact_normal
    press = button.pressed(kinematics.pose, joint @ patella_pose(coordinates), force)
    if press.problem:
        raise ComputationError(press.problem, WHERE)
    pressed = coordinates_of(inverse(joint) @ press.pose @ inverse(button.in_patella))
    coordinates[list(PLANE)] = pressed[list(PLANE)]
    return coordinates


def _link_wrenches(
    press: ButtonPress,
    heads: Sequence[Head],
    poses: Mapping[str, Array],
    loads: Sequence[PointForces],
) -> dict[str, Array]:
    """Return link -> wrench (6,) about the insert's origin of all loads at the patella."""
    on_patella = press.on_patella.copy()
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
