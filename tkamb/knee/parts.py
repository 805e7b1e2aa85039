"""What a knee is made of, as plain data: implant, extensor mechanism, points on frames.

Lengths are in metres, forces in newtons. A point on a frame of the user's model is a `LinkPoint` or
a pair of the frame's name and three coordinates, ("femur", (0.0, 0.01, -0.042)).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, Array
from tkamb.geometry.surface import Surface
from tkamb.knee.load import LinkPoint
from tkamb.knee.muscles import Muscle, PatellarLigament

if TYPE_CHECKING:
    import pinocchio as pin

    from tkamb.contact.materials import Material

Mesh = Any
"""A `trimesh.Trimesh`, a pair (vertices (n, 3) m, triangles (k, 3)), or a `Surface`."""

Point = LinkPoint | tuple[str, Sequence[float]]
"""A point on a frame of the model."""


@dataclass(frozen=True)
class PartSettings:
    """Checks of the implant meshes."""

    max_length: float = 0.5
    """m: no part of an implant is longer. Chosen: a longer mesh is probably in millimetres and is
    refused."""


PART = PartSettings()


@dataclass(frozen=True, eq=False)
class Implant:
    """The parts of a total knee replacement, SI.

    Args:
        femoral: femoral component, in the axes of the frame "femoral" (see `tkamb.Knee`):
            x anterior, y superior, z to the subject's right.
        insert: closed polyethylene insert, in the axes of the frame "insert": x anterior, y
            superior, z to the subject's right. Its flat bottom is found and faces -y.
        patella: patellar button, in the axes of the frame "patella", its joint side facing -x.
        material: of the insert, a name (`tkamb.contact.materials.MATERIALS`) or a `Material`.
        bearing: "fixed" (bottom glued) or "mobile" (bottom slides).
        placed: True: the insert frame of the results is the frame "insert" itself. False: its
        origin is the centre of the flat bottom of the mesh.
    """

    femoral: Mesh = None
    insert: Mesh = None
    patella: Mesh = None
    material: "str | Material" = "polyethylene"
    bearing: Literal["fixed", "mobile"] = "fixed"
    placed: bool = False

    @property
    def insert_material(self) -> "Material":
        """The material itself."""
        from tkamb.contact.materials import material

        return material(self.material) if isinstance(self.material, str) else self.material


@dataclass(frozen=True, eq=False)
class Extensor:
    """Quadriceps, patella and patellar ligament.

    The patella moves in a sagittal plane of the femur. Where the model has a frame "patella" that
    moves against the femur, its place is that of q. Otherwise the place follows from the
    equilibrium of a massless patella, with the given length of the ligament.

    Args:
        quadriceps: from the femur to the patella.
        patellar_ligament: from the patella to the tibia; its `length` is needed where the place
            of the patella is found.
        plane: pose of the plane's frame in the frame "femur"; None: of the joint "patella_ap"
            where the model has one, else the frame "femur" itself.
        solved: True: a patella of the model is solved again where `Knee.equilibrium` moves the
        femur. False: it stays fixed to the femur.
    """

    quadriceps: Muscle
    patellar_ligament: PatellarLigament
    plane: "pin.SE3 | None" = None
    solved: bool = False


def as_surface(mesh: Mesh, name: str, closed: bool = False) -> Surface:
    """Return a mesh in memory as a surface, m.

    Duplicate and degenerate triangles, wrong winding and small holes are mended
    (`tkamb.geometry.repair`).

    Args:
        mesh: see `Mesh`; a `Surface` is taken as it is.
        name: what to call it in messages.
        closed: whether it must enclose a volume.

    Raises:
        InputError: no mesh, not finite, in millimetres, not a surface, or open.
    """
    if isinstance(mesh, Surface):
        return mesh
    from tkamb.geometry.repair import repair

    vertices, faces = _arrays(mesh, name)
    if not np.isfinite(vertices).all():
        raise InputError("holds coordinates that are not finite", name, "check the mesh")
    extent = float(np.ptp(vertices, axis=0).max())
    if not 0.0 < extent < PART.max_length:
        raise InputError(
            f"is {extent:.4g} m long",
            name,
            "meshes are in metres: multiply millimetres by 1e-3",
        )
    mended = repair(vertices, faces)
    if mended.one_sided or len(mended.faces) < 4 or len(mended.forks):
        raise InputError("is not one triangulated surface", name, "give the part's outer skin")
    if closed and mended.holes:
        width = mended.holes[0].width
        raise InputError(
            f"is not closed: its widest hole is {width:.3g} m across", name, "close the mesh"
        )
    return Surface(mended.vertices, mended.faces, name, merged=True)


def _arrays(mesh: Mesh, name: str) -> tuple[Array, Any]:
    """Return vertices (n, 3) and triangles (k, 3) of a mesh object or of a pair of arrays."""
    how = "give a trimesh.Trimesh, or vertices (n, 3) in metres and triangles (k, 3)"
    parts = (mesh.vertices, mesh.faces) if hasattr(mesh, "faces") else mesh
    try:
        vertices, faces = (np.asarray(part) for part in parts)
    except (TypeError, ValueError):
        raise InputError("is no mesh", name, how) from None
    triangles = vertices.ndim == faces.ndim == 2 and vertices.shape[1] == faces.shape[1] == 3
    if not triangles or not len(faces) or not np.issubdtype(faces.dtype, np.integer):
        raise InputError("is no triangle mesh", name, how)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("has triangles with vertex numbers out of range", name, how)
    return vertices.astype(float), faces.astype(np.int64)


def link_point(point: Point) -> LinkPoint:
    """Return a point on a frame, whichever way it was given.

    Raises:
        InputError: not a frame's name and three finite numbers.
    """
    link: object = None
    position: object = ()
    if isinstance(point, LinkPoint):
        link, position = point.link, point.position
    elif isinstance(point, tuple | list) and len(point) == 2:
        link, position = point
    try:
        place = np.asarray(position, float)
    except (TypeError, ValueError):
        place = np.empty(0)
    if not isinstance(link, str) or place.shape != (3,) or not np.isfinite(place).all():
        raise InputError(
            f"{point!r} is no point on a frame", "Knee", "give (frame name, (x, y, z)) in metres"
        )
    return LinkPoint(link, place)


def mirrored_surface(surface: Surface) -> Surface:
    """Return the mirror image in the sagittal plane (z to -z), normals still outward."""
    faces = surface.faces[:, ::-1].copy()
    return Surface(surface.vertices @ MIRROR + 0.0, faces, surface.name, surface.merged)
