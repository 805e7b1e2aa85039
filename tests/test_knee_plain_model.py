"""tkamb.Knee on a model without a patella, and in a MeshCat window."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from knee_bodies import MIRROR, mirrored_inertia, mirrored_se3
from test_knee import FOUNDATION, SCENE, at


@pytest.fixture(scope="module")
def read():
    return tkamb.read_scene(tkamb.load_scene(SCENE, FOUNDATION))


def without_patella(plain, left=False):
    """Return the knee on a model of two bodies; equilibrium gives the patella's pose at every q."""
    turn, weigh = (mirrored_se3, mirrored_inertia) if left else (lambda x: x, lambda x: x)
    user, anatomy, model = plain.model, plain.anatomy, pin.Model()
    model.gravity = user.gravity
    root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    shank = user.inertias[anatomy.tibia.joint].se3Action(anatomy.tibia.placement.inverse())
    model.appendBodyToJoint(root, weigh(shank), pin.SE3.Identity())
    insert = turn(anatomy.tibia.placement.inverse() * plain.bridge.insert.placement)
    for name, placement in (("tibia", pin.SE3.Identity()), ("insert", insert)):
        model.addFrame(pin.Frame(name, root, 0, placement, pin.FrameType.BODY))
    joint = model.addJoint(root, pin.JointModelFreeFlyer(), insert, "knee")
    model.appendBodyToJoint(joint, weigh(user.inertias[anatomy.femur.joint]), pin.SE3.Identity())
    hip = turn(anatomy.hip.placement)
    for name, placement in (("femur", pin.SE3.Identity()), ("hip", hip)):
        model.addFrame(pin.Frame(name, joint, 0, placement, pin.FrameType.BODY))
    surfaces = [plain.femoral, plain.insert, plain.button]
    if left:
        surfaces = [one.mirrored() for one in surfaces]

    def moved(point):
        return (point.link, tuple(MIRROR @ point.position if left else point.position))

    def ended(line):
        return replace(line, proximal=moved(line.proximal), distal=moved(line.distal))

    muscle, line = plain.extensor.quadriceps, plain.extensor.patellar_ligament
    return tkamb.Knee(
        model,
        side="left" if left else "right",
        implant=tkamb.Implant(*surfaces),
        ligaments=[ended(one) for one in plain.ligaments],
        extensor=tkamb.Extensor(
            replace(muscle, points=tuple(moved(point) for point in muscle.points)), ended(line)
        ),
        contact=plain.contact.model,
        friction=plain.friction,
    )


def state_of(read, k):
    """Return q, v, a and external forces of the model of two bodies without motion."""
    plain, motion, ground = read
    data = plain.model.createData()
    pin.forwardKinematics(plain.model, data, motion.q[k])
    tibia = plain.anatomy.tibia
    root = data.oMi[tibia.joint] * tibia.placement
    q = np.concatenate([pin.SE3ToXYZQUAT(root), pin.SE3ToXYZQUAT(plain.pose(motion.q[k]))])
    force = tibia.placement.actInv(ground[k][tibia.joint])
    external = pin.StdVec_Force([pin.Force.Zero(), force, pin.Force.Zero()])
    return q, np.zeros(12), np.zeros(12), external


def test_a_model_without_a_patella_has_one_in_equilibrium(read):
    plain = read[0]
    knee = without_patella(plain)
    q, v, a, external = state_of(read, 60)
    loads = knee.inverse_dynamics(q, v, a, external)
    recorded = plain.inverse_dynamics(*at(read, 60))
    assert not loads.problems
    # the recorded patella is in equilibrium except for its weight and inertia
    assert loads.quadriceps == pytest.approx(recorded.quadriceps, rel=0.01)
    assert loads.contact_total == pytest.approx(recorded.contact_total, rel=0.01)
    assert abs(loads.patellofemoral_tangential) < 1e-3 * loads.patellofemoral
    all_forces = [
        sum((part[j] for part in parts), pin.Force.Zero())
        for j in range(3)
        for parts in [(external, loads.external_forces, loads.residual_forces, loads.hip_forces)]
    ]
    tau = pin.rnea(knee.model, knee.model.createData(), q, v, a, pin.StdVec_Force(all_forces))
    assert tau == pytest.approx(0.0, abs=1e-8)


def test_a_given_tension_has_the_forces_of_the_solved_loads(read):
    """The quadriceps' tension alone gives the same forces as both tensions of the solution."""
    knee = without_patella(read[0])
    q, v, a, external = state_of(read, 60)
    loads = knee.inverse_dynamics(q, v, a, external)
    bare = tkamb.Knee(knee.model, implant=knee.implant, extensor=knee.extensor)
    by_ratio = bare.external_forces(q, v, loads.quadriceps)
    by_both = bare.external_forces(q, v, loads.tensions)
    for joint in (1, 2):
        assert by_both[joint].vector == pytest.approx(by_ratio[joint].vector, rel=1e-5, abs=1e-3)


def test_equilibrium_moves_the_knee_of_a_model_without_a_patella(read):
    knee = without_patella(read[0])
    q, v, a, external = state_of(read, 60)
    equilibrium = knee.equilibrium(q, v, a, external)
    assert not equilibrium.failed
    assert knee.coordinates(equilibrium.q) == pytest.approx(equilibrium.coordinates, abs=1e-10)
    assert equilibrium.q[:7] == pytest.approx(q[:7])
    forces = knee.external_forces(equilibrium.q, v, equilibrium.loads.tensions)
    assert forces[1].vector == pytest.approx(equilibrium.loads.external_forces[1].vector, abs=0.15)


@pytest.mark.parametrize("left", [False, True])
def test_show_draws_below_the_users_own_node(read, left):
    from pinocchio.visualize import MeshcatVisualizer

    knee = without_patella(read[0], left)
    q = state_of(read, 60)[0]
    if left:
        poses = [mirrored_se3(pin.XYZQUATToSE3(part)) for part in (q[:7], q[7:])]
        q = np.concatenate([pin.SE3ToXYZQUAT(pose) for pose in poses])
    viewer = MeshcatVisualizer(knee.model, pin.GeometryModel(), pin.GeometryModel())
    viewer.initViewer(open=False)
    viewer.loadViewerModel("mine")
    sent = []
    window = viewer.viewer.window
    send, window.send = window.send, lambda command: (sent.append(command), send(command))[1]
    knee.show(viewer, q, contact=knee.press(q, 1500.0))
    paths = {command.path.lower() for command in sent}
    for part in ("femoral", "insert", "patella", "pressure", "force/medial/0", "extensor"):
        assert any(f"mine/knee/{part}" in path for path in paths), part
    # A left knee's map, whose triangles are mirrored, is seen from above, too.
    (drawn,) = [c for c in sent if "knee/pressure" in c.path.lower()]
    assert drawn.object.material.lower(drawn.object)["side"] == 2  # THREE.DoubleSide
    # At the first look the insert is upright in the middle of the window; later calls move nothing.
    (view,) = [c.matrix for c in sent if c.path.lower() == "/meshcat"]
    insert = pin.XYZQUATToSE3(q[:7]).homogeneous @ knee.bridge.insert.placement.homogeneous
    assert (view @ insert)[:3, 1] == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
    assert np.abs((view @ insert)[:3, 3]).max() < 0.03
    sent.clear()
    knee.show(viewer, q)
    assert not any(command.path.lower() == "/meshcat" for command in sent)
    with pytest.raises(tkamb.errors.InputError, match="MeshCat"):
        knee.show(object(), q)
