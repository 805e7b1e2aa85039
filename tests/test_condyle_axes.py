"""Medial and lateral condyles: components that lie askew are refused."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from contact_bodies import dished_insert, flat_insert, graded_sphere
from scenes import write_scene
from shapes import bicondylar, joined, sphere
from tkamb import simulate
from tkamb.cli import main
from tkamb.contact.foundation import LinearFoundation
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.errors import InputError
from tkamb.geometry.condyles import condyle_split, condyle_yaw, orientation
from tkamb.geometry.frames import pose
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.meshes import load_surface
from tkamb.run.press import press_meshes

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"
MODEL = ROOT / "models" / "deep_knee_bend"
MM = 1e-3


@cache
def femoral(kind):
    if kind in ("dm", "jw"):
        path = DATA / kind / "geometry" / "femoral_component.stl"
        if not path.exists():
            pytest.skip("the measured data are missing")
        return load_surface(path, "m", "-x,+y,-z", name=kind)
    if kind == "shipped":
        return load_surface(MODEL / "femoral_component.stl", "mm", "+x,+y,+z", name=kind)
    return bicondylar(kind)


def turned(surface, degrees):
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return Surface(surface.vertices @ turn.T, surface.faces, surface.name)


def mirrored(surface):
    return Surface(surface.vertices * [1, 1, -1], surface.faces[:, ::-1], surface.name)


def slow(*values):
    """Return values that only the slow tests try; the others run the same lines."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


KINDS = ["sphere", "torus", "shipped", "dm", "jw"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("yaw", [20, 90, -33, 125, *slow(45, -64)])
def test_condyles_that_lie_askew_are_refused(kind, yaw):
    with pytest.raises(InputError, match="medial and lateral cannot be distinguished"):
        condyle_split(turned(femoral(kind), yaw))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("yaw", [4, -9])
def test_condyles_that_lie_side_by_side_are_split(kind, yaw):
    component = femoral(kind)
    # The notch of a real component lies behind the origin, so a yaw moves its middle sideways.
    assert condyle_split(turned(component, yaw)) == pytest.approx(
        condyle_split(component), abs=6 * MM
    )
    assert np.degrees(condyle_yaw(turned(component, yaw))[0]) == pytest.approx(yaw, abs=3.0)


@pytest.mark.parametrize("kind", KINDS)
def test_the_split_of_a_mirrored_component_is_mirrored(kind):
    shift = np.eye(4)
    shift[2, 3] = 4 * MM
    shifted = femoral(kind).moved(shift)
    assert condyle_split(mirrored(shifted)) == pytest.approx(-condyle_split(shifted), abs=1.5 * MM)


def one_condyle(kind):
    ball = sphere(20 * MM)
    if kind == "sphere":
        return ball
    if kind == "cylinder":
        mesh = trimesh.creation.cylinder(20 * MM, 50 * MM)
        return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), kind)
    if kind == "runner":  # longer along x than along z
        return Surface(ball.vertices * [1.8, 1.0, 0.5], ball.faces, kind)
    if kind == "cap":
        return Surface(np.minimum(ball.vertices * [1.4, 1, 0.4], [1, 4 * MM, 1]), ball.faces, kind)
    component = femoral("shipped")
    sign = 1.0 if kind == "lateral half" else -1.0
    remaining = (sign * component.triangles[:, :, 2] > 0).all(axis=1)
    return Surface(component.vertices, component.faces[remaining], kind)


@pytest.mark.parametrize("yaw", [0, 20, 90, -30, *slow(45, 75, -60)])
@pytest.mark.parametrize(
    "kind", ["sphere", "cylinder", "runner", "cap", "lateral half", "medial half"]
)
def test_a_single_condyle_is_not_split_at_any_yaw(kind, yaw):
    assert condyle_split(turned(one_condyle(kind), yaw)) is None


@pytest.mark.parametrize("subject", ["dm", "jw"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_half_of_a_real_component_is_not_split_at_any_yaw(subject, sign):
    component = femoral(subject)
    remaining = (sign * component.triangles[:, :, 2] > 0).all(axis=1)
    half = Surface(component.vertices, component.faces[remaining], "half")
    for yaw in (-75, -30, 0, 75):
        assert condyle_split(turned(half, yaw)) is None


AXES = "+z,+y,-x"


def test_press_refuses_exchanged_axes_on_the_command_line(capsys):
    meshes = [str(MODEL / "femoral_component.stl"), str(MODEL / "insert.stl")]
    for contact in ("foundation", "lattice"):
        pressing = ["press", *meshes, f"--axes={AXES}", "--load", "1000", "--contact", contact]
        assert main([*pressing, "--no-cache"] if contact == "lattice" else pressing) == 2
        message = capsys.readouterr().err
        assert (
            "deg from the medial-lateral axis" in message
            and "axes" in message
            and "Traceback" not in message
        )


def test_press_and_run_refuse_exchanged_axes_in_python(tmp_path):
    meshes = MODEL / "femoral_component.stl", MODEL / "insert.stl"
    with pytest.raises(InputError, match="medial and lateral cannot be distinguished"):
        press_meshes(*meshes, 1000.0, axes=AXES, contact="foundation")
    scene = write_scene(tmp_path, implant__femoral__axes=AXES)
    with pytest.raises(InputError, match="medial and lateral cannot be distinguished"):
        simulate(scene, frames=slice(0, 1))


def test_a_press_with_correct_axes_loads_both_condyles(capsys):
    meshes = [str(MODEL / "femoral_component.stl"), str(MODEL / "insert.stl")]
    assert main(["press", *meshes, "--load", "1000", "--contact", "foundation", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["medial"]["force_N"] == pytest.approx(500, rel=0.1)
    assert result["lateral"]["force_N"] == pytest.approx(500, rel=0.1)


LINEAR = material("polyethylene-linear")


def flags_of(femoral, insert, load=500.0):
    model = LinearFoundation(1 * MM)
    return model.press(model.prepare(ContactPair(femoral, insert, LINEAR)), load, np.eye(4)).flags


def test_one_condyle_on_two_separate_patches_is_flagged():
    """A flat bar, which counts as one condyle, lies on two ridges 24 mm apart."""

    ridges = dished_insert(
        lambda x, z: 8 * MM - np.minimum((np.abs(x) - 12 * MM) ** 2 / 40e-3, 3 * MM),
        20 * MM,
        20 * MM,
    )
    bar = flat_insert(8 * MM, half_x=18 * MM, half_z=10 * MM)
    assert any("separate patches 24 mm apart" in flag for flag in flags_of(bar, ridges))


def test_one_condyle_on_one_patch_is_not_flagged():
    assert flags_of(graded_sphere(20 * MM), flat_insert(8 * MM)) == ()


@pytest.mark.parametrize("kind", ["shipped", "dm", "jw"])
def test_the_shape_shows_the_flexion(kind):
    """Flexion within 10 deg, tilt, and direction of the front, at several poses."""
    body = femoral(kind)
    for flexion in (-30.0, 0.0, 90.0, 150.0):
        for turn in (0.0, 20.0, 170.0):
            turned = Rotation.from_euler("YXZ", [turn, 8.0, flexion], degrees=True).as_matrix()
            result = orientation(body, pose(turned, np.zeros(3)))
            assert np.degrees(result.flexion) == pytest.approx(flexion, abs=10.0)
            assert np.degrees(result.tilt) == pytest.approx(8.0, abs=0.1)
            assert result.forward == pytest.approx(np.cos(np.radians(turn)), abs=0.1)


SPHERES_APART = joined(*(sphere(0.005, 3, (0.0, 0.0, z)) for z in (-0.03, 0.03)))


@pytest.mark.parametrize("shape", [sphere(0.02), bicondylar(), SPHERES_APART])
def test_a_body_that_is_not_a_shell_has_no_orientation(shape):
    assert orientation(shape, np.eye(4)) is None
