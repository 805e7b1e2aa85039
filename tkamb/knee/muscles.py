"""Muscles and their lines of action, with unknown or given tensions.

A line of action is a massless string through points of the links, which may wrap the outline of one
link. The forces of a unit tension on all links of the line are one column of the equations of
motion. The moment arm of a line of length L about a coordinate q of the chain is -dL/dq.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from tkamb.errors import ComputationError, InputError, must_be, names_near, real_number
from tkamb.geometry.frames import Array, cross, cross_matrix, transform
from tkamb.geometry.polygons import sagittal_outline
from tkamb.knee.anatomy import Anatomy, FixedFrame
from tkamb.knee.load import LinkPoint, PointForces, link_point

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface
    from tkamb.knee.chain import Chain
    from tkamb.knee.wrapping import TautPath


# Number of sagittal sections across the band. A line wraps the convex outline of all sections.
# Not studied.
SECTIONS = 7


@dataclass(frozen=True, eq=False)
class SagittalWrap:
    """Wrapping of a line around the front of an implant part's sagittal outline.

    Args:
        band: half of the medial-lateral width of the sections about the line, m.
        half_thickness: half of the tendon's thickness, the distance of the line from the part, m.
        bone: second surface that the line wraps, in the part's frame; None: no second surface.
    """

    band: float
    half_thickness: float
    bone: "Surface | None" = None

    def outline(self, part: "Surface", middle: float, below: float = np.inf) -> Array:
        """Return the convex outline (n, 2), m, of part and bone, offset by `half_thickness`.

        It lies in the x-y plane of the part's frame, below y = `below` (m); z of the line is
        `middle`.
        """
        surfaces = [part] if self.bone is None else [part, self.bone]
        planes = middle + np.linspace(-self.band, self.band, SECTIONS)
        return sagittal_outline(surfaces, planes, self.half_thickness, below=below)


@dataclass(frozen=True, eq=False)
class Muscle:
    """A muscle or tendon through points on links.

    Args:
        points: points from origin to insertion, at least two.
        wrap: wrapping of the femoral component by the segment that leaves the femur; None: this
            segment is straight.
        strength: maximal isometric force, N; NaN: unknown.
        group: name of the group with which the muscle is shown; empty: it is shown alone.
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
        wrap: wrapping of the insert's front lip; None: the ligament is straight.
        length: constant length, which determines the position of the patella, m; NaN: not needed.
    """

    proximal: LinkPoint
    distal: LinkPoint
    wrap: SagittalWrap | None = None
    length: float = float("nan")


@dataclass(frozen=True, eq=False)
class Wrap:
    """An outline that one segment of a line wraps.

    Args:
        outline: convex polygon in the link's x-y plane, (n, 2), m.
        segment: segment 0 is between the first two points.
    """

    link: str
    outline: Array
    segment: int = 0


@dataclass(frozen=True, eq=False)
class Line:
    """A string through points of the links, the proximal end first."""

    name: str
    points: tuple[LinkPoint, ...]
    wrap: Wrap | None = None

    def path(self, poses: Mapping[str, Array]) -> "TautPath":
        """Return the taut path in the insert frame.

        Raises:
            ComputationError: an end of the wrapped segment lies inside the outline.
        """
        from tkamb.knee.wrapping import TautPath, path_in_link  # imports numba

        positions = [transform(poses[point.link], point.position) for point in self.points]
        segments = []
        for i, (start, end) in enumerate(pairwise(positions)):
            wrapped = self.wrap if self.wrap and self.wrap.segment == i else None
            outline, link = (wrapped.outline, wrapped.link) if wrapped else (None, None)
            pose = np.eye(4) if link is None else np.asarray(poses[link], float)
            try:
                segments.append(path_in_link(start, end, outline, pose))
            except ComputationError as error:
                raise ComputationError(error.what, self.name) from None
        if len(segments) == 1:
            return segments[0]
        points = [segments[0].points, *(segment.points[1:] for segment in segments[1:])]
        return TautPath(
            np.concatenate(points),
            sum(segment.length for segment in segments),
            sum(segment.wrap_angle for segment in segments),
        )

    def loads(self, path: "TautPath") -> tuple[PointForces, ...]:
        """Return the forces of a unit tension on the links, the two ends first. Their sum is zero.

        The force at an inner point or corner is the change of direction.
        """
        links = [point.link for point in self.points]
        if self.wrap:
            index = self.wrap.segment + 1
            links[index:index] = [self.wrap.link] * (len(path.points) - len(links))
        directions = path.directions
        forces = np.concatenate([directions[:1], np.diff(directions, axis=0), -directions[-1:]])
        # Several inner points on one link become one load.
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
    """Return the number of the segment that leaves the femur."""
    carriers = [chain.carrier(point.link) for point in points]
    for i, (one, other) in enumerate(pairwise(carriers)):
        if one == "femur" != other:
            return i
    raise InputError("no segment of the line leaves the femur", None, "check its points' links")


def muscle_line(muscle: Muscle, chain: "Chain", femoral: "Surface") -> Line:
    """Return a muscle's line of action. It may wrap the femoral component in the patella's plane.

    `femoral` is in the femur link's frame.
    """
    if muscle.wrap is None:
        return Line(muscle.name, muscle.points)
    segment = off_femur(muscle.points, chain)
    last = muscle.points[segment]
    outline = muscle.wrap.outline(
        femoral,
        float(chain.patella_joint_in_femur[2, 3]),
        below=float(transform(chain.link_in(last.link, "femur"), last.position)[1]),
    )
    return Line(muscle.name, muscle.points, Wrap("femur", outline, segment))


def check_muscles(muscles: Sequence[Muscle], chain: "Chain") -> None:
    """Raise an error unless there is one muscle, from the femur to the patella.

    Equilibrium does not determine how several muscles share the joint moments.
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
                f"runs from {ends[0]} to {ends[1]}: such a muscle needs static optimisation, which "
                "[[muscle]] tables do not have",
                f"[[muscle]] {muscle.name}",
                "give one muscle from the femur to the patella; give the others in [muscles]",
            )


@dataclass(frozen=True, eq=False)
class TensionLine:
    """A straight line of given tension between points of a user's model.

    Args:
        positions: (3,), m, of each point in its frame.
    """

    frames: tuple[FixedFrame, ...]
    positions: tuple[Array, ...]

    def forces(self, data: Any, tension: float) -> list[tuple[int, pin.Force]]:
        """Return pairs of a joint and the force on it, in the joint's frame, at a tension (N)."""
        placements, points = self._points(data)
        steps = np.diff(points, axis=0)
        directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)
        # The tension pulls the ends along the line. At an inner point the force is the change of
        # direction.
        pulls = tension * np.concatenate(
            [directions[:1], np.diff(directions, axis=0), -directions[-1:]]
        )
        return [
            (frame.joint, placement.actInv(pin.Force(pull, cross(point, pull))))
            for placement, frame, point, pull in zip(
                placements, self.frames, points, pulls, strict=True
            )
        ]

    def _points(self, data: Any) -> tuple[list[pin.SE3], Array]:
        """Return each point's joint placement, and the points (m, 3), in the world."""
        placements = [data.oMi[frame.joint] for frame in self.frames]
        points = [
            placement.act(frame.placement.act(position))
            for placement, frame, position in zip(
                placements, self.frames, self.positions, strict=True
            )
        ]
        return placements, np.array(points)

    def add_derivatives(self, model: Any, data: Any, tension: float, changes: Array) -> None:
        """Add the derivatives of `forces` by q to `changes` (njoints, 6, nv), tangent space.

        A segment of length l along u changes its direction by (I - u u^T) dx / l. In the joint's
        axes a force R^T f changes by R^T df - omega x R^T f, and its point does not move. `data` is
        that after `pin.computeJointJacobians`.
        """
        placements, points = self._points(data)
        spins, moves = [], []
        for placement, frame, point in zip(placements, self.frames, points, strict=True):
            local = np.zeros((6, model.nv))
            if frame.joint:
                found = pin.getJointJacobian(model, data, frame.joint, pin.ReferenceFrame.LOCAL)
                local = found.reshape(6, -1)
            in_joint = placement.actInv(point)
            spins.append(local[3:])
            moves.append(placement.rotation @ (local[:3] - cross_matrix(in_joint) @ local[3:]))
        steps = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        directions = steps / lengths[:, None]
        turns = [
            (np.eye(3) - np.outer(u, u)) @ (after - before) / length
            for u, length, before, after in zip(
                directions, lengths, moves[:-1], moves[1:], strict=True
            )
        ]
        zero, none = np.zeros(3), np.zeros((3, model.nv))
        ahead, behind = [*directions, zero], [zero, *directions]
        ahead_turn, behind_turn = [*turns, none], [none, *turns]
        for k, (placement, frame) in enumerate(zip(placements, self.frames, strict=True)):
            back = placement.rotation.T
            pull = back @ (tension * (ahead[k] - behind[k]))
            change = back @ (tension * (ahead_turn[k] - behind_turn[k]))
            # The axes of the joint turn under the force.
            change = change + cross_matrix(pull) @ spins[k]
            changes[frame.joint, :3] += change
            changes[frame.joint, 3:] += cross_matrix(placement.actInv(points[k])) @ change


def tension_lines(muscles: Iterable[Muscle], anatomy: Anatomy) -> dict[str, TensionLine]:
    """Return name of a muscle -> its line."""
    lines = {}
    for muscle in muscles:
        where = f"muscle {muscle.name}"
        must_be(muscle.points, (tuple, list), f"{where}: points", "give a list of points on frames")
        points = [link_point(point) for point in muscle.points]
        if len(points) < 2 or muscle.wrap is not None:
            raise InputError(
                "is not a straight line through two or more points",
                where,
                "give two or more points, and a quadriceps that wraps in extensor=",
            )
        frames = tuple(anatomy.frame(point.link) for point in points)
        lines[muscle.name] = TensionLine(frames, tuple(point.position for point in points))
    return lines


def checked_tensions(
    tensions: Mapping[str, float] | float | None, extensor: tuple[str, ...], lines: Iterable[str]
) -> dict[str, float]:
    """Return muscle -> tension, N, after a check.

    Args:
        tensions: muscle -> tension, N; or the tension of the quadriceps alone, N.
        extensor: names of the lines of the extensor mechanism, the quadriceps first.
    """
    if tensions is None:
        return {}
    if not isinstance(tensions, Mapping):
        if not extensor:
            raise InputError(
                "the knee has no quadriceps", "tensions", "give extensor=, or muscle -> tension"
            )
        tensions = {extensor[0]: tensions}
    names, checked = (*extensor, *lines), {}
    for name, tension in tensions.items():
        if name not in names:
            raise InputError(
                f"no muscle '{name}'", "tensions", names_near(name, dict.fromkeys(names))
            )
        hint = "a muscle only pulls: give 0 or more"
        checked[name] = real_number(tension, f"muscle {name}: tension", hint)
        if not (math.isfinite(checked[name]) and checked[name] >= 0.0):
            raise InputError(f"tension {tension} N", f"muscle {name}", hint)
    return checked
