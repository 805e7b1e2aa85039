"""A picture of registered markers: places on the leg, their deviations, and residuals."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array, inverse, knee_pose, transform
from tkamb.show.style import BLUE, GREY, ORANGE, legend_above, new_figure, settings
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tkamb.io.importing.links import Links
    from tkamb.io.importing.markers import ModelSegment
    from tkamb.io.importing.registration import Registration

VIEWS = ((0, "anterior, mm"), (2, "right, mm"))
"""Horizontal axis of the shank, and its label."""


def draw_registration(
    links: "Links", model: "Sequence[ModelSegment]", found: "Registration"
) -> "Figure":
    """Return the picture of a registration.

    The leg is straight. Orange: markers at the model's positions. Blue: registered, with a bar of
    one standard deviation in each direction. On the right the residuals of the rigid fits.

    Args:
        model: segments with the model's markers.
    """
    with settings():
        figure = new_figure(10.0, 6.0)
        axes = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.3))
        for one, (axis, label) in zip(axes, VIEWS, strict=False):
            _draw_leg(one, links, model, found, axis)
            one.set(xlabel=label, aspect="equal")
        axes[0].set_ylabel("superior of the ankle, mm")
        _draw_residuals(axes[2], found)
    return figure


def _straight(links: "Links", segments: "Sequence[ModelSegment]") -> dict[str, Array]:
    """Return segment -> its pose (4, 4) in the shank of the straight leg."""
    thigh = links.insert_in_tibia @ knee_pose(links.neutral)
    poses = {"shank": np.eye(4), "thigh": thigh}
    for s in segments:
        if s.joint is not None and s.centre is not None:
            # foot and pelvis keep the directions of the neutral model
            body = links.leg.pelvis if s.name == "pelvis" else links.leg.foot[0]
            own = links.leg.neutral[links.leg.tibia[0]] @ links.tibia
            poses[s.name] = inverse(own) @ links.leg.neutral[body]
            joint = transform(poses[s.joined_to], s.joint)
            poses[s.name][:3, 3] = joint - poses[s.name][:3, :3] @ s.centre
    return poses


def _draw_leg(
    axes: "Axes",
    links: "Links",
    model: "Sequence[ModelSegment]",
    found: "Registration",
    axis: int,
) -> None:
    poses = _straight(links, model)
    hip = transform(poses["thigh"], links.hip)
    line = np.array([np.zeros(3), links.insert_in_tibia[:3, 3], hip]) / MILLIMETRE
    axes.plot(line[:, axis], line[:, 1], "o-", color=GREY, label="ankle, knee, hip")
    for k, (old, new) in enumerate(zip(model, found.segments, strict=True)):
        turn = poses[old.name]
        first, last = (
            transform(turn, np.array(list(s.points.values()))) / MILLIMETRE for s in (old, new)
        )
        error = np.array([np.abs(turn[:3, :3]) @ found.deviation[label] for label in old.points])
        error = error / MILLIMETRE
        names = ("model", "registered") if k == 0 else (None, None)
        axes.plot(first[:, axis], first[:, 1], "o", mfc="none", color=ORANGE, label=names[0])
        axes.errorbar(
            last[:, axis],
            last[:, 1],
            error[:, 1],
            error[:, axis],
            fmt="o",
            ms=4,
            lw=1.0,
            color=BLUE,
            label=names[1],
        )
        for a, b in zip(first, last, strict=True):
            axes.plot([a[axis], b[axis]], [a[1], b[1]], color=GREY, lw=0.6)
    if axis == 0:
        legend_above(axes, 1)


def _draw_residuals(axes: "Axes", found: "Registration") -> None:
    labels = [label for s in found.segments for label in s.points]
    place = np.arange(len(labels))[::-1]
    for name, shift, colour in (("before", 0.2, ORANGE), ("after", -0.2, BLUE)):
        values = [found.residuals[name][label] / MILLIMETRE for label in labels]
        axes.barh(place + shift, values, 0.4, color=colour, label=name)
    axes.set_yticks(place, labels, fontsize=7)
    axes.set(xlabel="residual of the rigid fit of the segment, mm (rms)")
    axes.grid(visible=False, axis="y")
    legend_above(axes, 2)
