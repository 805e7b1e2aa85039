"""The gallery's examples: each runs, leaves its picture and holds the number that it asserts."""

import runpy
from pathlib import Path

import pytest

GALLERY = Path(__file__).parents[1] / "docs" / "gallery"
EXAMPLES = sorted(GALLERY.glob("*.py"))


RECORDED = {"dm_gait": "dm", "jw_squat": "jw"}
"""Example -> the subject whose recordings it needs."""
SLOW = {"cohort", "insert_shapes", "knee_drop", *RECORDED}


def marked(example):
    """The example as a parameter: slow and skipped without data where it is on recordings."""
    marks = [pytest.mark.slow] if example.stem in SLOW else []
    if example.stem in RECORDED:
        folder = Path(__file__).parents[2] / "shared" / "data" / RECORDED[example.stem]
        reason = "the subject's recordings are not here"
        marks.append(pytest.mark.skipif(not folder.is_dir(), reason=reason))
    return pytest.param(example, id=example.stem, marks=marks)


@pytest.mark.parametrize("example", [marked(example) for example in EXAMPLES])
def test_the_example_holds_its_number(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    runpy.run_path(str(example))
    assert (tmp_path / f"{example.stem}.png").stat().st_size > 4000
    assert (GALLERY / f"{example.stem}.png").is_file(), "run scripts/make_gallery"


def test_there_are_examples_that_assert_something():
    assert len(EXAMPLES) >= 12
    assert all("\nassert " in path.read_text(encoding="utf-8") for path in EXAMPLES)
