"""Cam and post of a case: prepared if the scene asks for them, and evaluated at a pose."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.cam_post import CamPost, PostContact
    from tkamb.contact.materials import Material
    from tkamb.contact.model import ContactModel
    from tkamb.geometry.frames import Array
    from tkamb.io.scene.case import Case
    from tkamb.io.scene.tables import ContactTable


@dataclass(frozen=True)
class PostSideSettings:
    """On which side of the post the cam is."""

    pose_error: float = 0.5 * MILLIMETRE
    """m: error of a position from fluoroscopy; a deeper overlap of cam and post becomes a question
    to the user. Chosen: above its usual error."""


POST_SIDE = PostSideSettings()


def cam_on_post(
    case: "Case", model: "ContactModel", material: "Material", ready: "CamPost | None" = None
) -> "CamPost | None":
    """Return cam and post, prepared; None where the scene does not ask for them.

    Args:
        case: the case.
        model: the contact model.
        material: of the insert.
        ready: the same prepared already, perhaps of another material.

    Raises:
        InputError: see `CamPost`.
    """
    if case.post is None:
        return None
    if ready is not None:
        return ready if ready.material == material else ready.of_material(material)
    from tkamb.contact.cam_post import CamPost

    assert case.femoral is not None
    return CamPost(model, case.femoral, case.post, case.split, material)


def post_contact(
    cam_post: "CamPost | None", pose: "Array", table: "ContactTable"
) -> "PostContact | None":
    """Return cam and post at a pose (4, 4), with a question if a recorded AP makes them overlap.

    None where the scene does not ask for them.
    """
    if cam_post is None:
        return None
    post = cam_post.at(pose)
    if "ap" in table.released or post.problem or not post.gap < -POST_SIDE.pose_error:
        return post
    question = (
        f"cam and post overlap by {-post.gap / MILLIMETRE:.1f} mm as recorded, which makes "
        f"{np.linalg.norm(post.force):.0f} N: release ap"
    )
    return replace(post, flags=(*post.flags, question))
