"""The trade-off as blocks of Markdown between two markers, made from the study's JSON alone."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from statistics import median

from tkamb.errors import InputError
from tkamb.known_errors import KnownError
from tkamb.studies.body_trade import HEADS as BODY_HEADS
from tkamb.studies.body_trade import BodyRow
from tkamb.studies.row import KEYS, TIMING_NOISE, Row, beats, on_front
from tkamb.studies.tradeoff_report import (
    Setting,
    bodies_of,
    comparison,
    milliseconds,
    recommendations,
    setting_of,
    warm_by_bodies,
)

MARKERS = "<!-- {}:begin -->", "<!-- {}:end -->"
HEADS = ("approach", "condyle force", "mean p", "peak p", "area", "map L2")


def block(rows: Sequence[Row]) -> list[str]:
    """Return the lines between the markers: table, comparison with finite elements, advice.

    One line per setting, over all cases on which it was measured: medians of the times over
    the pairs of bodies, largest errors.
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
    """Return the README's few lines: time of a position, and the largest errors, of `SHORT`."""
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


def known_errors_json(rows: Sequence[Row]) -> str:
    """Return the text of `tkamb/known_errors.json`: the table's errors, setting by setting.

    Settings that failed on a case, or that belong to another program, are left out: nothing is
    known of them that would hold for every run.
    """
    names = [name for name in KnownError.__dataclass_fields__ if name != "cases"]
    found = []
    for (label, resolution), some in _settings(rows).items():
        if label.startswith("calculix") or not all(row.errors for row in some):
            continue
        worst = {name: max(row.errors[name] for row in some) for name in names}
        error = asdict(KnownError(**worst, cases=len(some)))
        found.append({"contact": label, "resolution_mm": resolution} | error)
    return json.dumps(found, indent=1, allow_nan=False) + "\n"


def _settings(rows: Sequence[Row]) -> dict[Setting, list[Row]]:
    """Return the rows of each setting: a model's variants beside it, coarse ones first."""
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
    """Return the table of the body's trade."""
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
        text: of the page.
        lines: of the block.
        name: of the markers, `<!-- name:begin -->` and `<!-- name:end -->`.

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
    """Return which points changed between on and off the front though no tie explains it.

    A tie explains it when the two points of every pair that decides lie within the noise of each
    other in one of the two measurements.

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
    return max(one[0], other[0]) <= TIMING_NOISE * min(one[0], other[0])
