"""The contact side of one frame, as the run records it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.area import area_above
from tkamb.contact.result import ContactResult, WarmStart
from tkamb.geometry.adjustment import Adjustment

if TYPE_CHECKING:
    from tkamb.contact.cam_post import PostContact
    from tkamb.knee.equilibrium.released import KneeEquilibrium

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
        iterations: iterations between body and contact until convergence; 0 if not coupled.
        load_change: N, change of the load in the last iteration.
        point_change: m, change of the centres of pressure in the last iteration.
        equilibrium: the search for the released coordinates, if there are any.
        sensitivity: N/rad, of the medial force to adduction (`split_sensitivity`); NaN where
            adduction is released, or there is one condyle.
        start: where a contact of the next frame may begin; None where there is no result.
        triangles: (k, 3) of the map.
        post: cam and post, where the scene asks for their contact.
    """

    result: ContactResult | None
    medial: NDArray[np.bool_]
    adjustment: Adjustment | None
    seconds: float
    problem: str
    flags: tuple[str, ...]
    iterations: int = 0
    load_change: float = NAN
    point_change: float = NAN
    equilibrium: "KneeEquilibrium | None" = None
    sensitivity: float = NAN
    start: WarmStart | None = None
    triangles: NDArray[np.int64] | None = None
    post: "PostContact | None" = None

    def area_above(self, side: str, pressure: float) -> float:
        """Return the share of a condyle's contact area above a pressure (Pa), 1 at most.

        The pressure is taken as linear between the map's points, see
        `tkamb.contact.area.area_above`.
        """
        if self.result is None or self.triangles is None:
            return NAN
        condyle = self.result.medial if side == "medial" else self.result.lateral
        if condyle is None:
            return NAN
        own = self.medial if side == "medial" else ~self.medial
        own_pressure = np.where(own, self.result.pressure, 0.0)
        above = area_above(self.result.points, self.triangles, own_pressure, pressure)
        return min(above / condyle.area, 1.0)
