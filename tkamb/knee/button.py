"""The patellar button pressed on the femoral component by a contact model.

Contact models press a rigid femoral component along -y into a body whose flat bottom lies in y = 0.
Here this is the button, whose flat back is fixed to the patella. In the button frame y points from
the back to the articular surface, x is superior and z is to the subject's right. In the patella's
frame (x anterior, y superior, z to the right) these axes are

    x_b = y,    y_b = -x,    z_b = z,

turned further by the few degrees that make the back level. The origin is the middle of the back's
bounding rectangle.

The equations give the patellofemoral force F along the contact normal n, from femur to patella. The
button is pressed along its axis y_b at the patella's pose, until the contact carries the axial
part, -F (n . y_b). The contact is frictionless, and its force across the axis follows from the
surfaces. The sagittal difference to F n is a result (`ButtonPress.imbalance`), as a residual is.

Medial and lateral facet are the parts of the contact on the two sides of the patella's sagittal
plane, in the femoral frame.
"""

import time as clock
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from tkamb.contact.pair import ContactPair
from tkamb.contact.result import CondyleContact, ContactResult, ContactStatus, Guess, WarmStart
from tkamb.errors import InputError
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import Array, inverse, pose, rotate, transform
from tkamb.geometry.repair import repair
from tkamb.geometry.surface import Surface, sharp_edges
from tkamb.geometry.topology import is_closed
from tkamb.knee.contact import KneeContact
from tkamb.units import MILLIMETRE

TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rows: the axes of the button frame in the patella's frame, before the back is made level."""


# m: distance of a loaded point from a sharp edge of the femoral component below which the contact
# is flagged. Chosen: one cell of a usual map.
EDGE_REACH = 1.0 * MILLIMETRE
# m: spacing of the points by which the edges are found. Chosen: half of `EDGE_REACH`.
EDGE_SPACING = 0.5 * MILLIMETRE
# 1: share of the peak pressure above which a point counts as loaded, as `EDGE.share`.
LOADED_SHARE = 0.05
# 1: share of the force below which a facet counts as unloaded, as `AGREEMENT.unloaded_share`.
UNLOADED_SHARE = 0.01
# 1: imbalance of the contact, as a share of the patellofemoral force, above which it is flagged.
# Chosen like `PATELLA_ACROSS`, the share above which a recorded patella is not in equilibrium.
LARGE_IMBALANCE = 0.03
# N: imbalance below which there is no flag. Chosen because it is below the error of any force.
LIGHT_IMBALANCE = 10.0


# m: depth below the flat back from which a part is a peg. Chosen above the noise of flat backs.
PEG = 0.1 * MILLIMETRE


@dataclass(frozen=True, eq=False)
class ButtonPress:
    """The button pressed on the femoral component at one instant, as that of a right knee.

    Args:
        force: patellofemoral force of the equations on the patella, insert frame, (3,), N. Of a
            released patella: the force that its lines require of the contact.
        pose: pose_button_in_insert of the contact, (4, 4).
        contact: the contact in the button frame. "Insert" in the names of `ContactResult` means
            the button. None: there is no contact, see `problem`.
        start: warm start of the next press; None: there is none.
        flags: warnings in words.
        problem: why there is no contact, in words; empty: there is one.
        seconds: computing time of the press, s.
    """

    force: Array
    pose: Array
    contact: ContactResult | None = None
    start: WarmStart | None = None
    flags: tuple[str, ...] = ()
    problem: str = ""
    seconds: float = 0.0

    @property
    def words(self) -> tuple[str, ...]:
        """Flags and problem, for the status of a frame."""
        return (*((self.problem,) if self.problem else ()), *self.flags)

    @property
    def facets(self) -> dict[str, CondyleContact | None]:
        """Side -> contact of that facet; None: the facet is unloaded. Empty without contact."""
        if self.contact is None:
            return {}
        return {"medial": self.contact.medial, "lateral": self.contact.lateral}

    @cached_property
    def on_patella(self) -> Array:
        """(6,) force (N) and moment about the insert's origin (N·m) on the patella, insert frame.

        The femur's is opposite; NaN without contact.
        """
        if self.contact is None:
            return np.full(6, np.nan)
        wrench = self.contact.wrench_on_insert
        force = rotate(self.pose, wrench[:3])
        moment = rotate(self.pose, wrench[3:]) + np.cross(self.pose[:3, 3], force)
        return np.concatenate([force, moment])

    @property
    def centre(self) -> Array:
        """Centre of pressure of both facets, insert frame, (3,), m; NaN without contact."""
        facets = [facet for facet in self.facets.values() if facet is not None]
        if not facets:
            return np.full(3, np.nan)
        places = [facet.centre_of_pressure for facet in facets]
        force = [facet.force for facet in facets]
        return transform(self.pose, np.average(places, axis=0, weights=force))

    @cached_property
    def imbalance(self) -> float:
        """Sagittal part of the contact's force minus the equations' force, N; NaN: no contact.

        The equations have no force along the patella's z axis: the patella stays in its plane.
        """
        apart = self.on_patella[:3] - self.force
        across = self.pose[:3, 2]
        return float(np.linalg.norm(apart - (apart @ across) * across))


class Button:
    """A contact model that is prepared for a button and a femoral component.

    Args:
        contact: contact model, with femoral component and button as its pair (`button_pair`).
        in_patella: pose_button_in_patella, (4, 4).
    """

    def __init__(self, contact: KneeContact, in_patella: Array) -> None:
        self.contact, self.in_patella = contact, in_patella

    @property
    def pair(self) -> ContactPair:
        """Femoral component, and button in the button frame."""
        return self.contact.pair

    def pressed(
        self, femur: Array, patella: Array, force: Array, start: Guess | None = None
    ) -> ButtonPress:
        """Return the button pressed with a patellofemoral force.

        Args:
            femur: pose_femoral_in_insert, (4, 4).
            patella: pose_patella_in_insert, (4, 4).
            force: force on the patella, insert frame, (3,), N.
            start: contact at a neighbouring pose; None: no warm start.
        """
        began, button = clock.perf_counter(), patella @ self.in_patella
        load = -float(force @ button[:3, 1])
        if not np.isfinite(load):
            return ButtonPress(force, button, problem="button: no patellofemoral force")
        if load <= 0.0:
            words = "button: lifted off, the patellofemoral force does not press it on the femur"
            return ButtonPress(force, button, problem=words)
        model, state = self.contact.model, self.contact.state
        result, start = model.press_from(state, load, inverse(button) @ femur, start)
        seconds = clock.perf_counter() - began
        if result.status is not ContactStatus.OK:
            reason = "; ".join((result.status.value.replace("_", " "), *result.flags))
            return ButtonPress(force, button, problem=_of_button(reason), seconds=seconds)
        press = ButtonPress(force, femur @ inverse(result.pose), result, start, seconds=seconds)
        return replace(press, flags=self.flags(press), seconds=clock.perf_counter() - began)

    def flags(self, press: ButtonPress) -> tuple[str, ...]:
        """Return the model's flags, and a button's: unloaded facet, femoral edge, imbalance."""
        assert press.contact is not None
        return (*map(_of_button, press.contact.flags), *self._flags(press))

    def _flags(self, press: ButtonPress) -> Iterator[str]:
        result = press.contact
        assert result is not None
        total = float(np.linalg.norm(result.wrench_on_insert[:3]))
        for side, facet in press.facets.items():
            if facet is None or facet.force < UNLOADED_SHARE * total:
                yield f"button: the {side} facet is unloaded"
        loaded = result.pressure > LOADED_SHARE * result.pressure.max()
        on_femur = transform(inverse(result.pose), result.places[loaded])
        if self._edges is not None:
            nearest = float(self._edges.query(on_femur)[0].min())
            if nearest <= EDGE_REACH:
                yield (
                    "button: the contact reaches an edge of the femoral component (within "
                    f"{EDGE_REACH / MILLIMETRE:g} mm): the button leaves the flange or lies over "
                    "the edge of the notch"
                )
        yield from self.imbalance_flags(press)

    @staticmethod
    def imbalance_flags(press: ButtonPress) -> Iterator[str]:
        """Flag a contact whose force is not the patellofemoral force, if this is known."""
        size = float(np.linalg.norm(press.force))
        if press.imbalance > max(LARGE_IMBALANCE * size, LIGHT_IMBALANCE):
            yield (
                f"button: at the patella's pose the contact's force differs by "
                f"{press.imbalance:.0f} N from the patellofemoral force of {size:.0f} N"
            )

    @cached_property
    def _edges(self) -> cKDTree | None:
        """Points on the component's sharp and open edges; None: it has none."""
        femoral = self.pair.femoral
        face, corner = np.nonzero(sharp_edges(femoral))
        if not len(face):
            return None
        start, end = (femoral.triangles[face, (corner + k) % 3] for k in (1, 2))
        count = np.ceil(np.linalg.norm(end - start, axis=1) / EDGE_SPACING).astype(int) + 1
        edge = np.repeat(np.arange(len(face)), count)
        step = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
        share = (step / np.maximum(count[edge] - 1, 1))[:, None]
        return cKDTree((1.0 - share) * start[edge] + share * end[edge])


def button_in_patella(button: Surface) -> Array:
    """Return pose_button_in_patella (4, 4) of a button in the patella's frame.

    Raises:
        InputError: the button is not closed, or has no flat back.
    """
    if not is_closed(button.faces):
        raise InputError("is not closed", button.name, "close the mesh: its contact is modelled")
    turned = pose(TURN, np.zeros(3))
    try:
        level = insert_placement(button.moved(turned), TURN)
    except InputError as error:
        hint = "the contact of the button needs a flat back that faces anterior (+x)"
        raise InputError(f"{button.name}: {error.what}", "patellofemoral contact", hint) from None
    return inverse(level @ turned)


def without_pegs(body: Surface) -> Surface:
    """Return a button in the button frame without the parts below its flat back.

    Pegs are cemented into the bone, so that they do not deform. Their points move up to y = 0: the
    end of a peg closes the back, and its wall, which has no area there, is removed. A peg that
    grows wider towards its end would cover the back twice; its faces cancel.
    """
    if body.bounds[0, 1] > -PEG:
        return body
    flat = body.vertices * 1.0
    flat[:, 1] = np.maximum(flat[:, 1], 0.0)
    repaired = repair(flat, body.faces)
    return Surface(repaired.vertices, repaired.faces, body.name, merged=True)


def _of_button(words: str) -> str:
    """Return a message of a contact model with the names of the button's parts."""
    for ours, theirs in (("insert", "button"), ("condyle", "facet")):
        words = words.replace(ours, theirs)
    return f"button: {words}"
