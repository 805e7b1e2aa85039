"""A ligament's side by its name: the MCL is medial, the LCL lateral, whatever the knee's side.

Retinacula and patellofemoral ligaments have a side too, and the iliotibial band is lateral.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass

from tkamb.errors import InputError
from tkamb.geometry.frames import inverse, transform
from tkamb.knee.chain import Chain
from tkamb.knee.ligaments import Ligament
from tkamb.knee.load import LinkPoint
from tkamb.units import MILLIMETRE


@dataclass(frozen=True)
class LigamentSideSettings:
    """Whether a collateral ligament is on its side of the knee."""

    wrong_side_distance: float = 8.0 * MILLIMETRE
    """m: an end farther than this beyond the middle of the knee is on the wrong side. Chosen:
    collateral ligaments end 20 to 45 mm from the middle, and no frame is displaced by as much as
    this."""


LIGAMENT_SIDE = LigamentSideSettings()


_KINDS = r"(collateral|retinacul|patell[ao])"
_MEDIAL = re.compile(
    rf"mcl|mpfl|(medial|tibial)[ _-]*{_KINDS}|{_KINDS}\w*[ _-]+medial", re.IGNORECASE
)
_LATERAL = re.compile(
    rf"(?<![a-z])l[ _-]?cl|fcl|lpfl|(?<![a-z])itb|iliotibial|(lateral|fibular)[ _-]*{_KINDS}"
    rf"|{_KINDS}\w*[ _-]+lateral",
    re.IGNORECASE,
)


def check_collateral_sides(ligaments: Iterable[Ligament], chain: Chain, side: str) -> None:
    """Raise where a ligament's name and its place are of different sides of the knee.

    Args:
        ligaments: the bundles, of a right knee or mirrored to one: z points laterally.
        chain: of the links that carry them.
        side: of the patient, for the message.

    Raises:
        InputError: names the bundle and its end.
    """
    for bundle in ligaments:
        sign = _lateral_sign(bundle.name)
        for name, end in (("proximal", bundle.proximal), ("distal", bundle.distal)):
            lateral = _lateral_place(end, chain)
            if sign * lateral < -LIGAMENT_SIDE.wrong_side_distance:
                opposite, own = ("lateral", "medial") if sign < 0 else ("medial", "lateral")
                raise InputError(
                    f"its {name} end lies {abs(lateral) / MILLIMETRE:.0f} mm on the {opposite} "
                    f"side of this {side} knee, but by its name it is a {own} ligament",
                    f"[[ligament]] {bundle.name}",
                    "turn the sign of z in point_mm (z points to the right on either side), or "
                    "correct [patient] side or the name",
                )


def _lateral_sign(name: str) -> int:
    """Return -1 for a ligament that is medial by its name, 1 for a lateral one, else 0."""
    medial, lateral = bool(_MEDIAL.search(name)), bool(_LATERAL.search(name))
    return int(lateral) - int(medial)


def _lateral_place(end: LinkPoint, chain: Chain) -> float:
    """Return how far (m) an end lies laterally in the insert frame, or the femur's or patella's."""
    carrier = chain.carrier(end.link)
    place = transform(chain.link_in(end.link, carrier), end.position)
    if carrier == "tibia":
        place = transform(inverse(chain.insert_in_tibia), place)
    return float(place[2])
