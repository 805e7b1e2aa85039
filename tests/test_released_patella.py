"""Scenes with [patella] released: the patella in six degrees of freedom in the frames of a run."""

import copy
import re

import numpy as np
import pytest

import tkamb
from mirrored_patient import write_mirrored_patient
from released_patella import RELEASED, bundle, head
from scenes import as_toml, write_scene
from tkamb.errors import InputError
from tkamb.geometry.frames import PATELLA_BODY_COORDINATES

FRAMES = slice(20, 101, 20)
BUTTON = {"model": "foundation", "resolution_mm": 1.0}
STRANDS = RELEASED["ligament"][:2]
INSIDE = bundle("inside", ("patella", 6.0, -21.0, -8.0), ("patella", 8.0, 20.0, 0.0), 20.0)
TURNED = head("turned", 0.0, 0.0, 1.0)
TURNED["origin"], TURNED["insertion"] = TURNED["insertion"], TURNED["origin"]


def released_scene(folder, **changes):
    return write_scene(folder, contact__patellofemoral=BUTTON, patella=RELEASED | changes)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return released_scene(tmp_path_factory.mktemp("released"))


@pytest.fixture(scope="module")
def results(scene):
    return tkamb.simulate(scene, frames=FRAMES)


def coordinates(results):
    units = ("mm", "mm", "mm", "deg", "deg", "deg")
    names = zip(PATELLA_BODY_COORDINATES, units, strict=True)
    return np.array([results[f"patella_{name}_{unit}"] for name, unit in names]).T


def test_a_plane_patella_has_no_columns_of_a_released_one(tmp_path):
    plane = tkamb.simulate(write_scene(tmp_path), frames=slice(40, 41))
    assert not any(name.startswith(("patella_tilt", "patella_line")) for name in plane.columns)


def test_the_patella_is_in_equilibrium_in_every_frame(results):
    assert not any("patella:" in status for status in results.status)
    assert (results["patella_residual_N"] <= 1e-6 * results["quadriceps_N"]).all()
    assert np.isfinite(coordinates(results)).all()
    # The patellar ligament of the equations is the resultant of its strands, which spread a little.
    strands = sum(results[f"patella_line_strand_{side}_N"] for side in ("medial", "lateral"))
    assert strands == pytest.approx(results["patellar_ligament_N"], rel=0.01)
    assert (strands >= results["patellar_ligament_N"]).all()
    # The patellofemoral force of the equations is that of the contact, which is frictionless.
    assert results["patellofemoral_N"] == pytest.approx(results["button_force_N"], rel=1e-6)
    assert (results["button_imbalance_N"] <= 1e-6 * results["quadriceps_N"]).all()


def test_a_run_and_the_object_find_the_same_patella(scene, results):
    """`Knee.patella_equilibrium` with the same lines, and the tension of each frame."""
    knee, motion, _ = tkamb.read_scene(scene)
    lines = [
        tkamb.Ligament(
            one["name"],
            *(
                tkamb.LinkPoint(one[end]["link"], 1e-3 * np.array(one[end]["point_mm"]))
                for end in ("proximal", "distal")
            ),
            tkamb.TwoLine(stiffness=1e3 * one["stiffness_N_per_mm"]),
            slack_length=1e-3 * one["slack_length_mm"],
        )
        for one in RELEASED["ligament"]
    ]
    heads = [
        tkamb.Muscle(
            one["name"],
            tuple(
                (one[end]["link"], tuple(1e-3 * np.array(one[end]["point_mm"])))
                for end in ("origin", "insertion")
            ),
        )
        for one in RELEASED["head"]
    ]
    own = tkamb.Knee(
        knee.model,
        implant=tkamb.Implant(knee.femoral, knee.insert, knee.button, placed=True),
        extensor=knee.extensor,
        ligaments=lines,
        muscles=heads,
        patellofemoral_contact=tkamb.contact_model("foundation", resolution=1e-3),
    )
    for row, frame in enumerate(range(*FRAMES.indices(len(motion)))):
        tension = results["quadriceps_N"][row]
        tensions = {one["name"]: one["share"] * tension for one in RELEASED["head"]}
        found = own.patella_equilibrium(motion.q[frame], tensions)
        mine = [found.coordinates[name] for name in PATELLA_BODY_COORDINATES]
        scale = [1e3] * 3 + [180.0 / np.pi] * 3
        assert np.array(mine) * scale == pytest.approx(coordinates(results)[row], abs=1e-5)
        peak = 1e6 * results["button_peak_pressure_MPa"][row]
        assert found.contact.contact.pressure.max() == pytest.approx(peak, rel=1e-5)


def test_a_left_patient_has_the_same_shift_and_tilt(results, tmp_path):
    import tomllib

    path = write_mirrored_patient(tmp_path)
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    patella = copy.deepcopy(RELEASED)
    for one in (*patella["head"], *patella["ligament"]):
        for end in set(one) & {"origin", "insertion", "proximal", "distal"}:
            one[end]["point_mm"][2] *= -1.0
    content["patella"], content["contact"]["patellofemoral"] = patella, BUTTON
    path.write_text(as_toml(content), encoding="utf-8")
    left = tkamb.simulate(path, frames=FRAMES)
    assert coordinates(left) == pytest.approx(coordinates(results), abs=1e-5)
    for name in ("button_medial_force_N", "button_lateral_force_N"):
        assert left[name] == pytest.approx(results[name], rel=1e-5)


def test_a_resumed_run_finds_the_same_patella(scene, tmp_path):
    frames = slice(40, 44)
    whole = tkamb.simulate(scene, frames=frames)

    def stop(indices):
        yield from list(indices)[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tkamb.simulate(scene, frames=frames, directory=tmp_path, progress=stop)
    tkamb.simulate(scene, frames=frames, directory=tmp_path, resume=True)
    resumed = tkamb.read_results(tmp_path)
    assert coordinates(resumed) == pytest.approx(coordinates(whole), abs=1e-5)


def test_released_coordinates_are_those_of_the_scene(tmp_path):
    held = released_scene(tmp_path, released=["ap", "si", "flexion", "tilt"])
    results = tkamb.simulate(held, frames=slice(60, 61))
    assert results["patella_shift_mm"][0] == results["patella_rotation_deg"][0] == 0.0
    assert abs(results["patella_tilt_deg"][0]) > 1e-3


def test_a_frame_does_not_depend_on_the_frame_before(scene):
    """One frame after another frame, and alone: pose and tension are solved to the end."""
    together = tkamb.simulate(scene, frames=slice(30, 71, 40))
    alone = tkamb.simulate(scene, frames=slice(70, 71))
    assert coordinates(together)[1] == pytest.approx(coordinates(alone)[0], abs=1e-6)
    for name in ("quadriceps_N", "patellar_ligament_N", "patellofemoral_N", "force_total_N"):
        assert together[name][1] == pytest.approx(alone[name][0], rel=1e-7)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ligament": []}, "released"),
        ({"head": RELEASED["head"][:2]}, "do not sum to 1"),
        ({"released": ["tild"]}, "released"),
        ({"released": ["ap", "tilt"]}, "needs ap, si and flexion"),
        ({"ligament": RELEASED["ligament"][2:]}, "patella to the tibia"),
        ({"ligament": RELEASED["ligament"] * 2}, "named twice"),
        ({"ligament": [*STRANDS, INSIDE]}, "inside: has both ends on the patella"),
        ({"ligament": [*STRANDS, INSIDE | {"name": "LCL"}]}, r"'LCL' is in \[\[ligament"),
        ({"head": [TURNED]}, "origin on the femur and an insertion on the patella"),
    ],
)
def test_tables_that_do_not_fit_are_refused(tmp_path, changes, words):
    path = released_scene(tmp_path, **changes)
    with pytest.raises(InputError, match=words):
        tkamb.simulate(path, frames=slice(0, 1))


def test_a_lost_patella_is_in_the_status(tmp_path):
    """Strands of 290 mm are slack: nothing holds the patella against the quadriceps."""
    slack = [one | {"slack_length_mm": 290.0} for one in RELEASED["ligament"]]
    results = tkamb.simulate(released_scene(tmp_path, ligament=slack), frames=slice(50, 51))
    assert results.status[0].startswith("failed: patella: ")
    assert np.isnan(coordinates(results)).all() and np.isnan(results["button_force_N"][0])
    assert np.isnan(results["force_total_N"][0])


def test_check_describes_the_released_patella(tmp_path):
    from tkamb.show.scene_check import check_scene

    metres = copy.deepcopy(RELEASED["ligament"])
    metres[0]["distal"]["point_mm"] = [0.038, 0.3928, -0.002]
    lines = "\n".join(check_scene(released_scene(tmp_path, ligament=metres)).lines())
    assert "30 % lateral" in lines and "retinaculum_medial" in lines
    assert "out-of-plane motion of the patella" not in lines
    assert "at the patella's pose in its sagittal plane" not in lines
    assert "strand_medial distal: within 1 mm of the link's origin" in lines


def test_a_second_computation_and_a_comparison_ignore_times(scene, tmp_path, capfd):
    from tkamb.cli import main

    out = str(tmp_path / "out")
    assert main(["run", str(scene), "--frames", "40:61:20", "--out", out]) == 0
    assert main(["verify", out, "--rerun"]) == 0
    capfd.readouterr()
    assert main(["compare", out, out, "--out", str(tmp_path / "compared")]) == 0
    assert "button_contact_seconds" not in capfd.readouterr().out


def test_errors_of_inputs_reach_the_released_patella(scene):
    from tkamb.io.scene.case import load_case
    from tkamb.studies.uncertainty.inputs import Draw, VariedInput
    from tkamb.studies.uncertainty.sample import varied_case

    case = load_case(tkamb.load_scene(scene))
    errors = {
        "femoral_placement.ap": (1.0, "mm"),
        "tuberosity.si": (2.0, "mm"),
        "muscle_attachment.quadriceps.insertion.ml": (3.0, "mm"),
        "ligament_stiffness.strand_medial": (0.1, "relative"),
    }
    inputs = tuple(VariedInput(name, 1.0, unit) for name, (_, unit) in errors.items())
    values = np.array([value for value, _ in errors.values()])
    draw = Draw(inputs, values, np.zeros((len(case.motion.time), 0)), 1.0)
    sample = varied_case(case, draw)
    for old, new in zip(case.patella_heads, sample.patella_heads, strict=True):
        moved = [
            1e3 * (getattr(new, end).position - getattr(old, end).position)
            for end in ("origin", "insertion")
        ]
        assert np.array(moved) == pytest.approx(np.array([[1, 0, 0], [0, 0, 3]]), abs=1e-9)
    pairs = list(zip(case.patella_ligaments, sample.patella_ligaments, strict=True))
    strand, retinaculum = pairs[0], pairs[2]
    tibial = strand[1].distal.position - strand[0].distal.position
    femoral = retinaculum[1].proximal.position - retinaculum[0].proximal.position
    assert 1e3 * tibial == pytest.approx([0.0, 2.0, 0.0])
    assert 1e3 * femoral == pytest.approx([1.0, 0.0, 0.0])
    factor = draw.factor("ligament_stiffness.strand_medial")
    assert strand[1].law.stiffness == pytest.approx(factor * strand[0].law.stiffness)
    assert abs(factor - 1.0) > 0.1
    assert retinaculum[1].law.stiffness == retinaculum[0].law.stiffness


def test_a_sample_with_a_reference_strain_has_all_frames(scene, tmp_path):
    """A strand's reference strain belongs to a frame that a thinned motion may not have."""
    from tkamb.io.scene.case import load_case
    from tkamb.studies.uncertainty.sample import thinnable

    strands = [one | {"reference_strain": 0.03} for one in RELEASED["ligament"]]
    for one in strands:
        del one["slack_length_mm"]
    assert thinnable(load_case(tkamb.load_scene(scene)))
    assert not thinnable(load_case(tkamb.load_scene(released_scene(tmp_path, ligament=strands))))


def test_a_patella_that_its_lines_lift_off_is_in_the_status(tmp_path):
    lifts = [
        bundle(f"lift_{k}", ("femur", 103.0, y, z), ("patella", 8.0, y, z), 200.0)
        for k, (y, z) in enumerate(((15.0, 0.0), (-10.0, -10.0), (-10.0, 10.0)))
    ]
    lines = [*RELEASED["ligament"], *lifts]
    results = tkamb.simulate(released_scene(tmp_path, ligament=lines), frames=slice(5, 6))
    assert "the button is not in contact" in results.status[0]
    assert np.isnan(coordinates(results)).all() and np.isnan(results["button_force_N"][0])


def test_a_failed_run_has_the_columns_of_the_button(tmp_path):
    """The button lies 50 mm behind its place, so that no frame has a patellofemoral force."""
    path = released_scene(tmp_path, motion="recorded")
    text = path.read_text(encoding="utf-8")
    behind = text.replace('patellar_button.stl"', 'patellar_button.stl", position_mm = [-50, 0, 0]')
    assert behind != text
    path.write_text(behind, encoding="utf-8")
    results = tkamb.simulate(path, frames=slice(40, 41))
    assert results.status[0].startswith("failed")
    assert np.isnan(results["button_force_N"][0]) and np.isnan(results["patella_tilt_deg"][0])


@pytest.mark.parametrize("released", [(), ("ap", "ml", "axial_rotation", "adduction")])
def test_muscles_of_the_leg_pull_the_released_patella(released):
    """Static optimisation, equations and patella agree on the tension of the quadriceps."""
    from scenes import MODEL
    from shared_trials import two_flexors
    from tkamb.io.scene.case import load_case
    from tkamb.run.muscles.shared_muscles import SharedMuscles
    from tkamb.run.read_scene import recording_of

    choice = {f"patella.{key}": value for key, value in RELEASED.items()}
    choice |= {"contact.model": "foundation", "contact.patellofemoral": BUTTON}
    if released:
        choice["contact.released"] = list(released)
    recording = recording_of(load_case(tkamb.load_scene(MODEL / "scene.toml", choice)))
    trial = two_flexors(len(recording.motion), least=0.02)
    recording.muscles = SharedMuscles(trial)
    for k in (40, 60):
        frame = recording.frame(k)
        assert not frame.failures
        tension = frame.geometry.extensor.tension(frame.loads.values)
        shared = recording.muscles.frame(k).tension(frame.geometry.share)
        assert frame.geometry.extensor.released.tension == pytest.approx(tension, rel=1e-7)
        assert shared == pytest.approx(tension, rel=1e-4 if released else 1e-7)
        assert frame.patella.balance.residual <= 1e-6 * tension


def moved_z(table, end, z):
    point = [*table[end]["point_mm"][:2], z]
    return table | {end: table[end] | {"point_mm": point}}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"head": [*RELEASED["head"][:2], moved_z(RELEASED["head"][2], "insertion", -12.0)]},
            r"lateral insertion, 12 mm medial",
        ),
        (
            {
                "ligament": [
                    *RELEASED["ligament"][:3],
                    moved_z(RELEASED["ligament"][3], "proximal", -42.0),
                ]
            },
            r"retinaculum_lateral distal: its other end, 42 mm medial",
        ),
        (
            {"ligament": [one | {"slack_length_mm": 48.0} for one in RELEASED["ligament"]]},
            r"retinaculum_\w+ .*strain beyond 15 %",
        ),
    ],
)
def test_check_asks_about_unlikely_lines_of_the_patella(tmp_path, changes, words):
    from tkamb.io.scene.case import load_case
    from tkamb.run.plausibility.plausibility import Plausibility
    from tkamb.run.read_scene import recording_of

    texts = []
    for number, change in enumerate(({}, changes)):
        case = load_case(tkamb.load_scene(released_scene(tmp_path / str(number), **change)))
        questions = Plausibility(case, recording_of(case)).questions
        texts.append(" ".join(question.text for question in questions))
    assert not re.search(words, texts[0])
    assert re.search(words, texts[1]), texts[1]


def test_the_viewer_draws_the_released_patella(scene, tmp_path):
    from tkamb.geometry.frames import transform
    from tkamb.show.view.draw import draw
    from tkamb.show.view.payload import pack
    from tkamb.show.view.run import run_of_results

    results = tkamb.simulate(scene, frames=FRAMES, directory=tmp_path)
    run = run_of_results(tkamb.read_results(tmp_path))
    drawing = draw(run)
    frames = range(*FRAMES.indices(101))
    found = [run.recording.loads(k).geometry.extensor.released.found for k in frames]
    solids = {one.name: one for one in drawing.solids}
    poses = np.array([one.poses["patella"] for one in found])
    # The femur is drawn at its press, and the patella with it.
    drawn = np.linalg.inv(solids["femoral component"].poses) @ solids["patella"].poses
    on_femur = np.linalg.inv([one.poses["femur"] for one in found]) @ poses
    assert drawn == pytest.approx(on_femur, abs=1e-8)
    assert drawing.button_map.pressure.max(axis=1) == pytest.approx(
        results["button_peak_pressure_MPa"], rel=1e-9
    )
    # The pressed points lie at the femoral component.
    femoral = solids["femoral component"]
    for k in range(len(found)):
        pressed = drawing.button_map.pressure[k] > 0.0
        points = transform(drawing.button_map.poses[k], drawing.button_map.points[pressed])
        on_femur = transform(np.linalg.inv(femoral.poses[k]), points)
        assert femoral.surface.nearest.at(on_femur).distance.max() < 1.5e-3
    strands = {one.name: one for one in drawing.strands}
    for one in RELEASED["ligament"]:
        ends = strands[one["name"].replace("_", " ")].points
        at = [
            transform(pose, 1e-3 * np.array(one[end]["point_mm"]))
            for pose in poses
            for end in ("proximal", "distal")
            if one[end]["link"] == "patella"
        ]
        gap = np.linalg.norm(ends - np.array(at)[:, None], axis=2).min(axis=1)
        assert gap == pytest.approx(0.0, abs=1e-4)
    heads = [strands[one["name"].replace("_", " ")] for one in RELEASED["head"]]
    assert all(np.isfinite(one.points).all() for one in heads)
    assert "· patella, lateral tilt" in {row.name for row in drawing.readings}
    assert len(pack([drawing])) > 1000


def test_maps_of_the_button_for_paraview(scene, tmp_path, capsys):
    from tkamb.cli import main
    from tkamb.io.recordings.polygon_files import read_vtp_values

    out, vtk = tmp_path / "out", tmp_path / "vtk"
    results = tkamb.simulate(scene, frames=slice(40, 61, 20), directory=out)
    assert main(["export", str(out), "--vtp", "--out", str(vtk)]) == 0
    assert "button.pvd: 2 of 2 frames" in capsys.readouterr().out
    pressure = read_vtp_values(vtk / "button_0001.vtp", "pressure_Pa")
    assert 1e-6 * pressure.max() == pytest.approx(results["button_peak_pressure_MPa"][1], rel=1e-9)


def test_the_button_wears_by_load_times_path(scene, tmp_path, capsys):
    """Archard's law: volume = k N sum of force times path, here by the nodal forces of the run."""
    import json

    from tkamb.cli import main
    from tkamb.geometry.frames import transform
    from tkamb.studies.wear.run import prepare_wear

    out, worn = tmp_path / "out", tmp_path / "worn"
    results = tkamb.simulate(scene, frames=slice(30, 91, 10), directory=out)
    words = ["--part", "button", "--law", "archard", "--wear-factor", "1e-7", "--cycles", "1e6"]
    words += ["--updates", "1", "--close", "as recorded", "--out", str(worn)]
    assert main(["wear", str(out), *words]) == 0
    assert "unworn button" in capsys.readouterr().out
    found = json.loads((worn / "wear.json").read_text(encoding="utf-8"))
    assert found["part"] == "button" and (worn / "worn_button.stl").is_file()
    maps, total = results.button_maps, 0.0
    forces = [np.linalg.norm(maps.frame_data(k)["nodal_force_N"], axis=1) for k in range(7)]
    for k in range(6):
        move = maps.femoral_pose[k + 1] @ np.linalg.inv(maps.femoral_pose[k])
        path = transform(move, maps.points_m) - maps.points_m
        # The path is tangential: its part along the force of the node is no sliding.
        along = sum(maps.frame_data(i)["nodal_force_N"] for i in (k, k + 1))
        size = np.linalg.norm(along, axis=1, keepdims=True)
        unit = along / np.where(size > 0.0, size, 1.0)
        path -= np.einsum("ij,ij->i", path, unit)[:, None] * unit
        total += float(0.5 * (forces[k] + forces[k + 1]) @ np.linalg.norm(path, axis=1))
    expected = 1e-7 * 1e6 * total  # mm³/(N m), cycles, N m
    assert found["volume_mm3"] == pytest.approx(expected, rel=0.03)
    # The viewer of the run does not take it for the insert's wear.
    assert main(["wear", str(out), *words[:2], "--simulator", "none.csv"]) == 2
    assert "a simulator has no patella" in capsys.readouterr().err
    with pytest.raises(InputError, match="no maps of the patellar button"):
        prepare_wear(scene, part="button", cycles=10)
