"""Released coordinates at rest under muscles that share the load of the knee where it rests.

The muscles' forces move the knee, and where the knee is decides its arms and its contact. Both
are found in turn: forces are shared with contact points and lines as they are, the knee comes to
rest under them, and so on until no force changes by more than `MuscleShare.agrees` allows. At
that place the tension which the sharing gives the extensor group is that of the knee's equations.
"""

import time as clock
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from tkamb.body.crossing import MuscleShare
from tkamb.body.knee import unsolved

if TYPE_CHECKING:
    from tkamb.equilibrium.contact_side import ContactSide
    from tkamb.equilibrium.frame_contact import FrameContact
    from tkamb.equilibrium.mechanics import FrameLoads
    from tkamb.equilibrium.shared_muscles import SharedMuscles

MOST_SHARINGS = 12


def rest_with_muscles(
    side: "ContactSide", muscles: "SharedMuscles", k: int, good: "Sequence[FrameContact]"
) -> "tuple[FrameLoads, FrameContact]":
    """Return body and contact of frame k at rest, muscles and knee in agreement.

    Args:
        side: the contact side, with released coordinates.
        muscles: those that share the load.
        k: frame.
        good: the last two contacts that were found, where the search begins.
    """
    body, contact = _in_turn(side, muscles, k, good)
    if good and contact.result is None:
        # the frames before may have led astray: once more from the recorded pose
        afresh, found = _in_turn(side, muscles, k, [])
        if found.result is not None:
            return afresh, found
    return body, contact


def _in_turn(
    side: "ContactSide", muscles: "SharedMuscles", k: int, good: "Sequence[FrameContact]"
) -> "tuple[FrameLoads, FrameContact]":
    start, friction = clock.perf_counter(), side.mechanics.friction
    share, problem = _first_share(side, muscles, k, good), "muscles and knee do not come to agree"
    for _ in range(MOST_SHARINGS):
        if share.status != "ok":
            problem = f"muscles: {share.status.removeprefix('failed: ')}"
            break
        body, contact = side.rest(k, good, share)
        if body.loads.problems or contact.equilibrium is None:
            return body, contact
        last, share = share, muscles.share(k, body.geometry, friction, body.loads.lifted)
        if last.agrees(share):
            return body, replace(contact, seconds=clock.perf_counter() - start)
        good = [*good[-1:], contact]
    return replace(side.mechanics.frame(k), loads=unsolved([problem])), side.nothing(problem)


def _first_share(
    side: "ContactSide", muscles: "SharedMuscles", k: int, good: "Sequence[FrameContact]"
) -> MuscleShare:
    """Return the muscles' forces with contact where it was in the frame before.

    Without one, or where it makes the equations singular, the knee's forces pass through the
    femoral origin. It is where the search begins, no more.
    """
    mechanics = side.mechanics
    place, condyles = side.case.motion.coordinates[k].copy(), {}
    if good and good[-1].equilibrium and good[-1].result:
        assert side.released is not None
        rows = list(side.released.released)
        place[rows] = good[-1].equilibrium.coordinates[rows]
        condyles = side.resultants(k, place, good[-1].result)
    geometry = mechanics.geometry(k, place)
    if condyles:
        sides = {"medial"} if side.case.split is None else {"medial", "lateral"}
        lost = frozenset(sides - set(condyles))
        touching = replace(geometry, condyles=condyles)
        share = muscles.share(k, touching, mechanics.friction, lost)
        if share.status == "ok":
            return share
    return muscles.share(k, geometry, mechanics.friction, frozenset())
