"""The request of an import."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tkamb.io.importing.recorded_poses import PoseRecording
from tkamb.io.importing.scene_text import Meshes
from tkamb.io.recordings.unit_words import GivenUnits


@dataclass(frozen=True)
class ImportRequest:
    """Files and options of an import; None: inferred, or absent.

    Args:
        model: the .osim file.
        side: of the knee.
        mass_kg: of the subject.
        recording: .c3d or .trc; .mot or .sto of the model's coordinates.
        grf: table of ground reactions, instead of a C3D file's plates.
        grf_force: how the columns of the foot's forces begin in it, separated by commas.
        poses: of the femoral component in the insert; then the recording's markers place the
            shank alone.
        without: labels of markers that are not to be used.
        static: recording of a standing trial, from which the markers' places are calibrated.
        meshes: the implant's.
        knee: the femorotibial joint's name.
        frames: part -> frame of its mesh.
        plates: under the foot.
        interval: s, the part of the recording.
        laboratory_axes: the file's that point forward, up and right.
        scale_mass: whether the model's masses are scaled to the subject's.
        method: how the markers are fitted, "segments" or "chain".
        cutoff_Hz: of markers and plates.
        contact: the scene's contact model.
        activity: what the report compares with; None: with nothing.
        notes: of the user, for the report.
        prefix: of the markers' labels that are used, where several prefixes share a label.
        muscles: whether the scene has all muscles of the model, which share the load.
        cycle: s, 0 and 100 % of the gait cycle; "plates": two foot strikes of the plates.
        units: the recording's units, where it does not state them.
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
