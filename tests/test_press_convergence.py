"""`tkamb press --contact lattice --json` on real implants converges with the cell size."""

import json

import pytest

from inserts import DATA
from tkamb.cli import main

JW_ALIGNED = ("jw", "0.00192979 0 0 0 0 0")
"""Subject and pose: aligned components at 0 deg of flexion, centred on the insert's dishes."""
DM_STANCE = ("dm", "-0.0065 0.041674 0.00014 -0.2406 2.9164 -9.9867")
"""Subject and recorded pose at 30 % of the gait cycle."""
DM_PRESSED_WIDE = ("dm", "-0.00616 0.041501 -0.000712 -1.1287 2.67 -9.8262")
"""Subject and recorded pose at 24 %: the lateral contact at an edge is several cells wide."""


def pressed(capsys, subject, pose, size, *flags):
    """Return the result of the command for 2500 N and cells of `size` mm."""
    folder = DATA / subject / "geometry"
    if not folder.is_dir():
        pytest.skip("subject data absent (shared/data): meshes of DM and JW are not shipped")
    meshes = [str(folder / f"{part}.stl") for part in ("femoral_component", "tibial_insert")]
    arguments = ["press", *meshes, "--units", "m", "--axes=-x,+y,-z", "--load", "2500"]
    arguments += ["--contact", "lattice", "--resolution", str(size), "--pose", *pose.split()]
    assert main([*arguments, "--json", *flags]) == 0
    return json.loads(capsys.readouterr().out)


def peak(result):
    return max(result[s]["peak_pressure_MPa"] for s in ("medial", "lateral") if result[s])


def check_converged(coarse, fine):
    """Check that approaches agree within 1 %, and condyle forces within 1 % of the load."""
    assert fine["status"] == coarse["status"] == "ok"
    assert fine["approach_mm"] == pytest.approx(coarse["approach_mm"], rel=0.01)
    for side in ("medial", "lateral"):
        forces = [0.0 if f[side] is None else f[side]["force_N"] for f in (coarse, fine)]
        assert forces[1] == pytest.approx(forces[0], abs=25.0)


@pytest.mark.slow
def test_jw_converges_with_its_peak_pressure(capsys):
    coarse, fine = (pressed(capsys, *JW_ALIGNED, size) for size in (1.0, 0.75))
    check_converged(coarse, fine)
    assert peak(fine) == pytest.approx(peak(coarse), rel=0.03)


def test_facets_leave_no_pattern_in_the_pressure_and_no_flag(capsys):
    """The surface is smoothed over JW's facets, which are 2.7 mm long.

    Without smoothing, the peaks are 24.4 and 25.3 MPa, and 31 MPa with cells of 0.75 mm.
    """
    coarse, fine = (pressed(capsys, *JW_ALIGNED, size) for size in (2.0, 1.5))
    assert coarse["flags"] == []
    assert peak(fine) == pytest.approx(23.6, rel=0.03)
    assert peak(coarse) == pytest.approx(23.6, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("flags", [(), ("--adjust",)])
def test_dm_converges_except_for_its_peak_pressure(capsys, flags):
    coarse, fine = (pressed(capsys, *DM_STANCE, size, *flags) for size in (1.0, 0.75))
    check_converged(coarse, fine)
    for result in (coarse, fine):
        assert [flag for flag in result["flags"] if "peak pressure lies at an edge" in flag]


@pytest.mark.slow
def test_dm_converges_with_its_peak_pressure_in_a_wide_contact(capsys):
    coarse, fine = (pressed(capsys, *DM_PRESSED_WIDE, size) for size in (1.0, 0.75))
    check_converged(coarse, fine)
    assert peak(fine) == pytest.approx(peak(coarse), rel=0.03)
    assert [flag for flag in fine["flags"] if "peak pressure lies at an edge" in flag]


def test_a_peak_pressure_at_an_edge_is_flagged(capsys):
    """DM's flat condyles press with their edges.

    With cells of 0.75 instead of 1 mm, the peak is 12 % larger.
    """
    assert "lateral peak pressure lies at an edge" in pressed(capsys, *DM_STANCE, 2.0)["flags"][0]
