"""How the femoral component moves when one knee coordinate does."""

import numpy as np
from numpy.typing import ArrayLike

from tkamb.geometry.frames import Array


def knee_axes(coordinates: ArrayLike) -> Array:
    """Return the femur's twist per unit rate of each knee coordinate.

    A wrench w (force, moment about the insert's origin) on the femur does the generalised
    forces `knee_axes(q) @ w` in the six coordinates.

    Args:
        coordinates: (..., 6) knee coordinates, m and rad.

    Returns:
        (..., 6, 6): row i is the velocity of the femoral point at the insert's origin and the
        angular velocity, insert frame, for a unit rate of coordinate i.
    """
    c = np.asarray(coordinates, float)
    axes = np.zeros((*c.shape[:-1], 6, 6))
    axes[..., [0, 1, 2], [0, 1, 2]] = 1.0
    turn, tilt = c[..., 3], c[..., 4]
    axes[..., 3, 4] = -1.0
    axes[..., 4, 3], axes[..., 4, 5] = -np.cos(turn), -np.sin(turn)
    axes[..., 5, 3] = -np.sin(turn) * np.cos(tilt)
    axes[..., 5, 4] = np.sin(tilt)
    axes[..., 5, 5] = np.cos(turn) * np.cos(tilt)
    axes[..., 3:, :3] = np.cross(c[..., None, :3], axes[..., 3:, 3:])
    return axes
