"""Whether a force plate's centre of pressure lies on its surface, and the unit that puts it there.

A plate states its moments, or its points, in a unit of length. If this unit is wrong, the centre of
pressure leaves the surface, or it rests at the transducers' origin as no foot does.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.units import LENGTH

# N: vertical force above which the centre of pressure is checked. A smaller force
# makes it a quotient of small numbers.
LOADED_N = 100.0
# 1: share of the plate's half width by which the median centre of pressure may lie outside the
# corners. A loaded plate has smaller errors.
BESIDE = 0.2
# 1: if 95 % of the centres of pressure are closer to the transducers' origin than this share of
# both half widths, below a millimetre, the moments are too small. A foot's centre of pressure
# moves by centimetres.
RESTING = 0.003
# 1: another unit is accepted only if the farthest centre of pressure (95 %) is farther from the
# transducers' origin than this share of a half width.
MOVING = 0.05


USUAL, UNUSUAL = ("mm", "m"), ("cm", "inch")
"""Units of length in moments, which are tried in this order if the stated one is impossible."""


@dataclass(frozen=True)
class PressureRange:
    """Where the centres of pressure of a loaded plate lie, as shares of its half widths.

    Args:
        median: (2,) median distance from the surface's centre along x and y.
        origin: (2,) distance from the transducers' origin that 95 % of the samples keep.
    """

    median: Array
    origin: Array

    @property
    def beside(self) -> bool:
        """Whether most centres of pressure lie beside the surface."""
        return bool((self.median > 1.0 + BESIDE).any())

    @property
    def resting(self) -> bool:
        """Whether the centre of pressure rests at the transducers' origin."""
        return bool((self.origin < RESTING).all())

    @property
    def usual(self) -> bool:
        """Whether the centres of pressure are those of a foot on the plate."""
        return not self.beside and bool((self.origin > MOVING).any())


def pressure_range(
    corners: Array, force: Array, moment: Array, origin: Array
) -> PressureRange | None:
    """Return where the centres of pressure lie; None if the plate is not loaded.

    Args:
        corners: (4, 3) m.
        force: (k, 3) N, in the plate's axes.
        moment: (k, 3) N·m about the surface's centre, in the plate's axes.
        origin: (3,) m, vector from the transducers' origin to the surface's centre.
    """
    loaded = (np.abs(force[:, 2]) > LOADED_N) & np.isfinite(moment).all(axis=1)
    if not loaded.any():
        return None
    half = 0.5 * np.linalg.norm([corners[0] - corners[1], corners[0] - corners[3]], axis=1)
    shares = []
    for about in (moment[loaded], moment[loaded] + np.cross(origin, force[loaded])):
        point = np.stack([-about[:, 1], about[:, 0]], axis=1) / force[loaded, 2:3]
        shares.append(np.abs(point) / half)
    return PressureRange(np.median(shares[0], axis=0), np.percentile(shares[1], 95, axis=0))


def other_units(stated_m: float) -> Iterator[tuple[tuple[str, float], ...]]:
    """Yield groups of names and metres of units of length other than the stated one (m)."""
    for names in (USUAL, UNUSUAL):
        units = tuple((name, LENGTH[name]) for name in names)
        yield tuple(unit for unit in units if abs(unit[1] / stated_m - 1.0) > 1e-6)
