"""The tables of the scene file: what each key means, its unit and its limits.

Units are in the key names; unknown keys are errors; every table is frozen.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, model_validator

from tkamb.defaults import CONTACT_MODEL

LengthUnit = Literal["m", "cm", "mm"]
AngleUnit = Literal["rad", "deg"]
Number = Annotated[float, Strict()]
"""Neither `true` nor a number in quotes is one."""
Count = Annotated[int, Strict()]
Switch = Annotated[bool, Strict()]
Vector = tuple[Number, Number, Number]
KneeFreedom = Literal["ap", "si", "ml", "axial_rotation", "adduction"]


def _axes(text: str) -> str:
    names = [part.strip() for part in text.split(",")]
    if len(names) != 3 or sorted(n.lstrip("+-") for n in names) != ["x", "y", "z"]:
        raise ValueError(
            "must name three different axes for anterior, superior and right, e.g. '-x,+y,-z'"
        )
    return ",".join(n if n[0] in "+-" else f"+{n}" for n in names)


Axes = Annotated[str, AfterValidator(_axes)]


def _within(low: float, high: float, question: str) -> Any:
    """Return the annotation of a number, or of each of a vector's, that must lie in a range."""

    def checked(value: Any) -> Any:
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and not low <= number <= high:
                raise ValueError(f"{number:g} is not within {low:g} to {high:g}; {question}")
        return value

    return AfterValidator(checked)


Point = Annotated[Vector, _within(-1000, 1000, "is it in millimetres?")]
"""A bone's length (0.6 m at most) and a frame's origin beside it are less than a metre."""
Offset = Annotated[Vector, _within(-600, 600, "is it in millimetres?")]
"""From a mesh's origin, at worst at the bone's other end, to the link's."""
Turn = Annotated[Vector, _within(-360, 360, "is it in degrees?")]


def _known_format(name: str) -> str:
    from tkamb.inputs.tables import READERS

    if name not in READERS:
        raise ValueError(f"unknown table format '{name}', use {', '.join(READERS)}")
    return name


TableFormat = Annotated[str, AfterValidator(_known_format)]
FORMAT = "csv, sto, mot, trc or c3d; default: the suffix"


class SceneTable(BaseModel):
    """A table of the scene file: frozen, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class PatientTable(SceneTable):
    """Who it is. The URDF holds the chain ankle-tibia-femur-patella."""

    urdf: Path
    side: Literal["right", "left"] = Field(description="the knee that is modelled")
    # From a child of six with a tumour prosthesis to the heaviest patients operated on.
    mass_kg: Annotated[Number, _within(20, 300, "is it in kilograms?")] = Field(
        description="body mass, 20 to 300; forces in BW are relative to it"
    )
    sex: Literal["male", "female"] | None = Field(
        None, description="only for segments without <inertial>: picks the de Leva table"
    )
    # The same child to the tallest adults but a few.
    height_mm: Annotated[Number | None, _within(1000, 2300, "is it in millimetres, standing?")] = (
        Field(None, description="body height, 1000 to 2300")
    )


class MarkerSegmentTable(SceneTable):
    """A segment with skin markers: the shank, the thigh, or what hangs on one of them."""

    name: str = Field(description="'shank' and 'thigh' are the knee's; others are neighbours")
    markers_mm: dict[str, Vector] = Field(
        min_length=1,
        description="marker -> position in the tibia link (shank), the femur link (thigh) or the "
        "neighbour's own frame",
    )
    weights: dict[str, float] = Field(
        default_factory=dict, description="of the squared distances, where not 1"
    )
    joined_to: Literal["shank", "thigh"] | None = Field(
        None, description="a neighbour's: the segment that it hangs on by a ball joint"
    )
    joint_mm: Vector | None = Field(None, description="the ball joint in that segment's link")
    centre_mm: Vector | None = Field(None, description="the same in the neighbour's own frame")

    @model_validator(mode="after")
    def _hangs_somewhere(self) -> Self:
        knee = self.name in ("shank", "thigh")
        given = [v is not None for v in (self.joined_to, self.joint_mm, self.centre_mm)]
        if any(given) if knee else not all(given):
            raise ValueError(
                "'joined_to', 'joint_mm' and 'centre_mm' go together, on every segment but "
                "shank and thigh"
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
        description="'segments': rigid fits of shank and thigh, each by itself; 'chain': all "
        "segments at once, held together by their joints. Both are computed and compared"
    )
    knee: Literal["hinge", "free"] = Field(
        "hinge", description="the chain's knee: flexion alone, or six freedoms"
    )
    coordinates: tuple[Literal["flexion", "adduction", "axial_rotation", "ap", "si", "ml"], ...] = (
        Field(
            ("flexion",),
            min_length=1,
            description="knee coordinates that are taken from the markers; [contact] releases "
            "the others",
        )
    )
    neutral_mm: Vector = Field(
        description="ap, si, ml of the femur link in the insert frame, where a hinge keeps it"
    )
    neutral_deg: tuple[float, float] = Field(
        (0.0, 0.0), description="axial rotation and adduction that a hinge keeps"
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
            raise ValueError("'coordinates' lacks flexion, which nothing else gives")
        return self


class MotionTable(SceneTable):
    """The knee's recorded motion.

    `interpretation = "coordinates"`: columns are the six knee coordinates (Grood-Suntay) of
    the femoral component in the insert frame. `"pose"`: columns are a rotation sequence and
    a translation that place the femoral mesh in the insert mesh's own axes. `"markers"`: skin
    markers of shank and thigh, see [motion.markers]; they place the shank too.
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
            "role -> column name, where it differs from the role. Roles: time, flexion, "
            "adduction, axial_rotation, ap, si, ml (coordinates); time, rotation_1..3, "
            "translation_1..3 (pose); patella_ap, patella_si, patella_rotation. Coordinates that "
            "[contact] releases need no column"
        ),
    )
    signs_turned: tuple[str, ...] = Field(
        (),
        description=(
            "roles whose columns are read with the other sign: states another reading of a file "
            "whose signs are in doubt"
        ),
    )
    angle_unit: AngleUnit | None = Field(None, description="of the file; markers need none")
    length_unit: LengthUnit | None = Field(
        None, description="of the file; .trc and .c3d state their own"
    )
    cutoff_Hz: Number | Literal["none"] = Field(
        description="low-pass cut-off of the differentiation; 'none' trusts the samples"
    )
    interval_s: tuple[Number, Number] | None = Field(
        None, description="the part of the recording that is computed; default: all of it"
    )
    cycle_s: tuple[Number, Number] | None = Field(
        None,
        description="the motion's time column is per cent of a cycle, which lies on this interval",
    )
    cycle_offset_percent: Number = Field(
        0.0, ge=-100, le=100, description="per cent of the cycle at cycle_s[0]"
    )
    frames: Count | None = Field(
        None, ge=2, description="resample to so many frames; default: as recorded"
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
    """A joint centre known from the neighbouring segment's markers: one more shank marker.

    For shanks with fewer than three markers: the ankle centre is carried by the markers of
    the foot, the knee centre by those of the thigh.
    """

    name: str
    markers_mm: dict[str, Point] = Field(
        description="the neighbour's markers: name -> position in the neighbour's own frame"
    )
    centre_mm: Point = Field(description="the joint centre in the neighbour's own frame")
    tibia_mm: Point = Field(description="the joint centre in the tibia link")


class TibiaTable(SceneTable):
    """How the shank stands in the laboratory (x forward, y up, z right).

    One of: `sagittal` (a forward lean about z over a fixed ankle), `pose` (columns of a
    file that place the tibia link), `markers` (rigid fit of shank markers).
    """

    kind: Literal["sagittal", "pose", "markers"]
    file: Path
    columns: dict[str, str] = Field(
        default_factory=dict,
        description=(
            "role -> column: time, angle (sagittal; forward lean is positive) | "
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
        None, description="of the file; needed for pose, and for markers unless the file says"
    )
    cutoff_Hz: Number | Literal["none"] | None = Field(
        None, description="low-pass cut-off; default: the motion's"
    )
    ankle_mm: Annotated[Vector, _within(-20000, 20000, "is it in millimetres?")] = Field(
        (0.0, 0.0, 0.0), description="sagittal: the fixed ankle in the lab"
    )
    markers_mm: dict[str, Point] = Field(
        default_factory=dict, description="markers: name -> position in the tibia link"
    )
    joint_centre: tuple[JointCentreTable, ...] = Field(
        (), description="markers: joint centres that neighbouring segments carry"
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
        description="of a .c3d: the plates that the foot stood on, in turn or at once, from 1; "
        "their wrenches are summed",
    )
    columns: dict[str, str] = Field(
        default_factory=dict,
        description=(
            "role -> column: time, force_1..3 (N, along the file's x, y, z), "
            "point_1..3 (centre of pressure), moment_1..3 (N·m, free moment at that point; "
            "those not named and not in the file are zero)"
        ),
    )
    length_unit: LengthUnit | None = Field(None, description="of the file; a .c3d states its own")
    laboratory_axes: Axes = Field(
        "+x,+y,+z", description="axes of the file that point forward, up and right"
    )
    applied: Literal["cop", "ankle"] = Field(
        "cop", description="'ankle' applies the force alone at the ankle centre (Sharma 2008)"
    )
    cutoff_Hz: Number | Literal["none"]
    unloaded_N: Number = Field(
        20.0, gt=0, le=200, description="below this vertical force the centre of pressure is held"
    )
    surface_mm: Number = Field(
        0.0,
        ge=0,
        le=3000,
        description="of a .c3d: height above the plates of what the foot stands on, a step say; "
        "the wrench stays as measured, the centre of pressure is given on that level",
    )


class FemoralImplantTable(SceneTable):
    """Femoral component: its mesh and where it sits on the femur link."""

    mesh: Path
    unit: LengthUnit
    axes: Axes = "+x,+y,+z"
    position_mm: Offset = Field(
        (0.0, 0.0, 0.0), description="mesh origin in the femur link, anatomical axes"
    )
    rotation_deg: Turn = Field((0.0, 0.0, 0.0), description="intrinsic x-y-z, after axes")


class InsertImplantTable(SceneTable):
    """Insert: its mesh gives the insert frame (centre of the flat bottom's rectangle)."""

    mesh: Path
    unit: LengthUnit
    axes: Axes = "+x,+y,+z"
    bearing: Literal["fixed", "mobile"] = "fixed"


class PatellarImplantTable(SceneTable):
    """Patellar button: its mesh and where it sits on the patella link."""

    mesh: Path
    unit: LengthUnit
    axes: Axes = "+x,+y,+z"
    position_mm: Offset = (0.0, 0.0, 0.0)
    rotation_deg: Turn = (0.0, 0.0, 0.0)


class ImplantTable(SceneTable):
    """The parts of the implant."""

    femoral: FemoralImplantTable | None = None
    insert: InsertImplantTable | None = None
    patella: PatellarImplantTable | None = None


class Attachment(SceneTable):
    """A point fixed to a link of the URDF."""

    link: str
    point_mm: Point


class LigamentTable(SceneTable):
    """One bundle: tension only, on a straight line.

    `law = "two-line"` (Shin 2007) takes `stiffness_N_per_mm`;
    `law = "quadratic-toe"` (Blankevoort 1991) takes `stiffness_N_per_strain`.
    """

    name: str = Field(pattern="^[A-Za-z0-9_]+$")
    proximal: Attachment
    distal: Attachment
    law: Literal["two-line", "quadratic-toe"]
    # Ten times a whole cruciate ligament's (Race & Amis 1994: 347 N/mm), and as much a strain.
    stiffness_N_per_mm: Annotated[Number | None, _within(0, 5000, "is it in N/m?")] = Field(
        None, gt=0
    )
    stiffness_N_per_strain: Annotated[
        Number | None, _within(0, 150000, "is it in N per unit strain?")
    ] = Field(None, gt=0)
    # From a capsule's fibre to the superficial MCL's longest with its frame's length to spare.
    slack_length_mm: Annotated[Number | None, _within(3, 300, "is it in millimetres?")] = Field(
        None
    )
    # No ligament bears more than 0.3 (Butler et al. 1986).
    reference_strain: Annotated[Number | None, _within(-0.5, 0.3, "is it in per cent?")] = Field(
        None, description="instead of slack_length_mm: strain at the reference pose"
    )
    reference_flexion_deg: Number = Field(
        0.0,
        ge=-45,
        le=180,
        description="the recorded frame nearest to this flexion is the reference pose",
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        wanted = self.stiffness_N_per_mm if self.law == "two-line" else self.stiffness_N_per_strain
        other = self.stiffness_N_per_strain if self.law == "two-line" else self.stiffness_N_per_mm
        if wanted is None or other is not None:
            unit = "N_per_mm" if self.law == "two-line" else "N_per_strain"
            raise ValueError(f"law '{self.law}' takes stiffness_{unit}, and only that")
        if (self.slack_length_mm is None) == (self.reference_strain is None):
            raise ValueError("give either slack_length_mm or reference_strain")
        return self


class GenericLigamentsTable(SceneTable):
    """A generic set for a patient who has none of their own, scaled to the implant.

    Its bundles are nobody's: they are named `generic_...` in the results, and the table of
    strains shows whether they suit the knee.
    """

    ligaments: tuple[Literal["MCL", "LCL", "PCL", "ACL"], ...] = Field(
        ("MCL", "LCL", "PCL"), min_length=1, description="those that the patient has"
    )


class BoneTable(SceneTable):
    """A bone's mesh, which a line may wrap beside the implant."""

    mesh: Path
    unit: LengthUnit
    axes: Axes = "+x,+y,+z"
    link: str = Field(description="link in whose frame the mesh stands")


HALF_THICKNESS = "of the tendon, off the outline"
BAND = (
    "wraps the sections within this distance of its sagittal plane: as far as, on average, the "
    "fibres of a lamina 20 mm wide; wider ones ride on the flanges"
)


class MuscleWrapTable(SceneTable):
    """What a muscle wraps: the sagittal outline of the femoral component, and of `bone`.

    It is the stretch of the path that leaves the femur which passes in front of it.
    """

    bone: BoneTable | None = None
    half_thickness_mm: Number = Field(3.5, ge=0, le=20, description=HALF_THICKNESS)
    band_mm: Number = Field(5.0, ge=0, le=50, description=BAND)


class MuscleTable(SceneTable):
    """A muscle: a line of action through points of the links.

    One muscle can be balanced by equilibrium alone: it must run from the femur to the patella.
    """

    name: str = Field(pattern="^[A-Za-z0-9_]+$")
    group: str = Field("", description="of muscles that are shown together; default: its own")
    path: tuple[Attachment, ...] = Field(
        min_length=2, description="from the origin, through any via points, to the insertion"
    )
    wrap: MuscleWrapTable | None = Field(None, description="default: straight between the points")
    # Twice the strongest of the lower limb (soleus and vastus lateralis, some 6 kN).
    force_N: Annotated[Number | None, _within(1, 15000, "is it in newtons?")] = Field(
        None, description="maximal isometric force; no bound where it is not given"
    )


class QuadricepsTable(SceneTable):
    """Quadriceps line, the short form of a [[muscle]] named quadriceps of two points.

    It runs from the vastus intermedius origin to the patella and wraps the sagittal outline of
    the femoral component, and of `bone` if given.
    """

    origin: Attachment
    insertion: Attachment
    wrap: Switch = True
    bone: BoneTable | None = None
    half_thickness_mm: Number = Field(3.5, ge=0, le=20, description=HALF_THICKNESS)
    band_mm: Number = Field(5.0, ge=0, le=50, description=BAND)


class MusclesTable(SceneTable):
    """All muscles of the leg, from the OpenSim model that the URDF was made from.

    They share the joint moments of hip, knee, ankle and subtalar joint by static optimisation;
    those that cross the knee act on it. The quadriceps' force is the knee's own, see
    docs/muscles.md. Without this table only the quadriceps acts.
    """

    model: Path = Field(description="the .osim file")
    coordinates: Path | None = Field(
        None,
        description=".mot or .sto of the model's coordinates; default: fitted to the markers of "
        "[motion] file",
    )
    exponent: Number = Field(2.0, ge=2, le=10, description="p of the cost: sum of w a^p")
    weights: Literal["volume", "equal"] = Field(
        "volume", description="w: optimal fibre length times strength over the mean, or 1"
    )
    reserve_Nm: Annotated[Number, Field(ge=0, le=10000)] | dict[str, Number] = Field(
        10.0,
        description="the reserve moment that costs as much as one fully active muscle of weight "
        "1, of every balanced coordinate or of each by name; 0 forbids it",
    )
    law: Literal["isometric", "hill"] = Field(
        "isometric", description="strength: the maximal isometric force, or force-length-velocity"
    )


class PatellarLigamentTable(SceneTable):
    """Patellar ligament line: from the patella to the tibial tuberosity.

    It wraps the insert's front lip when the insert is there.
    """

    proximal: Attachment
    distal: Attachment
    # Half of the shortest measured one to twice the longest (25 to 65 mm).
    length_mm: Annotated[Number | None, _within(12, 130, "is it in millimetres?")] = Field(
        None, description="its constant length; needed where the patella is solved"
    )
    wrap: Switch = True
    half_thickness_mm: Number = Field(2.5, ge=0, le=20)
    band_mm: Number = Field(5.0, ge=0, le=50, description="likewise, of the insert's lip")


class PatellaTable(SceneTable):
    """Whether the patella's sagittal motion was recorded or is to be found."""

    motion: Literal["recorded", "solved"]


class ContactTable(SceneTable):
    """The femorotibial contact."""

    model: str = Field(CONTACT_MODEL, description="a name of `tkamb contact list`")
    resolution_mm: Number = Field(1.0, gt=0)
    material: str = Field("polyethylene", description="a name of `tkamb.contact.materials`")
    friction: Number = Field(0.05, ge=0, le=1, description="Coulomb coefficient")
    adjust: Switch = Field(False, description="femoral adjustment before contact")
    coupling: Literal["none", "points"] = Field(
        "none", description="'points': the resultants of the deformed contact act in the equations"
    )
    released: tuple[KneeFreedom, ...] = Field(
        (),
        description=(
            "knee coordinates that find their own equilibrium under contact, ligaments and "
            "muscle line: adduction, axial_rotation, ap, si, ml (si always does)"
        ),
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="the model's own, see `tkamb contact list`"
    )

    @model_validator(mode="after")
    def _released_once(self) -> Self:
        if len(set(self.released)) != len(self.released):
            raise ValueError("'released' names a coordinate twice")
        if self.released and self.adjust:
            raise ValueError(
                "'adjust' and 'released' exclude each other: one moves the femur to "
                "where the other lets it settle"
            )
        return self


class OutputTable(SceneTable):
    """What is written and how it is read."""

    directory: Path | None = None
    yield_stress_MPa: Number = Field(21.0, ge=1, le=200)
    axis: Literal["flexion", "cycle", "time"] = Field(
        "flexion", description="the report's horizontal axis"
    )
    notes: list[str] = Field(default_factory=list, description="printed in the report")
