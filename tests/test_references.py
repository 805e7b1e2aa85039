"""The bibliography has exactly the DOIs that the code cites."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
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
