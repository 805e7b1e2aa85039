"""Results of the rigid-body equations: sliding, strains, wrapping, roll-slip, ligaments."""

import weakref

import numpy as np
import pytest

from scenes import fast_scene, write_scene
from tkamb import load_scene, simulate
from tkamb.errors import InputError
from tkamb.geometry.closest import ClosestPointQuery
from tkamb.geometry.frames import knee_pose
from tkamb.io.scene.case import load_case
from tkamb.knee.chain import Chain
from tkamb.run.read_scene import recording_of
from tkamb.run.tabulate import WHY_IT_FAILED
from tkamb.show.sections import strain_table

FEW = {"motion.frames": 26}
FRAMES = slice(10, 91, 40)


@pytest.fixture(scope="module")
def bend():
    """Return the results of three frames of the shipped bend."""
    return simulate(fast_scene(), frames=FRAMES)


@pytest.mark.parametrize("side", ["medial", "lateral"])
def test_slip_velocity_by_arcs_is_that_of_the_rigid_body(bend, side):
    by_arcs = bend[f"{side}_slip_velocity_mm_per_s"]
    by_body = bend[f"{side}_sliding_velocity_mm_per_s"]
    assert by_arcs.min() > 3.0
    np.testing.assert_allclose(by_arcs, by_body, rtol=0.02)


@pytest.mark.parametrize("side", ["medial", "lateral"])
def test_the_shipped_motion_satisfies_the_contact_constraint(bend, side):
    """The poses are first touches of smooth surfaces. The facets of the meshes cause 0.1 mm/s."""
    assert np.abs(bend[f"{side}_normal_velocity_mm_per_s"]).max() < 0.1


def test_a_lifted_femur_violates_the_contact_constraint(tmp_path):
    """An added upward velocity of 1 mm/s is the normal velocity in every frame."""
    path = write_scene(tmp_path)
    file = path.parent / "motion.csv"
    header = file.read_text(encoding="utf-8").split("\n", 1)[0]
    rows = np.loadtxt(file, delimiter=",", skiprows=1)
    rows[:, header.split(",").index("si_mm")] += rows[:, 0] - 2.0
    np.savetxt(file, rows, "%.9g", ",", header=header, comments="")
    results = simulate(path, frames=slice(50, 51))
    for side in ("medial", "lateral"):
        np.testing.assert_allclose(results[f"{side}_normal_velocity_mm_per_s"], 1.0, atol=0.1)


def test_strains_and_first_wrapping_are_in_the_summary(bend):
    strains = bend.summary["ligament_strain"]
    assert list(strains["flexion_deg"]) == [0.0, 60.0, 90.0]
    assert set(strains["strain"]) == {bundle.name for bundle in load_scene(fast_scene()).ligament}
    assert all(abs(strain) < 0.2 for row in strains["strain"].values() for strain in row)
    wrapping_flexion = bend["flexion_deg"][bend["quadriceps_wrap_deg"] > 0]
    assert bend.summary["first_wrapping_flexion_deg"] == wrapping_flexion.min()
    table = strain_table(bend.summary)
    rows = {name: cells for name, *cells in table.rows}
    assert "PCL_anterolateral" in rows
    text = f"{100 * strains['strain']['MCL_deep'][0]:.1f}".replace("-", "−")
    assert rows["MCL_deep"][0] == text


def test_roll_slip_with_the_recorded_slip_is_the_recorded_motion():
    """For a motion in contact, rolling plus slip gives the recorded AP, and contact gives SI."""
    recorded = load_case(load_scene(fast_scene(), FEW)).motion
    case = load_case(load_scene(fast_scene(), FEW | {"motion.motion": "roll-slip"}))
    rolling = case.motion
    np.testing.assert_array_equal(rolling.coordinates[:, 2:], recorded.coordinates[:, 2:])
    np.testing.assert_allclose(rolling.coordinates[:, 0], recorded.coordinates[:, 0], atol=1e-4)
    np.testing.assert_allclose(rolling.coordinates[:, 1], recorded.coordinates[:, 1], atol=3e-5)
    query = ClosestPointQuery(case.femoral, case.insert, case.split)
    for pose in knee_pose(rolling.coordinates[::6]):
        gaps = query.at(pose)
        assert min(abs(gaps.medial.gap), abs(gaps.lateral.gap)) < 2e-6


def test_pure_rolling_off_the_insert_is_refused():
    changes = FEW | {"motion.motion": "roll-slip", "motion.slip_share": 0.0}
    with pytest.raises(InputError, match="rolls off the insert at"):
        load_case(load_scene(fast_scene(), changes))


def test_generic_ligaments_have_generic_in_their_names():
    changes = FEW | {"ligament": [], "generic_ligaments.ligaments": ["MCL", "PCL"]}
    results = simulate(load_scene(fast_scene(), changes), frames=slice(15, 16))
    names = [name for name in results.columns if name.startswith("ligament_")]
    assert len(names) == 5
    assert all(name.startswith("ligament_generic_") for name in names)
    strain = results.summary["ligament_strain"]["strain"]
    assert strain["generic_MCL_deep"][0] == pytest.approx(0.03)
    assert any("generic" in sentence for sentence in results.summary["assumptions"])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"generic_ligaments.ligaments": ["MCL"]}, "'MCL_anterior' is in"),
        ({"generic_ligaments.ligaments": ["XCL"]}, "MCL"),
        ({"motion.slip_share": 0.5}, "belongs to motion = 'roll-slip'"),
        ({"motion.motion": "rolling"}, "roll-slip"),
        ({"quadriceps.band_mm": -1.0}, "band_mm"),
    ],
)
def test_keys_that_exclude_each_other_are_refused(changes, words):
    with pytest.raises(InputError, match=words):
        load_scene(fast_scene(), changes)


@pytest.mark.parametrize("table", ["quadriceps", "patellar_ligament"])
@pytest.mark.parametrize(("key", "value"), [("half_thickness_mm", 0.0035), ("band_mm", 0.005)])
def test_a_tendon_in_metres_is_refused(table, key, value):
    with pytest.raises(InputError, match=f"{value:g} is neither 0 nor within .* in millimetres"):
        load_scene(fast_scene(), {f"{table}.{key}": value})
    load_scene(fast_scene(), {f"{table}.{key}": 0.0})  # a line without thickness or breadth


def test_a_reference_pose_that_was_not_recorded_is_refused(tmp_path):
    changes = {"ligament": [], "generic_ligaments.ligaments": ["LCL"]}
    path = write_scene(tmp_path)
    for name in ("motion", "tibia", "ground_reaction"):
        file = path.parent / f"{name}.csv"
        header, *rows = file.read_text(encoding="utf-8").splitlines()
        file.write_text("\n".join([header, *rows[50:]]) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match="reference pose is at 0 deg"):
        simulate(load_scene(path, changes), frames=slice(0, 1))


def test_a_wider_quadriceps_band_wraps_earlier_and_over_a_larger_angle():
    """The ridges beside the groove are in front of its floor."""
    wraps = []
    for band in (5.0, 12.0):
        recording = recording_of(
            load_case(load_scene(fast_scene(), FEW | {"quadriceps.band_mm": band}))
        )
        wraps.append([recording.geometry(k).extensor.wrap for k in (12, 19, 25)])
    assert wraps[0][0] == 0.0
    assert (np.array(wraps[1]) > np.array(wraps[0])).all()


def test_a_long_motion_stores_no_chain_state_per_frame(monkeypatch):
    """A state with its Pinocchio data has a quarter of a MB."""
    at, states = Chain.at, []

    def recorded_at(self, motion):
        state = at(self, motion)
        states.append(weakref.ref(state))
        return state

    monkeypatch.setattr(Chain, "at", recorded_at)
    recording = recording_of(load_case(load_scene(fast_scene(), FEW)))
    assert recording.ligaments
    for k in range(len(recording.motion)):
        recording.geometry(k)
    assert len(states) >= 26
    assert sum(state_reference() is not None for state_reference in states) <= 1


def test_a_frame_with_contact_out_of_range_has_no_forces(tmp_path):
    """The equations have a solution, but the insert cannot carry the load."""
    path = write_scene(tmp_path)
    file = path.parent / "ground_reaction.csv"
    header = file.read_text(encoding="utf-8").split("\n", 1)[0]
    rows = np.loadtxt(file, delimiter=",", skiprows=1)
    forces = [header.split(",").index(f"force_{axis}_N") for axis in "xyz"]
    rows[60:, forces] *= 30.0
    np.savetxt(file, rows, "%.9g", ",", header=header, comments="")
    results = simulate(path, frames=slice(40, 71, 30))
    light_status, heavy_status = results.columns["status"]
    assert not light_status.startswith("failed")
    assert heavy_status.startswith("failed: contact out of range")
    motion = {"time_s", "flexion_deg", "adduction_deg", "axial_rotation_deg"}
    numbers = {n for n, v in results.columns.items() if n != "status" and np.isfinite(v[1])}
    assert motion <= numbers <= {*motion, *WHY_IT_FAILED}
    assert np.isfinite(results["force_total_N"][0])
