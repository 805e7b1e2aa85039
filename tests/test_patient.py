"""The patient's URDF: mirror image, default segments, and refused files."""

import re

import numpy as np
import pinocchio as pin
import pytest

from knees import INERTIA, leg_urdf, random_motion
from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, mirrored_pose
from tkamb.io.recordings.patient import load_urdf, segment_inertia
from tkamb.io.recordings.recording_tables import PatientTable
from tkamb.knee.chain import Chain, ChainMotion

LOOP = '<joint name="loop" type="fixed"><parent link="femur"/><child link="tibia"/></joint>'


def table(tmp_path, text, side="right", **more):
    path = tmp_path / "leg.urdf"
    path.write_text(text)
    return PatientTable(urdf=path, side=side, mass_kg=75.0, **more)


def left(text):
    """Return the URDF of the mirror image (z to -z), a left leg."""
    text = text.replace('axis xyz="0 -1 0"', 'axis xyz="0 1 0"')
    text = text.replace('axis xyz="-1 0 0"', 'axis xyz="1 0 0"')
    return text


def test_a_left_leg_gives_the_numbers_of_its_mirror_image(tmp_path):
    """RNEA of the mirrored leg under the mirrored motion has the mirrored forces."""
    plain = {
        "tibia": (4.2, "0.01 0.22 0.005", "0.06 0.008 0.061 0 0 0"),
        "femur": (10.5, "0.012 0.24 -0.004", "0.2 0.04 0.21 0 0 0"),
        "patella": (0.1, "0.004 0.001 0.002", "2e-5 2.5e-5 3e-5 0 0 0"),
    }
    text = left(leg_urdf(plain))
    left_leg = Chain(text.replace('rpy="0.1 -0.2 0.3"', 'rpy="0 0 0"'), True)
    mirrored_urdf = load_urdf(
        table(tmp_path, text.replace('rpy="0.1 -0.2 0.3"', 'rpy="0 0 0"'), "left"), True
    )
    mirrored_leg = Chain(mirrored_urdf, True)
    motion = random_motion(left_leg, np.random.default_rng(0))
    flip = np.diag([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
    joints = motion.joints.copy()
    joints[:, 2] *= -1.0  # knee_ml keeps its axis, so its coordinate changes sign
    mirrored = ChainMotion(
        mirrored_pose(motion.tibia),
        flip @ motion.tibia_velocity,
        flip @ motion.tibia_acceleration,
        joints,
    )
    expected, inertial = left_leg.at(motion).inertial, mirrored_leg.at(mirrored).inertial
    expected = expected.copy()
    expected[:6] = flip @ expected[:6]
    expected[8] *= -1.0
    np.testing.assert_allclose(inertial, expected, atol=1e-10)
    np.testing.assert_allclose(
        mirrored_leg.insert_in_tibia, mirrored_pose(left_leg.insert_in_tibia), atol=1e-12
    )


def test_mirrored_inertia_is_the_reflected_tensor(tmp_path):
    """I' = M I M about the reflected centre, also with a rotated inertial frame."""
    left_model = Chain(left(leg_urdf()), True).model
    mirrored_urdf = load_urdf(table(tmp_path, left(leg_urdf()), "left"), True)
    mirrored_model = Chain(mirrored_urdf, True).model
    for name in ("root_joint", "knee_flexion", "patella_rotation"):
        a, b = (
            left_model.inertias[left_model.getJointId(name)],
            mirrored_model.inertias[mirrored_model.getJointId(name)],
        )
        np.testing.assert_allclose(b.lever, MIRROR @ a.lever, atol=1e-12)
        np.testing.assert_allclose(b.inertia, MIRROR @ a.inertia @ MIRROR, atol=1e-12)


def test_a_right_leg_does_not_change(tmp_path):
    urdf = load_urdf(table(tmp_path, leg_urdf()), True)
    expected = pin.buildModelFromXML(leg_urdf(), pin.JointModelFreeFlyer())
    model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    assert all(a.isApprox(b) for a, b in zip(expected.inertias, model.inertias, strict=True))


def test_missing_inertials_come_from_de_leva(tmp_path):
    without = {"patella": INERTIA["patella"]}
    urdf = load_urdf(table(tmp_path, leg_urdf(without), sex="male"), True)
    model = Chain(urdf, True).model
    femur = model.inertias[model.getJointId("knee_flexion")]
    hip = np.array([0.003, 0.42, -0.01])
    assert femur.mass == pytest.approx(0.1416 * 75, rel=1e-12)
    np.testing.assert_allclose(femur.lever, hip * (1 - 0.4095), atol=1e-12)
    shank = model.inertias[model.getJointId("root_joint")]
    assert shank.mass == pytest.approx((0.0433 + 0.0137) * 75, rel=1e-12)


def test_the_inertia_of_a_segment_follows_from_its_radii_of_gyration():
    thigh = segment_inertia("thigh", "female", 60.0, np.array([0, 0.4, 0]), np.zeros(3))
    radii = np.sqrt(np.diag(thigh.tensor) / thigh.mass) / 0.4
    np.testing.assert_allclose(radii, [0.369, 0.162, 0.364], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.replace('<link name="hip"/>', ""), "no link 'hip'"),
        (lambda t: t.replace("knee_ml", "knee_z"), "no joint 'knee_ml'"),
        (lambda t: t.replace('axis xyz="0 -1 0"', 'axis xyz="0 1 0"'), "knee_axial_rotation"),
        (lambda t: t.replace('mass value="10.5"', 'mass value="0"'), "impossible inertia"),
        (lambda t: t.replace('ixx="0.2"', 'ixx="0.9"'), "impossible inertia"),
        (lambda t: t.replace('ixx="0.2"', 'ixx="wide"'), "not a number"),
        (lambda t: t.replace('<mass value="', '<mass value="1 ', 1), "not a number"),
        (lambda t: re.sub('xyz="[^"]*"', 'xyz="1 2"', t, count=1), "not 3 numbers"),
        (lambda t: t.replace("</robot>", '<link name="lonely"/></robot>'), "2 roots .*lonely"),
        (
            lambda t: t.replace("</robot>", LOOP + "</robot>"),
            "'tibia' is the child of a second joint",
        ),
        (lambda t: t[:-20], "not a readable URDF"),
    ],
)
def test_a_wrong_patient_is_refused_in_one_line(tmp_path, change, words):
    with pytest.raises(InputError, match=words) as refused:
        load_urdf(table(tmp_path, change(leg_urdf())), True)
    assert "\n" not in str(refused.value)


def test_without_inertias_the_sex_is_required(tmp_path):
    with pytest.raises(InputError, match="sex"):
        load_urdf(table(tmp_path, leg_urdf({"patella": INERTIA["patella"]})), True)


def test_missing_file_is_named(tmp_path):
    nowhere = PatientTable(urdf=tmp_path / "none.urdf", side="right", mass_kg=75.0)
    with pytest.raises(InputError, match=r"none\.urdf: no such URDF"):
        load_urdf(nowhere, True)


@pytest.mark.parametrize("joint", ["knee_ml", "knee_flexion", "patella_rotation", "knee_adduction"])
@pytest.mark.parametrize("change", [(1.0, 1.2e-9), (1.0, -4e-7), (1.2e-9, 0.0), (2.0, 0.0)])
def test_rounding_and_length_of_an_axis_change_nothing(tmp_path, joint, change):
    """The factors are of the axis, and of a component across it."""

    def with_axis(factor, across):
        def changed(match):
            axis = factor * np.array([float(v) for v in match[2].split()])
            axis[1] += across * factor
            return match[1] + " ".join(map(repr, axis.tolist()))

        return re.sub(rf'(name="{joint}".*?<axis xyz=")([^"]*)', changed, leg_urdf(), flags=re.S)

    assert with_axis(*change) != with_axis(1.0, 0.0)
    results = [load_urdf(table(tmp_path, with_axis(*pair)), True) for pair in ((1.0, 0.0), change)]
    assert results[0] == results[1]
    for wrong in ((1.0, 1e-4), (0.0, 0.0)):
        with pytest.raises(InputError, match="it must be"):
            load_urdf(table(tmp_path, with_axis(*wrong)), True)


@pytest.mark.parametrize("limits", ["0 0", "0.3 0.3", "-1 -1"])
def test_equal_limits_of_a_joint_are_accepted(tmp_path, limits):
    low, high = limits.split()
    text = re.sub('lower="[^"]*" upper="[^"]*"', f'lower="{low}" upper="{high}"', leg_urdf())
    assert f'lower="{low}"' in text
    load_urdf(table(tmp_path, text), True)
    with pytest.raises(InputError, match="exchange them"):
        load_urdf(table(tmp_path, text.replace(f'lower="{low}"', 'lower="9"')), True)
