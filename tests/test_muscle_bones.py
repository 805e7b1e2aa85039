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
            there = q.copy()
            there[:, chain.coordinates[coordinate]] += sign * STEP
            ends.append(chain.poses(there)[:, chain.bodies[bones[bone]]])
        rate = (ends[0] - ends[1]) / (2.0 * STEP)
        here = chain.poses(q)[:, chain.bodies[bones[bone]], :3, :3]
        for a in several:
            velocity = np.einsum("fij,fmj->fmi", rate[:, :3, :3], a.points) + rate[:, None, :3, 3]
            pull = np.einsum("fij,fmj->fmi", here, a.directions)
            total = total + np.nansum(pull * velocity, axis=2)
    return total


@needs_jw
def test_attachments_do_the_work_of_the_length(walking):
    """The virtual work of unit tension is -dL/dq along each of the knee's six axes."""
    trial, found = walking
    chain, q = trial.kinematics, trial.motion.q[::33]
    pull = found.bones.pull_on(("tibia", "foot"), "tibia")[..., 3:]
    names = [found.muscles[k] for k in np.flatnonzero(np.abs(pull).max(axis=(0, 2)) > 1e-6)]
    assert len(names) == 13
    some = solve_trial(chain.model, still(chain, q), {}, sharing=Sharing(tuple(names))).bones
    first = {bone: own[0] for bone, own in leg_bones(find_leg(chain.model, "right")).items()}
    towards = {"tibia": (None, "femur", "patella", "foot"), "foot": (None, "femur", "tibia")}
    attached = {b: [some.attachments(b, o) for o in others] for b, others in towards.items()}
    there = np.tile(q, (len(KNEE_AXES), 2, 1, 1))
    for k, name in enumerate(KNEE_AXES):
        there[k, :, :, chain.coordinates[name]] += STEP * np.array([[1.0], [-1.0]])
    lengths = LineSet(chain, names).at(there).lengths_m
    for k, name in enumerate(KNEE_AXES):
        work = moved_points(chain, q, name, first, attached)
        by_length = (lengths[k, 1] - lengths[k, 0]) / (2.0 * STEP)
        np.testing.assert_allclose(work, by_length, atol=1e-6, rtol=1e-5)


@needs_jw
def test_a_wrench_is_that_of_the_attachments(walking):
    _, found = walking
    for bone in ("tibia", "patella"):
        total = 0.0
        for other in (None, *(b for b in found.bones.names if b != bone)):
            a = found.bones.attachments(bone, other)
            wrench = np.concatenate([np.cross(a.points, a.directions), a.directions], axis=2)
            total = total + np.nan_to_num(wrench)
        np.testing.assert_allclose(total, found.bones.pull_on((bone,), bone), atol=1e-12)


@needs_jw
def test_the_knee_carries_about_its_hinge_what_reserve_and_patella_leave(walking):
    """The generalised force of knee and patella reactions about flexion equals the reserve.

    The patella's coordinate is coupled to knee flexion, so both move in the virtual work.
    """
    trial, found = walking
    chain, q = trial.kinematics, trial.motion.q
    flexion, patella = (chain.coordinates[n] for n in ("knee_flexion", "patfem_flexion"))
    ends = []
    for sign in (1.0, -1.0):
        there = q.copy()
        there[:, [flexion, patella]] += sign * STEP
        ends.append(chain.poses(there))
    rate = (ends[0] - ends[1]) / (2.0 * STEP)
    total = 0.0
    own = found.bones.demand_of(("patella",), "patella")
    own = own - found.muscle_wrench(("patella",), "patella")
    for bone, wrench in (("tibia", found.knee_reaction()), ("patella", own)):
        b = chain.bodies[bone]
        turn = chain.poses(q)[:, b, :3, :3]
        spin = np.einsum("fji,fjk->fik", turn, rate[:, b, :3, :3])
        omega = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        speed = np.einsum("fji,fj->fi", turn, rate[:, b, :3, 3])
        total = total + (wrench[:, :3] * omega).sum(1) + (wrench[:, 3:] * speed).sum(1)
    np.testing.assert_allclose(total, found.reserve[:, 3], atol=1e-5)


@needs_jw
def test_the_leg_balances_as_a_whole(walking):
    """Forces of knee, muscles, ground and gravity on shank and foot are mass x acceleration."""
    trial, found = walking
    chain, both = trial.kinematics, ("tibia", "foot")
    pose = found.bones.poses[:, found.bones.index("tibia")]
    turned = found.knee_reaction()[:, 3:] + found.muscle_wrench(both, "tibia")[:, 3:]
    force = np.einsum("fij,fj->fi", pose[:, :3, :3], turned) + trial.loads["calcaneus"][:, 3:]
    leg = find_leg(chain.model, "right")
    inertia = 0.0
    for body in (*leg.tibia, *leg.foot):
        own, b = chain.model.bodies[body], chain.bodies[body]
        place = chain.poses(trial.motion.q)[:, b] @ np.append(own.centre, 1.0)
        second = np.gradient(np.gradient(place[:, :3], 1 / 120, axis=0), 1 / 120, axis=0)
        inertia = inertia + own.mass_kg * (second - chain.model.gravity)
    inner = slice(4, -4)
    np.testing.assert_allclose(force[inner], inertia[inner], atol=1.0)  # N, for finite differences


def test_a_muscle_past_the_tibia_loads_it_through_the_foot_alone():
    calf = muscle("calf", ("femur_r", [-0.02, -0.38, 0.0]), ("foot_r", [-0.05, -0.03, 0.0]))
    model = plane_leg(calf)
    q = np.array([[0.0, -0.3, 0.2]])
    found = solve_trial(model, still(None, q), {}, sharing=Sharing(reserve=np.inf)).bones
    assert np.abs(found.pull_on(("tibia",), "tibia")).max() == 0.0
    there = found.attachments("foot", "femur")
    np.testing.assert_allclose(there.points[0, 0], [-0.05, -0.03, 0.0], atol=1e-15)
    assert np.isnan(found.attachments("tibia", "femur").points).all()
    back = found.attachments("femur", "foot")
    femur, foot = (found.poses[0, found.index(bone)] for bone in ("femur", "foot"))
    turned = rotate(inverse(foot) @ femur, back.directions[0])
    np.testing.assert_allclose(turned, -there.directions[0], atol=1e-14)


def test_quadriceps_that_end_on_the_patella_are_named():
    """In DM a ligament joins patella and tibia. In Rajagopal the muscles continue to the tibia."""
    chain = kinematics("DM")
    q = chain.coupled({})[None]
    with pytest.raises(InputError, match=r"recfem_r.* end on 'patella_r'"):
        solve_trial(chain.model, still(chain, q), {})
    hip = Sharing(coordinates=("hip_flex_r",), muscles=("psoas_r", "recfem_r"))
    found = solve_trial(chain.model, still(chain, q), {}, sharing=hip)
    assert found.status == ("ok",)
    with pytest.raises(InputError, match="recfem_r end on the patella; the force of the patellar"):
        found.knee_reaction()
    chain = kinematics("Rajagopal2016")
    q = chain.coupled({"knee_angle_r": 0.6})[None]
    found = solve_trial(chain.model, still(chain, q), {})
    assert found.status == ("ok",) and np.isfinite(found.knee_reaction()).all()


def test_an_unknown_bone_is_named():
    model = plane_leg(muscle("m", ("pelvis", [0.0, 0.0, 0.0]), ("tibia_r", [0.1, 0.0, 0.0])))
    found = solve_trial(model, still(None, np.zeros((1, 3))), {})
    with pytest.raises(InputError, match="no bone 'tibea'; did you mean tibia"):
        found.bones.index("tibea")
