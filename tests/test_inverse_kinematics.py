"""Inverse kinematics: Jacobians by finite differences, exact markers, missing markers, noise."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import knee_coordinates, knee_pose, pose, transform
from tkamb.io.recordings.inverse_kinematics import FLEXION, LegChain, LegState, Segment, fit_chain
from tkamb.io.recordings.markers import fit_rigid, fit_seen

FRAMES = 7
NEUTRAL = np.array([-0.002, 0.042, 0.001, 0.03, -0.02, 0.0])
INSERT = pose(Rotation.from_euler("xyz", [0.03, -0.02, 0.05]).as_matrix(), [0.01, 0.40, 0.0])


def segments(seed: int = 0) -> list[Segment]:
    rng = np.random.default_rng(seed)

    def segment(name: str, middle: list[float], count: int, **joint) -> Segment:
        points = np.array(middle) + rng.normal(0.0, 0.06, (count, 3))
        weights = rng.uniform(0.5, 2.0, count)
        labels = tuple(f"{name}{k}" for k in range(count))
        return Segment(name, labels, points, weights, **joint)

    ankle = {"joined_to": "shank", "joint": np.zeros(3), "centre": np.array([0.05, 0.05, 0.0])}
    hip = {
        "joined_to": "thigh",
        "joint": np.array([-0.02, 0.39, 0.02]),
        "centre": np.array([-0.04, -0.1, 0.08]),
    }
    return [
        segment("shank", [0.0, 0.2, 0.0], 3),
        segment("thigh", [0.03, 0.2, 0.05], 3),
        segment("foot", [0.1, 0.0, 0.0], 4, **ankle),
        segment("pelvis", [0.0, 0.0, 0.0], 4, **hip),
    ]


def random_state(chain: LegChain, seed: int = 1) -> LegState:
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.4, (FRAMES, 3))).as_matrix()
    shank = pose(turns, rng.normal(0.0, 0.5, (FRAMES, 3)))
    knee = np.tile(NEUTRAL, (FRAMES, 1))
    knee[:, FLEXION] = np.linspace(0.0, 1.8, FRAMES)
    if chain.free:
        knee[:, :5] += rng.normal(0.0, 0.02, (FRAMES, 5))
    thigh = shank @ INSERT @ knee_pose(knee)
    balls = {
        ball.name: Rotation.from_rotvec(rng.normal(0.0, 0.3, (FRAMES, 3))).as_matrix()
        for ball in chain.balls
    }
    return LegState(shank, knee, thigh, balls)


def start(chain: LegChain, measured: np.ndarray) -> LegState:
    fits, first = {}, 0
    for segment in chain.segments.values():
        part = measured[:, first : first + len(segment.points)]
        fits[segment.name] = fit_seen(part, segment.points, segment.weights, segment.name)[0]
        first += len(segment.points)
    return chain.start(fits, NEUTRAL)


@pytest.mark.parametrize("free", [False, True], ids=["hinge", "six freedoms"])
def test_the_jacobian_is_the_derivative_of_the_markers(free):
    chain = LegChain(segments(), INSERT, free)
    state = random_state(chain)
    _, jacobian = chain.markers(state)
    for k in range(chain.freedoms):
        step = np.zeros((FRAMES, chain.freedoms))
        step[:, k] = 1e-6
        ahead, behind = (chain.markers(chain.moved(state, s * step))[0] for s in (1, -1))
        np.testing.assert_allclose((ahead - behind) / 2e-6, jacobian[..., k], atol=1e-8)


@pytest.mark.parametrize("free", [False, True], ids=["hinge", "six freedoms"])
def test_exact_markers_give_the_exact_pose(free):
    chain = LegChain(segments(), INSERT, free)
    truth = random_state(chain)
    measured, _ = chain.markers(truth)
    weights = np.concatenate([s.weights for s in chain.segments.values()])
    fit = fit_chain(chain, measured, weights, start(chain, measured))
    assert fit.solved.all() and fit.rms.max() < 1e-9
    np.testing.assert_allclose(fit.state.shank, truth.shank, atol=1e-9)
    result = knee_coordinates(np.linalg.inv(fit.state.shank @ INSERT) @ fit.state.thigh)
    np.testing.assert_allclose(result, truth.knee, atol=1e-9)


def test_poses_are_found_with_missing_markers():
    chain = LegChain(segments(), INSERT, False)
    truth = random_state(chain)
    measured, _ = chain.markers(truth)
    incomplete = measured.copy()
    incomplete[:, 0] = np.nan  # a shank marker is missing throughout
    incomplete[2, 4:6] = np.nan  # two thigh markers are missing in one frame
    weights = np.concatenate([s.weights for s in chain.segments.values()])
    fit = fit_chain(chain, incomplete, weights, start(chain, measured))
    assert fit.solved.all()
    np.testing.assert_allclose(fit.state.thigh, truth.thigh, atol=1e-8)
    assert np.isnan(fit.distance[:, 0]).all()


def test_the_solution_is_a_minimum_of_the_weighted_distance():
    chain = LegChain(segments(), INSERT, False)
    measured, _ = chain.markers(random_state(chain))
    measured = measured + np.random.default_rng(3).normal(0.0, 0.01, measured.shape)
    weights = np.concatenate([s.weights for s in chain.segments.values()])
    fit = fit_chain(chain, measured, weights, start(chain, measured))
    places, jacobian = chain.markers(fit.state)
    gradient = np.einsum("fmi,m,fmin->fn", places - measured, weights, jacobian)
    assert fit.solved.all() and np.abs(gradient).max() < 1e-5
    heavier = weights.copy()
    heavier[4] *= 1e6
    refit = fit_chain(chain, measured, heavier, start(chain, measured))
    assert refit.distance[:, 4].max() < 0.01 * fit.distance[:, 4].min()


def test_flexion_has_no_bound():
    chain = LegChain(segments(), INSERT, False)
    state = random_state(chain)
    state.knee[:, FLEXION] = np.linspace(-0.5, 2.9, FRAMES)
    truth = LegState(
        state.shank, state.knee, state.shank @ INSERT @ knee_pose(state.knee), state.turns
    )
    measured, _ = chain.markers(truth)
    fit = fit_chain(chain, measured, np.ones(14), start(chain, measured))
    np.testing.assert_allclose(fit.state.knee[:, FLEXION], truth.knee[:, FLEXION], atol=1e-9)


def test_a_rigid_fit_needs_three_visible_markers():
    reference = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.15]])
    turn = Rotation.from_rotvec([0.3, -0.5, 1.2]).as_matrix()
    markers = np.tile(transform(pose(turn, [1.0, 2.0, 3.0]), reference), (3, 1, 1))
    markers[1, 0] = np.nan
    markers[2, :2] = np.nan
    poses, rms = fit_seen(markers, reference, np.ones(4), "x")
    np.testing.assert_allclose(
        poses[:2], np.tile(pose(turn, [1.0, 2.0, 3.0]), (2, 1, 1)), atol=1e-12
    )
    assert np.isnan(poses[2]).all() and np.isnan(rms[2])
    rigid, _ = fit_rigid(markers[:1], reference)
    np.testing.assert_allclose(poses[:1], rigid, atol=1e-14)
    with pytest.raises(InputError, match="no orientation"):
        fit_seen(markers[:, :2], reference[:2], np.ones(2), "x")
