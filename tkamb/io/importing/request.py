"""The files and options of an import."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tkamb.io.importing.recorded_poses import PoseRecording
from tkamb.io.importing.scene_text import Meshes
from tkamb.io.recordings.unit_words import GivenUnits


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
