"""Loads of a scaled patient, with the same shape and another size."""

from pathlib import Path

import numpy as np
import pytest

from tkamb.errors import InputError
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.read_scene import mechanics_of

SCENE = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "scene.toml"
S = 1.1


def case(scale, *drop):
    """Return the shipped knee at a scale without contact and what else is named."""
    scene = load_scene(SCENE, {"patient.scale": scale})
    return load_case(scene.model_copy(update=dict.fromkeys(("contact", *drop)) | {"ligament": ()}))


def test_at_rest_and_without_springs_forces_in_body_weights_are_those_of_the_original():
    # forces ~ s³, moments ~ s⁴, arms ~ s; the first frame stands still: no inertia, which
    # would grow with s⁴ at the same times
    plain, large = (mechanics_of(case(scale)).frame(0).loads for scale in (1.0, S))
    size = S**3 * float(np.linalg.norm(plain.contact_force))
    np.testing.assert_allclose(
        large.contact_force, S**3 * plain.contact_force, rtol=0.0, atol=1e-6 * size
    )
    assert size > 100.0


def test_every_part_of_the_case_is_scaled_by_its_power():
    scene = load_scene(SCENE)
    plain, large = load_case(scene), load_case(load_scene(SCENE, {"patient.scale": S}))
    assert large.body_weight == pytest.approx(S**3 * plain.body_weight)
    for part in ("femoral", "insert", "patella"):
        one, other = getattr(plain, part), getattr(large, part)
        np.testing.assert_allclose(other.vertices, S * one.vertices)
    for one, other in zip(plain.ligaments, large.ligaments, strict=True):
        assert other.slack_length == pytest.approx(S * one.slack_length)
        # the same strain gives S² times the force
        assert other.stiffness * other.slack_length == pytest.approx(
            S**2 * one.stiffness * one.slack_length
        )
    for link in ("tibia", "femur"):
        (mass, centre, inertia), (heavy, there, turning) = (
            one.chain.segment(link) for one in (plain, large)
        )
        assert heavy == pytest.approx(S**3 * mass)
        np.testing.assert_allclose(there, S * centre)
        np.testing.assert_allclose(turning, S**5 * inertia)
    np.testing.assert_allclose(
        large.motion.coordinates, plain.motion.coordinates * [*[S] * 3, 1, 1, 1]
    )
    moved = S * plain.chain.link_in("hip", "femur")[:3, 3]
    np.testing.assert_allclose(large.chain.link_in("hip", "femur")[:3, 3], moved)


def test_a_scale_beyond_people_is_refused():
    with pytest.raises(InputError, match=r"patient\.scale.*not within 0\.7"):
        load_scene(SCENE, {"patient.scale": 2.0})
