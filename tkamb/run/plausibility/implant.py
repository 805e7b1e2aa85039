"""Questions about the implant: whether its parts are turned as their axes say, and slide freely."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.io.scene.case import Case
from tkamb.run.plausibility.question import Question
from tkamb.units import DEGREE

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


@dataclass(frozen=True)
class ImplantShapeLimitSettings:
    """Which shapes and positions of an implant are plausible."""

    flange_height_share: float = 0.15
    """Share of the component's height at which the anterior flange is looked for, above the
    posterior condyles. Chosen: the flange is the only part there."""
    min_flange_position: float = 0.35
    """Share of the component's length, from behind. Chosen: eleven components have their top at
    0.92 to 0.97, one without a flange at 0.5, one back to front below 0.1."""
    min_opening_share: float = 0.05
    """Share of the largest extent: least distance from the centroid of the surface to the centre of
    the bounding box. Chosen: 0.09 to 0.14 in ten components, none in a sphere."""
    max_opening_angle: float = 60.0 * DEGREE
    """rad, from superior. Chosen: the same ten components open within 27 deg of it."""
    min_flatness_ratio: float = 2.0
    """Ratio of the flat area of the bone side of a patellar button to that of its joint side.
    Chosen: 15 at least in real ones."""
    min_notch_share: float = 0.02
    """Share of an insert's length by which it is cut out more in front than behind. Chosen: ten
    inserts are cut out more behind, by 0.05 to 0.3."""
    max_friction: float = 0.25
    """Coulomb coefficient of metal on polyethylene. Chosen: lubricated joints have 0.01 to 0.1, dry
    ones 0.2."""
    outline_offset: float = 0.25
    """Share of an insert's width, to either side, at which its outline is looked at: under the
    condyles. Chosen: it lies under the condyles."""


IMPLANT_SHAPE_LIMITS = ImplantShapeLimitSettings()

FLAT = np.cos(5.0 * DEGREE)
"""Of the angle between a flat's normal and an axis of the part."""
AT_HEIGHTS = (0.15, 0.3, 0.45)


def implant_questions(case: Case) -> Iterator[Question]:
    """Whether femoral component, insert and patellar button are turned, and rub too much."""
    if case.femoral is not None:
        yield from _of_femoral(case.femoral)
    if case.insert is not None and case.scene.contact:
        yield from _of_insert(case.insert)
    if case.patella is not None:
        yield from _of_button(case.patella)
    contact = case.scene.contact
    if contact and contact.friction > IMPLANT_SHAPE_LIMITS.max_friction:
        yield Question(
            f"a friction of {contact.friction:g} is more than metal on polyethylene has, even dry "
            "(0.2): is it a tenth of that?",
            "friction above any of metal on polyethylene",
        )


def _of_femoral(femoral: "Surface") -> Iterator[Question]:
    """Whether the flange lies in front, and what the component encloses above."""
    low, high = femoral.bounds
    vertices = femoral.vertices
    top = vertices[:, 1] > high[1] - IMPLANT_SHAPE_LIMITS.flange_height_share * (high[1] - low[1])
    place = float((vertices[top, 0].mean() - low[0]) / (high[0] - low[0]))
    opening = 0.5 * (low + high) - _centroid(femoral)
    size = float(np.linalg.norm(opening))
    if (
        size > IMPLANT_SHAPE_LIMITS.min_opening_share * (high - low).max()
        and opening[1] < np.cos(IMPLANT_SHAPE_LIMITS.max_opening_angle) * size
    ):
        yield Question(
            f"the femoral component opens {_way(opening)}, not upward, where the bone is: is it "
            "turned? see [implant.femoral] axes",
            "femoral component may be turned",
        )
    elif place < IMPLANT_SHAPE_LIMITS.min_flange_position:
        yield Question(
            "the top of the femoral component lies behind, where the posterior condyles end: is it "
            "back to front? see [implant.femoral] axes",
            "femoral component may be back to front",
        )


def _of_insert(insert: "Surface") -> Iterator[Question]:
    """Whether its notch lies behind: at mid-width its outline is compared with the condyles'."""
    low, high = insert.bounds
    heights, offsets = (
        np.array(AT_HEIGHTS),
        np.array([-IMPLANT_SHAPE_LIMITS.outline_offset, 0.0, IMPLANT_SHAPE_LIMITS.outline_offset]),
    )
    y, z = np.meshgrid(
        low[1] + heights * (high - low)[1],
        0.5 * (low + high)[2] + offsets * (high - low)[2],
        indexing="ij",
    )
    ends = []
    for x, way in ((low[0], 1.0), (high[0], -1.0)):
        starts = np.column_stack([np.full(y.size, x - 1e-3 * way), y.ravel(), z.ravel()])
        distance, _ = insert.rays.first(starts, np.array([way, 0.0, 0.0]))
        ends.append(distance.reshape(y.shape).min(axis=0))
    behind, before = (float(end[1] - end[[0, 2]].mean()) for end in ends)
    if before - behind > IMPLANT_SHAPE_LIMITS.min_notch_share * (high - low)[0]:
        yield Question(
            "the insert is cut out in front, not behind: is it back to front? see "
            "[implant.insert] axes",
            "insert may be back to front",
        )


def _of_button(button: "Surface") -> Iterator[Question]:
    """Whether its flat side, which lies on the bone, faces forward."""
    ways = np.vstack([np.eye(3), -np.eye(3)])
    flat = np.array([button.areas[button.face_normals @ way > FLAT].sum() for way in ways])
    largest = int(flat.argmax())
    if flat[largest] > IMPLANT_SHAPE_LIMITS.min_flatness_ratio * flat[0]:
        yield Question(
            f"the patellar button's flat side faces {_way(ways[largest])}, not forward, where the "
            "bone is: is it turned? see [implant.patella] axes",
            "patellar button may be turned",
        )


def _centroid(surface: "Surface") -> Array:
    """Return the centroid (3,) of a surface's area."""
    middles, areas = surface.triangles.mean(axis=1), surface.areas
    return np.asarray(areas @ middles / areas.sum())


def _way(direction: Array) -> str:
    """Return in a word which way of the anatomical axes a direction (3,) points most."""
    axis = int(np.abs(direction).argmax())
    return (("backward", "forward"), ("downward", "upward"), ("medially", "laterally"))[axis][
        int(direction[axis] > 0.0)
    ]
