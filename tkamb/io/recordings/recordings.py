"""Descriptions of the recordings to be read: files, columns, units and marker positions, in SI.

Units of length and angle here are those of the files' columns; all other numbers are SI.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tkamb.geometry.frames import Array
from tkamb.io.recordings.filtering import Cutoff

Side = Literal["right", "left"]


@dataclass(frozen=True, eq=False)
class Patient:
    """The patient.

    Args:
        urdf: file of the chain.
        side: the knee that is modelled.
        mass: kg, of the body.
        sex: picks the de Leva table for segments without inertia.
        height: m.
    """

    urdf: Path
    side: Side
    mass: float
    sex: Literal["male", "female"] | None = None
    height: float | None = None


@dataclass(frozen=True, eq=False)
class MarkerSegment:
    """A segment with skin markers: shank, thigh, or a neighbour of one of them.

    Args:
        name: of the segment.
        markers: name -> (3,) m, in the segment's frame.
        weights: of the squared distances, where not 1.
        joined_to: the segment that carries a neighbour by a ball joint.
        joint: (3,) m, that joint in its frame.
        centre: (3,) m, the same in the neighbour's own frame.
    """

    name: str
    markers: dict[str, Array]
    weights: dict[str, float] = field(default_factory=dict)
    joined_to: str | None = None
    joint: Array | None = None
    centre: Array | None = None


@dataclass(frozen=True, eq=False)
class MarkerSet:
    """The markers of a leg.

    Args:
        method: the fit that is used: rigid fits of each segment, or the chain.
        knee: of the chain: flexion alone, or six freedoms.
        coordinates: knee coordinates that are taken from the markers.
        neutral_translation: (3,) m, constant ap, si, ml of a hinge.
        neutral_rotation: (2,) rad, constant axial rotation and adduction of a hinge.
        laboratory_axes: axes of the file that point forward, up and right.
        segment: shank, thigh and neighbours.
    """

    method: Literal["segments", "chain"]
    knee: Literal["hinge", "free"]
    coordinates: tuple[str, ...]
    neutral_translation: Array
    neutral_rotation: Array
    laboratory_axes: str
    segment: tuple[MarkerSegment, ...]


@dataclass(frozen=True, eq=False)
class MotionRecording:
    """The recorded motion of the knee.

    Args:
        file: the file.
        cutoff: Hz, low-pass of the differentiation.
        interpretation: what its columns are.
        format: a name of `tkamb.io.recordings.tables.READERS`; None: the suffix.
        markers: with "markers".
        sequence: of the rotations, with "pose".
        columns: role -> column name, where it differs from the role.
        signs_turned: roles that are read with the other sign.
        angle_unit: of the file.
        length_unit: of the file.
        interval: s, the part that is computed.
        cycle: s, the interval on which per cent of a cycle lie.
        cycle_offset_percent: per cent of the cycle at its start.
        frames: resample to so many.
    """

    file: Path
    cutoff: Cutoff
    interpretation: Literal["coordinates", "pose", "markers"] = "coordinates"
    format: str | None = None
    markers: MarkerSet | None = None
    sequence: str | None = None
    columns: dict[str, str] = field(default_factory=dict)
    signs_turned: tuple[str, ...] = ()
    angle_unit: str | None = None
    length_unit: str | None = None
    interval: tuple[float, float] | None = None
    cycle: tuple[float, float] | None = None
    cycle_offset_percent: float = 0.0
    frames: int | None = None


@dataclass(frozen=True, eq=False)
class JointCentre:
    """A joint centre from a neighbouring segment's markers, used as one more shank marker.

    Args:
        name: of the joint.
        markers: name -> (3,) m, in the neighbour's frame.
        centre: (3,) m, in the neighbour's frame.
        tibia: (3,) m, in the tibia link.
    """

    name: str
    markers: dict[str, Array]
    centre: Array
    tibia: Array


@dataclass(frozen=True, eq=False)
class ShankRecording:
    """How the shank stands in the laboratory.

    Args:
        kind: a lean, the columns of a pose, or markers.
        file: the file.
        columns: role -> column name.
        sequence: of the rotations of a pose.
        angle_unit: of the file.
        length_unit: of the file.
        cutoff: Hz; None: the motion's.
        ankle: (3,) m in the laboratory, of a lean.
        markers: name -> (3,) m, in the tibia link.
        joint_centre: more markers.
        laboratory_axes: axes of the file that point forward, up and right.
    """

    kind: Literal["sagittal", "pose", "markers"]
    file: Path
    columns: dict[str, str]
    sequence: str | None
    angle_unit: str
    length_unit: str | None
    cutoff: Cutoff | None
    ankle: Array
    markers: dict[str, Array]
    joint_centre: tuple[JointCentre, ...]
    laboratory_axes: str


@dataclass(frozen=True, eq=False)
class ForceRecording:
    """The force that the ground exerts on the foot.

    Args:
        file: the file.
        cutoff: Hz, low-pass.
        format: a name of `tkamb.io.recordings.tables.READERS`; None: the suffix.
        plates: of a C3D file.
        columns: role -> column name.
        length_unit: of the file.
        laboratory_axes: axes of the file that point forward, up and right.
        force: what the file's force acts on; that on the plate is the opposite of that on the foot.
        unloaded: N, vertical force below which the centre of pressure is held.
        surface: m, of a C3D file: height of the surface under the foot above the plates.
        force_unit: of a C3D file's force channels; None: the file states it.
        moment_unit: of its moment channels; None: the file states it.
    """

    file: Path
    cutoff: Cutoff
    format: str | None
    plates: tuple[int, ...]
    columns: dict[str, str]
    length_unit: str | None
    laboratory_axes: str
    force: Literal["on the foot", "on the plate"]
    unloaded: float
    surface: float
    force_unit: str | None = None
    moment_unit: str | None = None

    @property
    def sign(self) -> float:
        """Factor, 1 or -1, from the file's force and moment to those on the foot."""
        return -1.0 if self.force == "on the plate" else 1.0


@dataclass(frozen=True, eq=False)
class ForceMeasurement:
    """What an instrumented implant measured.

    Args:
        file: the file.
        columns: time, total, medial, lateral -> column name, or column -> factor of a sum.
        unit: of the forces.
        offset: s, added to the file's clock it is the motion's.
        format: a name of `tkamb.io.recordings.tables.READERS`; None: the suffix.
    """

    file: Path
    columns: dict[str, str | dict[str, float]]
    unit: str
    offset: float
    format: str | None


@dataclass(frozen=True, eq=False)
class EmgRecording:
    """Surface EMG and the processing of its envelopes.

    Args:
        file: a C3D file or a table.
        time: of a table: its column of times.
        offset: s, added to the file's clock it is the motion's.
        channels: channel -> muscles.
        high_pass: Hz, before rectifying.
        cutoff: Hz, low-pass after it.
        normalised_by: "recording", or channel -> value in its unit.
    """

    file: Path
    time: str
    offset: float
    channels: dict[str, tuple[str, ...]]
    high_pass: Cutoff
    cutoff: float
    normalised_by: Literal["recording"] | dict[str, float]
