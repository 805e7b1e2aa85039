"""The documentation site: no warning in its build, and no content from other sites."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_is_self_contained(tmp_path):
    pytest.importorskip("material", reason="mkdocs-material is not installed")
    pytest.importorskip("mkdocstrings", reason="mkdocstrings is not installed")
    build = ["mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    config = ["--config-file", str(ROOT / "scripts" / "mkdocs.yml")]
    done = subprocess.run(
        [sys.executable, "-m", *build, *config], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    pages = list((tmp_path / "site").glob("**/*.html"))
    assert len(pages) > 25
    loads = re.compile(
        r'<(?:script|img)[^>]* src="(http[^"]*)"|<link[^>]*stylesheet[^>]*"(http[^"]*)"'
    )
    for page in pages:
        assert not loads.search(page.read_text(encoding="utf-8")), page
    assert (tmp_path / "site" / "gallery" / "press_two_meshes.png").is_file()
    assert "simulate" in (tmp_path / "site" / "api.html").read_text(encoding="utf-8")
