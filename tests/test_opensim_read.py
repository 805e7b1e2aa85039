"""OpenSim models: both layouts give the same model, published models are read, errors refused."""

import numpy as np
import pytest

from opensim_models import OWN, model
from tkamb.errors import InputError
from tkamb.io.opensim.read import read_osim


def test_both_layouts_hold_the_same_model():
    old, new = model("old_layout"), model("new_layout")
    assert list(old.coordinates) == list(new.coordinates)
    assert [j.name for j in old.joints] == [j.name for j in new.joints]
    for a, b in zip(old.joints, new.joints, strict=True):
        assert (a.kind, a.parent, a.child) == (b.kind, b.parent, b.child)
        np.testing.assert_allclose(a.pose_parent_frame, b.pose_parent_frame, atol=1e-15)
        np.testing.assert_allclose(a.pose_child_frame, b.pose_child_frame, atol=1e-15)
    for name, body in old.bodies.items():
        assert body.mass_kg == new.bodies[name].mass_kg
        np.testing.assert_array_equal(body.inertia, new.bodies[name].inertia)
    for name, muscle in old.muscles.items():
        other = new.muscles[name]
        assert muscle.kind == other.kind
        assert muscle.max_isometric_force_N == other.max_isometric_force_N
        assert muscle.optimal_fibre_length_m == other.optimal_fibre_length_m
        assert muscle.tendon_slack_length_m == other.tendon_slack_length_m
        assert muscle.pennation_rad == other.pennation_rad
        assert [w.wrap_object for w in muscle.path.wraps] == [
            w.wrap_object for w in other.path.wraps
        ]


def test_the_small_model_has_the_numbers_of_its_file():
    small = model("old_layout")
    assert small.mass_kg == pytest.approx(25.3)
    np.testing.assert_array_equal(small.bodies["femur"].inertia[0], [0.13, 0.001, -0.002])
    assert small.wrap_objects["ring"].dimensions == (0.02, 0.005)
    assert small.wrap_objects["front"].quadrant == (0, 1)
    assert small.muscles["over_ellipsoid"].path.wraps[0].first == 0
    assert small.muscles["over_ellipsoid"].path.wraps[0].last == 1
    assert small.constant_distances[0].distance == 0.05
    assert not small.constant_distances[0].enforced
    band = small.ligaments["band"]
    assert band.force_length is not None and band.scale_N == 100.0
    assert float(band.force_length(np.array(1.05))) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "bodies", "coordinates", "muscles", "ligaments", "markers", "wraps", "mass_kg"),
    [
        ("DM", 23, 52, 44, 149, 64, 40, 69.982),
        ("JW", 24, 59, 103, 3, 54, 36, 62.636),
        ("gait2392", 12, 23, 92, 0, 0, 0, 75.165),
        ("Rajagopal2016", 22, 39, 80, 0, 66, 40, 75.337),
    ],
)
def test_published_models_are_read(
    name, bodies, coordinates, muscles, ligaments, markers, wraps, mass_kg
):
    read = model(name)
    assert (len(read.bodies), len(read.joints)) == (bodies, bodies)
    assert (len(read.coordinates), len(read.muscles)) == (coordinates, muscles)
    assert (len(read.ligaments), len(read.markers)) == (ligaments, markers)
    assert len(read.wrap_objects) == wraps
    assert read.mass_kg == pytest.approx(mass_kg, abs=1e-3)


def test_equal_frame_names_and_a_backwards_knee_of_jw_are_read():
    """Two joints have offset frames of one name. The knee's parent is the tray, not the femur."""
    jw = model("JW")
    joints = {joint.name: joint for joint in jw.joints}
    weld, knee = joints["tibial_tray_weld"], joints["knee"]
    np.testing.assert_allclose(weld.pose_parent_frame[:3, 3], [0.0, 0.044254, 0.0])
    np.testing.assert_array_equal(knee.pose_parent_frame, np.eye(4))
    assert knee.backwards and (knee.inboard, knee.outboard) == ("femoral_component", "tibial_tray")
    rod = jw.constant_distances[0]
    assert rod.distance == 0.0502 and rod.bodies == ("patella", "tibia")
    assert [c.dependent for c in jw.couplers] == ["patfem_flexion", "patfem_flexion_l"]
    assert "CoordinateCouplerConstraint 'patfem_ty_con' (not enforced)" in jw.left_out


def test_the_ligaments_of_dm_are_read():
    dm = model("DM")
    assert {ligament.kind for ligament in dm.ligaments.values()} == {"Blankevoort1991Ligament"}
    capsule = dm.ligaments["pCAP1"]
    assert capsule.stiffness_N == 500.0
    assert capsule.slack_length_m == pytest.approx(0.066653950161332548, abs=1e-15)
    assert sum(entry.startswith("Smith2018") for entry in dm.left_out) == 5


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>'

REFUSED = {
    "entities": ("<OpenSimDocument", BOMB + "<OpenSimDocument", "entity 'a'"),
    "version": ('Version="30000"', 'Version="10905"', "oldest that is read"),
    "no model": ("OpenSimDocument", "Skeleton", "not an OpenSim model"),
    "units": ("<length_units>meters", "<length_units>mm", "length_units 'mm'"),
    "joint": ("SliderJoint", "ScapulothoracicJoint", "ScapulothoracicJoint 'rail'"),
    "reverse": ("<reverse>false", "<reverse>true", "<reverse>"),
    "function": ("PolynomialFunction", "GCVSpline", "a function that is not read"),
    "spline": ("-2.1 -1.6 -1", "-2.1 -1.6 -1.7", "x increasing"),
    "wrap": ("WrapTorus", "WrapDonut", "WrapDonut 'ring'"),
    "wrap size": ("<radius>0.02<", "<radius>-0.02<", "not positive"),
    "wrap name": ("<wrap_object>ring", "<wrap_object>rong", "'rong' that does not exist"),
    "quadrant": ("<quadrant>x<", "<quadrant>w<", "<quadrant>w</quadrant>"),
    "range": ("<range>1 2</range>", "<range>1 5</range>", "range 1 5"),
    "muscle": ("Delp1990Muscle_Deprecated", "Hill1938Muscle", "Hill1938Muscle 'moving'"),
    "constraint": (
        "ConstantDistanceConstraint",
        "PointOnLineConstraint",
        None,
    ),
    "parent": ("<parent_body>talus<", "<parent_body>tallus<", "frame 'tallus'"),
    "loop": ("<parent_body>ground<", "<parent_body>toes<", "not joined to ground"),
    "number": ("<mass>9<", "<mass>nine<", "<mass>nine</mass> is not 1 number"),
    "nan": ("<mass>9<", "<mass>nan<", "is not 1 number"),
    "negative mass": ("<mass>9<", "<mass>-9<", "a mass of -9 kg"),
    "coordinate twice": ('"hip_y"', '"hip_x"', "is defined twice"),
    "point": ("<PathPoint ", "<FloatingPoint ", None),
    "condition": ("<coordinate>knee<", "<coordinate>elbow<", "coordinate 'elbow'"),
    "axis": ("<axis>0.78717961 0.60474746 -0.12094949<", "<axis>0 0 0<", "axis of no length"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_is_refused_by_name(case, tmp_path):
    original, replacement, words = REFUSED[case]
    text = OWN["old_layout"].read_text(encoding="utf-8")
    assert original in text
    text = text.replace(original, replacement)
    if case == "point":
        text = text.replace("</PathPoint>", "</FloatingPoint>")
    if case == "constraint":
        text = text.replace("<isDisabled>true", "<isDisabled>false")
    path = tmp_path / "model.osim"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as error:
        read_osim(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    assert (words or replacement.strip("< ")) in str(error.value)


def test_missing_and_truncated_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such OpenSim model"):
        read_osim(tmp_path / "none.osim")
    path = tmp_path / "half.osim"
    path.write_bytes(OWN["old_layout"].read_bytes()[:9000])
    with pytest.raises(InputError, match="not a readable OpenSim model"):
        read_osim(path)
