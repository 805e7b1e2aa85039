"""The scene: overrides, what belongs together, and the page that documents it."""

import ast
import json
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import Field

from scenes import MODEL, write_scene
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, MIRROR, transform
from tkamb.io.recordings import recording_tables
from tkamb.io.recordings.meshes import load_surface
from tkamb.io.recordings.recording_tables import SceneTable
from tkamb.io.recordings.tibia import load_tibia
from tkamb.io.scene import scene as scene_module
from tkamb.io.scene import tables
from tkamb.io.scene.case import load_case
from tkamb.io.scene.parts import read_patellar_ligament
from tkamb.io.scene.scene import load_scene

ROOT = Path(__file__).parents[1]


def test_the_page_is_what_the_schema_says():
    page = runpy.run_path(str(ROOT / "scripts" / "make" / "scene_page"))["page"]()
    assert (ROOT / "docs" / "scene.md").read_text(encoding="utf-8") == page, (
        "run scripts/make/scene_page"
    )


def test_schema_is_printed_as_json(capsys):
    assert main(["scene", "--schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert set(schema["required"]) == {"patient", "motion"}
    assert schema["additionalProperties"] is False


def test_paths_are_relative_to_the_file(tmp_path):
    scene = load_scene(write_scene(tmp_path))
    assert scene.motion.file == tmp_path / "motion.csv"
    assert scene.implant.insert.mesh == tmp_path / "insert.stl"


def test_a_case_with_muscles_has_the_pose_of_the_inserts_mesh_without_contact():
    """Without contact, [muscles] reads the insert only for the pose of its mesh."""
    scene = load_scene(MODEL / "scene.toml")
    with_contact = load_case(scene)
    muscles = {"contact": None, "muscles": SimpleNamespace(emg=None)}
    with_muscles, without_both = (
        load_case(scene.model_copy(update=u)) for u in (muscles, {"contact": None})
    )
    assert (
        with_muscles.insert is None
        and without_both.insert is None
        and without_both.insert_placement is None
    )
    np.testing.assert_array_equal(with_muscles.insert_placement, with_contact.insert_placement)
    bottom = load_surface(scene.implant.insert.mesh, "mm", name="insert").vertices
    lowest = transform(with_muscles.insert_placement, bottom)[:, 1].min()
    assert lowest == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("ligament.0.slack_length_mm", "'ligament' is a list: .*; change it in the scene file"),
        ("contact.model.name", "'contact.model' has no keys; `tkamb scene --schema` lists"),
    ],
)
def test_an_override_below_a_list_or_a_value_is_refused_by_name(capsys, key, words):
    with pytest.raises(InputError, match=words):
        load_scene(MODEL / "scene.toml", {key: 1.0})
    assert main(["check", str(MODEL / "scene.toml"), "--set", f"{key}="]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"tkamb: --set {key}: ")


def test_an_override_wins_and_may_make_a_table(tmp_path):
    path = write_scene(tmp_path, ("contact",))
    scene = load_scene(path, {"contact.model": "hertz", "patient.mass_kg": 80})
    assert scene.contact.model == "hertz"
    assert scene.patient.mass_kg == 80.0


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le"])
def test_a_byte_order_mark_is_no_part_of_a_scene(tmp_path, encoding):
    path = write_scene(tmp_path)
    text = path.read_text(encoding="utf-8")
    path.write_text(("\ufeff" if encoding == "utf-16-le" else "") + text, encoding=encoding)
    assert load_scene(path) == load_scene(write_scene(tmp_path / "plain")).model_copy(
        update=dict(load_scene(path))
    )


@pytest.mark.parametrize(
    ("changes", "drop", "words"),
    [
        ({}, ("implant",), r"\[contact\] needs"),
        ({}, ("tibia",), r"\[ground_reaction\] needs \[tibia\]"),
        ({"patella__motion": "solved", "patellar_ligament__length_mm": None}, (), "length_mm"),
    ],
)
def test_a_scene_without_a_required_table_or_key_is_refused(tmp_path, changes, drop, words):
    with pytest.raises(InputError, match=words):
        load_scene(write_scene(tmp_path, drop, **changes))


@pytest.mark.parametrize(
    ("bundle", "words"),
    [
        ({"stiffness_N_per_strain": 2000.0}, "takes stiffness_N_per_mm"),
        ({"law": "quadratic-toe"}, "takes stiffness_N_per_strain"),
        ({"reference_strain": 0.02}, "either slack_length_mm or reference_strain"),
        ({"name": "MCL anterior"}, "name"),
    ],
)
def test_a_ligaments_law_and_unit_go_together(tmp_path, bundle, words):
    import tomllib

    bundles = tomllib.loads((MODEL / "scene.toml").read_text(encoding="utf-8"))["ligament"]
    bundles[0] |= bundle
    with pytest.raises(InputError, match=words):
        load_scene(write_scene(tmp_path, ligament=bundles))


def test_two_ligaments_of_one_name_are_refused(tmp_path):
    import tomllib

    bundles = tomllib.loads((MODEL / "scene.toml").read_text(encoding="utf-8"))["ligament"]
    with pytest.raises(InputError, match="same name"):
        load_scene(write_scene(tmp_path, ligament=[bundles[0], bundles[0]]))


def test_a_scene_replaces_only_its_own_keys_of_a_base(tmp_path):
    base = write_scene(tmp_path)
    derived = tmp_path / "own.toml"
    derived.write_text(
        'base = "scene.toml"\n[contact]\nfriction = 0.0\n[patient]\nmass_kg = 80.0\n'
    )
    scene, plain = load_scene(derived), load_scene(base)
    assert (scene.contact.friction, scene.patient.mass_kg) == (0.0, 80.0)
    assert scene.ligament == plain.ligament
    assert scene.contact.model_copy(update={"friction": plain.contact.friction}) == plain.contact
    for text, words in (
        ('base = "nothing.toml"', "no such scene file"),
        ('base = "../scene.toml"', "same folder"),
        ("base = 3", "same folder"),
        ('base = "own.toml"', "has a base itself"),
    ):
        wrong = tmp_path / "wrong.toml"
        wrong.write_text(text)
        with pytest.raises(InputError, match=words):
            load_scene(wrong)


def test_signs_turned_is_the_recording_with_its_columns_negated(tmp_path):
    path = write_scene(tmp_path)
    coordinates = load_case(load_scene(path)).motion.raw_coordinates
    turned = load_case(load_scene(path, {"motion.signs_turned": ["ml", "adduction"]})).motion
    signs = [-1.0 if name in ("ml", "adduction") else 1.0 for name in KNEE_COORDINATES]
    np.testing.assert_allclose(turned.raw_coordinates, coordinates * signs, atol=1e-12)
    with pytest.raises(InputError, match="unknown role 'rotation_1'"):
        load_case(load_scene(path, {"motion.signs_turned": ["rotation_1"]}))


def test_the_case_leaves_the_scene_as_its_file_has_it(tmp_path):
    """Only the case has mirrored points and generic bundles. The scene, and its hash, stay."""
    generic = {"ligaments": ["MCL"]}
    path = write_scene(tmp_path, ("ligament",), generic_ligaments=generic)
    scene = load_scene(path, {"motion.frames": 3})
    case = load_case(scene)
    assert case.scene is scene
    assert [bundle.name[:11] for bundle in case.ligaments] == ["generic_MCL"] * 3
    left = scene.model_copy(update={"patient": scene.patient.model_copy(update={"side": "left"})})
    right_point, left_point = (
        read_patellar_ligament(each).distal.position for each in (scene, left)
    )
    assert left_point.tolist() == (MIRROR @ right_point).tolist()
    assert right_point[2] == pytest.approx(0.003)
    assert left.patellar_ligament == scene.patellar_ligament


DECLARING = (recording_tables, tables)
"""Modules that declare the scene's tables."""


def table_classes():
    """Yield the tables of the scene, except MaterialTable, which is read as a whole."""
    for module in DECLARING:
        for table in vars(module).values():
            derived = isinstance(table, type) and table.__module__ == module.__name__
            if derived and issubclass(table, SceneTable) and table is not tables.MaterialTable:
                yield table


def test_every_key_is_read_somewhere():
    """A key that is declared but not read would be ignored without a message."""
    read = set()
    for path in (ROOT / "tkamb").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) != "self":
                read.add(node.attr)
    for table in table_classes():
        assert not table.model_fields.keys() - read, table


def test_a_key_is_declared_in_one_place(tmp_path, monkeypatch):
    """The reader gets a new key of its table, and the page of the scene names it."""

    class LongerTable(recording_tables.TibiaTable):
        tilt_deg: float = Field(0.0, description="tilt of the floor")

    class LongerScene(scene_module.Scene):
        tibia: LongerTable | None = None

    received = []

    def reader(table, *rest):
        received.append(table)
        return load_tibia(table, *rest)

    monkeypatch.setattr(scene_module, "Scene", LongerScene)
    monkeypatch.setattr("tkamb.io.recordings.tibia.load_tibia", reader)
    load_case(load_scene(write_scene(tmp_path), {"tibia.tilt_deg": 3.0, "motion.frames": 3}))
    assert [table.tilt_deg for table in received] == [3.0]
    page = runpy.run_path(str(ROOT / "scripts" / "make" / "scene_page"))["page"]()
    assert "| `tilt_deg` | number | `0.0` | tilt of the floor |" in page
