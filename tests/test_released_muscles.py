"""Released coordinates together with muscles that share the load."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

from joints import bundles, dished_joint, joint_equations, push
from jw_gait import JW, needs_jw
from mirrored_patient import write_mirrored_patient
from scenes import MODEL, write_scene
from shared_trials import two_flexors
from tkamb.contact.foundation import ElasticFoundation
from tkamb.geometry.frames import MIRROR, knee_pose
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.crossing import CrossingLines, MuscleShare
from tkamb.knee.load import total_wrench
from tkamb.knee.relaxation import Relaxation
from tkamb.knee.released_forces import SCALE, ReleasedForces, external_wrench
from tkamb.knee.solution_derivatives import moved_contact
from tkamb.run.muscles.shared_muscles import SharedMuscles
from tkamb.run.read_scene import recording_of
from tkamb.run.simulation import simulate

OG3 = MODEL.parent / "jw" / "ngait_og3.toml"
CONTACT = {
    "contact.model": "foundation",
    "contact.resolution_mm": 2.0,
    "contact.released": ["ap", "ml", "axial_rotation", "adduction"],
}
FRAMES = (40, 41, 42)


def side_with_flexors(scene, left=False):
    """Return the shipped knee with quadriceps, hamstring and gastrocnemius."""
    case = load_case(load_scene(scene, CONTACT))
    recording = recording_of(case)
    trial = two_flexors(len(case.motion.time), least=0.02)
    if left:
        trial = replace(trial, shank=trial.shank @ MIRROR, thigh=trial.thigh @ MIRROR)
    recording.muscles = SharedMuscles(trial, is_left=left)
    return recording


def computed(recording):
    """Return a few frames, each with the previous frame as initial guess."""
    results = []
    for k in FRAMES:
        results.append(recording.frame(k, [frame.next for frame in results]))
    return results


@pytest.fixture(scope="module")
def recording():
    return side_with_flexors(MODEL / "scene.toml")


@pytest.fixture(scope="module")
def equilibria(recording):
    return computed(recording)


def test_the_shank_is_in_equilibrium_with_muscles(recording, equilibria):
    """The loads are ground, weight, inertia, ligaments, muscles, contact and residuals."""
    for frame in equilibria:
        geometry, values = frame.geometry, frame.loads.values
        assert geometry.share.force[1:].min() > 15.0
        loads = [*geometry.ligaments, *geometry.share.loads(geometry.state)]
        total = external_wrench(geometry, geometry.coordinates)
        total = total + total_wrench([a for a in loads if a.link == "tibia"], np.zeros(3))
        pull = [p for p in geometry.extensor.patellar_ligament if p.link == "tibia"]
        total = total + values["patellar_ligament"] * total_wrench(pull, np.zeros(3))
        points = []
        for name, condyle in geometry.condyles.items():
            force = -values[f"{name}_normal"] * condyle.direction(recording.knee.friction)
            total = total + push(force, condyle.point)
            points.append(condyle.point)
        residual = np.array([values["residual_ap"], 0.0, values["residual_ml"]])
        total = total + push(residual, np.mean(points, axis=0))
        total[4] += values["residual_axial"]
        scale = np.linalg.norm(frame.loads.contact_force)
        np.testing.assert_allclose(total, 0.0, atol=1e-8 * scale)


def test_the_muscle_forces_satisfy_the_equations_of_the_released_knee(equilibria):
    """Static optimisation and equations give the same quadriceps tension to 1 N."""
    for frame in equilibria:
        quadriceps = frame.geometry.extensor.tension(frame.loads.values)
        assert quadriceps == pytest.approx(frame.geometry.share.force[0], abs=1.0)
        assert quadriceps > 500.0
        assert frame.iterations <= 6
        for name in ("residual_ap", "residual_ml"):
            assert abs(frame.loads.values[name]) < 0.2


def test_the_result_does_not_depend_on_the_initial_guess(recording, equilibria):
    """Alone and after other frames, a frame has the same pose and the same muscle forces to 0.1 N.

    The compliance of an early pass would change a muscle force of 52 N by 8 N.
    """
    frame, series = recording.frame(FRAMES[-1]), equilibria[-1]
    difference = (frame.equilibrium.coordinates - series.equilibrium.coordinates) * SCALE
    assert np.abs(difference).max() < 2e-6
    np.testing.assert_allclose(frame.geometry.share.force, series.geometry.share.force, atol=0.1)
    force = series.loads.contact_force
    np.testing.assert_allclose(frame.loads.contact_force, force, atol=2e-4 * np.linalg.norm(force))


def test_activations_are_continuous(equilibria):
    activations = np.array([frame.geometry.share.activation for frame in equilibria])
    assert np.abs(np.diff(activations, axis=0)).max() < 0.05


def test_a_left_leg_with_muscles_gives_the_mirrored_result(tmp_path, equilibria):
    mirrored = side_with_flexors(write_mirrored_patient(tmp_path), left=True)
    frame = mirrored.frame(FRAMES[0])
    right = equilibria[0]
    np.testing.assert_allclose(frame.geometry.share.force, right.geometry.share.force, atol=1e-5)
    np.testing.assert_allclose(frame.loads.contact_force, right.loads.contact_force, atol=1e-4)
    coordinates = frame.equilibrium.coordinates
    np.testing.assert_allclose(coordinates, right.equilibrium.coordinates, atol=1e-9)


def test_the_tension_per_wrench_is_that_of_a_second_search():
    """The tangent agrees with a second search under slightly more load: closely with a contact
    that is linear, roughly with the columns of the foundation.
    """
    model, start = ElasticFoundation(resolution=1e-3, law="linear"), np.zeros(6)
    state = model.prepare(dished_joint())
    start[1] = state.pair.first_touch_height(np.eye(4)) - 5e-5
    load = push((20.0, 900.0, 5.0), (0.003, 0.0, 0.004))
    ends = [((x, 0.0, 0.03), (0.0, -0.04, 0.03), 0.0745) for x in (-0.01, 0.02)]

    def joint_of(external):
        return joint_equations(external, ligaments=bundles(ends))

    def equilibrium(external, coordinates, probe):
        joint = joint_of(external)
        forces = ReleasedForces(joint, probe, coordinates)
        balance = forces.polished(forces.balance(), 1000.0)
        contact = forces.contact(balance)
        coordinates = forces.at(balance)
        return coordinates, contact, float(joint.reactions(coordinates, contact.wrench)[-1])

    coordinates, contact, tension = equilibrium(load, start, model.probe(state))
    forces = ReleasedForces(joint_of(load), model.probe(state), coordinates)
    compliance = forces.tension_per_wrench(contact)
    assert forces.tension_in_equilibrium(contact, compliance) == pytest.approx(tension, rel=1e-4)
    here = pin.SE3(knee_pose(coordinates)).inverse()
    linear = SimpleNamespace(
        at=lambda pose: moved_contact(contact, pin.log6(pin.SE3(pose) * here).vector)
    )
    added = push((1.0, 20.0, 0.5), (0.004, 0.01, -0.01))
    rigid = joint_equations(added).reactions(coordinates, np.zeros(6))[-1]
    exact, change = (
        equilibrium(load + added, coordinates, probe)[2] - tension
        for probe in (linear, model.probe(state))
    )
    assert compliance @ added - rigid == pytest.approx(exact - rigid, rel=1e-5)
    assert compliance @ added == pytest.approx(change, rel=0.01)
    assert abs(rigid - change) > 0.05 * abs(change)
    # near equilibrium: the residual is treated as an additional wrench
    away = ReleasedForces(joint_of(load + added), model.probe(state), coordinates)
    assert away.tension_in_equilibrium(contact, compliance) == pytest.approx(
        tension + change, rel=1e-3
    )


def share_of(force):
    value, no_lines = np.array([force]), np.zeros((0, 3))
    return MuscleShare(
        ("a",),
        value,
        value,
        ("knee",),
        value,
        value,
        0,
        np.zeros(0, int),
        CrossingLines(no_lines, no_lines),
    )


@pytest.mark.parametrize("slope", [0.2, -0.3, -1.0, -4.0])
def test_relaxation_converges_where_plain_iteration_diverges(slope):
    """With f' = 100 + slope f and a slope below -1, plain iteration diverges."""
    relaxation = Relaxation()
    applied = relaxation.relaxed_forces(share_of(0.0))
    for _ in range(6):
        applied = relaxation.relaxed_forces(share_of(100.0 + slope * applied.force[0]))
        if relaxation.converged:
            break
    assert relaxation.converged
    assert applied.force[0] == pytest.approx(100.0 / (1.0 - slope), abs=4.0)


@pytest.mark.parametrize("steepness", [0.5, -0.9, -2.0])
def test_the_compliance_converges_where_plain_iteration_oscillates(steepness):
    """With g' = 1 + steepness (g - 1) and a steepness below -1, plain iteration oscillates."""
    relaxation, compliance = Relaxation(), None
    for _ in range(10):
        measured = np.full(6, 3.0) if compliance is None else 1.0 + steepness * (compliance - 1.0)
        compliance = relaxation.compliance(measured)
    np.testing.assert_allclose(compliance, 1.0, atol=0.25)
    assert relaxation.compliance_error == pytest.approx(
        np.abs(measured - compliance).max() / np.abs(compliance).max()
    )
    assert relaxation.compliance(None) is None
    assert relaxation.compliance_error == 0.0


def test_the_last_compliance_is_constant_and_its_difference_is_reported():
    relaxation, compliance = Relaxation(), None
    for k in range(20):
        compliance = relaxation.compliance(np.full(6, 1.0 if k % 2 else 2.0))
    assert relaxation.compliance_error > 0.1
    np.testing.assert_array_equal(compliance, relaxation.compliance(np.full(6, 9.0)))


@pytest.mark.slow
@needs_jw
@pytest.mark.parametrize(("contact", "cell"), [("foundation", 1.5), ("lattice", 2.0)])
def test_single_frames_of_gait_equal_those_of_the_whole_run(contact, cell):
    """og3's frames 46 to 52 do not depend on the frame at which the run begins."""
    changes = {"contact.model": contact, "contact.resolution_mm": cell}
    scene = load_scene(OG3.with_name("ngait_og3_measured.toml"), changes)
    alone, longer = (simulate(scene, frames=slice(start, 53)) for start in (46, 40))
    force, expected = (run.columns["force_total_N"] for run in (alone, longer))
    assert np.isfinite(force).all()
    np.testing.assert_allclose(force, expected[6:], rtol=5e-4)


@pytest.mark.slow
@needs_jw
def test_activations_in_gait_are_continuous_at_100_Hz():
    """In the mid-stance of og3 forces jump only if a condyle lands or lifts off."""
    changes = {
        "muscles.model": str(JW / "JW.osim"),
        "contact.resolution_mm": 1.5,
        "motion.interval_s": [2.25, 2.45],
        "motion.frames": 21,
    }
    results = simulate(load_scene(OG3, changes))
    columns = results.columns
    assert not any(status.startswith("failed") for status in columns["status"])
    activations = np.array([v for name, v in columns.items() if name.startswith("activation_")])
    assert len(activations) > 40
    assert np.abs(np.diff(activations, axis=1)).max() < 0.2
    assert np.median(columns["coupling_iterations"]) <= 5
    heads = sum(columns[f"muscle_{name}_N"] for name in ("recfem", "vasint", "vaslat", "vasmed"))
    np.testing.assert_allclose(heads, columns["quadriceps_N"], atol=2.0)


def test_all_results_of_a_left_leg_equal_those_of_the_right_leg(tmp_path, monkeypatch):
    """Mirrored files give the same columns and the same map."""

    def muscles_of(case):
        left = case.scene.patient.side == "left"
        trial = two_flexors(len(case.motion.time), least=0.02)
        if left:
            trial = replace(trial, shank=trial.shank @ MIRROR, thigh=trial.thigh @ MIRROR)
        return SharedMuscles(trial, left)

    monkeypatch.setattr("tkamb.run.muscles.shared_muscles.load_muscles", muscles_of)
    settings = CONTACT | {
        "muscles.model": "patient.urdf"
    }  # the reader of this key is replaced here
    left_scene = write_mirrored_patient(tmp_path / "left")
    right, left = (
        simulate(load_scene(path, settings), frames=slice(40, 101, 30))
        for path in (write_scene(tmp_path / "right"), left_scene)
    )
    assert right.status == left.status
    assert not any(status.startswith("failed") for status in right.status)
    assert set(right.columns) == set(left.columns) >= {"muscle_hamstring_N", "hip_moment_ap_Nm"}
    assert "lateral_from_gastrocnemius_N" in right.columns
    for name in set(right.columns) - {"status"}:
        if not name.endswith("_seconds"):
            size = np.nanmax(np.abs(right[name]), initial=1e-3)
            np.testing.assert_allclose(left[name], right[name], atol=1e-6 * size, err_msg=name)
    np.testing.assert_allclose(left.maps.pressure_Pa, right.maps.pressure_Pa, atol=1.0)
