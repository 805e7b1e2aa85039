"""A plot before it is drawn: its lines, unit and words."""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.geometry.frames import Array


@dataclass(frozen=True, eq=False)
class Line:
    """One curve.

    Args:
        name: unique in its panel; a column's name, or what was made from columns.
        label: as the legend shows it.
        values: (f,) in the panel's unit.
        colour: of the line.
        dashed: drawn dashed.
    """

    name: str
    label: str
    values: Array
    colour: str
    dashed: bool = False


@dataclass(frozen=True, eq=False)
class Panel:
    """One plot.

    Args:
        name: id of the plot in the page.
        title: what it shows.
        unit: of the vertical axis.
        lines: its curves.
        note: a sentence under the plot.
        level: (value, label) of a horizontal reference line.
        second: (factor, unit) of a second vertical axis on the right.
        logarithmic: vertical axis.
        from_zero: the vertical axis holds zero.
        limits: of the vertical axis, where they are known beforehand.
        warning: the note is something to look at.
    """

    name: str
    title: str
    unit: str
    lines: tuple[Line, ...]
    note: str = ""
    level: tuple[float, str] | None = None
    second: tuple[float, str] | None = None
    logarithmic: bool = False
    from_zero: bool = True
    limits: tuple[float, float] | None = None
    warning: bool = False


def without_empty_lines(panel: Panel) -> Panel:
    """Return the panel with only the lines that hold a number."""
    lines = tuple(line for line in panel.lines if np.isfinite(line.values).any())
    return replace(panel, lines=lines)
