"""Rolling and slipping of the femoral condyles on the insert, by arc lengths.

From frame to frame the lowest point of a condyle moves by an arc a_f on the femoral surface, and
its projection by an arc a_i on the insert, both in the insert's sagittal plane and positive if the
contact moves backwards, as in flexion. In rolling they are equal. Axial rotation about the
geometric centre of the femoral component causes the part a_axial of a_i:

    slip = sum (a_f - (a_i - a_axial)),   a_axial = d(alpha) (z_condyle - z_centre) / cos(slope)

alpha is positive if the femur rotates externally, slip if the femur's surface slides forwards on
the insert. Its rate is the x velocity of the femur's contact point relative to the insert, without
the axial part; `sliding_velocity` computes it without arcs.

If the tangent of a profile turns by d between two points, the arc is chord (d/2)/sin(d/2). This is
exact on a circle, and of third order in the step on other profiles.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.geometry.condyles import LowestPoints
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import Array, inverse, knee_pose, knee_twist, rotate, transform
from tkamb.geometry.surface import Surface

UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class CondyleSlip:
    """Rolling and slipping of one condyle over f frames, cumulated from the first frame.

    All values are NaN from the first frame in which the condyle does not lie over the insert.

    Args:
        femoral_arc: arc on the femoral surface, positive backwards, (f,), m.
        insert_arc: arc on the insert, positive backwards, (f,), m.
        axial_part: part of `insert_arc` due to axial rotation, (f,), m.
    """

    femoral_arc: Array
    insert_arc: Array
    axial_part: Array

    @property
    def slip(self) -> Array:
        """The slip (f,), m, positive if the femur's surface slides forwards."""
        return np.asarray(self.femoral_arc - (self.insert_arc - self.axial_part))

    def slip_velocity(self, time: Array) -> Array:
        """Return the rate of the slip (f,), m/s, by central differences over the time (f,), s."""
        return np.asarray(np.gradient(self.slip, time[: len(self.slip)]))


class InsertProfile:
    """The insert's upper surface as a height over x and z, insert frame."""

    def __init__(self, insert: Surface) -> None:
        self._insert = insert
        self._above = float(insert.bounds[1, 1]) + 1e-3

    def at(self, points: Array) -> tuple[Array, Array]:
        """Return height y (n,), m, and sagittal slope (n,), rad, at points (n, 3); NaN beside the
        insert.
        """
        start = np.array(points, float)
        start[:, 1] = self._above
        distance, face = self._insert.rays.first(start, -UP)
        hit = face >= 0
        height, slope = np.full(len(start), np.nan), np.full(len(start), np.nan)
        height[hit] = self._above - distance[hit]
        feet = start[hit]
        feet[:, 1] = height[hit]
        normal = self._insert.smooth_normals(feet, face[hit])
        slope[hit] = np.arctan2(-normal[:, 0], normal[:, 1])
        return height, slope


def condyle_slip(
    femoral: Surface, insert: Surface, split: float | None, coordinates: Array
) -> tuple[CondyleSlip, CondyleSlip | None]:
    """Return rolling and slipping of the medial and the lateral condyle.

    `femoral`, `split` (z, m) and `insert` are in their own frames; a `split` of None: only a medial
    condyle. `coordinates` (f, 6) are recorded knee coordinates, m and rad.
    """
    lowest = LowestPoints(femoral, split)
    poses, profile = knee_pose(coordinates), InsertProfile(insert)
    centre = transform(poses, femoral.bounds.mean(axis=0))
    gaps = [lowest.at(pose) for pose in poses]
    slips: list[CondyleSlip] = []
    for side in (0, 1):
        if gaps[0][side] is None:
            return slips[0], None
        points = np.array([pair[side] for pair in gaps])
        slips.append(slip_of_points(points, poses, coordinates[:, 3], centre[:, 2], profile))
    return slips[0], slips[1]


def slip_of_points(
    points: Array, poses: Array, axial_rotation: Array, centre_z: Array, profile: InsertProfile
) -> CondyleSlip:
    """Return rolling and slipping of one condyle from its lowest points.

    Args:
        points: lowest points of the condyle, insert frame, (f, 3), m.
        poses: pose_femoral_in_insert, (f, 4, 4).
        axial_rotation: positive if the femur rotates externally, (f,), rad.
        centre_z: z of the component's geometric centre, insert frame, (f,), m.
    """
    height, slope = profile.at(points)
    on_insert = np.column_stack([points[:, 0], height])
    travelled = arc(np.diff(on_insert, axis=0), np.diff(slope))
    backwards = -np.sign(np.diff(points[:, 0]))
    # Axial rotation moves the contact point in proportion to its lateral distance from the centre
    # of the femoral component, along the slope of the insert.
    lever = _mean(points[:, 2] - centre_z) / np.cos(_mean(slope))
    return CondyleSlip(
        _cumulate(femoral_arcs(points, poses)),
        _cumulate(backwards * travelled),
        _cumulate(np.diff(axial_rotation) * lever),
    )


def femoral_arcs(points: Array, poses: Array) -> Array:
    """Return the arcs (f-1,), m, between successive lowest points, on the femoral surface.

    At a lowest point the normal of the surface is the insert's -y, so that the tangent turns by the
    rotation of the femur about its ML axis. Arguments as in `slip_of_points`.
    """
    back = inverse(poses)
    in_femur = transform(back, points[:, None])[:, 0]
    # The downward normal turns by the angle of the arc in femoral axes.
    normal = rotate(back, -UP)
    angle = np.unwrap(np.arctan2(normal[:, 1], normal[:, 0]))
    chord = np.diff(in_femur, axis=0)
    middle = np.einsum("fij,fj->fi", poses[1:, :3, :3] + poses[:-1, :3, :3], chord)
    size, twice = np.linalg.norm(chord, axis=1), np.linalg.norm(middle, axis=1)
    middle *= np.divide(size, twice, out=np.zeros_like(size), where=twice > 0.0)[:, None]
    return np.asarray(-np.sign(middle[:, 0]) * arc(middle[:, :2], np.diff(angle)))


def arc(chord: Array, turn: Array) -> Array:
    """Return the lengths (n,), m, of circular arcs from chords (n, 2), m, and turns (n,), rad."""
    # Arc over chord of a circle: (turn / 2) / sin(turn / 2).
    half = 0.5 * np.abs(turn)
    stretch = np.where(half > 1e-6, half / np.where(half > 1e-6, np.sin(half), 1.0), 1.0)
    return np.asarray(np.linalg.norm(chord, axis=1) * stretch)


def sliding_velocity(velocity: Array, spin: Array, arm: Array, lever: Array) -> Array:
    """Return the forward sliding (f,), m/s, of the femur's contact point, without axial rotation.

    By rigid-body kinematics it is (v + w x r)_x - w_y (z_condyle - z_centre), with v of the femoral
    origin and w relative to the insert, r (`arm`) from this origin to the contact point, (f, 3) in
    the insert frame, and `lever` (f,), m, the last difference.
    """
    return np.asarray((velocity + np.cross(spin, arm))[:, 0] - spin[:, 1] * lever)


def forward_sliding(coordinates: Array, rates: Array, centre: Array, contact: Array) -> float:
    """Return the forward sliding (m/s) at a contact point by rigid-body kinematics.

    Knee coordinates (6,) and their rates; the component's geometric centre is in the femoral frame,
    the contact point in the insert frame, (3,), m.
    """
    velocity, spin = knee_twist(coordinates, rates)
    arm, lever = (
        contact - coordinates[:3],
        contact[2] - transform(knee_pose(coordinates), centre)[2],
    )
    return float(sliding_velocity(velocity[None], spin[None], arm[None], np.array([lever]))[0])


def roll_slip_motion(
    femoral: Surface,
    insert: Surface,
    split: float | None,
    coordinates: Array,
    slip: Array,
) -> Array:
    """Return the motion of Sharma (2008): AP follows from rolling and slip, SI from first touch.

    The mean contact point moves backwards along the insert by the femoral arc less the slip. The
    femur is lowered to first touch in every frame.

    Args:
        split: z between the condyles in the femoral frame, m; None: one condyle.
        coordinates: knee coordinates, (f, 6), m and rad. Their rotations, ML, and the AP of
            the first frame are used.
        slip: cumulated slip, positive forwards, (f,), m; zero: pure rolling.

    Returns:
        Knee coordinates, (f, 6), m and rad. AP and SI are NaN from the first frame in which
        the femur leaves the insert.
    """
    changed = np.array(coordinates, float)
    poses, profile = knee_pose(changed), InsertProfile(insert)
    touch = FirstTouch(femoral, insert, split)
    arms, arcs = _mean_condyle(LowestPoints(femoral, split), poses)
    centre_z = transform(poses, femoral.bounds.mean(axis=0))[:, 2]
    axial = np.diff(changed[:, 3]) * _mean(arms[:, 2] + poses[:, 2, 3] - centre_z)
    backwards = arcs - np.diff(np.asarray(slip, float))
    contact = changed[0, 0] + arms[0, 0]
    changed[0, 1] -= touch.travel(knee_pose(changed[0]))
    for k in range(1, len(changed)):
        contact = _roll(profile, contact, poses[k, 2, 3] + arms[k, 2], backwards[k - 1])
        contact -= axial[k - 1]
        changed[k, 0] = contact - arms[k, 0]
        changed[k, 1] -= touch.travel(knee_pose(changed[k])) if np.isfinite(contact) else np.nan
    return changed


def _mean_condyle(lowest: LowestPoints, poses: Array) -> tuple[Array, Array]:
    """Return arms (f, 3), m, and femoral arcs (f-1,), m, as means over the condyles.

    An arm goes from the femoral origin to the lowest point. Both depend on the rotations alone.
    """
    condyle_points = [[point for point in lowest.at(pose) if point is not None] for pose in poses]
    points = np.array(condyle_points).swapaxes(0, 1)
    arcs = np.mean([femoral_arcs(side, poses) for side in points], axis=0)
    return points.mean(axis=0) - poses[:, :3, 3], np.asarray(arcs)


def _roll(profile: InsertProfile, x: float, z: float, backwards: float) -> float:
    """Return x (m) after an arc backwards along the insert's surface at z (midpoint rule)."""
    _, slope = profile.at(np.array([[x, 0.0, z]]))
    middle = x - 0.5 * backwards * np.cos(slope[0])
    _, slope = profile.at(np.array([[middle, 0.0, z]]))
    return float(x - backwards * np.cos(slope[0]))


def _mean(values: Array) -> Array:
    return np.asarray(0.5 * (values[1:] + values[:-1]))


def _cumulate(steps: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(steps)])
