"""Pairs of bodies on which the contact models' errors are measured, by situation.

Errors of a pressure map differ between three situations: contact in the interior of a smooth
surface, on a flank (its normal is far from the vertical) and at an edge (the outline of the insert,
a rim with a fillet, a femoral component with an edge). In each situation every second pair is held
out. The stated errors come from the other pairs, and the held-out pairs test them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.geometry.frames import Array, pose
from tkamb.geometry.surface import Surface
from tkamb.studies.cases import Height, block
from tkamb.units import DEGREE, MILLIMETRE

Situation = Literal["interior", "flank", "edge"]
SITUATIONS: tuple[Situation, ...] = ("interior", "flank", "edge")


@dataclass(frozen=True)
class ErrorCaseSettings:
    """The cases from which known errors are measured."""

    insert_mm: float = 16.0
    """mm: edge length of the inserts. Chosen because it allows fine cells, and the contact does not
    reach the outline."""
    vertex_spacing_mm: float = 0.25
    """mm: distance between the vertices of the surfaces. Chosen because facets then hardly change
    the pressure."""


ERROR_CASE = ErrorCaseSettings()


@dataclass(frozen=True, eq=False)
class ErrorCase:
    """A pair of bodies, the place of their contact, and the load.

    Args:
        name: name of the case.
        situation: where the contact lies: interior, flank or edge.
        held_out: whether the case tests the stated errors; otherwise they are computed from it.
        femoral: function of x and z (m): height (m) of the femoral underside over its lowest point.
        insert: function of x and z (m): height (m) of the insert's top.
        load: contact force, N.
        shift_mm: x and z of the femoral component, mm.
        width_mm: edge length of the femoral component, mm.
    """

    name: str
    situation: Situation
    held_out: bool
    femoral: Height
    insert: Height
    load: float
    shift_mm: tuple[float, float] = (0.0, 0.0)
    width_mm: float = 20.0

    def pair(self, material_name: str = "polyethylene") -> ContactPair:
        """Return the two bodies."""
        size = (ERROR_CASE.insert_mm * MILLIMETRE, ERROR_CASE.insert_mm * MILLIMETRE)
        insert = block(self.insert, size, ERROR_CASE.vertex_spacing_mm * MILLIMETRE)
        return ContactPair(
            _upside_down(self.femoral, self.width_mm), insert, material(material_name)
        )

    @property
    def pose(self) -> Array:
        """pose_femoral_in_insert (4, 4); its height does not matter."""
        x, z = np.array(self.shift_mm) * MILLIMETRE
        return pose(np.eye(3), [x, 0.1, z])


def error_cases() -> list[ErrorCase]:
    """Return all pairs."""
    result: list[ErrorCase] = []
    for situation, rows in (("interior", _interior()), ("flank", _flank()), ("edge", _edge())):
        for number, (name, *settings) in enumerate(rows):
            keys = ("femoral", "insert", "load", "shift_mm", "width_mm")
            result.append(
                ErrorCase(
                    f"{situation}: {name}",
                    situation,  # type: ignore[arg-type]
                    number % 2 == 1,
                    **dict(zip(keys, settings, strict=False)),
                )
            )
    return result


def _interior() -> Iterator[tuple]:
    yield "ball of 22 on 8 mm", _ball(22, 22), _level(8), 600.0
    yield "ball of 15 on 4 mm", _ball(15, 15), _level(4), 300.0
    yield "ellipsoid 35 x 18 on 6 mm", _ball(35, 18), _level(6), 700.0
    yield "ball of 20 in a dish of 28", _ball(20, 20), _dish(7, 28, 28), 1000.0
    yield "torus 30 x 22 in a dish 60 x 26", _ball(30, 22), _dish(7, 60, 26), 1200.0
    yield "ball of 40 on 3 mm", _ball(40, 40), _level(3), 900.0
    yield "roller 80 x 12 on 8 mm", _ball(80, 12), _level(8), 800.0
    yield "ball of 24 in a trough of 30", _ball(24, 24), _dish(6, 1e4, 30), 900.0


def _flank() -> Iterator[tuple]:
    yield "ball of 18 on a slope of 15 deg", _ball(18, 18), _slope(7, 15), 500.0, (-4.7, 0), 26.0
    yield "ball of 22 on a slope of 25 deg", _ball(22, 22), _slope(8, 25), 500.0, (-9.3, 0), 34.0
    yield "ball of 14 in a dish of 20, 4 mm", _ball(14, 14), _dish(5, 20, 20), 600.0, (1.2, 0)
    yield "ball of 16 in a dish of 24, 4 mm", _ball(16, 16), _dish(5, 24, 24), 700.0, (1, 1)
    yield (
        "roller 60 x 14 in a trough of 18, 4 mm",
        _ball(60, 14),
        _dish(5, 1e4, 18),
        700.0,
        (0, 0.9),
    )
    yield "ball of 20 on an eminence", _ball(20, 20), _dish(9, -14, 1e4), 400.0, (6.0, 0)
    yield (
        "torus 30 x 16 on a slope of 20 deg",
        _ball(30, 16),
        _slope(7, 20),
        700.0,
        (-10.2, 0.5),
        36.0,
    )
    yield "ball of 25 in a trough of 35, 5 mm", _ball(25, 25), _dish(5, 35, 1e4), 800.0, (1.4, 0)


def _edge() -> Iterator[tuple]:
    yield "ball of 22 at the outline", _ball(22, 22), _level(8), 500.0, (6.5, 0)
    yield "ball of 30 at the outline", _ball(30, 30), _level(6), 600.0, (0.3, 7.0)
    yield "ball of 22 at a rim of fillet 1 mm", _ball(22, 22), _rim(8, 1.0), 500.0, (4.5, 0)
    yield "ball of 18 at a rim of fillet 2 mm", _ball(18, 18), _rim(8, 2.0), 500.0, (4.2, 0.3)
    yield "punch of fillet 0.5 mm", _punch(4.0, 0.5), _level(7), 900.0, (0.2, 0.1), 10.0
    yield "punch of fillet 1.5 mm", _punch(3.5, 1.5), _level(7), 900.0, (0.4, 0.3), 10.0
    yield "ball of 40 at a rim of fillet 0.5 mm", _ball(40, 40), _rim(6, 0.5), 800.0, (4.0, 1.0)
    yield "roller 60 x 10 with fillet ends", _runner(10, 3.0, 1.0), _level(7), 500.0, (0, 0), 12.0
    yield "roller 80 x 12 with sharper ends", _runner(12, 3.5, 0.5), _level(7), 600.0, (0, 0), 12.0
    yield "ball of 15 at the outline", _ball(15, 15), _level(8), 400.0, (-6.9, 0.4)
    yield "ball of 30 at a rim of fillet 1.5 mm", _ball(30, 30), _rim(7, 1.5), 700.0, (4.4, -0.4)
    yield "punch of fillet 1 mm", _punch(3.0, 1.0), _level(8), 700.0, (0.3, 0.45), 10.0
    yield "torus 40 x 15 at a rim of fillet 0.5 mm", _ball(40, 15), _rim(8, 0.5), 500.0, (4.2, 0.5)
    yield "ellipsoid 20 x 35 at the outline", _ball(20, 35), _level(7), 600.0, (0.2, -6.8)
    yield (
        "roller 60 x 16 with blunter ends",
        _runner(16, 2.5, 2.0),
        _level(6),
        600.0,
        (0.4, 0.3),
        12.0,
    )
    yield "ball of 26 at a rim of fillet 1 mm", _ball(26, 26), _rim(5, 1.0), 500.0, (4.8, 0.25)


def _level(thickness_mm: float) -> Height:
    return lambda x, z: np.full_like(x, thickness_mm * MILLIMETRE)


def _ball(radius_x_mm: float, radius_z_mm: float) -> Height:
    """Return the height of an ellipsoid, given its radii along x and z at the lowest point."""
    a, b = radius_x_mm * MILLIMETRE, radius_z_mm * MILLIMETRE

    def height(x: Array, z: Array) -> Array:
        square = 1.0 - x**2 / a**2 - z**2 * a / (b * a**2)
        return np.asarray(a * (1.0 - np.sqrt(np.maximum(square, 0.05))), float)

    return height


def _dish(thickness_mm: float, radius_x_mm: float, radius_z_mm: float) -> Height:
    """Return the height of a dish, given its radii; a negative radius makes a ridge."""
    a, b = radius_x_mm * MILLIMETRE, radius_z_mm * MILLIMETRE
    return lambda x, z: thickness_mm * MILLIMETRE + x**2 / (2 * a) + z**2 / (2 * b)


def _slope(thickness_mm: float, degrees: float) -> Height:
    return lambda x, z: thickness_mm * MILLIMETRE + np.tan(degrees * DEGREE) * x


def _rim(thickness_mm: float, fillet_mm: float) -> Height:
    """Return the height of a plateau that ends at x = 5 mm in a slope of 60 deg, with a fillet."""
    return lambda x, z: thickness_mm * MILLIMETRE - _rounded(x - 5 * MILLIMETRE, fillet_mm)


def _rounded(beyond: Array, fillet_mm: float) -> Array:
    """Return the drop (m) of a level surface that turns down by 60 deg over a fillet."""
    radius, turn = fillet_mm * MILLIMETRE, 60.0 * DEGREE
    end = radius * np.sin(turn)
    x = np.maximum(beyond, 0.0)
    arc = radius - np.sqrt(np.maximum(radius**2 - np.minimum(x, end) ** 2, 0.0))
    return np.asarray(arc + np.tan(turn) * np.maximum(x - end, 0.0), float)


def _punch(half_mm: float, fillet_mm: float) -> Height:
    """Return the height of a round punch with a flat face of a radius and a fillet."""
    return lambda x, z: _rounded(np.hypot(x, z) - half_mm * MILLIMETRE, fillet_mm)


def _runner(radius_mm: float, half_mm: float, fillet_mm: float) -> Height:
    """Return the height of a roller along x with fillets at its ends."""
    across = _ball(1e4, radius_mm)
    return lambda x, z: across(0 * x, z) + _rounded(np.abs(x) - half_mm * MILLIMETRE, fillet_mm)


def _upside_down(height: Height, width_mm: float) -> Surface:
    """Return a body with an underside of a height function; its lowest point is at y = 0."""
    size, top = (width_mm * MILLIMETRE, width_mm * MILLIMETRE), 30.0 * MILLIMETRE
    whole = block(
        lambda x, z: np.maximum(top - height(x, z), MILLIMETRE),
        size,
        ERROR_CASE.vertex_spacing_mm * MILLIMETRE,
    )
    vertices = whole.vertices * [1.0, -1.0, 1.0] + [0.0, top, 0.0]
    return Surface(vertices, whole.faces[:, ::-1], "femoral")
