"""Large known errors of a contact model."""

from tkamb.run.known_errors import is_large

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
