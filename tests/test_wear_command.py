"""`tkamb wear` on the command line: written files, refused input, and interruption."""

import csv
import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import trimesh

import shapes
from scenes import write_scene
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.geometry.frames import knee_coordinates
from tkamb.studies.wear import run as wear_run
from tkamb.studies.wear.laws import (
    Archard,
    ContactArea,
    law_names,
    material_names,
    wear_law,
    wear_material,
)
from tkamb.studies.wear.report import STATE_NAME
from tkamb.studies.wear.setup import wear_setup
from tkamb.studies.wear.simulation import first_cycle
from tkamb.studies.wear.simulator import read_profile
from wear_bodies import balls_scene, swing, swinging_case

pytestmark = pytest.mark.usefixtures("plain_report")

CYCLE = """cycle_percent,axial_force_N,flexion_deg,ap_mm,axial_rotation_deg
0,300,0,0,0
15,1800,15,-1,1
45,1600,8,1,2
70,200,58,-3,4
100,300,0,0,0
"""
QUICK = ("--resolution", "4", "--frames-per-cycle", "5", "--updates", "2")


@pytest.fixture(scope="module")
def profile(tmp_path_factory):
    path = tmp_path_factory.mktemp("profile") / "cycle.csv"
    path.write_text(CYCLE, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return balls_scene(tmp_path_factory.mktemp("balls"))


@pytest.fixture(scope="module")
def written(tmp_path_factory, profile, scene):
    out = tmp_path_factory.mktemp("wear") / "out"
    wear_command = ["wear", str(scene), "--simulator", str(profile), *QUICK]
    assert main([*wear_command, "--cycles", "1e5", "--out", str(out)]) == 0
    return out


def refused(capsys, *arguments):
    assert main(["wear", *map(str, arguments)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


def test_table_summary_maps_and_mesh_have_the_same_volume(written, scene):
    names = {path.name for path in written.iterdir()}
    assert names == {".tkamb", "wear.csv", "wear.json", "wear.vtp", "worn_insert.stl", "wear.png"}
    report = json.loads((written / "wear.json").read_text())
    with open(written / "wear.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[-1]["volume_mm3"]) == report["volume_mm3"] > 0
    assert float(rows[-1]["cycles"]) == report["cycles"] == 100_000
    assert report["mass_mg"] == pytest.approx(0.93 * report["volume_mm3"])
    assert report["creep_depth_mm"] is None and rows[-1]["creep_depth_mm"] == ""
    maps = (written / "wear.vtp").read_bytes()
    assert b"wear_depth_mm" in maps and b"creep_depth_mm" not in maps
    assert report["mesh_volume_lost_mm3"] == pytest.approx(report["volume_mm3"], rel=1e-6)
    worn, new = (
        trimesh.load(p) for p in (written / "worn_insert.stl", scene.parent / "dishes.stl")
    )
    # the files have single precision, which is 1e-7 of the insert
    assert new.volume - worn.volume == pytest.approx(report["volume_mm3"], abs=2e-6 * new.volume)
    assert worn.is_watertight


def test_doubling_the_wear_factor_doubles_the_wear(capsys, tmp_path, profile, scene, written):
    single = json.loads((written / "wear.json").read_text())
    wear_command = ["wear", str(scene), "--simulator", str(profile), *QUICK, "--json"]
    assert (
        main([*wear_command, "--cycles", "100", "--wear-factor", "5.2e-7", "--out", str(tmp_path)])
        == 0
    )
    double = json.loads(capsys.readouterr().out)
    assert double["volume_mm3_per_Mc"] == pytest.approx(2 * single["volume_mm3_per_Mc"], rel=0.01)
    assert double["law_parameters"]["wear_factor_mm3_per_Nm"] == 5.2e-7


@pytest.mark.slow
def test_an_interrupted_simulation_is_resumed_to_the_same_result(
    monkeypatch, capsys, tmp_path, profile, scene
):
    wear_command = ["wear", str(scene), "--simulator", str(profile), *QUICK, "--cycles", "60000"]
    assert main([*wear_command, "--out", str(tmp_path / "whole")]) == 0
    keep, stops = wear_run.keep_state, iter([True])

    def keep_and_stop(*arguments):
        keep(*arguments)
        if next(stops):
            raise KeyboardInterrupt

    monkeypatch.setattr(wear_run, "keep_state", keep_and_stop)
    assert main([*wear_command, "--out", str(tmp_path / "part")]) == 130
    assert "go on with --resume" in capsys.readouterr().err
    monkeypatch.undo()
    other = [*wear_command[:-1], "70000", "--out", str(tmp_path / "part"), "--resume"]
    assert main(other) == 2
    assert "another simulation" in capsys.readouterr().err
    assert main([*wear_command, "--out", str(tmp_path / "part"), "--resume"]) == 0
    complete, resumed = (
        (tmp_path / name / "wear.csv").read_text(encoding="utf-8") for name in ("whole", "part")
    )
    assert resumed == complete


@pytest.mark.slow
def test_a_killed_simulation_is_resumed_to_the_same_result(tmp_path, profile, scene):
    wear_command = [
        "wear",
        str(scene),
        "--simulator",
        str(profile),
        *QUICK[:-1],
        "6",
        "--cycles",
        "60000",
    ]
    assert main([*wear_command, "--out", str(tmp_path / "whole")]) == 0
    part = tmp_path / "part"
    command = [sys.executable, "-c", "import sys; from tkamb.cli import main; sys.exit(main())"]
    process = subprocess.Popen(
        [*command, *wear_command, "--out", str(part)], stderr=subprocess.DEVNULL
    )
    while not (part / STATE_NAME).exists():
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert not (part / "wear.csv").exists()
    assert main([*wear_command, "--out", str(part), "--resume"]) == 0
    for name in ("wear.csv", "worn_insert.stl", "wear.vtp"):
        assert (part / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_invalid_input_is_an_error_of_one_line(capsys, tmp_path, profile, scene):
    out = tmp_path / "out"
    cases = {
        ("--cycles", "0"): "0 cycles",
        ("--updates", "0"): "0 updates",
        ("--wear-factor=-1e-7",): "-1e-07",
        ("--wear-factor", "nan"): "nan",
        ("--wear-factor", "3.5"): "in mm³/(N m)",
        ("--law", "archerd"): "did you mean archard",
        ("--law", "pressure-cross-shear"): "has no parameters",
        ("--material", "conventionnal"): "did you mean conventional",
        ("--material", "none.toml"): "no such",
        ("--frames-per-cycle", "1"): "at least 2",
        ("--period", "0"): "--period",
        ("--set", "wear.close=open"): "--set wear.close",
        ("--set", "wear.laws=archard"): "unknown key 'wear.laws'",
        ("--contact", "latice"): "did you mean lattice",
    }
    for options, words in cases.items():
        message = refused(capsys, scene, "--simulator", profile, *options, "--out", out)
        assert words in message, options
        assert not out.exists()
    with pytest.raises(SystemExit, match="2"):
        main(["wear", str(scene), "--cycles", "1.5"])
    assert "'1.5' is not a whole number" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("100,300,0,0,0", "100,300,5,0,0"), "does not close: 'flexion_deg'"),
        (("100,300,0,0,0", "99,300,0,0,0"), "runs from 0 to 99"),
        (("15,1800", "15,-1800"), "'axial_force_N' is -1800"),
        (("58,-3", "580,-3"), "'flexion_deg' is 580"),
        (("ap_mm", "ap_m"), "unknown column 'ap_m'"),
        (("70,200", "70,"), "missing or non-finite"),
        (("45,1600", "12,1600"), "does not rise"),
        (("axial_force_N", "adduction_deg"), "no column 'axial_force_N'"),
    ],
)
def test_an_invalid_profile_is_refused(tmp_path, change, words):
    path = tmp_path / "cycle.csv"
    path.write_text(CYCLE.replace(*change), encoding="utf-8")
    with pytest.raises(InputError, match=words):
        read_profile(path, 10)


def test_positions_of_a_profile_are_relative_to_the_dwell_position(profile, scene):
    setup = wear_setup(scene, simulator=profile, resolution_mm=3.0, frames=101)
    coordinates = knee_coordinates(setup.motion.poses)
    assert np.degrees(coordinates[[0, 15, 70, 100], 5]) == pytest.approx([0, 15, 58, 0], abs=1e-9)
    assert (coordinates[:, 0] - coordinates[0, 0])[[15, 45, 70]] == pytest.approx(
        [-1e-3, 1e-3, -3e-3]
    )
    assert setup.motion.load[[0, 15, 70]] == pytest.approx([300, 1800, 200])
    # two spheres lie lowest in the middle of two dishes, apart from the effect of facets
    assert (coordinates[0, 0], coordinates[0, 2]) == pytest.approx((0.0, 0.0), abs=1e-3)


@pytest.mark.slow
def test_a_folder_of_results_and_its_scene_give_the_same_cycle(tmp_path):
    scene = write_scene(tmp_path / "scene", contact__resolution_mm=3.0)
    assert main(["run", str(scene), "--frames", "0:101:17", "--out", str(tmp_path / "run")]) == 0
    folder = wear_setup(tmp_path / "run", frames=6, close="there-and-back")
    from_scene = wear_setup(scene, frames=6, close="there-and-back")
    assert folder.motion.passes == from_scene.motion.passes == 2
    # the run does not include the last recorded frame, but the motion of the scene does
    assert folder.motion.poses[0] == pytest.approx(from_scene.motion.poses[0], abs=1e-9)
    assert [len(wear_inputs.motion) for wear_inputs in (folder, from_scene)] == [6, 6]
    assert from_scene.motion.duration > folder.motion.duration
    scene.write_text(scene.read_text().replace("75.0", "76.0"), encoding="utf-8")
    with pytest.raises(InputError, match="an earlier version of the scene file"):
        wear_setup(tmp_path / "run")


def test_a_scene_without_contact_is_refused(tmp_path):
    scene = write_scene(tmp_path / "scene", drop=("contact",))
    with pytest.raises(InputError, match=r"no \[contact\]"):
        wear_setup(scene)


def test_every_built_in_material_has_sources_and_its_law():
    for name in material_names():
        material = wear_material(name)
        assert material.sources and material.caution and material.range_source
        low, high = material.factor_range
        assert low < 1 < high
        for law in material.laws:
            assert material.wear_law(law).name == law


def test_results_have_ranges_and_the_rates_of_all_laws(written):
    report = json.loads((written / "wear.json").read_text())
    material = wear_material("conventional")
    for key in ("volume_mm3", "mass_mg", "max_depth_mm", "volume_mm3_per_Mc"):
        expected = [factor * report[key] for factor in material.factor_range]
        assert report[f"{key}_range"] == pytest.approx(expected)
    assert "contact area cancels" in report["geometry"]
    laws = {entry["law"]: entry for entry in report["laws_side_by_side"]}
    assert set(laws) == {"archard", "cross-shear", "contact-area"}
    # on the unworn insert, the chosen law has the rate of the simulation
    first = laws["cross-shear"]["first_volume_mm3_per_Mc"]
    assert first == pytest.approx(report["volume_mm3_per_Mc"], rel=0.1)
    assert "more conforming" in laws["contact-area"]["geometry"]
    for name in ("archard", "cross-shear"):
        factor = material.laws[name]["wear_factor_mm3_per_Nm"]
        assert laws[name]["wear_factor_mm3_per_Nm"] == factor
    assert laws["contact-area"]["wear_factor_mm3_per_Nm"] is None


def test_conformity_increases_wear_by_area_but_not_by_archard(tmp_path):
    """The load and the path per radius are equal, and the area of the tight contact is larger."""
    motion = swing(0.4, 5, 500.0)
    trough = shapes.trough(0.03)
    volumes = {}
    for name, radius in (("tight", 0.028), ("loose", 0.015)):
        case = swinging_case(shapes.sphere(radius, 4), trough, motion)
        path = 500.0 * radius * 0.8
        laws = {"archard": Archard(1e-7), "area": ContactArea((0.0, 0.5), (1e-9, 1e-9))}
        cycle_volumes = first_cycle(case, laws).volumes
        volumes[name] = {law: volume / path for law, volume in cycle_volumes.items()}
    archard, area = (
        {fit: by_law[law] for fit, by_law in volumes.items()} for law in ("archard", "area")
    )
    assert archard["tight"] == pytest.approx(archard["loose"], rel=0.03)
    assert area["tight"] > 1.3 * area["loose"]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("factor_range = [0.5]", "cannot be"),
        ("factor_range = [1.5, 2.0]", "at most 1"),
        ("factor_range = [0.5, 2.0]", "'range_source' is missing"),
    ],
)
def test_an_invalid_range_of_factors_is_refused(tmp_path, line, words):
    path = tmp_path / "mine.toml"
    head = 'density_kg_per_m3 = 940\nlaw = "archard"\nsources = ["here"]\n'
    laws = "[laws.archard]\nwear_factor_mm3_per_Nm = 2e-7\n"
    path.write_text(f"{head}{line}\n{laws}", encoding="utf-8")
    with pytest.raises(InputError, match=words):
        wear_material(path)


def test_a_material_file_contains_laws_and_creep(tmp_path):
    path = tmp_path / "mine.toml"
    text = """
density_kg_per_m3 = 940
law = "archard"
sources = ["measured here"]
[laws.archard]
wear_factor_mm3_per_Nm = 2e-7
[creep]
compliance_per_MPa = 3e-3
per_decade_per_MPa = 8e-4
reference_min = 1000.0
"""
    path.write_text(text, encoding="utf-8")
    material = wear_material(path)
    assert material.wear_law().wear_factor_mm3_per_Nm == 2e-7
    assert material.wear_law("archard", 4e-7).wear_factor_mm3_per_Nm == 4e-7
    assert material.creep.per_decade_per_MPa == 8e-4
    for old, new, words in (
        ("2e-7", "-2e-7", "cannot be -2e-07"),
        ("940", "0.94", "density"),
        ("reference_min", "reference_s", "not complete"),
        ("archard]", "archerd]", "no wear law"),
        ("sources", "source", "unknown key 'source'"),
    ):
        path.write_text(text.replace(old, new), encoding="utf-8")
        with pytest.raises(InputError, match=words):
            wear_material(path)


def test_a_missing_or_unknown_parameter_of_a_law_is_named():
    assert set(law_names()) >= {"archard", "cross-shear", "pressure-cross-shear", "contact-area"}
    with pytest.raises(InputError, match="does not give 'across_to_along'"):
        wear_law("cross-shear", {"wear_factor_mm3_per_Nm": 1e-6})
    with pytest.raises(InputError, match="has no parameter 'k'"):
        wear_law("archard", {"k": 1e-6})
    with pytest.raises(InputError, match="row per cross-shear"):
        wear_law(
            "pressure-cross-shear",
            {
                "cross_shear": [0.0, 0.5],
                "pressure_MPa": [1.0, 2.0],
                "wear_factor_mm3_per_Nm": [[1e-7, 1e-7]],
            },
        )
