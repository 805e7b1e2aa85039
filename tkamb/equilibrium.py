"""Body and contact together: the only file that sees both.

Uncoupled (`coupling = "none"`): the body's equations give the superior-inferior contact
force, and the contact model presses that load in at the measured rotation.
"""

import time as clock
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.adjusted_press import press_adjusted
from tkamb.case import Case
from tkamb.contact.materials import material
from tkamb.contact.model import ContactPair, ContactResult, ContactStatus
from tkamb.contact.registry import contact_model
from tkamb.contact.summary import medial_points
from tkamb.geometry.adjustment import Adjustment
from tkamb.geometry.closest import ClosestPointQuery
from tkamb.geometry.frames import Array
from tkamb.mechanics import FrameLoads

NAN = float("nan")


@dataclass(frozen=True, eq=False)
class FrameContact:
    """The contact side of one frame.

    Args:
        result: the contact, None where it could not be computed.
        medial: (n,) which map points lie under the medial condyle.
        adjustment: the femoral adjustment, checked and perhaps restored; None if not asked for.
        seconds: computing time.
        problem: why there is no result, or empty.
        flags: plain words that a reader must know.
    """

    result: ContactResult | None
    medial: NDArray[np.bool_]
    adjustment: Adjustment | None
    seconds: float
    problem: str
    flags: tuple[str, ...]

    def area_above(self, side: str, pressure: float) -> float:
        """Return the share of a condyle's contact area above a pressure (Pa)."""
        if self.result is None:
            return NAN
        own = self.medial if side == "medial" else ~self.medial
        loaded = own & (self.result.pressure > 0)
        above = loaded & (self.result.pressure > pressure)
        area = self.result.area
        return float(area[above].sum() / area[loaded].sum()) if loaded.any() else NAN


class ContactSide:
    """The contact model of a case, prepared once.

    Args:
        case: a case with [contact].
    """

    def __init__(self, case: Case) -> None:
        table = case.scene.contact
        insert = case.scene.implant.insert
        assert table is not None and insert is not None
        assert case.femoral is not None and case.insert is not None
        self.case, self.table = case, table
        self.model = contact_model(table.model, table.resolution_mm, **table.options)
        pair = ContactPair(case.femoral, case.insert, material(table.material), insert.bearing)
        start = clock.perf_counter()
        self.state = self.model.prepare(pair)
        self.prepare_seconds = clock.perf_counter() - start

    def carry(
        self,
        body: FrameLoads,
        pose: Array,
        query: ClosestPointQuery,
        guess: ContactResult | None,
    ) -> FrameContact:
        """Press in what the body asks for, at the measured (or adjusted) rotation.

        Args:
            body: the body side of the frame.
            pose: (4, 4) measured pose_femoral_in_insert.
            query: closest points of the pair, for the femoral adjustment.
            guess: the previous frame's contact, which may save time.
        """
        load = float(body.loads.contact_force[1])
        if not np.isfinite(load):
            return self._nothing("no load from the equations")
        if load <= 0:
            return self._nothing("no compressive load")
        start = clock.perf_counter()
        adjustment = body.adjustment
        if adjustment is None:
            result = self.model.press(self.state, load, pose, guess)
        else:
            result, adjustment = press_adjusted(
                self.model, self.state, load, adjustment, query, guess
            )
        seconds = clock.perf_counter() - start
        medial = medial_points(self.state.points, result.pose, self.case.split)
        if result.status is not ContactStatus.OK:
            reason = f"contact {result.status.value.replace('_', ' ')}"
            words = "; ".join((reason, *result.flags))
            return FrameContact(None, medial, adjustment, seconds, words, ())
        return FrameContact(result, medial, adjustment, seconds, "", result.flags)

    def _nothing(self, problem: str) -> FrameContact:
        none = np.zeros(len(self.state.points), bool)
        return FrameContact(None, none, None, 0.0, problem, ())
