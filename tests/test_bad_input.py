"""Bad input gives one line (what, where, what to do), exit status 2 and no output folder."""

import csv

import numpy as np
import pytest
import trimesh

from scenes import MODEL, write_scene
from tkamb.cli import main

pytestmark = pytest.mark.usefixtures("plain_report")


def refused(capfd, *arguments):
    """Run a command that must refuse its input, and return its one line on stderr."""
    assert main([str(argument) for argument in arguments]) == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("tkamb: ")
    return lines[0]


def run_refused(capfd, path, *more):
    """Run a scene that must be refused without an output folder, and return the line."""
    out = path.parent / "results"
    line = refused(capfd, "run", path, "--out", out, "--frames", "0:3", *more)
    assert not out.exists()
    return line


def rewrite(path, change):
    rows = list(csv.reader(path.read_text().splitlines()))
    change(rows)
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"patient__urdf": "no.urdf"}, "no.urdf"),
        ({"motion__file": "no.csv"}, "no.csv"),
        ({"implant__insert__mesh": "no.stl"}, "no.stl"),
        ({"patient__colour": "blue"}, "unknown key 'patient.colour'"),
        ({"ligamnet": []}, "unknown key 'ligamnet'"),
        ({"implant__insert__unit": None}, "missing key 'implant.insert.unit'"),
        ({"motion__length_unit": None}, "missing key 'length_unit'"),
        ({"motion__cutoff_Hz": 5000.0}, "cut-off"),
        ({"contact__model": "magic"}, "foundation"),
        ({"contact__material": "cheese"}, "polyethylene"),
        ({"contact__resolution_mm": -1.0}, "resolution_mm"),
        ({"contact__resolution_mm": 500.0}, "resolution"),
        ({"contact__options": {"law": "cheese"}}, "nonlinear, linear"),
        ({"contact__options": {"resolution": 1.0}}, "give one of them"),
        ({"motion__length_unit": "cm"}, "length_unit"),
        ({"ground_reaction__laboratory_axes": "+x,+z,-y"}, "laboratory_axes"),
        ({"ground_reaction__laboratory_axes": "-x,-y,+z"}, "laboratory_axes"),
        ({"ground_reaction__length_unit": "m"}, "from the ankle"),
        ({"implant__insert__unit": "m"}, "mm"),
        ({"implant__femoral__unit": "m"}, "mm"),
        ({"implant__insert__axes": "+z,+y,+x"}, "axes"),
        ({"implant__insert__axes": "+y,+z,+x"}, "bottom"),
        ({"patient__mass_kg": 0.0}, "mass_kg"),
        ({"quadriceps__origin__link": "fibula"}, "fibula"),
        ({"quadriceps__origin__point_mm": [0.0, 10.0, 0.0]}, "quadriceps"),
        ({"quadriceps": None}, "go together"),
        ({"implant__insert__mesh": "femoral_component.stl"}, "insert"),
        ({"implant__femoral__position_mm": [0.0, 40.0, 0.0]}, "neither condyle is near"),
    ],
)
def test_an_unusable_scene_is_refused(tmp_path, capfd, changes, words):
    assert words in run_refused(capfd, write_scene(tmp_path, **changes))


def test_a_missing_scene_is_refused(tmp_path, capfd):
    assert "no such scene" in run_refused(capfd, tmp_path / "scene.toml")


def test_broken_toml_is_refused(tmp_path, capfd):
    path = tmp_path / "scene.toml"
    path.write_text("[patient\n")
    assert "not TOML" in run_refused(capfd, path)


def test_a_motion_with_nan_is_refused(tmp_path, capfd):
    path = write_scene(tmp_path)
    rewrite(tmp_path / "motion.csv", lambda rows: rows[7].__setitem__(1, "nan"))
    line = run_refused(capfd, path)
    assert "motion.csv" in line


def test_a_motion_with_unsorted_time_is_refused(tmp_path, capfd):
    path = write_scene(tmp_path)

    def swap(rows):
        rows[5], rows[6] = rows[6], rows[5]

    rewrite(tmp_path / "motion.csv", swap)
    assert "time" in run_refused(capfd, path)


def test_a_motion_shorter_than_the_filter_needs_is_refused(tmp_path, capfd):
    path = write_scene(tmp_path, motion__cutoff_Hz=3.0)
    rewrite(tmp_path / "motion.csv", lambda rows: rows.__delitem__(slice(4, None)))
    assert "motion.csv" in run_refused(capfd, path)


def test_a_link_without_mass_is_refused(tmp_path, capfd):
    path = write_scene(tmp_path)
    urdf = tmp_path / "patient.urdf"
    urdf.write_text(urdf.read_text().replace('<mass value="10.620000"/>', '<mass value="0"/>'))
    assert "impossible inertia" in run_refused(capfd, path)


def test_a_urdf_with_a_joint_of_no_known_type_is_refused(tmp_path, capfd):
    """tkamb checks the type first, because Pinocchio's parser would print more lines."""
    path = write_scene(tmp_path)
    urdf = tmp_path / "patient.urdf"
    urdf.write_text(urdf.read_text().replace('"revolute"', '"hinge"', 1))
    assert "unknown type 'hinge'; there are: revolute" in run_refused(capfd, path)


def test_a_urdf_without_a_needed_joint_is_refused(tmp_path, capfd):
    path = write_scene(tmp_path)
    urdf = tmp_path / "patient.urdf"
    urdf.write_text(urdf.read_text().replace("knee_si", "knee_up"))
    assert "no joint 'knee_si'" in run_refused(capfd, path)


def test_a_mesh_that_is_not_a_surface_is_refused(tmp_path, capfd):
    path = write_scene(tmp_path)
    rng = np.random.default_rng(0)
    soup = trimesh.Trimesh(
        rng.uniform(-40, 40, (300, 3)), np.arange(300).reshape(-1, 3), process=False
    )
    soup.export(tmp_path / "insert.stl")
    assert "insert" in run_refused(capfd, path)


def test_a_mesh_file_of_text_is_refused(tmp_path, capfd):
    path = write_scene(tmp_path)
    (tmp_path / "insert.stl").write_text("not a mesh\n")
    assert "insert.stl" in run_refused(capfd, path)


def test_an_output_folder_that_cannot_be_written_is_refused(tmp_path, capfd):
    path = write_scene(tmp_path / "model")
    file = tmp_path / "file"
    file.write_text("")
    line = refused(capfd, "run", path, "--out", file / "results")
    assert "cannot be written" in line


def test_frames_outside_the_motion_are_refused(tmp_path, capfd):
    line = refused(
        capfd, "run", MODEL / "scene.toml", "--out", tmp_path / "r", "--frames", "90:150"
    )
    assert "101" in line or "100" in line
    assert not list((tmp_path / "r").glob("*"))


def test_time_in_milliseconds_is_refused(tmp_path, capfd):
    path = write_scene(tmp_path)

    def in_milliseconds(rows):
        rows[1:] = [[str(1000 * float(row[0])), *row[1:]] for row in rows[1:]]

    rewrite(tmp_path / "motion.csv", in_milliseconds)
    assert "the time must be in seconds" in run_refused(capfd, path)


def test_a_mesh_file_cut_short_is_refused(tmp_path, capfd):
    path = write_scene(tmp_path)
    content = (tmp_path / "insert.stl").read_bytes()
    (tmp_path / "insert.stl").write_bytes(content[: len(content) // 2])
    assert "cut short" in run_refused(capfd, path)


@pytest.mark.parametrize(
    "arguments",
    [
        ("run",),
        ("run", "scene.toml", "--frames", "nonsense"),
        ("run", "scene.toml", "--frames", "0:1.5"),
        ("run", "scene.toml", "--set", "contact.model"),
        ("run", "scene.toml", "--set", "contact.resolution_mm=2\ncontact.model='hertz'"),
        ("press", "a.stl", "b.stl"),
        ("press", "a.stl", "b.stl", "--load", "much"),
        ("frobnicate",),
        (),
    ],
)
def test_bad_arguments_give_one_line(capfd, arguments):
    with pytest.raises(SystemExit) as caught:
        main(list(arguments))
    lines = capfd.readouterr().err.strip().splitlines()
    assert caught.value.code == 2
    assert len(lines) == 1, lines
    assert lines[0].startswith("tkamb")


@pytest.mark.parametrize("load", ["-5", "nan", "inf", "1e9"])
def test_an_impossible_load_is_refused(capfd, load):
    line = refused(
        capfd,
        "press",
        MODEL / "femoral_component.stl",
        MODEL / "insert.stl",
        f"--load={load}",
    )
    assert "load" in line


def test_press_refuses_an_unknown_contact_model(capfd):
    line = refused(
        capfd,
        "press",
        MODEL / "femoral_component.stl",
        MODEL / "insert.stl",
        "--load=100",
        "--contact=magic",
    )
    assert "magic" in line
    assert "hertz" in line


def test_set_refuses_an_unknown_key(tmp_path, capfd):
    line = refused(
        capfd,
        "run",
        MODEL / "scene.toml",
        "--out",
        tmp_path / "r",
        "--set",
        "contact.fricton=0.1",
    )
    assert "unknown key 'contact.fricton'" in line


@pytest.mark.parametrize("command", ["new", "wear"])
def test_a_folder_name_that_is_too_long_gives_one_line(capfd, command):
    assert "File name too long" in refused(capfd, command, "n" * 300)
