"""When the known error of a contact model is called large."""

from tkamb.run.known_errors import is_large

EDGE = {"edge": {"peak_pressure": 0.3, "area": 0.2}}


def test_the_edge_does_not_decide_whether_an_error_is_large():
    """Contact at an edge carries a flag of its own."""
    whole = {"peak_pressure": 0.3, "area": 0.2, "cases": 20}
    smooth = {"interior": {"peak_pressure": 0.02, "area": 0.05}} | EDGE
    assert is_large(whole, ("area",))
    assert not is_large(whole | {"situations": smooth}, ("area", "peak_pressure"))
    steep = smooth | {"flank": {"peak_pressure": 0.02, "area": 0.12}}
    assert is_large(whole | {"situations": steep}, ("area",))
    assert not is_large("not measured", ("area",))
