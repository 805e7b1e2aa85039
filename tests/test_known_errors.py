"""Large known errors of a contact model."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from lattice_bodies import above, box_insert, condyles
from tkamb.contact.flags import MESH_DEFECT, UNSUPPORTED
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.geometry.surface import Surface
from tkamb.run.known_errors import (
    LEAST_PAIRS,
    ContactSituation,
    is_large,
    known_error,
    stated_error,
)

BALL = condyles(offset=0.0, subdivisions=4)

EDGE = {"edge": {"peak_pressure": 0.3, "area": 0.2}}


def test_errors_at_an_edge_are_ignored_if_situations_were_measured():
    """Contact at an edge has its own flag."""
    overall = {"peak_pressure": 0.3, "area": 0.2, "cases": 20}
    smooth = {"interior": {"peak_pressure": 0.02, "area": 0.05}} | EDGE
    assert is_large(overall, ("area",))
    assert not is_large(overall | {"situations": smooth}, ("area", "peak_pressure"))
    steep = smooth | {"flank": {"peak_pressure": 0.02, "area": 0.12}}
    assert is_large(overall | {"situations": steep}, ("area",))
    assert not is_large("not measured", ("area",))


USUAL = ContactSituation((), (2.0,), 0.45)


def stated(contact):
    return stated_error("lattice", 1.0, "polyethylene", None, contact)


def test_an_error_is_stated_within_the_range_of_its_pairs():
    error = stated(USUAL)
    assert error.pairs >= LEAST_PAIRS
    # The facets' sag is added to the error of the approach only.
    coarse = stated(replace(USUAL, sag=0.1))
    assert coarse.approach == pytest.approx(error.approach + 0.1)
    assert coarse.peak_pressure == error.peak_pressure
    # A wrong compliance changes the split of the force under a tilt.
    foundation = known_error("foundation", 1.0, "polyethylene")
    assert 0.036 < foundation.force < foundation.approach


@pytest.mark.parametrize(
    ("contact", "words"),
    [
        (replace(USUAL, flags=(f"{MESH_DEFECT} insert mesh, a spike of 1 mm",)), MESH_DEFECT),
        (replace(USUAL, flags=(f"too narrow; the medial {UNSUPPORTED}: ...",)), UNSUPPORTED),
        (replace(USUAL, poisson_ratio=0.495), "Poisson's ratio is 0.495, measured were 0.45"),
        (replace(USUAL, thickness_over_radius=(2.0, 0.5)), "radius of contact is 0.5"),
        (replace(USUAL, thickness_over_radius=(9.0,)), "radius of contact is 9"),
        (replace(USUAL, sag=0.6), "sag of the facets is 0.6"),
    ],
)
def test_an_error_outside_the_range_is_not_measured_and_the_number_is_named(contact, words):
    said = stated(contact)
    assert isinstance(said, str)
    assert said.startswith("not measured: ") and words in said


def test_a_row_of_few_pairs_states_no_error():
    few = stated_error("lattice", 2.0, "polyethylene", {"tolerance": 0.01}, USUAL)
    assert few == "not measured: only 3 pairs of bodies were measured"


@pytest.mark.parametrize("model", ["foundation", "lattice-linear"])
def test_contact_is_similar_so_that_pairs_scale_with_the_cells(model):
    """Rows at 2 mm rest on pairs that were measured at 1 mm, at twice the size."""
    results = []
    for scale in (1.0, 2.0):
        femoral = Surface(scale * BALL.vertices, BALL.faces)
        box = box_insert(8e-3, 4e-3, 8e-3)
        insert = Surface(scale * box.vertices, box.faces)
        pair = ContactPair(femoral, insert, material("polyethylene"))
        contact = contact_model(model, resolution=scale * 1e-3)
        pose = above()
        pose[:3, 3] *= scale
        results.append(contact.press(contact.prepare(pair), 300.0 * scale**2, pose))
    small, large = results
    assert large.approach == pytest.approx(2.0 * small.approach, rel=1e-4)
    assert large.medial.peak_pressure == pytest.approx(small.medial.peak_pressure, rel=1e-4)
    assert large.medial.area == pytest.approx(4.0 * small.medial.area, rel=1e-3)


@pytest.mark.parametrize("degrees", [3.0, 10.0])
def test_the_sag_of_facets_is_that_of_chords_in_two_directions(degrees):
    """Facets of t by t/2 on a ball; their sags add up at the middle of a facet."""
    count = round(360.0 / degrees)
    ball = trimesh.creation.uv_sphere(radius=22e-3, count=[count // 2 + 1, count])
    surface = Surface(np.asarray(ball.vertices), np.asarray(ball.faces))
    sag = sum(22e-3 * (1.0 - np.cos(np.radians(turn / 2.0))) for turn in (degrees, degrees / 2.0))
    at_equator = surface.facet_sag(np.array([[0.0, -22e-3, 0.0]]), 6e-3)
    assert at_equator == pytest.approx(sag, rel=0.12)


def test_the_stated_error_covers_the_approach_on_coarse_facets():
    """A ball of 22 mm with facets of 10 by 5 deg, against one of fine facets."""
    results = []
    for count in (18, 90):
        ball = trimesh.creation.uv_sphere(radius=22e-3, count=[count, 2 * count])
        surface = Surface(np.asarray(ball.vertices), np.asarray(ball.faces), "ball")
        pair = ContactPair(surface, box_insert(14e-3, 8e-3, 14e-3), material("polyethylene"))
        model = contact_model("lattice", resolution=1e-3, cache=False)
        results.append(model.press(model.prepare(pair), 1000.0, above()))
    coarse, fine = results
    error = stated(ContactSituation.of(coarse))
    assert 0.15 < 1.0 - coarse.approach / fine.approach < error.approach < 0.6
    assert coarse.medial.peak_pressure == pytest.approx(fine.medial.peak_pressure, rel=0.01)
