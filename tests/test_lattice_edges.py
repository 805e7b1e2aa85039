"""A peak at an edge that the cells do not resolve is flagged; a peak on a smooth surface is not."""

import numpy as np
import pytest
import trimesh

from lattice_bodies import above, box_insert, pair, sphere_cap
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.geometry.surface import Surface

MODELS = ("lattice-linear", "fe")


def punch(radius=6e-3, fillet=0.5e-3):
    """Return a round flat punch with a rounded edge; its flat lies in y = 0."""
    angle = np.linspace(0.0, np.pi / 2, 20)
    rim = radius - fillet + fillet * np.sin(angle), fillet - fillet * np.cos(angle)
    flat = np.stack([np.linspace(0.0, radius - fillet, 12)[:-1], np.zeros(11)], axis=1)
    outline = np.vstack([flat, np.stack(rim, axis=1), [[radius, 5e-3], [0.0, 5e-3]]])
    body = trimesh.creation.revolve(outline, sections=128)
    body.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    return Surface(np.array(body.vertices), np.array(body.faces, np.int64), "punch")


def pressed(model, femoral, size_mm):
    bodies = pair(femoral, box_insert(16e-3, 8e-3, 16e-3), material("polyethylene-linear"))
    state = contact_model(model, resolution=size_mm * 1e-3, cache=False).prepare(bodies)
    start = above(y=10e-3 - femoral.bounds[0, 1])
    return contact_model(model, resolution=size_mm * 1e-3, cache=False).press(state, 500.0, start)


@pytest.mark.parametrize("model", MODELS)
def test_a_punch_is_flagged_at_every_cell_size_and_its_peak_rises(model):
    coarse, middle, fine = (pressed(model, punch(), size) for size in (1.5, 1.0, 0.8))
    for result in (coarse, middle, fine):
        peak = result.points[np.argmax(result.pressure)]
        assert np.hypot(peak[0], peak[2]) > 3e-3
        assert [flag for flag in result.flags if "edge of the femoral component" in flag]
    assert fine.pressure.max() > middle.pressure.max() > coarse.pressure.max()
    assert fine.pressure.max() > 1.2 * coarse.pressure.max()


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("size", [2.5, 1.5])
def test_a_sphere_has_no_edge(model, size):
    flags = pressed(model, sphere_cap(22e-3), size).flags
    assert not [flag for flag in flags if "edge of the femoral component" in flag]
