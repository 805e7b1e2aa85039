"""Taut paths of ligament bundles over surfaces, and their pulls on the links.

Let L be the length of the shortest path over the surfaces (`tkamb.knee.taut_strings`), and T its
tension, constant along the path without friction. The wrench on a link is -T dL/dx for its
displacement x: the tension pulls along the straight parts at their ends and presses on a surface
where the path meets and leaves it. The sum of all wrenches is zero.

If an end of the path moves into an ellipsoid, this shrinks, so that L is continuous. Inside a
cylinder, a sphere or a section there is no path.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, Index, inverse, transform
from tkamb.knee.taut_strings import Tension, WrappedStrings, inside, strings_over

if TYPE_CHECKING:
    from tkamb.knee.ligaments import Ligament


@dataclass(frozen=True, eq=False)
class BundlePaths:
    """Taut paths of n bundles at poses of leading shape (...).

    Args:
        length: lengths, m, (n, ...); NaN if there is no taut path.
        points: proximal end, points where the path meets and leaves each of w surfaces, distal end,
            m, (n, ..., 2 + 2w, 3). For a surface that is not touched the point before it is
            repeated.
        wrenches: link -> force and moment about the origin per newton of tension, shape
            (n, ..., 6).
    """

    length: Array
    points: Array
    wrenches: dict[str, Array]


def bundle_paths(bundles: Sequence["Ligament"], poses: Mapping[str, Array]) -> BundlePaths:
    """Return the taut paths of bundles between the same two links over the same surfaces.

    `poses` (..., 4, 4) are those of the links in the frame of the result.
    """
    links, wraps = bundles[0].links, bundles[0].wraps
    placed = np.broadcast_arrays(*(np.asarray(poses[link], float) for link in links))
    shape, count = (len(bundles), *placed[0].shape[:-2]), len(wraps)
    flat = {link: pose.reshape(-1, 4, 4) for link, pose in zip(links, placed, strict=True)}
    of_ends = [(bundle.proximal, bundle.distal) for bundle in bundles]
    ends = np.stack(
        [np.concatenate([transform(flat[e.link], e.position) for e in one])
         for one in zip(*of_ends, strict=True)]
    )  # fmt: skip
    objects = np.stack([flat[wrap.body] @ wrap.pose for wrap in wraps], axis=1)
    objects = np.tile(objects, (len(bundles), 1, 1, 1))
    rows = np.arange(ends.shape[1])
    # Every end counts as moving: an ellipsoid shrinks with it, and no string ignores the ellipsoid.
    strings = strings_over(
        wraps,
        objects,
        ends[0],
        ends[1],
        np.tile([wrap.active for wrap in wraps], (len(rows), 1)),
        np.ones((len(rows), count, 2), bool),
    )
    bodies = np.array([links.index(wrap.body) for wrap in wraps])
    at_ends = np.array([links.index(end.link) for end in of_ends[0]])
    work = Tension(np.stack([*ends], axis=1), np.zeros(2, int), at_ends, (1, len(links)))
    work.pull_wrapped(rows, 0, np.ones(len(rows), int), strings, bodies)
    work.press_points()
    lost = np.zeros(len(rows), bool)
    for w, wrap in enumerate(wraps):
        back = inverse(objects[:, w])
        for end in ends:
            local = np.einsum("fij,fj->fi", back[:, :3, :3], end) + back[:, :3, 3]
            lost |= inside(wrap, local) & wrap.active
    length = np.where(lost, np.nan, work.lengths.sum(axis=1))
    # `Tension` has the moment above the force.
    wrench = np.roll(work.wrenches[:, 0], 3, axis=-1)
    return BundlePaths(
        length.reshape(shape),
        _points(ends, strings, rows).reshape(*shape, 2 + 2 * count, 3),
        {link: wrench[:, k].reshape(*shape, 6) for k, link in enumerate(links)},
    )


def taut_wrenches(
    bundles: Sequence["Ligament"], poses: Mapping[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Return tensions (n, ...), N, and link -> forces and moments (n, ..., 6) about the origin.

    Bundles between the same links over the same surfaces are computed together.

    Raises:
        ComputationError: a bundle has no taut path at one of the poses.
    """
    alike: dict[Any, list[int]] = {}
    for k, bundle in enumerate(bundles):
        key = (bundle.proximal.link, bundle.distal.link, *(w.key for w in bundle.wraps))
        alike.setdefault(key, []).append(k)
    tensions: list[Array] = [np.empty(0)] * len(bundles)
    wrenches: dict[str, list[Array]] = {}
    for which in alike.values():
        paths = bundle_paths([bundles[k] for k in which], poses)
        for k, length in zip(which, paths.length, strict=True):
            if np.isnan(length).any():
                names = ", ".join(wrap.name for wrap in bundles[k].wraps)
                raise ComputationError(f"no taut path over {names}", f"ligament {bundles[k].name}")
            tensions[k] = bundles[k].force(length)
        for link, unit in paths.wrenches.items():
            found = wrenches.setdefault(link, [np.zeros_like(unit[0])] * len(bundles))
            for k, wrench in zip(which, unit, strict=True):
                found[k] = tensions[k][..., None] * wrench
    return np.array(tensions), {link: np.array(found) for link, found in wrenches.items()}


def _points(ends: Array, strings: WrappedStrings, rows: Index) -> Array:
    place, points = ends[0], [ends[0]]
    for gap in range(strings.order.shape[1]):
        touched = strings.order[:, gap]
        for at in (strings.entry, strings.exit):
            place = np.where((touched >= 0)[:, None], at[rows, touched], place)
            points.append(place)
    return np.stack([*points, ends[1]], axis=1)
