"""Curves of several runs over each other, and their pressure maps side by side."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from tkamb.geometry.frames import Array, Index
from tkamb.run.metrics import failed, map_rows, medial_share, residual_share, tension_ratio
from tkamb.show.compare.comparison import Comparison, Run
from tkamb.show.pressure_maps import draw_map, pressure_bar, top_view
from tkamb.show.style import CYCLE, new_figure, settings
from tkamb.units import MEGAPASCAL

if TYPE_CHECKING:
    from tkamb.run.results import Results

WIDTH, HEIGHT = 5.4, 2.7
DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (5, 1.2, 1.2, 1.2)))
"""Line styles, so that runs can be distinguished without colour and where they coincide."""


@dataclass(frozen=True)
class CompareFigureSettings:
    """Pictures of compared runs."""

    failed_row_height: float = 0.03
    """1: height of the crosses of failed frames above the bottom, and their distance from run to
    run, as a share of the picture's height. Chosen by looks."""


COMPARE_FIGURE = CompareFigureSettings()


@dataclass(frozen=True, eq=False)
class Quantity:
    """Quantity of one picture.

    Args:
        title: what it is.
        unit: of the values.
        values: (f,) of a run.
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


QUANTITIES = (
    _column("Contact force, total", "BW", "force_total_BW"),
    Quantity("Medial share by deformation", "–", lambda r: medial_share(r, "deformation")),
    *_both("Force by deformation", "N", "force_N"),
    *_both("Force by equilibrium", "N", "force_equilibrium_N"),
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
    """Return one quantity of all runs over the axis; None where no run has it.

    Each line is drawn in time order and broken where a frame failed; crosses at the bottom, in
    the run's colour, say where.
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
    marker = "o" if len(values) == 1 else ""  # a line of one point would not be seen
    axes.plot(x, y, color=colour, linestyle=dashes, gid=f"run-{number}", marker=marker)
    failures = failed(run.results)
    height = np.full(int(failures.sum()), COMPARE_FIGURE.failed_row_height * (1 + number))
    axes.plot(
        run.axis.values[failures], height, "x", color=colour, markersize=5,
        transform=axes.get_xaxis_transform(), gid=f"failed-{number}",
    )  # fmt: skip


def shown_frame(comparison: Comparison) -> int:
    """Return the frame of the first run whose maps are shown.

    It is the frame with the largest contact force among those at which most runs have a map; 0 if
    no frame has a force.
    """
    force = comparison.runs[0].results["force_total_BW"]
    finite = np.isfinite(force)
    if not finite.any():
        return 0
    maps = np.sum([_mapped(run, len(force)) for run in comparison.runs], axis=0)
    return int(np.nanargmax(np.where(maps == maps[finite].max(), force, np.nan)))


def _mapped(run: Run, frames: int) -> Index:
    """Return (f,) 1 for every frame of the first run at which this run has a map, else 0."""
    if run.pairing is None:
        return np.zeros(frames, np.int64)
    rows = map_rows(run.results)
    return np.array([run.pairing.nearest(frame) in rows for frame in range(frames)], np.int64)


def draw_maps(comparison: Comparison, frame: int) -> Figure | None:
    """Return the runs' pressure maps at one place, on one scale; None without any map.

    Args:
        comparison: the runs.
        frame: of the first run; of the others the nearest frame on the axis, which the titles
            name.
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
    """Return the pressures (n,) MPa of a frame; None where it has no map."""
    row = map_rows(results).get(frame)
    if results.maps is None or row is None:
        return None
    return results.maps.pressure_Pa[row] / MEGAPASCAL


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
