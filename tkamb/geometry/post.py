"""The post of an insert: its search, and its separation from the dishes.

In a posterior-stabilised insert a cam of the femoral component pushes the post from behind. Contact
models that press along y do not include this. `divide_insert` divides the insert into the dishes
for the condyles and the post for the cam.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.height_field import inside_intervals
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import connected_parts
from tkamb.units import MILLIMETRE

# m: smallest distance of the plane from a vertex. It is above rounding.
VERTEX_CLEARANCE = 1e-9
# m: step by which the plane is moved until its distance from all vertices is at least
# `VERTEX_CLEARANCE`. Not studied.
PLANE_SHIFT = 1e-7


# m: spacing of the lines along y that measure the insert's height. A post is
# several times as wide.
LINE_SPACING = 1e-3
# m: smallest rise of a post above the lowest dish. Flanks and lips of dishes are
# lower.
LEAST_RISE = 8e-3
# m: smallest drop of a steep side of a post within two lines. This slope of 56 deg
# is steeper than a dish.
SIDE_DROP = 3e-3
# 1: smallest share of a post's outline with a drop of `SIDE_DROP`. A post may merge
# into the insert along the rest.
STEEP_SHARE = 0.75
# 1: largest distance of a post's centre from the middle, as a share of half the insert's width.
# Dishes lie farther out.
MIDDLE_SHARE = 0.25
# m: height above the surroundings at which the post is cut off. It is above the
# noise of a mesh.
FOOT_CLEARANCE = 0.25e-3
# 1: height above the foot at which the post's front is measured, as a share of its height.
BACK_SHARE = 0.75
# m: smallest thickness of a post. A thinner post cannot carry the force of a cam.
LEAST_THICKNESS = 2e-3


FOOT_RING = (3, 5)
"""Inner and outer distance, in lines, of a ring around the post, beyond its slanted sides, where
the surroundings' height is measured.
"""


@dataclass(frozen=True)
class Post:
    """Position and size of a post, insert frame, SI.

    Args:
        x: m, of the centre, like `z`.
        height: m, height of the tip above the lowest dish.
        foot: m, y of the plane at which the post is cut off.
        front: m, x of the anterior face, at three quarters of the height above the foot.
        half_width: m, along z; `area` is that in the plan view.
    """

    x: float
    z: float
    height: float
    area: float
    foot: float
    front: float
    half_width: float

    @property
    def notice(self) -> str:
        """Notice that cam-post contact is not modelled."""
        return (
            f"post at x = {self.x / MILLIMETRE:.0f}, z = {self.z / MILLIMETRE:.0f} mm, "
            f"{self.height / MILLIMETRE:.0f} mm above the dishes: cam-post contact is not modelled "
            "without [contact] post"
        )


def find_post(insert: Surface) -> Post | None:
    """Return the post of an insert (insert frame); None if it has none.

    A post is a part of the upper surface that rises at least 8 mm above the lowest dish, lies in
    the middle of the width and is steep along 3/4 of its outline.
    """
    low, high = insert.bounds
    x, z = (np.arange(low[a] + LINE_SPACING / 2, high[a], LINE_SPACING) for a in (0, 2))
    intervals = inside_intervals(insert, 1, z, x)
    top = np.full((len(x), len(z)), -np.inf)
    np.maximum.at(top, (intervals.second, intervals.first), intervals.upper)
    dish = float(np.percentile(top[np.isfinite(top)], 2.0))
    patches, count = label(top > dish + LEAST_RISE)
    for number in range(1, count + 1):
        patch = patches == number
        i, k = np.nonzero(patch)
        centred = abs(z[k].mean() - (low[2] + high[2]) / 2) < MIDDLE_SHARE * (high[2] - low[2]) / 2
        if centred and patch.sum() >= 9 and _steep_share(top, patch) >= STEEP_SHARE:
            tip = float(top[patch].max())
            foot = _ground(top, patch, dish) + FOOT_CLEARANCE
            if tip <= foot:  # the surroundings are higher
                continue
            upper_part = patch & (top > foot + BACK_SHARE * (tip - foot))
            return Post(
                x=float(x[i].mean()),
                z=float(z[k].mean()),
                height=tip - dish,
                area=len(i) * LINE_SPACING**2,
                foot=foot,
                front=float(x[np.nonzero(upper_part)[0]].max()),
                half_width=float(np.ptp(z[k]) / 2 + LINE_SPACING / 2),
            )
    return None


def divide_insert(insert: Surface) -> tuple[Surface, Surface]:
    """Return the insert without its post, and the post, both closed, insert frame.

    A horizontal plane just above the surroundings separates them. In front the post is cut at a
    plane x = const, the fixed bottom of the cam-post contact; the material in front of it is
    removed.
    """
    post, where = find_post(insert), "[contact] post"
    if post is None:
        raise InputError("the insert has no post", where, "leave the key out")
    vertices, below, above = split_faces(*merged(insert.vertices, insert.faces), 1, post.foot)
    number = connected_parts(above)
    middles = vertices[above].mean(axis=1)[:, [0, 2]]
    in_post = number == number[np.hypot(*(middles - [post.x, post.z]).T).argmin()]
    dishes = closed_by_fans(vertices, np.concatenate([below, above[~in_post]]), insert.name)
    vertices, behind, _ = split_faces(
        *closed_by_fans(vertices, above[in_post], "post"), 0, post.front
    )
    if not len(behind) or np.ptp(vertices[behind][:, :, 0]) < LEAST_THICKNESS:
        raise InputError("the post has no depth that could carry a cam", where, "leave it out")
    return Surface(*dishes, insert.name), Surface(*closed_by_fans(vertices, behind, "post"), "post")


def _ground(top: Array, patch: Mask, dish: float) -> float:
    """Return the largest y (m) around a patch; `dish` if there is none."""
    near, far = (binary_dilation(patch, iterations=n) for n in FOOT_RING)
    ring = top[far & ~near]
    return float(ring[np.isfinite(ring)].max(initial=dish))


def _steep_share(top: Array, patch: Mask) -> float:
    """Return the share of the lines around a patch that end at least `side_drop` below the edge."""
    near = binary_dilation(patch)
    around = binary_dilation(near, iterations=1) & ~near
    edge = float(np.median(top[patch & binary_dilation(~patch)]))
    return float(np.mean(top[around] < edge - SIDE_DROP)) if around.any() else 0.0


def split_faces(
    vertices: Array, faces: Index, axis: int, level: float
) -> tuple[Array, Index, Index]:
    """Return all vertices, and the faces below and above a plane.

    The plane crosses `axis` at `level` (m), moved off the vertices (`CUT`). Crossed triangles are
    divided; their new vertices are shared. No two `vertices` (n, 3), m, are at the same place.
    """
    height = vertices[:, axis] - level
    while (np.abs(height) < VERTEX_CLEARANCE).any():
        height -= PLANE_SHIFT
    above = height[faces] > 0
    count = above.sum(axis=1)
    crossed = np.flatnonzero((count == 1) | (count == 2))
    # The corners are rotated, so that the single corner on one side of the plane comes first.
    lone = np.where((count[crossed] == 1)[:, None], above[crossed], ~above[crossed]).argmax(axis=1)
    a, b, c = (faces[crossed, (lone + i) % 3] for i in range(3))
    edges = np.sort(np.stack([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=-1)
    unique, number = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    first, second = height[unique[:, 0]], height[unique[:, 1]]
    share = (first / (first - second))[:, None]
    start, end = vertices[unique[:, 0]], vertices[unique[:, 1]]
    p, q = (len(vertices) + number).reshape(2, -1)
    tips = np.stack([a, p, q], axis=1)
    rests = np.concatenate([np.stack([p, b, c], axis=1), np.stack([p, c, q], axis=1)])
    tip_above = count[crossed] == 1
    rest_above = np.tile(~tip_above, 2)
    lower = [faces[count == 0], tips[~tip_above], rests[~rest_above]]
    upper = [faces[count == 3], tips[tip_above], rests[rest_above]]
    joined = np.concatenate([vertices, start + share * (end - start)])
    return joined, np.concatenate(lower), np.concatenate(upper)


def closed_by_fans(vertices: Array, faces: Index, name: str) -> tuple[Array, Index]:
    """Return vertices and faces of the surface; a fan of triangles closes every hole.

    The holes are plane; `name` of the part is for a message.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key, back = (edges * [len(vertices), 1]).sum(1), (edges * [1, len(vertices)]).sum(1)
    rim = edges[~np.isin(key, back)]
    for number in np.unique(loops := _loops(rim, len(vertices))):
        outline = rim[loops == number]
        start, end = vertices[outline[:, 0]], vertices[outline[:, 1]]
        length = np.linalg.norm(end - start, axis=1)
        middle = length @ (start + end) / 2 / length.sum()
        normals = np.cross(start - middle, end - middle)
        if (normals @ normals.sum(axis=0) < 0).any():
            raise InputError(
                "its outline where it is cut off cannot be closed",
                name,
                "give a post with a convex outline, or leave out [contact] post",
            )
        fan = np.column_stack([outline[:, ::-1], np.full(len(outline), len(vertices))])
        vertices, faces = np.vstack([vertices, middle]), np.concatenate([faces, fan])
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int64)


def _loops(edges: Index, count: int) -> Index:
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1][edges[:, 0]], np.int64)


def merged(vertices: Array, faces: Index) -> tuple[Array, Index]:
    """Return the surface with vertices at the same place merged."""
    places, number = np.unique(vertices, axis=0, return_inverse=True)
    return places, number.reshape(-1)[faces].astype(np.int64)
