"""Muscle forces on bones: virtual work against change of length, wrenches, knee reaction."""

import numpy as np
import pytest

from jw_gait import gait, needs_jw
from opensim_models import kinematics
from plane_leg import muscle, plane_leg
from tkamb.errors import InputError
from tkamb.geometry.frames import inverse, rotate
from tkamb.io.importing.anatomy import find_leg
from tkamb.io.opensim.motion import CoordinateMotion
from tkamb.io.opensim.paths import LineSet
from tkamb.run.muscles import Sharing, solve_trial
from tkamb.run.muscles.leg import leg_bones

STEP = 3e-5
KNEE_AXES = tuple(f"knee_{axis}" for axis in ("flexion", "adduction", "rotation", "tx", "ty", "tz"))


def still(chain, q):
    """Return a motion through coordinates q (f, n) with zero velocity and acceleration."""
    return CoordinateMotion(np.arange(float(len(q))), q, 0 * q, 0 * q)


@pytest.fixture(scope="module")
def walking():
    trial = gait(2.2, 2.75)
    return trial, solve_trial(trial.kinematics.model, trial.motion, trial.loads)


def moved_points(chain, q, coordinate, bones, attached):
    """Return the virtual work (f, m) of unit muscle tensions per unit of one coordinate.

    The velocities of the attachments are central differences.

    Args:
        chain: the model's kinematics.
        q: (f, n) coordinates of the model.
        coordinate: name of the only coordinate that moves.
        bones: bone -> its first body.
        attached: bone -> list of Attachments on it.
    """
    total = 0.0
    for bone, several in attached.items():
        ends = []
        for sign in (1.0, -1.0):
            shifted = q.copy()
            shifted[:, chain.coordinates[coordinate]] += sign * STEP
            ends.append(chain.poses(shifted)[:, chain.bodies[bones[bone]]])
        rate = (ends[0] - ends[1]) / (2.0 * STEP)
        rotation = chain.poses(q)[:, chain.bodies[bones[bone]], :3, :3]
        for a in several:
            velocity = np.einsum("fij,fmj->fmi", rate[:, :3, :3], a.points) + rate[:, None, :3, 3]
            pull = np.einsum("fij,fmj->fmi", rotation, a.directions)
            total = total + np.nansum(pull * velocity, axis=2)
    return total


@needs_jw
def test_work_at_the_attachments_is_the_change_of_length(walking):
    """The virtual work of unit tension is -dL/dq along each of the knee's six axes."""
    trial, result = walking
    chain, q = trial.kinematics, trial.motion.q[::33]
    pull = result.bones.pull_on(("tibia", "foot"), "tibia")[..., 3:]
    names = [result.muscles[k] for k in np.flatnonzero(np.abs(pull).max(axis=(0, 2)) > 1e-6)]
    assert len(names) == 13
    some = solve_trial(chain.model, still(chain, q), {}, sharing=Sharing(tuple(names))).bones
    first = {bone: bodies[0] for bone, bodies in leg_bones(find_leg(chain.model, "right")).items()}
    towards = {"tibia": (None, "femur", "patella", "foot"), "foot": (None, "femur", "tibia")}
    attached = {b: [some.attachments(b, o) for o in others] for b, others in towards.items()}
    shifted = np.tile(q, (len(KNEE_AXES), 2, 1, 1))
    for k, name in enumerate(KNEE_AXES):
        shifted[k, :, :, chain.coordinates[name]] += STEP * np.array([[1.0], [-1.0]])
    lengths = LineSet(chain, names).at(shifted).lengths_m
    for k, name in enumerate(KNEE_AXES):
        work = moved_points(chain, q, name, first, attached)
        by_length = (lengths[k, 1] - lengths[k, 0]) / (2.0 * STEP)
        np.testing.assert_allclose(work, by_length, atol=1e-6, rtol=1e-5)


@needs_jw
def test_a_wrench_is_that_of_the_attachments(walking):
    _, result = walking
    for bone in ("tibia", "patella"):
        total = 0.0
        for other in (None, *(b for b in result.bones.names if b != bone)):
            a = result.bones.attachments(bone, other)
            wrench = np.concatenate([np.cross(a.points, a.directions), a.directions], axis=2)
            total = total + np.nan_to_num(wrench)
        np.testing.assert_allclose(total, result.bones.pull_on((bone,), bone), atol=1e-12)


@needs_jw
def test_knee_and_patella_reactions_about_flexion_equal_the_reserve(walking):
    """The generalised force of knee and patella reactions about flexion equals the reserve.

    The patella's coordinate is coupled to knee flexion, so both move in the virtual work.
    """
    trial, result = walking
    chain, q = trial.kinematics, trial.motion.q
    flexion, patella = (chain.coordinates[n] for n in ("knee_flexion", "patfem_flexion"))
    ends = []
    for sign in (1.0, -1.0):
        shifted = q.copy()
        shifted[:, [flexion, patella]] += sign * STEP
        ends.append(chain.poses(shifted))
    rate = (ends[0] - ends[1]) / (2.0 * STEP)
    total = 0.0
    reaction = result.bones.demand_of(("patella",), "patella")
    reaction = reaction - result.muscle_wrench(("patella",), "patella")
    for bone, wrench in (("tibia", result.knee_reaction()), ("patella", reaction)):
        b = chain.bodies[bone]
        turn = chain.poses(q)[:, b, :3, :3]
        spin = np.einsum("fji,fjk->fik", turn, rate[:, b, :3, :3])
        omega = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        speed = np.einsum("fji,fj->fi", turn, rate[:, b, :3, 3])
        total = total + (wrench[:, :3] * omega).sum(1) + (wrench[:, 3:] * speed).sum(1)
    np.testing.assert_allclose(total, result.reserve[:, 3], atol=1e-5)


@needs_jw
def test_forces_on_shank_and_foot_are_mass_times_acceleration(walking):
    """Forces of knee, muscles, ground and gravity on shank and foot are mass x acceleration."""
    trial, result = walking
    chain, bones = trial.kinematics, ("tibia", "foot")
    pose = result.bones.poses[:, result.bones.index("tibia")]
    rotated = result.knee_reaction()[:, 3:] + result.muscle_wrench(bones, "tibia")[:, 3:]
    force = np.einsum("fij,fj->fi", pose[:, :3, :3], rotated) + trial.loads["calcaneus"][:, 3:]
    leg = find_leg(chain.model, "right")
    inertia = 0.0
    for body in (*leg.tibia, *leg.foot):
        inertial, b = chain.model.bodies[body], chain.bodies[body]
        place = chain.poses(trial.motion.q)[:, b] @ np.append(inertial.centre, 1.0)
        second = np.gradient(np.gradient(place[:, :3], 1 / 120, axis=0), 1 / 120, axis=0)
        inertia = inertia + inertial.mass_kg * (second - chain.model.gravity)
    inner = slice(4, -4)
    np.testing.assert_allclose(force[inner], inertia[inner], atol=1.0)  # N, for finite differences


def test_a_muscle_from_femur_to_foot_exerts_no_force_on_the_tibia():
    calf = muscle("calf", ("femur_r", [-0.02, -0.38, 0.0]), ("foot_r", [-0.05, -0.03, 0.0]))
    model = plane_leg(calf)
    q = np.array([[0.0, -0.3, 0.2]])
    result = solve_trial(model, still(None, q), {}, sharing=Sharing(reserve=np.inf)).bones
    assert np.abs(result.pull_on(("tibia",), "tibia")).max() == 0.0
    shifted = result.attachments("foot", "femur")
    np.testing.assert_allclose(shifted.points[0, 0], [-0.05, -0.03, 0.0], atol=1e-15)
    assert np.isnan(result.attachments("tibia", "femur").points).all()
    opposite = result.attachments("femur", "foot")
    femur, foot = (result.poses[0, result.index(bone)] for bone in ("femur", "foot"))
    rotated = rotate(inverse(foot) @ femur, opposite.directions[0])
    np.testing.assert_allclose(rotated, -shifted.directions[0], atol=1e-14)


def test_quadriceps_that_end_on_the_patella_are_named():
    """In DM a ligament joins patella and tibia. In Rajagopal the muscles continue to the tibia."""
    chain = kinematics("DM")
    q = chain.coupled({})[None]
    with pytest.raises(InputError, match=r"recfem_r.* end on 'patella_r'"):
        solve_trial(chain.model, still(chain, q), {})
    hip = Sharing(coordinates=("hip_flex_r",), muscles=("psoas_r", "recfem_r"))
    result = solve_trial(chain.model, still(chain, q), {}, sharing=hip)
    assert result.status == ("ok",)
    with pytest.raises(InputError, match="recfem_r end on the patella; the force of the patellar"):
        result.knee_reaction()
    chain = kinematics("Rajagopal2016")
    q = chain.coupled({"knee_angle_r": 0.6})[None]
    result = solve_trial(chain.model, still(chain, q), {})
    assert result.status == ("ok",) and np.isfinite(result.knee_reaction()).all()


def test_an_unknown_bone_is_named():
    model = plane_leg(muscle("m", ("pelvis", [0.0, 0.0, 0.0]), ("tibia_r", [0.1, 0.0, 0.0])))
    result = solve_trial(model, still(None, np.zeros((1, 3))), {})
    with pytest.raises(InputError, match="no bone 'tibea'; did you mean tibia"):
        result.bones.index("tibea")
