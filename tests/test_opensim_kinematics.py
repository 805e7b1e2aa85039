"""Kinematics and dynamics of OpenSim models agree with closed forms, differences and OpenSim."""

import numpy as np
import pytest

from opensim_models import OWN, PUBLISHED, kinematics
from opensim_references import WEIGHTS, references
from tkamb.errors import InputError
from tkamb.io.opensim.model import Linear, Polynomial, Scaled, piecewise_linear, simm_spline
from tkamb.io.opensim.motion import inverse_dynamics

X = np.array([-1.0, -0.4, 0.1, 0.7, 1.5])


def test_spline_reproduces_a_cubic():
    """The end conditions are exact for cubics, unlike those of a natural spline."""
    cubic = Polynomial(np.array([0.3, -1.0, 0.5, 2.0]))
    spline = simm_spline(X, cubic(X))
    inside = np.linspace(-1.0, 1.5, 40)
    np.testing.assert_allclose(spline(inside), cubic(inside), atol=1e-13)
    np.testing.assert_allclose(spline.slope(inside), cubic.slope(inside), atol=1e-12)
    np.testing.assert_allclose(spline.curvature(inside), cubic.curvature(inside), atol=1e-11)


@pytest.mark.parametrize(
    "function",
    [
        Linear(2.0, -1.0),
        Polynomial(np.array([1.0, 0.0, -2.0, 0.5])),
        Scaled(simm_spline(X, np.sin(X)), -1.5),
        simm_spline(X[:3], np.sin(X[:3])),
        simm_spline(X[:2], np.sin(X[:2])),
        piecewise_linear(X, np.sin(X)),
    ],
)
def test_slopes_and_curvatures_are_derivatives(function):
    x, h = np.linspace(-1.713, 1.931, 23), 1e-5
    np.testing.assert_allclose(
        (function(x + h) - function(x - h)) / (2 * h), function.slope(x), atol=1e-8
    )
    np.testing.assert_allclose(
        (function.slope(x + h) - function.slope(x - h)) / (2 * h), function.curvature(x), atol=1e-7
    )


@pytest.mark.parametrize("name", [*OWN, *PUBLISHED])
def test_poses_are_those_of_opensim(name):
    chain, truth = kinematics(name), references()[name]
    assert list(chain.coordinates) == truth["coordinates"]
    assert [c.rotational for c in chain.model.coordinates.values()] == truth["rotational"]
    assert chain.model.mass_kg == pytest.approx(truth["mass_kg"], abs=1e-12)
    poses = chain.poses(np.array(truth["q"]))
    index = [chain.bodies[body] for body in truth["bodies"]]
    sums = (poses[:, index, :3] * WEIGHTS).sum(axis=(-1, -2))
    np.testing.assert_allclose(sums, truth["pose_sums"], atol=1e-11)


@pytest.mark.parametrize("name", ["old_layout", "JW"])
def test_jacobian_is_the_derivative_of_points(name):
    chain = kinematics(name)
    rng = np.random.default_rng(3)
    q = rng.uniform(-0.8, 0.8, (2, len(chain.coordinates)))
    bodies = list(chain.model.bodies)
    points = rng.uniform(-0.3, 0.3, (len(bodies), 3))
    _, jacobian = chain.motion(q).points(bodies, points)
    h = 1e-6
    for c in range(q.shape[1]):
        step = h * np.eye(q.shape[1])[c]
        ahead, behind = (chain.motion(q + s).points(bodies, points)[0] for s in (step, -step))
        np.testing.assert_allclose((ahead - behind) / (2 * h), jacobian[..., c], atol=5e-9)


def test_a_backwards_joint_is_the_same_joint():
    """The parent of JW's knee is the tray and the child is the femur, which is nearer to ground."""
    chain = kinematics("JW")
    q = {"knee_flexion": -1.0, "knee_rotation": 0.2, "knee_ty": 0.03}
    poses = dict(zip(chain.bodies, chain.poses(q), strict=True))
    relative = np.linalg.inv(poses["tibial_tray"]) @ poses["femoral_component"]
    c, s = np.cos(-1.0), np.sin(-1.0)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c, s = np.cos(-0.2), np.sin(-0.2)
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    np.testing.assert_allclose(relative[:3, :3], about_z @ about_y, atol=1e-9)
    assert relative[1, 3] == pytest.approx(0.03)


def test_dependent_coordinates_follow_their_couplers():
    chain = kinematics("Rajagopal2016")
    q = chain.coupled({"knee_angle_r": 0.7})
    assert q[chain.coordinates["knee_angle_r_beta"]] == pytest.approx(0.7)


def test_wrong_coordinates_are_refused():
    chain = kinematics("old_layout")
    with pytest.raises(InputError, match="no coordinate 'elbow'"):
        chain.poses({"elbow": 1.0})
    with pytest.raises(InputError, match="16 coordinates, 3 are given"):
        chain.poses(np.zeros(3))


TOLERANCE = {"JW": 1e-8, "gait2392": 1e-8, "DM": 5e-3, "Rajagopal2016": 0.05}
"""N and N·m. OpenSim's own error is this large where splines rotate a joint, see
`test_force_on_the_pelvis_is_the_rate_of_momentum`."""


def energy(chain, q, rates):
    """Return kinetic and potential energy (f,) from the bodies' own motion."""
    motion = chain.motion(q)
    twists = np.einsum("fbin,fn->fbi", motion.twists, rates)
    total = np.zeros(len(q))
    for name, body in chain.model.bodies.items():
        b = chain.bodies[name]
        rotation = motion.poses[:, b, :3, :3]
        centre = rotation @ body.centre + motion.poses[:, b, :3, 3]
        omega = np.einsum("fji,fj->fi", rotation, twists[:, b, :3])
        speed = twists[:, b, 3:] + np.cross(twists[:, b, :3], centre)
        total += 0.5 * np.einsum("fi,ij,fj->f", omega, body.inertia, omega)
        total += body.mass_kg * (0.5 * (speed**2).sum(1) - centre @ chain.model.gravity)
    return total


@pytest.mark.parametrize("name", ["old_layout", "JW"])
def test_power_is_the_rate_of_energy(name):
    """The power of generalised forces and of a wrench on the foot is the rate of the energy."""
    chain = kinematics(name)
    rng = np.random.default_rng(2)
    q, rates, second = rng.uniform(-0.8, 0.8, (3, 3, len(chain.coordinates)))
    foot = "calcn" if name == "old_layout" else "calcaneus"
    foot = foot if foot in chain.bodies else list(chain.bodies)[-1]
    wrench = {foot: rng.uniform(-50.0, 50.0, (3, 6))}
    forces = inverse_dynamics(chain, q, rates, second, wrench)
    twist = np.einsum("fin,fn->fi", chain.motion(q).twists[:, chain.bodies[foot]], rates)
    power = (forces * rates).sum(1) + (wrench[foot] * twist).sum(1)
    h = 1e-5
    ahead, behind = (
        energy(chain, q + s * rates + 0.5 * s**2 * second, rates + s * second) for s in (h, -h)
    )
    np.testing.assert_allclose((ahead - behind) / (2 * h), power, rtol=1e-7, atol=1e-5)


@pytest.mark.parametrize("name", ["Rajagopal2016", "DM"])
def test_force_on_the_pelvis_is_the_rate_of_momentum(name):
    """The force agrees with differences of the mass centre's path; OpenSim is up to 0.03 N off."""
    chain, truth = kinematics(name), references()[name]
    rates, second, _ = (np.array([v]) for v in truth["dynamics"][1])
    q, model = np.array(truth["q"][1:2]), chain.model

    def first_moment(at):
        poses = chain.poses(at)
        return sum(
            body.mass_kg * (poses[0, chain.bodies[n]] @ np.append(body.centre, 1.0))[:3]
            for n, body in model.bodies.items()
        )

    h = 2e-4
    path = [first_moment(q + s * rates + 0.5 * s**2 * second) for s in h * np.arange(-2, 3)]
    expected_rate = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) @ path / (12.0 * h**2)
    forces = inverse_dynamics(chain, q, rates, second)[0]
    pelvis = [chain.coordinates[f"pelvis_t{axis}"] for axis in "xyz"]
    expected = expected_rate - model.mass_kg * model.gravity
    np.testing.assert_allclose(forces[pelvis], expected, atol=1e-4)


@pytest.mark.parametrize("name", PUBLISHED)
def test_generalised_forces_are_those_of_opensim(name):
    chain, truth = kinematics(name), references()[name]
    count = len(truth["dynamics"])
    rates, second, forces = (np.array(v) for v in zip(*truth["dynamics"], strict=True))
    computed = inverse_dynamics(chain, np.array(truth["q"])[:count], rates, second)
    np.testing.assert_allclose(computed, forces, atol=TOLERANCE[name])
