"""What a `tkamb.Knee` takes and returns: frames of the user's knee, and traps that are refused."""

import inspect
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from knee_bodies import MIRROR, mirrored_se3, whole_body
from test_knee import FOUNDATION, SCENE, at
from test_knee_plain_model import state_of, without_patella
from tkamb.contact import samples
from tkamb.contact.result import ContactStatus
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import mirrored_pose
from tkamb.knee.canonical import mirrored_spatial

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def read():
    return tkamb.read_scene(tkamb.load_scene(SCENE, FOUNDATION))


@pytest.fixture(scope="module")
def sides(read):
    """Return (knee, q, v, a, fext) of a right knee and of its mirror image."""
    q, v, a, fext = state_of(read, 60)
    parts = [mirrored_se3(pin.XYZQUATToSE3(part)) for part in (q[:7], q[7:])]
    mirrored = np.concatenate([pin.SE3ToXYZQUAT(pose) for pose in parts])
    forces = [pin.Force(mirrored_spatial(force.vector)) for force in fext]
    return (
        (without_patella(read[0]), q, v, a, fext),
        (without_patella(read[0], left=True), mirrored, v, a, pin.StdVec_Force(forces)),
    )


def lowered(knee, q, load=1200.0):
    """Return q at the height of the femur at which the contact carries a load."""
    q = q.copy()
    q[8] = knee.press(q, load).pose.translation[1]
    return q


def test_two_threads_with_data_of_their_own_agree_with_one(read):
    """To the last bit: they share the knee, its contact and its compiled loops."""
    knee, motion, _ = read

    def work(frame):
        data, rows = knee.create_data(), []
        for k in range(frame, frame + 12):
            q = motion.q[k].copy()
            result = knee.press(q, 1000.0, data)
            q[knee.model.joints[knee.model.getJointId("knee_si")].idx_q] += (
                result.pose.translation[1] - knee.coordinates(q)[1]
            )
            forces = knee.external_forces(q, motion.v[k], data=data)
            slopes = knee.external_forces_derivatives(q, motion.v[k], data=data)
            rows += [result.pressure, *(force.vector for force in forces), *slopes]
        return rows

    frames = (40, 45, 40, 60)
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(work, frames))
    for frame, found in zip(frames, together, strict=True):
        for one, other in zip(found, work(frame), strict=True):
            assert np.array_equal(one, other)


def test_a_left_knee_answers_in_its_own_frames(sides):
    """Positions, forces and poses are mirrored; medial and lateral are the patient's."""
    (right, q, *_), (left, mirrored, *_) = sides
    q, mirrored = lowered(right, q), lowered(left, mirrored)
    for call in ("press", "evaluate"):
        load = (1200.0,) if call == "press" else ()
        one, other = getattr(right, call)(q, *load), getattr(left, call)(mirrored, *load)
        assert isinstance(other.pose, pin.SE3)
        assert other.pose.homogeneous == pytest.approx(
            mirrored_pose(one.pose.homogeneous), abs=1e-6
        )
        assert other.approach == pytest.approx(one.approach, abs=1e-6)
        assert other.wrench_on_insert == pytest.approx(
            mirrored_spatial(one.wrench_on_insert), rel=1e-3, abs=0.1
        )
        for side in ("medial", "lateral"):
            ours, theirs = getattr(one, side), getattr(other, side)
            assert theirs.force == pytest.approx(ours.force, rel=1e-3)
            assert theirs.centre_of_pressure == pytest.approx(
                MIRROR @ ours.centre_of_pressure, abs=1e-4
            )
        # The medial condyle of a right knee is at -z, that of a left knee at +z.
        assert one.medial.centre_of_pressure[2] < 0.0 < other.medial.centre_of_pressure[2]
        loaded = other.pressure > 0
        centre = other.pressure[loaded] @ other.points[loaded] / other.pressure[loaded].sum()
        weighted = one.pressure @ one.points / one.pressure.sum()
        assert centre == pytest.approx(MIRROR @ weighted, abs=5e-4)
    flip = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])  # ml along z; rotations are clinical
    assert left.coordinates(mirrored) == pytest.approx(flip * right.coordinates(q), abs=1e-9)
    assert left.coordinates(mirrored)[:3] == pytest.approx(left.pose(mirrored).translation)


def test_an_equilibrium_of_a_left_knee_is_in_its_own_frames(sides):
    (right, *state), (left, *mirrored) = sides
    one = right.equilibrium(*state, derivatives=True)
    other = left.equilibrium(*mirrored, derivatives=True)
    assert one.failed is other.failed is False
    assert other.coordinates == pytest.approx(left.coordinates(other.q), abs=1e-9)
    flip = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])
    assert other.coordinates == pytest.approx(flip * one.coordinates, abs=2e-5)
    assert other.contact.pose.homogeneous[:3, 3] == pytest.approx(other.coordinates[:3], abs=1e-9)
    rows = np.append(flip, [1.0, 1.0])[:, None]
    expected = rows * mirrored_spatial(one.derivatives.by_load)
    scale = 0.02 * np.abs(expected).max(axis=1, keepdims=True) + 1e-12
    assert (np.abs(other.derivatives.by_load - expected) <= scale).all()
    # Loads from the pressed contact, which is given back in the user's frames.
    loads = left.inverse_dynamics(*mirrored, contact=other.contact)
    assert loads.failed is False and loads.reason == ""
    with pytest.raises(InputError, match="that of a left knee, this is a right knee"):
        right.inverse_dynamics(*state, contact=left.evaluate(mirrored[0]))


def test_data_of_something_else_are_refused_by_name(read):
    knee, motion, _ = read
    q, v = motion.q[60], motion.v[60]
    other = knee.with_contact(replace(knee.contact.model, resolution=3e-3))
    for call in (
        lambda data: knee.external_forces(q, v, data=data),
        lambda data: knee.stiffness(q, v, data=data),
        lambda data: knee.inverse_dynamics(*at(read, 60), data=data),
        lambda data: knee.press(q, 800.0, data=data),
        lambda data: knee.evaluate(q, data=data),
        lambda data: knee.forward_dynamics(q, v, v, data=data),
    ):
        with pytest.raises(InputError, match=r"another knee, '.*foundation"):
            call(other.create_data())
        with pytest.raises(InputError, match=r"a Data is no data of a tkamb.Knee"):
            call(knee.model.createData())
    slack = knee.with_ligaments(())
    slack.external_forces(q, v, data=knee.create_data())  # the same contact: the data fit


def test_one_warm_start_serves_all_calls(read):
    knee, motion, _ = read
    data, q = knee.create_data(), motion.q[60]
    cold, first = knee.press(q, 1000.0), knee.press(q, 1000.0, data)
    warm = knee.press(q, 1000.0, data)
    assert data.start is not None
    assert first.medial.force == cold.medial.force
    assert warm.medial.force == pytest.approx(cold.medial.force, rel=1e-4)
    before = data.start
    knee.evaluate(q, data)
    assert data.start is not before


def test_failure_is_a_bool_a_status_and_a_sentence(read):
    knee, motion, _ = read
    result = knee.press(motion.q[60], 1e6)
    assert result.failed is True and result.status is ContactStatus.OUT_OF_RANGE
    assert "1e+06 N cannot be reached" in result.reason
    assert " mm after the first touch a column of " in result.reason
    assert knee.press(motion.q[60], 500.0).failed is False
    found = knee.equilibrium(*at(read, 60))
    assert found.failed is False and found.status.name == "OK" and found.reason == ""
    assert found.loads.failed is False and found.loads.reason == ""


def test_names_of_frames(read):
    """A joint is no part unless it is named, and a part can be switched off."""
    plain = without_patella(read[0])
    model = plain.model.copy()
    model.addFrame(pin.Frame("patella", 1, 0, pin.SE3.Identity(), pin.FrameType.JOINT))
    assert tkamb.Knee(model).anatomy.patella is None
    hip = tkamb.Knee(model, frames={"hip": None}).anatomy.hip
    assert hip.placement == pin.SE3.Identity() or hip.joint in (1, 2)
    # Of two frames with one name the frame of the body counts, in any order.
    both, place = pin.Model(), pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.1]))
    parts = [
        both.addJoint(k, pin.JointModelFreeFlyer(), pin.SE3.Identity(), f"j{k}") for k in (0, 1)
    ]
    for name, joint in zip(("tibia", "femur"), parts, strict=True):
        both.addFrame(pin.Frame(name, joint, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
        both.addFrame(pin.Frame(name, joint, 0, place, pin.FrameType.BODY))
    assert tkamb.Knee(both).anatomy.femur.placement == place
    bare = pin.Model()
    thigh = bare.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "femur")
    bare.addJointFrame(thigh)
    with pytest.raises(InputError, match=r"'femur' is a joint; .*'femur': 'femur'"):
        tkamb.Knee(bare, frames={"tibia": "femur"})


def test_exchanged_frames_are_refused(read):
    plain = without_patella(read[0])
    swapped = {"femur": "insert", "tibia": "femur", "insert": None, "hip": None}
    words = (
        r"exchanged: the femur's centre of mass lies 0\.\d\d m below .* 0\.\d\d m above the insert"
    )
    with pytest.raises(InputError, match=words):
        tkamb.Knee(plain.model, frames=swapped)
    # Without masses, the components are on the wrong side of each other.
    light = plain.model.copy()
    for joint in range(1, light.njoints):
        light.inertias[joint] = pin.Inertia.Zero()
    knee = tkamb.Knee(light, implant=plain.implant, contact="foundation", frames=swapped)
    q = state_of(read, 60)[0]
    with pytest.raises(ComputationError, match=r"0\.\d+ m below the insert's bottom"):
        knee.external_forces(q, np.zeros(light.nv))


def test_a_femur_far_from_the_insert_or_below_it_is_refused(sides):
    (knee, q, v, a, fext), _ = sides
    for height, words in ((0.4, r"0\.\d+ m or more away"), (-0.06, r"0\.\d+ m below the insert")):
        far = q.copy()
        far[8] += height
        calls = (
            lambda far=far: knee.external_forces(far, v),
            lambda far=far: knee.stiffness(far, v),
            lambda far=far: knee.condyle_forces(far),
            lambda far=far: knee.forward_dynamics_derivatives(far, v, v),
            lambda far=far: knee.evaluate(far),
            lambda far=far: knee.inverse_dynamics(far, v, a, fext),
        )
        for call in calls:
            with pytest.raises(ComputationError, match=words):
                call()


def test_points_in_millimetres_are_refused(read):
    plain = without_patella(read[0])
    law = tkamb.QuadraticToe(stiffness=3000.0)
    ends = ("femur", (0.0, 0.0, -42.0)), ("tibia", (0.0, 360.0, -30.0))
    with pytest.raises(InputError, match=r"42 m from the frame 'femur'; is it in millimetres"):
        tkamb.Knee(plain.model, ligaments=[tkamb.Ligament("MCL", *ends, law, 85.0)])
    with pytest.raises(InputError, match=r"361.2 m from the frame 'tibia'"):
        tkamb.Knee(plain.model, muscles=[tkamb.Muscle("gastrocnemius", ends[::-1])])


def test_lengths_in_millimetres_and_names_given_twice_are_refused(read):
    plain = without_patella(read[0])
    bundle, line = plain.ligaments[0], plain.extensor.patellar_ligament
    with pytest.raises(InputError, match=r"slack_length 85 m; is it in millimetres"):
        plain.with_ligaments([replace(bundle, slack_length=85.0)])
    long = replace(plain.extensor, patellar_ligament=replace(line, length=50.0))
    with pytest.raises(InputError, match=r"patellar ligament: length 50 m; is it in millimetres"):
        tkamb.Knee(plain.model, implant=plain.implant, extensor=long)
    with pytest.raises(InputError, match=f"two are named '{bundle.name}'"):
        plain.with_ligaments([bundle, bundle])
    named = tkamb.Muscle("quadriceps", (("femur", np.zeros(3)), ("tibia", np.zeros(3))))
    with pytest.raises(InputError, match="two are named 'quadriceps'"):
        tkamb.Knee(plain.model, implant=plain.implant, extensor=plain.extensor, muscles=[named])


def test_angles_in_degrees_and_numbers_that_are_not_finite_are_refused(read):
    """Without the checks, a NaN in v gave forces without friction."""
    knee, motion, _ = read
    q, v = motion.q[60], motion.v[60]
    degrees, model = q.copy(), knee.model
    k = model.joints[model.getJointId("knee_flexion")].idx_q
    degrees[k] = np.rad2deg(q[k])
    words = rf"joint 'knee_flexion' is at {degrees[k]:.4g} rad; is it in degrees\?"
    nothing = np.full(model.nv, np.nan)
    for call, refused in (
        (lambda: knee.external_forces(degrees, v), words),
        (lambda: knee.press(degrees, 500.0), words),
        (lambda: knee.coordinates(degrees), words),
        (
            lambda: knee.press(np.where(np.arange(model.nq) == 3, np.nan, q), 500.0),
            r"q\[3\] is nan",
        ),
        (lambda: knee.external_forces(q, nothing), r"v\[0\] is nan"),
        (lambda: knee.inverse_dynamics(q, v, nothing), r"a\[0\] is nan"),
        (lambda: knee.forward_dynamics(q, v, nothing), r"tau\[0\] is nan"),
        (lambda: knee.press(q, [500.0, 600.0]), r"shape \(2,\)"),
        (lambda: knee.inverse_dynamics(q, v, v, np.zeros((model.njoints, 6))), "holds ndarray"),
    ):
        with pytest.raises(InputError, match=refused):
            call()


def test_only_a_patella_may_be_unknown(read):
    """The contact of the condyles does not change. Its indices in q are not those in v."""
    body = whole_body(read[0])
    q, joint = body.state(*at(read, 60))[0], body.model.joints[body.model.getJointId("cap_free")]
    first, last = joint.idx_q, joint.idx_q + joint.nq - 1
    known = body.knee.evaluate(q)
    for k in (first, last):
        found = body.knee.evaluate(np.where(np.arange(len(q)) == k, np.nan, q))
        assert (found.wrench_on_insert == known.wrench_on_insert).all()
    for k in (first - 1, last + 1):
        with pytest.raises(InputError, match=rf"q\[{k}\] is nan"):
            body.knee.evaluate(np.where(np.arange(len(q)) == k, np.nan, q))


def test_the_ligament_wraps_the_insert_in_the_plane_of_its_end(read):
    """A move of the end along this plane does not change the outline, a move across it does."""
    plain, outlines = read[0], []
    line = plain.extensor.patellar_ligament
    for move in ([0.0, 0.0, 0.0], [0.0, -5e-3, 0.0], [0.0, 0.0, 5e-3]):
        end = replace(line.distal, position=line.distal.position + move)
        extensor = replace(plain.extensor, patellar_ligament=replace(line, distal=end))
        knee = tkamb.Knee(plain.model, implant=plain.implant, extensor=extensor)
        outlines.append(knee.extensor_lines.ligament.wrap.outline)
    here, along, across = outlines
    assert along == pytest.approx(here, abs=1e-12)
    assert np.abs(across.max(axis=0) - here.max(axis=0)).max() > 1e-4


@pytest.mark.parametrize("link", ["femur", "hip"])
def test_an_origin_inside_the_femoral_component_is_refused(read, link):
    plain = read[0]
    inside = plain.femoral.bounds.mean(axis=0) - getattr(plain.anatomy, link).placement.translation
    muscle = plain.extensor.quadriceps
    muscle = replace(muscle, points=((link, tuple(inside)), muscle.points[-1]))
    extensor = replace(plain.extensor, quadriceps=muscle)
    with pytest.raises(InputError, match="the origin of quadriceps: lies inside the outline"):
        tkamb.Knee(plain.model, implant=plain.implant, extensor=extensor)


def test_an_argument_of_a_wrong_kind_is_refused_by_name(read):
    knee, motion, _ = read
    q, v, model = motion.q[60], motion.v[60], knee.model

    def ligament(**changes):
        ends = {"proximal": ("femur", (0.0, 0.0, -0.04)), "distal": ("tibia", (0.0, 0.36, -0.03))}
        law = {"law": tkamb.TwoLine(stiffness=3e4), "slack_length": 0.085}
        return tkamb.Ligament("MCL", **{**ends, **law, **changes})

    for where, call in (
        ("press: load: cannot be '100'", lambda: knee.press(q, "100")),
        ("press: load: cannot be None", lambda: knee.press(q, None)),
        ("q: cannot be an array of complex128", lambda: knee.external_forces(q + 0j, v)),
        ("q: cannot be 'abc'", lambda: knee.evaluate("abc")),
        ("quadriceps: tension: cannot be 'x'", lambda: knee.external_forces(q, v, "x")),
        ("with_contact: 3 is no contact model", lambda: knee.with_contact(3)),
        ("no contact model 'foundatoin'", lambda: knee.with_contact("foundatoin")),
        ("ligaments: cannot be 3", lambda: knee.with_ligaments([3])),
        (
            "slack_length: cannot be '0.08'",
            lambda: knee.with_ligaments([ligament(slack_length="0.08")]),
        ),
        ("wraps: cannot be 3", lambda: knee.with_ligaments([ligament(wraps=3)])),
        ("model: cannot be 'leg.urdf'", lambda: tkamb.Knee("leg.urdf")),
        ("implant: cannot be 'x'", lambda: tkamb.Knee(model, implant="x")),
        ("extensor: cannot be 3", lambda: tkamb.Knee(model, extensor=3)),
        ("friction: cannot be '0'", lambda: tkamb.Knee(model, friction="0")),
        ("frames: cannot be 3", lambda: tkamb.Knee(model, frames={"femur": 3})),
        ("muscles: cannot be 3", lambda: tkamb.Knee(model, muscles=[3])),
        ("resolution: cannot be '2'", lambda: tkamb.contact_model("hertz", resolution="2")),
        ("frames: cannot be '0:3'", lambda: tkamb.simulate(SCENE, frames="0:3")),
        ("contact: cannot be 3", lambda: tkamb.simulate(SCENE, contact=3)),
        ("read_results: cannot be 3", lambda: tkamb.read_results(3)),
        ("plot: cannot be 'out'", lambda: tkamb.plot("out")),
        ("live: cannot be 3", lambda: tkamb.live(3)),
    ):
        with pytest.raises(InputError, match=re.escape(where)):
            call()
    foundation = knee.with_contact("foundation")
    assert foundation.contact.model == tkamb.contact_model("foundation")
    implant = replace(knee.implant, bearing="moblie")
    with pytest.raises(InputError, match="bearing 'moblie'; give 'fixed' or 'mobile'"):
        tkamb.Knee(model, implant=implant, contact="foundation")


def test_a_quaternion_that_is_not_normalised_is_refused(sides):
    (knee, q, v, a, fext), _ = sides
    long = q.copy()
    long[10:14] *= 3.0
    for call in (
        lambda: knee.external_forces(long, v),
        lambda: knee.press(long, 500.0),
        lambda: knee.inverse_dynamics(long, v, a, fext),
        lambda: knee.coordinates(long),
        lambda: knee.relative_jacobian(long),
    ):
        with pytest.raises(InputError, match=r"not normalised: .* off by \d.*pin.normalize"):
            call()


def test_contact_in_python_is_in_si_and_simulate_takes_its_table():
    with pytest.raises(InputError, match=r"resolution 2.0 m; give more than 0, at most 10 mm"):
        tkamb.contact_model("foundation", resolution=2.0)
    with pytest.raises(TypeError):
        tkamb.contact_model("foundation", 2.0)
    table = {"model": "hertz", "resolution_mm": 2.0}
    results = tkamb.simulate(SCENE, contact=table, frames=slice(60, 61))
    assert results.summary["contact"]["model"] == "hertz"
    assert results.summary["contact"]["resolution_mm"] == 2.0


def test_the_second_knee_shares_the_prepared_contact(read, monkeypatch):
    """Nothing is prepared again, unless meshes, material, options or settings differ."""
    plain = without_patella(read[0])

    def state(implant=plain.implant, resolution=2e-3):
        model = tkamb.contact_model("foundation", resolution=resolution)
        knee = tkamb.Knee(plain.model, implant=implant, contact=model)
        knees.append(knee)  # a contact is shared as long as a knee uses it
        return knee.contact.state

    knees = []
    first = state()
    assert state() is first
    assert state(resolution=3e-3) is not first
    assert state(replace(plain.implant, material="polyethylene-linear")) is not first
    moved = replace(plain.implant.insert, vertices=plain.implant.insert.vertices + 1e-6)
    assert state(replace(plain.implant, insert=moved)) is not first
    monkeypatch.setattr(samples, "MAP_POINT", replace(samples.MAP_POINT, rim_rays=4))
    assert state() is not first


def test_a_repr_is_short(read):
    knee, motion, _ = read
    equilibrium = knee.equilibrium(*at(read, 60))
    assert "right knee" in repr(knee) and "foundation at 2 mm" in repr(knee)
    assert "medial" in repr(equilibrium) and "flexion" in repr(equilibrium)
    loads, pressed = equilibrium.loads, knee.press(motion.q[60], 500.0)
    batch = knee.press(motion.q[60:62], 500.0)
    for one in (knee, equilibrium, loads, pressed, batch, knee.create_data(), knee.ligaments[0]):
        assert len(repr(one).splitlines()) <= 6 and len(repr(one)) <= 600, repr(one)


def test_the_page_on_stable_names_lists_what_is_public():
    page = (ROOT / "docs" / "stable.md").read_text(encoding="utf-8")
    for owner, names in (
        ("`tkamb`", [name for name in tkamb.__all__ if not name.startswith("_")]),
        ("`tkamb.Knee`", [name for name in dir(tkamb.Knee) if not name.startswith("_")]),
    ):
        (row,) = [line for line in page.splitlines() if line.startswith(f"| names of {owner}: ")]
        assert re.findall(r"`(\w+)`", row.split(":", 1)[1]) == sorted(names)


def test_internals_are_private_and_arguments_have_one_name(read):
    public = {name for name in dir(read[0]) if not name.startswith("_")}
    assert not public & {"instant", "at", "link_poses", "query", "create_data_for_kinematics",
                         "press_from", "live"}  # fmt: skip
    arguments = {
        argument
        for name in public
        if callable(getattr(tkamb.Knee, name, None))
        for argument in inspect.signature(getattr(tkamb.Knee, name)).parameters
    }
    assert {"data", "fext"} <= arguments and not arguments & {"guess", "start", "external"}


def test_a_pose_is_given_as_se3_or_as_a_matrix(read):
    plain = without_patella(read[0])
    extensor, plane = plain.extensor, pin.SE3(np.eye(3), np.array([0.0, 0.01, 0.0]))
    for given in (plane, plane.homogeneous):
        knee = tkamb.Knee(
            plain.model, implant=plain.implant, extensor=replace(extensor, plane=given)
        )
        assert knee.anatomy.plane.placement.isApprox(plain.anatomy.femur.placement * plane)
