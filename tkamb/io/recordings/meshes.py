"""Surfaces from mesh files, in SI units and anatomical axes, with small defects repaired."""

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.files import MESH_BYTES, check_file
from tkamb.geometry.condyles import condyle_split
from tkamb.geometry.frames import Array
from tkamb.geometry.polygons import triangulated
from tkamb.geometry.repair import InnerWall, Repair, find_inner_wall, repair, touching_groups
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import Body, BoundaryLoop, connected_parts, separate_bodies
from tkamb.io.recordings.polygon_files import read_binary_stl, read_obj, read_ply, read_vtp
from tkamb.units import LENGTH, MILLIMETRE

Indices = NDArray[np.int64]

IMPLANT_SIZE = (0.010, 0.250)
"""m; accepted lengths of a part of a knee implant."""
BONE_SIZE = (0.010, 0.650)
"""m; accepted lengths of a bone at the knee, whole or in part."""


# m: smallest component with two condyles. Real ones are at least 50 mm wide.
MIN_SIZE = 0.034
# m: coarser rounding of coordinates gets a notice. Forces then change by about 0.5
# %.
ROUNDING_NOTICE = 1e-6
# m: a mesh with coarser rounding of coordinates is refused. 8 µm change forces by 4
# %.
ROUNDING_LIMIT = 5e-6
# Number of bytes in which a file's space is searched. Headers are shorter.
HEADER_BYTES = 4096
# 1: area of the wall between touching bodies, in the plan view, from which one body lies on the
# other, as a share of the part's extents. A post covers less, a tray more.
STACKED_SHARE = 0.3
# 1: widest hole of a part, as a share of its length. A part with a wider hole is an open sheet.
# Holes of damaged files are smaller.
SHEET_OPENING = 1.0 / 3.0


USUAL_SIZE = (0.040, 0.120)
"""m; lengths of usual components, including partial knees."""


_log = logging.getLogger("tkamb")


def axes_rotation(axes: str) -> Array:
    """Return the rotation (3, 3) from mesh axes to anatomical axes.

    Args:
        axes: the mesh axes that point anterior, superior and to the right, like "-x,+y,-z".

    Returns:
        R with p_anatomical = R p_mesh. Its entries are 0 and ±1, so that coordinates stay exact.
    """
    names = [name.strip() for name in axes.split(",")]
    letters = sorted(name[1:] if name[:1] in ("+", "-") else name for name in names)
    if letters != ["x", "y", "z"]:
        raise InputError(
            f"'{axes}' does not name three different axes",
            "axes",
            "give the mesh axes that point anterior, superior and right, like '-x,+y,-z'",
        )
    rotation = np.zeros((3, 3))
    for row, name in enumerate(names):
        rotation[row, "xyz".index(name[-1])] = -1.0 if name[0] == "-" else 1.0
    if np.linalg.det(rotation) < 0:
        raise InputError(
            f"'{axes}' is left-handed: it would turn the part into its mirror image",
            "axes",
            f"flip the sign of one axis, like '{_opposite(names)}'; a left knee is declared by "
            "its side, not by its axes",
        )
    return rotation


def load_surface(
    path: str | Path,
    unit: str,
    axes: str = "+x,+y,+z",
    *,
    name: str,
    closed: bool = False,
    size: tuple[float, float] = IMPLANT_SIZE,
) -> Surface:
    """Read an STL, OBJ, PLY or VTP file as a surface in anatomical axes and metres.

    Duplicate, degenerate and wrongly wound faces, loose vertices, cracks and small holes are
    repaired (`tkamb.geometry.repair`), with one warning on the logger "tkamb".

    Args:
        unit: unit of length of the file, "m", "cm", "mm" or "inch".
        axes: axes of the file that point anterior, superior and to the right.
        closed: whether the surface must enclose a volume.
        size: smallest and largest plausible length, m.

    Returns:
        The surface, m: x anterior, y superior, z right. The origin is that of the mesh.
    """
    rotation = axes_rotation(axes)
    if unit not in LENGTH:
        raise InputError(
            f"unknown unit '{unit}' of {name}", path, f"use one of {', '.join(LENGTH)}"
        )
    vertices, faces = read_triangles(path)
    _check_space(path, axes)
    _check_size(vertices[faces.reshape(-1)], unit, path, name, size)
    _check_rounding(vertices[faces.reshape(-1)], unit, path, name)
    mended = repair(vertices * LENGTH[unit], faces)
    _check_surface(mended, path, name, unit)
    wall = None
    if closed and size == IMPLANT_SIZE and not mended.holes:
        wall = find_inner_wall(mended.vertices, mended.faces)
        if wall is not None:
            _check_stacked(mended, wall, path, name, rotation[1], unit)
            mended, wall = _without_inner_wall(mended, wall, unit)
    if size == IMPLANT_SIZE:
        _check_part(mended, path, name, rotation[2], wall)
    if closed and mended.holes:
        raise InputError(
            f"{name} is not closed: {describe_holes(mended.holes, unit)}", path, _CLOSE
        )
    if mended.notices:
        _log.warning("%s: %s mesh repaired: %s", path, name, "; ".join(mended.notices))
    surface = Surface(mended.vertices @ rotation.T + 0.0, mended.faces, name, merged=True)
    if size == IMPLANT_SIZE:
        _check_knee_width(surface, path)
    return surface


SPACES = {"LPS": "-y,+z,-x", "RAS": "+y,+z,+x"}
"""Space that a mesh file names -> its axes that point anterior, superior and to the right."""
_SPACE = re.compile(rb"SPACE\W{0,3}(?:=|:)?\s*\W?(LPS|RAS)\b", re.IGNORECASE)
_SPACE_ARRAY = re.compile(
    rb"<(?:Data)?Array[^>]*Name=[\"']SPACE[\"'][^>]*>([\d\s]+)<", re.IGNORECASE
)


def space_of(path: str | Path) -> str | None:
    """Return the space, "LPS" or "RAS", that the header of a mesh file names; None without one.

    Headers are that of STL, comments of PLY and OBJ, and comments and field data (text) of VTP.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(HEADER_BYTES)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path) from error
    if Path(path).suffix.lower() == ".stl":
        head = head.split(b"\n")[0][:80]
    if (array := _SPACE_ARRAY.search(head)) is not None:  # a text array holds character codes
        head = b"SPACE=" + bytes(int(code) % 256 for code in array[1].split() if int(code))
    found = _SPACE.search(head)
    return None if found is None else found[1].decode().upper()


def check_same_space(first: str | Path, second: str | Path) -> None:
    """Raise an InputError if two files that share axes name different spaces."""
    spaces = space_of(first), space_of(second)
    if None not in spaces and spaces[0] != spaces[1]:
        raise InputError(
            f"names the space {spaces[1]} in its header, but {first} names {spaces[0]}",
            second,
            "export both meshes in the same space",
        )


def _check_space(path: str | Path, axes: str) -> None:
    space = space_of(path)
    if space is not None and not np.array_equal(axes_rotation(axes), axes_rotation(SPACES[space])):
        raise InputError(
            f"names the space {space} in its header, so that its axes are {SPACES[space]}, not "
            f"{axes}",
            path,
            f"give axes {SPACES[space]}; if the mesh was moved to other axes, delete the space "
            "from its header",
        )


def read_triangles(path: str | Path) -> tuple[Array, Indices]:
    """Return the vertices (n, 3) in file units and the faces (k, 3) of a mesh file, unrepaired."""
    path = Path(path)
    vertices, faces = read_vtp(path) if path.suffix.lower() == ".vtp" else _read_mesh(path)
    if len(faces) == 0:
        raise InputError(_NO_TRIANGLES, path, _FORMATS)
    bad = ~np.isfinite(vertices[faces]).all(axis=(1, 2))
    if bad.any():
        raise InputError(
            f"{int(bad.sum())} triangle(s) have a coordinate that is not a number "
            f"(first: triangle {int(np.flatnonzero(bad)[0])})",
            path,
            "export the mesh again",
        )
    return np.where(np.isfinite(vertices), vertices, 0.0), faces


def _read_mesh(path: Path) -> tuple[Array, Indices]:
    try:
        check_file(path, MESH_BYTES, what="mesh file")
        suffix = path.suffix.lower()
        if suffix == ".stl" and (corners := read_binary_stl(path)) is not None:
            return corners, np.arange(len(corners)).reshape(-1, 3)
        if suffix in (".obj", ".ply"):
            vertices, outline, ends = read_obj(path) if suffix == ".obj" else read_ply(path)
            return vertices, triangulated(vertices, outline, ends)
        return _read_by_trimesh(path)
    except InputError:
        raise
    except ImportError:  # an optional package that trimesh needs for this format is missing
        raise InputError("cannot be read as a mesh (cut short, or text)", path, _FORMATS) from None
    except Exception as error:  # the readers of the formats raise errors of many types
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(f"cannot be read as a mesh ({reason})", path, _FORMATS) from None


def _read_by_trimesh(path: Path) -> tuple[Array, Indices]:
    import trimesh  # takes 0.25 s; most meshes do not need it

    mesh = trimesh.load(path, force="mesh", process=False)
    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(_NO_TRIANGLES, path, _FORMATS)
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def plausible_units(extent: float, size: tuple[float, float] = IMPLANT_SIZE) -> list[str]:
    """Return the units in which the largest extent (file units) is within `size` (m).

    One that makes a part too small is left out if another unit gives a usual size. Example: a knee
    in inches, read as centimetres, is 30 mm wide.
    """
    lengths = {unit: extent * metres for unit, metres in LENGTH.items()}
    fits = [unit for unit, length in lengths.items() if size[0] <= length <= size[1]]
    if size != IMPLANT_SIZE:
        return fits
    usual = [unit for unit in fits if USUAL_SIZE[0] <= lengths[unit] <= USUAL_SIZE[1]]
    return [unit for unit in fits if lengths[unit] >= MIN_SIZE or not usual]


def body_size(body: Body, unit: float) -> str:
    """Return the extents of a body, as text; `unit` is metres per unit."""
    return " × ".join(f"{extent / unit:.3g}" for extent in body.extents)


def describe_holes(holes: tuple[BoundaryLoop, ...], unit: str) -> str:
    """Return a text on the widest hole, its centre in file axes and units, and the other holes."""
    widest, more = holes[0], len(holes) - 1
    where = ", ".join(f"{value / LENGTH[unit]:.4g}" for value in widest.centre)
    text = (
        f"hole of {len(widest.vertices)} edges, {widest.width / MILLIMETRE:.3g} mm wide, "
        f"at ({where}) {unit}"
    )
    return text if more == 0 else f"{text}, and {more} more"


_NO_TRIANGLES = "holds no triangles: it is cut short, or not a mesh"
_FORMATS = "give an STL, OBJ, PLY or VTP file of triangles"
_CLOSE = "close it in a mesh editor; holes up to about a lattice cell (2 mm) are closed on loading"


def _opposite(names: list[str]) -> str:
    last = names[2]
    reversed_axis = f"-{last[-1]}" if last[0] != "-" else f"+{last[-1]}"
    return ",".join([*names[:2], reversed_axis])


def _check_stacked(
    mended: Repair, wall: InnerWall, path: str | Path, name: str, up: Array, unit: str
) -> None:
    """Raise an InputError if bodies of a part lie on each other, like a tray.

    Args:
        up: (3,) superior direction in the file's axes.
    """
    surface = Surface(mended.vertices, mended.faces, name, merged=True)
    level = 0.5 * float(surface.areas[wall.faces] @ np.abs(surface.face_normals[wall.faces] @ up))
    across = np.ptp(mended.vertices, axis=0)[np.abs(up) < 0.5]
    if level < STACKED_SHARE * float(across.prod()):
        return
    where = ", ".join(f"{round(value / LENGTH[unit], 2) + 0.0:g}" for value in wall.centre)
    raise InputError(
        f"{name} holds bodies that lie on each other, like an insert on its tray: they touch on "
        f"{1e6 * level:.0f} mm² at ({where}) {unit}",
        path,
        "give the insert alone (`tkamb mesh part` writes one body); if all of it is polyethylene, "
        "unite the bodies in the CAD program",
    )


def _without_inner_wall(
    mended: Repair, wall: InnerWall, unit: str
) -> tuple[Repair, InnerWall | None]:
    """Return the part without its inner wall, or with one that cannot be removed."""
    where = ", ".join(f"{round(value / LENGTH[unit], 2) + 0.0:g}" for value in wall.centre)
    words = f"inner wall of {1e6 * wall.area:.0f} mm² at ({where}) {unit} between touching bodies"
    if wall.without is None:
        return replace(mended, notices=(*mended.notices, f"{words} is ignored")), wall
    vertices, faces = wall.without
    notices = (*mended.notices, f"{words} removed")
    return replace(mended, vertices=vertices, faces=faces, notices=notices), None


def _check_part(
    mended: Repair, path: str | Path, name: str, right: Array, wall: InnerWall | None
) -> None:
    """Raise an InputError if a part is an open sheet, like a contact surface, or several bodies.

    Bodies that touch at an inner wall count as one.
    """
    extent = float(np.ptp(mended.vertices, axis=0).max())
    if mended.holes and mended.holes[0].width > SHEET_OPENING * extent:
        raise InputError(
            f"{name} is an open sheet, like a contact surface: its opening is "
            f"{mended.holes[0].width / MILLIMETRE:.3g} mm wide, so that its inside cannot be "
            "distinguished from its outside",
            path,
            "give the whole closed part that the sheet was cut from",
        )
    if not connected_parts(mended.faces).any():
        return
    bodies = separate_bodies(mended.vertices, mended.faces)
    if wall is not None and len(bodies) > 1:
        groups = [body.faces for body in bodies]
        if touching_groups(mended.vertices, groups, mended.faces, wall.faces) == 1:
            return
    if len(bodies) > 1 and not _two_condyles(bodies, right):
        sizes = ", ".join(body_size(body, MILLIMETRE) for body in bodies[:3])
        more = f", and {len(bodies) - 3} more" if len(bodies) > 3 else ""
        raise InputError(
            f"{name} is {len(bodies)} separate bodies ({sizes}{more}; mm), not one",
            path,
            "`tkamb mesh check` numbers them, `tkamb mesh part` writes one into a separate file"
            + ("; if they are two condyles, check the axes" if len(bodies) == 2 else ""),
        )


def _two_condyles(bodies: list[Body], right: Array) -> bool:
    """Return whether two bodies of similar size lie side by side along `right` (3,), as the
    components of a bicompartmental knee.

    A tray and an insert lie one above the other, and parts of both legs are farther apart than
    their widths.
    """
    if len(bodies) != 2:
        return False
    widths = [float(np.abs(right) @ body.extents) for body in bodies]
    lengths = sorted(float(body.extents.max()) for body in bodies)
    distance = abs(float(right @ (bodies[0].centre - bodies[1].centre)))
    gap = distance - sum(widths) / 2.0
    return -0.1 * min(widths) <= gap <= max(widths) and lengths[0] >= lengths[1] / 2.0


def _check_size(
    corners: Array, unit: str, path: str | Path, name: str, size: tuple[float, float]
) -> None:
    extent = float(np.ptp(corners, axis=0).max())
    fits = plausible_units(extent, size)
    if unit in fits:
        return
    advice = ", ".join(
        f"'{u}' would make it {extent * LENGTH[u] / MILLIMETRE:.4g} mm" for u in fits
    )
    reason = (
        f"no size of a part of a knee ({size[0] / MILLIMETRE:g} to {size[1] / MILLIMETRE:g} mm)"
    )
    if size[0] <= extent * LENGTH[unit] <= size[1]:
        reason = "smaller than any person's knee"
    raise InputError(
        f"{name} is {extent * LENGTH[unit] / MILLIMETRE:.4g} mm long in unit '{unit}', {reason}",
        path,
        f"check the unit: {advice}" if fits else "check the mesh and its unit",
    )


def _check_knee_width(surface: Surface, path: str | Path) -> None:
    extents = np.ptp(surface.bounds, axis=0)
    if extents.max() < MIN_SIZE and condyle_split(surface) is not None:
        raise InputError(
            f"{surface.name} has two condyles and is {extents[2] / MILLIMETRE:.3g} mm wide, "
            "smaller than any person's knee",
            path,
            f"check the unit, one of {', '.join(LENGTH)}, and whether the mesh was scaled before",
        )


def _check_rounding(corners: Array, unit: str, path: str | Path, name: str) -> None:
    """Warn, or raise an InputError, if coordinates (n, 3) are rounded too coarsely."""
    rounding = coordinate_rounding(corners) * LENGTH[unit]
    if rounding <= ROUNDING_NOTICE:
        return
    far = float(np.abs(corners).max()) * LENGTH[unit] / MILLIMETRE
    words = (
        f"{name} lies {far:.3g} mm from the origin of its file, where coordinates are rounded to "
        f"{rounding / MILLIMETRE:.2g} mm"
    )
    if rounding > ROUNDING_LIMIT:
        raise InputError(
            words, path, "move the part to the origin in the CAD program, and export it again"
        )
    _log.warning("%s: %s", path, words)


def coordinate_rounding(corners: Array) -> float:
    """Return the step of coordinates (n, 3), in their unit; 0: none is detected.

    Single precision and text of six or seven digits are detected, axis by axis. If more than half
    of an axis's are multiples of four or five steps, they are exact round numbers.
    """
    return max((_axis_rounding(values) for values in corners.T), default=0.0)


def _axis_rounding(values: Array) -> float:
    """Return the step to which the coordinates (n,) along an axis are rounded; 0: none."""
    largest = float(np.abs(values).max(initial=0.0))
    if largest == 0.0:
        return 0.0
    digits = np.floor(np.log10(largest))
    long = values[np.abs(values) >= 10.0**digits]  # smaller numbers have finer steps
    single = float(np.spacing(np.float32(largest)))
    if (values == values.astype(np.float32)).all():
        return 0.0 if _multiples(values, 4.0 * single).mean() > 0.5 else single
    for step in (10.0 ** (digits - 5), 10.0 ** (digits - 6)):
        if _multiples(long, step).all():
            return 0.0 if _multiples(long, 5.0 * step).mean() > 0.5 else step
    return 0.0


def _multiples(values: Array, step: float) -> NDArray[np.bool_]:
    """Return which values (n,) are multiples, within double precision."""
    number = values / step
    return np.asarray(np.abs(number - np.rint(number)) <= 1e-5)


def _check_surface(mended: Repair, path: str | Path, name: str, unit: str) -> None:
    if mended.one_sided:
        raise InputError(f"{name} is not a surface: it has only one side", path, _REMESH)
    if len(mended.faces) < 4:
        raise InputError(
            f"{name} is not a surface: {len(mended.faces)} triangles remain after repair",
            path,
            _REMESH,
        )
    if len(mended.forks):
        point = mended.vertices[mended.forks[0]] / LENGTH[unit]
        where = ", ".join(f"{value:.4g}" for value in point)
        raise InputError(
            f"{name} is not a surface: three or more sheets meet in {len(mended.forks)} vertices, "
            f"first at ({where}) {unit}",
            path,
            _REMESH,
        )


_REMESH = "export the part's outer skin as one triangulated surface"
