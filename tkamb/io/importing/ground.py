"""The ground reaction of an imported trial, from force plates, a table or external loads."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.importing.anatomy import Leg
from tkamb.io.importing.plates import (
    MAX_FOOT_DISTANCE,
    Feet,
    Load,
    RecordedForce,
    TableForce,
    check_upward,
    common_surface,
    feet_loads,
    known_interval,
    own_plates,
    plate_forces,
    table_forces,
    unmeasured,
)
from tkamb.io.importing.scene_text import GroundFile, ImportRequest
from tkamb.io.opensim.document import Document, Element, open_document
from tkamb.io.recordings.c3d import read_c3d
from tkamb.io.recordings.force_plates import DRIFT_N, around_load, unloaded_level
from tkamb.io.recordings.ground_reaction import recorded_wrench, summed_reaction
from tkamb.io.recordings.recording_tables import GroundReactionTable
from tkamb.io.recordings.tables import Table, read_table


@dataclass(frozen=True)
class ExternalForce:
    """A force in a list of external loads.

    Args:
        beginnings: "force", "point" or "moment" -> beginning of the names of its columns.
    """

    name: str
    body: str
    beginnings: dict[str, str]


def with_external_loads(request: ImportRequest, foot: tuple[str, ...]) -> ImportRequest:
    """Return a request with a list of external loads replaced by its table and the foot's forces.

    `foot` are the names of the foot's bodies.
    """
    if request.grf is None or request.grf.suffix.lower() != ".xml":
        return request
    path, forces = _external_loads(request.grf)
    if request.grf_force is not None:
        return replace(request, grf=path)
    own = [force for force in forces if force.body in foot]
    if not own:
        bodies = ", ".join(force.body for force in forces) or "no body"
        what = f"applies no force to the foot ({', '.join(foot)}), but to {bodies}"
        raise InputError(what, request.grf, "give --grf-force")
    columns = table_forces(read_table(path))
    names = [_columns_of(force, columns, request.grf).name for force in own]
    return replace(request, grf=path, grf_force=",".join(names))


def _columns_of(force: ExternalForce, columns: list[TableForce], path: Path) -> TableForce:
    for candidate in columns:
        if all(
            name.startswith(force.beginnings[kind])
            for kind in ("force", "point", "moment")
            for role, name in candidate.columns.items()
            if role.startswith(kind) and force.beginnings[kind]
        ):
            return candidate
    names = ", ".join(candidate.name for candidate in columns) or "none"
    what = f"names columns '{force.beginnings['force']}…' of '{force.name}', but its table has "
    raise InputError(what + names, path, "correct its identifiers")


def _external_loads(path: Path) -> tuple[Path, list[ExternalForce]]:
    root, _ = open_document(path)
    document = Document(path, {})
    loads = root if root.tag == "ExternalLoads" else root.find("ExternalLoads")
    if loads is None:
        what = f"is no list of external loads: it has no <ExternalLoads> in <{root.tag}>"
        raise InputError(what, path, "give a .mot or .sto file")
    table = path.parent / document.text(loads, "datafile").replace("\\", "/")
    return table, [_force(document, entry) for entry in loads.findall("objects/ExternalForce")]


def _force(document: Document, entry: Element) -> ExternalForce:
    for tag in ("force_expressed_in_body", "point_expressed_in_body"):
        frame = document.text(entry, tag, default="ground").strip("/")
        if frame != "ground":
            what = f"has its numbers in the frame '{frame}', which is not read"
            raise InputError(what, document.where(entry), "express it in ground")
    tags = {"force": "force", "point": "point", "moment": "torque"}
    beginnings = {
        kind: document.text(entry, f"{tag}_identifier", default=" ").strip()
        for kind, tag in tags.items()
    }
    body = document.text(entry, "applied_to_body").split("/")[-1]
    return ExternalForce(entry.get("name", ""), body, beginnings)


# N: below this vertical force the centre of pressure is interpolated in time. The
# quotient of moment and force is noise below 40 N.
HOLD_BELOW = 40.0


COLUMNS = ("time", *(f"{kind}_{k}" for kind in ("force", "point", "moment") for k in (1, 2, 3)))
"""Columns of a table of summed forces: time (s), force (N), point of application (m), and moment
about this point (N·m). Axes: x forward, y up, z right."""
Interval = tuple[float, float]


@dataclass(frozen=True, eq=False)
class FoundGround:
    """The ground reaction of one foot.

    Args:
        ground: file with its plates or columns; None: no ground reaction is modelled.
        interval: start and end, s, of the part of the recording to use; None: unknown.
        span: times of a table's first and last sample, s; None: the forces are not from a table.
    """

    ground: GroundFile | None
    interval: Interval | None
    span: Interval | None
    remarks: list[str]


def find_ground(request: ImportRequest, leg: Leg, axes: str, feet: Feet | None) -> FoundGround:
    """Return the ground reaction of one foot.

    Args:
        axes: axes of the recording and table that point forward, up and right.
    """
    request, side = with_external_loads(request, leg.foot), leg.side
    if request.grf is not None:
        return _from_table(request, request.grf, side, axes, feet)
    if request.recording.suffix.lower() == ".c3d" and feet is not None:
        return _from_plates(request, side, axes, feet)
    return FoundGround(None, request.interval, None, ["no ground reaction given: none is modelled"])


def _from_plates(request: ImportRequest, side: str, axes: str, feet: Feet) -> FoundGround:
    recording = read_c3d(request.recording, request.units)
    unread = recording.unread_plates
    if request.plates == ():
        text = ["ATTENTION: no ground reaction is modelled, as given"]
        return FoundGround(None, request.interval, None, text)
    if request.plates is not None:
        for number in request.plates:
            recording.plate(number)
        text = [f"force plates {_listed(request.plates)} under the {side} foot, as given"]
        ground = GroundFile(request.recording, axes, request.plates, units=request.units)
        return FoundGround(ground, request.interval, None, text)
    if not recording.plates:
        if unread:
            raise next(iter(unread.values()))
        raise InputError(
            "holds no force plates",
            request.recording,
            "give the ground reaction with --grf, or --plates none to model none",
        )
    forces = plate_forces(recording, axes)
    downward = check_upward(forces, feet, side)
    loads = feet_loads(forces, feet)
    plates = own_plates(loads, side, request.recording)
    interval = request.interval or known_interval(loads, plates, feet)
    lines = [*(_load_line(load) for load in loads), *downward, _interval_line(request, interval)]
    lines += _unmeasured_line(loads, plates, feet, side, interval)
    lines += _drift_lines(forces, plates)
    surface = common_surface(loads, plates)
    numbers = tuple(int(plate) for plate in plates)
    ground = GroundFile(request.recording, axes, numbers, surface=surface, units=request.units)
    return FoundGround(ground, interval, None, lines)


def _from_table(
    request: ImportRequest, path: Path, side: str, axes: str, feet: Feet | None
) -> FoundGround:
    """The forces are chosen by --grf-force, by name, or by point of application."""
    table = read_table(path)
    forces = table_forces(table)
    time = table.time()
    span = (float(time[0]), float(time[-1]))
    notices = [f"notice: {remark}" for remark in table.remarks]
    table_axes = _axes_of_table(table, forces, axes)
    if table_axes != axes:
        notices.append(f"{path.name}: y points up; forward, up, right are its {table_axes}")
        axes = table_axes
    if request.plates is not None:
        raise InputError("is for the plates of a .c3d", "--plates", "give --grf-force for a table")
    chosen = _named(forces, side, request.grf_force, table)
    has_places = all(force.has("point") or force.has("moment") for force in forces)
    if chosen:
        if feet is not None and has_places:
            check_clocks([_recorded(table, force, axes) for force in chosen], feet, side, path)
        why = "as given" if request.grf_force else "by their name"
        recorded = [_recorded(table, force, axes) for force in chosen] if len(chosen) > 1 else []
        ground = _table_file(path, axes, chosen, recorded)
        lines = [_columns_line(path, side, chosen, why), *notices]
        return FoundGround(ground, request.interval, span, lines)
    if feet is None or not forces or not has_places:
        raise _which_foot(forces, side, table)
    recorded = [_recorded(table, force, axes) for force in forces]
    loads = feet_loads(recorded, feet)
    if not any(load.side == side for load in loads):
        for one in recorded:
            check_clocks([one], feet, side, path)
    names = own_plates(loads, side, path, "give --grf-force")
    interval = request.interval or known_interval(loads, names, feet)
    chosen = [force for force in forces if force.name in names]
    foot_forces = [force for force in recorded if force.key in names]
    check_clocks(foot_forces, feet, side, path)
    lines = [*(_load_line(load) for load in loads), _interval_line(request, interval)]
    lines += [_columns_line(path, side, chosen, "by their points of application"), *notices]
    lines += [*_unmeasured_line(loads, names, feet, side, interval), *_drift_lines(recorded, names)]
    return FoundGround(_table_file(path, axes, chosen, foot_forces), interval, span, lines)


def _axes_of_table(table: Table, forces: list[TableForce], axes: str) -> str:
    """Return the table's axes that point forward, up and right, usually those of the recording. If
    the recording's z points up and the table's largest force is along y, the table has OpenSim's
    axes: its x, y, z are the recording's x, z, -y.
    """
    if not forces or axes.split(",")[1][-1] != "z":
        return axes
    columns = [[table.column(force.columns[f"force_{k}"]) for k in (1, 2, 3)] for force in forces]
    size = np.nansum(np.abs(np.array(columns)), axis=(0, 2))
    if int(np.argmax(size)) != 1:
        return axes
    forceplate_axes = {"x": "+x", "z": "+y", "y": "-z"}
    result = []
    for axis in axes.split(","):
        table_axis = forceplate_axes[axis[-1]]
        result.append(("+" if table_axis[0] == axis[0] else "-") + table_axis[1])
    return ",".join(result)


def _named(
    forces: list[TableForce], side: str, source_name: str | None, table: Table
) -> list[TableForce]:
    """Return the forces of --grf-force, or the one with the foot's name, or []."""
    names = ", ".join(force.name for force in forces) or "none"
    if source_name is not None:
        chosen = []
        for name in source_name.split(","):
            plain = name.strip().removesuffix("_v").rstrip("_")
            matches = [force for force in forces if force.name == plain]
            if len(matches) != 1:
                raise InputError(
                    f"has no force '{name.strip()}' (it has {names})", table.path, "--grf-force"
                )
            chosen += matches
        return chosen
    matches = [f for f in forces if re.search(rf"(^|_){side[0]}(_|$)|{side}", f.name.lower())]
    return matches if len(matches) == 1 else []


def _which_foot(forces: list[TableForce], side: str, table: Table) -> InputError:
    names = ", ".join(force.name for force in forces) or "none"
    return InputError(
        f"does not say which force is the {side} foot's (it has {names})",
        table.path,
        f"give --grf-force, or name its columns after the foot: ground_force_{side[0]}_vx",
    )


def _recorded(table: Table, force: TableForce, axes: str) -> RecordedForce:
    columns = {"time": "time", **force.columns}
    source = GroundReactionTable(
        file=table.path,
        columns=columns,
        length_unit="m",
        laboratory_axes=axes,
        cutoff_Hz="none",
        unloaded_N=HOLD_BELOW,
    )
    time, wrench, level = recorded_wrench(source)
    loaded = around_load(np.linalg.norm(wrench[:, :3], axis=1), time)
    drift = unloaded_level(wrench[:, 1], loaded, time)
    return RecordedForce(force.name, f"force {force.name}", time, wrench, level, drift)


def _table_file(
    path: Path, axes: str, chosen: list[TableForce], recorded: list[RecordedForce]
) -> GroundFile:
    """One force is read from the user's table, several are summed in a new one."""
    if len(chosen) == 1:
        names = chosen[0].columns
        columns = (("time", "time"), *((k, names[k]) for k in COLUMNS[1:] if k in names))
        return GroundFile(path, axes, (), columns, "m")
    return GroundFile(path, "+x,+y,+z", (), (), "m", made=_summed(recorded, path))


def _summed(recorded: list[RecordedForce], path: Path) -> str:
    time = recorded[0].time
    levels = [force.level for force in recorded]
    wrenches = []
    for source in recorded:
        loaded = around_load(np.linalg.norm(source.wrench[:, :3], axis=1), time)
        wrenches.append(np.where(loaded[:, None], source.wrench, 0.0))
    level = float(np.mean(levels))
    point, moment, force = summed_reaction(time, wrenches, level, HOLD_BELOW, path)
    rows = np.column_stack([time, force, point, moment])
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
    return "\n".join([",".join(COLUMNS), *lines, ""])


def common_interval(
    time: Array, interval: Interval | None, span: Interval | None
) -> tuple[Interval | None, list[str]]:
    """Return the interval shared by motion and ground reaction, and a remark if it is shorter than
    the requested one.

    Args:
        time: times of the motion, s, (n,).
        interval: requested start and end, s; None: all of the motion.
        span: times of the ground reaction's first and last sample, s; None: the ground reaction
            is from the recording of the motion.
    """
    start, end = interval or (float(time[0]), float(time[-1]))
    if span is None or (span[0] <= start + 1e-9 and span[1] >= end - 1e-9):
        return interval, []
    inside = time[(time >= max(start, span[0]) - 1e-9) & (time <= min(end, span[1]) + 1e-9)]
    if len(inside) < 2:
        raise InputError(
            f"the motion lasts from {start:.4f} to {end:.4f} s, the ground reaction from "
            f"{span[0]:.4f} to {span[1]:.4f} s",
            "--grf",
            "give files of one trial, recorded on one clock",
        )
    common = (float(inside[0]), float(inside[-1]))
    return common, [
        f"ATTENTION: the ground reaction was recorded from {span[0]:.4f} to {span[1]:.4f} s, the "
        f"motion from {start:.4f} to {end:.4f} s: {common[0]:.4f} to {common[1]:.4f} s are used"
    ]


def _load_line(load: Load) -> str:
    if not load.side:
        return (
            f"ATTENTION: {load.title}: loaded from {load.start:.3f} to {load.end:.3f} s, and no "
            "foot's markers are near: not used"
        )
    other = "" if np.isnan(load.other) else f", {load.other * 1e3:.0f} mm from the other foot's"
    step = (
        f"; the foot stands on a step, about {load.surface:.2f} m above the plate: the measured "
        "wrench is kept, with its point of application at that height"
        if load.surface
        else ""
    )
    return (
        f"{load.title}: {load.side} foot from {load.start:.3f} to {load.end:.3f} s "
        f"(centre of pressure {load.distance * 1e3:.0f} mm from that foot's markers{other}){step}"
    )


def _interval_line(request: ImportRequest, interval: Interval) -> str:
    why = "as given" if request.interval else "from the first to the last load on these plates"
    return f"interval: {interval[0]:.4f} to {interval[1]:.4f} s of the recording's clock, {why}"


def _unmeasured_line(
    loads: list[Load], plates: tuple[int | str, ...], feet: Feet, side: str, interval: Interval
) -> list[str]:
    times = unmeasured(loads, plates, feet, side, interval)
    if not len(times):
        return []
    return [
        f"ATTENTION: in {len(times)} frames, first at {times[0]:.3f} s, the foot is nearly still "
        "but not on its plates: it may stand on an unmeasured surface"
    ]


def _drift_lines(forces: list[RecordedForce], plates: tuple[int | str, ...]) -> list[str]:
    return [
        f"ATTENTION: {force.title} reads {force.drift:.1f} N while nobody stands on it: it drifts, "
        "and its force under the foot is too large by that amount"
        for force in forces
        if force.key in plates and abs(force.drift) > DRIFT_N
    ]


def _columns_line(path: Path, side: str, chosen: list[TableForce], why: str) -> str:
    names = ", ".join(f"{force.name}_v*, {force.name}_p*" for force in chosen)
    moments = [name for force in chosen for name in force.moments]
    free = f"moments {', '.join(moments)}" if moments else "no moments"
    return f"ground reaction of the {side} foot: {names} of {path.name}, N and m, {why}; {free}"


def _listed(numbers: tuple[int, ...]) -> str:
    return ", ".join(map(str, numbers))


# %: share of the loaded samples that must lie under the foot. A few samples at foot
# strike and toe-off have a noisy centre of pressure.
PERCENTILE = 95.0
# Number of loaded samples that are compared. They are dense in one stance.
SAMPLES = 400
# 1: share of the loaded samples that a shift must bring into the times of the motion.
# A motion may be cut out of a longer recording.
SHARE = 0.5
# s: step of the shifts that are tried. A foot in stance hardly moves in it.
STEP_S = 0.02


def check_clocks(forces: list[RecordedForce], feet: Feet, side: str, path: Path) -> None:
    """Raise an InputError if this foot's forces lie under it only with a shifted clock."""
    time, point = _loaded_points(forces)
    middle = feet.middles[side]
    if not len(time) or not np.isfinite(middle).any():
        return
    apart, share = _distance(time, point, feet.time, middle)
    if share == 0.0 or apart <= MAX_FOOT_DISTANCE:
        return
    starts = [feet.time[0] - force.time[0] for force in forces]
    length = float(np.ptp(feet.time))
    shifts = [*starts, *np.arange(-length, length, STEP_S) - (time[0] - feet.time[0])]
    for shift in shifts:
        moved, share = _distance(time + shift, point, feet.time, middle)
        if share > SHARE and moved <= MAX_FOOT_DISTANCE:
            raise InputError(
                f"its centres of pressure lie up to {apart:.3g} m from the {side} foot, but under "
                f"it if {shift:+.3f} s is added to the times: force and motion are on two clocks",
                path,
                f"write the times of {feet.path.name} into it",
            )


def _loaded_points(forces: list[RecordedForce]) -> tuple[Array, Array]:
    """Return times (n,), s, and centres of pressure (n, 3), m, under load."""
    times = [force.time[force.loaded] for force in forces]
    points = [force.point[force.loaded] for force in forces]
    time, point = np.concatenate(times), np.concatenate(points)
    every = max(len(time) // SAMPLES, 1)
    return time[::every], point[::every]


def _distance(time: Array, point: Array, clock: Array, middle: Array) -> tuple[float, float]:
    """Return the horizontal distance (m) that `percentile` of the points keep from the foot, and
    their share.

    Args:
        time: (n,) s, times of the points.
        point: (n, 3) m.
        clock: (k,) s, times of the motion.
        middle: (k, 3) m, the foot.
    """
    seen = np.isfinite(middle).all(axis=1)
    inside = (time >= clock[seen][0]) & (time <= clock[seen][-1])
    if not inside.any():
        return np.inf, 0.0
    foot = [np.interp(time[inside], clock[seen], middle[seen, k]) for k in (0, 2)]
    apart = np.hypot(point[inside, 0] - foot[0], point[inside, 2] - foot[1])
    return float(np.percentile(apart, PERCENTILE)), float(inside.mean())
