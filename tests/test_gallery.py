"""Each example of the gallery runs, writes its picture and passes its assertions."""

import runpy
from pathlib import Path

import pytest

from tkamb.errors import InputError

GALLERY = Path(__file__).parents[1] / "docs" / "gallery"
EXAMPLES = sorted(GALLERY.glob("*.py"))


RECORDED = {"dm_gait": "dm", "jw_squat": "jw"}
"""Example -> subject of the recordings that it needs."""
SLOW = {"cohort", "insert_shapes", "knee_drop", "ligament_fit", "optimal_squat", *RECORDED}


def marked(example):
    """Return an example as a parameter. Examples with recordings are slow and need their data."""
    marks = [pytest.mark.slow] if example.stem in SLOW else []
    if example.stem in RECORDED:
        folder = Path(__file__).parents[2] / "shared" / "data" / RECORDED[example.stem]
        reason = "the subject's recordings are not here"
        marks.append(pytest.mark.skipif(not folder.is_dir(), reason=reason))
    return pytest.param(example, id=example.stem, marks=marks)


@pytest.mark.parametrize("example", [marked(example) for example in EXAMPLES])
def test_the_example_passes_its_assertions(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    if "tkamb.crocoddyl" in example.read_text(encoding="utf-8"):
        pytest.importorskip("crocoddyl")
        try:
            import tkamb.crocoddyl  # noqa: F401
        except InputError as error:
            pytest.skip(f"{error}: scripts/check_control runs this example")
    runpy.run_path(str(example))
    assert (tmp_path / f"{example.stem}.png").stat().st_size > 4000
    assert (GALLERY / f"{example.stem}.png").is_file(), "run scripts/make/gallery"


def test_every_example_has_an_assertion():
    assert len(EXAMPLES) >= 12
    assert all("\nassert " in path.read_text(encoding="utf-8") for path in EXAMPLES)
