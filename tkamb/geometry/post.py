"""A post on the insert: found so that nobody takes cam-post contact for modelled.

A posterior-stabilised insert carries a post that meets a cam of the femoral component
sideways. Contact along y, as modelled here, cannot see that.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, label

from tkamb.geometry.frames import Array, Mask
from tkamb.geometry.height_field import inside_intervals
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

SPACING = 1e-3
"""m between the lines along y."""
POST_RISE = 8e-3
"""m: what stands higher than this above the dishes may be a post."""
SIDE_DROP = 3e-3
"""m: a side of a post falls by this within two lines (56 deg) ..."""
STEEP_SHARE = 0.75
"""... on at least this share of its outline."""
MIDDLE_SHARE = 0.25
"""The centre of a post lies within this share of the width from the middle."""


@dataclass(frozen=True)
class Post:
    """A post: where it stands and how high it is, insert frame.

    Args:
        x: m, its centre.
        z: m, its centre.
        height: m, of its tip above the lowest dish.
        area: m², its footprint.
    """

    x: float
    z: float
    height: float
    area: float

    @property
    def notice(self) -> str:
        """Say what is not modelled."""
        return (
            f"post at x = {self.x / MILLIMETRE:.0f}, z = {self.z / MILLIMETRE:.0f} mm, "
            f"{self.height / MILLIMETRE:.0f} mm above the dishes: cam-post contact is not modelled"
        )


def find_post(insert: Surface) -> Post | None:
    """Return the post of an insert (insert frame), None if it has none.

    A post is a patch of the top that stands at least 8 mm above the lowest dish, steep on
    3/4 of its outline, in the middle of the width.
    """
    low, high = insert.bounds
    x, z = (np.arange(low[a] + SPACING / 2, high[a], SPACING) for a in (0, 2))
    found = inside_intervals(insert, 1, z, x)
    top = np.full((len(x), len(z)), -np.inf)
    np.maximum.at(top, (found.second, found.first), found.upper)
    dish = float(np.percentile(top[np.isfinite(top)], 2.0))
    patches, count = label(top > dish + POST_RISE)
    for number in range(1, count + 1):
        patch = patches == number
        i, k = np.nonzero(patch)
        centred = abs(z[k].mean() - (low[2] + high[2]) / 2) < MIDDLE_SHARE * (high[2] - low[2]) / 2
        if centred and patch.sum() >= 9 and _steep_share(top, patch) >= STEEP_SHARE:
            height = float(top[patch].max() - dish)
            return Post(float(x[i].mean()), float(z[k].mean()), height, len(i) * SPACING**2)
    return None


def _steep_share(top: Array, patch: Mask) -> float:
    """Return the share of the columns around a patch that lie far below its edge."""
    near = binary_dilation(patch)
    around = binary_dilation(near, iterations=1) & ~near
    edge = float(np.median(top[patch & ~_eroded(patch)]))
    return float(np.mean(top[around] < edge - SIDE_DROP)) if around.any() else 0.0


def _eroded(patch: Mask) -> Mask:
    return ~binary_dilation(~patch)
