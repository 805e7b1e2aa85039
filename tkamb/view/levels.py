"""Pressure as a level per point whose zero is the edge of the contact.

A loaded point holds its share of the page's largest pressure. Between a loaded and an unloaded
point the contact ends where the level, drawn linearly, is zero: an unloaded point at the rim
holds minus its gap, scaled so that on average the rim lies halfway. This is for the eye; at the
points themselves the levels are the data's.
"""

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.view.drawing import PressureMap

LEVELS = 32767
"""Steps from no pressure to the largest."""


def levels(found: PressureMap, peak: float) -> NDArray[np.int16]:
    """Return levels (f, n): 1 to LEVELS where loaded, negative where not.

    Args:
        found: the map.
        peak: MPa, top of the scale; a higher pressure has the top level.
    """
    share = np.clip(np.nan_to_num(found.pressure) / (peak or 1.0), 0.0, 1.0)
    return np.stack(
        [_frame(one, gap, found.triangles) for one, gap in zip(share, found.gap, strict=True)]
    )


def _frame(share: Array, gap: Array, triangles: NDArray[np.int64]) -> NDArray[np.int16]:
    loaded = share > 0
    level = np.where(loaded, np.maximum(np.round(share * LEVELS), 1.0), -float(LEVELS))
    corners = loaded[triangles]
    rim = np.zeros(len(share), bool)
    rim[triangles[corners.any(axis=1) & ~corners.all(axis=1)]] = True
    outside, inside = rim & ~loaded, rim & loaded
    if outside.any():
        apart = np.maximum(np.nan_to_num(gap[outside]), 0.0)
        mean = float(apart.mean())
        relative = apart / mean if mean > 0 else np.ones(len(apart))
        level[outside] = -np.clip(relative * level[inside].mean(), 1.0, LEVELS)
    return level.astype(np.int16)
