"""Where an answer stops being one: bodies pressed through each other, pressures beyond any law."""

from collections.abc import Iterator

import numpy as np

from tkamb.contact.model import CondyleContact, ContactPair, ContactResult
from tkamb.geometry.first_touch import Touch
from tkamb.geometry.frames import Array
from tkamb.units import MEGAPASCAL, MILLIMETRE

HIGHEST_KNOWN = 100.0 * MEGAPASCAL
"""Peak pressure beyond which polyethylene's curves are extrapolated (they end at 40 to 60 MPa)."""
HALF = 0.5
"""Approach over thickness beyond which a result is flagged; at 1 it is none."""
AROUND = 0.5 * MILLIMETRE
"""Within this of its rim the insert is as thick as anywhere so near: it has no thickness there."""
THINNEST = 1e-9
"""m; nothing is thinner."""

COLUMNS = np.array([(x, 0.0, z) for x in (0, -1, 1) for z in (0, -1, 1)]) * AROUND
DOWN = np.array([0.0, -1.0, 0.0])


def peak_flags(medial: CondyleContact | None, lateral: CondyleContact | None) -> Iterator[str]:
    """Yield a flag for each condyle whose peak pressure is beyond what any law was fitted to."""
    for side, condyle in (("medial", medial), ("lateral", lateral)):
        if condyle is not None and condyle.peak_pressure > HIGHEST_KNOWN:
            yield (
                f"{side} peak above {HIGHEST_KNOWN / MEGAPASCAL:.0f} MPa: polyethylene's law is "
                "not known there; is this the lip or an edge?"
            )


def compression(pair: ContactPair, touch: Touch, result: ContactResult) -> tuple[float, str]:
    """Return the largest ratio of approach to insert thickness, and in words where it is.

    The undeformed bodies overlap by the whole approach where they first touch. It is compared
    with the insert's thickness there and under each condyle's centre of pressure: a spike of
    the femoral component is met at the one, a spike of the insert at the other.

    Args:
        pair: the two bodies.
        touch: where they first touch at the result's rotation, x and z.
        result: a contact with an approach.
    """
    condyles = {"medial": result.medial, "lateral": result.lateral}
    places = {"where the meshes first touch": touch.point} | {
        f"under the {side} condyle": condyle.centre_of_pressure
        for side, condyle in condyles.items()
        if condyle is not None
    }
    found = []
    for where, place in places.items():
        thickness = thickness_near(pair, place)
        x, z = place[[0, 2]] / MILLIMETRE
        words = (
            f"an approach of {result.approach / MILLIMETRE:.3g} mm {where} (x = {x:.1f}, "
            f"z = {z:.1f} mm), where the insert is {thickness / MILLIMETRE:.3g} mm thick"
        )
        found.append((result.approach / thickness, words))
    return max(found)


def thickness_near(pair: ContactPair, place: Array) -> float:
    """Return the insert's thickness (m) along y at a place (3,), from the top to where it ends.

    Near a rim it is the largest within `AROUND`; the height above the bottom where no column
    meets the insert.
    """
    low, high = pair.insert.bounds[:, 1]
    origins = place + COLUMNS
    origins[:, 1] = high + AROUND
    ray, along, face = pair.insert_rays.all(origins, DOWN)
    leaves = pair.insert.face_normals[face, 1] < 0
    enter, exit_ = np.full(len(origins), np.inf), np.full(len(origins), np.inf)
    np.minimum.at(enter, ray[~leaves], along[~leaves])
    np.minimum.at(exit_, ray[leaves], along[leaves])
    whole = np.isfinite(enter) & np.isfinite(exit_)
    thick = exit_[whole] - enter[whole]
    if not whole.any():
        thick = place[1:2] - low
    return max(float(thick[0] if whole.all() else thick.max()), THINNEST)
