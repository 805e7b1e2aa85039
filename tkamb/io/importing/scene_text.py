"""Files and options of an import, and the text of its scene file with all inferred values."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tkamb.geometry.frames import Array
from tkamb.io.importing.links import Links, body_link
from tkamb.io.importing.markers import ModelSegment
from tkamb.io.importing.recorded_poses import (
    MOTION_FILE,
    PoseRecording,
    RecordedPoses,
    ShankMarkers,
    motion_tables,
)
from tkamb.io.importing.soft_tissue import End, SoftTissue
from tkamb.io.recordings.laboratory import GivenUnits
from tkamb.io.scene.parts import wrap_table
from tkamb.io.toml_text import toml_markers, toml_mm, toml_value
from tkamb.units import DEGREE

GROUND_FILE = "ground_reaction.csv"
"""Name of the file in the scene's folder with a ground reaction that is a sum of table forces."""


@dataclass(frozen=True)
class Meshes:
    """Files of the implant's meshes, with their unit and their axes.

    Args:
        insert: mesh of the insert.
        patella: mesh of the patellar button; None without a button.
        unit: "m", "cm", "mm" or "inch".
        axes: axes of the meshes that point anterior, superior and right, like "+x,+y,+z".
        femur_bone: mesh of the femur in the axes of the femur's body, for wrapping; None: none.
    """

    femoral: Path
    insert: Path
    patella: Path | None
    unit: str
    axes: str
    femur_bone: Path | None = None


@dataclass(frozen=True, eq=False)
class GroundFile:
    """Source of the ground reaction: plates of a C3D file, or columns of a table.

    Args:
        axes: axes of the file that point forward, up and right.
        columns: (role, name) of each column of a table.
        length_unit: unit of lengths in the table; None: the unit that the file states.
        surface: height of the step under the foot above its plates, m; 0: no step.
        units: units that the user states because a C3D file does not.
        made: text of a table of summed forces that the import writes; None: the scene reads `path`.
    """

    path: Path
    axes: str
    plates: tuple[int, ...] = ()
    columns: tuple[tuple[str, str], ...] = ()
    length_unit: str | None = None
    surface: float = 0.0
    units: GivenUnits = field(default_factory=GivenUnits)
    made: str | None = None


@dataclass(frozen=True, eq=False)
class MarkerFile:
    """A recording of markers, and the options with which the scene reads it.

    Args:
        axes: axes of the file that point forward, up and right.
        method: fit of the markers, "segments" or "chain".
        knee: joint of the chain, "hinge" or "free".
        interval: start and end, s; None: the whole recording.
        frames: number of frames at equal intervals; None: all frames of the recording.
        length_unit: unit of lengths that the user states; None: the unit that the file states.
        whole_labels: whether the scene names markers with their prefix.
    """

    path: Path
    axes: str
    segments: tuple[ModelSegment, ...]
    method: str
    knee: str
    interval: tuple[float, float] | None
    frames: int | None = None
    length_unit: str | None = None
    whole_labels: bool = False


@dataclass(frozen=True, eq=False)
class SceneText:
    """Content of the scene.

    The motion comes from `markers` or `poses`, and from `motion.csv` if there is neither.

    Args:
        folder: folder in which the scene will be written; paths in the scene are relative to it.
        side: side of the knee, "left" or "right".
        markers: recording of markers for knee and shank, or None.
        poses: recorded poses of the femoral component, or None.
        shank: markers that give the shank's pose, or None; needed with `poses`.
        ground: the ground reaction, or None.
        meshes: meshes of the implant, or None.
        activity: activity whose published peaks the report shows; None: no peaks.
        model: the .osim file, if all its muscles act; None: only the quadriceps acts.
        coordinates: file of the model's coordinates; None: they are fitted to the markers.
        cycle: times of 0 and 100 % of the gait cycle, s; "plates": from foot strikes on the
            plates; None: results are shown over time.
        uncertainty: deviations that a registration of the markers gives, as in [uncertainty].
    """

    title: tuple[str, ...]
    folder: Path
    side: str
    mass_kg: float
    urdf: str
    cutoff_Hz: float
    links: Links
    markers: MarkerFile | None
    poses: RecordedPoses | None
    shank: ShankMarkers | None
    ground: GroundFile | None
    meshes: Meshes | None
    tissue: SoftTissue
    contact: str
    activity: str | None
    notes: tuple[str, ...]
    model: Path | None = None
    coordinates: Path | None = None
    cycle: tuple[float, float] | Literal["plates"] | None = None
    uncertainty: dict[str, float] = field(default_factory=dict)

    def text(self) -> str:
        """Return the text of the scene file."""
        tables = [
            [f"# {line}" for line in self.title],
            self._patient(),
            self._motion(),
            *self._segments(),
            self.shank.lines(self._path(self.shank.path)) if self.shank else [],
            self._ground(),
            *self._implant(),
            self._muscles(),
            self._all_muscles(),
            self._ligaments(),
            self._contact(),
            self._uncertainty(),
            self._output(),
        ]
        return "\n\n".join("\n".join(lines) for lines in tables if lines) + "\n"

    def _path(self, path: Path) -> str:
        return toml_value(Path(os.path.relpath(path.absolute(), self.folder.absolute())).as_posix())

    def _patient(self) -> list[str]:
        return [
            "[patient]",
            f"urdf = {toml_value(self.urdf)}",
            f'side = "{self.side}"',
            f"mass_kg = {self.mass_kg:g}",
        ]

    def _motion(self) -> list[str]:
        m, neutral = self.markers, self.links.neutral
        if self.poses is not None:
            return self.poses.motion_lines(self._path(self.poses.given.file), self.cutoff_Hz)
        if m is None:
            head = ["[motion]", f'file = "{MOTION_FILE}"', 'interpretation = "coordinates"']
            head += ['angle_unit = "deg"', 'length_unit = "mm"', f"cutoff_Hz = {self.cutoff_Hz:g}"]
            return [*head, "", *motion_tables(self.meshes is not None)]
        lines = ["[motion]", f"file = {self._path(m.path)}", 'interpretation = "markers"']
        lines += [f'length_unit = "{m.length_unit}"'] if m.length_unit else []
        lines.append(f"cutoff_Hz = {self.cutoff_Hz:g}")
        if m.interval:
            lines.append(
                "# s, times of the file at which every surface under the foot was measured"
            )
            lines.append(f"interval_s = [{m.interval[0]:.9f}, {m.interval[1]:.9f}]")
        if m.frames:
            lines.append(
                "# every k-th frame: five frames per period of the cut-off frequency are enough"
            )
            lines.append(f"frames = {m.frames}")
        coordinates = ["flexion"] if self.meshes else _ALL
        lines += [
            "",
            "[motion.markers]",
            f'method = "{m.method}"  # "segments": shank and thigh separately; or "chain"',
            f'knee = "{m.knee}"',
            f"coordinates = {toml_value(coordinates)}",
            "# position and rotation of the straight knee in the model",
            f"neutral_mm = {toml_mm(neutral[:3])}",
            f"neutral_deg = {toml_value(neutral[3:5] / DEGREE, 3)}",
            f'laboratory_axes = "{m.axes}"',
        ]
        return lines

    def _segments(self) -> list[list[str]]:
        m = self.markers
        return [_segment(segment, m.whole_labels) for segment in m.segments] if m else []

    def _ground(self) -> list[str]:
        g = self.ground
        if g is None:
            return []
        file = toml_value(GROUND_FILE) if g.made else self._path(g.path)
        lines = ["[ground_reaction]", f"file = {file}"]
        lines += [f"plates = {list(g.plates)}"] if g.plates else []
        length = g.length_unit or g.units.length
        lines += [f'length_unit = "{length}"'] if length else []
        for key, unit in (("force_unit", g.units.force), ("moment_unit", g.units.moment)):
            lines += [f"{key} = {toml_value(unit)}"] if unit else []
        lines += [
            f'laboratory_axes = "{g.axes}"',
            f"cutoff_Hz = {self.cutoff_Hz:g}",
            "unloaded_N = 40.0",
        ]
        if g.surface:
            lines.append("# the foot stands on a step of about this height above the plate")
            lines.append(f"surface_mm = {round(g.surface * 1e3, -1):.0f}")
        if g.columns:
            lines += ["", "[ground_reaction.columns]"]
            lines += [f"{role} = {toml_value(column)}" for role, column in g.columns]
        return lines

    def _implant(self) -> list[list[str]]:
        m = self.meshes
        if m is None:
            return []
        parts: list[list[str]] = []
        for name, path in (("femoral", m.femoral), ("insert", m.insert), ("patella", m.patella)):
            if path is None:
                continue
            lines = [f"[implant.{name}]", f"mesh = {self._path(path)}", f'unit = "{m.unit}"']
            lines.append(f'axes = "{m.axes}"')
            if name == "insert":
                lines.append('bearing = "fixed"')
            if name == "patella":
                lines += _button(self.links.button_in_patella)
            parts.append(lines)
        return parts

    def _muscles(self) -> list[str]:
        t = self.tissue
        if not self._with_patella:
            return []
        assert t.quadriceps is not None and t.patellar_ligament is not None
        return [
            "[quadriceps]",
            _end("origin", t.quadriceps[0]),
            _end("insertion", t.quadriceps[1]),
            *self._bone(),
            "",
            "[patellar_ligament]",
            _end("proximal", t.patellar_ligament[0]),
            _end("distal", t.patellar_ligament[1]),
            f"length_mm = {t.ligament_length * 1e3:.3f}",
            "",
            "[patella]",
            'motion = "solved"',
        ]

    def _all_muscles(self) -> list[str]:
        if self.model is None:
            return []
        lines = [
            "# all muscles of the model share the load; see docs/muscles.md",
            "[muscles]",
            f"model = {self._path(self.model)}",
        ]
        if self.coordinates is not None:
            lines.append(f"coordinates = {self._path(self.coordinates)}")
        return lines

    def _bone(self) -> list[str]:
        m = self.meshes
        if m is None or m.femur_bone is None:
            return []
        link = toml_value(body_link(self.links.leg.femur[0]))
        mesh = f'mesh = {self._path(m.femur_bone)}, unit = "{m.unit}"'
        return [
            "# bone that the line may wrap, as well as the component",
            f"bone = {{ {mesh}, link = {link} }}",
        ]

    @property
    def _with_patella(self) -> bool:
        t, m = self.tissue, self.meshes
        return bool(m and m.patella and t.quadriceps and t.patellar_ligament)

    def _ligaments(self) -> list[str]:
        if self.tissue.bundles:
            lines: list[str] = []
            for b in self.tissue.bundles:
                lines += [
                    "",
                    "[[ligament]]",
                    f"name = {toml_value(b.name)}",
                    'law = "quadratic-toe"',
                ]
                lines += [_end("proximal", b.proximal), _end("distal", b.distal)]
                lines.append(f"stiffness_N_per_strain = {b.stiffness_N:g}")
                lines.append(f"slack_length_mm = {b.slack_length_m * 1e3:.4f}")
                if b.wraps:
                    tables = ", ".join(toml_value(wrap_table(wrap), 6) for wrap in b.wraps)
                    lines.append(f"wrap = [{tables}]")
            return lines[1:]
        if self.meshes is None:
            return []
        return [
            "# The model has none: a generic set, scaled to the implant, not the patient's own.",
            "[generic_ligaments]",
            'ligaments = ["MCL", "LCL", "PCL"]',
        ]

    def _contact(self) -> list[str]:
        if self.meshes is None:
            return []
        lines = [
            "[contact]",
            f'model = "{self.contact}"',
            "resolution_mm = 1.0",
            'material = "polyethylene"',
        ]
        if self.poses is not None:
            return lines
        return [
            *lines,
            "# not recorded: the equilibrium of contact, ligaments and muscle line gives them",
            'released = ["adduction", "axial_rotation", "ap", "ml"]',
        ]

    def _uncertainty(self) -> list[str]:
        if not self.uncertainty:
            return []
        values = [f"{key} = {value:g}" for key, value in self.uncertainty.items()]
        return ["# what the registration of the markers leaves open", "[uncertainty]", *values]

    def _output(self) -> list[str]:
        stride = self.poses is not None and self.poses.given.stride is not None
        axis = "cycle" if stride or self.cycle is not None else "time"
        lines = ["[output]", f'axis = "{axis}"']
        if self.cycle == "plates":
            lines.append("# 0 and 100 %: two foot strikes on the force plates")
        elif self.cycle is not None:
            lines.append(f"cycle_s = [{self.cycle[0]:g}, {self.cycle[1]:g}]")
        lines += [f"activity = {toml_value(self.activity)}"] if self.activity else []
        return [*lines, "notes = [", *(f"    {toml_value(note)}," for note in self.notes), "]"]


_ALL = ["flexion", "adduction", "axial_rotation", "ap", "si", "ml"]


def _end(key: str, end: End) -> str:
    return f"{key} = {{ link = {toml_value(end.link)}, point_mm = {toml_mm(end.point)} }}"


def _segment(segment: ModelSegment, whole_labels: bool) -> list[str]:
    lines = ["[[motion.markers.segment]]", f'name = "{segment.name}"']
    if segment.joint is not None and segment.centre is not None:
        lines += [
            f'joined_to = "{segment.joined_to}"',
            f"joint_mm = {toml_mm(segment.joint)}",
            f"centre_mm = {toml_mm(segment.centre)}",
        ]
    return [*lines, f"markers_mm = {toml_markers(segment.points, whole_labels)}"]


def _button(in_patella: Array | None) -> list[str]:
    from scipy.spatial.transform import Rotation

    if in_patella is None:
        return []
    angles = Rotation.from_matrix(in_patella[:3, :3]).as_euler("XYZ") / DEGREE
    return [
        f"position_mm = {toml_mm(in_patella[:3, 3])}",
        f"rotation_deg = {toml_value(angles, 3)}",
    ]


@dataclass(frozen=True)
class ImportRequest:
    """The files and options of an import. None: the option is inferred or not used.

    Args:
        side: side of the knee, "left" or "right".
        recording: .c3d or .trc file of markers, or .mot or .sto file of the model's coordinates.
        grf: table of ground reactions, used instead of a C3D file's plates.
        grf_force: names of the foot's forces in the table `grf`, separated by commas. A force's
            name is the common beginning of its column names.
        poses: recorded poses of the femoral component in the insert. The markers then give only
            the shank's pose.
        static: recording of a standing trial, which calibrates the markers' positions.
        register: whether the markers' positions are found together with the motion; None: if they
            misfit the model.
        companions: recordings of the same subject and markers that take part in the registration.
        knee: name of the femorotibial joint.
        frames: part of the implant -> name of its mesh's frame in the model.
        plates: numbers of the plates under the foot; (): no ground reaction.
        interval: start and end of the part of the recording to use, s.
        laboratory_axes: axes of the file that point forward, up and right.
        scale_mass: whether the model's masses are scaled to the subject's mass.
        method: method of fitting the markers, "segments" or "chain".
        cutoff_Hz: cut-off frequency of the low-pass filter of markers and plates.
        activity: activity whose published peaks the report shows; None: no peaks.
        prefix: prefix of the markers to use, if a label occurs with several prefixes.
        muscles: whether all muscles of the model share the load; otherwise only the quadriceps.
        cycle: times of 0 and 100 % of the gait cycle, s; "plates": two foot strikes on the plates.
        units: units that the user states because the file of the recording does not.
        straight_ligaments: whether the surfaces that ligaments wrap are left out.
    """

    model: Path
    side: str
    mass_kg: float
    recording: Path
    grf: Path | None = None
    grf_force: str | None = None
    poses: PoseRecording | None = None
    without: tuple[str, ...] = ()
    static: Path | None = None
    register: bool | None = None
    companions: tuple[Path, ...] = ()
    meshes: Meshes | None = None
    knee: str | None = None
    frames: dict[str, str | None] = field(default_factory=dict)
    plates: tuple[int, ...] | None = None
    interval: tuple[float, float] | None = None
    laboratory_axes: str | None = None
    scale_mass: bool | None = None
    method: str = "segments"
    cutoff_Hz: float = 6.0
    contact: str = "foundation"
    activity: str | None = None
    notes: tuple[str, ...] = ()
    prefix: str | None = None
    muscles: bool = False
    cycle: tuple[float, float] | Literal["plates"] | None = None
    units: GivenUnits = field(default_factory=GivenUnits)
    straight_ligaments: bool = False
