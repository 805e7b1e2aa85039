"""Figures of studies: the designs of a cohort, and the cases of `tkamb stability`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tkamb.geometry.frames import SIDES, Array
from tkamb.io.given_material import given_material
from tkamb.run.known_errors import ContactSituation, KnownError, stated_error
from tkamb.show.style import (
    BLUE,
    CYCLE,
    GREY,
    ORANGE,
    VERMILLION,
    legend_above,
    new_figure,
    settings,
)
from tkamb.studies.cohort.outcome import Group, Outcome
from tkamb.studies.cohort.plan import Cohort, CohortRun
from tkamb.studies.verdict import KINDS, MAX_ERROR, Verdict

WEAR = "volume_mm3_per_Mc"
"""Key of the worn volume; with _low or _high an end of the wear factor's range."""
BANDS = (
    "Dot: mean over the runs. Thick bar: smallest to largest run. Thin bar: these ends extended by "
    "the known error of the contact model (pressure), or by the range of the wear factor (wear), "
    "which scales all designs alike."
)


# 1: width of the dots of one tick on the horizontal axis, as a share of the distance between
# ticks. Chosen by eye.
SPREAD = 0.5


@dataclass(frozen=True)
class Bar:
    """One design in one plot.

    Args:
        series: label in the legend; "": no label.
        most: upper end of the uncertainty.
    """

    place: str
    series: str
    mean: float
    low: float
    high: float
    least: float
    most: float


def run_error(run: CohortRun, outcome: Outcome) -> KnownError | str | None:
    """Return the known error of a run's contact, or "not measured: ..."; None: no contact."""
    table = run.scene.contact
    if table is None or "approach_mm" not in outcome.columns:
        return None
    material = given_material(run.scene.insert_material)
    peak = ContactSituation.of_run(outcome.columns, outcome.status, material.poisson_ratio)
    return stated_error(table.model, table.resolution_mm, material.name, table.options, peak)


def factor_names(cohort: Cohort) -> list[str]:
    """Return the names of the designs' factors, that on the horizontal axis first."""
    return list(dict.fromkeys(name for design in cohort.table.design for name in design.factors))


def design_bars(
    cohort: Cohort, groups: Sequence[Group], outcomes: Mapping[int, Outcome]
) -> dict[str, list[Bar]]:
    """Return "pressure" and "wear" -> the bars of the groups with such results."""
    result: dict[str, list[Bar]] = {"pressure": [], "wear": []}
    for group in groups:
        sides = [group.peaks.get(f"{side}_peak_pressure_MPa") for side in SIDES]
        present = [values for values in sides if values is not None]
        if present:
            peaks = np.fmax.reduce(present)
            errors = [run_error(cohort.runs[n], outcomes[n]) for n in group.numbers]
            share = np.array(
                [e.peak_pressure if isinstance(e, KnownError) else np.nan for e in errors]
            )
            bars = _bar(cohort, group, peaks, peaks * (1 - share), peaks * (1 + share))
            result["pressure"] += bars
        if WEAR in group.wear:
            ends = (group.wear.get(f"{WEAR}_{end}", group.wear[WEAR]) for end in ("low", "high"))
            result["wear"] += _bar(cohort, group, group.wear[WEAR], *ends)
    return result


def _bar(cohort: Cohort, group: Group, values: Array, least: Array, most: Array) -> list[Bar]:
    if not np.isfinite(values).any():
        return []
    place, series = _labels(cohort, group)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    below = float(np.nanmin(np.append(least, low)))
    above = float(np.nanmax(np.append(most, high)))
    return [Bar(place, series, float(np.nanmean(values)), low, high, below, above)]


def _labels(cohort: Cohort, group: Group) -> tuple[str, str]:
    """Return place and series of a group's bar.

    They are the design's first factor and its others; without any the group's name.
    """
    names = factor_names(cohort)
    designs = {one.name: one for one in cohort.table.design}
    design = designs.get(group.labels.get("design", ""))
    if not names or design is None:
        return group.name, ""
    others = group.name_without("design")
    series = [f"{name} {design.factors.get(name, '–')}" for name in names[1:]]
    series += [] if others == "all runs" else [others]
    return f"{names[0]} {design.factors.get(names[0], '–')}", ", ".join(series)


def draw_designs(bars: Mapping[str, Sequence[Bar]]) -> Figure:
    """Return plots of the designs' peak pressures and worn volumes, with their uncertainties."""
    filled = {name: some for name, some in bars.items() if some}
    titles = {
        "pressure": "Peak contact pressure (MPa)",
        "wear": "Worn volume (mm³ per million cycles)",
    }
    with settings():
        figure = new_figure(10.8, 3.6)
        for axes, (name, some) in zip(
            figure.subplots(1, len(filled), squeeze=False)[0], filled.items(), strict=True
        ):
            _draw_bars(axes, some)
            axes.set_ylabel(titles[name])
    return figure


def _draw_bars(axes: Axes, bars: Sequence[Bar]) -> None:
    places = list(dict.fromkeys(bar.place for bar in bars))
    series = list(dict.fromkeys(bar.series for bar in bars))
    step = SPREAD / max(len(series), 1)
    for k, name in enumerate(series):
        some = [bar for bar in bars if bar.series == name]
        shift = (k - 0.5 * (len(series) - 1)) * step
        x = [places.index(bar.place) + shift for bar in some]
        colour = CYCLE[k % len(CYCLE)]
        axes.vlines(x, [b.least for b in some], [b.most for b in some], color=colour, linewidth=1)
        axes.vlines(
            x, [b.low for b in some], [b.high for b in some], color=colour, linewidth=5, alpha=0.4
        )
        axes.plot(x, [b.mean for b in some], "o", color=colour, markersize=5, label=name or None)
    slanted = max(map(len, places)) * len(places) > 60
    axes.set_xticks(range(len(places)), places, rotation=30 if slanted else 0)
    axes.set_xlim(-0.6, len(places) - 0.4)
    axes.set_ylim(0.0, 1.06 * max(bar.most for bar in bars))
    if any(series):
        legend_above(axes, 2)


VERDICT_COLOURS = {"converged": BLUE, "flagged": ORANGE}


def picture(verdicts: Sequence[Verdict]) -> Figure:
    """Return a plot with a dot per case: extreme parameter against distance from the reference."""
    groups = list(dict.fromkeys(_group(v) for v in verdicts))
    with settings():
        figure = new_figure(8.0, 1.6 + 0.2 * len(groups))
        axis = figure.subplots()
        for kind in KINDS:
            some = [v for v in verdicts if v.kind == kind]
            if not some:
                continue
            axis.plot(
                [_distance(v) for v in some],
                [groups.index(_group(v)) for v in some],
                "o" if kind in VERDICT_COLOURS else "X",
                color=VERDICT_COLOURS.get(kind, VERMILLION),
                ms=4 if kind in VERDICT_COLOURS else 7,
                alpha=0.75,
                label=f"{kind.replace('_', ' ')} ({len(some)})",
            )
        axis.axvline(MAX_ERROR, color=GREY, lw=1, ls="--")
        top = len(groups) - 0.3
        words = "wrong beyond 2 %; closed forms beyond their own bound "
        axis.text(MAX_ERROR, top, words, color=GREY, fontsize=7.5, ha="right")
        axis.text(1.0, top, "no answer", color=GREY, fontsize=7.5, ha="center")
        axis.set(xscale="log", xlim=(1e-9, 3.0), xlabel="largest distance from the reference")
        axis.set_yticks(range(len(groups)), groups, fontsize=7.5)
        axis.set_ylim(-0.7, len(groups) + 0.4)
        figure.legend(loc="outside upper left", ncols=4)
    return figure


def _distance(verdict: Verdict) -> float:
    return 1.0 if verdict.error is None else max(verdict.error, 2e-9)


def _group(verdict: Verdict) -> str:
    """Return a case's extreme parameters, its model, or the kind of its run."""
    if verdict.contact == "run":
        return " ".join(verdict.case.split()[:2])
    if verdict.contact != "lattice":
        return f"{verdict.contact}, any"
    names = [part.split("=")[0].rsplit("_", 1)[0] for part in verdict.case.split(", ")]
    return " and ".join(names)
