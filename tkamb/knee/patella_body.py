"""The patella as a body with six degrees of freedom, in quasi-static equilibrium.

The heads of the quadriceps pull with given tensions. The strands of the patellar ligament and the
retinacula are ligaments from the patella to tibia and femur, and the button presses on the femoral
component by a contact model. The patella is massless, and the pose of the femur is given.

The six coordinates of the patella in its joint's frame, which is fixed to the femur (x anterior, y
superior, z to the right), are the translations ap, si and shift of its origin, and the rotations

    R = R_z(flexion) R_y(-tilt) R_x(rotation).

Shift and tilt are positive to the lateral side: with a positive tilt the lateral edge is nearer to
the femur. A positive rotation turns the superior pole to the lateral side. A left patella has the
coordinates of its mirror image, so that these signs hold on both sides.

In the button frame (`tkamb.knee.button`) let w be the wrench on the patella about the origin, and
xi a displacement of the femur with the tibia. Contact models and ligaments give w and K = dw/dxi.
The displacement of the patella by its coordinates c is T dc, so that xi = -T dc. The generalised
forces and their stiffness are

    g = T^T w,    -dg/dc = T^T K T - (dT/dc)^T w.

`tkamb.knee.balance` finds g = 0 on the released coordinates. Newton's method then reduces the
residual to rounding errors, as far as the force does not jump from facet to facet.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tkamb.errors import ComputationError, InputError, names_among
from tkamb.geometry.frames import (
    PATELLA_BODY_COORDINATES,
    Array,
    cross,
    cross_matrix,
    inverse,
    pose,
    rotate,
    transform,
)
from tkamb.knee.balance import (
    SMALL_RESIDUAL,
    BalanceStatus,
    Trial,
    find_balance,
    polished,
    smallest_eigenvalues,
)
from tkamb.knee.button import Button
from tkamb.knee.ligaments import DISTAL, PROXIMAL, BundleArrays, Ligament
from tkamb.knee.wrapping import TautPath, path_in_link
from tkamb.units import MILLIMETRE

PLANE = (0, 1, 3)
"""Numbers of the coordinates in the sagittal plane, in the order of the plane model."""

# m: arm that makes rotations comparable to translations. Chosen: about half the width of a button.
ARM = 0.015
SCALE = np.array([1.0, 1.0, 1.0, ARM, ARM, ARM])
# 1: residual over the quadriceps' tension above which an equilibrium is flagged. A larger one
# remains where the contact's force jumps as a column crosses an edge of two femoral facets.
LARGEST_RESIDUAL = 1e-6
# m: distance from the patella's sagittal plane within which a head pulls on both sides.
CENTRAL = 1.0 * MILLIMETRE


@dataclass(frozen=True, eq=False)
class Head:
    """A head of the quadriceps: a line of given tension from the femur to the patella.

    It may wrap a convex outline of the femur (`tkamb.knee.wrapping`). With the length S of the path
    in the outline's plane up to the last corner, the distance D of the insertion from this corner
    in the plane, and the distance z along the femur's z axis, the length is sqrt((S + D)² + z²).

    Args:
        name: name of the head.
        origin: last point on the femur, femoral frame, shape (3,), m.
        insertion: point on the patella, shape (3,), m.
        outline: outline in the femur's x-y plane, shape (n, 2), m; None: the line is straight.
        tension: N.
    """

    name: str
    origin: Array
    insertion: Array
    outline: Array | None
    tension: float

    def path(self, insertion: Array) -> TautPath:
        """Return the path to an insertion (3,), m, in the femoral frame.

        Raises:
            ComputationError: an end lies inside the outline.
        """
        return path_in_link(self.origin, insertion, self.outline, np.eye(4))

    def slopes(self, insertion: Array) -> tuple[Array, Array]:
        """Return gradient (3,) and second derivative (3, 3), 1/m, of the length.

        Both are by the insertion, a point (3,) of the femoral frame, m.

        Raises:
            ComputationError: an end lies inside the outline.
        """
        path = self.path(insertion)
        across = np.array([0.0, 0.0, insertion[2] - self.origin[2]])
        last = insertion - path.points[-2]
        last[2] = 0.0
        distance = float(np.linalg.norm(last))
        along, plane = last / distance, float(np.sqrt(path.length**2 - across[2] ** 2))
        gradient = (plane * along + across) / path.length
        normal = np.diag([1.0, 1.0, 0.0]) - np.outer(along, along)
        second = np.outer(along, along) + plane / distance * normal + np.diag([0.0, 0.0, 1.0])
        return gradient, (second - np.outer(gradient, gradient)) / path.length

    def loads(self, place: Array, insertion: Array) -> tuple[Array, Array]:
        """Return the wrench (6,) on the patella and its derivative (6, 6) by a displacement.

        The displacement is that of the femur.

        Args:
            place: pose of the femur in the button frame, shape (4, 4).
            insertion: insertion in the button frame, shape (3,), m.

        Raises:
            ComputationError: an end lies inside the outline.
        """
        gradient, second = self.slopes(transform(inverse(place), insertion))
        turn = place[:3, :3]
        force = -self.tension * (turn @ gradient)
        lever = cross_matrix(insertion)
        slope = self.tension * turn @ second @ turn.T
        # The femur's displacement (u, w) moves its material away from the insertion by u + w x e,
        # and turns the force.
        change = np.hstack([slope, -slope @ lever - cross_matrix(force)])
        return np.concatenate([force, lever @ force]), np.vstack([change, lever @ change])


@dataclass(frozen=True, eq=False)
class PatellaBalance:
    """The patella in equilibrium, as that of a right knee.

    Args:
        coordinates: coordinates of the patella, shape (6,), m and rad.
        residual: largest generalised force on a released coordinate, N (moments over `ARM`).
        stiffness: stiffness of the n released coordinates, shape (n, n), N/m (rotations times
            `ARM`).
        problem: why there is no equilibrium, in words; empty: there is one.
        trials: number of evaluations of the forces.
    """

    coordinates: Array
    residual: float
    stiffness: Array
    problem: str
    trials: int


class PatellaBody:
    """Forces on the patella of a right knee at one pose of the femur.

    Args:
        button: contact of button and femoral component.
        probe: probe of this contact's model.
        joint: pose of the patella's joint in the femur, shape (4, 4).
        heads: heads of the quadriceps.
        lines: strands of the patellar ligament and retinacula, from femur or tibia to the patella.
        poses: link -> pose (4, 4) in the insert frame, without the patella.

    Attributes:
        bundles: the lines, in the femoral frame and the button frame.
    """

    def __init__(
        self,
        button: Button,
        probe: Any,
        joint: Array,
        heads: Sequence[Head],
        lines: Sequence[Ligament],
        poses: Mapping[str, Array],
    ) -> None:
        self.button, self.joint, self._probe = button, joint, probe
        self.heads, self.lines, self.poses = tuple(heads), tuple(lines), dict(poses)
        back = inverse(button.in_patella)
        self._heads = [(head, transform(back, head.insertion)) for head in heads]
        femur = inverse(poses["femur"])
        placed = {link: (PROXIMAL, femur @ np.asarray(place)) for link, place in poses.items()}
        placed["patella"] = (DISTAL, back)
        self.bundles = BundleArrays.between([line.on_links(placed) for line in lines])

    def femur_in_button(self, coordinates: Array) -> Array:
        """Return pose_femur_in_button (4, 4) at coordinates (6,)."""
        return inverse(self.joint @ patella_pose(coordinates) @ self.button.in_patella)

    def patella(self, coordinates: Array) -> Array:
        """Return pose_patella_in_insert (4, 4) at coordinates (6,)."""
        return np.asarray(self.poses["femur"] @ self.joint @ patella_pose(coordinates))

    def pull(self, coordinates: Array) -> Array:
        """Return the wrench (6,) of heads and lines on the patella, button frame, N and N·m.

        Raises:
            ComputationError: a line has no path.
        """
        place = self.femur_in_button(coordinates)
        heads = (head.loads(place, insertion)[0] for head, insertion in self._heads)
        return sum(heads, self.bundles.wrench(place))

    def head_paths(self, coordinates: Array) -> dict[str, TautPath]:
        """Return head -> its path to the patella, in the insert frame.

        Raises:
            ComputationError: an end of a head lies inside the outline.
        """
        femur = self.poses["femur"]
        back = inverse(femur) @ self.patella(coordinates)
        paths = {one.name: one.path(transform(back, one.insertion)) for one in self.heads}
        return {
            name: replace(path, points=transform(femur, path.points))
            for name, path in paths.items()
        }

    def head_forces(self, coordinates: Array) -> tuple[Array, Array]:
        """Return insertions (h, 3), m, and forces (h, 3), N, of the heads on the patella.

        Both are in the insert frame.

        Raises:
            ComputationError: an end of a head lies inside the outline.
        """
        patella, femur = self.patella(coordinates), self.poses["femur"]
        back = inverse(femur) @ patella
        places = np.array([transform(back, head.insertion) for head in self.heads])
        pulls = [
            -head.tension * head.slopes(at)[0] for head, at in zip(self.heads, places, strict=True)
        ]
        return transform(femur, places), rotate(femur, np.array(pulls))

    def wrench(self, coordinates: Array) -> Array:
        """Return w (6,), N and N·m; NaN where the contact model or a line has no result."""
        return self._loads(coordinates)[0]

    def _loads(self, coordinates: Array, exact: bool = False) -> tuple[Array, Array | None, bool]:
        """Return w (6,), K (6, 6) or None, and whether K is exact.

        `exact` is whether the contact model computes its exact tangent, if it has one.
        """
        place = self.femur_in_button(coordinates)
        contact, lost = self._probe.at(place), (np.full(6, np.nan), None, False)
        if not contact.known:
            return lost
        if exact:
            contact = self.button.contact.with_exact_tangent(self._probe, contact)
        try:
            heads = [head.loads(place, insertion) for head, insertion in self._heads]
            wrench = contact.wrench + self.bundles.wrench(place)
            tangent = self.bundles.tangent(place) if contact.tangent else None
        except ComputationError:
            return lost
        wrench = sum((one for one, _ in heads), wrench)
        if tangent is None:
            return wrench, None, False
        slopes = [load.stiffness for load in contact.loads] + [slope for _, slope in heads]
        return wrench, sum(slopes, tangent), bool(contact.exact)

    def _trial(self, coordinates: Array, rows: list[int], exact: bool = False) -> Trial:
        """Return the scaled generalised forces and their stiffness at coordinates (6,)."""
        wrench, tangent, known = self._loads(coordinates, exact)
        if not np.isfinite(wrench).all():
            return Trial(np.full(len(rows), np.nan))
        scale = SCALE[rows]
        twists = self.twists(coordinates)[:, rows] / scale
        if tangent is None:
            return Trial(twists.T @ wrench)
        turned = self._turned(coordinates, wrench)[np.ix_(rows, rows)] / np.outer(scale, scale)
        return Trial(twists.T @ wrench, twists.T @ tangent @ twists - turned, known)

    def exact_stiffness(self, coordinates: Array, released: Sequence[int]) -> Array:
        """Return -dg/dc (n, n) of the n released coordinates, N/m, N and N·m.

        Raises:
            InputError: the contact model has no exact tangent.
        """
        rows = list(released)
        trial = self._trial(coordinates, rows, exact=True)
        if trial.stiffness is None or not trial.exact:
            name = self.button.contact.model.name
            what = f"contact model '{name}' has no exact tangent"
            raise InputError(what, "derivatives", "take the foundation or a lattice for the button")
        return np.asarray(trial.stiffness * np.outer(SCALE[rows], SCALE[rows]))

    def balance(
        self, start: Array, released: Sequence[int], size: float, near: bool = False
    ) -> PatellaBalance:
        """Return the equilibrium of the released coordinates.

        Args:
            start: initial guess, shape (6,); coordinates that are not released keep their values.
            released: numbers of the n released coordinates.
            size: tension of the quadriceps, N, to which the residual is compared.
            near: whether Newton's method is tried before the search.
        """
        rows, trials = list(released), dict[bytes, Trial]()

        def coordinates_at(x: Array) -> Array:
            coordinates = np.array(start, float)
            coordinates[rows] = x / SCALE[rows]
            return coordinates

        def once(x: Array) -> Trial:
            if x.tobytes() not in trials:
                trials[x.tobytes()] = self._trial(coordinates_at(x), rows)
            return trials[x.tobytes()]

        def result(x: Array, last: Trial, stiffness: Array, problem: str = "") -> PatellaBalance:
            residual = float(np.abs(last.force).max())
            return PatellaBalance(coordinates_at(x), residual, stiffness, problem, len(trials))

        x = np.asarray(start, float)[rows] * SCALE[rows]
        if near:
            closer, last = polished(once, x, size)
            small = np.abs(last.force).max() <= SMALL_RESIDUAL * size
            if small and last.stiffness is not None and smallest_eigenvalues(last.stiffness)[1] > 0:
                return result(closer, last, last.stiffness)
        found = find_balance(once, x)
        x, last = found.coordinates, once(found.coordinates)
        if found.status is not BalanceStatus.OK:
            return result(x, last, found.stiffness, f"patella: {found.status.value}")
        x, last = polished(once, x, size)
        return result(x, last, found.stiffness if last.stiffness is None else last.stiffness)

    def twists(self, coordinates: Array) -> Array:
        """Return T (6, 6): displacement of the patella by its coordinates, button frame.

        The columns are translations (m) of the point at the origin, then rotations (rad).
        """
        axes = _rotation_axes(coordinates)
        button = patella_pose(coordinates) @ self.button.in_patella
        arm = button[:3, 3] - coordinates[:3]
        total = np.zeros((6, 6))
        total[:3, :3] = np.eye(3)
        total[:3, 3:], total[3:, 3:] = cross(axes, np.broadcast_to(arm, (3, 3))).T, axes.T
        back = button[:3, :3].T
        return np.vstack([back @ total[:3], back @ total[3:]])

    def _turned(self, coordinates: Array, wrench: Array) -> Array:
        """Return (dT/dc)^T w (6, 6), row: generalised force, column: coordinate.

        A rotation about a_k turns the button, its arm and the later axes.
        """
        axes = _rotation_axes(coordinates)
        button = patella_pose(coordinates) @ self.button.in_patella
        arm = button[:3, 3] - coordinates[:3]
        force, moment = button[:3, :3] @ wrench[:3], button[:3, :3] @ wrench[3:]
        result = np.zeros((6, 6))
        for k, axis in enumerate(axes):
            turned_force, turned_arm = cross(axis, force), cross(axis, arm)
            turned = np.array(
                [cross(axis, a) if i > k else np.zeros(3) for i, a in enumerate(axes)]
            )
            result[:3, 3 + k] = turned_force
            result[3:, 3 + k] = (
                turned @ (cross(arm, force) + moment)
                + axes @ (cross(turned_arm, force) + cross(arm, turned_force))
                + axes @ cross(axis, moment)
            )
        return result


def patella_pose(coordinates: Array) -> Array:
    """Return pose_patella_in_joint (4, 4) at coordinates (6,), m and rad."""
    _, _, _, flexion, tilt, rotation = coordinates
    turn = _about(2, flexion) @ _about(1, -tilt) @ _about(0, rotation)
    return pose(turn, coordinates[:3])


def coordinates_of(patella_in_joint: Array) -> Array:
    """Return the coordinates (6,) of a pose (4, 4); `patella_pose` is the inverse."""
    r = patella_in_joint[:3, :3]
    angles = [
        np.arctan2(r[1, 0], r[0, 0]),
        np.arcsin(np.clip(r[2, 0], -1.0, 1.0)),
        np.arctan2(r[2, 1], r[2, 2]),
    ]
    return np.concatenate([patella_in_joint[:3, 3], angles])


def _rotation_axes(coordinates: Array) -> Array:
    """Return the axes (3, 3), as rows, of flexion, tilt and rotation in the joint's frame."""
    _, _, _, flexion, tilt, _ = coordinates
    turned = _about(2, flexion)
    return np.array([[0.0, 0.0, 1.0], -turned[:, 1], (turned @ _about(1, -tilt))[:, 0]])


def _about(axis: int, angle: float) -> Array:
    """Return the rotation (3, 3) about a coordinate axis by an angle, rad."""
    c, s = np.cos(angle), np.sin(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[j, j], turn[j, k], turn[k, j], turn[k, k] = c, -s, s, c
    return turn


def released_numbers(names: Sequence[str]) -> tuple[int, ...]:
    """Return the numbers of released coordinates.

    Raises:
        InputError: the names are no list, one is unknown or given twice, or there is none.
    """
    names = names_among(names, PATELLA_BODY_COORDINATES, "released", "coordinate of the patella")
    if not names or len(set(names)) < len(names):
        raise InputError("names no coordinate, or one twice", "released", "name each once")
    return tuple(k for k, name in enumerate(PATELLA_BODY_COORDINATES) if name in names)


def sides_without_head(insertions: Mapping[str, Array], tensions: Mapping[str, float]) -> list[str]:
    """Return "medial" or "lateral" if the heads of that side do not pull, and others do.

    Args:
        insertions: head -> insertion on the patella of a right knee, shape (3,), m.
        tensions: head -> tension, N.
    """
    sides = {"medial": -1.0, "lateral": 1.0}
    heads = {
        side: [n for n, at in insertions.items() if s * at[2] > CENTRAL]
        for side, s in sides.items()
    }
    pulls = any(tensions.get(name, 0.0) > 0.0 for name in insertions)
    return [
        side
        for side, names in heads.items()
        if pulls and names and not any(tensions.get(name, 0.0) > 0.0 for name in names)
    ]
