"""Loads of a scaled patient, with the same shape and another size."""

from pathlib import Path

import numpy as np
import pytest

from tkamb.errors import InputError
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.read_scene import recording_of

SCENE = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "scene.toml"
S = 1.1


def case(scale, *drop):
    """Return the shipped knee at a scale without contact, ligaments and the tables `drop`."""
    scene = load_scene(SCENE, {"patient.scale": scale})
    return load_case(scene.model_copy(update=dict.fromkeys(("contact", *drop)) | {"ligament": ()}))


def test_static_forces_without_ligaments_scale_with_body_weight():
    # Forces scale with s³, moments with s⁴, arms with s. Inertia forces, which scale with s⁴, are
    # zero in the first frame.
    plain, large = (recording_of(case(scale)).loads(0).loads for scale in (1.0, S))
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
        original, scaled = getattr(plain, part), getattr(large, part)
        np.testing.assert_allclose(scaled.vertices, S * original.vertices)
    for original, scaled in zip(plain.ligaments, large.ligaments, strict=True):
        assert scaled.slack_length == pytest.approx(S * original.slack_length)
        # The same strain gives S² times the force.
        assert scaled.law.stiffness * scaled.slack_length == pytest.approx(
            S**2 * original.law.stiffness * original.slack_length
        )
    for link in ("tibia", "femur"):
        (mass, centre, inertia), (large_mass, large_centre, large_inertia) = (
            original.chain.segment(link) for original in (plain, large)
        )
        assert large_mass == pytest.approx(S**3 * mass)
        np.testing.assert_allclose(large_centre, S * centre)
        np.testing.assert_allclose(large_inertia, S**5 * inertia)
    np.testing.assert_allclose(
        large.motion.coordinates, plain.motion.coordinates * [*[S] * 3, 1, 1, 1]
    )
    expected = S * plain.chain.link_in("hip", "femur")[:3, 3]
    np.testing.assert_allclose(large.chain.link_in("hip", "femur")[:3, 3], expected)


def test_a_scale_beyond_people_is_refused():
    with pytest.raises(InputError, match=r"patient\.scale.*not within 0\.7"):
        load_scene(SCENE, {"patient.scale": 2.0})
