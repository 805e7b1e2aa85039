"""Assignment of recorded forces to the feet, and the interval in which a foot's load is measured.

They are from the plates of a C3D file, or from a table, whose columns programs name in many ways:
`ground_force_1_vx`, `1_ground_force_px`, `ground_torque_1_y`, `ground_moment_1_mx`,
`ground_force_calcn_r_mx`, `f1_1`, `FP2_tz`. A column name contains the kind (force, point, moment),
the axis, and the name of a force. A moment column whose name fits no force is an error, unless
every force of the table has a moment of its own.
"""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.recordings.c3d import Recording
from tkamb.io.recordings.force_plates import around_load, unloaded_level
from tkamb.io.recordings.gait_cycle import uninterrupted_runs
from tkamb.io.recordings.laboratory import laboratory_rotation
from tkamb.io.recordings.markers import marker_trajectories
from tkamb.io.recordings.tables import Table

_KINDS = {"v": "force", "f": "force", "p": "point", "m": "moment", "t": "moment"}
_OF_MOMENT = re.compile(r"torque|moment|grm|free")
_OF_FORCE = re.compile(r"force|grf")
_OF_POINT = re.compile(r"cop|point|position")
_WORDS = re.compile(r"ground|reaction|force|torque|moment|free|grf|grm|cop|point|position|plate")
_NUMBERED = re.compile(r"(cop|[fpmt])_?(\d+)_?([xyz123])")
_NUMBERED_LAST = re.compile(r"(cop|[fpmt])_?([xyz])_?(\d+)")
_AXIS_LAST = re.compile(r"(?<!pelvis_t)[xyz]$")
_NAMED = re.compile(r"(.*?)([_. ]?)([vpfmt]?)([xyz])")


@dataclass(frozen=True)
class TableForce:
    """The columns of one force in a table.

    Args:
        name: common beginning of the column names.
        columns: role in a scene, like "force_1" or "moment_2" -> name of the column.
    """

    name: str
    columns: dict[str, str] = field(default_factory=dict)

    def has(self, kind: str) -> bool:
        """Return whether all three columns of a kind (force, point, moment) exist."""
        return all(f"{kind}_{k}" in self.columns for k in (1, 2, 3))

    @property
    def moments(self) -> tuple[str, ...]:
        """Names of the columns with the force's moment."""
        return tuple(v for k, v in self.columns.items() if k.startswith("moment"))


@dataclass(frozen=True)
class _Column:
    name: str
    kind: str
    axis: int
    owner: str
    stem: str


def table_forces(table: Table) -> list[TableForce]:
    """Return the forces of a table, in the order of their columns."""
    columns = [c for name in table.columns if (c := _parsed_column(name)) is not None]
    result: dict[str, TableForce] = {}
    for column in columns:
        if column.kind == "force":
            result.setdefault(column.owner, TableForce(column.stem))
    forces = {k for k in result if sum(c.owner == k and c.kind == "force" for c in columns) >= 3}
    unassigned = [c for c in columns if c.kind == "moment" and c.owner not in forces]
    is_single = len(forces) == 1 and not any(
        c.kind == "moment" and c.owner in forces for c in columns
    )
    if unassigned and is_single and len({c.owner for c in unassigned}) == 1:
        owner = next(iter(forces))
        columns = [
            _Column(c.name, c.kind, c.axis, owner, c.stem) if c in unassigned else c
            for c in columns
        ]
        unassigned = []
    for column in columns:
        if column.owner not in forces:
            continue
        role, names = f"{column.kind}_{column.axis}", result[column.owner].columns
        if role in names:
            raise InputError(
                f"has two columns for one axis of one {column.kind}: '{names[role]}' and "
                f"'{column.name}'",
                table.path,
                "rename or remove one",
            )
        names[role] = column.name
    _refuse_unassigned(table, unassigned, [result[k] for k in result if k in forces])
    return [result[k] for k in result if k in forces]


def _refuse_unassigned(table: Table, unassigned: list[_Column], forces: list[TableForce]) -> None:
    read = {name for force in forces for name in force.columns.values()}
    others = [
        name
        for name in (*table.columns, *table.equal)
        if name not in read and (_OF_MOMENT.search(name.lower()) or _AXIS_LAST.search(name.lower()))
    ]
    others += [column.name for column in unassigned if column.name not in others]
    lacking = [force.name for force in forces if not force.moments]
    if others and lacking:
        raise InputError(
            f"has a column of moments, '{others[0]}', that belongs to none of its forces "
            f"({', '.join(force.name for force in forces)})",
            table.path,
            f"name it after its force, like {lacking[0]}_mx, or remove it",
        )


def _parsed_column(name: str) -> _Column | None:
    """Return a column's parts, or None if it is no force, point or moment."""
    plain = name.lower().rstrip()
    if match := _NUMBERED.fullmatch(plain):
        kind, owner, axis = match.groups()
        return _Column(name, _kind(kind), "xyz123".index(axis) % 3 + 1, owner, f"{name[0]}{owner}")
    if match := _NUMBERED_LAST.fullmatch(plain):
        kind, axis, owner = match.groups()
        return _Column(name, _kind(kind), "xyz".index(axis) + 1, owner, f"{name[0]}{owner}")
    match = _NAMED.fullmatch(plain)
    if match is None:
        return None
    stem, separator, letter, axis = match.groups()
    if letter and not separator and (stem + letter).endswith(("moment", "cop")):
        stem, letter = stem + letter, ""
    if letter in ("m", "t", "f") and not (_WORDS.search(stem) or re.search(r"\d|fp", stem)):
        return None  # pelvis_tx is a coordinate
    kind = _KINDS.get(letter) or _kind_of_words(stem)
    if kind is None:
        return None
    owner = re.sub(r"[^a-z0-9]", "", _WORDS.sub("", stem))
    return _Column(name, kind, "xyz".index(axis) + 1, owner, name[: len(stem)].rstrip("_. "))


def _kind(letter: str) -> str:
    return "point" if letter == "cop" else _KINDS[letter]


def _kind_of_words(stem: str) -> str | None:
    for pattern, kind in ((_OF_MOMENT, "moment"), (_OF_POINT, "point"), (_OF_FORCE, "force")):
        if pattern.search(stem):
            return kind
    return None


# N: a plate is loaded above this vertical force. The noise of a plate is a few
# newtons.
MIN_FORCE = 40.0
# s: a shorter load is not a step. Shorter loads are knocks on the plate.
MIN_DURATION = 0.1
# m: largest horizontal distance from the centre of pressure to the mean position of the foot's
# markers. A foot is about this long.
MAX_FOOT_DISTANCE = 0.25
# m: a foot stands on a step if its markers are higher above the plate than this.
# The lowest stair of the data sets is 0.17 m high.
MIN_STEP_HEIGHT = 0.15
# m: mean height of a foot's markers above the surface under the foot. It is a usual
# value on level ground.
MARKER_HEIGHT = 0.055
# m: two surfaces with a smaller difference in height are one step. The steps of
# stairs differ by more.
SAME_HEIGHT = 0.05
# m/s: a foot off the plates that is slower than this may stand on an unmeasured surface.
# A swinging foot is faster.
MAX_STANDING_SPEED = 0.15


@dataclass(frozen=True, eq=False)
class RecordedForce:
    """A recorded force in the laboratory's frame (x forward, y up, z right).

    Args:
        key: number of the plate, or name of the table's force.
        time: times, s, (k,).
        wrench: force (N) and moment (N·m) about the laboratory's origin, (k, 6).
        level: height of the plate's surface, m.
        drift: vertical force that the unloaded plate reads, N.
    """

    key: int | str
    title: str
    time: Array
    wrench: Array
    level: float
    drift: float = 0.0

    @property
    def point(self) -> Array:
        """(k, 3) m, centre of pressure on the surface; NaN while it is unloaded."""
        force, moment = self.wrench[:, :3], self.wrench[:, 3:]
        vertical = np.where(self.loaded, force[:, 1], np.nan)
        x = (moment[:, 2] + self.level * force[:, 0]) / vertical
        z = (self.level * force[:, 2] - moment[:, 0]) / vertical
        return np.stack([x, np.full_like(x, self.level), z], axis=1)

    @property
    def loaded(self) -> np.ndarray:
        """(k,) whether the surface is loaded."""
        return np.asarray(self.wrench[:, 1] - self.drift > MIN_FORCE)

    @property
    def pushes_down(self) -> bool:
        """Whether the vertical force points down while the surface is loaded."""
        down = self.wrench[:, 1] < -MIN_FORCE
        step = float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0
        long_enough = down.sum() * step >= MIN_DURATION
        return bool(long_enough and down.sum() > self.loaded.sum())

    @property
    def turned(self) -> "RecordedForce":
        """The force with the opposite sign."""
        return replace(self, wrench=-self.wrench, drift=-self.drift)


@dataclass(frozen=True)
class Load:
    """One uninterrupted load of a plate.

    Args:
        plate: number of the plate, or name of the table's force.
        side: "left" or "right" foot; "": no foot's markers are near.
        start: time of the load's first sample, s.
        end: time of the load's last sample, s.
        distance: median distance from the centre of pressure to the nearest foot's markers, m.
        other: median distance to the other foot's markers, m; NaN without such markers.
        surface: approximate height of the step under the foot above the plate, m; 0: no step.
    """

    plate: int | str
    title: str
    side: str
    start: float
    end: float
    distance: float
    other: float
    surface: float


@dataclass(frozen=True, eq=False)
class Feet:
    """Positions of the feet.

    Args:
        time: times, s, (n,).
        middles: side -> mean position of the foot's markers in the laboratory, m, (n, 3); NaN where
            no marker is visible.
    """

    path: Path
    time: Array
    middles: dict[str, Array]


def marked_feet(recorded: Table, axes: str, labels: dict[str, list[str]]) -> Feet:
    """Return the positions of the feet by their markers.

    Args:
        axes: axes of the file that point forward, up and right, like "-x,+z,+y".
        labels: side -> labels of the foot's markers.
    """
    rotation = laboratory_rotation(axes, recorded.path)
    middles = {side: _middle(recorded, names) @ rotation.T for side, names in labels.items()}
    return Feet(recorded.path, recorded.time(), middles)


def plate_forces(recording: Recording, axes: str) -> list[RecordedForce]:
    """Return the forces on a recording's plates, in the laboratory's frame.

    `axes` are the axes of the file that point forward, up and right.
    """
    rotation = laboratory_rotation(axes, recording.path)
    time = recording.analog_time
    forces = []
    for plate in recording.plates:
        wrench = (plate.wrench.reshape(-1, 2, 3) @ rotation.T).reshape(-1, 6)
        loaded = around_load(np.linalg.norm(wrench[:, :3], axis=1), time)
        drift = unloaded_level(wrench[:, 1], loaded, time)
        level = float((rotation @ plate.centre)[1])
        title = f"force plate {plate.number}"
        forces.append(RecordedForce(plate.number, title, time, wrench, level, drift))
    return forces


def feet_loads(forces: list[RecordedForce], feet: Feet) -> list[Load]:
    """Return all loads of all forces in order of time, each with the nearest foot."""
    loads = []
    for source in forces:
        middles = {s: _interpolated(m, feet.time, source.time) for s, m in feet.middles.items()}
        point = source.point
        for first, last in uninterrupted_runs(source.loaded):
            if source.time[last] - source.time[first] >= MIN_DURATION:
                part = slice(first, last + 1)
                positions = {side: middle[part] for side, middle in middles.items()}
                line = (source.time[part], point[part], source.wrench[part, :3])
                loads.append(_load(source, *line, positions))
    return sorted(loads, key=lambda load: load.start)


def _load(
    source: RecordedForce, time: Array, point: Array, force: Array, middles: dict[str, Array]
) -> Load:
    """On a step, the centre of pressure is where the force's line meets the step."""
    distances, surface = {}, {}
    for side, middle in middles.items():
        above = middle[:, 1] - point[:, 1]
        height = float(np.nanmedian(above)) if np.isfinite(above).any() else 0.0
        surface[side] = height - MARKER_HEIGHT if height > MIN_STEP_HEIGHT else 0.0
        place = point + force / force[:, 1:2] * surface[side]
        distance = np.linalg.norm((place - middle)[:, [0, 2]], axis=1)
        distances[side] = float(np.nanmedian(distance)) if np.isfinite(distance).any() else np.nan
    nearest = min(distances, key=lambda side: np.nan_to_num(distances[side], nan=np.inf))
    others = [distance for side, distance in distances.items() if side != nearest]
    foot = nearest if distances[nearest] < MAX_FOOT_DISTANCE else ""
    start, end = float(time[0]), float(time[-1])
    distance, other = distances[nearest], others[0]
    return Load(source.key, source.title, foot, start, end, distance, other, surface[nearest])


def own_plates(
    loads: list[Load], side: str, path: Path, hint: str = "give --plates and --interval"
) -> tuple[int | str, ...]:
    """Return the plates on which only this foot stood."""
    foot_plates = list(dict.fromkeys(load.plate for load in loads if load.side == side))
    others = {load.plate for load in loads if load.side != side}
    shared = [load.title for load in loads if load.plate in foot_plates and load.plate in others]
    if shared:
        what = f"both feet stood on {shared[0]}"
        if any(load.plate in foot_plates and not load.side for load in loads):
            what = f"{shared[0]} is also loaded by a foot without markers"
        raise InputError(what, path, f"{hint}, or take another trial")
    if not foot_plates:
        unknown_loads = [load for load in loads if not load.side]
        what = f"no force plate was under the {side} foot"
        if unknown_loads:
            what += (
                f": {unknown_loads[0].title} is loaded from {unknown_loads[0].start:.2f} to "
                f"{unknown_loads[0].end:.2f} s, but no foot's markers are within "
                f"{MAX_FOOT_DISTANCE:g} m of its centre of pressure"
            )
            hint = f"check --laboratory-axes and the foot's labels, or {hint}"
        raise InputError(what, path, f"{hint}, or take another trial")
    return tuple(sorted(foot_plates, key=str))


def check_upward(forces: list[RecordedForce], feet: Feet, side: str) -> list[str]:
    """Return a line on each plate whose force points down under the other foot."""
    lines = []
    for force in forces:
        if not force.pushes_down:
            continue
        largest = -float(np.nanmin(force.wrench[:, 1]))
        what = f"{force.title}: the vertical force points down, with up to {largest:.0f} N"
        if {load.side for load in feet_loads([force.turned], feet)} & {side, ""}:
            raise InputError(
                what,
                feet.path,
                "reverse the sign of its channels (ANALOG:SCALE), or take another trial",
            )
        lines.append(f"ATTENTION: {what}: not used")
    return lines


def common_surface(loads: list[Load], plates: tuple[int | str, ...]) -> float:
    """Return the mean height of the step under the foot, m, or 0 if the loads' heights differ."""
    heights = [load.surface for load in loads if load.plate in plates]
    return float(np.mean(heights)) if np.ptp(heights) < SAME_HEIGHT else 0.0


def known_interval(
    loads: list[Load], plates: tuple[int | str, ...], feet: Feet
) -> tuple[float, float]:
    """Return the times, s, of the first and last frame of the foot's loads."""
    foot_loads = [load for load in loads if load.plate in plates]
    start = min(load.start for load in foot_loads)
    end = max(load.end for load in foot_loads)
    inside = feet.time[(feet.time >= start - 1e-9) & (feet.time <= end + 1e-9)]
    if len(inside) < 2:
        raise InputError(
            f"has no two frames while the foot is loaded, {start:.3f} to {end:.3f} s",
            feet.path,
            "give force and markers of one trial",
        )
    return float(inside[0]), float(inside[-1])


def unmeasured(
    loads: list[Load],
    plates: tuple[int | str, ...],
    feet: Feet,
    side: str,
    interval: tuple[float, float],
) -> Array:
    """Return the times, s, at which the foot is nearly still but on no plate."""
    time = feet.time
    speed = np.linalg.norm(np.gradient(feet.middles[side], time, axis=0), axis=1)
    loaded = np.zeros(len(time), bool)
    for load in loads:
        if load.plate in plates:
            loaded |= (time >= load.start - 0.02) & (time <= load.end + 0.02)
    inside = (time >= interval[0]) & (time <= interval[1])
    return np.asarray(time[inside & ~loaded & (speed < MAX_STANDING_SPEED)])


def _middle(table: Table, labels: list[str]) -> Array:
    """Return the mean position (n, 3) m of visible markers; NaN without any."""
    rows = table.rows
    if not labels:
        return np.full((rows, 3), np.nan)
    points = marker_trajectories(table, labels, table.unit_scale(None, "length_unit"))
    visible = np.asarray(np.isfinite(points).all(axis=2))
    total = np.where(visible[:, :, None], points, 0.0).sum(axis=1)
    count = visible.sum(axis=1).astype(float)
    count[count == 0] = np.nan
    return np.asarray(total / count[:, None])


def _interpolated(values: Array, time: Array, at: Array) -> Array:
    columns = [np.interp(at, time, values[:, k], left=np.nan, right=np.nan) for k in range(3)]
    return np.stack(columns, axis=1)
