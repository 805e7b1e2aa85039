"""Correlated inputs, and the effect of markers, placement and muscles in a sample."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from knees import UP, bent_knee
from shared_trials import STRENGTHS, two_flexors
from test_uncertainty import SCENE, bodies_alone, knee
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, MIRROR, knee_pose, transform
from tkamb.io.recordings.recording_tables import MarkersTable
from tkamb.io.scene.case import load_case
from tkamb.io.scene.uncertainty import CorrelationTable
from tkamb.knee.load import PointForces
from tkamb.run.muscles.shared_muscles import SharedMuscles
from tkamb.run.read_scene import recording_of
from tkamb.studies.uncertainty.bands import influences
from tkamb.studies.uncertainty.inputs import (
    AXES,
    Draw,
    Point,
    VariedInput,
    correlation_root,
    normal_samples,
    one_at_a_time,
    varied_inputs,
)
from tkamb.studies.uncertainty.run import estimate_uncertainty
from tkamb.studies.uncertainty.sample import (
    Sampler,
    displaced_by_markers,
    varied_case,
    varied_muscles,
)

NAMES = ["a", "b", "c"]


def table(first, second, coefficient):
    return CorrelationTable(between=(first, second), coefficient=coefficient)


@pytest.mark.parametrize(
    "pairs",
    [
        [("a", "c", 0.6), ("b", "c", -0.5)],
        [("b", "a", 1.0), ("a", "c", 0.3), ("b", "c", 0.3)],  # singular
        [],
    ],
)
def test_a_linear_map_of_correlated_inputs_has_the_known_variance(pairs):
    slopes, count = np.array([3.0, -2.0, 1.0]), 4096
    matrix = np.eye(3)
    for first, second, coefficient in pairs:
        i, j = NAMES.index(first), NAMES.index(second)
        matrix[i, j] = matrix[j, i] = coefficient
    root = correlation_root([table(*pair) for pair in pairs], NAMES)
    np.testing.assert_allclose(root @ root.T, matrix, atol=1e-12)
    assert not np.triu(root, 1).any()
    x = normal_samples("sobol", count, 3, seed=2) @ root.T
    np.testing.assert_allclose(x.std(axis=0), 1.0, rtol=0.01)
    variance = slopes @ matrix @ slopes
    assert (x @ slopes).var() == pytest.approx(variance, rel=3 * np.sqrt(2 / count))
    rows = influences(["y"], NAMES, (x @ slopes)[:, None, None], x[:, None, :])
    shares = {row.name: row.share for row in rows}
    assert sum(shares[name] for name in NAMES) == pytest.approx(1.0, abs=1e-6)
    if pairs and abs(np.linalg.det(matrix)) > 1e-9:  # slopes need a regular matrix
        for name, expected in zip(NAMES, slopes * (matrix @ slopes) / variance, strict=True):
            assert shares[name] == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ([("a", "b", 0.9), ("a", "c", 0.9), ("b", "c", -0.9)], "not give a correlation matrix"),
        ([("a", "d", 0.5)], "'d' does not vary"),
        ([("a", "b", 0.5), ("b", "a", 0.4)], "has 'b' and 'a' twice"),
    ],
)
def test_an_impossible_correlation_is_refused(pairs, words):
    with pytest.raises(InputError, match=words):
        correlation_root([table(*pair) for pair in pairs], NAMES)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ('[{between=["ap","ap"],coefficient=0.5}]', "names 'ap' twice"),
        ('[{between=["ap","ml"],coefficient=1.5}]', "less than or equal to 1"),
        ('[{between=["ap","dome.ml"],coefficient=0.5}]', "'dome.ml' does not vary"),
        ('[{between=["ap","ml"],coefficient=0.5}]', "independent inputs"),
    ],
)
def test_an_invalid_correlation_is_an_error_of_one_line(value, words, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--set", f"uncertainty.correlation={value}", "--out", str(out), "--indices"]
    assert main(["uncertainty", str(SCENE), "--samples", "20", *options]) == 2
    message = capsys.readouterr().err.strip()
    assert words in message and "\n" not in message
    assert not out.exists()


def test_offset_and_noise_of_poses_are_correlated_but_not_in_a_screening():
    pair = [{"between": ["ap", "flexion"], "coefficient": -0.8}]
    scene = bodies_alone(uncertainty__correlation=pair)
    sampler = Sampler(scene, range(0, 101, 25), ["force_total_N"])
    names = [row.name for row in sampler.inputs]
    ap, flexion = names.index("ap"), names.index("flexion")
    normal = normal_samples("lhs", 1024, len(names), seed=1)
    draws = [sampler.draw(Point.of(n, row)) for n, row in enumerate(normal)]
    offset = np.array([draw.normal for draw in draws])
    noise = np.array([draw.noise for draw in draws])
    assert np.corrcoef(offset[:, ap], offset[:, flexion])[0, 1] == pytest.approx(-0.8, abs=0.05)
    for k in (0, 4):
        correlation = np.corrcoef(noise[:, k, ap], noise[:, k, flexion])[0, 1]
        assert correlation == pytest.approx(-0.8, abs=0.05)
    alone = sampler.draw(one_at_a_time(len(names))[2 * ap + 2]).standardised()
    np.testing.assert_array_equal(alone, np.tile(np.eye(len(names))[ap], (len(alone), 1)))


def errors_of(case, **values):
    """Return a draw with the given errors, mm or deg."""
    inputs = tuple(
        VariedInput(name.replace("__", "."), 1.0, (name.endswith("__about_ap") and "deg") or "mm")
        for name in values
    )
    frames = len(case.motion.time)
    return Draw(inputs, np.array(list(values.values())), np.zeros((frames, 0)), 1.0)


def test_an_error_of_the_knee_centre_equals_an_opposite_shift_of_the_ground_reaction():
    case = load_case(bodies_alone())
    errors = {"knee_centre__ap": 20.0, "knee_centre__si": -7.0, "knee_centre__ml": 5.0}
    sample = varied_case(case, errors_of(case, **errors))
    shift = case.tibia.pose[:, :3, :3] @ (1e-3 * np.array(list(errors.values())))
    opposite = replace(case, ground=replace(case.ground, point=case.ground.point - shift))
    for k in (10, 60):
        loads, expected = (recording_of(variant).loads(k).loads for variant in (sample, opposite))
        assert loads.values == pytest.approx(expected.values, rel=1e-9, abs=1e-8)
        assert (
            abs(loads.external_flexion - recording_of(case).loads(k).loads.external_flexion) > 5.0
        )


def test_an_error_of_the_insert_orientation_rotates_the_insert_frame():
    case = load_case(bodies_alone())
    sample = varied_case(case, errors_of(case, insert_placement__about_ap=2.0))
    rotation = case.chain.insert_in_tibia[:3, :3].T @ sample.chain.insert_in_tibia[:3, :3]
    angle = np.deg2rad(2.0)
    c, s = np.cos(angle), np.sin(angle)
    np.testing.assert_allclose(rotation, [[1, 0, 0], [0, c, -s], [0, s, c]], atol=1e-12)
    np.testing.assert_allclose(
        sample.chain.insert_in_tibia[:3, 3], case.chain.insert_in_tibia[:3, 3], atol=1e-15
    )


@pytest.mark.parametrize("side", ["right", "left"])
def test_rigidly_displaced_markers_move_their_segment(side):
    """A rotation of all thigh markers about the flexion axis changes flexion alone."""
    case, angle = load_case(bodies_alone()), np.deg2rad(1.5)
    corners = np.array(list(product([-20.0, 30.0], [-150.0, 100.0], [-40.0, 35.0])))
    labels = [f"m{i}" for i in range(len(corners))]
    markers = dict(zip(labels, corners.tolist(), strict=True))
    points = corners @ MIRROR if side == "left" else corners
    bend = np.zeros(6)
    bend[5] = angle
    shift = transform(knee_pose(bend), points) - points  # mm, in the femoral frame
    segments = [{"name": "shank", "markers_mm": {f"s{k}": v for k, v in markers.items()}}]
    segments.append({"name": "thigh", "markers_mm": markers})
    table = MarkersTable(
        method="segments",
        coordinates=KNEE_COORDINATES,
        neutral_mm=(0.0, 0.0, 0.0),
        segment=segments,
    )
    scene = case.scene.model_copy(
        update={
            "motion": case.scene.motion.model_copy(update={"markers": table}),
            "patient": case.scene.patient.model_copy(update={"side": side}),
        }
    )
    marked = replace(case, scene=scene)
    values = {
        f"marker__{label}__{axis}": shift[i, j]
        for i, label in enumerate(labels)
        for j, axis in enumerate(AXES)
    }
    tibia, coordinates = displaced_by_markers(marked, errors_of(marked, **values))
    np.testing.assert_allclose(tibia.pose, case.tibia.pose, atol=1e-12)
    change = coordinates - case.motion.coordinates
    np.testing.assert_allclose(change, np.tile(bend, (len(change), 1)), atol=1e-12)
    all_values = values | {name.replace("marker__", "marker__s"): v for name, v in values.items()}
    tibia, _ = displaced_by_markers(marked, errors_of(marked, **all_values))
    np.testing.assert_allclose(tibia.pose, case.tibia.pose @ knee_pose(bend), atol=1e-12)


def test_varied_muscles_equal_a_trial_with_changed_muscles():
    knee_now = replace(
        bent_knee(), ground=PointForces("tibia", np.array([[0.06, -0.45, 0.0]]), 700 * UP[None])
    )
    groups = {"flexors": ("hamstring", "gastrocnemius"), "extensors": ("quadriceps",)}
    trial = replace(two_flexors(1), groups=groups)
    deviation, shift = 0.3, 4e-3
    inputs = (
        VariedInput("muscle_strength.flexors", deviation, "relative"),
        VariedInput("muscle_attachment.flexors.shank.ap", 1.0, "mm"),
    )
    draw = Draw(inputs, np.array([1.0, 4.0]), np.zeros((1, 0)), 1.0)
    factor = draw.factor("muscle_strength.flexors")
    varied = varied_muscles(SharedMuscles(trial), draw).frame(0).share(knee_now, 0.05, frozenset())
    strengths = (STRENGTHS[0], factor * STRENGTHS[1], factor * STRENGTHS[2])
    expected_trial = two_flexors(1, strengths=strengths)
    expected_trial = replace(
        expected_trial, shank=expected_trial.shank + np.array([shift, 0.0, 0.0])
    )
    expected = SharedMuscles(expected_trial).frame(0).share(knee_now, 0.05, frozenset())
    np.testing.assert_allclose(varied.force, expected.force, rtol=1e-9)
    nominal = SharedMuscles(trial).frame(0).share(knee_now, 0.05, frozenset())
    assert np.abs(varied.force - nominal.force).max() > 1.0
    assert varied_muscles(None, draw) is None


@pytest.mark.slow
def test_each_input_changes_a_result_of_the_shipped_knee():
    """An input with a misspelt name would change no result."""
    deviations = {
        "ground_reaction": 0.05, "segment_mass": 0.1, "ligament_stiffness": 0.3,
        "ligament_strain": 0.02, "young_modulus": 0.1, "yield_stress": 0.1,
        "femoral_placement_mm": 1.0, "insert_placement_mm": 1.0, "insert_placement_deg": 1.0,
        "tuberosity_mm": 3.0, "dome_mm": 1.0, "knee_centre_mm": 5.0, "muscle_attachment_mm": 5.0,
    }  # fmt: skip
    table = {f"uncertainty__{name}": value for name, value in deviations.items()}
    scene = knee(**table, output__yield_stress_MPa=10.0)
    bundles = [bundle.name for bundle in scene.ligament]
    names = ["force_total_N", "medial_force_N", "quadriceps_N", "lateral_area_above_yield"]
    names += ["medial_peak_pressure_MPa", "patellofemoral_N"]
    sampler = Sampler(scene, range(60, 61), names + [f"ligament_{name}_N" for name in bundles])
    points = one_at_a_time(len(sampler.inputs))
    nominal = sampler(0, points[0]).values
    slack = {
        name for name, force in zip(bundles, nominal[len(names) :], strict=True) if force == 0.0
    }
    for varied, point in zip(sampler.inputs, points[2::2], strict=True):
        # a whole standard deviation may leave the frame without equilibrium
        values = sampler(1, Point(0.2 * point.normal, None)).values
        # the tendon wraps, so its origin may have no effect
        at_origin = varied.name.startswith("muscle_attachment.quadriceps.origin")
        if varied.name.partition(".")[2] not in slack and not at_origin:
            assert np.abs(values - nominal).max() > 1e-9, varied.name


def test_correlated_inputs_of_opposite_effect_give_a_narrow_band():
    pair = [{"between": ["centre_of_pressure_ap", "knee_centre.ap"], "coefficient": 0.99}]
    names = ("ap", "si", "ml", "axial_rotation", "adduction", "flexion")
    constant = {f"uncertainty__{n}_{'mm' if n in AXES else 'deg'}": 0.0 for n in names}
    others = ("centre_of_pressure_ml_mm", "ground_reaction", "segment_mass", "insert_placement_mm")
    others += ("ligament_stiffness", "ligament_strain", "femoral_placement_mm")
    constant |= dict.fromkeys((f"uncertainty__{n}" for n in others), 0.0)
    constant |= {"uncertainty__insert_placement_deg": 0.0, "uncertainty__knee_centre_mm": 3.0}
    widths = []
    for correlation in ([], pair):
        scene = bodies_alone(**constant, uncertainty__correlation=correlation)
        analysis = estimate_uncertainty(scene, samples=64, frames=slice(60, 61))
        name = "external_flexion_moment_Nm"
        widths.append(float(analysis.bands[f"{name}_p95"][0] - analysis.bands[f"{name}_p05"][0]))
        assert len(analysis.inputs) == len(varied_inputs(load_case(scene)))
    assert widths[1] < 0.35 * widths[0]
