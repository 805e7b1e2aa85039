"""Bodies pressed through each other are out of range; too large pressures are flagged."""

import numpy as np
import pytest

from lattice_bodies import above, box_insert, condyles, dished_insert
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.pressing import thickness_near
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.errors import InputError
from tkamb.geometry.surface import Surface
from tkamb.run.press import PressReport

MODELS = ["foundation", "foundation-linear", "hertz", "lattice", "lattice-linear", "fe"]
FEW = ["foundation-linear", "hertz", "lattice", "lattice-linear"]
FEMORAL = condyles(subdivisions=4)
POLYETHYLENE = material("polyethylene")


def pressed(name, femoral, insert, load, pose=None, size=2.0):
    """Return the result of a press, and the prepared state."""
    model = contact_model(name, resolution=size * 1e-3)
    state = model.prepare(ContactPair(femoral, insert, POLYETHYLENE))
    return model.press(state, load, above() if pose is None else pose), state


def spiked(surface, height, where):
    """Return the surface with the vertex nearest to a place moved by `height` (m) along y."""
    vertices = surface.vertices.copy()
    vertices[np.linalg.norm(vertices - where, axis=1).argmin(), 1] += height
    return Surface(vertices, surface.faces, surface.name)


def is_out_of_range(result):
    """Return whether a result is OUT_OF_RANGE, without numbers and with a reason."""
    numbers = [result.approach, *result.pressure, *result.wrench_on_insert]
    return (
        result.status is ContactStatus.OUT_OF_RANGE
        and np.isnan(numbers).all()
        and result.medial is None
        and bool(result.flags)
    )


@pytest.mark.parametrize("name", MODELS)
def test_a_dish_without_a_bottom_is_out_of_range(name):
    """The insert is 10 µm thick under each condyle. A lattice of such cells lacks this part and is
    refused. Columns of 0.5 mm see a thickness of 18 µm.
    """
    dish = dished_insert(height=2.01e-3, cells=24)
    if name in ("lattice", "lattice-linear", "fe"):
        with pytest.raises(InputError, match="less volume than the mesh"):
            pressed(name, FEMORAL, dish, 1000.0, size=1.5)
        return
    result, _ = pressed(name, FEMORAL, dish, 6000.0, size=0.5)
    assert is_out_of_range(result)
    assert "thick" in " ".join(result.flags)


@pytest.mark.parametrize("name", FEW)
@pytest.mark.parametrize("body", ["femoral", "insert"])
def test_a_spike_longer_than_the_insert_is_thick_is_out_of_range(name, body):
    """The spike is 28 mm long, on either mesh."""
    femoral, insert = FEMORAL, dished_insert(cells=24)
    if body == "femoral":
        femoral = spiked(femoral, -28e-3, [0, -20e-3, 10e-3])
    else:
        insert = spiked(insert, 28e-3, [3e-3, 7e-3, 10e-3])
    assert is_out_of_range(pressed(name, femoral, insert, 1500.0, size=3.0)[0])


@pytest.mark.parametrize(
    ("length", "pose", "words"),
    [
        (5e-3, above(), "mm thick: check the meshes for a spike"),
        (1e-3, above(0.7e-3, 0.9e-3), "meshes first touch 0.8"),
    ],
)
def test_a_shorter_spike_is_flagged(length, pose, words):
    """The spike is on a node or between nodes; the approach counts from its tip."""
    femoral = spiked(FEMORAL, -length, [0, -20e-3, 10e-3])
    result, _ = pressed("lattice-linear", femoral, dished_insert(cells=24), 1500.0, pose)
    assert result.status is ContactStatus.OK
    assert result.approach > length
    assert words in " ".join(result.flags)


@pytest.mark.parametrize("name", MODELS)
def test_a_valid_press_has_no_flag_of_a_spike_or_a_high_peak(name):
    result, _ = pressed(name, FEMORAL, dished_insert(cells=24), 1000.0, size=3.0)
    assert result.status is ContactStatus.OK
    assert not any(word in " ".join(result.flags) for word in ("spike", "thick:", "100 MPa"))


LIP, SHEET = box_insert(4e-3, 5e-3, 12e-3), box_insert(14e-3, 1e-3, 14e-3)


@pytest.mark.parametrize(("name", "insert"), [("lattice-linear", LIP), ("lattice", SHEET)])
def test_a_peak_above_100_megapascal_is_flagged(name, insert):
    """A sphere on a lip 4 mm wide and on a sheet of 1 mm."""
    sphere = condyles(offset=0.0, subdivisions=4)
    result, state = pressed(name, sphere, insert, 2500.0, size=1.0)
    assert result.status is ContactStatus.OK
    assert result.medial.peak_pressure > 100e6
    words = "peak above 100 MPa: polyethylene's law is not known there; check whether"
    assert any(words in flag for flag in result.flags)
    report = PressReport(
        name, 1.0, state.node_count, 2500.0, result, None, state.triangles, state.pair, "right",
        0.0, 0.0, 0.0,
    )  # fmt: skip
    assert any(words in line for line in report.lines() if line.startswith("note: "))
    assert any(words in flag for flag in report.as_dict()["flags"])


def test_thickness_near_a_rim_is_the_largest_one_nearby():
    dish = dished_insert(height=4e-3, cells=24)
    bodies = ContactPair(FEMORAL, dish, POLYETHYLENE)
    places = np.array([[0, 2e-3, 10e-3], [12e-3, 4e-3, 20e-3]])
    assert thickness_near(bodies, places) == pytest.approx([2e-3, 4e-3], rel=0.05)
