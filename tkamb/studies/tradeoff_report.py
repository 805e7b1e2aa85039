"""The trade-off for a reader: table and picture."""

from collections.abc import Sequence

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tkamb.output.style import CYCLE, GREY, new_figure, settings
from tkamb.studies.front import NOISE
from tkamb.studies.references import Reference
from tkamb.studies.row import FRONT_ERRORS, KEYS, Row

MARKERS = "osD^vPX*<>"
UNLABELLED_MM = 2.0
"""The cell size at which most points lie."""


def table(rows: Sequence[Row], references: dict[str, Reference]) -> list[str]:
    """Return the lines of the table, case by case."""
    head = (
        f"{'contact':30s} {'mm':>5s} {'prepare s':>9s} {'cold s':>8s} {'warm s':>8s} {'MB':>6s} "
        f"{'approach':>9s} {'force':>7s} {'mean p':>7s} {'peak p':>7s} {'area':>7s} {'map L2':>7s}"
    )
    lines = []
    for case in dict.fromkeys(row.job.case for row in rows):
        some = [row for row in rows if row.job.case == case]
        known = _uncertainty(references[case])
        lines += [f"{case} (reference known to: {known})", head]
        lines += [_line(row) for row in some]
        lines.append("")
    names = ", ".join(name.replace("_", " ") for name in FRONT_ERRORS)
    lines.append("* on the Pareto front of warm time against the largest of the errors in")
    tie = f"medians of time within {100 * (NOISE - 1):.0f} % count as equal"
    return [*lines, f"  {names}; {tie}. One thread."]


def _line(row: Row) -> str:
    measure, star = row.measure, "*" if row.on_front else " "
    start = f"{star}{row.job.label:29s} {row.job.resolution_mm:5.2f}"
    if not row.errors:
        return f"{start} {measure.status}"
    times = (
        f"{measure.prepare_seconds:9.3f} {measure.cold_seconds:8.4f} {measure.warm_seconds:8.4f}"
    )
    known = [row.errors[key] for key in KEYS]
    shares = [f"{100 * error:6.2f}%" if error == error else f"{'–':>7s}" for error in known]
    return f"{start} {times} {measure.peak_rss_MB:6.0f} {shares[0]:>9s} {' '.join(shares[1:])}"


def _uncertainty(reference: Reference) -> str:
    found = []
    for key in ("approach", "force", "mean_pressure", "peak_pressure", "area"):
        names = [name for name in reference.values if name.endswith(key)]
        scale = max(abs(reference.values[name]) for name in names)
        worst = max(reference.uncertainty[name] for name in names)
        found.append(f"{key.replace('_', ' ')} {100 * worst / scale:.1f} %")
    return ", ".join(found)


def picture(rows: Sequence[Row]) -> Figure:
    """Return error against time, one panel per case, the front as a line."""
    cases = list(dict.fromkeys(row.job.case for row in rows))
    labels = list(dict.fromkeys(row.job.label for row in rows))
    columns = min(4, len(cases))
    lines = -(-len(cases) // columns)
    with settings():
        figure = new_figure(3.4 * columns, 3.1 * lines + 0.3 + 0.9 * len(labels) / (2 * columns))
        axes = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
        for axis, case in zip(axes.ravel(), cases, strict=False):
            _panel(axis, [row for row in rows if row.job.case == case and row.errors], labels)
            axis.set_title(case, loc="left")
        for axis in axes.ravel()[len(cases) :]:
            axis.set_visible(False)
        for axis in axes[:, 0]:
            axis.set_ylabel("largest error, %")
        for number, axis in enumerate(axes.ravel()[: len(cases)]):
            if number + columns >= len(cases):
                axis.set_xlabel("time per warm press, ms")
                axis.tick_params(labelbottom=True)
        found = {text: line for axis in axes.ravel() for line, text in _legend(axis)}
        figure.legend(
            list(found.values()),
            list(found),
            loc="outside upper left",
            ncols=2 * columns,
            title=f"numbers at the points: cell size, mm; {UNLABELLED_MM:g} mm where there is none",
            alignment="left",
        )
    return figure


def _panel(axis: Axes, rows: Sequence[Row], labels: Sequence[str]) -> None:
    front = sorted(
        (row.measure.warm_seconds * 1e3, row.worst * 100) for row in rows if row.on_front
    )
    axis.plot(*zip(*front, strict=True), color=GREY, lw=1.2, zorder=1, label="Pareto front")
    for label in dict.fromkeys(row.job.label for row in rows):
        some = sorted((r for r in rows if r.job.label == label), key=lambda r: r.job.resolution_mm)
        number = labels.index(label)
        axis.plot(
            [row.measure.warm_seconds * 1e3 for row in some],
            [row.worst * 100 for row in some],
            MARKERS[number % len(MARKERS)],
            color=CYCLE[number % len(CYCLE)],
            ms=5.5,
            label=label,
        )
        for row in some:
            if row.job.resolution_mm == UNLABELLED_MM:
                continue
            axis.annotate(
                f"{row.job.resolution_mm:g}",
                (row.measure.warm_seconds * 1e3, row.worst * 100),
                xytext=(4, 3),
                textcoords="offset points",
                fontsize=6.5,
                color=GREY,
            )
    if rows:
        axis.axhline(100 * rows[0].floor, color=GREY, lw=0.8, ls=":", label="reference known to")
    axis.set(xscale="log", yscale="log")


def _legend(axis: Axes) -> list[tuple[Artist, str]]:
    return list(zip(*axis.get_legend_handles_labels(), strict=True))
