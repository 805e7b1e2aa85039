"""Six parametric implants: closed meshes in millimetres with the documented radii."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from design_radii import circle_radius, measured_radii
from tkamb.cli import main
from tkamb.contact.registry import contact_model
from tkamb.errors import InputError
from tkamb.geometry.post import find_post
from tkamb.io.recordings.meshes import load_surface
from tkamb.run.press import press_meshes
from tkamb.studies.designs.design import load_design
from tkamb.studies.designs.femoral import SagittalProfile
from tkamb.studies.designs.solids import write_stl
from validation.design_cells import Assumption, PressedDesign, nominal, table_force
from validation.design_tables import FOLDERS, pairs_in_order
from validation.dissertation import designs

ROOT = Path(__file__).parents[1] / "models" / "designs"


@pytest.fixture(scope="module", params=FOLDERS.values())
def design(request):
    return load_design(ROOT / request.param)


def test_there_is_a_design_for_every_column_of_the_tables():
    assert tuple(FOLDERS) == designs()


def test_meshes_have_the_documented_radii(design):
    radii = measured_radii(design)
    assert len(radii) >= 18
    for radius in radii:
        assert radius.measured == pytest.approx(radius.documented, abs=0.05), radius.name


def test_meshes_are_closed_with_outward_normals(design):
    meshes = [design.femoral.mesh(), design.insert.mesh(), design.insert.tray()]
    if design.femoral.cam is not None:
        meshes.append(design.femoral.mesh_with_cam())
    for vertices, faces in meshes:
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume > 0
        assert mesh.body_count == 1


def test_symmetry_bearing_and_post_are_those_of_the_source(design):
    name = design.name
    assert design.symmetric == (name in ("sigma_fb", "sigma_mb", "lps_flex"))
    assert design.bearing == ("mobile" if name == "sigma_mb" else "fixed")
    assert (design.insert.post is not None) == (name in ("sigma_fb", "sigma_mb", "lps_flex"))
    assert {"sagittal", "coronal", "range", "rest"} <= set(design.sources)


def test_deep_flexion_radii_have_the_order_of_the_source():
    radius = {}
    for title, folder in FOLDERS.items():
        profile = load_design(ROOT / folder).femoral.profile
        radius[title] = profile.radii[np.searchsorted(profile.joints, np.radians(100.0))]
    assert radius["LPS-Flex"] < radius["CR-Flex"] < radius["Sigma FB"] == radius["Sigma MB"]
    assert radius["NKII CP"] == radius["NKII UCP"] < radius["Sigma FB"]


def test_mesh_check_passes_and_the_post_is_found(tmp_path, capsys):
    design = load_design(ROOT / "lps_flex")
    files = design.write_meshes(tmp_path)
    assert main(["mesh", "check", *map(str, files)]) == 0
    output = capsys.readouterr().out
    assert output.count("watertight") == len(files) == 4
    assert "millimetres?" in output
    insert = load_surface(tmp_path / "insert.stl", "mm", "+x,+y,+z", name="insert", closed=True)
    assert find_post(insert) is not None
    without_post = replace(design.insert, post=None)
    assert without_post.mesh()[0][:, 1].max() < design.insert.mesh()[0][:, 1].max()


def test_the_cam_does_not_touch_the_eminence():
    """Only LPS-Flex has a cam. Its distance from the eminence is more than 1 mm."""
    cams = {name: load_design(ROOT / name).femoral.cam for name in FOLDERS.values()}
    assert {name for name, cam in cams.items() if cam} == {"lps_flex"}
    design, cam = load_design(ROOT / "lps_flex"), cams["lps_flex"]
    insert, across = replace(design.insert, post=None), np.linspace(-cam.radius, cam.radius, 101)
    below = np.sqrt(cam.radius**2 - across**2)
    for flexion in np.radians(np.arange(0.0, 121.0, 5.0)):
        cosine, sine = np.cos(flexion), np.sin(flexion)
        x = -6.0 + cosine * cam.centre_ap - sine * cam.centre_si + across
        y = 29.5 + sine * cam.centre_ap + cosine * cam.centre_si - below
        assert (y - insert.height(x, np.zeros_like(x))).min() > 1.0
    with pytest.raises(InputError, match="has no cam"):
        load_design(ROOT / "nkii_cp").femoral.mesh_with_cam()
    anterior_cam = replace(design.femoral, cam=replace(cam, centre_ap=40.0))
    with pytest.raises(InputError, match="cannot be joined"):
        anterior_cam.mesh_with_cam()


def test_a_circle_is_measured_exactly():
    angle = np.linspace(0.1, 0.9, 20)
    points = np.array([3.0, -7.0]) + 22.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert circle_radius(points) == pytest.approx(22.0, rel=1e-9)


def test_invalid_arcs_and_keys_are_refused(tmp_path):
    with pytest.raises(InputError, match="do not follow"):
        SagittalProfile([(-90.0, 0.0, 30.0), (10.0, 90.0, 20.0)])
    text = (ROOT / "nkii_cp" / "design.toml").read_text()
    (tmp_path / "design.toml").write_text(text.replace("thickness_mm", "thickness"))
    with pytest.raises(InputError, match="unknown key 'thickness'"):
        load_design(tmp_path)


def test_a_larger_size_follows_the_scaling_law():
    design, size, load = load_design(ROOT / "nkii_cp"), 1.07, 900.0
    pressed = PressedDesign(design, 4.0)
    case = Assumption(0.5, 0.5, 0.0, 0.0, size)
    scaled = pressed.cell("medial", 0.0, load, case)
    pair = pressed.pair("medial")
    femoral, insert = (
        replace(body, vertices=body.vertices * size) for body in (pair.femoral, pair.insert)
    )
    pose = pressed.pose("medial", 0.0, case)
    pose[:3, 3] *= size
    model = contact_model("lattice", resolution=4.0 * size * 1e-3, cache=False)
    state = model.prepare(replace(pair, femoral=femoral, insert=insert))
    direct = model.press(state, load, pose).medial
    assert scaled.area == pytest.approx(direct.area, rel=0.01)
    assert scaled.mean_pressure == pytest.approx(direct.mean_pressure, rel=0.01)


def test_a_condyle_alone_equals_half_of_a_symmetric_pair():
    pressed = PressedDesign(load_design(ROOT / "lps_flex"), 4.0)
    alone = pressed.press_alone("medial", 1.0, 1000.0).medial
    pair = pressed.press_both(1.0, 2000.0)
    assert pair.medial.force == pytest.approx(pair.lateral.force, rel=2e-3)
    assert pair.medial.area == pytest.approx(alone.area, rel=5e-3)
    assert pair.medial.peak_pressure == pytest.approx(alone.peak_pressure, rel=5e-3)


def test_table_force_is_body_weights_of_the_table_times_the_implied_mass():
    assert table_force("LPS-Flex", "medial", 10) == pytest.approx(2.61 * 70.3 * 9.80665, rel=0.01)
    assert nominal().axial_rotation == 0.0 and nominal().size == 1.0


def test_pairs_in_order_counts_agreeing_pairs():
    assert pairs_in_order(np.array([1.0, 2.0, 3.0]), np.array([10.0, 30.0, 20.0])) == (2, 3)


@pytest.mark.slow
def test_thickness_changes_the_pressure_as_finite_elements_say_and_not_as_a_foundation(tmp_path):
    """docs/limits.md: from 8 to 12 mm the peak pressure falls by 2 %; a foundation says 12 %."""
    design = load_design(ROOT / "lps_flex")
    write_stl(tmp_path / "femoral.stl", *replace(design.femoral, cam=None).mesh())

    def change(model, resolution_mm):
        peaks = []
        for thickness in (8.0, 12.0):
            radii = (40.0, 40.0)
            insert = replace(
                design.insert, medial_dish_radii=radii, lateral_dish_radii=radii,
                thickness=thickness, post=None,
            )  # fmt: skip
            write_stl(tmp_path / "insert.stl", *insert.mesh())
            pressed = press_meshes(
                tmp_path / "femoral.stl", tmp_path / "insert.stl", 2000.0, contact=model,
                resolution_mm=resolution_mm, material="polyethylene-linear",
                pose=(0, 40, 0, 0, 0, 0),
            ).as_dict()  # fmt: skip
            peaks.append(pressed["medial"]["peak_pressure_MPa"])
        return peaks[1] / peaks[0] - 1.0

    by_elements = change("fe", 2.5)
    assert -0.05 < by_elements < 0.0
    assert change("lattice", 2.0) == pytest.approx(by_elements, abs=0.02)
    assert change("foundation", 1.0) < by_elements - 0.05
