"""Documentation: messages, commands, links, lists and DOIs are valid; the site stands alone."""

import re
import shlex
import subprocess
import sys
import tomllib
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import pytest

import tkamb
from tkamb.cli import _parser

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
MESSAGE = re.compile(r'^\| "([^"]+)" \|', re.MULTILINE)
COMMAND = re.compile(r"^    tkamb (.+?)(?: {2,}#.*)?$", re.MULTILINE)


def source_text():
    """Return the source of the package, with strings of several lines joined."""
    text = "\n".join(p.read_text(encoding="utf-8") for p in sorted((ROOT / "tkamb").rglob("*.py")))
    return re.sub(r'"\s*\n\s*f?"', "", text)


def test_every_message_of_the_faq_is_in_the_source():
    text = source_text()
    messages = MESSAGE.findall((DOCS / "faq.md").read_text(encoding="utf-8"))
    assert len(messages) >= 15
    missing = [words for words in messages if words not in text]
    assert not missing


@pytest.mark.parametrize("page", ["your_own_patient.md", "commands.md", "../README.md"])
def test_every_command_line_of_the_page_is_parsed(page):
    lines = COMMAND.findall((DOCS / page).read_text(encoding="utf-8"))
    assert len(lines) > 5
    for line in lines:
        if "…" not in line and not line.endswith("\\"):
            _parser().parse_args(shlex.split(line))


def test_every_link_between_pages_leads_to_a_file():
    pages = [*DOCS.rglob("*.md"), *ROOT.glob("*.md"), *(ROOT / "models").glob("*/README.md")]
    for page in pages:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_numbers_of_the_paper_are_on_the_linked_pages():
    text = (DOCS / "paper.md").read_text(encoding="utf-8")
    quoted = re.findall(r"\[([\d.]+(?: of \d+)?)\]\(([a-z_]+\.md)\)", text)
    assert len(quoted) >= 5
    for number, page in quoted:
        linked = (DOCS / page).read_text(encoding="utf-8")
        assert re.search(rf"(?<![\d.]){re.escape(number)}(?![\d.]*\d)", linked), (number, page)


def test_every_page_is_on_the_site_and_in_the_list():
    site = (ROOT / "scripts" / "mkdocs.yml").read_text(encoding="utf-8")
    listed = (DOCS / "pages.md").read_text(encoding="utf-8")
    for page in DOCS.rglob("*.md"):
        name = page.relative_to(DOCS).as_posix()
        assert f"- {name}\n" in site, f"add {name} to nav of scripts/mkdocs.yml"
        assert name == "pages.md" or f"({name})" in listed, f"add {name} to pages.md"


def test_the_python_example_of_the_readme_runs():
    """The example needs no optional package, because the demo installs none."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    example = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]
    extras = ("pandas", "pyvista", "daqp", "pooch", "pyarrow", "distributed", "playwright")
    code = f"import sys\nsys.modules.update(dict.fromkeys({extras}))\n{example}"
    process = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    assert process.stdout.strip().endswith(")")


def test_the_readme_is_two_screens_and_each_release_of_the_changelog_one():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 130
    releases = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("\n## ")
    assert max(len(release.splitlines()) for release in releases) <= 80


def test_citation_changelog_and_package_have_one_version():
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"version: {tkamb.__version__}\n" in cited
    released = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+) - \d{4}-\d\d-\d\d$", released, re.M).group(1) == tkamb.__version__


def test_the_extra_all_installs_every_extra_for_users():
    with (ROOT / "pyproject.toml").open("rb") as file:
        extras = tomllib.load(file)["project"]["optional-dependencies"]
    (everything,) = extras["all"]
    named = set(re.search(r"\[(.+)\]", everything).group(1).split(","))
    assert named == set(extras) - {"all", "docs", "test"}


def test_every_module_that_the_architecture_names_exists():
    for page in (DOCS / "architecture.md", ROOT / "CONTRIBUTING.md"):
        text = page.read_text(encoding="utf-8")
        named = set(re.findall(r"`([a-z_]+(?:/[a-z_0-9]+)*(?:\.py|/))`", text))
        places = (ROOT / "tkamb", ROOT, ROOT / "tkamb" / "run" / "muscles")
        missing = [n for n in named if not any((place / n).exists() for place in places)]
        assert not missing, f"{page.name}: {missing}"


def test_the_architecture_shows_the_way_of_a_frame():
    """The list names the files that a frame enters, in order; none of them is in io/."""
    loader = SourceFileLoader("trace_frame", str(ROOT / "scripts" / "make" / "frame_trace"))
    trace = module_from_spec(spec_from_loader("trace_frame", loader))
    loader.exec_module(trace)
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    shown = page.split(trace.BEGIN)[1].split(trace.END)[0]
    files, traced = (
        re.findall(r"^ +\S+\.py", t, re.M) for t in (shown, trace.table(trace.traced()))
    )
    assert files == traced, "run scripts/make/frame_trace"
    assert f"It enters {len(files)} files" in shown
    assert not any(name.strip().startswith("io/") for name in files)


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


PAGE = ROOT / "docs" / "references.md"
DOI = re.compile(r"10\.\d{4,}/(?:\([^\s()]*\)|[^\s\"'`;,()])+")


def dois(text):
    """Return the DOIs of a text, with inner parentheses but without punctuation after them."""
    return {match.rstrip(".") for match in DOI.findall(text)}


def test_a_doi_may_contain_parentheses():
    text = "(Lu, doi:10.1016/S0021-9290(98)00158-4; Johnson, doi:10.1017/CBO9781139171731)."
    assert dois(text) == {"10.1016/S0021-9290(98)00158-4", "10.1017/CBO9781139171731"}


def test_the_bibliography_has_the_dois_of_the_code():
    code = [path.read_text(encoding="utf-8") for path in (ROOT / "tkamb").rglob("*.py")]
    cited = dois("\n".join(code))
    assert len(cited) > 20
    assert dois(PAGE.read_text(encoding="utf-8")) == cited


def test_entries_are_sorted_by_author_and_year():
    entries = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line[:2] == "- "]
    authors = [entry[2:].split(" (")[0].lower() for entry in entries]
    assert authors == sorted(authors)
    assert all(re.match(r"- .+ \(\d{4}\)\. .+\.", entry) for entry in entries)
