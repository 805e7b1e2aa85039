"""Recordings with wrong signs raise a question; correct recordings raise none."""

import csv
import shutil
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from mistakes import DATA, DM
from scenes import MODEL, as_toml
from tkamb.errors import InputError
from tkamb.io.recordings.filtering import OddSample
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.ligaments import check_collateral_sides
from tkamb.run.plausibility.ground import direction_questions, foot_questions, load_questions
from tkamb.run.plausibility.movement import motion_questions, sample_questions, sign_questions
from tkamb.show.scene_check import check_scene

needs_dm = pytest.mark.skipif(not DATA.is_dir(), reason="subject DM's files are not there")


@pytest.fixture
def knee(tmp_path):
    """Return the shipped scene in a folder of its own."""
    folder = tmp_path / "knee"
    shutil.copytree(MODEL, folder)
    return folder / "scene.toml"


def turn(path, column):
    """Change the sign of a column of a CSV."""
    rows = list(csv.reader(path.open()))
    k = rows[0].index(column)
    for row in rows[1:]:
        row[k] = repr(-float(row[k]))
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def signs_of(scene, **overrides):
    return [question.text for question in sign_questions(load_case(load_scene(scene, overrides)))]


@pytest.mark.parametrize(
    ("column", "words"),
    [
        ("ap_mm", "with the sign of AP turned"),
        ("axial_rotation_deg", "the sign of axial rotation, or of adduction, turned"),
        ("adduction_deg", "the sign of axial rotation, or of adduction, turned"),
    ],
)
def test_a_turned_sign_of_the_shipped_knee_is_asked_about(knee, column, words):
    assert signs_of(knee) == []
    turn(knee.parent / "motion.csv", column)
    questions = signs_of(knee)
    assert len(questions) == 1 and words in questions[0]
    role = column.rsplit("_", 1)[0]
    assert signs_of(knee, **{"motion.signs_turned": [role]}) == []


def test_released_coordinates_raise_no_question_of_sign(knee):
    turn(knee.parent / "motion.csv", "ap_mm")
    turn(knee.parent / "motion.csv", "axial_rotation_deg")
    released = {"contact.released": ["ap", "axial_rotation", "adduction", "ml"]}
    assert signs_of(knee, **released) == []


@needs_dm
@pytest.mark.parametrize("scene", ["scene.toml", "mirrored.toml"])
def test_both_scenes_of_dm_raise_no_question_of_sign(scene):
    assert signs_of(DM / scene) == []


@needs_dm
@pytest.mark.parametrize(
    ("scene", "role"),
    [
        ("scene.toml", "rotation_1"),
        ("scene.toml", "rotation_2"),
        pytest.param("mirrored.toml", "rotation_1", marks=pytest.mark.slow),
        pytest.param("mirrored.toml", "rotation_2", marks=pytest.mark.slow),
    ],
)
def test_one_turned_rotation_of_dm_is_asked_about(scene, role):
    path = DM / scene
    before = load_scene(path).motion.signs_turned
    turned = sorted({*before} ^ {role})
    assert len(signs_of(path, **{"motion.signs_turned": turned})) == 1


@pytest.mark.parametrize("scale", [1.0, 0.9, 0.6])
def test_negative_flexion_is_refused_with_the_key_to_set(knee, scale):
    rows = list(csv.reader((knee.parent / "motion.csv").open()))
    k = rows[0].index("flexion_deg")
    for row in rows[1:]:
        row[k] = repr(-scale * float(row[k]))
    with (knee.parent / "motion.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    with pytest.raises(InputError) as error:
        load_case(load_scene(knee))
    assert 'signs_turned = ["flexion"]' in str(error.value)
    load_case(load_scene(knee, {"motion.signs_turned": ["flexion"]}))


@needs_dm
def test_a_pose_with_negative_flexion_is_refused_with_its_rotation():
    with pytest.raises(InputError) as error:
        load_case(load_scene(DM / "scene.toml", {"motion.signs_turned": ["rotation_3"]}))
    assert 'signs_turned = ["rotation_3"]' in str(error.value)


def test_too_much_flexion_is_refused_without_naming_the_sign(knee):
    rows = list(csv.reader((knee.parent / "motion.csv").open()))
    k = rows[0].index("flexion_deg")
    for row in rows[1:]:
        row[k] = repr(2.0 * float(row[k]))
    with (knee.parent / "motion.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    with pytest.raises(InputError) as error:
        load_case(load_scene(knee))
    assert "signs_turned" not in str(error.value)


def test_a_missing_ground_reaction_is_asked_about(knee):
    text = knee.read_text()
    ground = slice(text.index("[ground_reaction]"), text.index("[implant.femoral]"))
    knee.write_text(text[: ground.start] + text[ground.stop :])
    questions = check_scene(knee, {}, lambda name: None).questions
    assert any("[ground_reaction] missing" in str(question) for question in questions)


def mirrored_force(case):
    """Mirror the sideways force of a case's ground reaction."""
    case.ground.force[:, 2] *= -1.0
    return case


@needs_dm
@pytest.mark.parametrize("applied", ["cop", "ankle"])
def test_a_mirrored_sideways_force_is_asked_about(applied):
    case = load_case(load_scene(DM / "scene.toml", {"ground_reaction.applied": applied}))
    assert not [q for q in direction_questions(case) if "outwards" in q.text]
    questions = [q.text for q in direction_questions(mirrored_force(case))]
    assert any("pushes the leg outwards" in text for text in questions)


@pytest.mark.parametrize(("share", "expected"), [(0.05, True), (0.025, True), (0.01, False)])
def test_how_far_outwards_a_force_may_point(knee, share, expected):
    """The sideways share of subject JW's stairs, 0.007, is below the limit."""
    case = load_case(load_scene(knee))
    case.ground.force[:, 2] = share * case.ground.force[:, 1]
    assert bool([q for q in direction_questions(case) if "outwards" in q.text]) is expected
    assert not list(load_questions(case))


def test_the_shipped_knee_raises_no_question(knee):
    assert not check_scene(knee, {}, lambda name: None).questions


def with_ligaments(scene, change):
    """Write the scene with [[ligament]] tables changed in place."""
    content = tomllib.loads(scene.read_text())
    change(content)
    scene.write_text(as_toml(content))


def mirror_ligaments(content):
    for bundle in content["ligament"]:
        for end in ("proximal", "distal"):
            bundle[end]["point_mm"][2] *= -1.0


def one_end(content):
    content["ligament"][0]["distal"]["point_mm"][2] *= -1.0


def renamed(content):
    content["ligament"][3]["name"] = "tibial_collateral_ligament"


@pytest.mark.parametrize("change", [mirror_ligaments, one_end, renamed])
def test_a_collateral_ligament_on_the_wrong_side_is_refused(knee, change):
    load_case(load_scene(knee))
    with_ligaments(knee, change)
    with pytest.raises(InputError, match="side of this right knee"):
        load_case(load_scene(knee))


@pytest.fixture(scope="module")
def bundles():
    case = load_case(load_scene(MODEL / "scene.toml"))
    return case.ligaments, case.chain


@pytest.mark.parametrize(
    ("name", "sign"),
    [
        ("MCL", -1),
        ("sMCL_2", -1),
        ("dMCL", -1),
        ("Medial Collateral", -1),
        ("LCL", 1),
        ("popLCL", 0),
        ("FCL3", 1),
        ("lateral-collateral", 1),
        ("collateral_medial", -1),
        ("MPFL", -1),
        ("medial_patellofemoral", -1),
        ("medial retinaculum", -1),
        ("LPFL_2", 1),
        ("retinaculum_lateral", 1),
        ("ITB", 1),
        ("iliotibial_band", 1),
        ("patellar_tendon", 0),
        ("tibiofibular", 0),
        ("PCLal9", 0),
        ("PCL_posteromedial", 0),
        ("ACL", 0),
        ("PFL", 0),
        ("ALL", 0),
        ("pCAP", 0),
    ],
)
def test_the_side_of_a_ligament_follows_from_its_name(bundles, name, sign):
    ligaments, chain = bundles
    medial, lateral = (next(b for b in ligaments if b.name == n) for n in ("MCL_deep", "LCL"))
    for bundle, bundle_side in ((medial, -1), (lateral, 1)):
        named = [replace(bundle, name=name)]
        if sign in (0, bundle_side):
            check_collateral_sides(named, chain, "right")
        else:
            with pytest.raises(InputError):
                check_collateral_sides(named, chain, "right")


def test_a_length_unit_or_a_clock_that_cannot_be_is_asked_about(knee):
    """Translations a thousand times too small, and a clock in per cent, each raise a question."""
    case = load_case(load_scene(knee))
    assert not list(motion_questions(case))
    coordinates = case.motion.coordinates.copy()
    coordinates[:, :3] = coordinates[0, :3] + 1e-3 * (coordinates[:, :3] - coordinates[0, :3])
    small = replace(case, motion=replace(case.motion, coordinates=coordinates))
    assert any("length_unit" in question.text for question in motion_questions(small))
    coordinates = coordinates.copy()
    coordinates[:, :3] = coordinates[0, :3]  # Constant coordinates are not recorded ones.
    fixed = replace(case, motion=replace(case.motion, coordinates=coordinates))
    assert not list(motion_questions(fixed))
    per_cent = replace(case, motion=replace(case.motion, time=25.0 * case.motion.time))
    assert any("per cent of a cycle" in question.text for question in motion_questions(per_cent))


def test_a_centre_of_pressure_behind_the_ankle_is_asked_about(knee):
    turn(knee.parent / "ground_reaction.csv", "point_x_mm")
    questions = [question.text for question in foot_questions(load_case(load_scene(knee)))]
    assert any("behind the ankle, not under" in text for text in questions)


@pytest.mark.parametrize(("cutoff", "expected"), [(6.0, False), ("none", True)])
def test_a_spike_that_the_filter_makes_small_is_not_asked_about(knee, cutoff, expected):
    """One wrong sample at 1200 Hz has no effect after a low-pass filter at 6 Hz."""
    time = np.arange(0.0, 4.0, 1 / 1200)
    force = 400.0 + 10.0 * np.sin(time)
    force[2400] -= 80.0
    rows = [[t, 0.0, f, 0.0, 40.0, 0.0, 0.0] for t, f in zip(time, force, strict=True)]
    path = knee.parent / "ground_reaction.csv"
    header = path.read_text().splitlines()[0]
    path.write_text("\n".join([header, *(",".join(map(repr, map(float, r))) for r in rows)]) + "\n")
    case = load_case(load_scene(knee, {"ground_reaction.cutoff_Hz": cutoff}))
    assert bool(case.ground.odd) is expected


@pytest.mark.parametrize(("distance", "expected"), [(0.15, True), (0.3, False)])
def test_a_spike_far_from_every_frame_is_not_asked_about(knee, distance, expected):
    case = load_case(load_scene(knee))
    last = float(case.motion.time[-1])
    odd = (OddSample(knee, "flexion", last + distance, 5.0, "deg"),)
    case = replace(case, motion=replace(case.motion, odd=odd))
    assert bool(list(sample_questions(case))) is expected
