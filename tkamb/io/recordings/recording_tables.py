"""Tables of the scene for the patient and the recordings, and their base class, units and limits.

Units are in the key names; the code that uses a value converts it to SI.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, model_validator

LengthUnit = Literal["m", "cm", "mm", "inch"]
AngleUnit = Literal["rad", "deg"]
Number = Annotated[float, Strict()]
"""A number. `true` and a number in quotes are refused."""
Count = Annotated[int, Strict()]
Switch = Annotated[bool, Strict()]
Vector = tuple[Number, Number, Number]
PatellaFreedom = Literal["ap", "si", "shift", "flexion", "tilt", "rotation"]
KneeFreedom = Literal["ap", "si", "ml", "axial_rotation", "adduction"]
Closing = Literal["interpolate", "there-and-back", "as recorded"]
"""How recorded frames become a cycle of wear, see `tkamb.studies.wear.motion`."""
DEFAULT_CLOSING: Closing = "interpolate"


def _axes(text: str) -> str:
    names = [part.strip() for part in text.split(",")]
    if len(names) != 3 or sorted(n.lstrip("+-") for n in names) != ["x", "y", "z"]:
        raise ValueError(
            "must name three different axes for anterior, superior and right, e.g. '-x,+y,-z'"
        )
    return ",".join(n if n[0] in "+-" else f"+{n}" for n in names)


Axes = Annotated[str, AfterValidator(_axes)]


def within(low: float, high: float, hint: str) -> Any:
    """Return the annotation of a number, or of a vector, with values from `low` to `high`."""

    def checked(value: Any) -> Any:
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and not low <= number <= high:
                raise ValueError(f"{number:g} is not within {low:g} to {high:g}; {hint}")
        return value

    return AfterValidator(checked)


def zero_or_within(low: float, high: float, hint: str) -> Any:
    """Return the annotation of a number that is zero, or from `low` to `high`."""

    def checked(value: float) -> float:
        if value != 0 and not low <= value <= high:
            raise ValueError(f"{value:g} is neither 0 nor within {low:g} to {high:g}; {hint}")
        return value

    return AfterValidator(checked)


HalfThickness = Annotated[Number, zero_or_within(0.2, 20, "give it in millimetres")]
"""mm: distance of a tendon's centre line from the outline that it wraps; zero: no thickness."""
Band = Annotated[Number, zero_or_within(0.1, 50, "give it in millimetres")]
"""mm: distance up to which a tendon wraps sections beside its sagittal plane; zero: this plane
only."""
Point = Annotated[Vector, within(-1000, 1000, "give it in millimetres")]
"""mm: point on a bone of at most 0.6 m, or an origin beside it."""
Offset = Annotated[Vector, within(-600, 600, "give it in millimetres")]
"""mm: position of a mesh's origin in a link, within the length of a bone."""
Turn = Annotated[Vector, within(-360, 360, "give it in degrees")]


def _known_format(name: str) -> str:
    from tkamb.io.recordings.tables import READERS

    if name not in READERS:
        raise ValueError(f"unknown table format '{name}', use {', '.join(READERS)}")
    return name


TableFormat = Annotated[str, AfterValidator(_known_format)]
FORMAT = "csv, sto, mot, trc or c3d; default: the suffix"


class SceneTable(BaseModel):
    """A table of the scene file: frozen, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Side = Literal["right", "left"]


class PatientTable(SceneTable):
    """The patient. The URDF holds the chain of ankle, tibia, femur and patella."""

    urdf: Path
    side: Side = Field(description="the knee that is modelled")
    # limits: from a six-year-old child with a tumour prosthesis to the heaviest patients
    mass_kg: Annotated[Number, within(20, 300, "give it in kilograms")] = Field(
        description="body mass, 20 to 300; forces in BW are relative to it"
    )
    sex: Literal["male", "female"] | None = Field(
        None, description="selects the de Leva table, for segments without <inertial>"
    )
    # limits: from the same child to very tall adults
    height_mm: Annotated[
        Number | None, within(1000, 2300, "give the standing height in millimetres")
    ] = Field(None, description="body height, 1000 to 2300")
    scale: Annotated[Number, within(0.7, 1.4, "1 is the patient as recorded")] = Field(
        1.0,
        description=(
            "scale factor of a synthetic patient of the same shape: lengths, implants and knee "
            "translations are multiplied by it, masses and ground reaction by its cube; mass_kg "
            "and height_mm are those of the recorded patient"
        ),
    )


class MarkerSegmentTable(SceneTable):
    """A segment with skin markers: the shank, the thigh, or a neighbour of one of them."""

    name: str = Field(description="'shank', 'thigh', or the name of a neighbour of one of them")
    markers_mm: dict[str, Vector] = Field(
        min_length=1,
        description="marker -> position in the tibia link (shank), the femur link (thigh) or the "
        "neighbour's own frame",
    )
    weights: dict[str, float] = Field(
        default_factory=dict, description="marker -> weight of its squared distance; default 1"
    )
    joined_to: Literal["shank", "thigh"] | None = Field(
        None, description="for a neighbour: the segment that a ball joint connects it to"
    )
    joint_mm: Vector | None = Field(None, description="the ball joint in that segment's link")
    centre_mm: Vector | None = Field(
        None, description="the ball joint in the neighbour's own frame"
    )

    @model_validator(mode="after")
    def _joint_is_complete(self) -> Self:
        knee = self.name in ("shank", "thigh")
        present = [v is not None for v in (self.joined_to, self.joint_mm, self.centre_mm)]
        if any(present) if knee else not all(present):
            raise ValueError(
                "a neighbour needs 'joined_to', 'joint_mm' and 'centre_mm'; shank and thigh have "
                "none of them"
            )
        for name, weight in self.weights.items():
            if name not in self.markers_mm:
                raise ValueError(f"a weight for '{name}', which is no marker of '{self.name}'")
            if not weight >= 0:
                raise ValueError(f"the weight of '{name}' is negative")
        return self


class MarkersTable(SceneTable):
    """The knee's motion and the shank in the laboratory, from skin markers."""

    method: Literal["segments", "chain"] = Field(
        description="'segments': separate rigid fits of shank and thigh; 'chain': one fit of all "
        "segments, connected by their joints. Both are computed and compared"
    )
    knee: Literal["hinge", "free"] = Field(
        "hinge", description="the chain's knee: flexion alone, or six degrees of freedom"
    )
    coordinates: tuple[Literal["flexion", "adduction", "axial_rotation", "ap", "si", "ml"], ...] = (
        Field(
            ("flexion",),
            min_length=1,
            description="knee coordinates that follow from the markers; [contact] releases the "
            "others",
        )
    )
    neutral_mm: Vector = Field(
        description="constant ap, si, ml of the femur link in the insert frame, for a hinge"
    )
    neutral_deg: tuple[float, float] = Field(
        (0.0, 0.0), description="constant axial rotation and adduction of a hinge"
    )
    laboratory_axes: Axes = Field(
        "+x,+y,+z", description="axes of the file that point forward, up and right"
    )
    segment: tuple[MarkerSegmentTable, ...] = Field(description="shank, thigh and neighbours")

    @model_validator(mode="after")
    def _shank_and_thigh(self) -> Self:
        names = [segment.name for segment in self.segment]
        if len(names) != len(set(names)):
            raise ValueError("two segments have the same name")
        if missing := {"shank", "thigh"} - set(names):
            raise ValueError(f"segment '{min(missing)}' is missing")
        if "flexion" not in self.coordinates:
            raise ValueError("'coordinates' lacks flexion")
        return self


class MotionTable(SceneTable):
    """The knee's recorded motion.

    `interpretation = "coordinates"`: columns are the six knee coordinates (Grood-Suntay) of
    the femoral component in the insert frame. `"pose"`: columns are a rotation sequence and
    a translation, the pose of the femoral mesh in the insert mesh's axes. `"markers"`: skin
    markers of shank and thigh, see [motion.markers]. They also give the pose of the shank.
    """

    file: Path
    motion: Literal["recorded", "roll-slip"] = Field(
        "recorded",
        description=(
            "'roll-slip' (Sharma 2008): rotations and ML as recorded, AP from rolling plus slip, "
            "SI from first touch; needs the implant"
        ),
    )
    slip_share: Number = Field(
        1.0, ge=0, le=10, description="roll-slip: share of the recorded slip; 0 is pure rolling"
    )
    format: TableFormat | None = Field(None, description=FORMAT)
    interpretation: Literal["coordinates", "pose", "markers"] = "coordinates"
    markers: MarkersTable | None = Field(None, description="with interpretation = 'markers'")
    sequence: str | None = Field(
        None,
        pattern="^([xyz]{3}|[XYZ]{3})$",
        description="pose only: upper case = intrinsic, as in scipy ('XYZ' is Rx Ry Rz)",
    )
    columns: dict[str, str] = Field(
        default_factory=dict,
        description=(
            "role -> column name, where it differs from the role. Roles: time (s), flexion, "
            "adduction, axial_rotation, ap, si, ml (coordinates); time, rotation_1..3, "
            "translation_1..3 (pose); patella_ap, patella_si, patella_rotation. Coordinates that "
            "[contact] releases need no column"
        ),
    )
    signs_turned: tuple[str, ...] = Field(
        (),
        description=(
            "roles whose columns are multiplied by -1, for a file with the opposite sign convention"
        ),
    )
    angle_unit: AngleUnit | None = Field(
        None, description="unit of angles in the file; not for markers"
    )
    length_unit: LengthUnit | None = Field(
        None, description="unit of lengths in the file; .trc and .c3d files state it"
    )
    cutoff_Hz: Number | Literal["none"] = Field(
        description="cut-off of the low-pass filter; 'none': the samples are not filtered"
    )
    interval_s: tuple[Number, Number] | None = Field(
        None, description="part of the recording to compute; default: all"
    )
    cycle_s: tuple[Number, Number] | None = Field(
        None,
        description="start and end of the cycle, if the time column of the file is per cent",
    )
    cycle_offset_percent: Number = Field(
        0.0, ge=-100, le=100, description="per cent of the cycle at cycle_s[0]"
    )
    frames: Count | None = Field(
        None,
        ge=2,
        le=100_000,
        description="number of frames to resample to; default: as recorded. The recording is "
        "filtered at its own samples first. Computed motions (a solved patella, roll-slip, the "
        "initial guess of unrecorded coordinates) are filtered at the frames, so that there must "
        "be more than 2 cutoff_Hz frames per second",
    )

    @model_validator(mode="after")
    def _keys_go_together(self) -> Self:
        if (self.interpretation == "pose") != (self.sequence is not None):
            raise ValueError("'sequence' belongs to interpretation = 'pose', and is needed there")
        if self.motion == "recorded" and "slip_share" in self.model_fields_set:
            raise ValueError("'slip_share' belongs to motion = 'roll-slip'")
        if (self.interpretation == "markers") != (self.markers is not None):
            raise ValueError("[motion.markers] belongs to interpretation = 'markers'")
        if self.markers is None and not (self.angle_unit and self.length_unit):
            missing = "length_unit" if self.angle_unit else "angle_unit"
            raise ValueError(f"missing key '{missing}'")
        if self.interval_s and (self.cycle_s or self.interval_s[0] >= self.interval_s[1]):
            raise ValueError("'interval_s' must rise, and excludes cycle_s")
        return self


class JointCentreTable(SceneTable):
    """A joint centre from the neighbouring segment's markers, used as one more shank marker.

    For shanks with fewer than three markers: the foot's markers give the ankle centre, the
    thigh's markers the knee centre.
    """

    name: str
    markers_mm: dict[str, Point] = Field(
        min_length=1,
        description="the neighbour's markers: name -> position in the neighbour's own frame",
    )
    centre_mm: Point = Field(description="the joint centre in the neighbour's own frame")
    tibia_mm: Point = Field(description="the joint centre in the tibia link")


class TibiaTable(SceneTable):
    """The pose of the shank in the laboratory (x forward, y up, z right).

    One of: `sagittal` (a forward lean about z over a fixed ankle), `pose` (columns of a
    file with the pose of the tibia link), `markers` (rigid fit of shank markers).
    """

    kind: Literal["sagittal", "pose", "markers"]
    file: Path
    columns: dict[str, str] = Field(
        default_factory=dict,
        description=(
            "role -> column: time (s), angle (sagittal; forward lean is positive) | "
            "time, rotation_1..3, translation_1..3 (pose)"
        ),
    )
    sequence: str | None = Field(
        None,
        pattern="^([xyz]{3}|[XYZ]{3})$",
        description="pose only: upper case = intrinsic, as in scipy",
    )
    angle_unit: AngleUnit = "deg"
    length_unit: LengthUnit | None = Field(
        None,
        description="unit of lengths in the file; needed if the file does not state it",
    )
    cutoff_Hz: Number | Literal["none"] | None = Field(
        None, description="low-pass cut-off; default: the motion's"
    )
    ankle_mm: Annotated[Vector, within(-20000, 20000, "give it in millimetres")] = Field(
        (0.0, 0.0, 0.0), description="sagittal: the fixed ankle in the lab"
    )
    markers_mm: dict[str, Point] = Field(
        default_factory=dict, description="markers: name -> position in the tibia link"
    )
    joint_centre: tuple[JointCentreTable, ...] = Field(
        (), description="markers: joint centres from the markers of neighbouring segments"
    )
    laboratory_axes: Axes = Field(
        "+x,+y,+z", description="axes of the file that point forward, up and right"
    )

    @model_validator(mode="after")
    def _kind_is_complete(self) -> Self:
        if (self.kind == "pose") != (self.sequence is not None):
            raise ValueError("'sequence' belongs to kind = 'pose', and is needed there")
        if self.kind == "pose" and self.length_unit is None:
            raise ValueError("kind = 'pose' needs 'length_unit'")
        if (self.kind == "markers") != bool(self.markers_mm or self.joint_centre):
            raise ValueError("'markers_mm' belongs to kind = 'markers', and is needed there")
        return self


class GroundReactionTable(SceneTable):
    """The force that the ground exerts on the foot: one level plate, or plates of a `.c3d`."""

    file: Path
    format: TableFormat | None = Field(None, description=FORMAT)
    plates: tuple[int, ...] = Field(
        (),
        description="of a .c3d: numbers (from 1) of the plates that the foot stood on, one after "
        "the other or at once; their wrenches are summed",
    )
    columns: dict[str, str] = Field(
        default_factory=dict,
        description=(
            "role -> column: time (s), force_1..3 (N, along the file's x, y, z), "
            "point_1..3 (centre of pressure; the vertical component may be missing: the "
            "plate is then at height 0 of the laboratory), moment_1..3 (N·m, free moment at that "
            "point; missing components are zero)"
        ),
    )
    length_unit: LengthUnit | None = Field(
        None, description="unit of lengths in the file; a .c3d usually states it"
    )
    force_unit: str | None = Field(
        None,
        description="of a .c3d: unit of its force channels (N, kN), if the file states none or an "
        "unknown one",
    )
    moment_unit: str | None = Field(
        None, description="of a .c3d: unit of its moment channels (Nm, Nmm, Ncm), if needed"
    )
    laboratory_axes: Axes = Field(
        "+x,+y,+z", description="axes of the file that point forward, up and right"
    )
    force: Literal["on the foot", "on the plate"] = Field(
        "on the foot",
        description="the body that the file's force acts on. 'on the plate' reverses the signs of "
        "force and free moment (Newton's third law), but not of the centre of pressure",
    )
    applied: Literal["cop", "ankle"] = Field(
        "cop", description="'ankle' applies the force alone at the ankle centre (Sharma 2008)"
    )
    cutoff_Hz: Number | Literal["none"]
    unloaded_N: Number = Field(
        20.0,
        gt=0,
        le=200,
        description="vertical force below which the centre of pressure is interpolated",
    )
    surface_mm: Number = Field(
        0.0,
        ge=0,
        le=3000,
        description="of a .c3d: height above the plates of the surface under the foot, a step for "
        "example. The centre of pressure is computed at this height from the measured wrench",
    )

    @property
    def sign(self) -> float:
        """Factor, 1 or -1, from the file's force and moment to those on the foot."""
        return -1.0 if self.force == "on the plate" else 1.0


class MeasuredTable(SceneTable):
    """Axial knee forces of an instrumented implant, only for comparison with the run."""

    file: Path
    format: TableFormat | None = Field(None, description=FORMAT)
    columns: dict[Literal["time", "total", "medial", "lateral"], str | dict[str, Number]] = Field(
        description="role -> column, or a sum of columns {column = factor}; of total, medial and "
        "lateral at least one, the third follows from the other two; compression is positive; "
        "time is in s, by default the column of that name"
    )
    unit: Literal["N", "kN", "lbf"] = Field(description="unit of the forces")
    offset_s: Number = Field(
        description="time of [motion] minus time of the file; 0 for a common clock"
    )

    @model_validator(mode="after")
    def _columns_are_complete(self) -> Self:
        if not set(self.columns) - {"time"}:
            raise ValueError("'columns' names no force: total, medial or lateral")
        if isinstance(self.columns.get("time"), dict):
            raise ValueError("'columns' time is one column, no sum")
        if any(column == {} for column in self.columns.values()):
            raise ValueError("'columns' holds an empty sum")
        return self


Positive = Annotated[Number, Field(gt=0)]


class EmgTable(SceneTable):
    """Surface EMG: envelopes that are compared with the activations, or constrain them.

    An envelope is the rectified signal, low-passed without phase shift and divided by a normalising
    value.
    """

    file: Path = Field(description="a .c3d with the channels, or a table that holds them")
    time: str = Field("time", description="of a table: the column of times, s")
    offset_s: Number = Field(
        0.0,
        description="time of [motion] minus time of the file; may include an "
        "electromechanical delay",
    )
    channels: dict[str, tuple[str, ...]] = Field(
        description="channel -> muscles of the model that it records"
    )
    high_pass_Hz: Positive | Literal["none"] = Field(
        description="cut-off of the high-pass before rectifying, against movement of the electrodes"
    )
    cutoff_Hz: Positive = Field(description="cut-off of the low-pass of the rectified signal")
    normalised_by: Literal["recording"] | dict[str, Positive] = Field(
        "recording",
        description="the envelope's largest value in the file, or channel -> value in its unit",
    )
    use: Literal["report", "target", "bounds"] = Field(
        "report",
        description="with the activation a and the envelope e: report: only reports their "
        "agreement; target: adds weight (a - e)^2 to the cost; bounds: keeps a between e - width "
        "and e + width",
    )
    weight: Positive | None = Field(None, description="with use = 'target': weight in the cost")
    width: Annotated[Number, Field(gt=0, le=1)] | None = Field(
        None, description="with use = 'bounds': half width, as an activation"
    )

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        for key, use in (("weight", "target"), ("width", "bounds")):
            if (getattr(self, key) is not None) != (self.use == use):
                raise ValueError(f"'{key}' belongs to use = '{use}', and is needed there")
        if not self.channels or not all(self.channels.values()):
            raise ValueError("'channels' names no channel, or a channel without a muscle")
        muscles = [name for names in self.channels.values() for name in names]
        twice = sorted({name for name in muscles if muscles.count(name) > 1})
        if twice:
            raise ValueError(f"'channels' names the muscle '{twice[0]}' twice")
        if isinstance(self.normalised_by, dict) and set(self.normalised_by) != set(self.channels):
            raise ValueError("'normalised_by' needs a value for each of the 'channels', no others")
        return self

    @property
    def sentence(self) -> str:
        """A sentence on the computation and the use of the envelopes."""
        high_pass = (
            "" if self.high_pass_Hz == "none" else f"high-passed at {self.high_pass_Hz:g} Hz, "
        )
        by_recording = self.normalised_by == "recording"
        divisors = "their largest values in that file" if by_recording else "given values"
        use = {
            "report": "they are only compared with the activations",
            "target": f"the cost holds {self.weight} (a - e)^2 for each",
            "bounds": f"activations stay within {self.width} of them",
        }[self.use]
        count = sum(map(len, self.channels.values()))
        return (
            f"EMG envelopes of {count} muscles ({self.file.name}: {high_pass}rectified, "
            f"low-passed at {self.cutoff_Hz:g} Hz, over {divisors}): {use}."
        )
