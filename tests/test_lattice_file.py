"""`tkamb mesh lattice`: report, file, and refusals in one line."""

import json
from pathlib import Path

import pytest

from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.mesh_files import lattice_of_file

INSERT = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "insert.stl"


def test_the_lattice_is_reported_and_written(tmp_path, capsys):
    out = tmp_path / "lattice.vtu"
    assert main(["mesh", "lattice", str(INSERT), "--resolution", "3", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "nodes" in text
    assert str(out) in text
    assert out.stat().st_size > 10_000


def test_json_holds_the_measures(capsys):
    assert main(["mesh", "lattice", str(INSERT), "--resolution", "3", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert abs(report["volume_error"]) < 0.05
    assert report["volume"] == pytest.approx(report["mesh_volume"], rel=0.05)
    assert report["out"] is None


def test_a_left_insert_gives_a_mirrored_lattice(tmp_path):
    right = lattice_of_file(INSERT, 3.0)
    left = lattice_of_file(INSERT, 3.0, side="left", out=tmp_path / "left.vtu")
    assert left.lines()[-1].endswith("the left insert's mirror image")
    assert left.as_dict()["mirrored"]
    assert left.quality.volume == pytest.approx(right.quality.volume, rel=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution_mm": 0.0}, "resolution"),
        ({"resolution_mm": 2.0, "side": "middle"}, "not a side"),
        ({"resolution_mm": 2.0, "out": "lattice.stl"}, "not a .vtu file"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        lattice_of_file(INSERT, **options)
