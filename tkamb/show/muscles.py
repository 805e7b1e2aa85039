"""The report's section on muscles: activations and EMG, forces, and their effect on the knee."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tkamb.geometry.frames import Array
from tkamb.run.columns import (
    ACTIVATION,
    CONTRIBUTIONS,
    ENVELOPE,
    MUSCLE_FORCE,
    family_column,
)
from tkamb.run.metrics import body_weight
from tkamb.show.axis import HorizontalAxis
from tkamb.show.panels import Line, Panel
from tkamb.show.style import (
    BLACK,
    EDGE_POINTS,
    GREY,
    LIGAMENT,
    LIST,
    QUADRICEPS,
    TICK_LABEL_POINTS,
    TICK_POINTS,
    label_width,
    leave_unmeasured,
    new_figure,
    overhang,
    set_place,
    settings,
)

if TYPE_CHECKING:
    from tkamb.run.results import Results

GROUP_COLOURS = (QUADRICEPS, *LIST, GREY, GREY)
EXTERNAL, LIGAMENTS, POST, EXTENSORS = "external", "ligaments", "post", "quadriceps"
"""Names of contributions of other loads, and of the quadriceps as a whole."""
HELD = (
    "Contribution of a load to a force: the force that the equations of the frame give if this "
    "load acts alone. Pose, contact points, contact normals, direction of friction and lines of "
    "action stay the same. The sum of all contributions is the force by equilibrium. If a single "
    "muscle acts, a moment balances its flexion moment. External loads are weight, inertia and "
    "ground reaction. Muscles are grouped by the bones to which they attach."
)


# 1: upper end of the axis of activations. Lines at 1 stay visible.
AXIS_TOP = 1.02


CELL, CELLS_ACROSS, MARGIN = (2.16, 1.12), 5, 0.3
"""Width and height of a small plot, inches; plots in a row; height for labels, inches."""
BETWEEN, LABELS = (11.5, 20.0), 10.0
"""Points: smallest horizontal and the vertical distance between small plots; height for axis labels
above an incomplete last row."""
FOOT, TITLE = 33.5, 11.5
"""Points: margin below and above all small plots."""
SHADE = "#c4c4c4"


@dataclass(frozen=True)
class Cell:
    """One small plot of activations.

    Args:
        envelope: name of the muscle whose EMG envelope is drawn; None: no EMG.
    """

    title: str
    muscles: tuple[str, ...]
    envelope: str | None


def muscle_panels(results: "Results") -> tuple[Panel, ...]:
    """Return plots of the contributions to each condyle's force, and of muscle forces by group."""
    panels = (
        *(_contributions(results, side) for side in CONTRIBUTIONS),
        _forces(results),
    )
    return tuple(panel for panel in panels if panel.lines)


def _groups(results: "Results") -> dict[str, tuple[str, ...]]:
    result: Mapping[str, Any] = results.summary.get("muscle_groups") or {}
    return {group: tuple(names) for group, names in result.items()}


def _colours(results: "Results") -> dict[str, str]:
    return dict(zip(_groups(results), GROUP_COLOURS, strict=False))


def _forces(results: "Results") -> Panel:
    scale, colours = 1 / body_weight(results), _colours(results)
    lines = tuple(
        Line(f"group-{k}", group, scale * total, colours[group])
        for k, (group, names) in enumerate(_groups(results).items())
        if np.isfinite(total := _sum(results, MUSCLE_FORCE, names)).any()
    )
    return Panel("muscle_forces", "Muscle forces by group", "BW", lines)


def _contributions(results: "Results", side: str) -> Panel:
    family, scale, colours = CONTRIBUTIONS[side], 1 / body_weight(results), _colours(results)
    total = results[f"{side}_force_equilibrium_N"]
    parts = {name: (name,) for name in (EXTERNAL, LIGAMENTS, POST)} | _groups(results)
    labels = {EXTERNAL: "external loads"}
    shades = {EXTERNAL: GREY, LIGAMENTS: LIGAMENT, POST: BLACK} | colours
    lines = [Line("all", "all", scale * total, BLACK)]
    for k, (part, names) in enumerate(parts.items()):
        loads = (EXTENSORS,) if part == "knee extensors" else names
        values = _sum(results, family, loads)
        if np.isfinite(values).any():
            dashed = part in (EXTERNAL, LIGAMENTS, POST)
            label = labels.get(part, part)
            lines.append(Line(f"part-{k}", label, scale * values, shades[part], dashed))
    panel = Panel(f"from_{side}", f"Contributions to the {side} force", "BW", tuple(lines))
    return panel if len(lines) > 1 else Panel(panel.name, panel.title, "BW", ())


def _sum(results: "Results", family: str, names: tuple[str, ...]) -> Array:
    """Return the sum (f,) of a family's existing columns; NaN without any."""
    columns = [family_column(family, name) for name in names]
    present = [results[name] for name in columns if name in results.columns]
    return np.sum(present, axis=0) if present else np.full(len(results), np.nan)


def activation_cells(results: "Results") -> list[Cell]:
    """Return the small plots: one per muscle of a knee group, and one per EMG channel of others.

    A group is a knee group if one of its muscles crosses the knee.
    """
    emg: Mapping[str, Any] = (results.summary.get("emg") or {}).get("muscles", {})
    cells: list[Cell] = []
    for group, names in _groups(results).items():
        across = group == "knee extensors" or any(
            family_column(CONTRIBUTIONS["medial"], name) in results.columns for name in names
        )
        if across:
            cells += [Cell(name, (name,), name if name in emg else None) for name in names]
            continue
        channels: dict[str, tuple[str, ...]] = {}
        for name in names:
            if name in emg:
                channel = emg[name]["channel"]
                channels[channel] = (*channels.get(channel, ()), name)
        cells += [
            Cell(
                muscles[0] if len(muscles) == 1 else f"{channel} ({len(muscles)})",
                muscles,
                muscles[0],
            )
            for channel, muscles in channels.items()
        ]
    return cells


def draw_activations(results: "Results", axis: HorizontalAxis) -> Figure | None:
    """Return small plots of activations over shaded EMG envelopes; None: no activations."""
    cells = activation_cells(results)
    if not cells:
        return None
    rows = -(-len(cells) // CELLS_ACROSS)
    with settings():
        figure = new_figure(CELLS_ACROSS * CELL[0], rows * CELL[1] + MARGIN)
        first = figure.add_axes((0, 0, 1, 1))
        others = [figure.add_axes((0, 0, 1, 1), sharex=first, sharey=first) for _ in cells[1:]]
        for k, (cell, axes) in enumerate(zip(cells, (first, *others), strict=True)):
            _draw_cell(axes, cell, results, axis)
            below = k + CELLS_ACROSS >= len(cells)
            axes.tick_params(labelbottom=below, labelleft=k % CELLS_ACROSS == 0)
        first.set_ylim(0, AXIS_TOP)
        first.set_yticks([0, 0.5, 1])
        low = EDGE_POINTS / 72 / figure.get_figheight()
        figure.supxlabel(axis.label, fontsize=TICK_LABEL_POINTS, y=low, va="bottom")
        _place_cells((first, *others), rows)
    return figure


def _place_cells(cells: Sequence[Axes], rows: int) -> None:
    width, height = 72 * CELLS_ACROSS * CELL[0], 72 * (rows * CELL[1] + MARGIN)
    margin = EDGE_POINTS + TICK_POINTS + label_width(cells[0].yaxis)
    beyond = overhang(cells[0].xaxis, width / CELLS_ACROSS - margin)
    margin, right = (
        max(margin, EDGE_POINTS + beyond[0]),
        EDGE_POINTS + beyond[1],
    )
    gap = max(BETWEEN[0], sum(beyond) + 2 * EDGE_POINTS)
    labels_within = LABELS if len(cells) % CELLS_ACROSS and rows > 1 else 0.0
    wide = (width - margin - right + gap) / CELLS_ACROSS - gap
    tall = (height - FOOT - TITLE - labels_within + BETWEEN[1]) / rows - BETWEEN[1]
    for k, axes in enumerate(cells):
        row, column = divmod(k, CELLS_ACROSS)
        raised = labels_within if row < rows - 1 else 0.0
        bottom = FOOT + (rows - 1 - row) * (tall + BETWEEN[1]) + raised
        set_place(axes, margin + column * (wide + gap), bottom, wide, tall)
    for axes in cells:
        leave_unmeasured(axes.xaxis)
        leave_unmeasured(axes.yaxis)


def _draw_cell(axes: Axes, cell: Cell, results: "Results", axis: HorizontalAxis) -> None:
    if cell.envelope is not None:
        x, envelope = axis.broken(results[family_column(ENVELOPE, cell.envelope)])
        axes.fill_between(x, envelope, color=SHADE, linewidth=0)
    for name in cell.muscles:
        x, activation = axis.broken(results[family_column(ACTIVATION, name)])
        axes.plot(x, activation, color=BLACK, linewidth=1.3)
    axes.set_title(cell.title, loc="left", fontsize=8.5, pad=2)
    text = ", ".join(filter(None, (_agreement(results, cell), _beyond(results, cell))))
    if text:
        axes.set_title(text, loc="right", fontsize=7.5, color=GREY, pad=2)


def _beyond(results: "Results", cell: Cell) -> str:
    """Return the largest EMG envelope beyond the plot in words; else ""."""
    if cell.envelope is None:
        return ""
    envelope = results[family_column(ENVELOPE, cell.envelope)]
    largest = float(np.nan_to_num(envelope).max(initial=0.0))
    return f"EMG to {largest:.2g}" if largest > AXIS_TOP else ""


def _agreement(results: "Results", cell: Cell) -> str:
    """Return Pearson's r of activation and envelope in words, or its range."""
    emg: Mapping[str, Any] = (results.summary.get("emg") or {}).get("muscles", {})
    correlations = [emg[name]["pearson_r"] for name in cell.muscles if name in emg]
    correlations = [r for r in correlations if r is not None and np.isfinite(r)]
    if not correlations:
        return ""
    low, high = f"{min(correlations):.2f}", f"{max(correlations):.2f}"
    return (f"r {low}" if low == high else f"r {low} to {high}").replace("-", "−")


def reserve_words(summary: Mapping[str, Any]) -> str:
    """Return a sentence on the reserve moments; empty without reserves."""
    result: Mapping[str, Any] = summary.get("reserves") or {}
    if not result:
        return ""
    parts = [
        f"{name.replace('_', ' ')} {one['largest_Nm']:.1f} N·m "
        f"({one['percent_of_largest_moment']:.0f} %"
        + (f", above 5 % in {n} frames)" if (n := one["frames_above_5_percent"]) else ")")
        for name, one in result.items()
    ]
    return (
        "Largest reserve moments, which no muscle provides (share of the largest moment of the "
        "coordinate): " + "; ".join(parts) + "."
    )
