"""Blocks of Markdown on the trade-off, from the study's JSON."""

import json
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from error_cases import SITUATIONS
from error_rows import RATIOS, ErrorRow
from tkamb.contact.materials import material as named
from tkamb.errors import InputError
from tkamb.run.known_errors import KnownError
from tkamb.show.tradeoff_report import (
    Setting,
    bodies_of,
    comparison,
    milliseconds,
    recommendations,
    setting_of,
    warm_by_bodies,
)
from tkamb.studies.tradeoff import EQUAL_RATIO, KEYS, BodyRow, Row, beats, on_front
from tkamb.studies.tradeoff import HEADS as BODY_HEADS

MARKERS = "<!-- {}:begin -->", "<!-- {}:end -->"
HEADS = ("approach", "condyle force", "mean p", "peak p", "area", "map L2")


def block(rows: Sequence[Row]) -> list[str]:
    """Return the lines between the markers: table, comparison with finite elements, advice.

    The table has a line per setting, with the median time over the pairs of bodies and the largest
    errors over all measured cases.
    """
    bodies = len({bodies_of(row.job.case) for row in rows})
    cases = len({row.job.case for row in rows})
    settings = _settings(rows)
    errors = " | ".join(f"{head} %" for head in HEADS)
    lines = [
        f"| contact | mm | prepare s | cold ms | warm ms | MB | {errors} | cases | on the front |",
        "| --- |" + " ---: |" * (7 + len(HEADS)),
    ]
    lines += [_line(setting, some) for setting, some in settings.items()]
    lines += [
        "",
        f"{cases} cases, {bodies} pairs of bodies, one thread. Times are medians, errors the "
        "largest over the cases on which a setting was measured, against converged references.",
        "",
        *(f"- {line}" for line in comparison(rows)),
        "",
        *(f"- {line[0].upper()}{line[1:]}" for line in recommendations(rows)),
    ]
    return lines


SHORT = (
    ("hertz", 1.0),
    ("foundation", 1.0),
    ("lattice-linear", 1.0),
    ("lattice", 1.0),
    ("calculix C3D8I", 1.0),
)
"""Settings of the README's five rows."""


def short_block(rows: Sequence[Row]) -> list[str]:
    """Return the README's table of time per position and largest errors, for `SHORT`."""
    settings = _settings(rows)
    lines = [
        "| contact, 1 mm | ms a position | condyle force % | peak pressure % | area % |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for setting in SHORT:
        some = settings[setting]
        warm = milliseconds(median(warm_by_bodies(some)))
        keys = ("force", "peak_pressure", "area")
        cells = " | ".join(_percent([row.errors[key] for row in some]) for key in keys)
        lines.append(f"| {setting[0]} | {warm} | {cells} |")
    return lines


def known_errors_json(rows: Sequence[Row], cases: Sequence[ErrorRow] = ()) -> str:
    """Return the text of `tkamb/run/known_errors.json`, setting by setting.

    Settings of another program, and settings that failed on a case of the study, are left out.

    Args:
        rows: rows of the trade-off study, whose material is polyethylene.
        cases: errors on the pairs of bodies of `error_cases`.
    """
    found: dict[Key, dict[str, list[Mapping[str, float]]]] = {}
    for (label, resolution), some in _settings(rows).items():
        if not label.startswith("calculix") and all(row.errors for row in some):
            bodies = found.setdefault((label, resolution, "polyethylene"), {})
            for row in some:
                bodies.setdefault(bodies_of(row.job.case), []).append(row.errors)
    for row in cases:
        if not row.held_out and row.errors:
            key = row.contact, row.resolution_mm, row.material
            found.setdefault(key, {}).setdefault(row.case, []).append(row.errors)
    return (
        json.dumps([_known_error(key, some, cases) for key, some in found.items()], indent=1) + "\n"
    )


Key = tuple[str, float, str]
"""Contact model with options, mm, material."""
FINEST = 1.0
"""mm: spacing of the pairs that are scaled up to a coarser spacing."""
WIDENING = 3.0
"""Number of pairs n at which a largest error is doubled: it is widened by the factor 1 + 3/n.
Measured on the pairs at 1 mm that are not held out: the widened largest error of n of them, 4 to
14, covers 95 % of the errors on the others."""
SPLIT = 0.3
"""1: error of a condyle's force over the error of the approach. For a condyle that carries F = c d²
at the approach d, an error e of the compliance changes its share under a tilt by at most 0.3 e: the
largest 2 x (1 - x)/((1 + x²)(1 + x)) over the ratio x of the two approaches."""


def scaled_rows(key: Key, cases: Sequence[ErrorRow]) -> list[ErrorRow]:
    """Return the rows of a setting, with the rows at 1 mm of pairs scaled up to its spacing.

    Contact is similar: a body of n times the size, under n² times the load, has the same pressure
    on cells of n times the size, and the same relative errors.
    """
    contact, resolution, material = key
    return [
        row
        for row in cases
        if (row.contact, row.material) == (contact, material)
        and row.resolution_mm in (resolution, min(FINEST, resolution))
    ]


def _known_error(
    key: Key, bodies: Mapping[str, Sequence[Mapping[str, float]]], cases: Sequence[ErrorRow]
) -> dict[str, Any]:
    """Return the stated errors of one setting as JSON, from its errors on each pair of bodies."""
    names = [name for name in KnownError.__dataclass_fields__ if name in KEYS]
    own = [row for row in scaled_rows(key, cases) if row.errors]
    stated = [row for row in own if not row.held_out]
    study = [errors for some in bodies.values() for errors in some]
    errors = [*study, *(row.errors for row in stated if row.resolution_mm != key[1])]
    pairs = len(
        {*bodies, *((r.case, r.resolution_mm) for r in stated if r.resolution_mm != key[1])}
    )
    widened = 1.0 + WIDENING / pairs
    worst: dict[str, float | None] = {name: _worst(name, errors, widened) for name in names}
    if worst["force"] is not None:
        worst["force"] = max(worst["force"], round(SPLIT * (worst["approach"] or 0.0), 6))
    situations = {
        place: {
            name: min(_worst(name, some, 1.0 + WIDENING / len(some)), limit)
            for name, limit in worst.items()
            if name != "force" and limit is not None
        }
        for place in SITUATIONS
        if (some := [row.errors for row in stated if row.situation == place])
    }
    judged = [
        row.errors[name] <= limit
        for row in own
        if row.held_out
        for name, limit in worst.items()
        if name in row.errors and limit is not None
    ]
    covered = sum(judged) / len(judged) if judged else None
    label, resolution, material = key
    said = {"contact": label, "resolution_mm": resolution, "material": material}
    return said | worst | {
        "cases": len(errors), "situations": situations, "covered": covered,
        "pairs": pairs, "range": _range({*bodies, *(row.case for row in own)}, material),
    }  # fmt: skip


def _range(bodies: set[str], material: str) -> dict[str, list[float]]:
    """Return the range of pairs of bodies; see `KnownError`."""
    measured = json.loads(RATIOS.read_text(encoding="utf-8"))
    ratios = [ratio for name in bodies for ratio in measured[name]]
    nu = named(material).poisson_ratio
    return {"thickness_over_radius": [min(ratios), max(ratios)], "poisson_ratio": [nu, nu]}


def _worst(name: str, errors: Sequence[Mapping[str, float]], factor: float) -> Any:
    """Return the largest error of a quantity times a factor; None if no case has it."""
    found = [row[name] for row in errors if name in row]
    return round(factor * max(found), 6) if found else None


def _settings(rows: Sequence[Row]) -> dict[Setting, list[Row]]:
    """Return the rows of each setting, sorted by model, with coarse resolutions first."""
    found: dict[Setting, list[Row]] = {}
    for row in rows:
        found.setdefault(setting_of(row), []).append(row)
    models = list(dict.fromkeys(label.split("[")[0] for label, _ in found))
    place = {s: (models.index(s[0].split("[")[0]), "[" in s[0], s[0], -s[1]) for s in found}
    return {setting: found[setting] for setting in sorted(found, key=lambda s: place[s])}


def _line(setting: Setting, rows: Sequence[Row]) -> str:
    found = [row for row in rows if row.errors]
    start = f"| {setting[0]} | {setting[1]:g} |"
    if not found:
        return f"{start} {rows[0].measure.status} |" + " |" * (6 + len(HEADS))
    measures = [row.measure for row in found]
    times = (
        f"{median(m.prepare_seconds for m in measures):.2g}",
        milliseconds(median(m.cold_seconds for m in measures)),
        milliseconds(median(warm_by_bodies(found))),
        f"{median(m.peak_rss_MB for m in measures):.0f}",
    )
    worst = [_percent([row.errors[key] for row in found]) for key in KEYS]
    fronts = sum(row.on_front for row in rows)
    done = f"{len(rows)}" if len(found) == len(rows) else f"{len(found)} of {len(rows)}"
    return f"{start} {' | '.join([*times, *worst, done, str(fronts)])} |"


def _percent(errors: Sequence[float]) -> str:
    worst = max(errors)
    return f"{100 * worst:.2g}" if worst == worst else "–"


def body_block(rows: Sequence[BodyRow]) -> list[str]:
    """Return the table of speed and accuracy of the inverse dynamics."""
    heads = " | ".join(f"{head} %" for head in BODY_HEADS.values())
    lines = [
        f"| knee bend | ms per frame | before the frames s | {heads} |",
        "| --- |" + " ---: |" * (2 + len(BODY_HEADS)),
    ]
    for row in rows:
        if row.changed is None:
            lines.append(f"| {row.name} | {row.status} |" + " |" * (1 + len(BODY_HEADS)))
            continue
        shares = " | ".join(f"{100 * row.changed[key]:.2f}" for key in BODY_HEADS)
        start = f"| {row.name} | {1e3 * row.frame_seconds:.3g} | {row.prepare_seconds:.2g}"
        lines.append(f"{start} | {shares} |")
    return lines


def with_block(text: str, lines: Sequence[str], name: str = "tradeoff") -> str:
    """Return a page's text with the lines between its markers.

    Args:
        text: text of the page.
        lines: lines of the block.
        name: the name in the markers `<!-- name:begin -->` and `<!-- name:end -->`.

    Raises:
        InputError: the page does not hold both markers, in order and once.
    """
    begin, end = (marker.format(name) for marker in MARKERS)
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise InputError(f"does not hold {begin} and {end} once each", "the page")
    before, rest = text.split(begin)
    after = rest.split(end)[1]
    return "\n".join([before + begin, "", *lines, "", end + after])


def moved(first: Sequence[tuple[float, float]], second: Sequence[tuple[float, float]]) -> list[int]:
    """Return the points that moved onto or off the front without a tie.

    A move is a tie if each point that beats the moved point, where that is off the front, has an
    equal time (within `EQUAL_RATIO`) in one of the two measurements.

    Args:
        first: (seconds, error) of each point.
        second: the same points, measured again.
    """
    found = []
    marks = on_front(first), on_front(second)
    for i, (before, after) in enumerate(zip(*marks, strict=True)):
        points = first if after else second
        deciding = [j for j in range(len(points)) if beats(points[j], points[i])]
        if before != after and not all(
            _tied(first[i], first[j]) or _tied(second[i], second[j]) for j in deciding
        ):
            found.append(i)
    return found


def _tied(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return max(one[0], other[0]) <= EQUAL_RATIO * min(one[0], other[0])
