"""Muscles and their lines of action, as columns of the equations or with given tensions.

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
    """The outline that a muscle wraps."""

    sections: int = 7
    """Number of sagittal sections across the band, whose common outline is wrapped. Chosen: more
    sections change the lines by little."""


MUSCLE_BAND = MuscleBandSettings()


@dataclass(frozen=True, eq=False)
class SagittalWrap:
    """Wrapping of a line around the front of an implant part's sagittal outline.

    Args:
        band: m, half of the medial-lateral width over which sections are taken, about the line.
        half_thickness: m, half of the tendon's thickness, the distance of the line from the part.
        bone: surface that is wrapped together with the part, in the same frame; None: none.
    """

    band: float
    half_thickness: float
    bone: "Surface | None" = None

    def outline(self, part: "Surface", middle: float, below: float = np.inf) -> Array:
        """Return the convex outline (n, 2) m of the part and the bone, grown by the tendon.

        Args:
            part: the part, in the frame whose x-y plane holds the outline.
            middle: m, z of the line in that frame.
            below: m, greatest y; parts of the surfaces above are left out.
        """
        surfaces = [part] if self.bone is None else [part, self.bone]
        planes = middle + np.linspace(-self.band, self.band, MUSCLE_BAND.sections)
        return sagittal_outline(surfaces, planes, self.half_thickness, below=below)


@dataclass(frozen=True, eq=False)
class Muscle:
    """A muscle or tendon through points on links.

    Args:
        name: name of the muscle.
        points: points from origin to insertion, at least two.
        wrap: wrapping of the femoral component by the stretch that leaves the femur; None: it is
            straight.
        strength: N, maximal isometric force; NaN: unknown.
        group: name of the muscles that are shown together; empty: it is shown by itself.
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
        proximal: end on the patella.
        distal: end on the tibia.
        wrap: wrapping of the insert's front lip; None: it is straight.
        length: m, constant length, from which the place of the patella follows; NaN: not needed.
    """

    proximal: LinkPoint
    distal: LinkPoint
    wrap: SagittalWrap | None = None
    length: float = float("nan")


@dataclass(frozen=True, eq=False)
class Wrap:
    """An outline that one stretch of a line wraps.

    Args:
        link: name of the link that the outline is fixed to, which takes the reaction.
        outline: (n, 2) m, convex polygon in the link's x-y plane.
        stretch: number of the stretch; 0 runs from the first point to the second.
    """

    link: str
    outline: Array
    stretch: int = 0


@dataclass(frozen=True, eq=False)
class Line:
    """A line of action: a string through points of the links.

    Args:
        name: name of the muscle or ligament, for messages.
        points: points from the proximal to the distal end, at least two.
        wrap: outline that it wraps; None: it runs straight from point to point.
    """

    name: str
    points: tuple[LinkPoint, ...]
    wrap: Wrap | None = None

    def path(self, poses: Mapping[str, Array]) -> "TautPath":
        """Return the taut path in the insert frame.

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
        """Return the forces of a unit tension on the links; their sum is zero.

        The tension pulls both ends along the path. At every point and corner between, the force is
        the change of direction. The two ends come first.
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
    """Return the number of the stretch that leaves the femur.

    Raises:
        InputError: no stretch leaves it.
    """
    carriers = [chain.carrier(point.link) for point in points]
    for i, (one, other) in enumerate(pairwise(carriers)):
        if one == "femur" != other:
            return i
    raise InputError("no stretch of the path leaves the femur", None, "check its points' links")


def muscle_line(muscle: Muscle, chain: "Chain", femoral: "Surface") -> Line:
    """Return a muscle's line of action, which wraps the femoral component in the patella's plane.

    Args:
        muscle: the muscle.
        chain: chain of the knee.
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
    """Raise unless there is one muscle, from the femur to the patella.

    With one muscle the equations of a frame are square. Equilibrium does not determine how several
    muscles share the joint moments.

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
    """A straight line of given tension between points of a user's model.

    Args:
        places: frame of each point.
        positions: (3,) m, position of each point in its frame.
    """

    places: tuple[Place, ...]
    positions: tuple[Array, ...]

    def forces(self, data: Any, tension: float) -> list[tuple[int, pin.Force]]:
        """Return the joints, and the force on each in the joint's frame.

        Args:
            data: Pinocchio data with joint placements up to date.
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
        # The tension pulls each end along the line. A point between takes the change of direction.
        pulls = tension * np.concatenate([along[:1], np.diff(along, axis=0), -along[-1:]])
        return [
            (place.joint, placement.actInv(pin.Force(pull, cross(point, pull))))
            for placement, place, point, pull in zip(
                placements, self.places, points, pulls, strict=True
            )
        ]


def tension_lines(muscles: Iterable[Muscle], anatomy: Anatomy) -> dict[str, TensionLine]:
    """Return muscle -> line of given tension.

    Raises:
        InputError: a muscle has fewer than two points or a wrap, or names an unknown frame.
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
    """Return muscle -> tension, N, after a check.

    Args:
        tensions: muscle -> N, or a number, the tension of the quadriceps.
        extensor: names of the lines of the extensor mechanism, the quadriceps first.
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
