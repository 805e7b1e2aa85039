"""Mesh files into surfaces: SI units, anatomical axes, mended with a notice or refused."""

import logging
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.files import MESH_LIMIT, check_file
from tkamb.geometry.boundary import BoundaryLoop
from tkamb.geometry.frames import MIRROR, Array
from tkamb.geometry.repair import Repair, repair
from tkamb.geometry.surface import Surface
from tkamb.units import LENGTH, MILLIMETRE

Indices = NDArray[np.int64]

IMPLANT_SIZE = (0.010, 0.250)
"""m; least and greatest length of a part of a knee implant."""
BONE_SIZE = (0.010, 0.650)
"""m; least and greatest length of a bone at the knee, whole or in part."""

_log = logging.getLogger("tkamb")


def axes_rotation(axes: str) -> Array:
    """Return the rotation (3, 3) from mesh axes to anatomical axes.

    Args:
        axes: the mesh axes that point anterior, superior and to the right, like "-x,+y,-z".

    Returns:
        R with p_anatomical = R p_mesh; its rows are the named axes. Entries are 0 and ±1,
        so that a permutation changes no digit of a coordinate.

    Raises:
        InputError: not three different axes, or a left-handed system (a mirror image).
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
    """Read an STL, OBJ or PLY file as a surface in anatomical axes and metres.

    Mended with one warning on the logger "tkamb": duplicate, degenerate and wrongly wound
    faces, loose vertices, cracks and small holes (`tkamb.geometry.repair`).

    Args:
        path: the file.
        unit: its unit of length, "m", "cm" or "mm".
        axes: its axes that point anterior, superior and to the right.
        name: what to call the part in messages.
        closed: whether the surface must enclose a volume.
        size: m, least and greatest plausible length; another one means a wrong unit.

    Returns:
        The surface about the mesh's own origin: x anterior, y superior, z right, m.

    Raises:
        InputError: no such file, no mesh, no triangles, NaN, a size that no knee part has,
            not a surface, or open where it must be closed.
    """
    rotation = axes_rotation(axes)
    if unit not in LENGTH:
        raise InputError(f"unknown unit '{unit}' of {name}", path, f"one of {', '.join(LENGTH)}")
    vertices, faces = read_triangles(path)
    _check_size(vertices[faces.reshape(-1)], unit, path, name, size)
    mended = repair(vertices * LENGTH[unit], faces)
    _check_surface(mended, path, name, unit)
    if closed and mended.holes:
        raise InputError(
            f"{name} is not closed: {describe_holes(mended.holes, unit)}", path, _CLOSE
        )
    if mended.notices:
        _log.warning("%s: %s mesh repaired: %s", path, name, "; ".join(mended.notices))
    return Surface(mended.vertices @ rotation.T + 0.0, mended.faces, name)


def mirrored(surface: Surface) -> Surface:
    """Return the mirror image in the sagittal plane (z to -z), normals still outward.

    It turns a part of a left knee, in anatomical axes, into that of a right one.
    """
    return Surface(surface.vertices @ MIRROR + 0.0, surface.faces[:, ::-1].copy(), surface.name)


def read_triangles(path: str | Path) -> tuple[Array, Indices]:
    """Return vertices (n, 3) in file units and faces (k, 3) as the file has them.

    Raises:
        InputError: no such file, not a mesh, no triangles, or NaN.
    """
    path = Path(path)
    try:
        check_file(path, MESH_LIMIT, what="mesh file")
        mesh = trimesh.load(path, force="mesh", process=False)
    except InputError:
        raise
    except ImportError:  # an STL that is not binary goes to the reader of text, which is extra
        raise InputError("cannot be read as a mesh (cut short, or text)", path, _FORMATS) from None
    except Exception as error:  # readers of many formats: each raises what it likes
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(f"cannot be read as a mesh ({reason})", path, _FORMATS) from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError("holds no triangles: is it cut short, or text?", path, _FORMATS)
    faces = np.asarray(mesh.faces, np.int64)
    vertices = np.asarray(mesh.vertices, np.float64)
    bad = ~np.isfinite(vertices[faces]).all(axis=(1, 2))
    if bad.any():
        raise InputError(
            f"{int(bad.sum())} triangle(s) have a coordinate that is not a number "
            f"(first: triangle {int(np.flatnonzero(bad)[0])})",
            path,
            "export the mesh again",
        )
    vertices = np.where(np.isfinite(vertices), vertices, 0.0)
    return vertices, faces


def plausible_units(extent: float, size: tuple[float, float] = IMPLANT_SIZE) -> list[str]:
    """Return the units in which the largest extent (file units) is within `size` (m)."""
    return [unit for unit, metres in LENGTH.items() if size[0] <= extent * metres <= size[1]]


def describe_holes(holes: tuple[BoundaryLoop, ...], unit: str) -> str:
    """Return the number of holes and the widest one, its centre in file axes and units."""
    widest, more = holes[0], len(holes) - 1
    where = ", ".join(f"{value / LENGTH[unit]:.4g}" for value in widest.centre)
    text = (
        f"hole of {len(widest.vertices)} edges, {widest.width / MILLIMETRE:.3g} mm wide, "
        f"at ({where}) {unit}"
    )
    return text if more == 0 else f"{text}, and {more} more"


_FORMATS = "give an STL, OBJ or PLY file of triangles"
_CLOSE = "close it in a mesh editor; holes up to about a lattice cell (2 mm) are closed for you"


def _opposite(names: list[str]) -> str:
    last = names[2]
    turned = f"-{last[-1]}" if last[0] != "-" else f"+{last[-1]}"
    return ",".join([*names[:2], turned])


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
    raise InputError(
        f"{name} is {extent * LENGTH[unit] / MILLIMETRE:.4g} mm long in unit '{unit}', which no "
        f"such part of a knee is ({size[0] / MILLIMETRE:g} to {size[1] / MILLIMETRE:g} mm)",
        path,
        f"is the unit right? {advice}" if fits else "check the mesh and its unit",
    )


def _check_surface(mended: Repair, path: str | Path, name: str, unit: str) -> None:
    if mended.one_sided:
        raise InputError(f"{name} is not a surface: it has only one side", path, _REMESH)
    if len(mended.faces) < 4:
        raise InputError(
            f"{name} is not a surface: {len(mended.faces)} triangles left", path, _REMESH
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
