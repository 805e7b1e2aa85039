"""The trade-off as a block of Markdown between two markers, made from the study's JSON alone."""

from collections.abc import Sequence
from statistics import median

from tkamb.errors import InputError
from tkamb.studies.advice import (
    Setting,
    bodies_of,
    comparison,
    recommendations,
    setting_of,
    warm_by_bodies,
)
from tkamb.studies.tradeoff import KEYS, Row

BEGIN, END = "<!-- tradeoff:begin -->", "<!-- tradeoff:end -->"
HEADS = ("approach", "condyle force", "mean p", "peak p", "area", "map L2")


def block(rows: Sequence[Row]) -> list[str]:
    """Return the lines between the markers: table, comparison with finite elements, advice.

    One line per setting, over all cases on which it was measured: medians of the times over
    the pairs of bodies, largest errors.
    """
    bodies = len({bodies_of(row.job.case) for row in rows})
    cases = len({row.job.case for row in rows})
    settings: dict[Setting, list[Row]] = {}
    for row in rows:
        settings.setdefault(setting_of(row), []).append(row)
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


def _line(setting: Setting, rows: Sequence[Row]) -> str:
    found = [row for row in rows if row.errors]
    start = f"| {setting[0]} | {setting[1]:g} |"
    if not found:
        return f"{start} {rows[0].measure.status} |" + " |" * (6 + len(HEADS))
    measures = [row.measure for row in found]
    times = (
        f"{median(m.prepare_seconds for m in measures):.2g}",
        f"{1e3 * median(m.cold_seconds for m in measures):.3g}",
        f"{1e3 * median(warm_by_bodies(found)):.3g}",
        f"{median(m.peak_rss_MB for m in measures):.0f}",
    )
    worst = [_percent([row.errors[key] for row in found]) for key in KEYS]
    fronts = sum(row.on_front for row in rows)
    done = f"{len(rows)}" if len(found) == len(rows) else f"{len(found)} of {len(rows)}"
    return f"{start} {' | '.join([*times, *worst, done, str(fronts)])} |"


def _percent(errors: Sequence[float]) -> str:
    worst = max(errors)
    return f"{100 * worst:.2g}" if worst == worst else "–"


def with_block(text: str, lines: Sequence[str]) -> str:
    """Return a page's text with the lines between its markers.

    Raises:
        InputError: the page does not hold both markers, in order and once.
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise InputError(f"does not hold {BEGIN} and {END} once each", "the page")
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    return "\n".join([before + BEGIN, "", *lines, "", END + after])
