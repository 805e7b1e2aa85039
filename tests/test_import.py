"""`tkamb import`: a scene from a model, a recording and meshes; and its errors."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

import tkamb
from pendulum_leg import changed, moving_leg, pendulum_osim, recorded_leg
from recordings import write_c3d
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import inverse
from tkamb.io.importing.anatomy import find_leg
from tkamb.io.importing.links import find_links, link_inertias, patient_urdf, quarter_turn
from tkamb.io.importing.model_fit import ModelChain, fit_model
from tkamb.io.importing.soft_tissue import soft_tissue
from tkamb.io.opensim.read import read_osim
from tkamb.io.recordings.markers import matched_labels
from tkamb.io.recordings.meshes import axes_rotation, load_surface
from tkamb.io.recordings.tables import read_table
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.plausibility.movement import marker_questions
from tkamb.show.storage import write_storage, write_trc

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"
JW = DATA / "jw"
needs_jw = pytest.mark.skipif(
    not JW.is_dir(), reason="subject JW's files are not beside the project"
)
AXES = "-x,+y,-z"


def test_a_model_without_implant_becomes_a_scene_that_loads_and_bends(tmp_path, capsys):
    assert main(recorded_leg(tmp_path)) == 0
    output = capsys.readouterr().out
    scene = load_scene(tmp_path / "out" / "scene.toml")
    assert scene.contact is None and scene.motion.markers is not None
    assert "not scaled" in output and "+x,+y,+z" in output and "no implant" in output
    assert "flexion 5.7 to 67.7 deg" in output  # 0.1 to 1.18 rad: the last of 60 frames is skipped


def test_results_of_a_run_on_markers_have_both_fits(tmp_path):
    assert main(recorded_leg(tmp_path)) == 0
    results = tkamb.simulate(tmp_path / "out" / "scene.toml")
    for method in ("segments", "chain"):
        assert results[f"marker_rms_{method}_mm"].max() < 1e-3  # the file has 1e-5 mm
        bend = np.radians(results[f"flexion_{method}_deg"])
        np.testing.assert_allclose(bend, np.linspace(0.1, 1.2, 60)[::2], atol=1e-6)
    assert results["knee_centre_distance_mm"].max() < 1e-2
    np.testing.assert_allclose(results["time_s"], np.arange(60)[::2] / 60.0, atol=1e-8)
    assert "skin markers" in " ".join(results.summary["assumptions"])


@pytest.mark.parametrize(("offset", "asked"), [(10.0, 0), (14.0, 1)])
def test_markers_of_another_subject_are_asked_about(tmp_path, offset, asked):
    """If marker clusters grow by the share c, the rms of a rigid fit is c times the radius."""
    assert main(recorded_leg(tmp_path)) == 0
    scene = load_scene(tmp_path / "out" / "scene.toml")
    segments = scene.motion.markers.segment[:2]
    assert {segment.name for segment in segments} == {"shank", "thigh"}
    clusters = [np.array(list(segment.markers_mm.values())) for segment in segments]
    radii = np.concatenate([cluster - cluster.mean(axis=0) for cluster in clusters])
    larger = 1 + offset / np.sqrt((radii**2).sum(axis=1).mean())
    for segment in segments:
        for name, place in segment.markers_mm.items():
            segment.markers_mm[name] = tuple(larger * np.array(place))
    questions = [str(question) for question in marker_questions(load_case(scene))]
    assert len(questions) == asked
    assert all(
        "the markers of shank and thigh lie 14 mm (rms)" in question for question in questions
    )


def test_the_scene_states_inferred_values(tmp_path):
    assert main(recorded_leg(tmp_path)) == 0
    text = (tmp_path / "out" / "scene.toml").read_text()
    for key in ("laboratory_axes", "interval_s", "neutral_mm", "markers_mm", "method"):
        assert key in text
    assert '"S:' not in text  # The subject's prefix is not part of a marker's name.


def test_the_fit_of_a_model_returns_its_coordinates(tmp_path):
    osim = pendulum_osim(tmp_path / "leg.osim")
    q, markers = moving_leg(osim)
    write_trc(tmp_path / "leg.trc", np.arange(60) / 60.0, markers, 60.0)
    _, fit = fit_model(read_osim(osim), read_table(tmp_path / "leg.trc"))
    assert fit.solved.all()
    np.testing.assert_allclose(fit.state, q, atol=1e-6)  # the file has 1e-8 m


def test_normal_equations_agree_with_finite_differences(tmp_path):
    check_normal_equations(read_osim(pendulum_osim(tmp_path / "leg.osim")))


@needs_jw
def test_normal_equations_agree_with_backwards_joints_and_couplers():
    check_normal_equations(read_osim(JW / "JW.osim"))


def check_normal_equations(model):
    """Assert that gradient and Hessian of the cost agree with finite differences."""
    chain = ModelChain(model, list(model.markers))
    rng = np.random.default_rng(2)
    q = chain.kinematics.coupled(rng.normal(0.0, 0.3, (3, len(model.coordinates))))
    count = len(model.markers)
    target = chain.places(q) + rng.normal(0.0, 0.02, (3, count, 3))
    weights = rng.uniform(0.5, 2.0, (3, count))
    jacobian = np.zeros((3, count, 3, len(chain.free)))
    hessian = np.zeros((3, len(chain.free), len(chain.free)))
    for k in range(len(chain.free)):
        step = np.zeros((3, len(chain.free)))
        step[:, k] = 1e-6
        shifted = [chain.moved(q, s * step) for s in (1, -1)]
        ahead, behind = (chain.places(state) for state in shifted)
        jacobian[..., k] = (ahead - behind) / 2e-6
        ahead, behind = (chain.normal(state, target, weights).right for state in shifted)
        hessian[..., k] = -(ahead - behind) / 2e-6
    result = chain.normal(q, target, weights)
    offset = target - chain.places(q)
    np.testing.assert_allclose(result.cost, np.einsum("fm,fmi,fmi->f", weights, offset, offset))
    right = np.einsum("fm,fmin,fmi->fn", weights, jacobian, offset)
    np.testing.assert_allclose(result.right, right, atol=1e-8)
    matrix = np.einsum("fm,fmin,fmik->fnk", weights, jacobian, jacobian)
    np.testing.assert_allclose(result.matrix, matrix, atol=1e-7)
    np.testing.assert_allclose(result.matrix + result.curvature, hessian, atol=1e-7)


def test_a_motion_in_the_models_coordinates_is_read_through_its_kinematics(tmp_path, capsys):
    osim = pendulum_osim(tmp_path / "leg.osim")
    q, _ = moving_leg(osim)
    names = list(read_osim(osim).coordinates)
    columns = {name: q[:, k] for k, name in enumerate(names)}
    write_storage(tmp_path / "leg.mot", {"time": np.arange(60) / 60.0} | columns, in_degrees=False)
    arguments = ["import", str(osim), "--motion", str(tmp_path / "leg.mot"), "--side", "right"]
    assert main([*arguments, "--mass-kg", "53.5", "--out", str(tmp_path / "out")]) == 0
    notes = load_scene(tmp_path / "out" / "scene.toml").output.notes
    assert any("joint angles" in note for note in notes)
    assert not any("skin markers" in note for note in notes)
    table = read_table(tmp_path / "out" / "motion.csv")
    np.testing.assert_allclose(
        np.radians(table.columns["flexion_deg"]), np.linspace(0.1, 1.2, 60), atol=1e-8
    )
    ankle = np.array([table.columns[f"tibia_translation_{k}_mm"] for k in (1, 2, 3)]).T
    model = read_osim(osim)
    poses = ModelChain(model, list(model.markers)).kinematics.poses(q)
    tibia = poses[:, ["ground", *model.bodies].index("tibia_r")]
    np.testing.assert_allclose(ankle * 1e-3, tibia[:, :3, :3] @ [0, -0.42, 0] + tibia[:, :3, 3])


def bomb(path: Path) -> None:
    entities = "".join(f'<!ENTITY a{k} "{"".join([f"&a{k - 1};"] * 10)}">' for k in range(1, 9))
    head = f'<!DOCTYPE x [<!ENTITY a0 "x">{entities}]>'
    path.write_text(f"{head}<OpenSimDocument>&a8;</OpenSimDocument>")


MISTAKES = {
    "no such model": (lambda a, d: [a[0], str(d / "none.osim"), *a[2:]], "no such"),
    "model is text": (lambda a, d: spoil(a, d, "leg.osim", "hello"), "leg.osim"),
    "model is an XML bomb": (lambda a, d: bomb(d / "leg.osim") or a, "leg.osim"),
    "model cut short": (lambda a, d: halve(a, d, "leg.osim"), "leg.osim"),
    "other side": (lambda a, d: changed(a, side="left"), "left knee"),
    "knee that is not there": (lambda a, d: changed(a, knee="knee_x"), "no joint 'knee_x'"),
    "hip as knee": (lambda a, d: changed(a, knee="hip_r"), "--knee"),
    "pounds": (lambda a, d: changed(a, mass_kg="118"), "--mass-kg"),
    "no mass": (lambda a, d: changed(a, mass_kg="0"), "--mass-kg"),
    "mass is a word": (lambda a, d: changed(a, mass_kg="heavy"), "mass-kg"),
    "negative cut-off": (lambda a, d: changed(a, cutoff_hz="-1"), "--cutoff-hz"),
    "cut-off beyond the rate": (lambda a, d: changed(a, cutoff_hz="40"), "cut-off"),
    "no recording": (lambda a, d: changed(a, trc=None), "required"),
    "recording not there": (lambda a, d: changed(a, trc=str(d / "no.trc")), "no such file"),
    "recording is text": (lambda a, d: spoil(a, d, "leg.trc", "hello"), ".trc"),
    "recording is empty": (lambda a, d: spoil(a, d, "leg.trc", ""), ".trc"),
    "c3d is a trc": (lambda a, d: changed(a, trc=None, c3d=str(rename(d))), "not a C3D"),
    "two recordings": (lambda a, d: changed(a, c3d=str(d / "x.c3d")), "not allowed"),
    "one mesh alone": (lambda a, d: changed(a, femoral=str(d / "f.stl")), "both or none"),
    "button alone": (lambda a, d: changed(a, patella=str(d / "f.stl")), "--patella"),
    "no mesh unit": (
        lambda a, d: changed(a, femoral="f.stl", insert="i.stl", mesh_axes=AXES),
        "--mesh-unit",
    ),
    "no mesh axes": (
        lambda a, d: changed(a, femoral="f.stl", insert="i.stl", mesh_unit="mm"),
        "--mesh-axes",
    ),
    "mesh not there": (
        lambda a, d: changed(
            a, femoral="f.stl", insert="i.stl", mesh_unit="mm", mesh_axes="+x,+y,+z"
        ),
        "no such mesh",
    ),
    "left-handed laboratory": (lambda a, d: changed(a, laboratory_axes="+x,+y,-z"), "left-handed"),
    "laboratory axes of two letters": (lambda a, d: changed(a, laboratory_axes="+x,+y"), "axes"),
    "interval outside": (lambda a, d: changed(a, interval="5:6"), "--interval"),
    "interval that ends after the recording": (
        lambda a, d: changed(a, interval="0.5:1.5"),
        "not within the recording, 0.0000 to 0.9833 s",
    ),
    "interval backwards": (lambda a, d: changed(a, interval="0.9:0.1"), "--interval"),
    "interval of words": (lambda a, d: changed(a, interval="start:end"), "interval"),
    "plates of words": (lambda a, d: changed(a, plates="left"), "plates"),
    "ground reaction not there": (lambda a, d: changed(a, grf=str(d / "g.mot")), "no such file"),
    "ground reaction of no foot": (
        lambda a, d: changed(a, grf=str(unnamed_forces(d))),
        "which force",
    ),
    "standing trial not there": (lambda a, d: changed(a, static=str(d / "s.c3d")), "no such file"),
    "unknown method": (lambda a, d: changed(a, method="magic"), "method"),
    "out is a file": (lambda a, d: changed(a, out=str(d / "leg.trc")), "leg.trc"),
}
SPOILT = {
    "no markers in common": ({"rename": lambda n: n[::-1]}, "markers of the shank"),
    "markers ten times too far": ({"stretch": 10.0}, "have a residual of"),
    "markers in mm, said to be m": ({"stretch": 1000.0}, "have a residual of"),
    "the other foot's labels": ({"osim": {"-0.04 -0.1 0.08": "-0.04 -0.1 0.48"}}, "swapped"),
    "no hip": ({"osim": {"BallJoint": "WeldJoint"}}, ""),
    "model of no mass": ({"osim": {"<mass>40.0</mass>": "<mass>-40.0</mass>"}}, "mass"),
    "mass that is a word": ({"osim": {"<mass>9.0</mass>": "<mass>nine</mass>"}}, "number"),
    "joint that cannot be read": ({"osim": {"PinJoint": "ScrewJoint"}}, "ScrewJoint"),
    "socket to nowhere": ({"osim": {"/bodyset/tibia_r<": "/bodyset/shank<"}}, "knee_r"),
    "tibia twice": ({"osim": {'Body name="foot_r"': 'Body name="tibia_r"'}}, "tibia_r"),
    "old version": ({"osim": {'Version="40000"': 'Version="10000"'}}, "Version"),
    "other root": ({"osim": {"OpenSimDocument": "OpenSimModel"}}, "not an OpenSim model"),
    "location of two numbers": ({"osim": {"-0.04 -0.1 0.08": "-0.04 -0.1"}}, "numbers"),
}


def spoil(arguments: list[str], folder: Path, name: str, text: str) -> list[str]:
    (folder / name).write_text(text)
    return arguments


def halve(arguments: list[str], folder: Path, name: str) -> list[str]:
    text = (folder / name).read_text()
    return spoil(arguments, folder, name, text[: len(text) // 2])


def rename(folder: Path) -> Path:
    path = folder / "leg.c3d"
    path.write_bytes((folder / "leg.trc").read_bytes())
    return path


def unnamed_forces(folder: Path) -> Path:
    time = np.arange(60) / 60.0
    names = [f"plate{k}_v{a}" for k in (1, 2) for a in "xyz"]
    write_storage(folder / "g.mot", {"time": time} | dict.fromkeys(names, 0 * time), False)
    return folder / "g.mot"


@pytest.mark.parametrize("mistake", [*MISTAKES, *SPOILT])
def test_a_mistake_is_one_line_and_nothing_is_written(tmp_path, capsys, mistake):
    if mistake in MISTAKES:
        change, words = MISTAKES[mistake]
        arguments = change(recorded_leg(tmp_path), tmp_path)
    else:
        changes, words = SPOILT[mistake]
        arguments = recorded_leg(tmp_path, **changes)
    try:
        status = main(arguments)
    except SystemExit as refused:  # argparse
        status = refused.code
    lines = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert status == 2, lines
    assert len(lines) == 1 and words in lines[0], lines
    assert not (tmp_path / "out").exists()


def test_an_existing_scene_is_not_replaced(tmp_path, capsys):
    arguments = recorded_leg(tmp_path)
    assert main(arguments) == 0
    before = (tmp_path / "out" / "scene.toml").read_text()
    assert main(arguments) == 2
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "out" / "scene.toml").read_text() == before


def test_the_nearest_quarter_turn_is_returned():
    turn = np.array([[0.1, -0.99, 0.05], [-0.99, -0.1, 0.02], [0.0, 0.05, -1.0]])
    axes, _ = quarter_turn(turn)
    np.testing.assert_array_equal(axes, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]])


@pytest.mark.skipif(not DATA.is_dir(), reason="no shared data beside the project")
@pytest.mark.parametrize("name", ["gait2392", "Rajagopal2016"])
@pytest.mark.parametrize("side", ["right", "left"])
def test_the_legs_of_widely_used_models_are_found(name, side):
    leg = find_leg(read_osim(DATA / "opensim" / f"{name}.osim"), side)
    links = find_links(leg, None, "+x,+y,+z", {}, False)
    assert leg.knee.name.endswith("_" + side[0]) and leg.flexion == f"knee_angle_{side[0]}"
    assert 0.3 < links.insert_in_tibia[1, 3] < 0.5  # m, from ankle to knee
    assert 0.3 < links.hip[1] < 0.5  # m, from knee to hip
    ElementTree.fromstring(patient_urdf(links, 1.0, ""))


@needs_jw
def test_jws_links_are_where_the_data_page_says():
    model = read_osim(JW / "JW.osim")
    mesh = load_surface(JW / "geometry/tibial_insert.stl", "m", AXES, name="insert")
    placement = insert_placement(mesh, axes_rotation(AXES))
    links = find_links(find_leg(model, "right"), placement, AXES, {}, True)
    np.testing.assert_allclose(links.hip * 1e3, [-23.0, 392.0, 23.0], atol=0.05)
    assert links.patella is not None  # x distal, y posterior, z medial
    np.testing.assert_array_equal(links.patella[:3, :3], [[0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    assert soft_tissue(links).ligament_length == pytest.approx(0.0502)
    assert soft_tissue(links).bundles == ()
    assert links.leg.knee.backwards
    scale = 66.7 / model.mass_kg
    inertias = link_inertias(links, scale)
    shank = sum(model.bodies[b].mass_kg for b in (*links.leg.tibia, *links.leg.foot))
    assert inertias["tibia"].mass == pytest.approx(scale * shank)
    np.testing.assert_allclose(links.body_in_link("tibia")[1], inverse(links.tibia), atol=1e-12)


@needs_jw
def test_jws_markers_fit_no_worse_than_opensims_tool():
    recorded = read_table(JW / "motion/jw_ngait_og3.c3d")
    turn = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    model = read_osim(JW / "JW.osim")
    part = {"time": recorded.columns["time"][:120:12]}
    labels = [c[:-2] for c in recorded.columns if c.endswith("_x")]
    for label in matched_labels(model.markers, labels).values():
        path = np.stack([recorded.columns[f"{label}_{a}"] for a in "xyz"], axis=1) @ turn.T
        part |= {f"{label}_{a}": path[:120:12, k] for k, a in enumerate("xyz")}
    _, fit = fit_model(model, type(recorded)(recorded.path, part, "m"))
    assert fit.solved.all()
    # mm: rms of OpenSim 4.6's InverseKinematicsTool at these frames, with the same model, markers
    # and weights, ranges not clamped, accuracy 1e-5.
    tool = [11.774, 10.274, 9.1, 9.46, 12.928, 14.196, 13.894, 14.78, 12.918, 11.831]
    assert np.all(fit.rms < 1e-3 * (np.array(tool) + 0.002))
    assert fit.rms.mean() < 1e-3 * np.mean(tool)


@needs_jw
def test_the_script_writes_the_scenes_that_are_shipped(tmp_path):
    from importlib.machinery import SourceFileLoader
    from importlib.util import module_from_spec, spec_from_loader

    loader = SourceFileLoader("jw_scenes", str(ROOT / "scripts/make/jw_scenes"))
    script = module_from_spec(spec_from_loader("jw_scenes", loader))
    loader.exec_module(script)
    from tkamb.io.importing.patient import import_patient

    patient = import_patient(script.request(JW, "ngait_og3"), ROOT / "models/jw")
    assert patient.scene.text() == (ROOT / "models/jw/ngait_og3.toml").read_text()
    assert patient.urdf == (ROOT / "models/jw/patient.urdf").read_text()
    output = "\n".join(patient.report)
    assert "force plate 2: right" in output and "force plate 1: left" in output
    assert patient.scene.ground is not None and patient.scene.ground.plates == (2, 3)


def test_a_recording_without_plates_asks_for_the_ground_reaction(tmp_path, capsys):
    arguments = recorded_leg(tmp_path)
    _, markers = moving_leg(tmp_path / "plain.osim")
    path = write_c3d(tmp_path / "leg.c3d", markers)
    assert main(changed(arguments, trc=None, c3d=str(path))) == 2
    assert "no force plates" in capsys.readouterr().err


def test_storage_and_trc_come_back_as_written(tmp_path):
    time = np.arange(5) / 50.0
    write_storage(tmp_path / "a.sto", {"time": time, "x": time**2}, in_degrees=True)
    table = read_table(tmp_path / "a.sto")
    np.testing.assert_allclose(table.columns["x"], time**2)
    assert table.in_degrees is True
    places = np.random.default_rng(0).normal(0, 1, (5, 3))
    places[2] = np.nan
    write_trc(tmp_path / "a.trc", time, {"A": places, "B": places + 1}, 50.0)
    table = read_table(tmp_path / "a.trc")
    result = np.stack([table.columns[f"B_{a}"] for a in "xyz"], axis=1)
    np.testing.assert_allclose(result * 1e-3, places + 1, atol=1e-8)
    np.testing.assert_allclose(table.columns["time"], time)
    with pytest.raises(InputError, match="blank"):
        write_storage(tmp_path / "b.sto", {"time": time, "a b": time}, in_degrees=False)
