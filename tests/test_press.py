"""`tkamb press` on mesh files: output, units, axes, side, adjustment and refused input."""

import argparse
import base64
import json
import re
from functools import cache, partial
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from contact_bodies import dished_insert, flat_insert, graded_sphere, joined
from scenes import write_scene
from tkamb import simulate
from tkamb.cli import main
from tkamb.commands.mesh import add_mesh, add_press
from tkamb.contact.registry import contact_class, contact_names
from tkamb.errors import InputError
from tkamb.geometry.surface import Surface
from tkamb.io import starter
from tkamb.io.recordings.polygon_files import read_vtp
from tkamb.run import press
from tkamb.run.press import read_pose
from tkamb.units import LENGTH, MILLIMETRE

FOUNDATION = ["--contact", "foundation"]
press_meshes = partial(press.press_meshes, contact="foundation")
KEYS = [
    "contact",
    "resolution_mm",
    "nodes",
    "load_N",
    "reaction_N",
    "approach_mm",
    "medial",
    "lateral",
    "prepare_seconds",
    "solve_seconds",
    "peak_rss_MB",
    "iterations",
    "residual",
    "status",
    "flags",
    "known_error",
    "material",
]
CONDYLE_KEYS = ["force_N", "area_mm2", "mean_pressure_MPa", "peak_pressure_MPa", "cop_mm"]
TURN = np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]])
"""Rotation from anatomical axes to the axes -x,+y,-z of a mesh."""


@cache
def two_condyles():
    """Return condyles of different sizes, so that medial and lateral results differ."""
    medial = graded_sphere(22e-3, (1e-3, 0, -22e-3))
    lateral = graded_sphere(20e-3, (0, -2e-3, 22e-3))
    return joined(medial, lateral)


@cache
def dishes():
    """Return an insert with two dishes."""
    return dished_insert(
        lambda x, z: 8e-3 + (x**2) / (2 * 50e-3) + (np.abs(z) - 22e-3) ** 2 / (2 * 60e-3),
        half_x=20e-3,
        half_z=36e-3,
        spacing=1e-3,
    )


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """Return a function that returns the paths of the meshes in a unit and axes."""
    folder = tmp_path_factory.mktemp("meshes")

    def write(scale=1e3, turn=None, mirror=False):
        paths = []
        for name, surface in (("femoral", two_condyles()), ("insert", dishes())):
            vertices, faces = surface.vertices * scale, surface.faces
            if mirror:
                vertices, faces = vertices * [1, 1, -1], faces[:, ::-1]
            if turn is not None:
                vertices = vertices @ turn.T
            path = folder / f"{name}_{scale:g}_{turn is not None}_{mirror}.ply"
            if not path.exists():
                Surface(vertices, faces, name).mesh.export(path)
            paths.append(path)
        return paths

    return write


def condyles(report):
    """Return the results of medial and lateral condyle, one row each (2, 7)."""
    output = report.as_dict()
    return np.array(
        [[*(output[s][k] for k in CONDYLE_KEYS[:-1]), *output[s]["cop_mm"]] for s in SIDES]
    )


SIDES = ("medial", "lateral")


def test_the_json_output_has_the_documented_keys(meshes, capsys):
    femoral, insert = meshes()
    arguments = ["press", str(femoral), str(insert), "--load", "900", "--json"]
    assert main([*arguments, *FOUNDATION, "--resolution", "1.5"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert list(output) == KEYS
    assert list(output["medial"]) == list(output["lateral"]) == CONDYLE_KEYS
    assert output["status"] == "ok"
    assert output["load_N"] == 900
    assert output["reaction_N"] == pytest.approx(900, rel=1e-6)
    assert output["resolution_mm"] == 1.5
    assert output["medial"]["cop_mm"][2] == pytest.approx(-22, abs=1.5)
    assert output["lateral"]["cop_mm"][2] == pytest.approx(22, abs=1.5)
    assert 0 < output["approach_mm"] < 1


def test_the_text_has_both_condyles_and_the_map_has_the_load(meshes, capsys, tmp_path):
    femoral, insert = meshes()
    pressing = ["press", str(femoral), str(insert), "--load", "900", *FOUNDATION]
    assert main([*pressing, "--out", str(tmp_path / "map.vtp")]) == 0
    assert nodal_forces(tmp_path / "map.vtp")[:, 1].sum() == pytest.approx(-900, rel=1e-6)
    assert main([*pressing, "--out", str(tmp_path / "map.stl")]) == 2
    text = capsys.readouterr().out
    forces = [
        float(x) for x in re.findall(r"^(?:medial|lateral) +([0-9.]+) N .*centre", text, re.M)
    ]
    assert len(forces) == 2 and sum(forces) == pytest.approx(900, rel=2e-3)
    assert "reaction 900 N" in text


def test_the_lattice_is_the_default(meshes, capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("TKAMB_CACHE_DIR", str(tmp_path / "cache"))
    femoral, insert = meshes()
    arguments = ["press", str(femoral), str(insert), "--load", "900", "--no-cache", "--json"]
    assert main([*arguments, "--resolution", "2"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["contact"] == "lattice"
    assert output["reaction_N"] == pytest.approx(900, rel=1e-5)
    assert not (tmp_path / "cache").exists()
    assert main([*arguments, *FOUNDATION]) == 2
    assert "'foundation' has no cache on disk" in capsys.readouterr().err


def test_each_contact_model_carries_the_load(meshes):
    femoral, insert = meshes()
    for contact in ("foundation", "foundation-linear", "hertz"):
        report = press_meshes(femoral, insert, 600.0, contact=contact)
        assert report.as_dict()["reaction_N"] == pytest.approx(600, rel=1e-6)
        assert report.as_dict()["contact"] == contact


def test_results_do_not_depend_on_unit_axes_and_height(meshes):
    pose = (2.0, 30.0, 0.4, 0.03, 1.0, 15.0)
    expected = condyles(press_meshes(*meshes(), 2000.0, pose=pose))
    in_metres = (*(1e-3 * np.array(pose[:3])), *pose[3:])
    metres = press_meshes(*meshes(scale=1.0), 2000.0, units="m", pose=in_metres)
    assert np.allclose(condyles(metres), expected, rtol=1e-5, atol=1e-5)
    turned = TURN @ Rotation.from_euler("XYZ", pose[3:], degrees=True).as_matrix() @ TURN.T
    angles = Rotation.from_matrix(turned).as_euler("XYZ", degrees=True)
    other = press_meshes(
        *meshes(turn=TURN), 2000.0, axes="-x,+y,-z", pose=(*(TURN @ pose[:3]), *angles)
    )
    assert np.allclose(condyles(other), expected, rtol=1e-5, atol=1e-5)
    higher = press_meshes(*meshes(), 2000.0, pose=(2.0, 55.0, 0.4, 0.03, 1.0, 15.0))
    assert np.allclose(condyles(higher), expected, rtol=1e-9, atol=1e-6)


def test_a_left_knee_is_the_mirror_image(meshes):
    """The condyles have the same results. Only z, to the subject's right, changes its sign."""
    pose = np.array([2.0, 30.0, 0.4, 0.03, 1.0, 15.0])
    right = condyles(press_meshes(*meshes(), 2000.0, pose=pose))
    mirrored = pose * [1, 1, -1, -1, -1, 1]
    left = condyles(press_meshes(*meshes(mirror=True), 2000.0, pose=mirrored, side="left"))
    assert np.allclose(left[:, :-1], right[:, :-1], rtol=1e-6, atol=1e-6)
    assert np.allclose(left[:, -1], -right[:, -1], atol=1e-6)
    assert right[0, -1] < 0 < right[1, -1]


def nodal_forces(path):
    """Return the nodal forces (n, 3), N, of a .vtp file."""
    arrays = ElementTree.parse(path).getroot().iter("DataArray")
    (text,) = (array.text for array in arrays if array.get("Name") == "nodal_force_N")
    return np.frombuffer(base64.b64decode(text)[8:]).reshape(-1, 3)


def test_the_map_of_a_left_knee_is_on_the_given_insert(meshes, tmp_path):
    """The map has the printed centres of pressure, and mirrors the map of the right knee."""
    pose, path, forces = np.array([2.0, 30.0, 0.4, 0.03, 1.0, 15.0]), tmp_path / "map.vtp", {}
    for side, flip in (("right", 1), ("left", -1)):
        turned = pose * [1, 1, flip, flip, flip, 1]
        report = press_meshes(*meshes(mirror=flip < 0), 2000.0, pose=turned, side=side)
        report.write_map(path)
        (points, faces), forces[side] = read_vtp(path), nodal_forces(path)
        for name, place in (("medial", -flip), ("lateral", flip)):
            magnitude = np.linalg.norm(forces[side], axis=1)
            load = np.where(points[:, 2] * place > 0, magnitude, 0.0)
            centre = load @ points / load.sum() / MILLIMETRE
            assert centre[::2] == pytest.approx(report.as_dict()[name]["cop_mm"][::2], abs=2e-3)
        edges = (points[faces[:, k]] - points[faces[:, 0]] for k in (1, 2))
        assert (np.cross(*edges)[:, 1] > 0).all()  # outward normals of the top are upward
    right, left = (forces[side].sum(axis=0) for side in ("right", "left"))
    assert abs(right[2]) > 1.0
    assert left == pytest.approx(right * [1, 1, -1], abs=1e-3)


def test_the_pose_is_that_of_the_femoral_mesh_in_the_insert_s_axes(meshes):
    """A sphere of radius r that moves by s in a dish of radius R touches at s R / (R - r)."""
    reference = condyles(press_meshes(*meshes(), 2000.0))
    moved = condyles(press_meshes(*meshes(), 2000.0, pose=(3.0, 0, 0, 0, 0, 0)))
    expected = [3 * 50 / (50 - 22), 3 * 50 / (50 - 20)]
    assert np.allclose((moved - reference)[:, 4], expected, rtol=0.05)


def test_the_adjustment_removes_a_recorded_varus_of_0_2_deg(meshes, capsys):
    """Such a varus is within the error of fluoroscopy."""
    level = press_meshes(*meshes(), 2000.0).result
    centre = level.pose[1, 3] * 1e3 + level.approach * 1e3
    report = press_meshes(*meshes(), 2000.0, pose=(0, centre + 0.05, 0, 0.2, 0, 0), adjust=True)
    assert report.adjustment is not None
    assert abs(np.degrees(report.adjustment.coronal_angle)) > 0.05
    assert any(line.startswith("adjusted") for line in report.lines())
    with pytest.raises(InputError, match="neither condyle is near"):
        press_meshes(*meshes(), 2000.0, pose=(0, 100, 0, 0, 0, 0), adjust=True)


KNEE = Path(__file__).parents[1] / "models" / "deep_knee_bend"


@pytest.mark.parametrize(("height", "moved"), [(30.5, 0.24), (30.7, 0.04), (31.2, -0.46)])
def test_the_adjusted_split_does_not_depend_on_the_recorded_height(height, moved, capsys):
    """The pose of the shipped knee has 0.3 deg of adduction."""
    files = [str(KNEE / name) for name in ("femoral_component.stl", "insert.stl")]
    pose = ["--pose", "-6.9", str(height), "0", "0.3", "0", "0"]
    assert main(["press", *files, "--load", "1500", *pose, *FOUNDATION, "--adjust", "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["medial"]["force_N"] == pytest.approx(748, abs=3)
    assert output["lateral"]["force_N"] == pytest.approx(752.5, abs=3)
    assert output["adjustment"]["translation_mm"] == pytest.approx(moved, abs=0.01)
    assert output["adjustment"]["coronal_deg"] == pytest.approx(-0.3, abs=0.01)
    assert not output["adjustment"]["restored"]
    assert output["flags"] == []


def test_the_rule_either_restores_the_rotation_at_the_right_height(meshes):
    """Penetration alone restores it. The rule is refused without an adjustment."""
    bodies = [KNEE / name for name in ("femoral_component.stl", "insert.stl")]
    pose = (-6.9, 30.7, 0, 0.3, 0, 0)
    report = press_meshes(*bodies, 1500.0, pose=pose, adjust=True, restore_when="either")
    assert report.adjustment is not None
    assert report.adjustment.restored
    assert report.as_dict()["medial"] is None or report.result.medial.force < 100.0
    assert any("whether the recorded rotation is restored" in line for line in report.lines())
    with pytest.raises(InputError, match="needs the femoral adjustment"):
        press_meshes(*bodies, 1500.0, pose=pose, restore_when="either")
    with pytest.raises(InputError, match="'neither' is not a rule"):
        press_meshes(*bodies, 1500.0, pose=pose, adjust=True, restore_when="neither")


def test_the_contact_of_a_single_sphere_is_medial(tmp_path):
    graded_sphere(20e-3).mesh.export(tmp_path / "sphere.ply")
    flat_insert(10e-3).mesh.export(tmp_path / "block.ply")
    report = press_meshes(tmp_path / "sphere.ply", tmp_path / "block.ply", 500.0, units="m")
    output = report.as_dict()
    assert output["lateral"] is None
    assert output["medial"]["force_N"] == pytest.approx(500, rel=1e-6)
    assert output["medial"]["cop_mm"] == pytest.approx([0, 10, 0], abs=0.02)
    assert any("one condyle: its contact is called medial" in flag for flag in output["flags"])


@pytest.mark.parametrize(("turn", "noted"), [(20, False), (-45, True), (90, True), (180, True)])
def test_a_femur_rotated_farther_than_in_any_knee_gets_a_note(meshes, turn, noted):
    pose = [0.0, 0.0, 0.0, 0.0, turn, 0.0]
    report = press_meshes(*meshes(), 500.0, pose=pose, contact="foundation", resolution_mm=3.0)
    flags = report.as_dict()["flags"]
    assert any(f"by {abs(turn)} deg on the insert" in flag for flag in flags) == noted


@pytest.mark.parametrize("model", contact_names())
def test_a_mobile_bearing_has_a_larger_approach_or_a_note(meshes, model):
    """An insert with a sliding bottom is compressed more by the same load."""
    fixed, mobile = (
        press.press_meshes(*meshes(), 500.0, contact=model, resolution_mm=3.0, bearing=bearing)
        for bearing in ("fixed", "mobile")
    )
    assert not any("bearing" in flag for flag in fixed.as_dict()["flags"])
    noted = any("as a fixed one" in line for line in mobile.lines())
    if contact_class(model).mobile_bearing:
        assert not noted and mobile.result.approach > 1.01 * fixed.result.approach
    else:
        assert noted and mobile.result.approach == fixed.result.approach


def test_the_assumptions_of_a_run_have_the_note_on_a_mobile_bearing(tmp_path):
    def notes(**changes):
        scene = write_scene(tmp_path, implant__insert__bearing="mobile", **changes)
        return simulate(scene, frames=slice(50, 51)).summary["assumptions"]

    assert any("mobile, but foundation computes it" in note for note in notes())
    lattice = {"contact__model": "lattice-linear", "contact__resolution_mm": 4.0}
    assert not any("bearing" in note for note in notes(**lattice))


def test_a_zero_load_is_ok_and_too_large_a_load_is_out_of_range(meshes):
    unloaded = press_meshes(*meshes(), 0.0).as_dict()
    assert unloaded["reaction_N"] == unloaded["approach_mm"] == 0
    assert unloaded["medial"] is None
    assert unloaded["status"] == "ok"
    crushed = press_meshes(*meshes(), 1e5)
    output = crushed.as_dict()
    assert output["status"] == "out_of_range"
    assert output["reaction_N"] is output["approach_mm"] is output["medial"] is None
    assert not crushed.carried
    assert any("cannot be reached" in line for line in crushed.lines())
    json.dumps(output, allow_nan=False)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"load": -5.0}, "load: cannot be"),
        ({"load": float("nan")}, "load: cannot be"),
        ({"load": float("inf")}, "load: cannot be"),
        ({"load": 1e8}, "more than any knee carries"),
        ({"contact": "magic"}, "there are: .*foundation"),
        ({"material": "cheese"}, "there are: polyethylene"),
        ({"units": "inch"}, "unit"),
        ({"units": "m"}, "unit"),
        ({"axes": "+x,+x,+z"}, "axes"),
        ({"axes": "+y,+z,+x"}, "check the axes"),
        ({"side": "both"}, "side"),
        ({"bearing": "loose"}, "bearing"),
        ({"pose": (0, 0, 0)}, "six finite numbers"),
        ({"pose": (0, 0, 0, 0, 0, float("nan"))}, "six finite numbers"),
        ({"pose": (300, 0, 0, 0, 0, 0)}, "neither condyle lies over the insert"),
        ({"resolution_mm": 0.0}, "resolution"),
        ({"resolution_mm": 1e-3}, "coarser"),
        ({"femoral": "nowhere.stl"}, "nowhere.stl"),
    ],
)
def test_bad_input_is_refused(meshes, changed, words):
    femoral, insert = meshes()
    arguments = {"femoral": femoral, "insert": insert, "load": 500.0, **changed}
    with pytest.raises(InputError, match=words):
        press_meshes(**arguments)


def test_an_open_insert_is_refused(meshes, tmp_path):
    femoral, _ = meshes()
    surface = dishes()
    keep = surface.face_normals[:, 1] < 0.5
    Surface(1e3 * surface.vertices, surface.faces[keep], "shell").mesh.export(
        tmp_path / "shell.ply"
    )
    with pytest.raises(InputError, match=r"closed|flat"):
        press_meshes(femoral, tmp_path / "shell.ply", 500.0)


def test_a_pose_file_has_six_numbers(tmp_path):
    path = tmp_path / "pose.txt"
    path.write_text("1.5, 2 3\n0 -5 90\n")
    assert read_pose(path) == (1.5, 2, 3, 0, -5, 90)
    for text in ("1 2 3", "1 2 3 4 5 six"):
        path.write_text(text)
        with pytest.raises(InputError, match="six numbers"):
            read_pose(path)
    with pytest.raises(InputError, match="no such pose file"):
        read_pose(tmp_path / "none.txt")


def test_both_condyles_of_subject_dm_are_loaded_in_stance():
    """The pose at 30 % of the cycle is that of models/dm/README.md."""
    geometry = Path(__file__).parents[2] / "shared" / "data" / "dm" / "geometry"
    if not geometry.is_dir():
        pytest.skip("subject DM's data are not beside the project")
    output = press_meshes(
        geometry / "femoral_component.stl",
        geometry / "tibial_insert.stl",
        1500.0,
        units="m",
        axes="-x,+y,-z",
        pose=(-0.0065, 0.041674, 0.00014, -0.2406, 2.9164, -9.9867),
        adjust=True,
    ).as_dict()
    for side, sign in (("medial", -1), ("lateral", 1)):
        assert output[side]["force_N"] > 600.0
        assert 18.0 < sign * output[side]["cop_mm"][2] < 32.0
        assert abs(output[side]["cop_mm"][0]) < 8.0


def test_press_and_mesh_lattice_accept_every_unit_of_length():
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers()
    add_press(commands)
    add_mesh(commands)
    for unit in LENGTH:
        press = ["press", "a.stl", "b.stl", "--load", "1", "--units", unit]
        assert parser.parse_args(press).units == unit
        assert parser.parse_args(["mesh", "lattice", "b.stl", "--units", unit]).units == unit


STARTER = Path(starter.__file__).parent / "files"
SHIPPED = (STARTER / "femoral_component.stl", STARTER / "insert.stl")


@pytest.mark.parametrize(
    ("turns", "fault"),
    [
        ((180, 0, 0), "stands upside down"),
        ((0, 0, 180), "stands upside down"),
        ((0, 180, 180), "stands upside down"),
        ((0, 0, -160), "stands upside down"),
        ((90, 0, 0), "lies on its side"),
        ((-80, 0, 0), "lies on its side"),
    ],
)
@pytest.mark.parametrize("side", ["right", "left"])
def test_a_femoral_component_upside_down_or_on_its_side_is_refused(turns, fault, side):
    with pytest.raises(InputError, match=fault):
        press_meshes(*SHIPPED, 500.0, pose=(0, 0, 0, *turns), resolution_mm=3.0, side=side)


@pytest.mark.parametrize(
    ("turns", "axes", "remark"),
    [
        ((0, 0, 0), "+x,+y,+z", None),
        ((0, 0, 140), "+x,+y,+z", None),
        ((0, 0, -20), "+x,+y,+z", None),
        ((10, 15, 90), "+x,+y,+z", None),
        ((0, 0, -90), "+x,+y,+z", "not its condyles, faces the insert"),
        ((0, 0, 0), "-x,+y,-z", "points backward"),
        ((0, 90, 0), "+x,+y,+z", "by 90 deg"),
    ],
)
def test_a_pose_beyond_those_of_knees_gets_a_note(turns, axes, remark):
    """Poses from 20 deg of hyperextension to 140 deg of flexion get no note."""
    report = press_meshes(*SHIPPED, 500.0, pose=(0, 0, 0, *turns), axes=axes, resolution_mm=3.0)
    notes = "\n".join(report.as_dict()["flags"])
    about_pose = [w for w in ("faces the insert", "points backward", "turns the") if w in notes]
    assert (remark in notes) if remark else not about_pose


def test_exchanged_meshes_are_refused():
    with pytest.raises(InputError, match="shape of a femoral component"):
        press_meshes(*reversed(SHIPPED), 500.0)
