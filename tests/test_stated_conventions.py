"""Conventions that a model states are read: gravity, names of axes, units of length."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from opensim_models import OWN
from pendulum_leg import changed, moving_leg, pendulum_osim, recorded_leg
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.importing.anatomy import find_leg
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.motion import inverse_dynamics
from tkamb.io.opensim.read import read_osim
from tkamb.io.recordings.tables import read_table
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.show.storage import write_storage

ROOT_FRAME = re.compile(r'(<PhysicalOffsetFrame name="root_p">.*?<orientation>)0 0 0')
Q_TURN = np.array([0.3, -0.2, 0.5])


def turned_leg(path: Path, turn: np.ndarray) -> Path:
    """Write the pendulum leg in a ground that is turned by a rotation (3, 3)."""
    text = pendulum_osim(path).read_text()
    angles = " ".join(map(repr, Rotation.from_matrix(turn).as_euler("XYZ").tolist()))
    text = ROOT_FRAME.sub(rf"\g<1>{angles}", text)
    gravity = " ".join(map(repr, (turn @ [0.0, -9.80665, 0.0]).tolist()))
    path.write_text(text.replace("0 -9.80665 0", gravity))
    return path


def about(axis: str, degrees: float) -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


GROUNDS = {
    "z up": (about("x", 90), "+x,+z,-y"),
    "z down": (about("x", -90), "+x,-z,+y"),
    "x up": (about("z", -90), "-y,+x,+z"),
    "x down": (about("z", 90), "+y,-x,+z"),
    "y down": (about("x", 180), "+x,-y,-z"),
    "oblique": (Rotation.from_euler("XYZ", Q_TURN).as_matrix(), None),
    "almost down": (about("x", 179.9), None),
}


@pytest.mark.parametrize("name", GROUNDS)
def test_gravity_says_where_up_is(tmp_path, name):
    """The same leg in a turned ground needs the same joint moments, with gravity along -y."""
    turn, axes = GROUNDS[name]
    q, _ = moving_leg(pendulum_osim(tmp_path / "plain.osim"), 5)
    plain, leg = (
        Kinematics(read_osim(path))
        for path in (tmp_path / "plain.osim", turned_leg(tmp_path / "a.osim", turn))
    )
    np.testing.assert_allclose(leg.model.gravity, [0.0, -9.80665, 0.0], atol=1e-12)
    assert leg.model.ground_axes == axes and len(leg.model.notices) == 1
    assert "its gravity is" in leg.model.notices[0]
    moments = [inverse_dynamics(k, q, 0.3 * q, 0.1 * q) for k in (plain, leg)]
    np.testing.assert_allclose(*moments, atol=1e-9)
    heights = [k.poses(q)[:, :, 1, 3] for k in (plain, leg)]
    np.testing.assert_allclose(*heights, atol=1e-12)
    if axes:  # the turn of ground is undone, so that the axes name it
        rows = [np.eye(3)["xyz".index(a[1])] * (-1 if a[0] == "-" else 1) for a in axes.split(",")]
        np.testing.assert_allclose(np.array(rows) @ turn, np.eye(3), atol=1e-12)


def test_markers_and_wraps_that_are_fixed_to_ground_turn_with_it(tmp_path):
    text = turned_leg(tmp_path / "a.osim", about("x", 90)).read_text()
    marker = (
        '<MarkerSet name="m"><objects><Marker name="post"><socket_parent_frame>/ground'
        "</socket_parent_frame><location>0.1 -0.3 0.2</location></Marker>"
    )
    sphere = (
        '<Ground name="ground"><WrapObjectSet><objects><WrapSphere name="ball"><radius>0.1</radius>'
        "<translation>0.1 -0.3 0.2</translation></WrapSphere></objects></WrapObjectSet></Ground>"
    )
    text = text.replace('<MarkerSet name="m"><objects>', marker)
    (tmp_path / "a.osim").write_text(text.replace("<BodySet", sphere + "<BodySet"))
    model = read_osim(tmp_path / "a.osim")
    np.testing.assert_allclose(model.markers["post"].location, [0.1, 0.2, 0.3], atol=1e-15)
    ball = model.wrap_objects["ball"].pose[:3, 3]
    np.testing.assert_allclose(ball, [0.1, 0.2, 0.3], atol=1e-15)


def motion_import(tmp_path: Path, osim: Path, out: str, *options: str) -> list[str]:
    """Write a standing motion in the model's coordinates; return an import's arguments."""
    q, _ = moving_leg(pendulum_osim(tmp_path / "plain.osim"))
    columns = {name: q[:, k] for k, name in enumerate(read_osim(osim).coordinates)}
    write_storage(tmp_path / "leg.mot", {"time": np.arange(60) / 60.0} | columns, in_degrees=False)
    arguments = ["--motion", str(tmp_path / "leg.mot"), "--side", "right", "--mass-kg", "53.5"]
    return ["import", str(osim), *arguments, *options, "--out", str(tmp_path / out)]


def push(tmp_path: Path, turn: np.ndarray, name: str = "g.mot") -> str:
    """Write a constant force under the foot, in the axes of a turned ground."""
    osim = pendulum_osim(tmp_path / "plain.osim")
    q, _ = moving_leg(osim)
    model = read_osim(osim)
    foot = Kinematics(model).poses(q)[:, ["ground", *model.bodies].index("foot_r"), :3, 3]
    foot[:, 1] = 0.0
    vectors = {"v": np.tile([15.0, 400.0, -8.0], (60, 1)), "p": foot}
    columns = {"time": np.arange(60) / 60.0}
    for kind, values in vectors.items():
        for axis, column in zip("xyz", (values @ turn.T).T, strict=True):
            columns[f"ground_force_r_{kind}{axis}"] = column
    write_storage(tmp_path / name, columns, in_degrees=False)
    return str(tmp_path / name)


@pytest.mark.parametrize("name", ["z up", "x down", "y down"])
def test_a_motion_and_its_force_in_a_turned_ground_give_the_same_case(tmp_path, capsys, name):
    turn, axes = GROUNDS[name]
    plain = pendulum_osim(tmp_path / "plain.osim")
    assert main(motion_import(tmp_path, plain, "plain", "--grf", push(tmp_path, np.eye(3)))) == 0
    osim = turned_leg(tmp_path / "a.osim", turn)
    assert (
        main(motion_import(tmp_path, osim, "turned", "--grf", push(tmp_path, turn, "t.mot"))) == 0
    )
    assert f"forward, up, right are {axes} of the model's ground" in capsys.readouterr().out
    first, second = (
        load_case(load_scene(tmp_path / n / "scene.toml")) for n in ("plain", "turned")
    )
    np.testing.assert_allclose(second.ground.force, first.ground.force, atol=1e-6)
    np.testing.assert_allclose(second.ground.point, first.ground.point, atol=1e-6)
    np.testing.assert_allclose(second.tibia.pose, first.tibia.pose, atol=1e-6)


def test_forces_in_a_ground_of_oblique_or_no_gravity_are_refused(tmp_path, capsys):
    osim = turned_leg(tmp_path / "a.osim", GROUNDS["oblique"][0])
    assert main(motion_import(tmp_path, osim, "a", "--grf", push(tmp_path, np.eye(3)))) == 2
    assert "turn ground so that gravity is along an axis" in capsys.readouterr().err
    assert main(motion_import(tmp_path, osim, "b")) == 0
    floating = pendulum_osim(tmp_path / "a.osim", {"0 -9.80665 0": "0 0 0"})
    assert main(motion_import(tmp_path, floating, "c")) == 2
    assert "has no gravity" in capsys.readouterr().err


def test_gravity_of_another_planet_is_named(tmp_path):
    for size, count in ((9.81, 0), (9.78, 0), (1.62, 1)):
        path = pendulum_osim(tmp_path / "a.osim", {"0 -9.80665 0": f"0 -{size} 0"})
        assert len(read_osim(path).notices) == count


# Names of axes

AXIS = re.compile(r'<TransformAxis name="\w+">.*?</TransformAxis>', re.S)
ORDERS = {"reversed": [5, 4, 3, 2, 1, 0], "mixed": [3, 0, 4, 1, 5, 2], "turned": [2, 0, 1, 4, 3, 5]}


def reordered(order: list[int]) -> str:
    """Return a model with the axes of every joint in another order, names kept."""

    def of_joint(match: re.Match) -> str:
        parts = [m[0] for m in AXIS.finditer(match[0])]
        new = iter([parts[k] for k in order] if len(parts) == 6 else parts)
        return AXIS.sub(lambda _: next(new), match[0])

    text = OWN["new_layout"].read_text(encoding="utf-8")
    return re.sub(r"<SpatialTransform.*?</SpatialTransform>", of_joint, text, flags=re.S)


@pytest.mark.parametrize("order", ORDERS)
def test_axes_of_a_joint_act_by_their_names(tmp_path, order):
    (tmp_path / "a.osim").write_text(reordered(ORDERS[order]), encoding="utf-8")
    assert reordered(ORDERS[order]) != OWN["new_layout"].read_text(encoding="utf-8")
    chains = [Kinematics(read_osim(path)) for path in (OWN["new_layout"], tmp_path / "a.osim")]
    q = np.linspace(-0.3, 0.4, len(chains[0].coordinates))
    np.testing.assert_array_equal(*(chain.poses(q) for chain in chains))


def test_axes_without_names_or_in_elements_of_their_name_are_read(tmp_path):
    text = OWN["new_layout"].read_text(encoding="utf-8")
    unnamed = re.sub(r'<TransformAxis name="\w+">', "<TransformAxis>", text)
    inside = re.sub(
        r'<TransformAxis name="(\w+)">(.*?)</TransformAxis>',
        r"<\1><TransformAxis>\2</TransformAxis></\1>",
        reordered(ORDERS["mixed"]),
        flags=re.S,
    )
    q = None
    for k, form in enumerate((unnamed, inside)):
        (tmp_path / f"{k}.osim").write_text(form, encoding="utf-8")
        chains = [Kinematics(read_osim(p)) for p in (OWN["new_layout"], tmp_path / f"{k}.osim")]
        q = np.linspace(-0.3, 0.4, len(chains[0].coordinates))
        np.testing.assert_array_equal(*(chain.poses(q) for chain in chains))


@pytest.mark.parametrize("name", ["rotation2", "spin"])
def test_two_axes_of_one_name_or_an_unknown_name_are_refused(tmp_path, name):
    text = OWN["new_layout"].read_text(encoding="utf-8")
    (tmp_path / "a.osim").write_text(text.replace('"rotation1"', f'"{name}"'), encoding="utf-8")
    with pytest.raises(InputError, match="name each axis once: rotation1"):
        read_osim(tmp_path / "a.osim")


# Units, welds


@pytest.mark.parametrize("word", ["Unassigned", "unassigned", "Unknown"])
def test_lengths_without_a_unit_are_metres_as_in_opensim(tmp_path, word):
    text = OWN["new_layout"].read_text(encoding="utf-8")
    text = text.replace("<length_units>meters", f"<length_units>{word}")
    (tmp_path / "a.osim").write_text(text, encoding="utf-8")
    model = read_osim(tmp_path / "a.osim")
    assert model.notices == (f"its length_units is '{word}': meters, as in OpenSim",)
    units = f"<length_units>{word}</length_units><gravity>"
    leg = {"0 -0.42 0": "0 -420 0", "<gravity>": units}
    with pytest.raises(InputError, match="which is no length in metres"):
        read_osim(pendulum_osim(tmp_path / "leg.osim", leg))


WELDED = {
    "thigh": ("BallJoint", "hip_r", "/bodyset/pelvis"),
    "shank": ("PinJoint", "knee_r", "/bodyset/femur_r"),
    "foot": ("PinJoint", "ankle_r", "/bodyset/tibia_r"),
}


def welded_leg(path: Path, segment: str) -> Path:
    """Write the pendulum leg with a segment that is welded to ground in place of its joint."""
    kind, name, parent = WELDED[segment]
    text = pendulum_osim(path).read_text()
    joint = re.search(rf'<{kind} name="{name}">.*?</{kind}>', text)[0]
    weld = re.sub("<coordinates>.*?</coordinates>", "", joint).replace(kind, "WeldJoint")
    path.write_text(text.replace(joint, weld.replace(parent, "/ground")))
    return path


@pytest.mark.parametrize("segment", WELDED)
def test_a_segment_that_is_welded_to_ground_is_named(tmp_path, segment):
    words = {"thigh": "'femur_r' .* welded to ground", "shank": "knee", "foot": "one joint below"}
    with pytest.raises(InputError, match=words[segment]):
        find_leg(read_osim(welded_leg(tmp_path / "leg.osim", segment), partial=True), "right")


def test_a_knee_whose_shank_is_welded_to_ground_is_named(tmp_path):
    """The knee moves the thigh against a fixed shank, as on a test bench."""
    path = pendulum_osim(tmp_path / "leg.osim")
    joints = re.findall(r'<(\w+Joint) name="(\w+)">', path.read_text())
    assert joints[0] == ("FreeJoint", "root")
    free = re.search(r'<FreeJoint name="root">.*?</FreeJoint>', path.read_text())[0]
    weld = re.sub("<coordinates>.*?</coordinates>", "", free).replace("FreeJoint", "WeldJoint")
    weld = weld.replace("/bodyset/pelvis", "/bodyset/tibia_r").replace("root", "fixed")
    path.write_text(path.read_text().replace(free, weld))
    with pytest.raises(InputError, match=r"'tibia_r' .* welded to ground"):
        find_leg(read_osim(path, partial=True), "right")


def test_a_hip_on_ground_is_a_leg(tmp_path):
    path = pendulum_osim(tmp_path / "leg.osim")
    text = path.read_text()
    free = re.search(r'<FreeJoint name="root">.*?</FreeJoint>', text)[0]
    weld = re.sub("<coordinates>.*?</coordinates>", "", free).replace("FreeJoint", "WeldJoint")
    path.write_text(text.replace(free, weld))
    assert find_leg(read_osim(path), "right").pelvis == "pelvis"
    markers = changed(recorded_leg(tmp_path), scene="hip.toml")
    assert main(markers) == 0
    assert len(read_table(tmp_path / "leg.trc").columns) > 30
