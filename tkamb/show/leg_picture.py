"""Pictures of the leg: three frames with the ground reaction, and registered markers.

The rows show the whole leg from the lateral side and from the front, then the knee likewise. The
last one names the ligaments. The laboratory's y is up, and forward the mean direction of the
insert's x over the three frames. A left knee is mirrored at input and mirrored back in the picture.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MultipleLocator

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, inverse, knee_pose, transform
from tkamb.geometry.surface import Surface
from tkamb.io.scene.case import Case
from tkamb.knee.chain import ChainState
from tkamb.run.recording import Recording
from tkamb.show.style import (
    BLACK,
    BLUE,
    FORCE_COLOURS,
    GREY,
    LIGAMENT,
    ORANGE,
    PATELLAR_LIGAMENT,
    QUADRICEPS,
    SKY,
    legend_above,
    new_figure,
    settings,
)
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tkamb.io.importing.links import Links
    from tkamb.io.importing.markers import ModelSegment
    from tkamb.io.importing.registration import Registration


# m per body weight: length of the force arrow. It fits beside the leg.
ARROW_METRES_PER_BW = 0.35
# m: half width of the picture of the knee. A total knee fits.
KNEE_HALF_WIDTH = 0.085
# m: margin around the leg or knee. Labels fit.
MARGIN = 0.08


LEGEND = (
    f"In the laboratory, y up, grid 0.1 m. Green arrow: force of the plate on the foot, 1 BW = "
    f"{ARROW_METRES_PER_BW:g} m.\nGrey: femoral component, light blue: insert and button; "
    "dark red: quadriceps, pink: patellar ligament, purple: ligaments."
)


@dataclass(frozen=True, eq=False)
class LegFrame:
    """The leg at one frame in the laboratory, m.

    Args:
        joints: centres of hip, knee and ankle, (3, 3). The knee is the origin of the insert frame.
        lines: ligaments and tendons, each with points (n, 3), its colour and its name.
        force: force on the foot, N, (3,); None without a plate.
        point: point of application of the force, (3,).
        loaded: whether the foot stands on the plate; otherwise no arrow is drawn.
    """

    frame: int
    joints: Array
    bodies: tuple[tuple[Surface, str], ...]
    lines: tuple[tuple[Array, str, str], ...]
    force: Array | None
    point: Array
    loaded: bool


def shown_frames(case: Case) -> list[int]:
    """Return three distinct frames in time order, or fewer for a short motion.

    They are the first frame and those of the largest ground reaction and flexion. One near another
    is replaced by the last or the middle frame.
    """
    count = len(case.motion.time)
    frames = [0, int(np.argmax(case.motion.coordinates[:, 5])), count - 1, count // 2]
    if case.ground is not None:
        frames.insert(1, int(np.argmax(np.linalg.norm(case.ground.force, axis=1))))
    result: list[int] = []
    for k in frames:
        if len(result) < 3 and all(abs(k - other) >= max(count // 5, 1) for other in result):
            result.append(k)
    return sorted(result)


def leg_frame(case: Case, recording: Recording, k: int) -> LegFrame:
    """Return the leg in frame k."""
    state = recording.geometry(k).state
    to_laboratory = state.insert_in_laboratory
    in_insert = [state.point("hip", np.zeros(3)), np.zeros(3), state.point("tibia", np.zeros(3))]
    parts = (
        (case.insert, np.eye(4), SKY),
        (case.femoral, state.pose("femur"), GREY),
        (case.patella, state.pose("patella") if case.patella else np.eye(4), SKY),
    )
    bodies = tuple(
        (surface.moved(to_laboratory @ pose), colour)
        for surface, pose, colour in parts
        if surface is not None
    )
    lines = [
        (transform(to_laboratory, points), colour, name)
        for points, colour, name in _lines(recording, state)
    ]
    force, point = None, transform(to_laboratory, in_insert[2])
    if case.ground is not None:
        force = case.ground.force[k]
        if case.scene.ground_reaction and case.scene.ground_reaction.applied == "cop":
            point = case.ground.point[k]
    joints = transform(to_laboratory, np.array(in_insert))
    loaded = case.ground is not None and bool(case.ground.loaded[k])
    return LegFrame(k, joints, bodies, tuple(lines), force, point, loaded)


def _lines(recording: Recording, state: ChainState) -> list[tuple[Array, str, str]]:
    """Return ligaments, muscle and patellar ligament: points in the insert frame, colour, and name
    of a first strand.
    """
    segments: list[tuple[Array, str, str]] = []
    named: set[str] = set()
    for bundle in recording.ligaments:
        poses = {link: state.pose(link) for link in bundle.links}
        name = bundle.name.removeprefix("generic_").split("_")[0].rstrip("0123456789")
        segments.append((bundle.points(poses), LIGAMENT, "" if name in named else name))
        named.add(name)
    if recording.extensor is not None:
        with suppress(ComputationError):  # the pose of the patella has no solution in this frame
            quadriceps, ligament = recording.extensor.lines.paths(state)
            segments.append((quadriceps.points, QUADRICEPS, ""))
            segments.append((ligament.points, PATELLAR_LIGAMENT, ""))
    return segments


@dataclass(frozen=True, eq=False)
class View:
    """Directions of a picture in the laboratory frame, whose y is up.

    Args:
        across: horizontal direction (3,) to the right of the page. It is reversed for a left knee,
            which is computed as a right one.
        towards: horizontal direction (3,) towards the reader.
        left: anatomical direction to the left of the page, for example "anterior".
    """

    across: Array
    towards: Array
    left: str
    right: str

    def page(self, points: Array) -> Array:
        """Return the page coordinates (..., 2), m, of points (..., 3), m."""
        return np.stack([points @ self.across, points[..., 1]], axis=-1)


def draw_leg(case: Case, recording: Recording) -> Figure:
    """Return the picture of a case: three frames side by side, four views below each other."""
    frames = [leg_frame(case, recording, k) for k in shown_frames(case)]
    ahead = np.mean([_ahead(recording, one.frame) for one in frames], axis=0)
    ahead /= np.linalg.norm(ahead)
    lateral = np.cross(ahead, [0.0, 1.0, 0.0])
    mirror = -1.0 if case.scene.patient.side == "left" else 1.0
    side, front = ("posterior", "anterior"), ("lateral", "medial")
    if mirror < 0:
        side, front = side[::-1], front[::-1]
    from_side = View(mirror * ahead, lateral, *side)
    from_front = View(-mirror * lateral, ahead, *front)
    weight = case.body_weight
    with settings():
        figure = new_figure(3.2 * len(frames), 14.7)
        grid = figure.subplots(4, len(frames), squeeze=False, height_ratios=(1.3, 1.3, 1.0, 1.0))
        views = (from_side, from_front, from_side, from_front)
        for column, one in zip(grid.T, frames, strict=True):
            for axes, view in zip(column, views, strict=True):
                _draw(axes, one, view, weight)
                _name_sides(axes, view)
            for axes, view in zip(column[2:], views[2:], strict=True):
                _close_up(axes, one, view)
            _name_ligaments(column[3], one, from_front)
            column[0].set_title(_caption(case, one), fontsize=9)
        _same_limits(grid[0])
        _same_limits(grid[1])
        places = ("from its lateral side", "from the front")
        words = [f"{part}, {place}" for part in ("leg", "knee") for place in places]
        for row, label in zip(grid, words, strict=True):
            row[0].set_ylabel(label)
        knee = f"{case.scene.patient.side.capitalize()} knee. "
        figure.supxlabel(knee + LEGEND, fontsize=8)
    return figure


def _ahead(recording: Recording, k: int) -> Array:
    """Return the horizontal part (3,) of the insert's x, laboratory frame."""
    state = recording.geometry(k).state
    return state.insert_in_laboratory[:3, 0] * np.array([1.0, 0.0, 1.0])


def _caption(case: Case, one: LegFrame) -> str:
    motion = case.motion
    flexion = motion.coordinates[one.frame, 5] / DEGREE
    words = f"frame {one.frame}, {motion.time[one.frame]:.2f} s\nflexion {flexion:.0f} deg"
    if one.force is None:
        return f"{words}, no force plate"
    if not one.loaded:
        return f"{words}, plate not loaded"
    return f"{words}, plate {np.linalg.norm(one.force) / case.body_weight:.2f} BW"


def _draw(axes: Axes, one: LegFrame, view: View, weight: float) -> None:
    joints = view.page(one.joints)
    axes.plot(*joints.T, color=BLACK, linewidth=3, alpha=0.35, solid_capstyle="round")
    axes.plot(*joints.T, "o", color=BLACK, markersize=4)
    shown = [one.joints]
    for surface, colour in one.bodies:
        _draw_surface(axes, surface, view, colour)
    for points, colour, _ in one.lines:
        axes.plot(*view.page(points).T, color=colour, linewidth=1.3)
    if one.force is not None and one.loaded:
        tip = one.point + one.force / weight * ARROW_METRES_PER_BW
        arrow = {
            "arrowstyle": "-|>",
            "color": FORCE_COLOURS["ground reaction"],
            "linewidth": 1.8,
            "shrinkA": 0,
            "shrinkB": 0,
        }
        head, tail = (tuple(view.page(end).tolist()) for end in (tip, one.point))
        axes.annotate("", head, tail, arrowprops=arrow)
        shown += [tip[None], one.point[None]]
    if one.force is not None:
        axes.axhline(one.point[1], color=GREY, linewidth=1)
    extent = view.page(np.concatenate(shown))
    low, high = extent.min(axis=0) - MARGIN, extent.max(axis=0) + MARGIN
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="box")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(0.1))
    axes.tick_params(labelbottom=False, labelleft=False, length=0)


def _name_sides(axes: Axes, view: View) -> None:
    ends = ((0.02, 0.015, "left", view.left), (0.98, 0.05, "right", view.right))
    for place, height, align, words in ends:  # two heights, because labels may overlap
        axes.text(
            place, height, words, ha=align, va="bottom", fontsize=8, color=GREY,
            transform=axes.transAxes, gid=f"side-{align}",
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )  # fmt: skip


def _name_ligaments(axes: Axes, one: LegFrame, view: View) -> None:
    for points, _, name in one.lines:
        if name:
            x, y = view.page(points.mean(axis=0))
            axes.text(
                x, y, name, fontsize=8, color=LIGAMENT, clip_on=True, gid=f"ligament-{name}",
                path_effects=[withStroke(linewidth=2.5, foreground="white")],
            )  # fmt: skip


def _draw_surface(axes: Axes, surface: Surface, view: View, colour: str) -> None:
    """Draw triangles, farthest first; those that face the reader are lightest."""
    lean = surface.face_normals @ view.towards
    facing = np.flatnonzero(lean > 0)
    corners = surface.triangles[facing]
    order = np.argsort(corners.mean(axis=1) @ view.towards)
    faces = (0.45 + 0.55 * lean[facing[order]])[:, None] * np.array(to_rgb(colour))
    axes.add_collection(
        PolyCollection(
            list(view.page(corners[order])), facecolors=faces, linewidths=0, antialiaseds=False,
            rasterized=True,
        ),
        autolim=False,
    )  # fmt: skip


def _close_up(axes: Axes, one: LegFrame, view: View) -> None:
    centre = view.page(one.joints[1]) + np.array([0.0, 15 * MILLIMETRE])
    axes.set_xlim(centre[0] - KNEE_HALF_WIDTH, centre[0] + KNEE_HALF_WIDTH)
    axes.set_ylim(centre[1] - KNEE_HALF_WIDTH, centre[1] + KNEE_HALF_WIDTH)


def _same_limits(row: Array) -> None:
    width = max(np.ptp(axes.get_xlim()) for axes in row)
    low = min(axes.get_ylim()[0] for axes in row)
    high = max(axes.get_ylim()[1] for axes in row)
    for axes in row:
        middle = np.mean(axes.get_xlim())
        axes.set_xlim(middle - width / 2, middle + width / 2)
        axes.set_ylim(low, high)


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
