"""The pages for newcomers: messages exist in the source, command lines are understood."""

import re
import shlex
from pathlib import Path

import pytest

from tkamb.cli import _parser

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
MESSAGE = re.compile(r'^\| "([^"]+)" \|', re.MULTILINE)
COMMAND = re.compile(r"^    tkamb (.+?)(?: {2,}#.*)?$", re.MULTILINE)


def source_text():
    """Return all of the source with the seams of strings that go on in the next line removed."""
    text = "\n".join(p.read_text(encoding="utf-8") for p in sorted((ROOT / "tkamb").rglob("*.py")))
    return re.sub(r'"\s*\n\s*f?"', "", text)


def test_every_message_of_the_page_is_one_of_the_program_s():
    text = source_text()
    found = MESSAGE.findall((DOCS / "faq.md").read_text(encoding="utf-8"))
    assert len(found) >= 15
    missing = [words for words in found if words not in text]
    assert not missing


@pytest.mark.parametrize("page", ["your_own_patient.md", "commands.md", "../README.md"])
def test_every_command_line_of_the_page_is_understood(page):
    lines = COMMAND.findall((DOCS / page).read_text(encoding="utf-8"))
    assert len(lines) > 5
    for line in lines:
        if "…" not in line and not line.endswith("\\"):
            _parser().parse_args(shlex.split(line))


def test_every_link_between_the_pages_leads_somewhere():
    pages = [*DOCS.rglob("*.md"), *ROOT.glob("*.md"), *(ROOT / "models").glob("*/README.md")]
    for page in pages:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_paper_s_numbers_stand_in_the_pages_that_they_link():
    text = (DOCS / "paper.md").read_text(encoding="utf-8")
    quoted = re.findall(r"\[([\d.]+(?: of \d+)?)\]\(([a-z_]+\.md)\)", text)
    assert len(quoted) >= 5
    for number, page in quoted:
        there = (DOCS / page).read_text(encoding="utf-8")
        assert re.search(rf"(?<![\d.]){re.escape(number)}(?![\d.]*\d)", there), (number, page)


def test_every_page_is_on_the_site_and_in_the_list():
    site = (ROOT / "scripts" / "mkdocs.yml").read_text(encoding="utf-8")
    listed = (DOCS / "pages.md").read_text(encoding="utf-8")
    for page in DOCS.rglob("*.md"):
        name = page.relative_to(DOCS).as_posix()
        assert f"- {name}\n" in site, f"add {name} to nav of scripts/mkdocs.yml"
        assert name == "pages.md" or f"({name})" in listed, f"add {name} to pages.md"
