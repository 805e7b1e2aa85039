"""Files and options of an import, and the text of its scene file with all inferred values."""

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import KNEE_COORDINATES
from tkamb.io.importing.links import Links, body_link
from tkamb.io.importing.markers import ModelSegment
from tkamb.io.importing.recorded_poses import (
    COLUMNS,
    MOTION_FILE,
    ROLES,
    PoseRecording,
    RecordedPoses,
    ShankMarkers,
)
from tkamb.io.importing.soft_tissue import SoftTissue
from tkamb.io.recordings.laboratory import GivenUnits
from tkamb.io.scene.parts import wrap_table
from tkamb.io.texts import environment
from tkamb.io.toml_text import toml_markers, toml_mm, toml_value
from tkamb.units import DEGREE

GROUND_FILE = "ground_reaction.csv"
"""File in the scene's folder with a sum of table forces."""


@dataclass(frozen=True)
class Meshes:
    """Files of the implant, with their unit and axes.

    Args:
        patella: mesh of the patellar button; None without a button.
        unit: "m", "cm", "mm" or "inch".
        axes: axes of the meshes that point anterior, superior and right, like "+x,+y,+z".
        femur_bone: mesh in the axes of the femur's body, for wrapping; None: none.
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
    """Content of the scene; None: without.

    The motion comes from `markers` or `poses`, and from `motion.csv` if there is neither.

    Args:
        folder: folder in which the scene will be written; paths in the scene are relative to it.
        markers: recording of markers for knee and shank, or None.
        poses: recorded poses of the femoral component, or None.
        shank: markers that give the shank's pose, or None; needed with `poses`.
        activity: activity whose published peaks the report shows; None: no peaks.
        model: the .osim file, if all its muscles act; None: only the quadriceps acts.
        coordinates: file of the model's coordinates; None: they are fitted to the markers.
        cycle: times of 0 and 100 % of the gait cycle, s; "plates": from foot strikes on the plates;
            None: results are shown over time.
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
        meshes, button = self.meshes, self.links.button_in_patella
        parts = (
            {"femoral": meshes.femoral, "insert": meshes.insert, "patella": meshes.patella}
            if (meshes)
            else {}
        )
        template = environment("tkamb.io.importing", html=False).overlay()
        template.filters = template.filters | {
            "toml": toml_value,
            "mm": toml_mm,
            "markers": toml_markers,
            "degrees": lambda angles: toml_value(angles / DEGREE, 3),
            "path": lambda path: toml_value(
                Path(os.path.relpath(path.absolute(), self.folder.absolute())).as_posix()
            ),
            "wraps": lambda wraps: toml_value([wrap_table(wrap) for wrap in wraps], 6),
        }
        text = template.get_template("scene.toml").render(
            s=self,
            motion_file=MOTION_FILE,
            ground_file=GROUND_FILE,
            motion_columns=dict(zip(KNEE_COORDINATES, COLUMNS, strict=False)),
            tibia_columns=dict(zip(ROLES, COLUMNS[6:], strict=True)),
            implant=[(name, path) for name, path in parts.items() if path is not None],
            button=button is not None
            and {
                "place": button[:3, 3],
                "angles": Rotation.from_matrix(button[:3, :3]).as_euler("XYZ"),
            },
            bone_link=body_link(self.links.leg.femur[0]),
        )
        return re.sub(r"\n{3,}", "\n\n", text).strip("\n") + "\n"


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
