"""The contact of one frame in a run: condyles, cam and post."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.area import area_above
from tkamb.contact.result import ContactResult, WarmStart
from tkamb.geometry.adjustment import Adjustment
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.cam_post import CamPost, PostContact
    from tkamb.contact.materials import Material
    from tkamb.contact.model import ContactModel
    from tkamb.contact.pair import ContactPair
    from tkamb.geometry.frames import Array
    from tkamb.geometry.surface import Surface
    from tkamb.knee.released import KneeEquilibrium


@dataclass(frozen=True)
class PostSideSettings:
    """Limits for cam and post."""

    pose_error: float = 0.5 * MILLIMETRE
    """m: overlap of cam and post at a recorded pose above which a flag is set. Chosen because it is
    the usual error of a position from fluoroscopy."""


POST_SIDE = PostSideSettings()


def cam_on_post(
    model: "ContactModel",
    pair: "ContactPair",
    post: "Surface",
    material: "Material",
    ready: "CamPost | None" = None,
) -> "CamPost":
    """Return the prepared contact of cam and post.

    Args:
        model: the contact model.
        pair: femoral component and insert.
        post: surface of the insert's post, insert frame.
        material: material of the insert.
        ready: an earlier result, also with another material; None: no earlier result.

    Raises:
        InputError: see `CamPost`.
    """
    if ready is not None:
        return ready if ready.material == material else ready.of_material(material)
    from tkamb.contact.cam_post import CamPost

    return CamPost(model, pair.femoral, post, pair.split, material)


def post_contact(
    cam_post: "CamPost | None", pose: "Array", released: Sequence[str]
) -> "PostContact | None":
    """Return the contact of cam and post at a pose (4, 4); None: not modelled.

    The result has a flag if cam and post overlap at a recorded AP position.
    """
    if cam_post is None:
        return None
    post = cam_post.at(pose)
    # With AP released, equilibrium determines the overlap.
    if "ap" in released or post.problem or not post.gap < -POST_SIDE.pose_error:
        return post
    flag = (
        f"cam and post: they overlap by {-post.gap / MILLIMETRE:.1f} mm at the recorded position, "
        f"with a force of {np.linalg.norm(post.force):.0f} N: add 'ap' to [contact] released"
    )
    return replace(post, flags=(*post.flags, flag))


NAN = float("nan")


@dataclass(frozen=True, eq=False)
class FrameContact:
    """The contact of one frame, with the data of its computation.

    Args:
        result: the contact; None: it could not be computed.
        medial: whether each map point lies under the medial condyle, shape (n,).
        adjustment: the femoral adjustment after its check; None: the run has no adjustment.
        seconds: computing time, s.
        problem: reason why there is no result; empty: there is a result.
        flags: flags of the result.
        iterations: number of iterations between loads and contact; 0: not coupled.
        load_change: change of the load in the last iteration, N.
        point_change: change of the centres of pressure in the last iteration, m.
        equilibrium: result of the search for released coordinates; None: none are released.
        sensitivity: change of the medial force with adduction (`split_sensitivity`), N/rad; NaN:
            adduction is released, or there is one condyle.
        start: warm start of the next frame; None: there is no result.
        triangles: triangles of the map, shape (k, 3).
        post: contact of cam and post; None: not modelled.
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

        The pressure is linear between the map points, see `tkamb.contact.area.area_above`.
        """
        if self.result is None or self.triangles is None:
            return NAN
        condyle = self.result.medial if side == "medial" else self.result.lateral
        if condyle is None:
            return NAN
        under_condyle = self.medial if side == "medial" else ~self.medial
        condyle_pressure = np.where(under_condyle, self.result.pressure, 0.0)
        above = area_above(self.result.points, self.triangles, condyle_pressure, pressure)
        return min(above / condyle.area, 1.0)
