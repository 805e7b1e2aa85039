"""An insert: a height field with two dishes over a kidney-shaped outline, flat below.

Each dish is a coronal arc moved along a sagittal arc, so both curvatures are exact at its lowest
line. The eminence between is an arc tangent to both.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tkamb.geometry.frames import Array
from tkamb.studies.designs import solids
from tkamb.studies.designs.femoral import rounded_edge

# mm: distance from the middle within which unequal dishes blend. Contacts lie
# outside it.
BLEND_HALF_WIDTH = 8.0


@dataclass(frozen=True)
class Post:
    """A posterior-stabilising post; mm, insert frame.

    Args:
        height: height above the lowest points of the dishes.
        draft: distance by which the faces lean inwards between base and top.
    """

    posterior: float
    anterior: float
    half_width: float
    height: float
    corner_radius: float = 2.0
    draft: float = 2.0

    def rise(self, x: ArrayLike, z: ArrayLike) -> Array:
        """Return the height (...) above the lowest points of the dishes; 0 outside a rectangle with
        rounded corners.
        """
        half = np.array([(self.anterior - self.posterior) / 2.0, self.half_width])
        middle = (self.anterior + self.posterior) / 2.0
        offset = np.abs(np.stack(np.broadcast_arrays(np.asarray(x) - middle, z), axis=-1))
        corner = offset - (half - self.corner_radius)
        outside = np.linalg.norm(np.maximum(corner, 0.0), axis=-1)
        inside = np.minimum(corner.max(axis=-1), 0.0)
        distance = self.corner_radius - outside - inside
        return np.asarray(self.height * np.clip(distance / self.draft, 0.0, 1.0))


@dataclass(frozen=True)
class Insert:
    """A right insert; lengths in mm, insert frame (x anterior, y superior, z lateral).

    Args:
        medial_dish_radii: sagittal radii of the medial dish, anterior and posterior to its lowest
            point.
        lateral_dish_radii: sagittal radii of the lateral dish, in the same order.
        thickness: smallest thickness.
        low_point_ap: anterior position of the lowest points of both dishes.
        dish_half: ML distance of the lowest lines of the dishes from the middle.
        eminence_height: height of the eminence above the lowest points of the dishes.
        notch_width: half the ML width of the notch where its depth has fallen to 37 %.
    """

    medial_dish_radii: tuple[float, float]
    lateral_dish_radii: tuple[float, float]
    coronal_radius: float = 25.0
    thickness: float = 9.5
    low_point_ap: float = -2.0
    dish_half: float = 23.0
    eminence_height: float = 4.0
    depth_half: float = 24.0
    width_half: float = 37.0
    notch_depth: float = 7.0
    notch_width: float = 9.0
    edge_fillet: float = 2.0
    post: Post | None = None

    def eminence_radius(self) -> float:
        """Return the radius of the eminence's arc, which is tangent to both dishes."""
        r, h, w = self.coronal_radius, self.eminence_height, self.dish_half
        return (w**2 + (r - h) ** 2 - r**2) / (2.0 * h)

    def height(self, x: ArrayLike, z: ArrayLike) -> Array:
        """Return the height of the articular surface above the flat bottom, mm."""
        x, z = np.broadcast_arrays(x, z)
        dishes = self._sagittal(x, z) + self._coronal(z)
        if self.post is not None:
            dishes = np.maximum(dishes, self.post.rise(x, z))
        return np.asarray(self.thickness + dishes)

    def mesh(self) -> tuple[Array, NDArray[np.int64]]:
        """Return a closed triangulation in the insert frame: vertices, mm, and faces."""
        z, back, front = self._outline()
        fillet = np.minimum(self.edge_fillet, (front - back) / 4.0)
        turn = (1.0 - np.cos(np.radians(np.linspace(0.0, 90.0, 5)[:-1])))[:, None]
        inside = np.linspace(0.0, 1.0, 71)[:, None]
        x = np.concatenate(
            [
                back + fillet * turn,
                back + fillet + (front - back - 2.0 * fillet) * inside,
                front - fillet * turn[::-1],
            ]
        )
        z = np.broadcast_to(z, x.shape)
        drop = rounded_edge(np.minimum(x - back, front - x), fillet)
        drop = drop + rounded_edge(self.width_half - np.abs(z), self.edge_fillet)
        top = np.stack([x, self.height(x, z) - drop, z], axis=-1)
        bottom = top * np.array([1.0, 0.0, 1.0])
        return solids.close_sheets(top, bottom, [0, len(x) - 1], list(range(z.shape[1])))

    def tray(self, thickness: float = 4.0) -> tuple[Array, NDArray[np.int64]]:
        """Return a closed triangulation of the flat tray below the insert, with its outline."""
        z, back, front = self._outline()
        x = back + (front - back) * np.linspace(0.0, 1.0, 5)[:, None]
        top = np.stack([x, np.zeros_like(x), np.broadcast_to(z, x.shape)], axis=-1)
        bottom = top - np.array([0.0, thickness, 0.0])
        return solids.close_sheets(top, bottom, list(range(5)), list(range(len(z))))

    def _sagittal(self, x: Array, z: Array) -> Array:
        medial = self._arc(x, self.medial_dish_radii)
        if self.medial_dish_radii == self.lateral_dish_radii:
            return medial
        s = np.clip(0.5 + 0.5 * z / BLEND_HALF_WIDTH, 0.0, 1.0)
        lateral = s * s * (3.0 - 2.0 * s)
        return (1.0 - lateral) * medial + lateral * self._arc(x, self.lateral_dish_radii)

    def _arc(self, x: Array, radii: tuple[float, float]) -> Array:
        s = x - self.low_point_ap
        radius = np.where(s > 0, *radii)
        s = np.clip(s, -radius, radius)
        return np.asarray(radius - np.sqrt(radius**2 - s**2))

    def _coronal(self, z: Array) -> Array:
        u, arc, bump = np.abs(z), self.coronal_radius, self.eminence_radius()
        tangent = self.dish_half * bump / (bump + arc)
        across = np.clip(u - self.dish_half, -arc, arc)
        dish = arc - np.sqrt(arc**2 - across**2)
        hill = self.eminence_height - bump + np.sqrt(bump**2 - np.minimum(u, bump) ** 2)
        return np.asarray(np.where(u < tangent, hill, dish))

    def _outline(self) -> tuple[Array, Array, Array]:
        """Return z, finer at the rounded ends, and x of both edges at each z, (n,), centred in
        x.
        """
        inner = np.linspace(0.0, self.width_half - 4.0, 49)
        turn = np.sin(np.radians(np.linspace(0.0, 90.0, 13)))[1:]
        half = np.concatenate([inner, self.width_half - 4.0 + 4.0 * turn])
        z = np.concatenate([-half[:0:-1], half])
        u = np.abs(z) / (self.width_half * 1.004)
        front = self.depth_half * (1.0 - u**3.0) ** (1.0 / 2.2)
        back = -self.depth_half * (1.0 - u**6.0) ** (1.0 / 2.2)
        back = back + self.notch_depth * np.exp(-((z / self.notch_width) ** 2))
        middle = (back.min() + front.max()) / 2.0
        return z, back - middle, front - middle
