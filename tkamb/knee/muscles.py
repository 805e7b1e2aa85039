"""Muscles, tendons and their paths: points on links, what they wrap, strength, given tensions.

A line of action is a massless string through points of the links, perhaps around the outline
of one of them. A unit tension on it, with the reactions of what it passes, is one column of the
equations of motion. Its moment arm about any coordinate q of the chain is then -dL/dq.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from tkamb.errors import ComputationError, InputError, names_near
from tkamb.geometry.frames import Array, cross, transform
from tkamb.geometry.polygons import sagittal_outline
from tkamb.knee.anatomy import Anatomy, Place
from tkamb.knee.load import LinkPoint, PointForces, link_point

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface
    from tkamb.knee.chain import Chain
    from tkamb.knee.wrapping import TautPath


@dataclass(frozen=True)
class MuscleBandSettings:
    """A muscle as a band around the femur."""

    sections: int = 7
    """Sagittal planes across the band whose sections are wrapped. Chosen: more sections change the
    lines by little."""


MUSCLE_BAND = MuscleBandSettings()


@dataclass(frozen=True, eq=False)
class SagittalWrap:
    """How a line wraps an implant part: in front of its sagittal outline.

    Args:
        band: m, half the width of the sections, about the line's own sagittal plane.
        half_thickness: m, of the tendon, off the outline.
        bone: wrapped beside the part, in the frame of the link that carries it.
    """

    band: float
    half_thickness: float
    bone: "Surface | None" = None

    def outline(self, part: "Surface", middle: float, below: float = np.inf) -> Array:
        """Return the convex outline (n, 2) m of the part and the bone, grown by the tendon.

        Args:
            part: in the frame whose x-y plane holds the outline.
            middle: m, z of the line's own sagittal plane there.
            below: m, what lies above this y is left out.
        """
        surfaces = [part] if self.bone is None else [part, self.bone]
        planes = middle + np.linspace(-self.band, self.band, MUSCLE_BAND.sections)
        return sagittal_outline(surfaces, planes, self.half_thickness, below=below)


@dataclass(frozen=True, eq=False)
class Muscle:
    """A muscle as the scene gives it.

    Args:
        name: of the muscle.
        points: its path from origin to insertion, at least two.
        wrap: how its stretch off the femur wraps the femoral component; None: straight.
        strength: N, maximal isometric force; NaN where none is given.
        group: of muscles that are shown together; empty: its own.
    """

    name: str
    points: tuple[LinkPoint, ...]
    wrap: SagittalWrap | None = None
    strength: float = float("nan")
    group: str = ""


@dataclass(frozen=True, eq=False)
class PatellarLigament:
    """The patellar ligament: one line from the patella to the tibial tuberosity.

    Args:
        proximal: on the patella.
        distal: on the tibia.
        wrap: how it wraps the insert's front lip; None: straight.
        length: m, where the patella's motion is to be found; else NaN.
    """

    proximal: LinkPoint
    distal: LinkPoint
    wrap: SagittalWrap | None = None
    length: float = float("nan")


@dataclass(frozen=True, eq=False)
class Wrap:
    """An outline that one stretch of a line passes in front of.

    Args:
        link: to which the outline is fixed; it takes the reaction.
        outline: (n, 2) m, convex, in the link's x-y plane.
        stretch: which: 0 is that from the first point to the second.
    """

    link: str
    outline: Array
    stretch: int = 0


@dataclass(frozen=True, eq=False)
class Line:
    """A line of action: a string through points of the links.

    Args:
        name: of the muscle or ligament, for messages.
        points: from the proximal end to the distal one, at least two.
        wrap: what it wraps; None: straight from point to point.
    """

    name: str
    points: tuple[LinkPoint, ...]
    wrap: Wrap | None = None

    def path(self, poses: Mapping[str, Array]) -> "TautPath":
        """Return the taut path in the insert frame, at one frame of the motion.

        Args:
            poses: link -> pose_link_in_insert (4, 4).

        Raises:
            ComputationError: an end of the wrapped stretch lies inside the outline.
        """
        from tkamb.knee.wrapping import TautPath, path_in_link  # imports numba

        places = [transform(poses[point.link], point.position) for point in self.points]
        stretches = []
        for i, (start, end) in enumerate(pairwise(places)):
            wrapped = self.wrap if self.wrap and self.wrap.stretch == i else None
            outline, link = (wrapped.outline, wrapped.link) if wrapped else (None, None)
            pose = np.eye(4) if link is None else np.asarray(poses[link], float)
            try:
                stretches.append(path_in_link(start, end, outline, pose))
            except ComputationError as error:
                raise ComputationError(error.what, self.name) from None
        if len(stretches) == 1:
            return stretches[0]
        points = [stretches[0].points, *(stretch.points[1:] for stretch in stretches[1:])]
        return TautPath(
            np.concatenate(points),
            sum(stretch.length for stretch in stretches),
            sum(stretch.wrap_angle for stretch in stretches),
        )

    def loads(self, path: "TautPath") -> tuple[PointForces, ...]:
        """Return the forces of a unit tension on the links: zero force and moment in sum.

        Both ends are pulled along the path; every point between, and every corner of the
        outline, is pressed by the change of direction there. The ends come first.
        """
        links = [point.link for point in self.points]
        if self.wrap:
            at = self.wrap.stretch + 1
            links[at:at] = [self.wrap.link] * (len(path.points) - len(links))
        along = path.directions
        forces = np.concatenate([along[:1], np.diff(along, axis=0), -along[-1:]])
        inner = np.array(links[1:-1])
        return (
            PointForces(links[0], path.points[:1], forces[:1]),
            PointForces(links[-1], path.points[-1:], forces[-1:]),
            *(
                PointForces(link, path.points[1:-1][inner == link], forces[1:-1][inner == link])
                for link in dict.fromkeys(links[1:-1])
            ),
        )


def off_femur(points: Sequence[LinkPoint], chain: "Chain") -> int:
    """Return the index of the stretch that leaves the femur.

    Raises:
        InputError: none does.
    """
    carriers = [chain.carrier(point.link) for point in points]
    for i, (one, other) in enumerate(pairwise(carriers)):
        if one == "femur" != other:
            return i
    raise InputError("no stretch of the path leaves the femur", None, "check its points' links")


def muscle_line(muscle: Muscle, chain: "Chain", femoral: "Surface") -> Line:
    """Return a muscle's line of action; it wraps the femoral component in the patella's plane.

    Args:
        muscle: the muscle.
        chain: the patient.
        femoral: femoral component in the femur link's frame.
    """
    if muscle.wrap is None:
        return Line(muscle.name, muscle.points)
    stretch = off_femur(muscle.points, chain)
    last = muscle.points[stretch]
    outline = muscle.wrap.outline(
        femoral,
        float(chain.patella_joint_in_femur[2, 3]),
        below=float(transform(chain.link_in(last.link, "femur"), last.position)[1]),
    )
    return Line(muscle.name, muscle.points, Wrap("femur", outline, stretch))


def check_muscles(muscles: Sequence[Muscle], chain: "Chain") -> None:
    """Raise unless one muscle alone crosses the knee, from the femur to the patella.

    Then the equations of a frame are square. More of them share the joint moments in a way
    that equilibrium does not determine.

    Raises:
        InputError: several muscles, one that crosses no joint, or one that inserts elsewhere.
    """
    for muscle in muscles:
        if len({chain.carrier(point.link) for point in muscle.points}) == 1:
            where = f"[[muscle]] {muscle.name}"
            raise InputError("crosses no joint of the model", where, "check its points' links")
    if len(muscles) > 1:
        raise InputError(
            f"{len(muscles)} muscles cross the knee ({', '.join(m.name for m in muscles)}): "
            "[[muscle]] tables cannot share the load by static optimisation",
            "[[muscle]]",
            "keep the one that inserts on the patella; [muscles] shares the load among muscles",
        )
    for muscle in muscles:
        ends = [chain.carrier(muscle.points[i].link) for i in (0, -1)]
        if ends != ["femur", "patella"]:
            raise InputError(
                f"runs from {ends[0]} to {ends[1]}: [[muscle]] tables have no static optimisation, "
                "which such a muscle needs",
                f"[[muscle]] {muscle.name}",
                "give one muscle from the femur to the patella; [muscles] takes the others",
            )


@dataclass(frozen=True, eq=False)
class TensionLine:
    """A line of given tension, straight from point to point.

    Args:
        places: the frames that its points are fixed to.
        positions: (3,) m each, of the points in these frames.
    """

    places: tuple[Place, ...]
    positions: tuple[Array, ...]

    def forces(self, data: Any, tension: float) -> list[tuple[int, pin.Force]]:
        """Return joints, and the forces on them in their own frames.

        Args:
            data: Pinocchio's, with joint placements up to date.
            tension: N.
        """
        placements = [data.oMi[place.joint] for place in self.places]
        points = [
            placement.act(place.placement.act(position))
            for placement, place, position in zip(
                placements, self.places, self.positions, strict=True
            )
        ]
        steps = np.diff(np.array(points), axis=0)
        along = steps / np.linalg.norm(steps, axis=1, keepdims=True)
        pulls = tension * np.concatenate([along[:1], np.diff(along, axis=0), -along[-1:]])
        return [
            (place.joint, placement.actInv(pin.Force(pull, cross(point, pull))))
            for placement, place, point, pull in zip(
                placements, self.places, points, pulls, strict=True
            )
        ]


def tension_lines(muscles: Iterable[Muscle], anatomy: Anatomy) -> dict[str, TensionLine]:
    """Return muscle -> its line.

    Raises:
        InputError: fewer than two points, a wrap, or no such frame.
    """
    lines = {}
    for muscle in muscles:
        points = [link_point(point) for point in muscle.points]
        if len(points) < 2 or muscle.wrap is not None:
            raise InputError(
                "is no straight line over two points or more",
                f"muscle {muscle.name}",
                "give its points; a quadriceps that wraps belongs to extensor=",
            )
        places = tuple(anatomy.frame(point.link) for point in points)
        lines[muscle.name] = TensionLine(places, tuple(point.position for point in points))
    return lines


def checked_tensions(
    tensions: Mapping[str, float] | float | None, extensor: tuple[str, ...], lines: Iterable[str]
) -> dict[str, float]:
    """Return muscle -> N.

    Args:
        tensions: as given; a number alone is the quadriceps'.
        extensor: names of the extensor mechanism's lines, the quadriceps first.
        lines: names of the other muscles.

    Raises:
        InputError: an unknown muscle, or a tension that is negative or not finite.
    """
    if tensions is None:
        return {}
    if not isinstance(tensions, Mapping):
        if not extensor:
            raise InputError("has no quadriceps", "tensions", "give extensor=, or names")
        tensions = {extensor[0]: tensions}
    names = (*extensor, *lines)
    for name, tension in tensions.items():
        if name not in names:
            raise InputError(f"no muscle '{name}'", "tensions", names_near(name, list(names)))
        if not (np.isfinite(tension) and tension >= 0.0):
            raise InputError(f"tension {tension} N", f"muscle {name}", "a muscle only pulls")
    return {name: float(tension) for name, tension in tensions.items()}
