"""The gallery's examples: each runs, leaves its picture and holds the number that it asserts."""

import runpy
from pathlib import Path

import pytest

GALLERY = Path(__file__).parents[1] / "docs" / "gallery"
EXAMPLES = sorted(GALLERY.glob("*.py"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_the_example_holds_its_number(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    runpy.run_path(str(example))
    assert (tmp_path / f"{example.stem}.png").stat().st_size > 4000
    assert (GALLERY / f"{example.stem}.png").is_file(), "run scripts/make_gallery"


def test_there_are_examples_that_assert_something():
    assert len(EXAMPLES) >= 6
    assert all("\nassert " in path.read_text(encoding="utf-8") for path in EXAMPLES)
