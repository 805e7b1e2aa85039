"""The filter's response, exactness, convergence and behaviour at the ends; rigid-body rates."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import inverse, pose
from tkamb.io.recordings.filtering import (
    check_frames,
    differentiate_coordinates,
    differentiate_poses,
)

CUTOFF = 6.0


def test_quadratics_pass_the_filter_unchanged():
    t = np.sort(np.random.default_rng(0).uniform(0, 2, 300))
    x, v, a = differentiate_coordinates(t, np.stack([1 + 2 * t - 3 * t**2, t], axis=1), CUTOFF)
    np.testing.assert_allclose(x[:, 0], 1 + 2 * t - 3 * t**2, atol=1e-9)
    np.testing.assert_allclose(v, np.stack([2 - 6 * t, np.ones_like(t)], axis=1), atol=1e-7)
    np.testing.assert_allclose(a, np.tile([-6.0, 0.0], (300, 1)), atol=1e-5)


def test_quintics_are_exact_without_filter():
    t = np.linspace(-1, 1, 23) ** 3 + np.linspace(-1, 1, 23)
    at = np.linspace(-1.5, 1.5, 40)
    x, v, a = differentiate_coordinates(t, t**5 - t**2, "none", at)
    np.testing.assert_allclose(x, at**5 - at**2, atol=1e-10)
    np.testing.assert_allclose(v, 5 * at**4 - 2 * at, atol=1e-9)
    np.testing.assert_allclose(a, 20 * at**3 - 2, atol=1e-8)


@pytest.mark.parametrize("frequency", [1.0, 3.0, 6.0, 12.0])
@pytest.mark.parametrize("periodic", [False, True])
def test_response_is_that_of_a_two_pass_butterworth(frequency, periodic):
    t = np.linspace(0, 4, 961)
    wave, omega = np.sin(2 * np.pi * frequency * t), 2 * np.pi * frequency
    x, v, a = differentiate_coordinates(t, wave, CUTOFF, periodic=periodic)
    middle = slice(None) if periodic else slice(300, 660)
    gain = 1 / (1 + (frequency / CUTOFF) ** 6)
    np.testing.assert_allclose(x[middle], gain * wave[middle], atol=1e-5)
    np.testing.assert_allclose(
        v[middle] / omega, gain * np.cos(omega * t[middle]), atol=3e-5, err_msg="velocity"
    )
    np.testing.assert_allclose(a[middle] / omega**2, -gain * wave[middle], atol=3e-4)


def test_uneven_samples_give_the_same_curve():
    rng = np.random.default_rng(1)
    even = np.linspace(0, 2, 401)
    uneven = np.sort(np.concatenate([[0.0, 2.0], rng.uniform(0, 2, 600)]))
    at = np.linspace(0.3, 1.7, 50)

    def signal(t):
        return np.sin(2 * np.pi * t) + 0.2 * np.cos(2 * np.pi * 2.3 * t)

    from_even = differentiate_coordinates(even, signal(even), CUTOFF, at)
    from_uneven = differentiate_coordinates(uneven, signal(uneven), CUTOFF, at)
    for first, second, scale in zip(from_even, from_uneven, (1.0, 10.0, 100.0), strict=True):
        np.testing.assert_allclose(first, second, atol=1e-3 * scale)


def test_noise_is_reduced_and_the_acceleration_usable():
    rng = np.random.default_rng(2)
    t = np.linspace(0, 3, 361)
    omega = 2 * np.pi
    noisy = np.sin(omega * t) + rng.normal(0, 1e-3, len(t))
    _, _, raw = differentiate_coordinates(t, noisy, "none")
    _, _, filtered = differentiate_coordinates(t, noisy, CUTOFF)
    truth = -(omega**2) * np.sin(omega * t)
    inner = slice(40, -40)
    assert np.std((raw - truth)[inner]) > 0.5 * omega**2
    assert np.std((filtered - truth)[inner]) < 0.01 * omega**2


def test_end_effects_fade_within_a_period_and_are_below_those_of_a_padded_butterworth():
    t, omega = np.linspace(0, 3, 721), 2 * np.pi
    sections = butter(3, CUTOFF, fs=240, output="sos")
    ours, padded = [], []
    for phase in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        wave = np.sin(omega * t + phase)
        _, _, acceleration = differentiate_coordinates(t, wave, CUTOFF)
        ours.append(acceleration / omega**2 + wave)
        by_filter = np.gradient(np.gradient(sosfiltfilt(sections, wave), t), t)
        padded.append(by_filter / omega**2 + wave)
    ours, padded = (np.sqrt(np.mean(np.square(e), axis=0)) for e in (ours, padded))
    quarter, half, period = (round(240 * share / CUTOFF) for share in (0.25, 0.5, 1))
    assert ours[0] < 0.25
    assert ours[quarter] < 0.07
    assert ours[half] < 0.015
    assert ours[period] < 0.003
    for k in (0, quarter, half, period):
        assert ours[k] < 0.5 * padded[k]


def test_periodic_curve_closes_with_its_derivatives():
    t = np.linspace(0, 1.5, 101)
    wave = np.cos(2 * np.pi * t / 1.5) ** 3 + 0.01 * np.sin(t)
    wave[-1] = wave[0] + 0.02
    for cutoff in (CUTOFF, "none"):
        for value in differentiate_coordinates(t, wave, cutoff, periodic=True):
            np.testing.assert_allclose(value[0], value[-1], atol=1e-8 * np.abs(value).max())


def test_derivatives_converge_with_the_samples():
    at = np.linspace(0.5, 1.5, 30)
    errors = []
    for count in (21, 41, 81):
        t = np.linspace(0, 2, count)
        _, _, a = differentiate_coordinates(t, np.sin(4 * t), "none", at)
        errors.append(np.abs(a + 16 * np.sin(4 * at)).max())
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert slopes.min() > 3.7  # a quintic's second derivative is of fourth order


def moving(t):
    turn = Rotation.from_euler("XYZ", np.stack([np.sin(3 * t), 0.5 * np.cos(2 * t), 4 * t], -1))
    return pose(turn.as_matrix(), np.stack([np.sin(t), t**2, np.cos(2 * t)], axis=-1))


def test_rates_of_poses_agree_with_finite_differences_of_pinocchio():
    t, at, h = np.linspace(0, 2, 201), np.linspace(0.3, 1.7, 11), 1e-4

    def body_velocity(t):
        steps = inverse(moving(t - h)) @ moving(t + h)
        logs = [pin.log6(pin.SE3(step[:3, :3], step[:3, 3])).vector for step in steps]
        return np.array(logs) / (2 * h)

    poses, velocity, acceleration = differentiate_poses(t, moving(t), "none", at)
    np.testing.assert_allclose(poses, moving(at), atol=1e-9)
    np.testing.assert_allclose(velocity, body_velocity(at), atol=1e-6)
    by_difference = (body_velocity(at + h) - body_velocity(at - h)) / (2 * h)
    np.testing.assert_allclose(acceleration, by_difference, atol=1e-4)


def test_free_flyer_accelerates_as_pinocchio_integrates():
    """Integration of velocity and acceleration of one frame gives the next pose."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    dt = 1e-3
    at = np.array([0.7, 0.7 + dt])
    poses, velocity, acceleration = differentiate_poses(
        np.linspace(0, 2, 201), moving(np.linspace(0, 2, 201)), "none", at
    )
    q = np.concatenate([poses[0, :3, 3], Rotation.from_matrix(poses[0, :3, :3]).as_quat()])
    step = velocity[0] * dt + 0.5 * acceleration[0] * dt**2
    end = pin.integrate(model, q, step)
    np.testing.assert_allclose(end[:3], poses[1, :3, 3], atol=2e-7)
    np.testing.assert_allclose(Rotation.from_quat(end[3:]).as_matrix(), poses[1, :3, :3], atol=2e-7)


def test_filtered_orientation_does_not_depend_on_the_axes():
    t = np.linspace(0, 2, 241)
    rng = np.random.default_rng(3)
    noise = Rotation.from_rotvec(rng.normal(0, 0.01, (241, 3))).as_matrix()
    poses = moving(t)
    poses[:, :3, :3] = poses[:, :3, :3] @ noise
    left, right = (Rotation.random(random_state=k).as_matrix() for k in (4, 5))
    turned = pose(left @ poses[:, :3, :3] @ right, poses[:, :3, 3] @ left.T)
    filtered, velocity, _ = differentiate_poses(t, poses, CUTOFF)
    filtered_turned, velocity_turned, _ = differentiate_poses(t, turned, CUTOFF)
    np.testing.assert_allclose(
        left @ filtered[:, :3, :3] @ right, filtered_turned[:, :3, :3], atol=1e-9
    )
    np.testing.assert_allclose(velocity[:, 3:] @ right, velocity_turned[:, 3:], atol=1e-7)
    error = Rotation.from_matrix(np.swapaxes(filtered[:, :3, :3], 1, 2) @ moving(t)[:, :3, :3])
    assert np.median(error.magnitude()) < 0.01


@pytest.mark.parametrize(
    ("time", "value", "cutoff", "message"),
    [
        (np.linspace(0, 2, 50), np.r_[np.nan, np.zeros(49)], 6.0, "missing or not finite"),
        (np.r_[0, 0, np.linspace(0.1, 2, 48)], np.zeros(50), 6.0, "do not rise"),
        (np.linspace(0, 2, 50), np.zeros(50), 13.0, "half the sampling rate"),
        (np.linspace(0, 2, 50), np.zeros(50), 0.0, "not a positive"),
        (np.linspace(0, 2, 50), np.zeros(50), 0.4, "shorter than one period"),
        (np.linspace(0, 2, 5), np.zeros(5), "none", "5 samples are too few"),
    ],
)
def test_unusable_samples_are_refused(time, value, cutoff, message):
    with pytest.raises(InputError, match=message) as caught:
        differentiate_coordinates(time, value, cutoff, name="gait.csv")
    assert "gait.csv" in str(caught.value)


def test_too_few_frames_for_the_cutoff_are_refused_with_the_number_needed():
    time = np.linspace(0.0, 2.0, 26)
    check_frames(time, 6.0, 26)
    differentiate_coordinates(time, np.zeros(26), 6.0)  # the number in the message is accepted
    with pytest.raises(InputError, match=r"frames = 25 resamples to 12 Hz.*give 26 or more"):
        check_frames(np.linspace(0.0, 2.0, 25), 6.0, 25)
    check_frames(np.linspace(0.0, 2.0, 25), "none", 25)


def test_curves_are_refused_outside_the_recording():
    t = np.linspace(0, 2, 50)
    with pytest.raises(InputError, match=r"covers 0 to 2 s, but 2\.1 s is needed"):
        differentiate_coordinates(t, np.zeros(50), 6.0, at=np.array([1.0, 2.1]))


@pytest.mark.parametrize("cutoff", np.arange(1.0, 12.5, 0.5))
def test_no_cutoff_loses_the_last_knot(cutoff):
    """The last knot equals the last sample to rounding (4 s at 25 Hz and 10 Hz)."""
    time = np.linspace(0.0, 4.0, 101)
    x, _, _ = differentiate_coordinates(time, np.column_stack([time, time**2]), cutoff)
    np.testing.assert_allclose(x[:, 0], time, atol=1e-9)
