"""A comparison of runs as one self-contained page: curves, pressure maps and tables."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index
from tkamb.run import metrics
from tkamb.run.claims import split_of
from tkamb.run.metrics import failed, map_rows, medial_share, residual_share, tension_ratio
from tkamb.show.axis import UNITS
from tkamb.show.comparison import SAME, Comparison, Difference, Run
from tkamb.show.headline import limits_line, peak_lines
from tkamb.show.pages import asset, policy_sources, render
from tkamb.show.pressure_maps import draw_map, pressure_bar, top_view
from tkamb.show.style import CYCLE, new_figure, settings, svg_text
from tkamb.units import MEGAPASCAL

if TYPE_CHECKING:
    from tkamb.run.results import Results


WIDTH, HEIGHT = 5.4, 2.7
DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (5, 1.2, 1.2, 1.2)))
"""Line styles: runs can be distinguished without colour, and where they coincide."""


# 1: distance between the rows of crosses that mark failed frames, as a share of the plot's height.
# Each run has a row. Chosen by eye.
FAILED_ROW_HEIGHT = 0.03


@dataclass(frozen=True, eq=False)
class Quantity:
    """Quantity of one picture.

    Args:
    values: function of a run's results that returns (f,) values, in `unit`.
    """

    title: str
    unit: str
    values: "Callable[[Results], Array]"


def _column(title: str, unit: str, name: str) -> Quantity:
    return Quantity(title, unit, lambda results: results[name])


def _both(title: str, unit: str, column: str) -> tuple[Quantity, ...]:
    return tuple(
        _column(f"{title}, {side}", unit, f"{side}_{column}") for side in ("medial", "lateral")
    )


def determined_share(results: "Results") -> Array:
    """Return the medial share by deformation (f,); NaN where adduction does not determine it."""
    undetermined = split_of(results.columns).undetermined
    return np.where(undetermined, np.nan, medial_share(results, "deformation"))


QUANTITIES = (
    _column("Contact force, resultant", "BW", "force_total_BW"),
    Quantity("Medial share by equilibrium", "–", lambda r: medial_share(r, "equilibrium")),
    Quantity("Medial share by deformation", "–", determined_share),
    *_both("Force by equilibrium", "N", "force_equilibrium_N"),
    *_both("Force by deformation", "N", "force_N"),
    *_both("Peak pressure", "MPa", "peak_pressure_MPa"),
    *_both("Contact area", "mm²", "area_mm2"),
    *_both("Centre of pressure, anterior", "mm", "cop_ap_mm"),
    _column("Quadriceps", "N", "quadriceps_N"),
    Quantity("Ratio PL/Q", "–", lambda r: tension_ratio(r, "patellar_ligament_N")),
    _column("Patellofemoral force", "N", "patellofemoral_N"),
    _column("Flexion", "deg", "flexion_deg"),
    _column("Adduction", "deg", "adduction_deg"),
    _column("Axial rotation", "deg", "axial_rotation_deg"),
    Quantity("Residual force / SI contact force", "%", lambda r: 100 * residual_share(r)),
)


def run_colour(number: int) -> str:
    """Return the colour of a run in every picture."""
    return CYCLE[number % len(CYCLE)]


def draw_quantity(comparison: Comparison, quantity: Quantity) -> Figure | None:
    """Return a plot of one quantity of all runs; None: no run has it, or it is the axis itself.

    Lines are in time order and broken at failed frames, which crosses at the bottom mark in the
    run's colour.
    """
    curves = [quantity.values(run.results) for run in comparison.runs]
    if not any(np.isfinite(values).any() for values in curves):
        return None
    if quantity.title == "Flexion" and comparison.kind == "flexion":
        return None
    with settings():
        figure = new_figure(WIDTH, HEIGHT)
        axes = figure.add_subplot()
        for number, (run, values) in enumerate(zip(comparison.runs, curves, strict=True)):
            _draw_curve(axes, number, run, values)
        axes.set_xlabel(comparison.runs[0].axis.label)
        axes.set_ylabel("" if quantity.unit == "–" else quantity.unit)
        axes.margins(x=0.01)
    return figure


def _draw_curve(axes: Axes, number: int, run: Run, values: Array) -> None:
    x, y = run.axis.broken(values)
    colour, dashes = run_colour(number), DASHES[number % len(DASHES)]
    marker = "o" if len(values) == 1 else ""  # a line of one point would be invisible
    axes.plot(x, y, color=colour, linestyle=dashes, gid=f"run-{number}", marker=marker)
    failures = failed(run.results)
    height = np.full(int(failures.sum()), FAILED_ROW_HEIGHT * (1 + number))
    axes.plot(
        run.axis.values[failures], height, "x", color=colour, markersize=5,
        transform=axes.get_xaxis_transform(), gid=f"failed-{number}",
    )  # fmt: skip


def shown_frame(comparison: Comparison) -> int:
    """Return the frame of the first run at which maps are shown by default.

    It has the largest contact force among those with a map of most runs; 0 if no frame has a force.
    """
    force = comparison.runs[0].results["force_total_BW"]
    finite = np.isfinite(force)
    if not finite.any():
        return 0
    maps = np.sum([_mapped(run, len(force)) for run in comparison.runs], axis=0)
    return int(np.nanargmax(np.where(maps == maps[finite].max(), force, np.nan)))


def _mapped(run: Run, frames: int) -> Index:
    """Return (f,): 1 if this run has a map at the first run's frame, else 0."""
    if run.pairing is None:
        return np.zeros(frames, np.int64)
    rows = map_rows(run.results)
    return np.array([run.pairing.nearest(frame) in rows for frame in range(frames)], np.int64)


def draw_maps(comparison: Comparison, frame: int) -> Figure | None:
    """Return the runs' pressure maps on one colour scale; None without any map.

    Args:
        frame: frame of the first run. Each other run shows its nearest frame on the axis.
    """
    frames = [
        None if run.pairing is None else run.pairing.nearest(frame) for run in comparison.runs
    ]
    pressures = [
        None if k is None else _map_at(run.results, k)
        for run, k in zip(comparison.runs, frames, strict=True)
    ]
    if all(pressure is None for pressure in pressures):
        return None
    return _map_figure(comparison, frames, pressures)


def _map_at(results: "Results", frame: int) -> Array | None:
    """Return a frame's pressures (n,), MPa; None without a map."""
    row = map_rows(results).get(frame)
    if results.maps is None or row is None:
        return None
    return results.maps.rows("pressure_Pa", [row])[0] / MEGAPASCAL


def _map_figure(
    comparison: Comparison, frames: Sequence[int | None], pressures: Sequence[Array | None]
) -> Figure:
    peak = max(float(p.max()) for p in pressures if p is not None)
    scale = Normalize(0.0, peak if peak > 0 else 1.0)
    across = min(4, len(comparison.runs))
    down = -(-len(comparison.runs) // across)
    with settings():
        figure = new_figure(11.0, 2.7 * down)
        grid = figure.subplots(down, across, squeeze=False).ravel()
        for axes, run, frame, pressure in zip(
            grid, comparison.runs, frames, pressures, strict=False
        ):
            view = top_view(run.results)
            if view is None or frame is None or pressure is None:
                axes.set_axis_off()
                axes.set_title(f"{run.label}: no map here", fontsize=8.5)
                continue
            draw_map(axes, view, run.results, frame, scale)
            words = f"{run.label}\nframe {frame}, {run.axis.label.split(' (')[0]} "
            axes.set_title(f"{words}{run.axis.at(frame)}", fontsize=8.5)
        for axes in grid[len(comparison.runs) :]:
            axes.set_axis_off()
        pressure_bar(figure, scale, ax=list(grid), fraction=0.02, pad=0.01, aspect=30)
    return figure


POLICY = (
    "default-src 'none'; style-src-elem {style}; style-src-attr 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'"
)
FIRST = (
    "force_total_N", "force_total_BW", "medial_force_equilibrium_N", "lateral_force_equilibrium_N",
    "medial_force_N", "lateral_force_N",
    "medial_peak_pressure_MPa", "lateral_peak_pressure_MPa", "medial_area_mm2", "lateral_area_mm2",
    "medial_cop_ap_mm", "lateral_cop_ap_mm", "quadriceps_N", "patellar_ligament_N",
    "patellofemoral_N", "approach_mm",
)  # fmt: skip
"""Columns of the printed table, which comes first on the page."""


def headline(comparison: Comparison) -> list[Difference]:
    """Return the differences of the columns in `FIRST`."""
    return [one for name in FIRST for one in comparison.differences if one.column == name]


def check_frame(comparison: Comparison, frame: int | None) -> int:
    """Return the first run's frame with shown maps; negative ones count from the end."""
    count = len(comparison.runs[0].results)
    if frame is None:
        return shown_frame(comparison)
    if not -count <= frame < count:
        what = f"there is no frame {frame} in {comparison.runs[0].label}"
        raise InputError(what, "--frame", f"0 to {count - 1}")
    return frame % count


def comparison_html(comparison: Comparison, frame: int | None = None) -> str:
    """Return the page: curves, maps at a frame, differences and notes."""
    frame = check_frame(comparison, frame)
    style = asset("tkamb.show", "report.css") + asset("tkamb.show", "compare.css")
    maps = draw_maps(comparison, frame)
    first = headline(comparison)
    return render(
        "tkamb.show",
        "compare.html",
        policy=POLICY.format(style=policy_sources(style)),
        style=style,
        title=" and ".join(run.label for run in comparison.runs),
        kind=comparison.kind,
        runs=[_run(comparison, number) for number in range(len(comparison.runs))],
        peaks=run_lines(comparison),
        notes=comparison.notes or (SAME,),
        plots=_plots(comparison),
        maps=None if maps is None else svg_text(maps, "maps"),
        first=_rows(comparison, first),
        rest=_rows(comparison, [one for one in comparison.differences if one not in first]),
    )


def _run(comparison: Comparison, number: int) -> dict[str, Any]:
    run = comparison.runs[number]
    contact = run.results.summary.get("contact") or {}
    model = contact.get("model", "contact not modelled")
    at = f" at {contact['resolution_mm']:g} mm" if contact.get("resolution_mm") else ""
    return {
        "label": run.label,
        "colour": run_colour(number),
        "folder": str(run.folder),
        "contact": f"{model}{at}",
        "frames": len(run.results),
        "failed": int(failed(run.results).sum()),
    }


def _plots(comparison: Comparison) -> list[dict[str, str]]:
    result = []
    for number, quantity in enumerate(QUANTITIES):
        figure = draw_quantity(comparison, quantity)
        if figure is not None:
            svg = svg_text(figure, f"plot{number}")
            result.append({"title": quantity.title, "unit": quantity.unit, "svg": svg})
    return result


def _rows(comparison: Comparison, differences: Sequence[Difference]) -> list[list[str]]:
    unit = UNITS[comparison.kind]
    return [
        [
            one.run,
            one.column,
            f"{one.max_abs:.4g}",
            f"{one.percent:.3g}" if math.isfinite(one.percent) else "–",
            f"{one.at_frame} ({one.at:.4g}{unit})" if one.max_abs else "–",
            f"{one.rms:.4g}",
            f"{one.mean:+.4g}" if one.mean else "0",
            str(one.frames),
        ]
        for one in differences
    ]


def run_lines(comparison: Comparison) -> list[str]:
    """Return lines with each run's peak forces and bands, peak pressure and muscles at a limit."""
    lines: list[str] = []
    said: set[str] = set()
    for run in comparison.runs:
        words = [one for one in peak_lines(run.results) if one[0] != "(" or one not in said]
        said.update(words)
        if pressure := metrics.peak_pressure(run.results):
            doubt = f", where {pressure['doubt']}" if pressure["doubt"] else ""
            place = f"{pressure['side']}, at {pressure['time_s']:.4g} s{doubt}"
            words.append(f"peak pressure {pressure['MPa']:.1f} MPa, {place}")
        limits = limits_line(run.results)
        lines += [f"{run.label}: {one}" for one in [*words, *([limits] if limits else [])]]
    return lines


def table_lines(comparison: Comparison) -> list[str]:
    """Return each run's peak forces, notes and the first differences as lines of text."""
    heads = ["run", "column", "max", "% of peak", "at frame", "rms", "mean", "frames"]
    rows = [heads, *_rows(comparison, headline(comparison))]
    widths = [max(len(row[k]) for row in rows) for k in range(len(heads))]
    table = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
    if len(rows) == 1:
        table = ["no differences could be computed"]
    notes = [f"note: {note}" for note in comparison.notes or (SAME,)]
    return [*run_lines(comparison), *notes, *(line.rstrip() for line in table)]
