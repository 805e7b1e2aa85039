"""Contact at the edge of the insert's articular surface is flagged."""

import numpy as np
import pytest

from contact_bodies import dished_insert, flat_insert, graded_sphere, joined
from tkamb.contact.flags import EDGE, ArticularEdge
from tkamb.contact.foundation import LinearFoundation
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.geometry.frames import pose

LINEAR = material("polyethylene-linear")
MM = 1e-3
HALF = 15 * MM


def filleted(fillet=3 * MM, height=9 * MM):
    """Return an insert with a flat top and a fillet along its outline."""

    def top(x, z):
        beyond = np.maximum(np.maximum(np.abs(x), np.abs(z)) - (HALF - fillet), 0.0)
        return height - fillet + np.sqrt(np.maximum(fillet**2 - beyond**2, 0.0))

    return dished_insert(top, spacing=0.25 * MM)


def with_eminence():
    """Return a flat insert with a steep ridge along x in the middle."""
    return dished_insert(
        lambda x, z: 8 * MM + np.clip(8 * MM - 3 * np.abs(z), 0.0, 6 * MM), half_z=30 * MM
    )


def flags(insert, x, z, model="foundation-linear", radius=20 * MM, load=150.0):
    chosen = contact_model(
        model, resolution=1e-3, **({"cache": False} if model.startswith("lat") else {})
    )
    pair = ContactPair(graded_sphere(radius), insert, LINEAR)
    result = chosen.press(chosen.prepare(pair), load, pose(np.eye(3), [x, 0, z]))
    return [flag for flag in result.flags if "edge of the insert" in flag]


@pytest.mark.parametrize("model", ["foundation-linear", "lattice-linear", "hertz"])
def test_contact_near_the_edge_is_flagged(model):
    insert = flat_insert(8 * MM)
    assert flags(insert, 0, 0, model) == []
    assert flags(insert, 6 * MM, 0, model) == []
    load = (
        20.0 if model == "hertz" else 150.0
    )  # with a larger load the ellipse would leave the insert
    for x, z in ((13.2 * MM, 0), (-13.2 * MM, 0), (0, 13.2 * MM), (3 * MM, -13.2 * MM)):
        (flag,) = flags(insert, x, z, model, load=load)
        assert "its peak pressure lies there" in flag


def test_the_edge_is_where_the_fillet_is_steep():
    """The articular surface ends at a slope of 50 deg on the fillet, 0.7 mm inside the wall."""
    edge = ArticularEdge.of(filleted())
    at = np.array([[x * MM, 9 * MM, 0.0] for x in (0, 8, 12, 13.5, 14.2, 14.9)])
    ends = HALF - 3 * MM * (1 - np.sin(EDGE.steepest))
    assert edge.distance(at) == pytest.approx(
        np.maximum(ends - at[:, 0], 0), abs=1.5 * EDGE.spacing
    )
    assert flags(filleted(), 11.8 * MM, 0)
    assert not flags(filleted(), 7 * MM, 0)


def test_the_flank_of_an_eminence_is_not_an_edge():
    edge = ArticularEdge.of(with_eminence())
    distances = edge.distance(np.array([[0, 0, 0], [0, 0, 3 * MM], [0, 0, 8 * MM]]))
    assert (distances > 10 * MM).all()  # the ends of the ridge at the outline belong to the rim
    assert not flags(with_eminence(), 0, 6 * MM, radius=8 * MM)


def test_each_condyle_has_its_own_flag():
    condyles = joined(*(graded_sphere(20 * MM, (0, 0, z * MM)) for z in (-22, 22)))
    insert = flat_insert(8 * MM, half_x=15 * MM, half_z=34 * MM)
    model = LinearFoundation(1 * MM)
    state = model.prepare(ContactPair(condyles, insert, LINEAR))
    for shift, side in ((-9.5 * MM, "medial"), (9.5 * MM, "lateral")):
        result = model.press(state, 400.0, pose(np.eye(3), [0, 0, shift]))
        (flag,) = [flag for flag in result.flags if "edge of the insert" in flag]
        assert flag.startswith(f"the {side} contact")
    level = model.press(state, 400.0, np.eye(4))
    assert not [flag for flag in level.flags if "edge of the insert" in flag]


@pytest.mark.parametrize("shift", [0.0, 7.0])
def test_the_flag_states_the_distance_of_the_peak(shift):
    """A wide, flat contact reaches the edge with its peak inside."""
    (flag,) = flags(flat_insert(8 * MM), (8 + shift) * MM, 0, radius=60 * MM, load=4000.0)
    assert ("lies there" in flag) == (shift > 0)
