"""Questions about lines of action: attachments, stiffness and strain."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array, inverse, transform
from tkamb.io.scene.case import Case
from tkamb.run.plausibility import Question, some
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.load import LinkPoint


@dataclass(frozen=True)
class LineLimitSettings:
    """Limits of plausible ligaments and muscle lines."""

    max_strain: float = 0.15
    """1: largest strain of a ligament. Ligaments of the knee tear at 0.12 to 0.20 (Kennedy et al.
    1976, Butler et al. 1986)."""
    min_strain: float = -0.4
    """1: least value of a ligament's largest strain in the motion. One with smaller strains has no
    effect.
    """
    max_attachment_distance: float = 0.16
    """m: largest distance of an attachment from the origin of insert or link. The
    superficial MCL, the farthest, ends 0.06 to 0.12 below the insert."""
    max_overlap: float = 0.03
    """m: largest height of a tibial end above the insert's bottom, and of a femoral end below the
    flexion axis. The ends in a knee overlap by less."""
    min_anterior_offset: float = 0.01
    """m: least distance of the quadriceps origin in front of the line from hip to knee. Three
    models have 0.029 to 0.044."""
    max_patella_distance: float = 0.06
    """m: largest distance of quadriceps insertion and patellar ligament from the patella's origin.
    A patella is 0.045 long."""
    max_tendon_change: float = 0.15
    """1: largest change of the patellar ligament's length, relative to the mean. Its
    strain is a few per cent."""


LINE_LIMITS = LineLimitSettings()

STIFFNESS_PER_MM, STIFFNESS_PER_STRAIN = (2.0, 500.0), (20.0, 30000.0)
"""N/mm and N: limits of a ligament's stiffness, from a tenth of a bundle of the capsule to more
than a whole cruciate ligament (347 N/mm: Race & Amis 1994; 18 kN for both PCL bundles:
Blankevoort & Huiskes 1996)."""
TENDON = (0.025, 0.085)
"""m: limits of the patellar ligament's length."""
ORIGIN = (0.08, 0.55)
"""m: limits of the height of an extensor's origin above the flexion axis."""
TUBEROSITY = (0.01, 0.11)
"""m: limits of the distance of the patellar ligament's distal end from the insert's centre."""
PATELLA_HEIGHT, PATELLA_ASIDE = 0.025, 0.025
"""m: least height of the quadriceps insertion above the patellar ligament's end (0.039 to 0.045 in
three models), and largest distance of both ends from the sagittal plane of the patella."""


NEAR_SIDE, FAR_SIDE = 0.001, 0.008
"""m: distance from the middle beyond which an end on the patella, and one on femur or tibia, is on
a side. The tuberosity of a symmetric knee is not far from the middle."""


def attachment_questions(case: Case) -> Iterator[Question]:
    """Ask about attachments in metres instead of millimetres, or far from the knee."""
    ends = [
        (f"{bundle.name} {side}", getattr(bundle, side))
        for bundle in (*case.ligaments, *case.patella_ligaments)
        for side in ("proximal", "distal")
    ]
    far = [name for name, end in ends if not _is_plausible_end(*_on_carrier(case, end))]
    if far:
        yield Question(
            f"{some(far)}: more than {LINE_LIMITS.max_attachment_distance / MILLIMETRE:.0f} mm "
            "from the knee, or beyond the joint; is point_mm, its sign or the link another one?",
            "attachment far from its place",
        )
    for muscle in case.muscles:
        ends += [(f"[{muscle.name}] origin", muscle.points[0])]
        ends += [(f"[{muscle.name}] via point", point) for point in muscle.points[1:-1]]
        ends += [(f"[{muscle.name}] insertion", muscle.points[-1])]
    for head in case.patella_heads:
        ends += [(f"{head.name} origin", head.origin), (f"{head.name} insertion", head.insertion)]
    if case.patellar_ligament:
        ends += [
            ("[patellar_ligament] proximal", case.patellar_ligament.proximal),
            ("[patellar_ligament] distal", case.patellar_ligament.distal),
        ]
    near_origin = [name for name, end in ends if 0.0 < np.abs(end.position).max() < MILLIMETRE]
    if near_origin:
        yield Question(
            f"{some(near_origin)}: within 1 mm of the link's origin; is point_mm in metres?",
            "attachment within 1 mm of its link's origin",
        )


def _on_carrier(case: Case, end: "LinkPoint") -> tuple[str, Array]:
    """Return an attachment's bone (femur, tibia or patella), and its position (3,), m.

    It is in the insert frame for the tibia, else in the link's frame.
    """
    chain = case.chain
    carrier = chain.carrier(end.link)
    place = transform(chain.link_in(end.link, carrier), end.position)
    if carrier == "tibia":
        place = transform(inverse(chain.insert_in_tibia), place)
    return carrier, place


def _is_plausible_end(carrier: str, place: Array) -> bool:
    """Return whether a ligament may end at a position (3,), m, from `_on_carrier`."""
    beyond = {"tibia": place[1], "femur": -place[1]}.get(carrier, 0.0)
    return (
        float(np.linalg.norm(place)) <= LINE_LIMITS.max_attachment_distance
        and beyond <= LINE_LIMITS.max_overlap
    )


def stiffness_questions(case: Case) -> Iterator[Question]:
    """Ask about a stiffness outside the range of ligaments."""
    for si_unit, (low, high), scale, unit in (
        ("N/m", STIFFNESS_PER_MM, MILLIMETRE, "N/mm"),
        ("N per strain", STIFFNESS_PER_STRAIN, 1.0, "N per unit strain"),
    ):
        values = {b.name: b.law.stiffness * scale for b in case.ligaments if b.law.unit == si_unit}
        if odd := [name for name, k in values.items() if not low <= k <= high]:
            yield Question(
                f"{some(odd)}: {values[odd[0]]:g} {unit} is no ligament's stiffness ({low:g} to "
                f"{high:g}): is it in another unit?",
                "stiffness of no ligament",
            )


def strain_questions(
    ligaments: "Sequence[Ligament]", strains: Mapping[str, Array], time: Array
) -> Iterator[Question]:
    """Ask about bundles that would tear, or are far from taut in all frames.

    Args:
        strains: name of a bundle -> strain at the recorded poses, (f,).
        time: times of the frames, s, (f,).
    """
    if not ligaments:
        return
    table = np.array([strains[bundle.name] for bundle in ligaments])
    most = table.max(axis=1)
    torn = [
        bundle.name
        for bundle, strain in zip(ligaments, most, strict=True)
        if strain > LINE_LIMITS.max_strain
    ]
    if torn:
        i, k = divmod(int(np.argmax(table)), table.shape[1])
        yield Question(
            f"{some(torn)} would strain beyond {100 * LINE_LIMITS.max_strain:.0f} %, "
            f"{ligaments[i].name} by {100 * table[i, k]:.0f} % at {time[k]:.4g} s: "
            "is an attachment, a slack length or the recorded pose wrong?",
            "",
        )
    loose = [
        bundle.name
        for bundle, strain in zip(ligaments, most, strict=True)
        if strain < LINE_LIMITS.min_strain
    ]
    if loose:
        yield Question(
            f"{some(loose)}: in all frames more than {-100 * LINE_LIMITS.min_strain:.0f} % slack; "
            "is an attachment, slack_length_mm or [motion] length_unit in another unit?",
            "ligament far from taut throughout",
        )


def extensor_questions(case: Case, poses: Mapping[str, Array]) -> Iterator[Question]:
    """Ask about the ends of quadriceps and patellar ligament, and the patellar ligament's length.

    Args:
        poses: link -> pose_link_in_insert, (f, 4, 4).
    """
    ligament = case.patellar_ligament
    if ligament is None:
        return
    _, tip = _on_carrier(case, ligament.proximal)
    hip = case.chain.link_in("hip", "femur")[:3, 3]
    off, on_patella = [], [("[patellar_ligament] proximal", tip, -1.0)]
    for muscle in case.muscles:
        _, origin = _on_carrier(case, muscle.points[0])
        ahead = origin[0] - hip[0] * origin[1] / hip[1]
        aside = np.hypot(origin[0], origin[2]) > 0.12
        if (
            not ORIGIN[0] <= origin[1] <= ORIGIN[1]
            or ahead < LINE_LIMITS.min_anterior_offset
            or aside
        ):
            off.append(f"[{muscle.name}] origin")
        _, base = _on_carrier(case, muscle.points[-1])
        on_patella.insert(-1, (f"[{muscle.name}] insertion", base, 1.0))
        if 0.0 <= base[1] < tip[1] + PATELLA_HEIGHT and tip[1] < 0.0:
            above = (base - tip)[1] / MILLIMETRE
            off.append(f"[{muscle.name}] insertion, {above:.0f} mm above the patellar ligament's,")
    _, distal = _on_carrier(case, ligament.distal)
    away = float(np.linalg.norm(distal))
    if not TUBEROSITY[0] <= away <= TUBEROSITY[1] or distal[0] < 0 or distal[1] > 0.01:
        off.append("[patellar_ligament] distal")
    for name, place, sign in on_patella:
        beyond = (
            np.linalg.norm(place) > LINE_LIMITS.max_patella_distance
            or abs(place[2]) > PATELLA_ASIDE
        )
        if beyond or sign * place[1] < 0.0:
            off.append(name)
    if off:
        yield Question(
            f"{some(off)}: no such line ends there; is point_mm, its sign or the link another one?",
            "extensor line ends off its bone",
        )
    ends = [transform(poses[e.link], e.position) for e in (ligament.proximal, ligament.distal)]
    lengths = np.linalg.norm(ends[0] - ends[1], axis=1)
    yield from _tendon(lengths[np.isfinite(lengths)], ligament.length)


def side_questions(case: Case) -> Iterator[Question]:
    """Ask about heads and ligaments of a released patella on the wrong side of it.

    The side is that of the name, or else of the other end.
    """
    ends = [
        (head.name, f"[[patella.head]] {head.name} insertion", head.insertion, head.origin)
        for head in case.patella_heads
    ]
    for bundle in case.patella_ligaments:
        proximal, distal = bundle.proximal, bundle.distal
        on_patella = case.chain.carrier(proximal.link) == "patella"
        if not on_patella:
            proximal, distal = distal, proximal
        which = "proximal" if on_patella else "distal"
        ends.append((bundle.name, f"[[patella.ligament]] {bundle.name} {which}", proximal, distal))
    odd = []
    for name, where, end, other in ends:
        here, there = (_on_carrier(case, one)[1][2] for one in (end, other))
        side = named_side(name) or np.sign(there) * (abs(there) > FAR_SIDE)
        if side * here < -NEAR_SIDE:
            odd.append(f"{where}, {abs(here) / MILLIMETRE:.0f} mm {_side_of(here)}")
        elif named_side(name) * there < -FAR_SIDE:
            odd.append(
                f"{where}: its other end, {abs(there) / MILLIMETRE:.0f} mm {_side_of(there)}"
            )
    if odd:
        yield Question(
            f"{some(odd)}: on the other side of the patella than its name or its other end says; "
            "is the sign of z in point_mm (to the right in both knees), or the name, wrong?",
            "line of the patella on the wrong side",
        )


def _side_of(place: float) -> str:
    return "lateral" if place > 0.0 else "medial"


def named_side(name: str) -> int:
    """Return 1 for the name of a lateral part, -1 of a medial one, else 0."""
    medial, lateral = "medial" in name.lower(), "lateral" in name.lower()
    return int(lateral) - int(medial)


def _tendon(lengths: Array, declared: float) -> Iterator[Question]:
    """Ask about unlikely lengths (f,), m, or a wrong length_mm."""
    if not len(lengths):
        return
    low, high = float(lengths.min()), float(lengths.max())
    mean = float(lengths.mean())
    if not TENDON[0] <= mean <= TENDON[1] or high - low > LINE_LIMITS.max_tendon_change * mean:
        yield Question(
            f"the patellar ligament is {low / MILLIMETRE:.0f} to {high / MILLIMETRE:.0f} mm long: "
            "is one of its ends, or the patella's motion, wrong in sign or unit?",
            "patellar ligament of odd length",
        )
    elif (
        abs(declared / mean - 1) > LINE_LIMITS.max_tendon_change
    ):  # False if none is declared (NaN)
        yield Question(
            f"the patellar ligament is {mean / MILLIMETRE:.0f} mm between its ends, but length_mm "
            f"is {declared / MILLIMETRE:g}: which is right?",
            "patellar ligament of odd length",
        )
