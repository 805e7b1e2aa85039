"""Functions, poses and Jacobians agree with analytic values, finite differences and OpenSim."""

import numpy as np
import pytest

from opensim_models import OWN, PUBLISHED, kinematics
from opensim_references import WEIGHTS, references
from tkamb.errors import InputError
from tkamb.io.opensim.model import Linear, Polynomial, Scaled, piecewise_linear, simm_spline

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
