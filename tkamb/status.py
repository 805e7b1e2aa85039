"""The status of a frame in words: "ok", why it failed, or what a reader must know."""

from typing import TYPE_CHECKING

from tkamb.case import Case
from tkamb.mechanics import FrameLoads
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.equilibrium import FrameContact

FILTER_TRANSLATION = 0.5 * MILLIMETRE
FILTER_ROTATION = 0.5 * DEGREE
"""Where filtering moves a pose by more than fluoroscopy errs, the frame is flagged."""

FAILED = "failed: "


def frame_status(case: Case, k: int, body: FrameLoads, contact: "FrameContact | None") -> str:
    """Return "ok", or reason words joined by "; ". A frame without force begins with failed."""
    failures = list(body.loads.problems)
    if contact and contact.problem and not failures:
        failures.append(contact.problem)
    words = [*_motion_flags(case, k)]
    words += [f"{side} condyle off the insert" for side in sorted(body.loads.lifted)]
    words += list(contact.flags) if contact else []
    if failures:
        return FAILED + "; ".join([*failures, *words])
    return "; ".join(words) or "ok"


def _motion_flags(case: Case, k: int) -> list[str]:
    motion = case.motion
    far = motion.deviation_translation[k] > FILTER_TRANSLATION
    turned = motion.deviation_rotation[k] > FILTER_ROTATION
    return ["filter moves the recorded pose beyond 0.5 mm or 0.5 deg"] if far or turned else []
