"""Registration of markers: synthetic walks with a known truth, and subject DM."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

from tkamb.errors import InputError
from tkamb.geometry.frames import pose
from tkamb.io.importing.markers import ModelSegment
from tkamb.io.importing.registration import REGISTRATION, _MarkedLeg, register
from tkamb.io.importing.trial import moved_markers
from tkamb.units import DEGREE, MILLIMETRE

LEG = SimpleNamespace(
    insert_in_tibia=pose(np.eye(3), [0.01, 0.36, 0.004]), neutral=np.array([0.0, 0.04, 0, 0, 0, 0])
)
HIP, ANKLE = (np.array([-0.02, 0.39, 0.02]), [-0.04, -0.08, 0.08]), (np.zeros(3), [0.045, 0.045, 0])


def segment(name, points, joined_to="", joint=None, centre=None):
    markers = {f"{name}{k}": np.array(point) for k, point in enumerate(points)}
    return ModelSegment(
        name, markers, (), joined_to, joint, None if centre is None else np.array(centre)
    )


SEGMENTS = [
    segment("shank", [[-0.03, 0.32, 0.08], [-0.015, 0.09, 0.035], [0.03, 0.2, -0.01]]),
    segment("thigh", [[0.0, 0.30, 0.1], [0.02, 0.07, 0.06], [0.08, 0.16, 0.02]]),
    segment(
        "foot",
        [[-0.05, 0.03, -0.02], [0.12, 0.08, 0.02], [0.14, 0.0, 0.06], [0.06, -0.02, 0.04]],
        *("shank", *ANKLE),
    ),
    segment(
        "pelvis",
        [[-0.16, 0.0, 0.03], [-0.16, 0.0, -0.03], [0.05, 0.0, 0.14], [0.05, 0.0, -0.13]],
        *("thigh", *HIP),
    ),
]
SKIN_MM = {"shank": 4.0, "thigh": 7.0, "foot": 2.0, "pelvis": 4.0}
"""Root mean square movement of skin, half of it common to the segment."""
CAMERA_MM = 1.0
FRAMES = 60


def walk(rng, placement_mm):
    """Return the true shifts θ and the measured markers of three strides.

    Args:
        rng: random generator.
        placement_mm: standard deviation of the markers' shifts from the model, mm.
    """
    leg = _MarkedLeg(LEG, SEGMENTS)
    theta = leg.prior * rng.standard_normal(leg.size)
    theta[: 3 * leg.markers] = placement_mm * MILLIMETRE * rng.standard_normal(3 * leg.markers)
    time = np.linspace(0.0, 3.0, FRAMES)  # strides
    phase = 2.0 * np.pi * time

    def periodic(size):
        harmonics = np.sin(phase[:, None] * [1, 2] + rng.uniform(0, 2 * np.pi, 2))
        return size * harmonics @ rng.standard_normal(2)

    q = np.tile(pin.neutral(leg.model), (FRAMES, 1))
    q[:, 12] = (32.0 - 28.0 * np.cos(phase)) * DEGREE
    q[:, 7:12] = leg.neutral[:5] + theta[-5:]
    q[:, 7:12] += np.column_stack([periodic(0.7 * one) for one in leg.scatter])
    for k, angle in enumerate(phase):
        sway, turn, swing = 2 * np.sin(angle), 5 * np.sin(angle + 1), -30 * np.sin(angle - 0.5) - 10
        shank = pin.rpy.rpyToMatrix(*(np.array([sway, turn, swing]) * DEGREE))
        q[k, :7] = pin.SE3ToXYZQUAT(pin.SE3(shank, np.array([1.2 * time[k], 0.1, 0.0])))
        for ball in leg.balls:
            at = leg.model.idx_qs[leg.joints[ball.name]]
            sizes = (5.0, 6.0, 25.0) if ball.name == "pelvis" else (4.0, 4.0, 14.0)
            angles = np.array(sizes) * np.sin(angle + np.array([2.0, 0.0, 0.5])) * DEGREE
            q[k, at : at + 4] = pin.Quaternion(pin.rpy.rpyToMatrix(*angles)).coeffs()
    x, _, rotations = leg.at_state(q, theta)
    for i, one in enumerate(leg.segments):
        common = np.column_stack([periodic(1.0) for _ in range(3)])
        for m in np.flatnonzero(leg.at == i):
            own = np.column_stack([periodic(1.0) for _ in range(3)])
            skin = SKIN_MM[one.name] * MILLIMETRE * np.sqrt(0.5) * (common + own)
            x[:, m] += np.einsum("fij,fj->fi", rotations[:, i], skin)
    x += CAMERA_MM * MILLIMETRE * rng.standard_normal(x.shape)
    return theta, {one.name: x[:, leg.at == i] for i, one in enumerate(leg.segments)}


def errors_of(placement_mm, seeds):
    """Return errors of shank and thigh markers (n, 6, 3), m, of hip centres (n, 3), and z values.

    A z value is an error over its stated deviation.
    """
    markers, hips, scores = [], [], []
    for seed in seeds:
        theta, measured = walk(np.random.default_rng(seed), placement_mm)
        found = register(LEG, SEGMENTS, {"walk": measured})
        labels = [label for one in SEGMENTS for label in one.points]
        shifts = np.array([found.shift(label, SEGMENTS) for label in labels])
        error = shifts - theta[: shifts.size].reshape(-1, 3)
        scores.append(error / np.array([found.deviation[label] for label in labels]))
        markers.append(error[:6])
        hips.append(found.joints["hip"][0] - theta[shifts.size + 3 : shifts.size + 6])
        assert found.knee_distance[1] < found.knee_distance[0]
    return np.array(markers), np.array(hips), np.array(scores)


def test_stated_deviations_contain_the_truth():
    """90 % of the positions lie within 1.645 deviations, for markers 15 mm from the model."""
    markers, hips, scores = errors_of(15.0, range(4))
    assert 0.82 < np.mean(np.abs(scores) < 1.645) < 0.98
    assert np.sqrt(np.mean(markers**2)) < 7.0 * MILLIMETRE
    assert np.sqrt(np.mean(np.sum(hips**2, axis=1))) < 10.0 * MILLIMETRE


def test_markers_that_hands_place_well_are_found_within_4_mm():
    markers, _, _ = errors_of(5.0, range(2))
    assert np.sqrt(np.mean(markers**2)) < 4.0 * MILLIMETRE


def test_the_search_is_at_a_minimum():
    """The derivative of the cost by θ is that of finite differences."""
    from tkamb.io.importing import registration

    theta, measured = walk(np.random.default_rng(1), 10.0)
    leg = _MarkedLeg(LEG, SEGMENTS)
    chosen = {name: points[:3] for name, points in measured.items()}
    q = leg.start(registration._rigid(leg.segments, chosen))
    target = np.concatenate([chosen[one.name] for one in leg.segments], axis=1)
    _, (*_, gradient) = registration._equations(leg, q, theta, target, leg.skin)
    step = 1e-6
    for i in (0, 20, leg.size - 8, leg.size - 1):
        ends = [theta.copy(), theta.copy()]
        ends[0][i], ends[1][i] = theta[i] - step, theta[i] + step
        low, high = (registration._equations(leg, q, e, target, leg.skin)[0] for e in ends)
        assert -(high - low) / (4 * step) == pytest.approx(gradient[i], rel=1e-4, abs=1e-3)


def test_a_marker_that_sits_elsewhere_in_another_trial_is_left_out_there():
    _, own = walk(np.random.default_rng(2), 5.0)
    other = {name: points.copy() for name, points in own.items()}
    other["thigh"][:, 2] += [0.0, 0.05, 0.05]
    assert moved_markers(SEGMENTS, own, other) == ["thigh2"]
    assert np.isnan(other["thigh"][:, 2]).all()
    assert np.isfinite(other["thigh"][:, :2]).all()


def test_a_trial_without_three_markers_of_the_thigh_is_refused():
    _, measured = walk(np.random.default_rng(3), 5.0)
    measured["thigh"][:, 0] = np.nan
    with pytest.raises(InputError, match="three markers of shank and of thigh"):
        register(LEG, SEGMENTS, {"walk": measured})


DM = Path(__file__).parents[2] / "shared" / "data" / "dm"


@pytest.mark.skipif(not DM.is_dir(), reason="subject DM is absent from ../shared/data")
def test_the_markers_of_dm_are_registered_without_a_standing_trial(tmp_path, capsys):
    """The model's markers misfit by 24 mm, and the knee centres lie 44 mm apart."""
    from tkamb.cli import _parser
    from tkamb.commands.import_model import import_request
    from tkamb.io.importing.patient import import_patient

    motion = DM / "motion"
    words = ["import", DM / "DM.osim", "--side", "right", "--mass-kg", 69.98]
    words += ["--trc", motion / "DM_ngait_og1_new.trc", "--grf", motion / "DM_ngait_og1_grf.sto"]
    words += ["--with", motion / "DM_ngait_og7_new.trc", "--out", tmp_path]
    patient = import_patient(import_request(_parser().parse_args(map(str, words))), tmp_path)
    found = patient.registration
    assert "R_Thigh_Lateral sits elsewhere in DM_ngait_og7_new.trc" in "\n".join(patient.report)
    before, after = (found.rms(found.residuals[k]) / MILLIMETRE for k in ("before", "after"))
    assert before > 20.0 and after < 8.0
    assert found.knee_distance[0] > 40 * MILLIMETRE and found.knee_distance[1] < 15 * MILLIMETRE
    assert found.frames <= REGISTRATION.max_frames + 2
    assert patient.scene.uncertainty["knee_centre_mm"] > 0.0
    assert "[uncertainty]\nknee_centre_mm" in patient.scene.text()
