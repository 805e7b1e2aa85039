"""Knee, motion and ground reaction of a scene (`tkamb.read_scene`).

`recording_of` adds the other parts of a run: muscles of [muscles], patella in all frames, femoral
adjustment, post and coupling.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from tkamb.errors import InputError, must_be
from tkamb.geometry.frames import Array, inverse, knee_pose, sagittal_pose
from tkamb.io.scene import Scene, load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.knee.chain import ChainMotion
from tkamb.knee.frame import FrameMethod
from tkamb.knee.instant import nearest_gap
from tkamb.knee.knee import Knee
from tkamb.knee.parts import Extensor, Implant
from tkamb.knee.unknowns import CONTACT_POINT
from tkamb.run.recording import Ground, Motion, Recording
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.cam_post import CamPost
    from tkamb.contact.pair import ContactPair
    from tkamb.knee.contact import KneeContact
    from tkamb.knee.extensor import ExtensorFrames
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.patella_frame import PatellaMethod
    from tkamb.run.muscles.shared_muscles import SharedMuscles

STRAIN_FLEXIONS = (0.0, 60.0, 90.0)
"""deg: flexions at which the summary states the ligaments' strains."""


@dataclass(frozen=True, eq=False)
class SharedState:
    """State that a sample (a case with changed inputs) shares with the nominal case.

    Args:
        muscles: muscles of [muscles], possibly with other strengths than the nominal ones.
        extensor: extensor mechanism of the nominal case, whose patella is the initial guess.
        frames: frames with a search for the patella. Other frames keep the nominal pose.
    """

    pair: "ContactPair | None"
    muscles: "SharedMuscles | None"
    extensor: "ExtensorFrames | None"
    frames: range


def read_scene(scene: Scene | Case | str | Path) -> tuple[Knee, Motion, Ground]:
    """Return the knee of a scene, its motion and its ground reaction.

    The knee's model is the leg of the scene with a free-flyer joint at the tibia, x forward, y up,
    z to the right. A left leg is read as its mirror image. The pose of a patella with motion
    "solved" is computed for all frames and is part of q.

    Args:
        scene: scene, path of a scene file, or case.

    Raises:
        InputError: the scene or a file that it names cannot be used.
    """
    if isinstance(scene, str | Path):
        scene = load_scene(scene)
    must_be(scene, (Scene, Case), "read_scene", "give a scene or the path of a scene file")
    case = scene if isinstance(scene, Case) else load_case(scene)
    if case.scene.muscles is not None:  # [muscles] is not part of the knee
        case = replace(case, scene=case.scene.model_copy(update={"muscles": None}))
    recording = recording_of(case)
    knee, motion, ground = recording.knee, recording.motion, recording.ground
    if knee.contact is not None:
        knee.contact.state  # noqa: B018  prepare the contact, so that errors occur here
    if ground is None:
        none = pin.StdVec_Force([pin.Force.Zero()] * knee.model.njoints)
        ground = Ground((none,) * len(motion), np.full((len(motion), 3), np.nan))
    return knee, motion, ground


def recording_of(
    case: Case,
    shared: SharedState | None = None,
    near: bool = False,
    contact: "KneeContact | None" = None,
    split_sensitivity: bool = True,
    cam: "CamPost | None" = None,
) -> Recording:
    """Return the knee of a case in the frames of its motion. The contact is not prepared here.

    Args:
        shared: state of the nominal case, for a sample; None: the case is no sample.
        near: whether to skip the check that the condyles are near the insert.
        contact: prepared contact model; None: the contact model of the scene.
        cam: prepared cam and post with the same contact model; None: there are none yet.

    Raises:
        InputError: the parts of the scene do not fit together.
    """
    poses = knee_pose(case.motion.coordinates)
    knee = _knee(case, shared, contact)
    if shared is None and not near:
        _check_near(case, knee, poses)
    extensor = None
    if knee.extensor_lines is not None:
        extensor = _extensor_frames(case, knee, poses, shared)
    strains = None
    patella_lines: tuple[Ligament, ...] = ()
    if case.ligaments or case.patella_ligaments:
        from tkamb.knee.ligaments import build_ligaments, strain_table

        flexion, links = case.motion.coordinates[:, 5], link_poses(case, poses, extensor)
        patella_lines = build_ligaments(case.patella_ligaments, links, flexion)
    if case.ligaments:
        bundles = build_ligaments(case.ligaments, links, flexion)
        knee = knee.with_ligaments(bundles)
        strains = strain_table(bundles, links, flexion, STRAIN_FLEXIONS)
    motion = _motion(case, extensor)
    muscles = shared.muscles if shared else _muscles(case)
    if patella_lines:
        knee = knee._with_patella(_patella_method(case, knee, patella_lines))
    ground, method = _ground(case, motion), _method(case, knee, split_sensitivity, cam)
    return Recording(method, motion, ground, extensor, muscles, strains)


def _method(case: Case, knee: Knee, split_sensitivity: bool, cam: "CamPost | None") -> FrameMethod:
    table, adjust = case.scene.contact, None
    if table is None:
        return FrameMethod(knee)
    if table.adjust:
        from tkamb.geometry.adjustment import AdjustmentSettings

        adjust = AdjustmentSettings(restore_when=table.adjust_restore_when)
    coupled, released = table.coupling == "points", tuple(table.released)
    return FrameMethod(knee, coupled, released, adjust, split_sensitivity, case.post, cam)


def _patella_method(case: Case, knee: Knee, lines: "tuple[Ligament, ...]") -> "PatellaMethod":
    from tkamb.knee.muscles import off_femur
    from tkamb.knee.patella_frame import HeadShare, PatellaMethod

    assert case.scene.patella is not None and knee.extensor_lines is not None
    assert knee.button_contact is not None
    main, heads = knee.extensor_lines.muscle, case.patella_heads
    if not heads:
        segment = off_femur(main.points, knee.chain)
        origin, insertion = main.points[segment : segment + 2]
        heads = (HeadShare(main.name, origin, insertion, 1.0),)
    outline, released = (
        None if main.wrap is None else main.wrap.outline,
        case.scene.patella.released,
    )
    return PatellaMethod(knee.button_contact, knee.chain, heads, lines, outline, released)


def link_poses(case: Case, poses: Array, extensor: "ExtensorFrames | None") -> dict[str, Array]:
    """Return link -> recorded pose_link_in_insert, (f, 4, 4), for all links with attachments.

    Args:
        poses: recorded pose_femur_in_insert, (f, 4, 4).
    """
    chain, ligament = case.chain, case.patellar_ligament
    shank = np.broadcast_to(inverse(chain.insert_in_tibia), poses.shape)
    result: dict[str, Array] = {"femur": poses, "tibia": shank}
    if extensor is not None:
        places = [sagittal_pose(extensor.joints(k)[0]) for k in range(len(poses))]
        result["patella"] = poses @ chain.patella_joint_in_femur @ np.array(places)
    bundles = (*case.ligaments, *case.patella_ligaments)
    links = {link for bundle in bundles for link in bundle.links}
    if ligament is not None:
        links |= {ligament.proximal.link, ligament.distal.link}
    for link in links - set(result):
        carrier = chain.carrier(link)
        result[link] = result[carrier] @ chain.link_in(link, carrier)
    return result


def _knee(case: Case, shared: SharedState | None, contact: "KneeContact | None") -> Knee:
    scene, extensor = case.scene, None
    table, insert = scene.contact, scene.implant.insert
    implant = Implant(case.femoral, case.insert, case.patella, placed=True)
    friction = 0.0 if table is None else table.friction
    if table is not None and contact is None:
        from tkamb.contact.pair import ContactPair
        from tkamb.contact.registry import contact_model_in_mm
        from tkamb.io.given_material import given_material
        from tkamb.knee.contact import KneeContact

        assert insert is not None and case.femoral is not None and case.insert is not None
        pair = shared.pair if shared else None
        if pair is None:
            material = given_material(scene.insert_material)
            pair = ContactPair(case.femoral, case.insert, material, insert.bearing)
            pair.__dict__["split"] = case.split  # computed once for case and pair
        model = contact_model_in_mm(table.model, table.resolution_mm, table.options)
        contact = KneeContact(model, pair, friction)
    if contact is not None:
        pair = contact.pair
        implant = replace(implant, material=pair.material, bearing=pair.bearing)
    if scene.patella is not None:
        (muscle,) = case.muscles
        assert case.patellar_ligament is not None
        solved = scene.patella.motion == "solved"
        extensor = Extensor(muscle, case.patellar_ligament, solved=solved)
    button = None if table is None else table.patellofemoral
    patellofemoral = None
    if button is not None:
        from tkamb.contact.registry import contact_model_in_mm
        from tkamb.io.given_material import given_material

        implant = replace(implant, patella_material=given_material({"base": button.material}))
        patellofemoral = contact_model_in_mm(button.model, button.resolution_mm, button.options)
    return Knee(
        case.chain.model,
        implant=implant,
        extensor=extensor,
        contact=contact,
        friction=friction,
        patellofemoral_contact=patellofemoral,
    )


def _check_near(case: Case, knee: Knee, poses: Array) -> None:
    table = case.scene.contact
    if table is None or table.released:
        return
    nearest: list[float] = []
    for k in (len(poses) // 2, 0, len(poses) - 1):
        nearest.append(nearest_gap(knee._query.at(poses[k])))
        if abs(nearest[-1]) <= CONTACT_POINT.max_gap:
            return
    gap = min(nearest, key=abs)
    raise InputError(
        f"neither condyle is near the insert (nearest {abs(gap) / MILLIMETRE:.0f} mm "
        f"{'apart' if gap > 0 else 'inside'})",
        "[motion] with [implant.femoral] and [implant.insert]",
        "check whether the meshes are exchanged, and units, axes and positions of meshes and "
        "motion",
    )


def _extensor_frames(
    case: Case, knee: Knee, poses: Array, shared: SharedState | None
) -> "ExtensorFrames":
    from tkamb.knee.extensor import ExtensorFrames

    motion, recorded = case.motion, None
    assert case.scene.patella is not None and knee.extensor_lines is not None
    if shared is not None:
        assert shared.extensor is not None
        given = motion.patella if case.scene.patella.motion == "recorded" else None
        return shared.extensor.moved(knee.extensor_lines, poses, shared.frames, given)
    if case.scene.patella.motion == "recorded":
        if motion.patella is None:
            raise InputError(
                "has no patella columns",
                case.scene.motion.file,
                "record patella_ap, patella_si, patella_rotation or set [patella] motion = "
                "'solved'",
            )
        assert motion.patella_velocity is not None and motion.patella_acceleration is not None
        rates = (motion.patella_velocity, motion.patella_acceleration)
        recorded = np.stack([motion.patella, *rates], axis=1)
    return ExtensorFrames(knee.extensor_lines, motion.time, poses, recorded, case.rates)


def _motion(case: Case, extensor: "ExtensorFrames | None") -> Motion:
    motion, tibia, states = case.motion, case.tibia, []
    still = (np.eye(4), np.zeros(6), np.zeros(6))
    for k, rows in enumerate(
        np.stack([motion.coordinates, motion.velocity, motion.acceleration], axis=1)
    ):
        joints = rows if extensor is None else np.hstack([rows, extensor.joints(k)])
        shank = still
        if tibia is not None:
            shank = (tibia.pose[k], tibia.velocity[k], tibia.acceleration[k])
        states.append(case.chain.configuration(ChainMotion(*shank, joints)))
    q, v, a = (np.array(values) for values in zip(*states, strict=True))
    return Motion(motion.time, q, v, a, motion.coordinates)


def _ground(case: Case, motion: Motion) -> Ground | None:
    ground, table, model = case.ground, case.scene.ground_reaction, case.chain.model
    if ground is None or table is None:
        return None
    points, moments = ground.point, ground.moment
    if table.applied == "ankle":
        assert case.tibia is not None
        points, moments = case.tibia.pose[:, :3, 3], np.zeros_like(ground.force)
    joint = model.frames[case.chain.frame_id("tibia")].parentJoint
    data, result = model.createData(), []
    for q, force, point, moment in zip(motion.q, ground.force, points, moments, strict=True):
        pin.forwardKinematics(model, data, q)
        forces = [pin.Force.Zero()] * model.njoints
        forces[joint] = data.oMi[joint].actInv(pin.Force(force, moment + np.cross(point, force)))
        result.append(pin.StdVec_Force(forces))
    return Ground(tuple(result), points)


def _muscles(case: Case) -> "SharedMuscles | None":
    if case.scene.muscles is None:
        return None
    from tkamb.run.muscles.shared_muscles import load_muscles

    return load_muscles(case)
