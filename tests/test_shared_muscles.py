"""Muscles across the knee: static optimisation agrees with the knee's equations."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knees import UP, bent_knee
from shared_trials import SHANK, STRENGTHS, THIGH, two_flexors
from tkamb.errors import InputError
from tkamb.geometry.frames import SIDES, knee_axes, knee_pose, pose, transform
from tkamb.io.scene import load_scene
from tkamb.knee.crossing import CrossingLines, MuscleShare
from tkamb.knee.equations import solve_knee
from tkamb.knee.load import PointForces, total_wrench
from tkamb.run.columns import (
    MUSCLE_FORCE,
    RESERVE,
    belongs,
    family_column,
    in_a_family,
    ordered_names,
)
from tkamb.run.muscles.knee_trial import condyle_rows
from tkamb.run.muscles.shared_muscles import SharedMuscles
from tkamb.run.summary import reserves

FRICTION = 0.05
SHIPPED = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "scene.toml"
GROUND_POINTS = {
    "behind": [-0.06, -0.45, 0.0],
    "ahead": [0.06, -0.45, 0.0],
    "aside": [-0.05, -0.45, 0.12],
}


def with_ground_force(point):
    """Return the bent knee with 700 N of ground reaction at a point (3,), m, insert frame."""
    force = PointForces("tibia", np.array([point]), 700 * UP[None])
    return replace(bent_knee(), ground=force)


@pytest.mark.parametrize("where", GROUND_POINTS)
def test_static_optimisation_and_equations_give_the_same_quadriceps(where):
    muscles = SharedMuscles(two_flexors(1))
    geometry, loads = muscles.frame(0).solve(with_ground_force(GROUND_POINTS[where]), FRICTION)
    assert loads.problems == ()
    assert geometry.share.force.min() > 50.0
    quadriceps = geometry.extensor.tension(loads.values)
    assert quadriceps == pytest.approx(geometry.share.force[0], abs=1e-6)


def test_flexors_supply_the_moment_that_a_slack_quadriceps_lacks():
    """The ground reaction is in front. Flexors supply its moment, except a reserve below 2 %."""
    knee = with_ground_force([0.06, -0.45, 0.0])
    alone = solve_knee(knee, FRICTION)
    geometry, loads = (
        SharedMuscles(two_flexors(1, reserve=0.5, least=0.0)).frame(0).solve(knee, FRICTION)
    )
    assert alone.slack
    assert alone.values["residual_flexion"] < -10.0
    assert geometry.share.force[0] < 1e-6
    assert abs(geometry.share.reserve[0]) < 0.02 * abs(alone.values["residual_flexion"])
    assert abs(loads.values.get("residual_flexion", 0.0)) < 0.25  # the patella's own weight
    assert np.linalg.norm(loads.contact_force) > np.linalg.norm(alone.contact_force) + 200.0


def _with_share(where, least_share):
    """Return geometry, the condyles' forces by all equations, and the rows at the same forces."""
    trial = two_flexors(1, reserve=30.0, least=0.0, least_share=least_share)
    frame = SharedMuscles(trial).frame(0)
    geometry, loads = frame.solve(with_ground_force(where), FRICTION)
    points = {side: one.point for side, one in geometry.condyles.items()}
    rows = condyle_rows(geometry, frame.lines, points)
    force = geometry.share.force
    normal = rows.constant + rows.extensor * force[0] + rows.arms @ force[1:]
    return geometry, np.array([loads.values.get(f"{side}_normal", 0.0) for side in SIDES]), normal


def test_the_rows_of_the_condyles_agree_with_all_equations():
    """Friction and the lean of the normals, which the rows neglect, change them by under 5 %."""
    _, forces, rows = _with_share(GROUND_POINTS["behind"], 0.0)
    np.testing.assert_allclose(rows, forces, atol=0.05 * forces.sum())


def test_muscles_keep_the_least_share_of_load_on_each_condyle():
    where = [-0.05, -0.45, -0.05]
    _, alone, _ = _with_share(where, 0.0)
    geometry, forces, rows = _with_share(where, 0.3)
    least = int(np.argmin(alone))
    assert alone[least] < 0.2 * alone.sum()
    assert geometry.share.both_loaded
    assert rows[least] == pytest.approx(0.3 * rows.sum(), rel=1e-6)
    assert forces[least] == pytest.approx(0.3 * forces.sum(), abs=0.05 * forces.sum())
    assert forces.sum() > alone.sum() + 50.0  # by co-contraction


def test_a_share_that_no_muscle_forces_keep_is_reported():
    """The ground reaction acts 0.3 m beside the knee: the flexors are too weak."""
    geometry, forces, _ = _with_share([-0.05, -0.45, 0.3], 0.3)
    assert not geometry.share.both_loaded
    assert forces.min() == 0.0


def test_muscles_without_strength_do_not_change_the_loads():
    knee = with_ground_force(GROUND_POINTS["behind"])
    trial = two_flexors(1, strengths=(6000.0, 1e-9, 1e-9), reserve=1e-3, least=0.0)
    geometry, loads = SharedMuscles(trial).frame(0).solve(knee, FRICTION)
    alone = solve_knee(knee, FRICTION)
    assert loads.values == pytest.approx(alone.values, rel=1e-6, abs=1e-4)
    assert geometry.share.reserve[0] == pytest.approx(0.0, abs=1e-6)


def test_two_flexors_share_by_strength_and_the_arms_of_the_knee():
    """Without reserve, optimal activations are proportional to moment arm times strength."""
    knee = with_ground_force(GROUND_POINTS["ahead"])
    trial = two_flexors(1, reserve=1e-3, least=0.0)
    share = SharedMuscles(trial).frame(0).share(knee, FRICTION, frozenset())
    force, step = share.force, 1.0
    tensions = []
    for i in (1, 2):  # moment arms by differences of the knee's equations
        forces = np.zeros(3)
        forces[i] = step
        loaded = replace(knee, share=replace(share, force=forces, reserve=np.zeros(1)))
        tensions.append(_taut_quadriceps(loaded))
    unloaded = replace(knee, share=replace(share, force=np.zeros(3), reserve=np.zeros(1)))
    arms = np.array(tensions) - _taut_quadriceps(unloaded)
    expected = arms * np.array(STRENGTHS[1:]) ** 2
    assert force[1] / force[2] == pytest.approx(expected[0] / expected[1], rel=1e-6)


def _taut_quadriceps(geometry):
    """Return the tension of the quadriceps, N; negative if the quadriceps would push."""
    from tkamb.knee.equations import KneeSystem
    from tkamb.knee.unknowns import LoadState

    taut = LoadState(frozenset(), frozenset())
    return KneeSystem(geometry, FRICTION, taut).solution.values["muscle_quadriceps"]


def test_the_generalised_force_of_a_line_is_the_work_of_its_shortening():
    """On each knee coordinate it is -F dL/dq, by differences of the length L."""
    rng = np.random.default_rng(3)
    shank, thigh = rng.normal(scale=0.1, size=(2, 2, 3))
    force, tibia = np.array([700.0, 300.0]), np.eye(4)
    share = MuscleShare(
        ("a", "b"), force, force, ("knee",), np.zeros(1), np.zeros(1), 0, np.arange(2),
        CrossingLines(shank, thigh),
    )  # fmt: skip
    coordinates = np.array([0.003, 0.04, -0.002, 0.1, -0.05, 0.7])

    def lengths(q):
        return np.linalg.norm(transform(knee_pose(q), thigh) - shank, axis=1)

    step = 1e-6
    slopes = [
        (lengths(coordinates + e) - lengths(coordinates - e)) / (2 * step) for e in step * np.eye(6)
    ]
    on_femur = -knee_axes(coordinates) @ share.wrench(tibia, knee_pose(coordinates))
    np.testing.assert_allclose(on_femur, -np.array(slopes) @ force, rtol=1e-7, atol=1e-6)


def test_the_wrench_of_the_released_knee_is_that_of_the_equations():
    trial, knee = two_flexors(1), with_ground_force(GROUND_POINTS["behind"])
    share = SharedMuscles(trial).frame(0).share(knee, FRICTION, frozenset())
    state = knee.state
    on_tibia = [load for load in share.loads(state) if load.link == "tibia"]
    wrench = share.wrench(state.pose("tibia"), state.pose("femur"))
    np.testing.assert_allclose(wrench, total_wrench(on_tibia, np.zeros(3)), atol=1e-9)


def test_a_muscle_without_a_path_fails_its_frame_by_name():
    trial = two_flexors(1)
    trial.problems.arms[0, 1] = np.nan
    geometry, loads = (
        SharedMuscles(trial).frame(0).solve(with_ground_force(GROUND_POINTS["behind"]), FRICTION)
    )
    assert "no taut path of hamstring" in loads.problems[0]
    assert np.isnan(loads.contact_force).all()
    assert np.isnan(geometry.share.force).all()


def test_a_frame_without_its_patella_fails_by_name():
    lost = replace(
        with_ground_force(GROUND_POINTS["behind"]), extensor=None, problems=("patella lost",)
    )
    geometry, loads = SharedMuscles(two_flexors(1)).frame(0).solve(lost, FRICTION)
    assert "patella lost" in loads.problems[0]
    assert np.isnan(geometry.share.force).all()


def test_a_scene_with_muscles_needs_its_own_patella(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(
        '[patient]\nurdf = "a.urdf"\nside = "right"\nmass_kg = 70.0\n'
        '[motion]\nfile = "a.csv"\nangle_unit = "deg"\nlength_unit = "mm"\ncutoff_Hz = 6.0\n'
        '[muscles]\nmodel = "a.osim"\n'
    )
    with pytest.raises(InputError, match=r"\[muscles\] needs \[quadriceps\]"):
        load_scene(scene)


def test_without_the_tables_neither_muscles_nor_emg_nor_measurements_are_imported():
    modules = (
        "tkamb.run.muscles",
        "tkamb.io.opensim",
        "tkamb.io.recordings.measured",
        "tkamb.run.recorded",
    )
    code = (
        "import sys; from tkamb.io.scene import load_scene; "
        "from tkamb.io.scene.case import load_case; "
        "from tkamb.run.read_scene import recording_of; "
        f"m = recording_of(load_case(load_scene({str(SHIPPED)!r}))); assert m.muscles is None; "
        f"print([n for n in sys.modules if n.startswith({modules})])"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert process.stdout.strip() == "[]"


def test_columns_of_muscles_have_their_positions():
    name = family_column(MUSCLE_FORCE, "soleus_r")
    assert name == "muscle_soleus_r_N"
    assert in_a_family("reserve_knee_angle_r_Nm")
    assert not belongs("reserve_Nm", RESERVE)
    names = ordered_names([name, "ligament_PCL_N"])
    assert names.index("ligament_PCL_N") < names.index(name)


def test_the_summary_reports_the_reserve():
    columns = {
        "reserve_knee_Nm": np.array([0.1, -3.0, np.nan]),
        "joint_moment_knee_Nm": np.array([-40.0, 20.0, np.nan]),
    }
    knee_reserve = reserves(columns)["knee"]
    assert knee_reserve["largest_Nm"] == 3.0
    assert knee_reserve["percent_of_largest_moment"] == pytest.approx(7.5)
    assert knee_reserve["frames_above_5_percent"] == 1


def test_the_rotation_since_the_lines_were_computed_is_reported():
    computed_at = pose(Rotation.from_euler("z", -30, degrees=True).as_matrix(), [0.01, 0.4, 0.0])
    now = pose(Rotation.from_euler("zx", (-40, 3), degrees=True).as_matrix(), [0.0, 0.4, 0.0])
    tibia = pose(Rotation.from_euler("y", 25, degrees=True).as_matrix(), [0.1, 0.2, 0.3])
    for knee, angle in ((computed_at, 0.0), (now, np.hypot(10, 3))):
        state = SimpleNamespace(pose={"tibia": tibia, "femur": tibia @ knee}.__getitem__)
        turned = np.degrees(CrossingLines(SHANK, THIGH, computed_at).turned(state))
        assert turned == pytest.approx(angle, abs=0.05)
        assert np.isnan(CrossingLines(SHANK, THIGH).turned(state))
