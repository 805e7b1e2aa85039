"""The released patella in the forces of a knee: balance, reaction, virtual work, symmetry."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from equilibrium_cases import random_states
from knee_bodies import whole_body
from patella_bodies import HEADS, Z, body_knee, read_plane, symmetric
from test_patella_body import energy
from tkamb.errors import InputError
from tkamb.geometry.frames import PATELLA_BODY_COORDINATES, knee_pose
from tkamb.knee.load import wrenches
from tkamb.knee.patella_search import solve_patella

SIZE = sum(HEADS.values())
ALL = ("ap", "ml", "axial_rotation", "adduction")


@pytest.fixture(scope="module")
def plain():
    return read_plane()


@pytest.fixture(scope="module")
def knee(plain):
    """A knee with both contacts and the ligaments of the shipped one."""
    source = plain[0]
    made = body_knee(source, released=True, contact=source.contact, friction=0.05)
    return made.with_ligaments([*made.ligaments, *source.ligaments])


@pytest.fixture(scope="module")
def open_knee(plain):
    """A knee without femorotibial contact: the patella's forces alone."""
    return body_knee(plain[0], released=True)


def state(plain, frame):
    _, motion, ground = plain
    return motion.q[frame], motion.v[frame], motion.a[frame], ground[frame]


def resultant(knee, q, forces):
    """Return the sum (6,) of forces on the joints, about the world's origin."""
    data = knee.model.createData()
    pin.forwardKinematics(knee.model, data, q)
    return sum((data.oMi[k].act(force) for k, force in enumerate(forces)), pin.Force.Zero()).vector


@pytest.mark.parametrize("frame", [10, 40, 60, 90])
def test_the_patella_of_the_equations_is_in_equilibrium(plain, knee, frame):
    """With the heads' tensions of the solution the patella has the same ligaments and contact."""
    loads = knee.inverse_dynamics(*state(plain, frame))
    q = plain[1].q[frame]
    alone = knee.patella_equilibrium(q, loads.tensions)
    assert alone.residual <= 1e-6 * loads.quadriceps
    assert sum(loads.tensions.values()) == pytest.approx(loads.quadriceps, rel=1e-7)
    for name, tension in alone.tensions.items():
        assert loads.ligaments[name] == pytest.approx(tension, abs=1e-6 * loads.quadriceps)
    force = np.linalg.norm(alone.contact.contact.wrench_on_insert[:3])
    assert loads.patellofemoral == pytest.approx(force, rel=1e-6)
    # The pull on the tibia in the equations is that of the ligaments.
    (muscle,) = loads.geometry.muscles
    pulled = loads.quadriceps * wrenches(muscle.loads)[0]
    poses = loads.geometry.extensor.released.found.poses
    strands = [one for one in knee.patella.lines if one.distal.link == "tibia"]
    on_tibia = sum(pull_on_tibia(bundle, poses) for bundle in strands)
    assert pulled == pytest.approx(on_tibia, abs=2e-6 * loads.quadriceps)


def pull_on_tibia(bundle, poses):
    """Return the wrench (6,) of a straight ligament on the tibia, computed by hand."""
    ends = [
        (poses[end.link] @ np.append(end.position, 1.0))[:3]
        for end in (bundle.proximal, bundle.distal)
    ]
    length = np.linalg.norm(ends[0] - ends[1])
    pull = bundle.force(length) * (ends[0] - ends[1]) / length
    return np.concatenate([pull, np.cross(ends[1], pull)])


@pytest.mark.parametrize("frame", [10, 60])
def test_action_equals_reaction_over_all_bodies(plain, knee, open_knee, frame):
    q, v, a, fext = state(plain, frame)
    loads = knee.inverse_dynamics(q, v, a, fext)
    for forces in (loads.external_forces, loads.residual_forces):
        assert np.abs(resultant(knee, q, forces)).max() <= 1e-9 * loads.quadriceps
    forces = open_knee.external_forces(q, v, HEADS)
    assert np.abs(resultant(open_knee, q, forces)).max() <= 1e-9 * SIZE
    # With all loads of the equations the model is in equilibrium.
    acting = pin.StdVec_Force(
        [
            sum(each, pin.Force.Zero())
            for each in zip(
                fext, loads.external_forces, loads.residual_forces, loads.hip_forces, strict=True
            )
        ]
    )
    data = knee.model.createData()
    assert pin.rnea(knee.model, data, q, v, a, acting) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("frame", [30, 60, 90])
def test_virtual_work_of_the_whole_extensor(plain, frame):
    """The moment of `external_forces` on flexion is the slope of the energy, to 0.5 %."""
    released = body_knee(plain[0], "foundation-linear", released=True)
    model = released.model
    joint, step, energies = model.joints[model.getJointId("knee_flexion")], np.radians(0.25), []
    for sign in (-1.0, 1.0):
        q = plain[1].q[frame].copy()
        q[joint.idx_q] += sign * step
        energies.append(energy(released, q, released.patella_equilibrium(q, HEADS)))
    slope = (energies[1] - energies[0]) / (2.0 * step)
    q, rest = plain[1].q[frame], np.zeros(model.nv)
    forces, data = released.external_forces(q, rest, HEADS), model.createData()
    without = pin.rnea(model, data, q, rest, rest).copy()
    moment = (without - pin.rnea(model, data, q, rest, rest, forces))[joint.idx_v]
    assert moment == pytest.approx(-slope, rel=0.005)
    assert abs(moment) > 10.0


@pytest.mark.parametrize("frame", [40, 90])
def test_the_work_of_the_patella_over_a_closed_loop_vanishes(plain, open_knee, frame):
    """Tensions, contact and elastic ligaments have an energy, whose minimum is that of the knee."""
    model, data = open_knee.model, open_knee.create_data()
    kinematics, centre = model.createData(), plain[1].q[frame]
    size, phase = np.zeros(model.nv), np.zeros(model.nv)
    for k, name in enumerate(("ap", "si", "ml", "axial_rotation", "adduction", "flexion")):
        joint = model.joints[model.getJointId(f"knee_{name}")].idx_v
        size[joint] = (1.5e-3, 5e-4, 5e-4, 0.02, 0.005, 0.04)[k]
        phase[joint] = k
    power = []
    for turn in 2.0 * np.pi * np.arange(40) / 40:
        q = pin.integrate(model, centre, size * (np.sin(turn + phase) - np.sin(phase)))
        forces = open_knee.external_forces(q, 0.0 * size, HEADS, data)
        pin.forwardKinematics(model, kinematics, q, size * np.cos(turn + phase))
        pairs = zip(forces, kinematics.v, strict=True)
        power.append(sum(force.dot(velocity) for force, velocity in pairs))
    assert abs(np.mean(power)) < 1e-6 * np.mean(np.abs(power))


def test_a_number_is_the_tension_of_all_heads(plain, open_knee):
    q, v = plain[1].q[60], plain[1].v[60]
    by_head, total = (open_knee.external_forces(q, v, given) for given in (HEADS, SIZE))
    for one, other in zip(by_head, total, strict=True):
        assert one.vector == pytest.approx(other.vector, abs=1e-6)
    slack = open_knee.external_forces(q, v)
    assert max(np.abs(force.vector).max() for force in slack) == 0.0


@pytest.mark.parametrize("frame", [20, 60, 90])
def test_derivatives_of_the_forces(plain, open_knee, frame):
    q, v, model = plain[1].q[frame], plain[1].v[frame], open_knee.model
    by_q, by_v = open_knee.external_forces_derivatives(q, v, HEADS)
    step, columns = 1e-6, []
    for move in step * np.eye(model.nv):
        ahead, behind = (
            open_knee.external_forces(pin.integrate(model, q, sign * move), v, HEADS)
            for sign in (1.0, -1.0)
        )
        columns.append([(a - b).vector / (2.0 * step) for a, b in zip(ahead, behind, strict=True)])
    numeric = np.array(columns).transpose(1, 2, 0)
    assert np.abs(numeric).max() > 1e3
    assert by_q == pytest.approx(numeric, abs=1e-5 * np.abs(numeric).max())
    assert not by_v.any()


@pytest.mark.parametrize("released", [("adduction",), ALL])
@pytest.mark.parametrize("frame", [20, 60, 90])
def test_knee_and_patella_are_in_equilibrium_together(plain, knee, released, frame):
    """Residuals of both, at one pose and one tension, are below 1e-6 of the quadriceps."""
    found = knee.equilibrium(*state(plain, frame), released=released)
    quadriceps = common_tension(knee, found, 1e-6, 1e-5)
    # The residuals of the released coordinates vanish in the equations, too.
    residuals = found.loads.residuals
    if "ap" in released:
        assert max(map(abs, residuals.values())) <= 1e-5 * quadriceps


def test_a_patella_on_a_jump_of_its_contact_has_an_equilibrium(plain, knee):
    """The tension cannot agree to 1e-7 where the force of the button jumps from facet to facet."""
    *_, jumping = random_states(plain, knee, False, 20)
    found = jumping.equilibrium()
    common_tension(knee, found, 1e-4, 1e-4)


def common_tension(knee, found, residual, rel):
    """Assert residuals of knee and patella relative to the quadriceps' tension, and return it.

    The equations at that pose agree with the search about the tension.
    """
    assert not found.failed, found.reason
    quadriceps = found.loads.quadriceps
    assert found.residual <= residual * quadriceps
    alone = knee.patella_equilibrium(found.q, found.loads.tensions)
    assert alone.residual <= residual * quadriceps
    tension = found.search.geometry.extensor.released.tension
    assert quadriceps == pytest.approx(tension, rel=rel)
    return quadriceps


def test_the_pose_of_the_knee_and_the_patella_depend_on_each_other(plain, knee):
    """The plane patella gives another equilibrium: the chain is solved as a whole."""
    now = state(plain, 60)
    plane = plain[0].equilibrium(*now, released=ALL)
    whole = knee.equilibrium(*now, released=ALL)
    change = np.abs(plane.coordinates - whole.coordinates)
    assert change[:3].max() > 1e-5
    assert whole.loads.quadriceps == pytest.approx(plane.loads.quadriceps, rel=0.05)


def even_knee(plain):
    """Return a knee that is symmetric about its sagittal plane, and its heads' shares."""
    source = plain[0]
    parts = [symmetric(one) for one in (source.femoral, source.button)]
    shares = {"quadriceps": 0.4, "vastus_medialis": 0.3, "vastus_lateralis": 0.3}
    return body_knee(
        source,
        femoral=parts[0],
        button=parts[1],
        even=True,
        released_patella=PATELLA_BODY_COORDINATES,
        head_shares=shares,
    )


def even_state(plain, knee, frame):
    """Return a symmetric state: no motion, and the ground reaction in the sagittal plane."""
    _, motion, ground = plain
    coordinates = motion.coordinates[frame] * [1.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    q = knee.bridge.configuration(motion.q[frame], knee_pose(coordinates))
    rest = np.zeros(knee.model.nv)
    forces = pin.StdVec_Force(
        [pin.Force(f.linear * [1.0, 1.0, 0.0], f.angular * [0.0, 0.0, 1.0]) for f in ground[frame]]
    )
    return q, rest, rest, forces


@pytest.mark.parametrize("frame", [20, 50, 90])
def test_a_symmetric_knee_has_no_tilt_and_no_shift(plain, frame):
    even = even_knee(plain)
    loads = even.inverse_dynamics(*even_state(plain, even, frame))
    assert not loads.failed, loads.reason
    found = loads.geometry.extensor.released.found
    places = dict(zip(PATELLA_BODY_COORDINATES, found.balance.coordinates, strict=True))
    for name in ("shift", "tilt", "rotation"):
        assert abs(places[name]) < 1e-9, name
    medial, lateral = (found.press.facets[side].force for side in ("medial", "lateral"))
    assert medial == pytest.approx(lateral, rel=1e-9)
    force, moment = np.split(wrenches(loads.geometry.muscles[0].loads)[0], 2)
    assert abs(force[2]) < 1e-9 and np.abs(moment[:2]).max() < 1e-9


@pytest.mark.parametrize("frame", [10, 30, 50, 75, 90])
def test_a_symmetric_patella_is_nearly_the_plane_patella(plain, frame):
    """PL/Q and PF/Q with the ligament of the plane patella as long as the stretched strands.

    The contact of the button is soft, and the strands spread by 3 mm. Measured: 0.7 and 0.4 %.
    """
    even = even_knee(plain)
    now = even_state(plain, even, frame)
    loads = even.inverse_dynamics(*now)
    poses = loads.geometry.extensor.released.found.poses
    strand = next(one for one in even.patella.lines if one.name == "strand_medial")
    across = strand.proximal.position[2] - strand.distal.position[2]
    length = np.sqrt(float(strand.length(poses)) ** 2 - across**2)
    mechanism = replace(even.extensor_lines.mechanism, ligament_length=length)
    plane = solve_patella(mechanism, poses["femur"])
    assert loads.patellar_ligament / loads.quadriceps == pytest.approx(
        plane.ligament_ratio, rel=0.01
    )
    assert loads.patellofemoral / loads.quadriceps == pytest.approx(
        plane.patellofemoral_ratio, rel=0.005
    )


@pytest.mark.parametrize("frame", [20, 60])
def test_a_left_knee_is_the_mirror_image_of_a_right_one(plain, knee, frame):
    now, results = state(plain, frame), []
    for left in (False, True):
        body = whole_body(knee, left)
        q, v, a, fext = body.state(*now)
        results.append(
            (
                body.knee.inverse_dynamics(q, v, a, fext),
                body.knee.equilibrium(q, v, a, fext, released=ALL),
                body.knee.patella_equilibrium(q, HEADS),
            )
        )
    for right, left in zip(*results, strict=True):
        if hasattr(right, "loads"):
            assert left.coordinates * [1, 1, -1, 1, 1, 1] == pytest.approx(
                right.coordinates, abs=1e-7
            )
            right, left = right.loads, left.loads
        if hasattr(right, "quadriceps"):
            assert left.quadriceps == pytest.approx(right.quadriceps, rel=1e-6)
            assert left.contact_force * [1, 1, -1] == pytest.approx(right.contact_force, rel=1e-5)
        else:
            for name, value in right.coordinates.items():
                assert left.coordinates[name] == pytest.approx(value, abs=1e-8)


def test_a_slack_quadriceps_leaves_the_patella_free(plain, knee):
    """The ground pulls the foot forward and extends the knee: no force of the patella acts."""
    q, v, a, fext = state(plain, 60)
    joint = knee.anatomy.tibia.joint
    extending = pin.StdVec_Force(fext)
    extending[joint] = pin.Force(fext[joint].linear, fext[joint].angular + 400.0 * Z)
    loads = knee.inverse_dynamics(q, 0.0 * v, 0.0 * a, extending)
    assert not loads.failed and loads.slack, loads
    assert loads.quadriceps == loads.patellofemoral == loads.patellar_ligament == 0.0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"released_patella": ("ap", "tilt")}, "needs ap, si and flexion"),
        ({"released_patella": ("tild",)}, "no coordinate of the patella 'tild'"),
        ({"head_shares": {"quadriceps": 0.5, "sartorius": 0.5}}, "no head 'sartorius'"),
        ({"head_shares": {"quadriceps": 0.5}}, "do not sum to 1"),
        ({"head_shares": {"quadriceps": "all"}}, "head_shares: quadriceps"),
        ({"head_shares": 0.5}, "head_shares"),
        ({"head_shares": {}}, "do not sum to 1"),
        ({"head_shares": {"quadriceps": 1.5, "vastus_medialis": -0.5}}, "share 1.5"),
        ({"released_patella": True}, "released_patella: cannot be True"),
        ({"released_patella": (0, 1, 3)}, "released_patella: cannot be 0"),
        ({"released_patella": "ap"}, "released_patella: is the text 'ap'"),
        ({"released_patella": ()}, "needs released_patella="),
    ],
)
def test_arguments_that_do_not_fit_are_refused(plain, changes, words):
    given = {
        "released_patella": PATELLA_BODY_COORDINATES,
        "head_shares": {"quadriceps": 0.5, "vastus_medialis": 0.5},
    }
    with pytest.raises(InputError, match=words):
        body_knee(plain[0], **(given | changes))


@pytest.mark.parametrize("kind", [list, np.array, iter])
def test_names_of_released_coordinates_may_be_any_list(plain, kind):
    made = body_knee(plain[0], released_patella=kind(["ap", "si", "flexion", "tilt"]))
    assert made.patella.released == ("ap", "si", "flexion", "tilt")


def test_a_muscle_on_the_patella_pulls_it_without_a_share(plain, open_knee):
    """Its tension reaches femur and tibia through the patella, as that of a head with a share."""
    q, v = plain[1].q[60], plain[1].v[60]
    expected = open_knee.external_forces(q, v, HEADS)
    for shares in (None, {"quadriceps": 1.0}, {"quadriceps": 0.0, "vastus_medialis": 1.0}):
        other = body_knee(plain[0], released_patella=PATELLA_BODY_COORDINATES, head_shares=shares)
        forces = other.external_forces(q, v, HEADS)
        for one, given in zip(expected, forces, strict=True):
            assert given.vector == pytest.approx(one.vector, abs=1e-6)
        assert not forces[other.anatomy.patella.joint].vector.any()
        with pytest.raises(InputError, match="tension of the quadriceps is unknown"):
            other.inverse_dynamics(*state(plain, 60), tensions={"vastus_medialis": 100.0})


def test_a_muscle_that_the_released_patella_would_not_feel_is_refused(plain):
    source = plain[0]
    turned = tkamb.Muscle("turned", (("patella", (0.0, 0.0, 0.0)), ("tibia", (0.0, 0.3, 0.0))))
    with pytest.raises(InputError, match="muscle turned: touches the patella"):
        tkamb.Knee(
            source.model,
            implant=tkamb.Implant(source.femoral, source.insert, source.button, placed=True),
            extensor=source.extensor,
            ligaments=body_knee(source).ligaments,
            muscles=[turned],
            patellofemoral_contact="foundation",
            released_patella=PATELLA_BODY_COORDINATES,
        )


def test_what_a_released_patella_does_not_allow_is_refused(plain, knee):
    q, v, a, fext = state(plain, 60)
    names = "there are: quadriceps, vastus_medialis"
    with pytest.raises(InputError, match=f"no muscle 'patellar_ligament'; {names}"):
        knee.external_forces(q, v, {"quadriceps": 100.0, "patellar_ligament": 90.0})
    with pytest.raises(InputError, match="tension of the quadriceps is unknown"):
        knee.inverse_dynamics(q, v, a, fext, tensions={"vastus_medialis": 100.0})
    retinacula = [one for one in knee.ligaments if one.name.startswith("retinaculum")]
    with pytest.raises(InputError, match="no strand"):
        knee.with_ligaments(retinacula).external_forces(q, v, 100.0)


def test_a_lost_patella_is_a_problem_of_the_loads(plain, knee):
    """Strands of 290 mm are slack: nothing holds the patella."""
    long = [
        replace(one, slack_length=0.29) if one.name.startswith("strand") else one
        for one in knee.ligaments
    ]
    loads = knee.with_ligaments(long).inverse_dynamics(*state(plain, 60))
    assert loads.failed and "patella: " in loads.reason
    assert np.isnan(loads.quadriceps)
