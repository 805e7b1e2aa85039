"""Muscles of a whole trial: closed forms, balance, continuity, frames that fail, bad input."""

import numpy as np
import pytest

from jw_gait import gait, needs_jw
from plane_leg import COORDINATES, MASSES, SHANK, muscle, plane_leg
from tkamb.errors import InputError
from tkamb.io.importing.anatomy import find_leg
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.model import CoordinateCoupler, Linear
from tkamb.io.opensim.motion import CoordinateMotion, coordinate_motion, read_coordinates
from tkamb.io.recordings.tables import Table
from tkamb.run.muscles import Sharing, solve_trial
from tkamb.run.muscles.leg import leg_muscles, length_twins

G = 9.80665
KNEE = COORDINATES[1:2]
FREE = np.inf


def hamstring(name="hamstring", depth=-0.04, **numbers):
    """Return a muscle parallel to the shank of a straight knee: its arm is then the depth."""
    ends = ("femur_r", [depth, -0.4, 0.0]), ("tibia_r", [depth, -0.3, 0.0])
    return muscle(name, *ends, **numbers)


def still_leg(model, knee, frames=1):
    """Return the motion of a leg that is still, bent by an angle (rad)."""
    q = np.tile([0.0, knee, 0.0], (frames, 1))
    return CoordinateMotion(np.arange(frames) / 100.0, q, 0.0 * q, 0.0 * q)


def gravity_about_knee(knee):
    """Return the moment (N·m) that holds shank and foot, bent by an angle from the vertical."""
    return G * (MASSES["tibia_r"] * 0.2 + MASSES["foot_r"] * SHANK) * np.sin(knee)


def test_one_muscle_balances_gravity():
    model = plane_leg(hamstring())
    sharing = Sharing(coordinates=KNEE, reserve=0.0)
    knee = -0.5
    trial = solve_trial(model, still_leg(model, knee), {}, sharing=sharing)
    assert trial.status == ("ok",)
    needed = gravity_about_knee(knee)
    assert trial.moment[0, 0] == pytest.approx(needed)
    lever = trial.moment_arm_m[0, 0, 0]
    assert trial.force_N[0, 0] == pytest.approx(needed / lever)
    # The arm is the line's distance from the knee's axis.
    turn = np.array([[np.cos(knee), -np.sin(knee)], [np.sin(knee), np.cos(knee)]])
    origin, insertion = np.array([-0.04, 0.0]), turn @ [-0.04, -0.3]
    u = (insertion - origin) / np.linalg.norm(insertion - origin)
    assert lever == pytest.approx(insertion[1] * u[0] - insertion[0] * u[1])


def test_two_muscles_share_by_strength_lever_and_weight():
    """At the minimum of Σ w a² with Σ r F a = M, a is proportional to r F / w."""
    pair = hamstring("long", -0.05, force=900.0), hamstring("short", -0.03, force=1500.0)
    model = plane_leg(*pair)
    for weights, w in (("equal", np.ones(2)), ("volume", np.array([900.0, 1500.0]))):
        sharing = Sharing(coordinates=KNEE, reserve=0.0, weights=weights)
        trial = solve_trial(model, still_leg(model, -0.6), {}, sharing=sharing)
        strength = trial.moment_arm_m[0, :, 0] * [900.0, 1500.0]
        shape = strength / w
        expected = shape * trial.moment[0, 0] / (strength @ shape)
        np.testing.assert_allclose(trial.activation[0], expected, rtol=1e-9)


def test_a_moment_on_the_foot_changes_the_knee_moment():
    model = plane_leg(hamstring(force=1e5))
    push = {"foot_r": np.array([[0.0, 0.0, 40.0, 0.0, 0.0, 0.0]])}  # N·m, straightens the knee
    sharing = Sharing(coordinates=KNEE, reserve=0.0)
    with_it = solve_trial(model, still_leg(model, -0.5), push, sharing=sharing)
    without = solve_trial(model, still_leg(model, -0.5), {}, sharing=sharing)
    assert with_it.moment[0, 0] - without.moment[0, 0] == pytest.approx(-40.0)
    difference = (with_it.force_N - without.force_N)[0, 0]
    assert difference == pytest.approx(-40.0 / with_it.moment_arm_m[0, 0, 0])


def test_muscle_moments_and_reserves_sum_to_the_joint_moment():
    model = plane_leg(hamstring(force=50.0))
    trial = solve_trial(model, still_leg(model, -0.8), {}, sharing=Sharing(reserve=1.0))
    muscle_moment = np.einsum("fm,fmc->fc", trial.force_N, trial.moment_arm_m)
    np.testing.assert_allclose(muscle_moment + trial.reserve, trial.moment, atol=1e-12)
    assert trial.activation[0, 0] == pytest.approx(1.0) and trial.reserve[0, 1] < -1.0


def test_a_coupled_coordinate_adds_its_share():
    """With ankle = 2 knee, moments and arms are those of the knee plus twice the ankle's."""
    calf = muscle("calf", ("tibia_r", [-0.03, -0.1, 0.0]), ("foot_r", [-0.05, -0.02, 0.0]))
    plain = plane_leg(calf)
    follower = CoordinateCoupler("c", COORDINATES[2], COORDINATES[1], Linear(2.0, 0.1))
    coupled = plane_leg(calf)
    object.__setattr__(coupled, "couplers", (follower,))
    time = np.linspace(0.0, 1.0, 60)
    q = np.stack([0 * time, -0.5 + 0.1 * np.sin(5 * time), 0 * time], axis=1)
    motion = coordinate_motion(Kinematics(coupled), time, q, "none")
    np.testing.assert_allclose(motion.q[:, 2], 2 * motion.q[:, 1] + 0.1)
    np.testing.assert_allclose(motion.accelerations[:, 2], 2 * motion.accelerations[:, 1])
    loose = solve_trial(plain, motion, {}, sharing=Sharing(coordinates=COORDINATES[1:]))
    tied = solve_trial(coupled, motion, {}, sharing=Sharing(coordinates=KNEE))
    factors = np.array([1.0, 2.0])
    np.testing.assert_allclose(tied.moment[:, 0], loose.moment @ factors, atol=1e-12)
    np.testing.assert_allclose(tied.moment_arm_m[..., 0], loose.moment_arm_m @ factors, atol=1e-15)


def test_frames_fail_with_a_reason_and_no_numbers():
    model = plane_leg(hamstring(force=100.0))
    knees = np.array([-0.1, -0.1, -1.2])
    q = np.stack([0 * knees, knees, 0 * knees], axis=1)
    motion = CoordinateMotion(np.arange(3.0), q, 0 * q, 0 * q)
    load = np.zeros((3, 6))
    load[1, 2] = np.nan
    sharing = Sharing(coordinates=KNEE, reserve=0.0)
    trial = solve_trial(model, motion, {"foot_r": load}, sharing=sharing)
    assert trial.status[0] == "ok"
    assert trial.status[1] == "failed: an external load is unknown"
    assert trial.status[2].startswith("failed: no muscle forces within their limits")
    for values in (trial.activation, trial.force_N, trial.reserve, trial.knee_reaction()):
        assert np.isfinite(values[0]).all() and np.isnan(values[1:]).all()
    assert np.isnan(trial.kkt_residual[1:]).all()


def test_fibres_beyond_their_curves_fail_by_name():
    long = hamstring(optimal_fibre_length_m=0.04, tendon_slack_length_m=0.2)
    model = plane_leg(long)
    trial = solve_trial(model, still_leg(model, -0.2), {}, sharing=Sharing(law="hill"))
    assert trial.status == ("failed: fibres beyond 1.8 optimal lengths in hamstring",)


def test_hill_muscles_pull_passively_and_with_less_strength():
    muscle_ = hamstring(optimal_fibre_length_m=0.08, tendon_slack_length_m=0.2)
    model = plane_leg(muscle_)
    trial = solve_trial(
        model, still_leg(model, -0.3), {}, sharing=Sharing(law="hill", reserve=FREE)
    )
    # The reserve costs nothing: the muscle is idle and pulls passively at (L - slack)/l_o = 1.2.
    assert trial.activation[0, 0] == pytest.approx(0.0, abs=1e-9)
    length = np.linalg.norm(_line(model, -0.3))
    stretch = (length - 0.2) / 0.08
    passive = np.expm1(4.0 * (stretch - 1.0) / 0.6) / np.expm1(4.0)
    assert trial.force_N[0, 0] == pytest.approx(1000.0 * passive)


def _line(model, knee):
    points = model.muscles["hamstring"].path.points
    points, _ = (
        Kinematics(model)
        .motion([0.0, knee, 0.0])
        .points([p.body for p in points], [p.location for p in points])
    )
    return points[1] - points[0]


def test_a_length_twin_carries_no_force():
    """A length twin is a copy of a muscle with fewer path points. Only its length is used."""
    twin = muscle("copy", ("femur_r", [0.0, -0.1, 0.0]), ("tibia_r", [0.05, -0.05, 0.0]))
    whole = muscle(
        "whole",
        ("femur_r", [0.0, -0.1, 0.0]),
        ("tibia_r", [0.05, -0.05, 0.0]),
        ("foot_r", [0.0, -0.05, 0.0]),
    )
    model = plane_leg(twin, whole, hamstring())
    assert length_twins(model) == {"whole": "copy"}
    assert leg_muscles(find_leg(model, "right")) == ("whole", "hamstring")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"muscles": ("hamstrin",)}, "no muscle 'hamstrin'.*did you mean hamstring"),
        ({"coordinates": ("knee",)}, "no coordinate 'knee'"),
        ({"coordinates": KNEE * 2}, "each once"),
        ({"muscles": ()}, "needs muscles"),
        ({"reserve": -1.0}, "negative"),
        ({"reserve": np.nan}, "negative or no number"),
        ({"reserve": {"hip_flexion_r": 1.0}}, "differ in ankle_flexion_r, knee_flexion_r"),
        ({"exponent": 1.0}, "exponent"),
        ({"lowest": 1.0}, "lowest 1"),
    ],
)
def test_options_that_make_no_sense_are_refused(change, message):
    model = plane_leg(hamstring())
    with pytest.raises(InputError, match=message):
        solve_trial(model, still_leg(model, -0.2), {}, sharing=Sharing(**change))


def test_motion_and_loads_that_do_not_fit_are_refused():
    model = plane_leg(hamstring())
    with pytest.raises(InputError, match="no body 'calcn_r'"):
        solve_trial(model, still_leg(model, 0.0), {"calcn_r": np.zeros((1, 6))})
    with pytest.raises(InputError, match="2 rows for 1 times"):
        solve_trial(model, still_leg(model, 0.0), {"foot_r": np.zeros((2, 6))})
    with pytest.raises(InputError, match="not finite"):
        solve_trial(model, still_leg(model, np.nan), {})
    with pytest.raises(InputError, match="left knee"):
        solve_trial(model, still_leg(model, 0.0), {}, side="left")


def test_coordinates_are_read_by_name_or_path(tmp_path):
    chain = Kinematics(plane_leg())
    columns = {
        "time": np.arange(3.0),
        "/jointset/knee_r/knee_flexion_r/value": np.array([10.0, 20.0, 30.0]),
        "hip_flexion_r": np.array([1.0, 2.0, 3.0]),
    }
    q, missing = read_coordinates(chain, Table(tmp_path / "q.mot", columns, in_degrees=True))
    assert missing == ("ankle_flexion_r",)
    np.testing.assert_allclose(np.degrees(q), [[1, 10, 0], [2, 20, 0], [3, 30, 0]])
    with pytest.raises(InputError, match="inDegrees"):
        read_coordinates(chain, Table(tmp_path / "q.mot", columns))


@pytest.fixture(scope="module")
def walking():
    trial = gait(2.2, 2.75)
    return trial, solve_trial(trial.kinematics.model, trial.motion, trial.loads)


@needs_jw
def test_a_gait_trial_is_optimal_and_continuous_in_every_frame(walking):
    _, result = walking
    assert len(result.muscles) == 44 and set(result.status) == {"ok"}
    assert result.coordinates == (
        *("hip_flexion", "hip_adduction", "hip_rotation"),
        *("knee_flexion", "ankle_angle", "subtalar_angle"),
    )
    assert result.kkt_residual.max() < 1e-8
    assert np.abs(np.diff(result.activation, axis=0)).max() < 0.2  # at 120 Hz
    assert result.activation.min() > -1e-9 and result.activation.max() < 1.0 + 1e-9


@needs_jw
def test_forces_and_reserves_balance_the_moments(walking):
    _, result = walking
    muscle_moment = np.einsum("fm,fmc->fc", result.force_N, result.moment_arm_m) + result.reserve
    np.testing.assert_allclose(muscle_moment, result.moment, atol=1e-8)
