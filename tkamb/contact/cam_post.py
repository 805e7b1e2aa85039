"""Cam and post as a separate contact pair: the same contact model, in a turned frame.

A cam touches the post from behind, so the post is turned with its posterior face up. In the insert
frame (x anterior, y superior, z to the right) the turned axes are

    x' = y - y_m,    y' = x_f - x,    z' = z - z_m,

where x_f is the flat front of the post (`tkamb.geometry.post.divide_insert`), and y_m and z_m are
the middle of the post's bounding box. The front is the fixed bottom of the layer, and the post's
depth its thickness: the post does not bend at its root. The pair is evaluated at a given pose, with
rotation R and translation t of pose_insert_in_turned.

X = [[R, t x R], [0, R]] maps a small displacement of the femur (translation of its point at the
origin, then rotation) into the turned frame. As power is the same in both, wrench and stiffness in
the insert frame are

    w = X^T w',    K = X^T K' X.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tkamb.contact.materials import Material
from tkamb.contact.model import CondyleWrench, ContactModel, ProbedContact, condyle_wrenches
from tkamb.contact.pair import ContactPair
from tkamb.contact.result import ContactResult, ContactStatus
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, rotate, transform
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

WHERE = "[contact] post"
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rows: the turned axes in the insert frame."""
UP = np.array([0.0, 1.0, 0.0])


# m: height above the post at which rays along -y' begin. It is well above the noise
# of a mesh.
RAY_START_HEIGHT = 1e-3
# m: distance beside the post up to which triangles belong to the cam. The femur
# moves from side to side.
SEARCH_MARGIN = 3 * MILLIMETRE


TICKS, ZOOMS = 41, 3
"""Rays along each edge of a search grid, and grids, each twenty times finer than the one before. On
16 mm the last one has a spacing of 1 µm.
"""
NO_LINE_CONTACT = ("hertz",)
"""Models that cannot compute contact along a line."""


class PostPair(ContactPair):
    """A cam and a post in the turned frame: one contact without medial and lateral side."""

    @property
    def split(self) -> None:
        """None, because cam and post have no medial and lateral side."""

    def clearance(self, pose: Array) -> float:
        """Return the smallest gap (m) along y' of post and cam; NaN if no line along y' meets both.

        Rays along y' on a grid over the post find it; two finer grids follow. A search over
        vertices would miss contact on the edges of long triangles. `pose` (4, 4) is
        pose_femoral_in_turned.
        """
        low, high = self.insert.bounds[:, [0, 2]]
        least = np.nan
        for _ in range(ZOOMS):
            ticks = np.linspace(low, high, TICKS)
            x, z = (grid.ravel() for grid in np.meshgrid(*ticks.T, indexing="ij"))
            gap = self._apart(np.column_stack([x, np.zeros_like(x), z]), pose)
            if not np.isfinite(gap).any():
                break
            k = int(np.nanargmin(gap))
            # The next grid covers one cell on each side of the smallest gap: it is 20 times finer.
            least, cell = float(gap[k]), (high - low) / (TICKS - 1)
            place = np.array([x[k], z[k]])
            low = np.maximum(place - cell, self.insert.bounds[0, [0, 2]])
            high = np.minimum(place + cell, self.insert.bounds[1, [0, 2]])
        return least

    def _apart(self, points: Array, pose: Array) -> Array:
        """Return the gap (n,), m, along y' at places (n, 3); NaN where a ray misses a body."""
        far, back = float(np.abs(self.femoral.bounds).max()), inverse(pose)
        below = points + (pose[1, 3] - 2 * far) * UP
        up, _ = self.femoral.rays.first(transform(back, below), rotate(back, UP))
        above = points + (self.insert.bounds[1, 1] + RAY_START_HEIGHT) * UP
        down, _ = self.insert.rays.first(above, -UP)
        gap = (below[:, 1] + up) - (above[:, 1] - down)
        return np.where(np.isfinite(gap), gap, np.nan)


@dataclass(frozen=True, eq=False)
class PostContact:
    """Contact of cam and post at one pose, insert frame, SI. Without contact the force is zero.

    Args:
        load: wrench of the normal forces on the insert; None without contact.
        gap: m, along x between cam and post; negative if they overlap.
        problem: reason why there is no result; empty if there is one.
    """

    load: CondyleWrench | None
    gap: float
    area: float = 0.0
    peak_pressure: float = 0.0
    flags: tuple[str, ...] = ()
    problem: str = ""

    @property
    def force(self) -> Array:
        """(3,) N, force on the insert; NaN if it could not be computed."""
        if self.problem:
            return np.full(3, np.nan)
        return np.zeros(3) if self.load is None else self.load.wrench[:3]

    @property
    def centre(self) -> Array:
        """(3,) m, centre of pressure; NaN without contact."""
        return np.full(3, np.nan) if self.load is None else self.load.centre


class CamPost:
    """A contact model prepared for a cam and a post, each in its own frame.

    The closed post is flat in front (`divide_insert`). `split` is z (m) between the condyles.
    """

    def __init__(
        self,
        model: ContactModel,
        femoral: Surface,
        post: Surface,
        split: float | None,
        material: Material,
    ) -> None:
        if model.name in NO_LINE_CONTACT:
            hint = "take foundation, lattice or fe"
            raise InputError(f"contact model '{model.name}' has no line contact", WHERE, hint)
        # The post is turned so that its back faces up, because contact models press along -y.
        low, high = post.bounds
        front = np.array([high[0], (low[1] + high[1]) / 2, (low[2] + high[2]) / 2])
        self.in_turned = np.eye(4)
        self.in_turned[:3, :3], self.in_turned[:3, 3] = TURN, -TURN @ front
        cam = cam_of(femoral, split, (high[2] - low[2]) / 2 + SEARCH_MARGIN)
        self._foot = float(low[1])
        self._prepare(model, PostPair(cam, post.moved(self.in_turned), material))

    def _prepare(self, model: ContactModel, pair: ContactPair) -> None:
        self.model, self.state = model, model.prepare(pair)

    @property
    def material(self) -> Material:
        """Material of the post."""
        return self.state.pair.material

    def of_material(self, material: Material) -> "CamPost":
        """Return this contact with another material of the post."""
        other = object.__new__(CamPost)
        other.in_turned, other._foot = self.in_turned, self._foot
        other._prepare(self.model, replace(self.state.pair, material=material))
        return other

    def at(self, pose: Array) -> PostContact:
        """Return the contact at a pose_femoral_in_insert (4, 4)."""
        gap = self.clearance(pose)
        result = self.model.evaluate(self.state, self.in_turned @ pose)
        if result.status is not ContactStatus.OK:
            words = "; ".join((result.status.value.replace("_", " "), *result.flags))
            reason = words.replace("insert's thickness", "post's depth")
            reason = reason.replace("insert's edge", "post's edge")
            overlap = f", overlap {-gap / MILLIMETRE:.1f} mm" if gap < 0 else ""
            return PostContact(None, gap, problem=f"cam-post contact {reason}{overlap}")
        if result.medial is None:
            return PostContact(None, gap)
        return PostContact(
            self._in_insert(condyle_wrenches(result, None)["medial"]),
            gap,
            result.medial.area,
            result.medial.peak_pressure,
            self._flags(result),
        )

    def clearance(self, pose: Array) -> float:
        """Return the smallest gap (m) along x between cam and post at a pose (4, 4).

        It is negative if they overlap, and NaN if the cam does not lie behind the post.
        """
        pair: PostPair = self.state.pair
        return pair.clearance(self.in_turned @ pose)

    def probe(self) -> "PostProbe":
        """Return the probe of the post for a search of equilibrium, insert frame."""
        return PostProbe(self, self.model.probe(self.state))

    def probe_with(self, condyles: Any) -> Any:
        """Return a probe of the condyles and the post together."""
        return CondylesAndPost(condyles, self.probe())

    def seen(self, contact: ProbedContact) -> ProbedContact:
        """Return the post's contact in the insert frame, from the turned frame."""
        load = contact.condyles.get("medial")
        post = None if load is None else self._in_insert(load)
        return replace(contact, condyles={}, post=post)

    def _in_insert(self, load: CondyleWrench) -> CondyleWrench:
        x = twist_matrix(self.in_turned)
        # The transposed matrix transforms the wrench, so that the work is the same in both frames.
        stiffness = None if load.stiffness is None else x.T @ load.stiffness @ x
        centre = transform(inverse(self.in_turned), load.centre)
        slope = load.centre_slope
        if slope is not None:
            slope = self.in_turned[:3, :3].T @ slope @ x
        return CondyleWrench(x.T @ load.wrench, centre, stiffness, slope)

    def _flags(self, result: ContactResult) -> tuple[str, ...]:
        loaded = transform(inverse(self.in_turned), result.points[result.pressure > 0])
        words = [flag.replace("medial", "post") for flag in result.flags]
        if loaded[:, 1].min() < self._foot + self.model.resolution:
            words.append("cam meets the foot of the post: contact below the foot is not modelled")
        return tuple(words)


class PostProbe:
    """Evaluates cam and post at neighbouring poses; see `tkamb.contact.model.Probe`."""

    def __init__(self, cam_post: CamPost, turned_probe: Any) -> None:
        self._cam_post, self._turned = cam_post, turned_probe

    def at(self, pose: Array) -> ProbedContact:
        """Return the post's contact at a pose_femoral_in_insert (4, 4)."""
        return self._cam_post.seen(self._turned.at(self._cam_post.in_turned @ pose))


class CondylesAndPost:
    """Evaluates condyles and post as one contact."""

    def __init__(self, condyles: Any, post: PostProbe) -> None:
        self._condyles, self._post = condyles, post

    def at(self, pose: Array) -> ProbedContact:
        """Return the contact at a pose_femoral_in_insert (4, 4)."""
        return _together(self._condyles.at(pose), self._post.at(pose))

    def smoothed(self, pose: Array, contact: ProbedContact) -> ProbedContact:
        """Return the contact with the condyles' stiffness smoothed, the post's unchanged."""
        condyles = self._condyles.smoothed(pose, replace(contact, post=None))
        return _together(condyles, replace(contact, condyles={}))


def _together(condyles: ProbedContact, post: ProbedContact) -> ProbedContact:
    return ProbedContact(
        condyles.condyles,
        condyles.known and post.known,
        condyles.tangent and post.tangent,
        condyles.exact and post.exact,
        max(condyles.accuracy, post.accuracy),
        post.post,
    )


def twist_matrix(pose: Array) -> Array:
    """Return X (6, 6), which transforms a twist (translation, then rotation) from frame A to B.

    `pose` is pose_A_in_B (4, 4).
    """
    turn, (x, y, z) = pose[:3, :3], pose[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[turn, cross @ turn], [np.zeros((3, 3)), turn]])


def cam_of(femoral: Surface, split: float | None, reach: float) -> Surface:
    """Return the cam: the triangles between the condyles in the posterior half.

    `split` and `reach`, the cam's largest distance from it, are along z (m), femoral frame.
    """
    if split is None:
        hint = "leave the key out, or give a component with two condyles"
        raise InputError("one condyle has no cam", WHERE, hint)
    # z of the triangles' corners, measured from the plane between the condyles.
    across = femoral.triangles[:, :, 2] - split
    behind = femoral.triangles[:, :, 0].max(axis=1) < femoral.bounds[:, 0].mean()
    chosen = behind & (across.min(axis=1) < reach) & (across.max(axis=1) > -reach)
    if not chosen.any():
        problem = "the femoral component has no cam between its condyles"
        raise InputError(problem, WHERE, "leave the key out, or give the mesh with its cam")
    used, faces = np.unique(femoral.faces[chosen], return_inverse=True)
    return Surface(femoral.vertices[used], faces.reshape(-1, 3).astype(np.int64), "cam")
