"""The equilibrium of the patella in six degrees of freedom, from initial guesses to a contact."""

import time as clock
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tkamb.contact.result import ContactStatus
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, inverse, rotate
from tkamb.knee.button import ButtonPress
from tkamb.knee.ligaments import ligament_loads
from tkamb.knee.load import PointForces
from tkamb.knee.patella_body import (
    LARGEST_RESIDUAL,
    PLANE,
    PatellaBalance,
    PatellaBody,
    coordinates_of,
    sides_without_head,
)

# 1: patellofemoral force over quadriceps' tension with which the first guess is pressed where the
# plane patella gives none. Chosen: that of a slightly bent knee.
LIGHT_PRESS = 0.3


@dataclass(frozen=True, eq=False)
class FoundPatella:
    """The patella of a right knee in equilibrium, in the insert frame.

    Args:
        balance: coordinates, residual and stiffness.
        press: contact of the button; None: no equilibrium.
        tensions: ligament at the patella -> tension, N.
        loads: loads of these ligaments on the links.
        poses: link -> pose (4, 4) in the insert frame of femur, tibia and patella.
        flags: warnings in words, without those of the contact.
        problem: why there is no equilibrium, in words; empty: there is one.
    """

    balance: PatellaBalance
    press: ButtonPress | None = None
    tensions: dict[str, float] = field(default_factory=dict)
    loads: tuple[PointForces, ...] = ()
    poses: dict[str, Array] = field(default_factory=dict)
    flags: tuple[str, ...] = ()
    problem: str = ""


def found_patella(
    body: PatellaBody, guesses: Iterable[Callable[[], Array]], numbers: Sequence[int]
) -> FoundPatella:
    """Return the patella in equilibrium from the first guess that leads to one.

    The arguments are those of `first_balance`.
    """
    return complete_patella(body, first_balance(body, guesses, numbers))


def first_balance(
    body: PatellaBody,
    guesses: Iterable[Callable[[], Array]],
    numbers: Sequence[int],
    near: bool = False,
) -> PatellaBalance:
    """Return the equilibrium from the first guess that leads to one.

    Args:
        body: forces on the patella, with at least one head that pulls.
        guesses: functions that return initial guesses (6,).
        numbers: numbers of the released coordinates.
        near: whether the first guess is an equilibrium at nearly the same forces.
    """
    size, balance = sum(head.tension for head in body.heads), None
    for guess in guesses:
        balance = body.balance(guess(), numbers, size, near)
        near = False
        if not balance.problem:
            break
    assert balance is not None
    return balance


def complete_patella(body: PatellaBody, balance: PatellaBalance) -> FoundPatella:
    """Return the patella of an equilibrium with contact, tensions and flags."""
    tensions = {head.name: head.tension for head in body.heads}
    size = sum(tensions.values())
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
    place = poses["patella"] @ button.in_patella
    # The contact carries this force, except on coordinates that are not released.
    press = ButtonPress(-rotate(place, body.pull(balance.coordinates)[:3]), place, contact)
    press = replace(press, flags=button.flags(press), seconds=clock.perf_counter() - began)
    pulls, loads = ligament_loads(body.lines, poses)
    names = [line.name for line in body.lines]
    pulled = dict(zip(names, pulls.tolist(), strict=True))
    return FoundPatella(balance, press, pulled, loads, poses, tuple(flags))


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
        raise ComputationError(press.problem, "patella")
    pressed = coordinates_of(
        inverse(body.poses["femur"] @ body.joint) @ press.pose @ inverse(body.button.in_patella)
    )
    coordinates[list(PLANE)] = pressed[list(PLANE)]
    return coordinates
