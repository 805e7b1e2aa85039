"""Marker positions on the segments of a leg, found together with the motion of several trials.

Hip, knee and ankle are joints, so that a marker in the wrong place disagrees with the others in
many frames (docs/import.md). With the measured markers p, the pose q of the leg in each frame and
the parameters θ (positions of the markers, shifts of hip and ankle in thigh and shank, mean offset
of the knee from the model's),

    min_{q, θ}  Σ_frames [ Σ_m |x_m(q, θ) - p_m|² / σ_m² + Σ_i (k_i(q) - k̄_i - o_i)² / s_i² ] / c
                + Σ_j (θ_j - θ̄_j)² / τ_j².

The second sum keeps the knee a joint: its coordinates k other than flexion may leave the model's
neutral values k̄ by a few millimetres and degrees. Gauss-Newton steps eliminate the frames (Schur's
complement), with Pinocchio's Jacobians. σ_m follows from the residuals. Skin moves alike in each
stride and slowly within it, so c is the number of frames per independent observation. The inverse
of the reduced matrix is the covariance of θ.

References: Reinbolt et al., J Biomech 38:621 (2005), doi:10.1016/j.jbiomech.2004.03.031; Andersen
et al., Comput Methods Biomech Biomed Eng 13:171 (2010), doi:10.1080/10255840903067080; Werling et
al., PLoS ONE 18:e0295152 (2023), doi:10.1371/journal.pone.0295152.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, knee_coordinates, transform
from tkamb.io.importing.links import Links
from tkamb.io.importing.markers import ModelSegment
from tkamb.io.recordings.inverse_kinematics import skew
from tkamb.io.recordings.markers import fit_seen
from tkamb.units import DEGREE, MILLIMETRE


@dataclass(frozen=True)
class RegistrationSettings:
    """The registration of markers from motion."""

    max_frames: int = 320
    """Largest number of frames of all trials. Not studied; c makes more frames worthless."""
    independent: float = 8.0
    """Number of independent observations in all frames: skin moves alike in each stride, and over
    some eighth of it. Chosen such that the stated deviations contain the truth as often as they
    should in synthetic walks (tests/test_registration.py)."""
    marker: float = 15.0 * MILLIMETRE
    """m: scale τ of a marker's distance from the model's position in each direction. Not studied:
    hands place markers to about this accuracy."""
    marker_freedom: float = 4.0
    """Degrees of freedom of Student's t of that distance. Single markers lie much
    farther away: of subject DM one by 80 mm."""
    joint: float = 5.0 * MILLIMETRE
    """m: deviation τ of hip and ankle centre in thigh and shank. An assumption: bone lengths from
    images err by less, and those scaled to markers by more."""
    offset_mm: tuple[float, float, float] = (3.0, 1.0, 2.0)
    """mm: deviation τ of the knee's mean AP, SI and ML offset. An assumption: the dishes of an
    insert allow no more."""
    offset_deg: tuple[float, float] = (2.0, 1.0)
    """deg: deviation τ of the knee's mean axial rotation and adduction. An assumption: two loaded
    condyles fix adduction to 1 deg, a dished insert axial rotation to a few degrees."""
    scatter_mm: tuple[float, float, float] = (3.0, 1.0, 2.0)
    """mm: deviation s of AP, SI and ML within a motion. An assumption, as for `offset_mm`."""
    scatter_deg: tuple[float, float] = (3.0, 1.0)
    """deg: deviation s of axial rotation and adduction within a motion. An assumption."""
    skin_mm: tuple[tuple[str, float], ...] = (
        ("shank", 6.0),
        ("thigh", 10.0),
        ("foot", 4.0),
        ("pelvis", 6.0),
    )
    """mm: smallest σ of a segment's markers. Residuals do not show skin that moves the markers of
    a segment together. Shank and thigh as in `SKIN_MARKER_ERROR`; foot and pelvis are
    assumptions."""
    noise_rounds: int = 6
    """Number of estimates of σ. The fourth changes it by less than 2 %."""
    tolerance: float = 1e-6
    """m and rad: the search ends after a smaller step. Far below the noise of markers."""
    max_iterations: int = 60
    """Largest number of steps per estimate of σ. Searches that converge need fewer than 20."""


REGISTRATION = RegistrationSettings()

KNEE_AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [-1, 0, 0], [0, 0, 1]], float)
"""Axes of the knee's three translations and three rotations, see `tkamb.geometry.frames`."""
HELD = 5
"""The first five knee coordinates have a prior; flexion has none."""


@dataclass(frozen=True, eq=False)
class Registration:
    """Registered markers of a leg. Deviations are standard deviations.

    Args:
        segments: the segments with the registered positions of markers and joints.
        residuals: "before" (with the model's positions) and "after" -> label -> root mean square
            residual of the rigid fit of its segment, m.
        deviation: label -> deviation of its position, m, (3,).
        prior: label -> deviation of its position by the model alone, m.
        noise: label -> its deviation σ about the fitted leg, m.
        joints: "hip" or "ankle" -> its shift in thigh or shank and the deviation, m, (3,) each.
        offset: mean offset of AP, SI, ML (m), axial rotation and adduction (rad), (5,).
        offset_deviation: its deviation, (5,).
        knee_distance: median distance of the knee centres of shank and thigh before and after, m.
        knee_centre: deviation of the knee's centre, as the shank's markers place it, in the axes
            of the shank, m, (3,).
        frontal_alignment: deviation of the shank's angle in the frontal plane, rad.
    """

    segments: tuple[ModelSegment, ...]
    residuals: dict[str, dict[str, float]]
    deviation: dict[str, Array]
    prior: dict[str, float]
    noise: dict[str, float]
    joints: dict[str, tuple[Array, Array]]
    offset: Array
    offset_deviation: Array
    knee_distance: tuple[float, float]
    knee_centre: Array
    frontal_alignment: float
    frames: int
    trials: tuple[str, ...]

    def rms(self, residuals: dict[str, float]) -> float:
        """Return the root mean square over shank and thigh, m."""
        labels = [k for s in self.segments if s.name in ("shank", "thigh") for k in s.points]
        return float(np.sqrt(np.mean([residuals[label] ** 2 for label in labels])))

    def data_share(self, label: str) -> float:
        """Return the share of a marker's prior variance that the data remove."""
        return 1.0 - float(np.mean(self.deviation[label] ** 2)) / self.prior[label] ** 2

    def shift(self, label: str, model: Sequence[ModelSegment]) -> Array:
        """Return the shift (3,) m of a marker from the model's position."""
        first, last = (
            next(s.points[label] for s in segments if label in s.points)
            for segments in (model, self.segments)
        )
        return np.asarray(last - first)


def register(
    links: Links, segments: Sequence[ModelSegment], trials: dict[str, dict[str, Array]]
) -> Registration:
    """Return the registered markers of a leg.

    Args:
        links: links of the leg; a left leg is not mirrored.
        segments: "shank" and "thigh", and their neighbours, with the model's markers.
        trials: trial -> segment -> measured markers (n, m, 3), m, in the laboratory, gaps NaN, in
            the order of the segment's points.
    """
    leg = _MarkedLeg(links, segments)
    measured = _chosen_frames(leg, trials)
    before = _rigid(leg.segments, measured)
    q = leg.start(before)
    theta, noise = np.zeros(leg.size), leg.skin
    target = np.concatenate([measured[s.name] for s in leg.segments], axis=1)
    for _ in range(REGISTRATION.noise_rounds):
        q, theta, covariance = _solved(leg, q, theta, target, noise)
        noise = _noise(leg, q, theta, target)
        leg.prior = leg.prior_at(theta)
    found = leg.moved(theta)
    after = _rigid(found, measured)
    deviations = np.sqrt(np.diag(covariance))
    labels = [label for s in leg.segments for label in s.points]
    joints = {
        {"pelvis": "hip", "foot": "ankle"}.get(s.name, s.name): (theta[part], deviations[part])
        for s, part in leg.joint_parts
    }
    knee, tilt = _knee_centre(leg, found, covariance)
    return Registration(
        tuple(found),
        {
            when: {label: rms for _, values in fits.values() for label, rms in values.items()}
            for when, fits in (("before", before), ("after", after))
        },
        {label: deviations[3 * k : 3 * k + 3] for k, label in enumerate(labels)},
        dict(zip(labels, leg.prior[: 3 * leg.markers : 3].tolist(), strict=True)),
        dict(zip(labels, noise.tolist(), strict=True)),
        joints,
        theta[-HELD:],
        deviations[-HELD:],
        (knee_distance(links, before), knee_distance(links, after)),
        knee,
        tilt,
        len(target),
        tuple(trials),
    )


def misfit(
    links: Links, segments: Sequence[ModelSegment], measured: dict[str, Array]
) -> tuple[float, float]:
    """Return how far the markers of a trial misfit the model's segments.

    Args:
        measured: segment -> measured markers (n, m, 3), m.

    Returns:
        Root mean square residual of the rigid fits of shank and thigh, m, and the median distance
        of the knee centres that they give, m.
    """
    bones = [s for s in segments if s.name in ("shank", "thigh")]
    fits = _rigid(bones, measured)
    squares = [rms**2 for _, values in fits.values() for rms in values.values()]
    return float(np.sqrt(np.mean(squares))), knee_distance(links, fits)


def knee_distance(links: Links, fits: dict[str, tuple[Array, dict[str, float]]]) -> float:
    """Return the median distance (m) of the knee centres that shank and thigh markers give."""
    knee = inverse(fits["shank"][0] @ links.insert_in_tibia) @ fits["thigh"][0]
    return float(np.nanmedian(np.linalg.norm(knee[:, :3, 3] - links.neutral[:3], axis=1)))


class _MarkedLeg:
    """Pinocchio's model of a leg: a free shank, the knee's six joints, balls at hip and ankle.

    θ has the shifts of the markers (3 each, in their segments), then of the balls, then the five
    mean offsets of the knee.
    """

    def __init__(self, links: Links, segments: Sequence[ModelSegment]) -> None:
        self.segments, self.insert = list(segments), links.insert_in_tibia
        self.neutral = links.neutral
        model = pin.Model()
        last = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "shank")
        self.joints = {"shank": last}
        place = pin.SE3(self.insert)
        for k, axis in enumerate(KNEE_AXES):
            kind = pin.JointModelPrismaticUnaligned if k < 3 else pin.JointModelRevoluteUnaligned
            last = model.addJoint(last, kind(axis), place, f"knee{k}")
            place = pin.SE3.Identity()
        self.joints["thigh"] = last
        self.balls = [s for s in self.segments if s.joined_to]
        for ball in self.balls:
            parent, at = self.joints[ball.joined_to], pin.SE3(np.eye(3), ball.joint)
            self.joints[ball.name] = model.addJoint(
                parent, pin.JointModelSpherical(), at, ball.name
            )
        self.model, self.data = model, model.createData()
        self.markers = sum(len(s.points) for s in self.segments)
        first = 3 * self.markers
        self.joint_parts = [
            (s, slice(first + 3 * k, first + 3 * k + 3)) for k, s in enumerate(self.balls)
        ]
        self.size = first + 3 * len(self.balls) + HELD
        settings = REGISTRATION
        units = np.array([MILLIMETRE] * 3 + [DEGREE] * 2)
        offset = np.array([*settings.offset_mm, *settings.offset_deg]) * units
        self.scatter = np.array([*settings.scatter_mm, *settings.scatter_deg]) * units
        self.held = np.concatenate([np.full(3 * len(self.balls), settings.joint), offset])
        self.prior = self.prior_at(np.zeros(self.size))
        skin = dict(settings.skin_mm)
        self.skin = np.concatenate(
            [np.full(len(s.points), skin[s.name] * MILLIMETRE) for s in self.segments]
        )
        # a ball's own centre is the origin of its frame here
        self.points = np.concatenate(
            [
                np.array(list(s.points.values())) - (0.0 if s.centre is None else s.centre)
                for s in self.segments
            ]
        )
        self.at = np.repeat(range(len(self.segments)), [len(s.points) for s in self.segments])

    def prior_at(self, theta: Array) -> Array:
        """Return the deviations τ (p,); those of markers are of Student's t at their shifts."""
        freedom, scale = REGISTRATION.marker_freedom, REGISTRATION.marker
        square = np.sum(theta[: 3 * self.markers].reshape(-1, 3) ** 2, axis=1)
        wide = np.sqrt((freedom + square / scale**2) / (freedom + 3.0))
        return np.concatenate([np.repeat(scale * wide, 3), self.held])

    def moved(self, theta: Array) -> list[ModelSegment]:
        shifts, k, found = theta[: 3 * self.markers].reshape(-1, 3), 0, []
        parts = {s.name: part for s, part in self.joint_parts}
        for s in self.segments:
            points = {}
            for label, point in s.points.items():
                points[label] = point + shifts[k]
                k += 1
            joint = None if s.joint is None else s.joint + theta[parts[s.name]]
            found.append(replace(s, points=points, joint=joint))
        return found

    def start(self, fits: dict[str, tuple[Array, dict[str, float]]]) -> Array:
        """Return (f, nq) from the rigid fits of the segments."""
        poses = {name: fit[0] for name, fit in fits.items()}
        shank, thigh = poses["shank"], poses["thigh"]
        q = np.tile(pin.neutral(self.model), (len(shank), 1))
        q[:, :7] = [pin.SE3ToXYZQUAT(pin.SE3(p)) for p in shank]
        knee = knee_coordinates(inverse(shank @ self.insert) @ thigh)
        q[:, 7:12], q[:, 12] = self.neutral[:HELD], knee[:, HELD]
        for ball in self.balls:
            start = self.model.idx_qs[self.joints[ball.name]]
            for k, (parent, own) in enumerate(
                zip(poses[ball.joined_to], poses[ball.name], strict=True)
            ):
                turn = parent[:3, :3].T @ own[:3, :3]
                if np.isfinite(turn).all():
                    q[k, start : start + 4] = pin.Quaternion(turn).coeffs()
        return q

    def at_state(self, q: Array, theta: Array) -> tuple[Array, Array, Array]:
        """Return marker positions (f, m, 3), Jacobians (f, m, 3, nv) and rotations (f, s, 3, 3)."""
        for ball, part in self.joint_parts:
            assert ball.joint is not None
            joint = self.model.jointPlacements[self.joints[ball.name]]
            joint.translation = ball.joint + theta[part]
        points = self.points + theta[: 3 * self.markers].reshape(-1, 3)
        order = [self.joints[s.name] for s in self.segments]
        poses = np.zeros((len(q), len(order), 4, 4))
        twists = np.zeros((len(q), len(order), 6, self.model.nv))
        for k, one in enumerate(q):
            pin.computeJointJacobians(self.model, self.data, one)
            for i, joint in enumerate(order):
                poses[k, i] = self.data.oMi[joint].homogeneous
                twists[k, i] = pin.getJointJacobian(
                    self.model, self.data, joint, pin.ReferenceFrame.WORLD
                )
        own = poses[:, self.at]
        x = np.einsum("fmij,mj->fmi", own[..., :3, :3], points) + own[..., :3, 3]
        moving = twists[:, self.at]
        jacobian = moving[:, :, :3] - skew(x) @ moving[:, :, 3:]
        return x, jacobian, poses[..., :3, :3]

    def of_theta(self, rotations: Array) -> Array:
        """Return the derivatives (f, m, 3, p) of the marker positions by θ."""
        result = np.zeros((len(rotations), self.markers, 3, self.size))
        for m, s in enumerate(self.at):
            result[:, m, :, 3 * m : 3 * m + 3] = rotations[:, s]
        names = [s.name for s in self.segments]
        for ball, part in self.joint_parts:
            rows = np.flatnonzero(self.at == names.index(ball.name))
            result[:, rows, :, part] = rotations[:, None, names.index(ball.joined_to)]
        return result


def _chosen_frames(leg: _MarkedLeg, trials: dict[str, dict[str, Array]]) -> dict[str, Array]:
    """Return segment -> measured markers (f, m, 3) of the frames with shank and thigh visible."""
    chosen: dict[str, list[Array]] = {s.name: [] for s in leg.segments}
    for markers in trials.values():
        seen = [np.isfinite(markers[n]).all(axis=2).sum(axis=1) >= 3 for n in ("shank", "thigh")]
        rows = np.flatnonzero(seen[0] & seen[1])
        stride = max(1, int(np.ceil(len(rows) * len(trials) / REGISTRATION.max_frames)))
        for name, parts in chosen.items():
            parts.append(markers[name][rows[::stride]])
    measured = {name: np.concatenate(parts) for name, parts in chosen.items()}
    if not len(measured["shank"]):
        raise InputError(
            "no frame shows three markers of shank and of thigh", ", ".join(trials), "leave it out"
        )
    return measured


def _rigid(
    segments: Sequence[ModelSegment], measured: dict[str, Array]
) -> dict[str, tuple[Array, dict[str, float]]]:
    """Return segment -> rigid fits (f, 4, 4), and label -> root mean square residual, m."""
    result = {}
    for s in segments:
        points = np.array(list(s.points.values()))
        poses, _ = fit_seen(measured[s.name], points, np.ones(len(points)), s.name)
        off = transform(poses, np.broadcast_to(points, measured[s.name].shape)) - measured[s.name]
        rms = np.sqrt(np.nanmean(np.sum(off**2, axis=2), axis=0))
        result[s.name] = (poses, dict(zip(s.points, rms.tolist(), strict=True)))
    return result


def _solved(
    leg: _MarkedLeg, q: Array, theta: Array, target: Array, noise: Array
) -> tuple[Array, Array, Array]:
    """Return poses, θ and its covariance at the minimum for given σ (m,)."""
    cost, equations = _equations(leg, q, theta, target, noise)
    for _ in range(REGISTRATION.max_iterations):
        own, cross, right, matrix, gradient = equations
        solved = np.linalg.solve(own, np.concatenate([cross, right[:, :, None]], axis=2))
        reduced = matrix - np.einsum("fiv,fiw->vw", cross, solved[:, :, :-1])
        step = np.linalg.solve(reduced, gradient - np.einsum("fiv,fi->v", cross, solved[:, :, -1]))
        frames = solved[:, :, -1] - solved[:, :, :-1] @ step
        size, share = max(np.abs(step).max(), np.abs(frames).max()), 1.0
        while share > 1e-3:
            moved = np.array(
                [
                    pin.integrate(leg.model, one, share * move)
                    for one, move in zip(q, frames, strict=True)
                ]
            )
            trial_cost, trial = _equations(leg, moved, theta + share * step, target, noise)
            if trial_cost <= cost * (1.0 + 1e-12):
                break
            share *= 0.5
        q, theta, cost, equations = moved, theta + share * step, trial_cost, trial
        if size < REGISTRATION.tolerance:
            return q, theta, np.linalg.inv(reduced)
    raise InputError(
        "the registration of the markers does not converge",
        "--register",
        "check the labels of the markers; two may be swapped",
    )


def _equations(
    leg: _MarkedLeg, q: Array, theta: Array, target: Array, noise: Array
) -> tuple[float, tuple[Array, Array, Array, Array, Array]]:
    """Return the cost, and the normal equations' blocks: frames, cross, θ, right sides."""
    x, jacobian, rotations = leg.at_state(q, theta)
    share = min(1.0, REGISTRATION.independent / len(q))
    visible = np.isfinite(target).all(axis=2)
    scale = np.where(visible, np.sqrt(share) / noise, 0.0)[:, :, None]
    off = (np.nan_to_num(target) - x) * scale
    frames = len(q)
    a = (jacobian * scale[..., None]).reshape(frames, -1, leg.model.nv)
    b = (leg.of_theta(rotations) * scale[..., None]).reshape(frames, -1, leg.size)
    r = off.reshape(frames, -1)
    weight = np.sqrt(share) / leg.scatter
    knee_q, knee_theta = np.zeros((HELD, leg.model.nv)), np.zeros((HELD, leg.size))
    knee_q[range(HELD), range(6, 6 + HELD)] = weight
    knee_theta[range(HELD), range(leg.size - HELD, leg.size)] = -weight
    knee_r = weight * (leg.neutral[:HELD] + theta[-HELD:] - q[:, 7 : 7 + HELD])
    own = np.swapaxes(a, 1, 2) @ a + knee_q.T @ knee_q
    own += 1e-9 * own.max() * np.eye(leg.model.nv)  # of a ball whose segment is not visible
    cross = np.swapaxes(a, 1, 2) @ b + knee_q.T @ knee_theta
    right = np.einsum("fki,fk->fi", a, r) + knee_r @ knee_q
    matrix = np.einsum("fki,fkj->ij", b, b, optimize=True) + frames * knee_theta.T @ knee_theta
    matrix += np.diag(leg.prior**-2)
    gradient = np.einsum("fki,fk->i", b, r) + knee_r.sum(axis=0) @ knee_theta
    gradient -= theta / leg.prior**2
    cost = float(np.sum(r**2) + np.sum(knee_r**2) + np.sum((theta / leg.prior) ** 2))
    return cost, (own, cross, right, matrix, gradient)


def _noise(leg: _MarkedLeg, q: Array, theta: Array, target: Array) -> Array:
    """Return σ (m,) m of each marker in each direction, from its residuals.

    The poses adapt to the markers, so that residuals have too few degrees of freedom.
    """
    x, _, _ = leg.at_state(q, theta)
    square = np.nanmean((target - x) ** 2, axis=(0, 2))
    free = 1.0 - (leg.model.nv - HELD) / (3.0 * leg.markers)
    return np.asarray(np.maximum(np.sqrt(square / free), leg.skin))


def _knee_centre(
    leg: _MarkedLeg, segments: Sequence[ModelSegment], covariance: Array
) -> tuple[Array, float]:
    """Return the deviation (3,) m of the knee's centre by the shank's markers, and of its tilt.

    A rigid fit turns errors e of the markers into a displacement d and a turn t of the shank,
    which minimise Σ |d + t × p - e|².
    """
    first = 0
    for s in segments:
        if s.name == "shank":
            break
        first += 3 * len(s.points)
    points = np.array(list(s.points.values()))
    rows = np.concatenate([np.tile(np.eye(3), (len(points), 1)), -skew(points).reshape(-1, 3)], 1)
    fit = np.linalg.pinv(rows)
    part = slice(first, first + 3 * len(points))
    pose = fit @ covariance[part, part] @ fit.T
    at_knee = np.hstack([np.eye(3), -skew(leg.insert[:3, 3])])
    centre = at_knee @ pose @ at_knee.T
    return np.sqrt(np.diag(centre)), float(np.sqrt(pose[3, 3]))
