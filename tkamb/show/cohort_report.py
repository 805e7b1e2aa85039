"""The report of a cohort: one self-contained page that compares the groups."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from tkamb.geometry.frames import Array
from tkamb.io.given_material import given_material, material_as_json
from tkamb.run.claims import method_error
from tkamb.run.known_errors import as_json, is_large, known_error_words
from tkamb.run.maps import ContactMaps
from tkamb.show.headline import OTHER_ERRORS, PRESSURE_AND_AREA, Card
from tkamb.show.pages import asset, policy_sources, render
from tkamb.show.pressure_maps import TopView, draw_pressure
from tkamb.show.study_figures import BANDS, design_bars, draw_designs, run_error
from tkamb.show.style import CYCLE as COLOURS
from tkamb.show.style import PRESSURE_MAP, legend_above, new_figure, settings, svg_text
from tkamb.studies.cohort.outcome import CYCLE, Group, Outcome, spread
from tkamb.studies.cohort.plan import Cohort
from tkamb.units import MEGAPASCAL

PACKAGE = "tkamb.studies.cohort"
POLICY = (
    "default-src 'none'; style-src-elem {style}; style-src-attr 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'"
)
SHOWN = {
    "force_total_BW": ("Tibiofemoral contact force", "BW", 2),
    "medial_peak_pressure_MPa": ("Peak pressure, medial", "MPa", 1),
    "lateral_peak_pressure_MPa": ("Peak pressure, lateral", "MPa", 1),
    "medial_area_mm2": ("Contact area, medial", "mm²", 0),
    "lateral_area_mm2": ("Contact area, lateral", "mm²", 0),
    "quadriceps_N": ("Quadriceps tension", "N", 0),
}
"""Column -> title, unit and number of decimals."""
AT_ONCE = len(COLOURS)
"""Largest number of groups in one plot."""


# Largest number of pressure maps. More make the page slow to open.
MOST_MAPS = 24
# Largest number of failed runs in the list. The page stays readable.
MOST_FAILED = 100


def cohort_html(cohort: Cohort, outcomes: Mapping[int, Outcome], groups: Sequence[Group]) -> str:
    """Return the report as HTML."""
    style = asset("tkamb.show", "report.css")
    return render(
        PACKAGE,
        "cohort.html",
        policy=POLICY.format(style=policy_sources(style)),
        style=style,
        title=cohort.table.title,
        subtitle=_subtitle(cohort, outcomes),
        cards=_cards(cohort, outcomes, groups),
        headings=[SHOWN[name][:2] for name in _there(groups)],
        rows=[_row(group, _there(groups)) for group in groups],
        plots=list(_plots(groups)),
        designs=_designs(cohort, groups, outcomes),
        wear=_wear_table(groups),
        maps=_maps(cohort, outcomes, groups),
        failed=_failed(cohort, outcomes)[:MOST_FAILED],
        failed_count=sum(bool(one.reason) for one in outcomes.values()),
    )


def _designs(
    cohort: Cohort, groups: Sequence[Group], outcomes: Mapping[int, Outcome]
) -> dict[str, str] | None:
    bars = design_bars(cohort, groups, outcomes)
    if not cohort.table.design or not any(bars.values()):
        return None
    return {"svg": svg_text(draw_designs(bars), "designs"), "words": BANDS}


def _error_card(cohort: Cohort, outcomes: Mapping[int, Outcome]) -> Card | None:
    words: dict[str, str] = {}
    large = False
    for n, outcome in outcomes.items():
        table = cohort.runs[n].scene.contact
        if table is None or outcome.reason:
            continue
        error = as_json(run_error(cohort.runs[n], outcome))
        material = material_as_json(given_material(cohort.runs[n].scene.insert_material))["name"]
        setting = f"{table.model} at {table.resolution_mm:g} mm, {material}"
        if setting not in words or isinstance(error, str):
            words[setting] = f"{setting}: {known_error_words(error, PRESSURE_AND_AREA)}"
        large = large or is_large(error, PRESSURE_AND_AREA)
    if not words:
        return None
    detail = " ".join([*words.values(), OTHER_ERRORS])
    number = f"{len(words)} setting{'s' * (len(words) > 1)}"
    return Card("Known error of the contact model", number, detail, warning=large)


def _there(groups: Sequence[Group]) -> list[str]:
    return [name for name in SHOWN if any(name in group.peaks for group in groups)]


def _subtitle(cohort: Cohort, outcomes: Mapping[int, Outcome]) -> str:
    parts = []
    for axis in ("subject", "trial", "design", "contact"):
        count = len({cohort.runs[n].labels[axis] for n in outcomes} - {""})
        if count:
            parts.append(f"{count} {axis}{'s' if count > 1 else ''}")
    groups = ", ".join(cohort.group_by) or "nothing: one group"
    return f"{' × '.join(parts)}; grouped by {groups}"


def _cards(cohort: Cohort, outcomes: Mapping[int, Outcome], groups: Sequence[Group]) -> list[Card]:
    failed = sum(bool(one.reason) for one in outcomes.values())
    frames = sum(len(one.status) for one in outcomes.values())
    failures = sum(one.failed_frames for one in outcomes.values())
    detail = f"{failed} failed: listed at the end" if failed else "none failed"
    result = [
        Card(
            "Runs computed",
            f"{len(outcomes) - failed} of {len(outcomes)}",
            detail,
            warning=failed > 0,
        )
    ]
    words = "failed frames have no numbers" if failures else "none failed"
    if flagged := sum(one.flagged_frames for one in outcomes.values()):
        words += f"; {flagged} to be read with care, see their status in cohort.parquet"
    result.append(
        Card("Frames computed", f"{frames - failures} of {frames}", words, warning=failures > 0)
    )
    name = "force_total_BW"
    means = {
        group.name: float(np.nanmean(group.peaks[name])) for group in groups if name in group.peaks
    }
    if not means:
        return result
    low, high = (f(means, key=lambda group: means[group]) for f in (min, max))
    value, detail = f"{means[low]:.2f}–{means[high]:.2f} BW", f"least {low}, most {high}"
    if f"{means[low]:.2f}" == f"{means[high]:.2f}":
        value, detail = f"{means[low]:.2f} BW", "alike in all groups"
    result.append(Card("Peak resultant contact force", value, f"mean of the runs' peaks: {detail}"))
    result += _method_cards(cohort, outcomes)
    error = _error_card(cohort, outcomes)
    result += [] if error is None else [error]
    if cohort.table.wear is not None:
        result.append(_wear_card(outcomes, groups))
    return result


def _method_cards(cohort: Cohort, outcomes: Mapping[int, Outcome]) -> list[Card]:
    """Return the method's measured error by activity and choice of muscles."""
    scenes = [cohort.runs[n].scene for n, one in outcomes.items() if not one.reason]
    cases = dict.fromkeys((one.output.activity, one.muscles is not None) for one in scenes)
    cards = []
    for activity, muscles in cases:
        error = method_error({"activity": activity, "scene_tables": {"muscles": muscles}})
        title = f"Error of this method: {activity or 'activity not stated'}"
        cards.append(Card(title, error.headline, " ".join(error.sentences), warning=True))
    return cards


def _wear_card(outcomes: Mapping[int, Outcome], groups: Sequence[Group]) -> Card:
    lost = sum(bool(one.wear_problem) for one in outcomes.values())
    name = "volume_mm3_per_Mc"
    means = [float(np.nanmean(group.wear[name])) for group in groups if name in group.wear]
    value = f"{min(means):.3g}–{max(means):.3g} mm³ per million cycles" if means else "none"
    text = (
        f"mean of the runs by group; {len(outcomes) - lost} of {len(outcomes)} runs. By archard "
        "and cross-shear the contact area cancels: the volume hardly follows the design's "
        "conformity. If designs differ by one law only, the law causes the difference: see the "
        "table of wear"
    )
    if lost:
        text += f". {lost} runs have none, see wear_failed in runs.csv"
    return Card("Worn volume", value, text, warning=lost > 0)


def _wear_table(groups: Sequence[Group]) -> dict[str, Any] | None:
    groups = [group for group in groups if "volume_mm3_per_Mc" in group.wear]
    if not groups:
        return None
    laws = [name for name in groups[0].wear if name.startswith("first_")]
    words = [name.removeprefix("first_").removesuffix("_mm3_per_Mc") for name in laws]
    rows = []
    for group in groups:
        mean = {name: float(np.nanmean(values)) for name, values in group.wear.items()}
        low, high = mean["volume_mm3_per_Mc_low"], mean["volume_mm3_per_Mc_high"]
        cells = [f"{mean['volume_mm3_per_Mc']:.3g} ({low:.3g}–{high:.3g})"]
        cells += [f"{mean['max_depth_mm']:.3g}"] if "max_depth_mm" in mean else ["–"]
        rows.append([group.name, *cells, *(f"{mean[law]:.3g}" for law in laws)])
    return {"laws": words, "rows": rows}


def _row(group: Group, names: Sequence[str]) -> list[str]:
    cells = [group.name, str(len(group.numbers)), str(group.failed or "")]
    for name in names:
        over = spread(group.peaks.get(name, np.array([np.nan]))[:, None])
        digits = SHOWN[name][2]
        if not over.runs.sum():
            cells.append("–")
            continue
        text = f"{over.mean[0]:.{digits}f}"
        if over.runs[0] > 1:
            text += (
                f" ± {over.sd[0]:.{digits}f} ({over.low[0]:.{digits}f}–{over.high[0]:.{digits}f})"
            )
        cells.append(text)
    return cells


def _plots(groups: Sequence[Group]) -> Any:
    for name in _there(groups):
        for axis in dict.fromkeys(group.axis for group in groups):
            drawn = [group for group in groups if group.axis == axis and name in group.bins]
            highest = max(_highest(group, name) for group in drawn) if drawn else 0.0
            for place, (words, part) in enumerate(_split_into_plots(drawn)):
                title = ", ".join(filter(None, (SHOWN[name][0], words)))
                svg = svg_text(draw_groups(part, name, highest), f"{name}-{axis}-{place}")
                yield {"title": title, "unit": SHOWN[name][1], "svg": svg}


def _split_into_plots(groups: Sequence[Group]) -> list[tuple[str, dict[str, Group]]]:
    """Return for each plot the label value that its groups share, and its groups by name.

    If there are too many groups, each plot shows those of one value of a label. It is the label
    with the fewest values that leaves at most `AT_ONCE` groups in a plot. Without such a label the
    groups are divided in their order.
    """
    if len(groups) > AT_ONCE:
        values = {
            axis: list(dict.fromkeys(group.labels[axis] for group in groups))
            for axis in groups[0].labels
        }
        for axis in sorted(values, key=lambda axis: len(values[axis])):
            parts = [[g for g in groups if g.labels[axis] == value] for value in values[axis]]
            if 1 < max(map(len, parts)) <= AT_ONCE:
                named = [{group.name_without(axis): group for group in part} for part in parts]
                return list(zip(values[axis], named, strict=True))
    starts = range(0, len(groups), AT_ONCE)
    return [("", {group.name: group for group in groups[k : k + AT_ONCE]}) for k in starts]


def _highest(group: Group, name: str) -> float:
    """Return the largest mean plus standard deviation."""
    over = spread(group.bins[name])
    return float(np.nanmax(over.mean + np.nan_to_num(over.sd), initial=0.0))


def draw_groups(groups: Mapping[str, Group], name: str, highest: float) -> Figure:
    """Return the groups' means of a column over the motion, with one standard deviation.

    Args:
        highest: largest value of all plots of the column, which share one vertical scale.
    """
    with settings():
        figure = new_figure(5.4, 3.1)
        axes = figure.add_subplot()
        for (label, group), colour in zip(groups.items(), COLOURS, strict=False):
            _draw_group(axes, group, label, name, colour)
        cycle = next(iter(groups.values())).axis == CYCLE
        axes.set_xlabel("cycle (%)" if cycle else "flexion (deg)")
        axes.set_ylabel(SHOWN[name][1])
        axes.set_ylim(0.0, 1.05 * highest or None)
        legend_above(axes, 2 if sum(len(label) + 6 for label in groups) > 72 else 4)
    return figure


def _draw_group(axes: Axes, group: Group, label: str, name: str, colour: str) -> None:
    over, middle = spread(group.bins[name]), 0.5 * (group.edges[:-1] + group.edges[1:])
    filled = over.runs > 0  # the line crosses bins without frames
    middle, mean, sd = middle[filled], over.mean[filled], over.sd[filled]
    axes.plot(middle, mean, "o-", color=colour, markersize=3, label=label)
    axes.fill_between(middle, mean - sd, mean + sd, color=colour, alpha=0.13, linewidth=0)


def _maps(
    cohort: Cohort, outcomes: Mapping[int, Outcome], groups: Sequence[Group]
) -> dict[str, Any] | None:
    shown, alike = _typical(cohort, outcomes, groups)
    with_map = shown[:MOST_MAPS]
    if not with_map:
        return None
    flexion = cohort.table.map_flexion_deg
    frame = "The largest force" if flexion is None else f"The frame nearest to {flexion:g}°"
    return {
        "svg": svg_text(draw_group_maps(cohort, outcomes, with_map), "maps"),
        "frame": frame,
        "whose": "runs that differ only in the labels of their groups, those with peak "
        "forces nearest to the groups' medians"
        if alike
        else "the run whose peak force is its group's median",
        "more": len(groups) - len(with_map),
    }


def _typical(
    cohort: Cohort, outcomes: Mapping[int, Outcome], groups: Sequence[Group]
) -> tuple[list[tuple[Group, int]], bool]:
    """Return one run of each group, and whether these runs differ only in the groups' labels.

    Maps of the same subject and trial are easiest to compare, so all runs share the labels that do
    not define the groups, if possible. Of several such sets, that of peak forces nearest to the
    groups' medians is returned. Otherwise each group has the run of its median. Runs without a map
    are ignored.
    """
    peaks = [
        {
            _other_labels(cohort, group, n): (
                n,
                float(np.nanmax(outcomes[n].columns["force_total_BW"])),
            )
            for n in group.numbers
            if outcomes[n].chosen is not None
        }
        for group in groups
    ]
    mapped = [(group, runs) for group, runs in zip(groups, peaks, strict=True) if runs]
    if not mapped:
        return [], False
    medians = [
        sorted(peak for _, peak in runs.values())[(len(runs) - 1) // 2] for _, runs in mapped
    ]
    pairs = list(zip((runs for _, runs in mapped), medians, strict=True))
    common = [labels for labels in mapped[0][1] if all(labels in runs for _, runs in mapped)]
    if common:
        labels = min(common, key=lambda key: sum(abs(runs[key][1] - m) for runs, m in pairs))
        return [(group, runs[labels][0]) for group, runs in mapped], True
    nearest = [min(runs.values(), key=lambda one: abs(one[1] - m))[0] for runs, m in pairs]
    return [(group, n) for (group, _), n in zip(mapped, nearest, strict=True)], False


def _other_labels(cohort: Cohort, group: Group, number: int) -> tuple[str, ...]:
    return tuple(v for k, v in cohort.runs[number].labels.items() if k not in group.labels)


def draw_group_maps(
    cohort: Cohort, outcomes: Mapping[int, Outcome], rows: Sequence[tuple[Group, int]]
) -> Figure:
    """Return the chosen pressure maps on one colour scale."""
    largest = max(_pressure(outcomes[n]).max() for _, n in rows)
    scale = Normalize(0.0, float(largest) or 1.0)
    across = min(4, len(rows))
    down = -(-len(rows) // across)
    with settings():
        figure = new_figure(11.0, down * 2.6)
        grid = figure.subplots(down, across, squeeze=False).ravel()
        for axes in grid:
            axes.set_axis_off()
        for axes, (group, n) in zip(grid, rows, strict=False):
            chosen = outcomes[n].chosen
            assert chosen is not None
            maps = ContactMaps({"points_m": chosen.points, "triangles": chosen.triangles})
            view = TopView(maps, chosen.side, chosen.lateral)
            view.draw_insert(axes)
            draw_pressure(axes, view, _pressure(outcomes[n]), scale)
            view.draw_labels(axes)
            axes.set_title(_caption(cohort, outcomes[n], group, n), fontsize=8.5)
        bar = figure.colorbar(
            ScalarMappable(scale, PRESSURE_MAP), ax=list(grid), fraction=0.02, pad=0.01, aspect=30
        )
        bar.set_label("contact pressure (MPa)")
    return figure


def _pressure(outcome: Outcome) -> Array:
    assert outcome.chosen is not None
    return outcome.chosen.pressure / MEGAPASCAL


def _caption(cohort: Cohort, outcome: Outcome, group: Group, number: int) -> str:
    assert outcome.chosen is not None
    k = outcome.chosen.frame
    flexion, force = outcome.columns["flexion_deg"][k], outcome.columns["force_total_BW"][k]
    who = cohort.runs[number].labels["subject"]
    return f"{group.name}\n{who + ', ' if who else ''}{flexion:.0f}°, {force:.2f} BW"


def _failed(cohort: Cohort, outcomes: Mapping[int, Outcome]) -> list[tuple[str, str, str]]:
    return [
        (str(n), cohort.runs[n].words(), one.reason) for n, one in outcomes.items() if one.reason
    ]
