"""Coupling of body and contact on the shipped knee bend: points, and released adduction."""

import numpy as np
import pytest

from scenes import fast_scene
from tkamb.errors import InputError
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.frame import COUPLING
from tkamb.run.read_scene import recording_of
from tkamb.run.simulation import simulate

SCENE = fast_scene()
FRAMES = slice(0, 101, 20)
COARSE = {"contact.resolution_mm": 2.0}


def run(**contact):
    """Return the results of six frames with changed keys of [contact]."""
    overrides = COARSE | {f"contact.{key}": value for key, value in contact.items()}
    return simulate(load_scene(SCENE, overrides), frames=FRAMES)


@pytest.fixture(scope="module")
def uncoupled():
    return run()


@pytest.fixture(scope="module")
def coupled():
    return run(coupling="points")


@pytest.fixture(scope="module")
def tilting():
    """Return the results with released adduction."""
    return run(released=["adduction"])


def shares(results):
    """Return the medial share by deformation, and that by coronal equilibrium."""
    medial, lateral = results["medial_force_N"], results["lateral_force_N"]
    return medial / (medial + lateral), results["medial_share_equilibrium"]


def test_an_uncoupled_frame_is_a_contact_solution_at_the_load_of_the_equations():
    case = load_case(load_scene(SCENE, COARSE))
    recording = recording_of(case)
    contact, frame = recording.knee.contact, recording.frame(60)
    load = recording.loads(60).loads.contact_force[1]
    pressed = contact.model.press(contact.state, load, recording.poses[60], None)
    assert frame.loads.contact_force[1] == load
    assert np.array_equal(frame.contact.pressure, pressed.pressure)
    assert frame.iterations == 0


def test_coupled_points_converge_within_five_iterations(uncoupled, coupled):
    assert coupled["coupling_iterations"].max() <= 5
    assert coupled["coupling_change_N"].max() < COUPLING.force_tolerance
    assert coupled["coupling_change_mm"].max() < COUPLING.point_tolerance * 1e3
    assert np.isnan(uncoupled["coupling_iterations"]).all()
    change = np.abs(coupled["force_si_N"] / uncoupled["force_si_N"] - 1)
    assert 0 < change.max() < 0.02


def test_the_sum_of_nodal_forces_is_the_superior_inferior_force(coupled):
    pressed = -coupled.maps.nodal_force_N[..., 1].sum(axis=1)
    assert np.allclose(pressed, coupled["force_si_N"], rtol=1e-5)


def test_both_estimates_of_the_split_agree_with_released_adduction(uncoupled, tilting):
    deformed, balanced = shares(uncoupled)
    assert np.abs(deformed - balanced).max() > 0.02
    deformed, balanced = shares(tilting)
    assert np.abs(deformed - balanced).max() < 1e-3
    rotation = tilting["adduction_deg"] - uncoupled["adduction_deg"]
    assert 1e-3 < np.abs(rotation).max() < 0.2
    assert np.allclose(tilting["axial_rotation_deg"], uncoupled["axial_rotation_deg"])
    for axis in ("ap", "ml"):
        assert np.allclose(tilting[f"{axis}_mm"], uncoupled[f"{axis}_mm"], atol=1e-9)


def test_pressures_and_condylar_forces_are_never_negative(coupled, tilting):
    for results in (coupled, tilting):
        assert (results.maps.pressure_Pa >= 0).all()
        assert (results["medial_force_equilibrium_N"] >= 0).all()
        assert (results["lateral_force_equilibrium_N"] >= 0).all()


def test_adjustment_and_released_coordinates_exclude_each_other():
    with pytest.raises(InputError, match="exclude"):
        load_scene(SCENE, {"contact.released": ["ml"], "contact.adjust": True})
    with pytest.raises(InputError, match="twice"):
        load_scene(SCENE, {"contact.released": ["ml", "ml"]})
    with pytest.raises(InputError, match="released"):
        load_scene(SCENE, {"contact.released": ["flexion"]})
