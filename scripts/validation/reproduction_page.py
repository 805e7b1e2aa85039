"""docs/dissertation.md: chapters 4 and 5 and appendix D of Sharma (2008), and tkamb's numbers."""

import string
import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from validation import dissertation

HEAD = """\
# The dissertation, reproduced

tkamb began as the knee model of A. Sharma, *Development of a computational model to predict the
in vivo contact mechanics of modern total knee arthroplasty*, dissertation, University of
Tennessee, Knoxville, 2008. One option runs any scene as that study did:

    tkamb run models/deep_knee_bend/scene.toml --as sharma-2008
    tkamb run my_knee.toml --as sharma-2008 --set contact.adjust=false

In Python `tkamb.simulate(scene, preset="sharma-2008")`. What the preset changed in the scene
stands in `summary.json` (`preset`) and in the report; `--set`, `--contact` and `--resolution`
still override it. A scene that lacks what the study needs is refused in one line. The default
of tkamb is *not* this system: the calibrated lattice is closer to finite elements (chapter 5
below), and the coupling of body and contact differs.
"""
MADE = """\
Made by `{command}` on {date}, tkamb {version}. Nothing in the tables is typed: the source's
numbers stand in `scripts/validation/reproduction.toml` and `dissertation_tables.toml`, ours
in `scripts/data/dissertation.json` and `scripts/data/validation.json`."""
SET = """\
Why each of them: `tkamb/io/presets.py`. Another study adds its own by a class and a
row in `tkamb/io/presets.py`, or from another package through the entry-point group
`tkamb.io.presets`."""
ELEMENTS = """\
Code and tests are paths in the repository. Where no number stands, the test is the evidence."""
OPEN = """\
The text leaves three things open:

- The point about which the femur is turned. Here it is the component's own centre.
- What the 0.5 mm of section 4.3 limit. Here the adjustment moves the femur by 0.5 mm at most and a
  larger distance from touch is flagged. The press moves the femur on to contact in any case.
- What becomes of nodes in contact that would be pulled. Here they are let go.

The rule that undoes the adjustment has two readings. "both" is the default, and
`[contact] adjust_restore_when = "either"` is the other."""
COMPARED = """\
Every number of chapter 5, in its order. "Cannot be compared" means what it says: no value of
ours beside such a number confirms or contradicts it."""
APPENDIX = """\
The tables hold means over 4 or 5 subjects of each of six designs, whose motions, geometries and
ground reactions are not published. They **cannot be reproduced**. Below stand the least and
largest of the six means, and the shipped synthetic knee run as sharma-2008: one knee that
nobody has. Agreement or disagreement says how far the shipped knee is like those, not how good
the model is. Contact areas and pressures of six parametric designs under the tables' own forces
are in [validation.md](validation.md), with what is wrong in the tables as printed (D-12 is
taken with its NKII columns exchanged)."""


@cache
def facts() -> dict[str, Any]:
    """Return elements of chapter 4 and comparisons of chapter 5."""
    text = (Path(__file__).parent / "reproduction.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def names_in(text: str) -> list[str]:
    """Return the names of the values that a text has in braces."""
    return [name for _, name, _, _ in string.Formatter().parse(text) if name]


def page(
    stored: Mapping[str, Any], validated: Mapping[str, float], preset: Mapping[str, Any]
) -> str:
    """Return the page's text.

    Args:
        stored: scripts/data/dissertation.json.
        validated: values of scripts/data/validation.json.
        preset: dotted key -> value of sharma-2008.
    """
    values = {**validated, **stored["values"]}
    parts = [
        [HEAD],
        [MADE.format(**stored), ""],
        _settings(preset),
        _elements(values),
        _comparisons(values),
        _appendix(stored["bend"]),
    ]
    return "\n".join("\n".join(part) for part in parts).rstrip() + "\n"


def _settings(preset: Mapping[str, Any]) -> list[str]:
    lines = ["## What the preset sets", "", "| key | value |", "| --- | --- |"]
    for key, value in preset.items():
        if isinstance(value, Mapping):
            text = ", ".join(f"{name} = {item}" for name, item in value.items())
        else:
            text = "left out" if value is None else (str(value).lower() if value != [] else "none")
        lines.append(f"| `{key}` | {text} |")
    return [*lines, "", SET, ""]


def _elements(values: Mapping[str, float]) -> list[str]:
    lines = [
        "## Chapter 4, element by element",
        "",
        ELEMENTS,
        "",
        "| section | element | equation | code, test | number |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in facts()["element"]:
        number = row["number"].format(**values)
        lines.append(
            f"| {row['section']} | {row['name']} | {row['equation']} | `{row['code']}`<br>"
            f"`{row['test'].removeprefix('tests/')}` | {number} |"
        )
    return [*lines, "", OPEN, ""]


def _comparisons(values: Mapping[str, float]) -> list[str]:
    lines = [
        "## Chapter 5, number by number",
        "",
        COMPARED,
        "",
        "| section | what | source | ours | |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in facts()["comparison"]:
        number = row["number"].format(**values)
        lines.append(
            f"| {row['section']} | {row['what']} | {row['source']} | {number} | {row['kind']} |"
        )
    return [*lines, ""]


def _appendix(bend: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = ["## Appendix D", "", APPENDIX, ""]
    percent = "".join(f" | {row['percent']:.0f} %" for row in bend)
    lines += [f"| table | of{percent} |", "| --- | --- |" + " ---: |" * len(bend)]
    for number in range(1, 13):
        table = dissertation.corrected(number)
        spread = [f"{low:g} to {high:g}" for low, high in
                  zip(table.mean.min(axis=1), table.mean.max(axis=1), strict=True)]  # fmt: skip
        ours = [f"{row[f'D-{number}']:.3g}" for row in bend]
        lines.append(f"| D-{number} {table.heading} | six designs | " + " | ".join(spread) + " |")
        lines.append("| | ours | " + " | ".join(ours) + " |")
    failed = [row for row in bend if row["status"] != "ok"]
    if failed:
        lines += ["", "Of our frames, flagged: "]
        lines += [f"- {row['percent']:.0f} %: {row['status']}" for row in failed]
    return [*lines, ""]
