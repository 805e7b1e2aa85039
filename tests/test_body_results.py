"""What the body adds to the results: sliding, strains, wrapping; roll-slip, generic ligaments."""

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
from tkamb.run.read_scene import mechanics_of
from tkamb.run.tabulate import WHY_IT_FAILED
from tkamb.show.sections import strain_table

FEW = {"motion.frames": 26}
FRAMES = slice(10, 91, 40)


@pytest.fixture(scope="module")
def bend():
    return simulate(fast_scene(), frames=FRAMES)


@pytest.mark.parametrize("side", ["medial", "lateral"])
def test_slip_velocity_by_arcs_is_that_of_the_rigid_body(bend, side):
    by_arcs = bend[f"{side}_slip_velocity_mm_per_s"]
    by_body = bend[f"{side}_sliding_velocity_mm_per_s"]
    assert by_arcs.min() > 3.0
    np.testing.assert_allclose(by_arcs, by_body, rtol=0.02)


@pytest.mark.parametrize("side", ["medial", "lateral"])
def test_shipped_motion_keeps_the_contact_constraint(bend, side):
    """Its poses are first touches of smooth surfaces; facets leave 0.1 mm/s of 17 mm/s."""
    assert np.abs(bend[f"{side}_normal_velocity_mm_per_s"]).max() < 0.1


def test_a_femur_that_is_lifted_violates_it(tmp_path):
    """1 mm in a second, upwards: that velocity along the normal, in every frame."""
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
    found = bend.summary["ligament_strain"]
    assert list(found["flexion_deg"]) == [0.0, 60.0, 90.0]
    assert set(found["strain"]) == {bundle.name for bundle in load_scene(fast_scene()).ligament}
    assert all(abs(strain) < 0.2 for row in found["strain"].values() for strain in row)
    wrapped = bend["flexion_deg"][bend["quadriceps_wrap_deg"] > 0]
    assert bend.summary["first_wrapping_flexion_deg"] == wrapped.min()
    table = strain_table(bend.summary)
    shown = {name: cells for name, *cells in table.rows}
    assert "PCL_anterolateral" in shown
    drawn = f"{100 * found['strain']['MCL_deep'][0]:.1f}".replace("-", "−")
    assert shown["MCL_deep"][0] == drawn


def test_roll_slip_with_the_recorded_slip_is_the_recorded_motion():
    """AP from rolling plus slip gives back AP, SI from contact SI, on a motion in touch."""
    recorded = load_case(load_scene(fast_scene(), FEW)).motion
    case = load_case(load_scene(fast_scene(), FEW | {"motion.motion": "roll-slip"}))
    rolled = case.motion
    np.testing.assert_array_equal(rolled.coordinates[:, 2:], recorded.coordinates[:, 2:])
    np.testing.assert_allclose(rolled.coordinates[:, 0], recorded.coordinates[:, 0], atol=1e-4)
    np.testing.assert_allclose(rolled.coordinates[:, 1], recorded.coordinates[:, 1], atol=3e-5)
    query = ClosestPointQuery(case.femoral, case.insert, case.split)
    for pose in knee_pose(rolled.coordinates[::6]):
        gaps = query.at(pose)
        assert min(abs(gaps.medial.gap), abs(gaps.lateral.gap)) < 2e-6


def test_pure_rolling_leaves_this_insert_and_says_so():
    changes = FEW | {"motion.motion": "roll-slip", "motion.slip_share": 0.0}
    with pytest.raises(InputError, match="rolls off the insert at"):
        load_case(load_scene(fast_scene(), changes))


def test_generic_ligaments_are_named_so():
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
def test_keys_that_do_not_go_together(changes, words):
    with pytest.raises(InputError, match=words):
        load_scene(fast_scene(), changes)


@pytest.mark.parametrize("table", ["quadriceps", "patellar_ligament"])
@pytest.mark.parametrize(("key", "value"), [("half_thickness_mm", 0.0035), ("band_mm", 0.005)])
def test_a_tendon_in_metres_is_refused(table, key, value):
    """It ran as ok: at 120 deg a string of a quadriceps pulls 0.7 % more than a tendon."""
    with pytest.raises(InputError, match=f"{value:g} is neither 0 nor within .* in millimetres"):
        load_scene(fast_scene(), {f"{table}.{key}": value})
    load_scene(fast_scene(), {f"{table}.{key}": 0.0})  # a string, or its own plane, as before


def test_a_reference_pose_that_was_not_recorded_is_refused(tmp_path):
    changes = {"ligament": [], "generic_ligaments.ligaments": ["LCL"]}
    path = write_scene(tmp_path)
    for name in ("motion", "tibia", "ground_reaction"):
        file = path.parent / f"{name}.csv"
        header, *rows = file.read_text(encoding="utf-8").splitlines()
        file.write_text("\n".join([header, *rows[50:]]) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match="reference pose is at 0 deg"):
        simulate(load_scene(path, changes), frames=slice(0, 1))


def test_a_wider_band_wraps_sooner_and_further():
    """The flanges stand in front of the groove's floor."""
    wraps = []
    for band in (5.0, 12.0):
        mechanics = mechanics_of(
            load_case(load_scene(fast_scene(), FEW | {"quadriceps.band_mm": band}))
        )
        wraps.append([mechanics.geometry(k).extensor.wrap for k in (12, 19, 25)])
    assert wraps[0][0] == 0.0
    assert (np.array(wraps[1]) > np.array(wraps[0])).all()


def test_a_long_motion_keeps_no_state_of_every_frame(monkeypatch):
    """A state holds Pinocchio's data, a quarter of a MB: 3,000 of them were 0.8 GB."""
    at, seen = Chain.at, []

    def watched(self, motion):
        state = at(self, motion)
        seen.append(weakref.ref(state))
        return state

    monkeypatch.setattr(Chain, "at", watched)
    mechanics = mechanics_of(load_case(load_scene(fast_scene(), FEW)))
    assert mechanics.ligaments
    for k in range(len(mechanics.motion)):
        mechanics.geometry(k)
    assert len(seen) >= 26
    assert sum(one() is not None for one in seen) <= 1


def test_a_contact_out_of_range_leaves_no_load_of_the_body(tmp_path):
    """At a recorded pose: the body has its forces, but the insert cannot carry them."""
    path = write_scene(tmp_path)
    file = path.parent / "ground_reaction.csv"
    header = file.read_text(encoding="utf-8").split("\n", 1)[0]
    rows = np.loadtxt(file, delimiter=",", skiprows=1)
    forces = [header.split(",").index(f"force_{axis}_N") for axis in "xyz"]
    rows[60:, forces] *= 30.0
    np.savetxt(file, rows, "%.9g", ",", header=header, comments="")
    results = simulate(path, frames=slice(40, 71, 30))
    carried, crushed = results.columns["status"]
    assert not carried.startswith("failed")
    assert crushed.startswith("failed: contact out of range")
    motion = {"time_s", "flexion_deg", "adduction_deg", "axial_rotation_deg"}
    told = {name for name, v in results.columns.items() if name != "status" and np.isfinite(v[1])}
    assert motion <= told <= {*motion, *WHY_IT_FAILED}
    assert np.isfinite(results["force_total_N"][0])
