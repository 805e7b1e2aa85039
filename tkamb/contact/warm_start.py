"""Where a contact solver may begin: a thing of its own, which the caller hands on.

A `ContactResult` is an answer and nothing else. Who presses again and again takes
`ContactModel.press_from`, which returns the answer and the start of the next press, and passes
that on. An answer may stand in for a start: it saves less time.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tkamb.contact.pair import ContactPair
from tkamb.contact.result import ContactResult
from tkamb.geometry.frames import Array


@dataclass(frozen=True, eq=False)
class WarmStart:
    """An earlier contact, as far as a next one of the same prepared state may begin with it.

    It may save time, and changes no answer beyond the model's tolerance.

    Args:
        pair: the two bodies.
        pose: (4, 4) pose_femoral_in_insert.
        points: (n, 3) m, the map's.
        pressure: (n,) Pa; NaN where the contact failed.
        gap: (n,) m.
    """

    pair: ContactPair
    pose: Array
    points: Array
    pressure: Array
    gap: Array

    @classmethod
    def after(cls, result: ContactResult) -> "WarmStart":
        """Return the start that an answer by itself gives."""
        return WarmStart(result.pair, result.pose, result.points, result.pressure, result.gap)

    @cached_property
    def approach(self) -> float:
        """m, travel along -y since first touch; NaN where the contact failed."""
        failed = bool(np.isnan(self.pressure).any())
        return float("nan") if failed else self.pair.approach(self.pose)


Guess = ContactResult | WarmStart
"""What a press may begin with: both have `pose`, `points`, `pressure`, `gap` and `approach`."""
