"""`tkamb new` for a person: lengths and masses from published tables, left and right."""

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.starter import lay_out
from tkamb.io.starter.person import Person

FRAMES = slice(0, 6, 5)


def run(scene):
    return tkamb.simulate(scene, contact="foundation", resolution_mm=2.0, frames=FRAMES)


@pytest.fixture(scope="module")
def knees(tmp_path_factory):
    """Return the results of one body's right and left knee."""
    folder, body = tmp_path_factory.mktemp("new"), {"mass": 92.0, "height": 1.83, "sex": "male"}
    return {side: run(lay_out(folder / side, Person(side, **body))) for side in ("right", "left")}


def test_a_left_leg_is_the_mirror_image_of_the_right_one(knees):
    for name in ("force_total_BW", "medial_force_N", "lateral_force_N", "quadriceps_N"):
        np.testing.assert_allclose(knees["left"][name], knees["right"][name], rtol=2e-3)
    for name in [name for name in knees["right"].columns if name.startswith("ligament_")]:
        np.testing.assert_allclose(knees["left"][name], knees["right"][name], rtol=1e-3, atol=0.1)


def test_neither_leg_raises_a_question(knees):
    for results in knees.values():
        assert results.summary["questions"] == []


def test_forces_go_with_body_weight(tmp_path):
    """A change of mass alone scales all weights and the ground reaction, but not the ligaments."""
    light = tkamb.load_scene(lay_out(tmp_path / "light", Person(mass=60.0)), {"ligament": []})
    heavy = tkamb.load_scene(lay_out(tmp_path / "heavy", Person(mass=120.0)), {"ligament": []})
    forces = [
        tkamb.simulate(scene, contact="foundation", resolution_mm=2.0, frames=FRAMES)
        for scene in (light, heavy)
    ]
    np.testing.assert_allclose(forces[1]["quadriceps_N"], 2 * forces[0]["quadriceps_N"], rtol=0.02)


def test_the_urdf_holds_the_published_lengths_and_masses(tmp_path):
    body = Person("left", 68.0, 1.62, "female")
    model = pin.buildModelFromUrdf(str(lay_out(tmp_path / "p", body).parent / "patient.urdf"))
    masses = sum(inertia.mass for inertia in model.inertias)
    assert masses == pytest.approx(68.0 * (0.1478 + 0.0481 + 0.0129) + 0.1, rel=1e-5)
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    places = {f.name: data.oMf[k].translation for k, f in enumerate(model.frames)}
    assert places["tibia"][1] == pytest.approx(0.039 * 1.62, abs=1e-6)
    assert places["hip"][1] - places["femur"][1] == pytest.approx(0.245 * 1.62, abs=5e-3)
    assert places["femur"][1] - places["tibia"][1] == pytest.approx(0.246 * 1.62, abs=2e-2)


def test_the_medial_ligament_is_on_the_medial_side(tmp_path):
    for side, sign in (("right", -1), ("left", 1)):
        scene = tkamb.load_scene(lay_out(tmp_path / side, Person(side)))
        medial = next(bundle for bundle in scene.ligament if bundle.name.startswith("MCL"))
        assert sign * medial.proximal.point_mm[2] > 30.0
        assert sign * medial.distal.point_mm[2] > 25.0


@pytest.mark.parametrize("option", [("--mass-kg", "5"), ("--height-mm", "1.83")])
def test_an_impossible_body_is_refused_and_nothing_is_written(tmp_path, capfd, option):
    assert main(["new", str(tmp_path / "p"), *option]) == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and option[0] in lines[0]
    assert not (tmp_path / "p").exists()


def test_a_person_is_checked_in_python_too():
    with pytest.raises(InputError, match="kg"):
        Person(mass=900.0)
