"""OpenSim models in the forms of public files: each form gives the same model."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from opensim_models import OWN
from pendulum_leg import changed, pendulum_osim, recorded_leg
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.files import named_files
from tkamb.io.importing.anatomy import find_leg
from tkamb.io.importing.model_fit import ModelChain
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.model import OpenSimModel
from tkamb.io.opensim.motion import read_coordinates
from tkamb.io.opensim.read import read_osim
from tkamb.io.recordings.tables import read_table
from tkamb.run.identity import files_hash
from tkamb.show.storage import write_storage

NEW = OWN["new_layout"].read_text(encoding="utf-8")


def written(folder: Path, text: str | bytes, name: str = "model.osim") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
    return path


def assert_same(first: OpenSimModel, other: OpenSimModel) -> None:
    """Assert that two models have the same bodies, poses and paths."""
    assert first.bodies.keys() == other.bodies.keys()
    for name, body in first.bodies.items():
        np.testing.assert_array_equal(body.inertia, other.bodies[name].inertia)
    for part in ("coordinates", "markers", "muscles", "ligaments", "wrap_objects"):
        assert list(getattr(first, part)) == list(getattr(other, part))
    for part in ("couplers", "constant_distances"):
        assert [c.name for c in getattr(first, part)] == [c.name for c in getattr(other, part)]
    q = np.linspace(-0.3, 0.4, len(first.coordinates))
    np.testing.assert_array_equal(*(Kinematics(m).poses(q) for m in (first, other)))


def cut_out(text: str, tag: str) -> tuple[str, str]:
    """Return a set of the model, and the model without it."""
    match = re.search(rf"<{tag}[ >].*?</{tag}>", text, re.S)
    assert match
    return match[0], text.replace(match[0], f'<{tag} file="parts/{tag}.xml"/>')


SETS = ("BodySet", "JointSet", "ConstraintSet", "ForceSet", "MarkerSet")
"""Sets that the tests move into separate files. `MARKER` adds a MarkerSet to the model first."""
MARKER = (
    '<MarkerSet name="markerset"><objects><Marker name="spot"><socket_parent_frame>/bodyset/tibia'
    "</socket_parent_frame><location>0.01 -0.1 0.02</location></Marker></objects></MarkerSet>"
)
WITH_MARKER = NEW.replace("</Model>", MARKER + "</Model>")


@pytest.mark.parametrize("wrapped", ["document", "bare"])
@pytest.mark.parametrize("tag", SETS)
def test_a_set_in_a_file_of_its_own_is_read(tmp_path, tag, wrapped):
    element, remainder = cut_out(WITH_MARKER, tag)
    (tmp_path / "parts").mkdir()
    if wrapped == "document":
        element = (
            f'<?xml version="1.0"?><OpenSimDocument Version="40000">{element}</OpenSimDocument>'
        )
    written(tmp_path / "parts", element, f"{tag}.xml")
    read = read_osim(written(tmp_path, remainder))
    assert_same(read, read_osim(written(tmp_path, WITH_MARKER, "whole.osim")))
    assert read.notices == (f"{tag} read from parts/{tag}.xml",)


def test_a_run_reads_the_files_that_its_model_names(tmp_path):
    """A change of a set in its own file makes another run, which `verify` detects."""
    element, remainder = cut_out(NEW, "ForceSet")
    (tmp_path / "parts").mkdir()
    forces = written(tmp_path / "parts", element.replace("<objects>", '<objects file="more.xml">'))
    forces = forces.rename(forces.with_name("ForceSet.xml"))
    more = written(tmp_path / "parts", "<objects/>", "more.xml")
    model = written(tmp_path, remainder)
    assert named_files(model) == [forces, more]
    scene = SimpleNamespace(model_dump=lambda exclude: {"muscles": {"model": model}})
    case = SimpleNamespace(femoral=None, scene=scene)
    before = files_hash(case)
    more.write_text("<objects> </objects>")
    assert files_hash(case) != before


def test_a_files_own_defaults_hold_for_its_own_elements(tmp_path):
    element, remainder = cut_out(NEW, "ForceSet")
    strengths = re.findall(r"<max_isometric_force>(.*?)<", element)
    bare = re.sub(r"<max_isometric_force>.*?</max_isometric_force>", "", element)
    default = (
        "<defaults><Thelen2003Muscle><max_isometric_force>321</max_isometric_force>"
        "</Thelen2003Muscle></defaults>"
    )
    (tmp_path / "parts").mkdir()
    written(tmp_path / "parts", bare.replace("<objects>", default + "<objects>", 1), "ForceSet.xml")
    muscles = read_osim(written(tmp_path, remainder)).muscles.values()
    forces = {m.max_isometric_force_N for m in muscles if m.kind == "Thelen2003Muscle"}
    assert strengths and forces == {321.0}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "does not exist"),
        ("<ForceSet><objects/></ForceSet>", "instead of a <JointSet>"),
        ("<OpenSimDocument><ForceSet/></OpenSimDocument>", "without a <JointSet>"),
        ('<JointSet file="JointSet.xml"/>', "includes this one"),
        ("<JointSet><objects>", "no element found: line 1"),
    ],
)
def test_a_set_whose_file_cannot_be_used_is_refused(tmp_path, content, words):
    _, remainder = cut_out(NEW, "JointSet")
    (tmp_path / "parts").mkdir()
    if content:
        written(tmp_path / "parts", content, "JointSet.xml")
    with pytest.raises(InputError, match=re.escape(words)):
        read_osim(written(tmp_path, remainder))


def test_a_controllers_file_may_be_missing(tmp_path):
    text = NEW.replace("</Model>", '<ControllerSet file="controls.xml"/></Model>')
    assert "ControllerSet is left out" in read_osim(written(tmp_path, text)).notices[0]


AMONG = "<credits>{}</credits><gravity>"
LENIENT = {
    "ampersand": (NEW.replace("<gravity>", AMONG.format("A. & B."), 1), "a bare & in line 9"),
    "ampersand in an attribute": (NEW.replace("<gravity>", '<credits of="A&B"/><gravity>'), "& in"),
    "entity of HTML": (NEW.replace("<gravity>", AMONG.format("&nbsp;"), 1), "a bare & in line 9"),
    "Latin-1": (
        NEW.replace("<gravity>", AMONG.format("Müller"), 1).encode("latin-1"),
        "line 9 is not UTF-8",
    ),
    "dashes in a comment": (NEW.replace("<gravity>", "<!-- a -- b ---><gravity>", 1), "comment"),
    "blanks first": ("\n  " + NEW, "blanks before"),
    "control character": (NEW.replace("<gravity>", AMONG.format("a\x02b"), 1), "control"),
    "text at the end": (NEW + "\n</OpenSimDocument>", "after its last element"),
}


@pytest.mark.parametrize("case", LENIENT)
def test_xml_that_opensim_reads_is_read(tmp_path, case):
    text, words = LENIENT[case]
    read = read_osim(written(tmp_path, text))
    assert_same(read, read_osim(OWN["new_layout"]))
    assert len(read.notices) == 1 and words in read.notices[0]


@pytest.mark.parametrize("gravity", ["(0 -9.5 0)", "~[0,-9.5,0]", "0, -9.5, 0"])
def test_three_numbers_in_brackets_or_with_commas_are_read(tmp_path, gravity):
    text = re.sub("<gravity>.*?</gravity>", f"<gravity>{gravity}</gravity>", NEW)
    np.testing.assert_array_equal(read_osim(written(tmp_path, text)).gravity, [0.0, -9.5, 0.0])


@pytest.mark.parametrize("gravity", ["0 -9,5 0,1", "0 -9,5", "(0 1)"])
def test_decimal_commas_are_not_taken_for_several_numbers(tmp_path, gravity):
    text = re.sub("<gravity>.*?</gravity>", f"<gravity>{gravity}</gravity>", NEW)
    with pytest.raises(InputError, match="is not 3 numbers"):
        read_osim(written(tmp_path, text))


def test_a_byte_order_mark_is_no_fault(tmp_path):
    read = read_osim(written(tmp_path, b"\xef\xbb\xbf" + NEW.encode()))
    assert read.notices == ()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("</gravity>", "</gravitas>", ("mismatched tag: line 9, column", "correct that line")),
        ("<gravity>", "<gravity", ("not well-formed (invalid token): line 9, column", "correct")),
        ("<gravity>", "<credits>m < 5 & > 3</credits><gravity>", ("line 9", "write &lt; for a <")),
    ],
)
def test_malformed_xml_is_refused_with_line_column_and_remedy(tmp_path, old, new, words):
    with pytest.raises(InputError) as error:
        read_osim(written(tmp_path, NEW.replace(old, new, 1)))
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize("mass", ["0", "0.0", "1e-15"])
def test_a_massless_body_has_no_inertia(tmp_path, mass):
    body = NEW.index('<Body name="sled">')
    text = NEW[:body] + re.sub("<mass>.*?<", f"<mass>{mass}<", NEW[body:], count=1)
    sled = read_osim(written(tmp_path, text)).bodies["sled"]
    assert not sled.inertia.any()
    assert read_osim(OWN["new_layout"]).bodies["sled"].inertia.any()


def coupler(name: str, leads: str, follows: str, gradient: float) -> str:
    return (
        f'<CoordinateCouplerConstraint name="{name}"><isEnforced>true</isEnforced>'
        f"<coupled_coordinates_function><LinearFunction><coefficients>{gradient} 0.01"
        "</coefficients></LinearFunction></coupled_coordinates_function>"
        f"<independent_coordinate_names>{leads}</independent_coordinate_names>"
        f"<dependent_coordinate_name>{follows}</dependent_coordinate_name>"
        "</CoordinateCouplerConstraint>"
    )


def coupled(tmp_path: Path, *couplers: str, partial: bool = False) -> OpenSimModel:
    body = "".join(couplers)
    sets = f'<ConstraintSet name="c"><objects>{body}</objects></ConstraintSet></Model>'
    return read_osim(pendulum_osim(tmp_path / "leg.osim", {"</Model>": sets}), partial)


CHAIN = (
    coupler("a", "knee_r_0", "hip_r_0", 0.5),
    coupler("b", "hip_r_0", "hip_r_1", 0.3),
    coupler("c", "hip_r_1", "ankle_r_0", -2.0),
)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0), (2, 0, 1)])
def test_couplers_in_a_chain_do_not_depend_on_their_order(tmp_path, order):
    model = coupled(tmp_path, *(CHAIN[k] for k in order))
    kinematics = Kinematics(model)
    q = kinematics.coupled({"knee_r_0": -0.8})
    place = kinematics.coordinates
    hip = 0.5 * -0.8 + 0.01
    turn = 0.3 * hip + 0.01
    values = [q[place[name]] for name in ("hip_r_0", "hip_r_1", "ankle_r_0")]
    np.testing.assert_allclose(values, [hip, turn, -2.0 * turn + 0.01], rtol=1e-14)
    slopes = kinematics.coupling(q)[:, place["knee_r_0"]]
    assert slopes[place["ankle_r_0"]] == pytest.approx(0.5 * 0.3 * -2.0)
    # A coordinate that depends through several couplers also moves markers.
    chain = ModelChain(model, list(model.markers))
    state = np.tile(q, (1, 1))
    target = chain.places(state) + 0.01
    equations = chain.normal(state, target, np.ones((1, len(model.markers))))
    step, knee = 1e-6, chain.free.index(place["knee_r_0"])
    costs = []
    for sign in (1, -1):
        move = np.zeros((1, len(chain.free)))
        move[0, knee] = sign * step
        costs.append(((target - chain.places(chain.moved(state, move))) ** 2).sum())
    slope = -(costs[0] - costs[1]) / (4 * step)
    assert equations.right[0, knee] == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (coupler("d", "knee_r_0", "ankle_r_0", 1.0), "depend on a second coordinate"),
        (coupler("d", "ankle_r_0", "knee_r_0", 1.0), "depend on itself"),
        (coupler("d", "knee_r_0", "knee_r_0", 1.0), "depend"),
    ],
)
def test_couplers_that_contradict_each_other_are_refused(tmp_path, more, words):
    with pytest.raises(InputError, match=words):
        coupled(tmp_path, *CHAIN, more)
    with pytest.raises(InputError, match=words):  # The couplers concern this knee.
        find_leg(coupled(tmp_path, *CHAIN, more, partial=True), "right")


ARM_BODY = (
    '<Body name="hand"><mass>1</mass><mass_center>0 0 0</mass_center>'
    "<inertia>1 1 1 0 0 0</inertia></Body></objects></BodySet>"
)
FRAMES_OF_ARM = (
    "<socket_parent_frame>/bodyset/pelvis</socket_parent_frame>"
    "<socket_child_frame>/bodyset/hand</socket_child_frame>"
    '<coordinates><Coordinate name="reach"/></coordinates>'
)


def arm(joint: str, inside: str = "", frames: str = FRAMES_OF_ARM) -> dict[str, str]:
    """Return the changes that give the leg's pelvis a hand on some joint."""
    return {
        "</objects></BodySet>": ARM_BODY,
        "</objects></JointSet>": (
            f'<{joint} name="wrist">{frames}{inside}</{joint}></objects></JointSet>'
        ),
    }


def in_set(tag: str, element: str) -> dict[str, str]:
    return {"</Model>": f'<{tag} name="s"><objects>{element}</objects></{tag}></Model>'}


def axis(function: str, coordinates: str = "reach") -> str:
    return (
        f'<SpatialTransform><TransformAxis name="rotation1"><coordinates>{coordinates}'
        f"</coordinates><axis>1 0 0</axis>{function}</TransformAxis></SpatialTransform>"
    )


NOT_NEEDED = {
    "joint class": arm("ScapulothoracicJoint"),
    "ellipsoid joint": arm("EllipsoidJoint"),
    "function class": arm("CustomJoint", axis("<GCVSpline name='function'/>")),
    "function of two": arm("CustomJoint", axis("", "reach grasp")),
    "axis of no length": arm("CustomJoint", axis("").replace("1 0 0", "0 0 0")),
    "socket to nowhere": arm("PinJoint", "", FRAMES_OF_ARM.replace("/pelvis", "/thorax")),
    "loop": arm("PinJoint")
    | {
        "</objects></JointSet>": f'<PinJoint name="wrist">{FRAMES_OF_ARM}</PinJoint>'
        f'<PinJoint name="grip">{FRAMES_OF_ARM.replace("reach", "grip_0")}</PinJoint>'
        "</objects></JointSet>"
    },
    "no joint": {"</objects></BodySet>": ARM_BODY},
    "constraint": arm("PinJoint")
    | in_set(
        "ConstraintSet",
        '<PointOnLineConstraint name="rod"><socket_line_body>/bodyset/hand</socket_line_body>'
        "</PointOnLineConstraint>",
    ),
    "coupler of two": arm("PinJoint")
    | in_set(
        "ConstraintSet",
        coupler("two", "reach hip_r_0", "reach", 1.0).replace("hip_r_0", "reach"),
    ),
    "muscle class": in_set("ForceSet", '<Hill1938Muscle name="m"/>'),
    "muscle without points": in_set("ForceSet", '<Thelen2003Muscle name="m"/>'),
    "ligament class": in_set("ForceSet", '<Smith2038Ligament name="l"/>'),
    "marker twice": {'name="M.pelvis.1"': 'name="M.pelvis.0"'},
    "marker nowhere": {'<Marker name="M.pelvis.0"><socket_parent_frame>/bodyset/pelvis': (
        '<Marker name="M.pelvis.0"><socket_parent_frame>/bodyset/thorax'
    )},
    "wrap object": {
        '<Body name="pelvis">': '<Body name="pelvis"><WrapObjectSet><objects><WrapDonut name="d"/>'
        "</objects></WrapObjectSet>"
    },
}  # fmt: skip


@pytest.mark.parametrize("case", NOT_NEEDED)
def test_an_unreadable_element_that_the_knee_does_not_need_is_a_notice(tmp_path, capsys, case):
    assert main(recorded_leg(tmp_path, osim=NOT_NEEDED[case])) == 0
    assert "not needed for this knee" in capsys.readouterr().out
    with pytest.raises(InputError):  # A complete reading does not accept the element.
        read_osim(tmp_path / "leg.osim")


NEEDED = {
    "knee": {
        '<PinJoint name="knee_r">': '<ScrewJoint name="knee_r">',
        "</PinJoint><PinJoint": None,
    },
    "hip": {"BallJoint": "ScrewJoint"},
    "constraint on the femur": in_set(
        "ConstraintSet",
        '<PointOnLineConstraint name="rod"><socket_line_body>/bodyset/femur_r</socket_line_body>'
        "</PointOnLineConstraint>",
    ),
    "constraint by a coordinate": in_set(
        "ConstraintSet", coupler("two", "knee_r_0 hip_r_0", "ankle_r_0", 1.0)
    ),
    "constraint by an offset frame": in_set(
        "ConstraintSet",
        '<WeldConstraint name="w"><socket_frame1>/jointset/knee_r/knee_r_p</socket_frame1>'
        "</WeldConstraint>",
    ),
}


@pytest.mark.parametrize("case", NEEDED)
def test_an_unreadable_element_that_the_knee_needs_is_refused(tmp_path, capsys, case):
    changes = {old: new for old, new in NEEDED[case].items() if new is not None}
    if case == "knee":
        changes["</PinJoint><PinJoint"] = "</ScrewJoint><PinJoint"
    assert main(recorded_leg(tmp_path, osim=changes)) == 2
    output = capsys.readouterr().err
    assert "not read" in output or "needs one independent" in output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["Schutte1993Muscle", "Delp1990Muscle", "Thelen2003Muscle"])
def test_muscle_classes_with_older_names_are_read(tmp_path, kind):
    text = OWN["old_layout"].read_text(encoding="utf-8")
    assert "Delp1990Muscle_Deprecated" in text
    model = read_osim(written(tmp_path, text.replace("Delp1990Muscle_Deprecated", kind)))
    assert kind in {muscle.kind for muscle in model.muscles.values()}


def as_connectors(text: str, style: str) -> str:
    """Return a document of version 4 with the sockets of versions 30500 to 30515."""
    if style == "connectors":
        new = (
            r'<connectors><Connector_PhysicalFrame_ name="\1"><connectee_name>\2</connectee_name>'
            r"</Connector_PhysicalFrame_></connectors>"
        )
    else:
        new = rf"<{style}_\1_connectee_name>\2</{style}_\1_connectee_name>"
    return re.sub(r"<socket_(\w+)>(.*?)</socket_\1>", new, text)


@pytest.mark.parametrize(
    ("style", "version"), [("connectors", 30501), ("connector", 30508), ("socket", 30512)]
)
def test_versions_between_3_and_4_are_read(tmp_path, style, version):
    text = as_connectors(NEW, style).replace("40600", str(version))
    assert_same(read_osim(written(tmp_path, text)), read_osim(OWN["new_layout"]))


@pytest.mark.parametrize(
    ("axes", "turn"),
    [
        (("+x", "+y"), np.eye(3)),
        (("-x", "+y"), np.diag([-1.0, 1.0, -1.0])),
        (("+y", "+z"), np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])),
    ],
)
def test_a_frame_defined_by_stations_is_read(tmp_path, axes, turn):
    """Stations that define the knee's frame on the femur give the same frame as an offset."""
    places = {"a": (0, 0, 0), "b": (0.1, 0, 0), "c": (0.02, 0, -0.1), "o": (0, -0.4, 0)}
    stations = "".join(
        f'<Station name="{name}"><socket_parent_frame>/bodyset/femur_r</socket_parent_frame>'
        f"<location>{x} {y} {z}</location></Station>"
        for name, (x, y, z) in places.items()
    )
    sockets = {"point_a": "a", "point_b": "b", "point_c": "c", "origin_point": "o"}
    frame = (
        f'<StationDefinedFrame name="knee_r_p"><ab_axis>{axes[0]}</ab_axis>'
        f"<ab_x_ac_axis>{axes[1]}</ab_x_ac_axis>"
        + "".join(f"<socket_{s}>/{name}</socket_{s}>" for s, name in sockets.items())
        + "</StationDefinedFrame>"
    )
    old = re.compile(r'<PhysicalOffsetFrame name="knee_r_p">.*?</PhysicalOffsetFrame>')
    text = pendulum_osim(tmp_path / "leg.osim").read_text()
    text = old.sub(frame, text).replace("</Model>", f"<components>{stations}</components></Model>")
    knee = next(j for j in read_osim(written(tmp_path, text)).joints if j.name == "knee_r")
    assert knee.parent == "femur_r"
    np.testing.assert_allclose(knee.pose_parent_frame[:3, 3], [0, -0.4, 0], atol=1e-15)
    np.testing.assert_allclose(knee.pose_parent_frame[:3, :3], turn, atol=1e-15)


@pytest.mark.parametrize("unit", ["metres", "Meters", "m"])
def test_spellings_of_the_metre_are_accepted(tmp_path, unit):
    text = NEW.replace("<length_units>meters", f"<length_units>{unit}")
    assert_same(read_osim(written(tmp_path, text)), read_osim(OWN["new_layout"]))


# A model of one leg: the pelvis has no mass.
ALONE = {"<mass>40.0<": "<mass>0<"}


@pytest.mark.parametrize(
    ("masses", "subject", "leg_kg", "words"),
    [
        (ALONE, "80", 13.5, "one leg of 13.50 kg, 17% of the subject's 80 kg: not scaled"),
        (ALONE, "120", 13.5, "one leg of 13.50 kg, 11% of the subject's 120 kg: not scaled"),
        (
            ALONE
            | {"<mass>9.0<": "<mass>55<", "<mass>3.5<": "<mass>15<", "<mass>1.0<": "<mass>5<"},
            "80",
            12.88,
            "the whole body's: scaled to 12.88 kg",
        ),
    ],
)
def test_the_mass_of_a_model_of_one_leg_is_kept_or_scaled(
    tmp_path, capsys, masses, subject, leg_kg, words
):
    arguments = changed(recorded_leg(tmp_path, osim=masses), mass_kg=subject)
    assert main(arguments) == 0
    assert words in capsys.readouterr().out
    text = (tmp_path / "out" / "patient.urdf").read_text()
    written_kg = sum(float(m) for m in re.findall(r'<mass value="(.*?)"', text))
    assert written_kg == pytest.approx(leg_kg, rel=1e-6)


@pytest.mark.parametrize(
    ("masses", "subject", "more", "words"),
    [
        (ALONE, "176", [], "one leg of 13.5 kg"),
        (ALONE, "40", [], "one leg of 13.5 kg"),
        (ALONE, "13.5", ["--keep-mass"], "a leg has 10% to 25%"),
        (
            {f"<mass>{m}<": "<mass>0<" for m in ("40.0", "9.0", "3.5", "1.0")},
            "70",
            [],
            "no mass",
        ),
    ],
)
def test_masses_of_no_leg_are_refused(tmp_path, capsys, masses, subject, more, words):
    arguments = changed(recorded_leg(tmp_path, osim=masses), mass_kg=subject)
    assert main([*arguments, *more]) == 2
    assert words in capsys.readouterr().err


def states(tmp_path: Path, columns: dict[str, np.ndarray], in_degrees: bool | None) -> Path:
    path = tmp_path / "states.sto"
    write_storage(path, {"time": np.linspace(0, 1, len(BEND))} | columns, bool(in_degrees))
    if in_degrees is None:
        path.write_text(re.sub("inDegrees=.*\n", "", path.read_text()))
    return path


BEND = np.linspace(-0.2, -1.1, 41)


@pytest.mark.parametrize(
    "names",
    [
        ("/jointset/knee_r/knee_r_0/speed", "/jointset/knee_r/knee_r_0/value"),
        ("knee_r/knee_r_0/speed", "knee_r/knee_r_0/value"),
        ("knee_r_0_u", "knee_r_0"),
        ("/jointset/knee_r/knee_r_0/speed", "/jointset/knee_r/knee_r_0"),
    ],
)
def test_a_speed_is_no_coordinate_in_whichever_order(tmp_path, names):
    kinematics = Kinematics(read_osim(pendulum_osim(tmp_path / "leg.osim")))
    path = states(tmp_path, dict(zip(names, (9.0 * BEND, BEND), strict=True)), False)
    q, missing = read_coordinates(kinematics, read_table(path))
    np.testing.assert_allclose(q[:, kinematics.coordinates["knee_r_0"]], BEND, atol=1e-6)
    assert "knee_r_0" not in missing


def test_a_speed_alone_is_no_coordinate(tmp_path):
    kinematics = Kinematics(read_osim(pendulum_osim(tmp_path / "leg.osim")))
    path = states(tmp_path, {"/jointset/knee_r/knee_r_0/speed": BEND}, False)
    assert "knee_r_0" in read_coordinates(kinematics, read_table(path))[1]


@pytest.mark.parametrize(
    ("scale", "in_degrees", "words"),
    [
        (57.3, False, "reaches 63.03, which no joint does in radians"),
        (1.0, None, "add the line inDegrees=no (radians) or inDegrees=yes"),
        (57.3, None, "add the line inDegrees=yes above its endheader"),
    ],
)
def test_an_impossible_or_unknown_angle_unit_is_refused(tmp_path, capsys, scale, in_degrees, words):
    path = states(tmp_path, {"knee_r_0": scale * BEND}, in_degrees)
    arguments = changed(recorded_leg(tmp_path), trc=None, motion=str(path))
    assert main(arguments) == 2
    assert words in capsys.readouterr().err


def test_radians_said_to_be_degrees_are_noticed(tmp_path, capsys):
    path = states(tmp_path, {"knee_r_0": BEND}, True)
    main(changed(recorded_leg(tmp_path), trc=None, motion=str(path)))
    assert "check whether the file is in radians" in capsys.readouterr().out
