"""Large known errors of a contact model."""

from tkamb.contact.flags import MESH_DEFECT, UNSUPPORTED
from tkamb.run.known_errors import is_large, outside_measured

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


def test_no_error_is_stated_for_defects_and_supports_that_were_not_measured():
    assert outside_measured([f"{MESH_DEFECT} insert mesh, a spike of 1 mm"])
    assert outside_measured(["too narrow", f"the medial {UNSUPPORTED}: ..."])
    assert not outside_measured(["the medial contact is too narrow for the cells"])
