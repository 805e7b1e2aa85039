"""Surfaces that a string wraps: simple solids, and the convex section of a mesh.

The section of a mesh is a convex outline in the object's x-y plane, extruded along its z axis. With
x to the right and y up the string runs clockwise, in front of the outline (+x), from its first
point to its last (`tkamb.knee.wrapping`).
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, mirrored_pose

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface

Shape = Literal["cylinder", "sphere", "ellipsoid", "torus", "section"]
DIMENSIONS = {"cylinder": 2, "sphere": 1, "ellipsoid": 3, "torus": 2, "section": 0}
"""Shape -> number of its dimensions."""
# Number of sections across the band of a mesh, whose common convex outline is wrapped. Not studied.
SECTIONS = 7


@dataclass(frozen=True, eq=False)
class WrapObject:
    """A surface fixed to a body, around which strings wrap.

    Args:
        shape: "cylinder" (along its z), "sphere", "ellipsoid", "torus" (about its z) or "section"
            (along its z).
        pose: (4, 4) pose_object_in_body.
        dimensions: m. Cylinder: radius, length; sphere: radius; ellipsoid: semi-axes x, y, z;
            torus: radius of the centre line, radius of the tube; section: none.
        quadrant: axis (0, 1 or 2) and sign (±1) of the half on which paths must lie; None: either
            half.
        outline: of a "section": strictly convex polygon in x-y, counter-clockwise, (n, 2), m.

    Raises:
        InputError: dimensions or outline do not suit the shape.
    """

    name: str
    body: str
    shape: Shape
    pose: Array
    dimensions: tuple[float, ...]
    quadrant: tuple[int, int] | None = None
    active: bool = True
    outline: Array | None = None

    def __post_init__(self) -> None:
        count = DIMENSIONS.get(self.shape)
        if count is None:
            raise InputError(
                f"no shape '{self.shape}'",
                f"wrap object {self.name}",
                f"give {', '.join(DIMENSIONS)}",
            )
        sizes = np.asarray(self.dimensions, float)
        if sizes.shape != (count,) or not (np.isfinite(sizes) & (sizes > 0.0)).all():
            raise InputError(
                f"dimensions {self.dimensions} m",
                f"wrap object {self.name}",
                f"a {self.shape} has {count}, each above 0",
            )
        if (self.outline is None) == (self.shape == "section"):
            raise InputError(
                f"a {self.shape} {'without' if self.outline is None else 'with'} an outline",
                f"wrap object {self.name}",
                "only a section has one: see mesh_section",
            )

    @property
    def key(self) -> tuple[Any, ...]:
        """All that determines a path over the object."""
        outline = None if self.outline is None else self.outline.tobytes()
        sizes = (self.dimensions, self.quadrant, self.active, outline)
        return (self.body, self.shape, self.pose.tobytes(), *sizes)

    def on(self, body: str, pose_body_in_other: Array) -> Self:
        """Return the object on another body that is fixed to its body."""
        return replace(self, body=body, pose=pose_body_in_other @ self.pose)

    def mirrored(self) -> Self:
        """Return the mirror image, on the mirror image of its body."""
        quadrant = self.quadrant
        if quadrant is not None and quadrant[0] == 2:
            quadrant = (2, -quadrant[1])
        return replace(self, pose=mirrored_pose(self.pose), quadrant=quadrant)

    def scaled(self, factor: float) -> Self:
        """Return the object with all lengths multiplied by a factor."""
        placed = self.pose.copy()
        placed[:3, 3] *= factor
        outline = None if self.outline is None else factor * self.outline
        sizes = tuple(factor * size for size in self.dimensions)
        return replace(self, pose=placed, dimensions=sizes, outline=outline)


def mesh_section(
    name: str,
    body: str,
    surface: "Surface",
    pose: Array,
    band: float = 0.0,
    offset: float = 0.0,
) -> WrapObject:
    """Return the convex section of a mesh as a wrap object.

    Args:
        pose: (4, 4) pose of the section in the body: z along the normal of the section's plane, x
            to the side on which strings pass, y from their last to their first points.
        band: half of the width along z across which sections are joined, m.
        offset: distance of the string's centre line from the surface, m.

    Raises:
        InputError: no plane of the band meets the surface.
    """
    from tkamb.geometry.polygons import sagittal_outline

    planes = np.linspace(-band, band, SECTIONS if band > 0.0 else 1)
    outline = sagittal_outline([surface.moved(inverse(pose))], planes, offset)
    return WrapObject(name, body, "section", pose, (), outline=outline)
