"""Inputs that err together, and what markers, placement and muscles do in a sample."""

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
from tkamb.run.read_scene import mechanics_of
from tkamb.studies.uncertainty.bands import influences
from tkamb.studies.uncertainty.inputs import AXES, Draw, VariedInput, varied_inputs
from tkamb.studies.uncertainty.run import estimate_uncertainty
from tkamb.studies.uncertainty.sample import (
    Sampler,
    displaced_by_markers,
    varied_case,
    varied_muscles,
)
from tkamb.studies.uncertainty.sampling import (
    Point,
    correlation_root,
    normal_samples,
    one_at_a_time,
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
def test_a_linear_map_of_correlated_inputs_has_the_variance_of_their_matrix(pairs):
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
    found = influences(["y"], NAMES, (x @ slopes)[:, None, None], x[:, None, :])
    shares = {one.name: one.share for one in found}
    assert sum(shares[name] for name in NAMES) == pytest.approx(1.0, abs=1e-6)
    if pairs and abs(np.linalg.det(matrix)) > 1e-9:  # one that is singular has no slopes
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
def test_what_is_no_correlation_is_refused(pairs, words):
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
def test_a_bad_correlation_is_one_line_and_nothing_is_written(value, words, tmp_path, capsys):
    out = tmp_path / "out"
    more = ["--set", f"uncertainty.correlation={value}", "--out", str(out), "--indices"]
    assert main(["uncertainty", str(SCENE), "--samples", "20", *more]) == 2
    message = capsys.readouterr().err.strip()
    assert words in message and "\n" not in message
    assert not out.exists()


def test_poses_err_together_in_offset_and_noise_and_a_screening_moves_one_alone():
    pair = [{"between": ["ap", "flexion"], "coefficient": -0.8}]
    scene = bodies_alone(uncertainty__correlation=pair)
    sampler = Sampler(scene, range(0, 101, 25), ["force_total_N"])
    names = [one.name for one in sampler.inputs]
    ap, flexion = names.index("ap"), names.index("flexion")
    normal = normal_samples("lhs", 1024, len(names), seed=1)
    draws = [sampler.draw(Point.of(n, one)) for n, one in enumerate(normal)]
    offset = np.array([draw.normal for draw in draws])
    noise = np.array([draw.noise for draw in draws])
    assert np.corrcoef(offset[:, ap], offset[:, flexion])[0, 1] == pytest.approx(-0.8, abs=0.05)
    for k in (0, 4):
        found = np.corrcoef(noise[:, k, ap], noise[:, k, flexion])[0, 1]
        assert found == pytest.approx(-0.8, abs=0.05)
    alone = sampler.draw(one_at_a_time(len(names))[2 * ap + 2]).standardised()
    np.testing.assert_array_equal(alone, np.tile(np.eye(len(names))[ap], (len(alone), 1)))


def errors_of(case, **values):
    """Return a draw with these errors, in the inputs' units, of inputs that err by one each."""
    inputs = tuple(
        VariedInput(name.replace("__", "."), 1.0, (name.endswith("__about_ap") and "deg") or "mm")
        for name in values
    )
    frames = len(case.motion.time)
    return Draw(inputs, np.array(list(values.values())), np.zeros((frames, 0)), 1.0)


def test_a_knee_centre_that_is_off_is_a_ground_reaction_that_is_off_the_other_way():
    case = load_case(bodies_alone())
    off = {"knee_centre__ap": 20.0, "knee_centre__si": -7.0, "knee_centre__ml": 5.0}
    moved = varied_case(case, errors_of(case, **off))
    away = case.tibia.pose[:, :3, :3] @ (1e-3 * np.array(list(off.values())))
    other = replace(case, ground=replace(case.ground, point=case.ground.point - away))
    for k in (10, 60):
        found, expected = (mechanics_of(one).frame(k).loads for one in (moved, other))
        assert found.values == pytest.approx(expected.values, rel=1e-9, abs=1e-8)
        assert (
            abs(found.external_flexion - mechanics_of(case).frame(k).loads.external_flexion) > 5.0
        )


def test_an_insert_that_is_turned_turns_the_femur_with_it():
    case = load_case(bodies_alone())
    moved = varied_case(case, errors_of(case, insert_placement__about_ap=2.0))
    turn = case.chain.insert_in_tibia[:3, :3].T @ moved.chain.insert_in_tibia[:3, :3]
    angle = np.deg2rad(2.0)
    c, s = np.cos(angle), np.sin(angle)
    np.testing.assert_allclose(turn, [[1, 0, 0], [0, c, -s], [0, s, c]], atol=1e-12)
    np.testing.assert_allclose(
        moved.chain.insert_in_tibia[:3, 3], case.chain.insert_in_tibia[:3, 3], atol=1e-15
    )


@pytest.mark.parametrize("side", ["right", "left"])
def test_markers_that_move_with_a_segment_move_it_and_the_knee(side):
    """All markers of the thigh turned about the knee's axis: so much more flexion, and no else."""
    case, angle = load_case(bodies_alone()), np.deg2rad(1.5)
    corners = np.array(list(product([-20.0, 30.0], [-150.0, 100.0], [-40.0, 35.0])))
    labels = [f"m{i}" for i in range(len(corners))]
    markers = dict(zip(labels, corners.tolist(), strict=True))
    own = corners @ MIRROR if side == "left" else corners
    bend = np.zeros(6)
    bend[5] = angle
    shift = transform(knee_pose(bend), own) - own  # in the femur's axes, mm
    segments = [{"name": "shank", "markers_mm": {f"s{k}": v for k, v in markers.items()}}]
    segments.append({"name": "thigh", "markers_mm": markers})
    read = MarkersTable(
        method="segments",
        coordinates=KNEE_COORDINATES,
        neutral_mm=(0.0, 0.0, 0.0),
        segment=segments,
    )
    scene = case.scene.model_copy(
        update={
            "motion": case.scene.motion.model_copy(update={"markers": read}),
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
    both = values | {name.replace("marker__", "marker__s"): v for name, v in values.items()}
    tibia, _ = displaced_by_markers(marked, errors_of(marked, **both))
    np.testing.assert_allclose(tibia.pose, case.tibia.pose @ knee_pose(bend), atol=1e-12)


def test_muscles_of_another_strength_and_place_are_those_of_a_trial_made_so():
    knee_now = replace(
        bent_knee(), ground=PointForces("tibia", np.array([[0.06, -0.45, 0.0]]), 700 * UP[None])
    )
    groups = {"flexors": ("hamstring", "gastrocnemius"), "extensors": ("quadriceps",)}
    trial = replace(two_flexors(1), groups=groups)
    deviation, away = 0.3, 4e-3
    inputs = (
        VariedInput("muscle_strength.flexors", deviation, "relative"),
        VariedInput("muscle_attachment.flexors.shank.ap", 1.0, "mm"),
    )
    draw = Draw(inputs, np.array([1.0, 4.0]), np.zeros((1, 0)), 1.0)
    factor = draw.factor("muscle_strength.flexors")
    found = varied_muscles(SharedMuscles(trial), draw).frame(0).share(knee_now, 0.05, frozenset())
    strengths = (STRENGTHS[0], factor * STRENGTHS[1], factor * STRENGTHS[2])
    by_hand = two_flexors(1, strengths=strengths)
    by_hand = replace(by_hand, shank=by_hand.shank + np.array([away, 0.0, 0.0]))
    expected = SharedMuscles(by_hand).frame(0).share(knee_now, 0.05, frozenset())
    np.testing.assert_allclose(found.force, expected.force, rtol=1e-9)
    before = SharedMuscles(trial).frame(0).share(knee_now, 0.05, frozenset())
    assert np.abs(found.force - before.force).max() > 1.0
    assert varied_muscles(None, draw) is None


@pytest.mark.slow
def test_each_input_that_the_knee_has_moves_it():
    """Of the shipped knee at one frame: a name that nothing reads would change nothing."""
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
    sampler = Sampler(scene, range(60, 61), names + [f"ligament_{one}_N" for one in bundles])
    points = one_at_a_time(len(sampler.inputs))
    still = sampler(0, points[0]).values
    slack = {one for one, force in zip(bundles, still[len(names) :], strict=True) if force == 0.0}
    for one, point in zip(sampler.inputs, points[2::2], strict=True):
        changed = sampler(1, Point(0.2 * point.normal, None)).values  # a whole one may not fit
        wrapped = one.name.startswith(
            "muscle_attachment.quadriceps.origin"
        )  # off the bone below it
        if one.name.partition(".")[2] not in slack and not wrapped:
            assert np.abs(changed - still).max() > 1e-9, one.name


def test_a_band_of_inputs_that_cancel_is_narrow():
    """Two offsets that always err against each other in a sum of their effects."""
    pair = [{"between": ["centre_of_pressure_ap", "knee_centre.ap"], "coefficient": 0.99}]
    names = ("ap", "si", "ml", "axial_rotation", "adduction", "flexion")
    still = {f"uncertainty__{n}_{'mm' if n in AXES else 'deg'}": 0.0 for n in names}
    others = ("centre_of_pressure_ml_mm", "ground_reaction", "segment_mass", "insert_placement_mm")
    others += ("ligament_stiffness", "ligament_strain", "femoral_placement_mm")
    still |= dict.fromkeys((f"uncertainty__{n}" for n in others), 0.0)
    still |= {"uncertainty__insert_placement_deg": 0.0, "uncertainty__knee_centre_mm": 3.0}
    widths = []
    for together in ([], pair):
        scene = bodies_alone(**still, uncertainty__correlation=together)
        found = estimate_uncertainty(scene, samples=64, frames=slice(60, 61))
        name = "external_flexion_moment_Nm"
        widths.append(float(found.bands[f"{name}_p95"][0] - found.bands[f"{name}_p05"][0]))
        assert len(found.inputs) == len(varied_inputs(load_case(scene)))
    assert widths[1] < 0.35 * widths[0]
