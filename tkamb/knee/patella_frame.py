"""The patella in six degrees of freedom in the frames of a motion.

The equations of a frame give the tension of the quadriceps with the patella in its plane. The heads
share this tension, and `tkamb.knee.patella_body` finds the patella in equilibrium with them. The
equations keep the plane patella: shift and tilt do not change the forces on the knee.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

from tkamb.errors import ComputationError
from tkamb.geometry.frames import PATELLA_BODY_COORDINATES, Array, inverse, transform
from tkamb.knee.button import Button
from tkamb.knee.chain import Chain
from tkamb.knee.ligaments import Ligament
from tkamb.knee.load import LinkPoint
from tkamb.knee.patella_body import PLANE, Head, PatellaBody, coordinates_of, released_numbers
from tkamb.knee.patella_equilibrium import FoundPatella, found_patella, pressed_coordinates

if TYPE_CHECKING:
    from tkamb.knee.equations import KneeGeometry


@dataclass(frozen=True, eq=False)
class HeadShare:
    """A head of the quadriceps with its share of the tension.

    Args:
        name: name of the head.
        origin: point on the femur.
        insertion: point on the patella.
        share: share of the tension of the quadriceps, 1.
    """

    name: str
    origin: LinkPoint
    insertion: LinkPoint
    share: float


@dataclass(frozen=True, eq=False)
class PatellaMethod:
    """How the patella of a knee is found in the frames of a motion.

    Args:
        button: contact of button and femoral component.
        chain: chain of the knee.
        heads: heads of the quadriceps.
        lines: strands of the patellar ligament and retinacula, with slack lengths.
        outline: outline that all heads wrap, in the femur's x-y plane, shape (n, 2), m; None: they
            are straight.
        released: names of the released coordinates.
    """

    button: Button
    chain: Chain
    heads: tuple[HeadShare, ...]
    lines: tuple[Ligament, ...]
    outline: Array | None
    released: tuple[str, ...]

    @cached_property
    def _carried(self) -> tuple[Ligament, ...]:
        """The lines with all points on femur, tibia and patella."""
        placed = {}
        for link in {link for line in self.lines for link in line.links}:
            carrier = self.chain.carrier(link)
            placed[link] = (carrier, self.chain.link_in(link, carrier))
        return tuple(line.on_links(placed) for line in self.lines)

    def _point(self, point: LinkPoint, link: str) -> Array:
        return transform(self.chain.link_in(point.link, link), point.position)

    def at(
        self, geometry: "KneeGeometry", tension: float, force: Array, start: Array | None
    ) -> FoundPatella:
        """Return the patella in equilibrium.

        Args:
            geometry: the frame, with the plane patella.
            tension: tension of the quadriceps, N.
            force: patellofemoral force of the equations on the patella, insert frame, shape (3,),
                N. It presses the plane patella, the initial guess.
            start: coordinates (6,) of the patella in the last frame, the first guess if all are
                released; None: unknown.

        Raises:
            ComputationError: the quadriceps is slack, or the plane patella cannot be pressed.
        """
        if not tension > 0.0:
            raise ComputationError("no tension of the quadriceps pulls it")
        heads = [
            Head(
                head.name,
                self._point(head.origin, "femur"),
                self._point(head.insertion, "patella"),
                self.outline,
                head.share * tension,
            )
            for head in self.heads
        ]
        state, joint = geometry.state, self.chain.patella_joint_in_femur
        poses = {link: state.pose(link) for link in ("femur", "tibia")}
        probe = self.button.contact.probe()
        body = PatellaBody(self.button, probe, joint, heads, self._carried, poses)
        plane = coordinates_of(inverse(poses["femur"] @ joint) @ state.pose("patella"))
        guesses: list[Callable[[], Array]] = []
        # Coordinates that are not released keep the values of this frame's plane patella.
        if start is not None and len(self.released) == len(PATELLA_BODY_COORDINATES):
            guesses.append(lambda: start)
        guesses.append(lambda: pressed_coordinates(body, plane[list(PLANE)], force))
        found = found_patella(body, guesses, released_numbers(self.released))
        if found.press is None:
            return found
        press = replace(found.press, force=force)
        if not {PATELLA_BODY_COORDINATES[k] for k in PLANE} <= set(self.released):
            # The held coordinates of the plane do not let the contact find its force.
            flags = (*press.flags, *self.button.imbalance_flags(press))
            press = replace(press, flags=flags)
        return replace(found, press=press)
