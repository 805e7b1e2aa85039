"""Report of the trade-off study: table, picture, fastest model for an error, comparisons."""

from collections.abc import Sequence
from statistics import median

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from tkamb.geometry.frames import SIDES
from tkamb.show.style import CYCLE, GREY, new_figure, settings
from tkamb.studies.references import Reference
from tkamb.studies.tradeoff import EQUAL_RATIO, FRONT_ERRORS, KEYS, Row

MARKERS = "osD^vPX*<>"


# mm: cell size that is not written beside its point. Most points have it.
UNLABELLED_MM = 2.0
# 1: a logarithmic axis also has labels within its decades if the ratio of its two ends is smaller
# than this. On longer axes the labels of the decades are enough.
SHORT_AXIS_RATIO = 30.0
# Smallest number of different pairs of bodies that gives a recommendation. The two
# pairs of the quick study suit `hertz`, whose errors on a knee are larger.
MIN_BODIES = 3


LIMITS = {
    "approach": (0.05,),
    "force": (0.03,),
    "mean_pressure": (0.05, 0.10),
    "peak_pressure": (0.02, 0.05, 0.10),
    "area": (0.05, 0.10),
    "map": (0.10,),
}
"""Error limits, 1, for which the fastest model is recommended."""
NAMES = dict(zip(KEYS, (key.replace("_", " ") for key in KEYS), strict=True)) | {
    "force": "condyle force",
    "map": "the pressure map (L2)",
}
COMPARED_ON, COMPARED_AT_MM = "two condyles", 2.0
"""Case and cell size, mm, for the comparison of the default lattice with finite elements."""
DEFAULT = "lattice"

Setting = tuple[str, float]


def table(rows: Sequence[Row], references: dict[str, Reference]) -> list[str]:
    """Return the lines of the table, case by case."""
    head = (
        f"{'contact':30s} {'mm':>5s} {'prepare s':>9s} {'cold s':>8s} {'warm s':>8s} {'MB':>6s} "
        f"{'approach':>9s} {'force':>7s} {'mean p':>7s} {'peak p':>7s} {'area':>7s} {'map L2':>7s}"
    )
    lines = []
    for case in dict.fromkeys(row.job.case for row in rows):
        some = [row for row in rows if row.job.case == case]
        uncertainty = _uncertainty(references[case])
        lines += [f"{case} (reference known to: {uncertainty})", head]
        lines += [_line(row) for row in some]
        lines.append("")
    names = ", ".join(name.replace("_", " ") for name in FRONT_ERRORS)
    lines.append("* on the Pareto front of warm time against the largest of the errors in")
    tie = f"medians of time within {100 * (EQUAL_RATIO - 1):.0f} % count as equal"
    return [*lines, f"  {names}; {tie}. One thread."]


def _line(row: Row) -> str:
    measure, star = row.measure, "*" if row.on_front else " "
    start = f"{star}{row.job.label:29s} {row.job.resolution_mm:5.2f}"
    if not row.errors:
        return f"{start} {measure.status}"
    times = (
        f"{measure.prepare_seconds:9.3f} {measure.cold_seconds:8.4f} {measure.warm_seconds:8.4f}"
    )
    errors = [row.errors[key] for key in KEYS]
    shares = [f"{100 * error:6.2f}%" if error == error else f"{'–':>7s}" for error in errors]
    return f"{start} {times} {measure.peak_rss_MB:6.0f} {shares[0]:>9s} {' '.join(shares[1:])}"


def _uncertainty(reference: Reference) -> str:
    result = []
    for key in ("approach", "force", "mean_pressure", "peak_pressure", "area"):
        names = [name for name in reference.values if name.endswith(key)]
        scale = max(abs(reference.values[name]) for name in names)
        worst = max(reference.uncertainty[name] for name in names)
        result.append(f"{key.replace('_', ' ')} {100 * worst / scale:.1f} %")
    return ", ".join(result)


def picture(rows: Sequence[Row]) -> Figure:
    """Return plots of error against time, one per case, with the Pareto front as a line."""
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
        _plain_ticks(axes[0, 0])
        for axis in axes[:, 0]:
            axis.set_ylabel("largest error, %")
        for number, axis in enumerate(axes.ravel()[: len(cases)]):
            if number + columns >= len(cases):
                axis.set_xlabel("time per warm press, ms")
                axis.tick_params(labelbottom=True)
        result = {text: line for axis in axes.ravel() for line, text in _legend(axis)}
        figure.legend(
            list(result.values()),
            list(result),
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


def _plain_ticks(axis: Axes) -> None:
    for side, (low, high) in ((axis.xaxis, axis.get_xlim()), (axis.yaxis, axis.get_ylim())):
        if high < SHORT_AXIS_RATIO * low:
            side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            side.set_major_formatter("{x:g}")
            side.set_minor_formatter(NullFormatter())


def _legend(axis: Axes) -> list[tuple[Artist, str]]:
    return list(zip(*axis.get_legend_handles_labels(), strict=True))


def setting_of(row: Row) -> Setting:
    """Return the model with its options, and its cell size (mm)."""
    return row.job.label, row.job.resolution_mm


def bodies_of(case: str) -> str:
    """Return the name of a case's bodies, which all their poses share."""
    if case.endswith(" deg"):
        return case.split()[0]
    return {"varus": "two condyles"}.get(case, case)


def recommendations(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for each limit: the fastest setting that is within it in all cases.

    Only settings with results on all pairs of bodies are compared, by the median over the pairs of
    a warm press's time.
    """
    if len({bodies_of(row.job.case) for row in rows}) < MIN_BODIES:
        return ["no recommendation from so few cases: run the whole study, without --quick"]
    settings = _settings_on_all_bodies(rows)
    return [
        f"for at most {100 * limit:g} % in {NAMES[key]}, {_fastest(settings, key, limit)}"
        for key, limits in LIMITS.items()
        for limit in limits
    ]


def _settings_on_all_bodies(rows: Sequence[Row]) -> dict[Setting, list[Row]]:
    bodies = {bodies_of(row.job.case) for row in rows}
    result: dict[Setting, list[Row]] = {}
    for row in rows:
        result.setdefault(setting_of(row), []).append(row)
    return {
        setting: some
        for setting, some in result.items()
        if {bodies_of(row.job.case) for row in some} == bodies
    }


def _fastest(settings: dict[Setting, list[Row]], key: str, limit: float) -> str:
    worst = {
        setting: max(row.errors.get(key, float("inf")) for row in some)
        for setting, some in settings.items()
    }
    times = {setting: median(warm_by_bodies(some)) for setting, some in settings.items()}
    within = [setting for setting, error in worst.items() if error <= limit]
    if within:
        best = min(within, key=lambda setting: times[setting])
        return f"the fastest is {_named(best)} ({milliseconds(times[best])} ms warm)"
    if not worst:
        return "no recommendation: no setting was measured on all bodies"
    nearest = min(worst, key=lambda setting: worst[setting])
    return f"no setting: the nearest is {_named(nearest)} with {100 * worst[nearest]:.2g} %"


def warm_by_bodies(rows: Sequence[Row]) -> list[float]:
    """Return for each pair of bodies the median time of a warm press over its poses, s."""
    bodies = dict.fromkeys(bodies_of(row.job.case) for row in rows)
    return [
        median(row.measure.warm_seconds for row in rows if bodies_of(row.job.case) == body)
        for body in bodies
    ]


def milliseconds(seconds: float) -> str:
    """Return a time in ms with three digits."""
    value = 1e3 * seconds
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _named(setting: Setting) -> str:
    return f"{setting[0]} at {setting[1]:g} mm"


def comparison(rows: Sequence[Row]) -> list[str]:
    """Return sentences that compare the default lattice with finite elements in this study."""
    some = [row for row in rows if row.job.case == COMPARED_ON and row.errors]
    lattice = {row.job.resolution_mm: row for row in some if row.job.label == DEFAULT}
    if COMPARED_AT_MM not in lattice:
        return []
    where = "is" if lattice[COMPARED_AT_MM].on_front else "is not"
    time = milliseconds(lattice[COMPARED_AT_MM].measure.warm_seconds)
    front = ", ".join(f"{size:g}" for size, row in lattice.items() if row.on_front)
    first = (
        f"{COMPARED_ON}, 2000 N, nonlinear, {COMPARED_AT_MM:g} mm: {DEFAULT} takes {time} ms a "
        f"position (warm) and {where} on the front; its cell sizes on the front: {front or 'none'}"
        " mm"
    )
    others = [
        row
        for row in some
        if row.job.label.startswith("calculix")
        or (row.job.label.startswith("fe") and row.job.resolution_mm == COMPARED_AT_MM)
    ]
    return [
        first,
        *(_against(r, lattice[size]) for r in others if (size := r.job.resolution_mm) in lattice),
    ]


def _against(row: Row, lattice: Row) -> str:
    label, times = row.job.label, row.measure.warm_seconds / lattice.measure.warm_seconds
    line = (
        f"{label} at {row.job.resolution_mm:g} mm: {milliseconds(row.measure.warm_seconds)} ms, "
        f"{times:.3g} times as long as {DEFAULT}"
    )
    if label == "fe":
        line += "; it shares the lattice's stored response and solver"
    if label.startswith("calculix"):
        line += (
            f"; {_difference(lattice, row)}; CalculiX has finite strain, the lattice small strain"
        )
    return line


def _difference(lattice: Row, peer: Row) -> str:
    """Return the differences from another model in words, % of it."""
    a, b = lattice.measure.values, peer.measure.values
    if not a or not b:
        return "values not kept"
    load = sum(b[f"{side}_force"] for side in SIDES)
    peak = max(b[f"{side}_peak_pressure"] for side in SIDES)
    shares = {
        "approach": abs(a["approach"] / b["approach"] - 1),
        "peak pressure": max(abs(a[f"{s}_peak_pressure"] - b[f"{s}_peak_pressure"]) for s in SIDES)
        / peak,
        "condyle force": max(abs(a[f"{s}_force"] - b[f"{s}_force"]) for s in SIDES) / load,
    }
    text = ", ".join(f"{100 * share:.2g} % in {name}" for name, share in shares.items())
    return f"the lattice differs from it by {text}"
