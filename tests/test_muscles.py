"""The scene alone defines a muscle: name, points and wrapping. Impossible muscles are refused."""

import numpy as np
import pytest

from scenes import write_scene
from tkamb import simulate
from tkamb.errors import InputError
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.muscles import muscle_line
from tkamb.run.read_scene import recording_of

ORIGIN = {"link": "femur", "point_mm": [32.0, 205.0, 0.0]}
INSERTION = {"link": "patella", "point_mm": [8.0, 20.0, 0.0]}
FEW = {"motion.frames": 3}
BARE = ("contact", "ligament", "quadriceps")


def muscle(name="quadriceps", path=(ORIGIN, INSERTION), wraps=True, **more):
    return {"name": name, "path": list(path), **({"wrap": {}} if wraps else {}), **more}


def case_of(folder, *muscles, drop=BARE):
    return load_case(load_scene(write_scene(folder, drop, muscle=list(muscles)), FEW))


def test_the_long_form_of_the_quadriceps_gives_the_same_numbers(tmp_path):
    short = write_scene(tmp_path / "short", ("contact",))
    long = write_scene(tmp_path / "long", ("contact", "quadriceps"), muscle=[muscle()])
    first, other = (simulate(load_scene(path, FEW)) for path in (short, long))
    assert np.isfinite(first["quadriceps_N"]).all()
    for name, values in first.columns.items():
        if name != "status" and not name.endswith("seconds"):
            assert np.array_equal(values, other[name], equal_nan=True), name


def test_a_muscle_renamed_and_moved_by_data_pulls_with_its_own_moment_arm(tmp_path):
    """The generalised force of unit tension is -dL/dq for all nine joint coordinates."""
    origin = {"link": "femur", "point_mm": [25.0, 180.0, 9.0]}
    case = case_of(tmp_path, muscle("vastus_lateralis", (origin, INSERTION)))
    recording = recording_of(case)
    frame, chain = recording.loads(2), recording.knee.chain
    assert frame.loads.values["muscle_vastus_lateralis"] > 100.0
    assert "muscle_quadriceps" not in frame.loads.values
    line = muscle_line(case.muscles[0], chain, case.femoral)
    motion, step = recording.instant(2).motion, 1e-6

    def length(joint, change):
        joints = motion.joints.copy()
        joints[0, joint] += change
        state = chain.at(type(motion)(motion.tibia, *2 * [np.zeros(6)], joints))
        return line.path({link: state.pose(link) for link in ("femur", "patella")}).length

    slopes = [(length(j, step) - length(j, -step)) / (2 * step) for j in range(9)]
    (unknown,) = frame.geometry.muscles
    arms = frame.geometry.state.generalised([unknown.loads])[chain._columns, 0]
    assert -np.array(slopes) == pytest.approx(arms, abs=1e-6)
    assert np.abs(arms[6:]).max() > 0.5  # The muscle pulls on the patella.


def test_a_via_point_on_the_femur_lengthens_the_muscle_and_moves_its_pull(tmp_path):
    """The muscle pulls along the line from its last point on the femur."""
    via = {"link": "femur", "point_mm": [45.0, 90.0, 0.0]}
    bent = case_of(tmp_path / "a", muscle(path=(ORIGIN, via, INSERTION), wraps=False))
    direct = case_of(tmp_path / "b", muscle(path=(via, INSERTION), wraps=False))
    bent, direct = recording_of(bent), recording_of(direct)
    far, near = (first.loads(0) for first in (bent, direct))
    assert not far.loads.problems
    for name, value in near.loads.values.items():
        assert far.loads.values[name] == pytest.approx(value, rel=1e-9, abs=1e-7)
    paths = [first.extensor.lines.paths(first.geometry(0).state)[0] for first in (bent, direct)]
    difference = np.subtract(ORIGIN["point_mm"], via["point_mm"]) * 1e-3
    assert paths[0].length - paths[1].length == pytest.approx(np.linalg.norm(difference))


@pytest.mark.parametrize(
    ("muscles", "words"),
    [
        ([muscle(), muscle("vasti")], "2 muscles cross the knee (quadriceps, vasti): [[mus"),
        ([muscle(path=(ORIGIN, {"link": "tibia", "point_mm": [20, 350, 0]}))], "femur to tibia"),
        ([muscle(path=(ORIGIN, ORIGIN))], "crosses no joint"),
        ([muscle(path=(ORIGIN, {"link": "fibula", "point_mm": [0, 0, 0]}))], "no link 'fibula'"),
        ([muscle(), muscle()], "two muscles have the same name"),
        ([muscle(path=(ORIGIN,))], "muscle.0.path"),
        ([muscle(force_N=6e4)], "give it in newtons"),
        ([muscle(insertion=INSERTION)], "unknown key 'muscle.0.insertion'"),
    ],
)
def test_an_indeterminate_or_malformed_muscle_is_a_one_line_error(tmp_path, muscles, words):
    with pytest.raises(InputError) as error:
        case_of(tmp_path, *muscles)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_the_short_form_beside_a_second_muscle_is_refused(tmp_path):
    with pytest.raises(InputError, match="static optimisation"):
        case_of(tmp_path, muscle("vasti"), drop=BARE[:-1])
