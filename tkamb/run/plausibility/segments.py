"""Questions about shank and thigh: masses, centres, radii of gyration, lengths."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.io.recordings.patient import DE_LEVA
from tkamb.io.scene.case import Case
from tkamb.run.plausibility.question import Question
from tkamb.units import DEGREE, MILLIMETRE


@dataclass(frozen=True)
class SegmentLimitSettings:
    """Which masses and positions of the segments of a leg are plausible."""

    max_mass_ratio: float = 1.6
    """1: largest ratio, either way, of a segment's mass to that of de Leva for the same body mass.
    The ratio is up to 1.35 between cadaver studies and up to 1.3 with obesity; pounds read as
    kilograms give 2.2."""
    max_patella_offset: float = 0.05
    """m; of the patella's centre of mass from its origin."""
    max_insert_rotation: float = 20.0 * DEGREE
    """rad; from the tibia's axes. Chosen: the slope is up to 10 deg, and the axis of a shank may be
    laid through other points."""
    max_centre_offset: float = 0.12
    """Share of a segment's length by which its centre of mass may lie beside its axis. Chosen: with
    the foot, which points forward, twice as much."""


SEGMENT_LIMITS = SegmentLimitSettings()

PATELLA_MASS = (0.02, 0.6)
"""kg, from the bone alone to all that moves with it."""
PATELLA_RADII = (0.005, 0.04)
"""m, of gyration: a bone 45 mm wide and 20 mm thick has 9 to 13 mm."""

SHANK_SHARE, THIGH_SHARE = (0.19, 0.30), (0.19, 0.31)
"""Least and largest length, as shares of body height: 0.246 and 0.245 (Drillis & Contini 1966),
about a quarter less or more."""
RADII = ((0.15, 0.45), (0.05, 0.30))
"""Of gyration over segment length, across and along it: de Leva's are 0.24 to 0.37 and 0.09 to
0.16; a foot makes the shank's larger."""
CENTRE = (0.15, 0.8)
"""Of a segment's mass, as a share of its length from the distal joint: 0.37 to 0.64 (de Leva)."""


def segment_questions(case: Case) -> Iterator[Question]:
    """Masses, centres and inertias of shank and thigh, and their lengths."""
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
            f"'{link}' of the URDF weighs {masses[link]:.3g} kg, {ratios[link]:.2g} times what it "
            f"does in a body of {case.body_mass:g} kg: is mass_kg, or the URDF's, in pounds?",
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
            "insert far turned in the tibia",
        )


def _of_patella(case: Case) -> Iterator[Question]:
    """The patella's mass, where its centre is, and its inertia."""
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
    """One segment's centre and radii of gyration, between its origin and its proximal end."""
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
            f"the radii of gyration of '{link}' are {radii[0]:.2f} across and {radii[1]:.2f} along "
            "of its length, no limb's: are <inertia> and <mass> in kg·m² and kg, about the "
            "centre of mass?",
            f"inertia of {link} unlike a limb's",
        )
