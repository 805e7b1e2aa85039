"""Where an answer stops being one: bodies pressed through each other, pressures beyond any law."""

from collections.abc import Iterator

import numpy as np

from tkamb.contact.pair import ContactPair
from tkamb.contact.result import CondyleContact, ContactResult
from tkamb.geometry.first_touch import Touch
from tkamb.geometry.frames import Array
from tkamb.units import MEGAPASCAL, MILLIMETRE

HIGHEST_KNOWN = 100.0 * MEGAPASCAL
"""Peak pressure beyond which polyethylene's curves are extrapolated (they end at 40 to 60 MPa)."""
HALF = 0.5
"""Approach over thickness beyond which a result is flagged; at 1 it is none."""
AROUND = 0.5 * MILLIMETRE
"""Within this of its rim the insert is as thick as anywhere so near: it has no thickness there."""
SKIN = 1e-7
"""m; rays into the insert start so far below its surface, and nothing counts as thinner."""

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
    thickness = thickness_near(pair, np.array(list(places.values())))
    worst = int(thickness.argmin())
    where, (x, _, z) = list(places.items())[worst]
    return result.approach / float(thickness[worst]), (
        f"an approach of {result.approach / MILLIMETRE:.3g} mm {where} (x = {x / MILLIMETRE:.1f}, "
        f"z = {z / MILLIMETRE:.1f} mm), where the insert is {thickness[worst] / MILLIMETRE:.3g} mm "
        "thick"
    )


def thickness_near(pair: ContactPair, places: Array) -> Array:
    """Return the insert's thickness (n,), m, along y at places (n, 3), from its top down.

    To where it ends first. Near a rim it is the largest within `AROUND`; the height above the
    bottom where no column meets the insert.
    """
    low, high = pair.insert.bounds[:, 1]
    columns = (places[:, None] + COLUMNS).reshape(-1, 3)
    columns[:, 1] = high + AROUND
    enter, _ = pair.insert_rays.first(columns, DOWN)
    met = np.isfinite(enter)
    columns[met, 1] -= enter[met] + SKIN
    leave, _ = pair.insert_rays.first(columns, DOWN)
    met &= np.isfinite(leave)
    thick = np.where(met, leave + SKIN, 0.0).reshape(len(places), -1)
    whole = met.reshape(thick.shape).all(axis=1)
    found = np.where(whole, thick[:, 0], thick.max(axis=1))
    return np.maximum(np.where(found > 0, found, places[:, 1] - low), SKIN)
