"""Questions about the masses and shapes of segments and implant parts."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.io.recordings.patient import DE_LEVA
from tkamb.io.scene.case import Case
from tkamb.run.plausibility import Question
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


@dataclass(frozen=True)
class SegmentLimitSettings:
    """Limits of plausible masses and positions of the segments of a leg."""

    max_mass_ratio: float = 1.6
    """1: largest ratio of a segment's mass to that of de Leva for the same body mass, and largest
    reciprocal. The ratio is up to 1.35 between cadaver studies, up to 1.3 with obesity, and 2.2 for
    pounds that are read as kilograms."""
    max_patella_offset: float = 0.05
    """m: largest distance of the patella's centre of mass from its origin. A patella
    is smaller."""
    max_insert_rotation: float = 20.0 * DEGREE
    """rad: largest rotation of the insert in the tibia. The slope is up to 10 deg,
    and definitions of the tibia's axes differ."""
    max_centre_offset: float = 0.12
    """1: largest distance of a segment's centre of mass from its axis, as a share of its length.
    Twice as much is allowed for the shank, which includes the foot."""


SEGMENT_LIMITS = SegmentLimitSettings()

PATELLA_MASS = (0.02, 0.6)
"""kg: limits of the patella's mass, from the bone alone to bone and soft tissue."""
PATELLA_RADII = (0.005, 0.04)
"""m: limits of the patella's radii of gyration. A bone 45 mm wide and 20 mm thick has 9 to 13 mm.
"""

SHANK_SHARE, THIGH_SHARE = (0.19, 0.30), (0.19, 0.31)
"""1: limits of the segments' lengths as shares of body height, 0.246 and 0.245 (Drillis & Contini
1966) minus and plus about a quarter."""
RADII = ((0.15, 0.45), (0.05, 0.30))
"""1: limits of the radii of gyration across and along a segment, relative to its length. De Leva
has 0.24 to 0.37 and 0.09 to 0.16; a foot increases those of the shank."""
CENTRE = (0.15, 0.8)
"""1: limits of the distance from the distal joint to the centre of mass, relative to the length.
De Leva has 0.37 to 0.64."""


def segment_questions(case: Case) -> Iterator[Question]:
    """Ask about masses, centres of mass, inertias and lengths of the segments, and the insert."""
    chain, patient = case.chain, case.scene.patient
    hip = chain.link_in("hip", "femur")[:3, 3]
    knee = chain.insert_in_tibia[:3, 3]
    tables = [DE_LEVA[patient.sex]] if patient.sex else list(DE_LEVA.values())
    shares = {
        "tibia": np.mean([t["shank"].mass + t["foot"].mass for t in tables]),
        "femur": np.mean([t["thigh"].mass for t in tables]),
    }
    masses = {link: chain.segment(link)[0] for link in shares}
    ratios = {link: masses[link] / (share * case.body_mass) for link, share in shares.items()}
    if wrong := [
        s
        for s, r in ratios.items()
        if not 1 / SEGMENT_LIMITS.max_mass_ratio <= r <= SEGMENT_LIMITS.max_mass_ratio
    ]:
        link = wrong[0]
        yield Question(
            f"'{link}' of the URDF weighs {masses[link]:.3g} kg, {ratios[link]:.2g} times the "
            f"usual mass in a body of {case.body_mass:g} kg: is mass_kg, or the URDF's, in pounds?",
            "masses of URDF and [patient] disagree",
        )
    if case.scene.patella:
        yield from _of_patella(case)
    for link, end, shares_of_height in (
        ("tibia", knee, SHANK_SHARE),
        ("femur", hip, THIGH_SHARE),
    ):
        length = float(np.linalg.norm(end))
        yield from _of_inertia(case, link, end)
        if case.height_mm is not None:
            share = length / (case.height_mm * MILLIMETRE)
            if not shares_of_height[0] <= share <= shares_of_height[1]:
                yield Question(
                    f"'{link}' is {length / MILLIMETRE:.0f} mm long, {share:.2f} of the body "
                    "height: is height_mm, or the URDF's origin, right?",
                    f"length of {link} and height_mm disagree",
                )
    turn = chain.insert_in_tibia[:3, :3]
    leans = np.degrees(np.arccos(np.clip(np.diag(turn), -1, 1)))
    if leans.max() > SEGMENT_LIMITS.max_insert_rotation / DEGREE:
        yield Question(
            f"the insert's axes are turned by {leans.max():.0f} deg from the tibia's: is the rpy "
            "of knee_ap right?",
            "insert turned far in the tibia",
        )


def _of_patella(case: Case) -> Iterator[Question]:
    mass, centre, tensor = case.chain.segment("patella")
    radii = np.sqrt(np.linalg.eigvalsh(tensor) / mass)
    if radii[0] < PATELLA_RADII[0] or radii[-1] > PATELLA_RADII[1]:
        words = " to ".join(f"{radius / MILLIMETRE:.3g}" for radius in radii[[0, -1]])
        yield Question(
            f"the radii of gyration of 'patella' are {words} mm: is its <inertia> in kg·m²?",
            "inertia of patella unlike a patella's",
        )
    if (
        not PATELLA_MASS[0] <= mass <= PATELLA_MASS[1]
        or np.linalg.norm(centre) > SEGMENT_LIMITS.max_patella_offset
    ):
        words = ", ".join(f"{value / MILLIMETRE:.0f}" for value in centre)
        yield Question(
            f"'patella' of the URDF weighs {mass:.3g} kg, its centre of mass at ({words}) mm: is "
            "its <inertial> in kilograms and metres?",
            "mass or centre of patella unlike a patella's",
        )


def _of_inertia(case: Case, link: str, end: Array) -> Iterator[Question]:
    """Ask about a segment from its origin to `end` (3,)."""
    mass, centre, tensor = case.chain.segment(link)
    length = float(np.linalg.norm(end))
    along = end / length
    share = float(centre @ along) / length
    aside = float(np.linalg.norm(centre - share * end)) / length
    if not CENTRE[0] <= share <= CENTRE[1] or aside > SEGMENT_LIMITS.max_centre_offset * (
        2 if link == "tibia" else 1
    ):
        words = ", ".join(f"{value / MILLIMETRE:.0f}" for value in centre)
        yield Question(
            f"the centre of mass of '{link}' is at ({words}) mm, off its segment: is the origin "
            "of its <inertial> right, sign and unit?",
            f"centre of mass of {link} off its segment",
        )
    inside = float(along @ tensor @ along)
    across = 0.5 * (float(np.trace(tensor)) - inside)
    radii = [float(np.sqrt(moment / mass)) / length for moment in (across, inside)]
    if not all(low <= radius <= high for radius, (low, high) in zip(radii, RADII, strict=True)):
        yield Question(
            f"the radii of gyration of '{link}' are {radii[0]:.2f} (across) and {radii[1]:.2f} "
            "(along) of its length, which no limb has: are <inertia> and <mass> in kg·m² and kg, "
            "about the centre of mass?",
            f"inertia of {link} unlike a limb's",
        )


@dataclass(frozen=True)
class ImplantShapeLimitSettings:
    """Limits of plausible shapes and positions of an implant."""

    flange_height_share: float = 0.15
    """1: share of the femoral component's height, from the top, that is searched for the flange.
    The posterior condyles end below."""
    min_flange_position: float = 0.35
    """1: least position of the component's top from its posterior end, as a share of its length.
    Eleven components have 0.92 to 0.97, one without a flange has 0.5, and a component that is back
    to front has less than 0.1."""
    min_opening_share: float = 0.05
    """1: a component opens in the direction from its surface's centroid to the centre of its
    bounding box. This direction is checked if that distance is more than this share of the largest
    extent. Ten components have 0.09 to 0.14, a sphere has 0."""
    max_opening_angle: float = 60.0 * DEGREE
    """rad: largest angle between the opening of the component and superior. The same ten components
    have at most 27 deg."""
    min_flatness_ratio: float = 2.0
    """1: ratio of the flat area of the largest flat side of a patellar button to that of its
    anterior side, above which the button may be turned. The flat area of the bone side of a real
    button is at least 15 times that of its joint side."""

    min_notch_share: float = 0.02
    """1: depth of the notch in front minus that behind, as a share of the insert's length, above
    which the insert may be back to front. Ten inserts have deeper notches behind, by 0.05 to
    0.3."""
    max_friction: float = 0.25
    """1: largest Coulomb coefficient of metal on polyethylene. Lubricated joints have 0.01 to 0.1,
    dry joints 0.2."""
    outline_offset: float = 0.25
    """1: distance from the middle to the compared outlines of an insert, as a share of its width.
    The condyles are there."""


IMPLANT_SHAPE_LIMITS = ImplantShapeLimitSettings()

FLAT = np.cos(5.0 * DEGREE)
"""1: cosine of the largest angle between the normal of a flat face and an axis of the part."""
AT_HEIGHTS = (0.15, 0.3, 0.45)
"""1: heights of the compared outlines as shares of the insert's height."""


def implant_questions(case: Case) -> Iterator[Question]:
    """Ask about implant parts that may be turned, and about too large a friction."""
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
            f"(0.2): is it {0.1 * contact.friction:g}?",
            "friction above any of metal on polyethylene",
        )


def _of_femoral(femoral: "Surface") -> Iterator[Question]:
    """Ask about a flange behind, or a component that does not open upward."""
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
    """Ask about a notch in front, by outlines at mid-width and at the condyles."""
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
    """Ask about a flat bone side that does not face forward."""
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
    middles, areas = surface.triangles.mean(axis=1), surface.areas
    return np.asarray(areas @ middles / areas.sum())


def _way(direction: Array) -> str:
    axis = int(np.abs(direction).argmax())
    return (("backward", "forward"), ("downward", "upward"), ("medially", "laterally"))[axis][
        int(direction[axis] > 0.0)
    ]
