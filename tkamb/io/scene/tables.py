"""The tables of the scene file: what each key means, its unit and its limits.

Units are in the key names; unknown keys are errors; every table is frozen. The tables of what was
recorded are in `recording_tables`.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from tkamb.io import CONTACT_MODEL
from tkamb.io.activities import Activity
from tkamb.io.recordings.recording_tables import EmgTable
from tkamb.io.recordings.scene_table import (
    DEFAULT_CLOSING,
    Axes,
    Band,
    Closing,
    HalfThickness,
    KneeFreedom,
    LengthUnit,
    Number,
    Offset,
    Point,
    SceneTable,
    Switch,
    Turn,
    within,
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
    bearing: Literal["fixed", "mobile"] = Field(
        "fixed",
        description="mobile: the bottom slides on the tray without friction, by lattices and fe; "
        "other contact models press it like a fixed one, and the run says so",
    )


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
    stiffness_N_per_mm: Annotated[Number | None, within(0, 5000, "give it in N/mm, not in N/m")] = (
        Field(None, gt=0)
    )
    stiffness_N_per_strain: Annotated[
        Number | None, within(0, 150000, "give it in N per unit strain")
    ] = Field(None, gt=0)
    # From a capsule's fibre to the superficial MCL's longest with its frame's length to spare.
    slack_length_mm: Annotated[Number | None, within(3, 300, "give it in millimetres")] = Field(
        None
    )
    # No ligament bears more than 0.3 (Butler et al. 1986).
    reference_strain: Annotated[Number | None, within(-0.5, 0.3, "give a strain, not per cent")] = (
        Field(None, description="instead of slack_length_mm: strain at the reference pose")
    )
    reference_flexion_deg: Number = Field(
        0.0,
        ge=-45,
        le=180,
        description="the recorded frame nearest to this flexion is the reference pose",
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        stiffness = (
            self.stiffness_N_per_mm if self.law == "two-line" else self.stiffness_N_per_strain
        )
        other = self.stiffness_N_per_strain if self.law == "two-line" else self.stiffness_N_per_mm
        if stiffness is None or other is not None:
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
    half_thickness_mm: HalfThickness = Field(3.5, description=HALF_THICKNESS)
    band_mm: Band = Field(5.0, description=BAND)


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
    force_N: Annotated[Number | None, within(1, 15000, "give it in newtons")] = Field(
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
    half_thickness_mm: HalfThickness = Field(3.5, description=HALF_THICKNESS)
    band_mm: Band = Field(5.0, description=BAND)


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
    least_activation: Number = Field(
        0.0,
        ge=0,
        le=0.2,
        description="of every muscle: its resting tone, which presses the knee where no load does",
    )
    law: Literal["isometric", "hill"] = Field(
        "isometric", description="strength: the maximal isometric force, or force-length-velocity"
    )
    emg: EmgTable | None = Field(None, description="recorded activity of the muscles")


class PatellarLigamentTable(SceneTable):
    """Patellar ligament line: from the patella to the tibial tuberosity.

    It wraps the insert's front lip when the insert is there.
    """

    proximal: Attachment
    distal: Attachment
    # Half of the shortest measured one to twice the longest (25 to 65 mm).
    length_mm: Annotated[Number | None, within(12, 130, "give it in millimetres")] = Field(
        None, description="its constant length; needed where the patella is solved"
    )
    wrap: Switch = True
    half_thickness_mm: HalfThickness = Field(2.5)
    band_mm: Band = Field(5.0, description="likewise, of the insert's lip")


class PatellaTable(SceneTable):
    """Whether the patella's sagittal motion was recorded or is to be found."""

    motion: Literal["recorded", "solved"]


class ContactTable(SceneTable):
    """The femorotibial contact."""

    model: str = Field(CONTACT_MODEL, description="a name of `tkamb contact list`")
    resolution_mm: Number = Field(1.0, gt=0)
    material: str = Field("polyethylene", description="a name of `tkamb.contact.materials`")
    friction: Number = Field(0.05, ge=0, le=1, description="Coulomb coefficient")
    adjust: Switch = Field(
        False,
        description="turns the recorded femur in the coronal plane, by 0.5 deg at most, until both "
        "condyles touch, and moves it along y, by 0.5 mm at most, before the contact model presses",
    )
    adjust_restore_when: Literal["both", "either"] = Field(
        "both",
        description="with adjust: the recorded rotation is restored if penetration and coronal "
        "angle after the press exceed the adjustment (both, Sharma 2008), or if either does",
    )
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
    post: Switch = Field(
        False,
        description=(
            "cam–post contact: the insert's post and the femoral cam as a second pair of surfaces"
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


class MaterialTable(SceneTable):
    """What the insert is made of: elastic constants and a stress-strain curve.

    True stress against true strain, the same in tension and compression. `base` takes a built-in
    material and changes what is given; without it the material is given whole.
    """

    base: str | None = Field(None, description="name of a built-in material")
    name: str | None = Field(
        None, description="what to call it in results; default: 'own', or the base's with 'changed'"
    )
    # From a gel to ceramics; UHMWPE has 0.4 to 1.5 GPa.
    young_modulus_MPa: Annotated[Number | None, within(0.1, 500000, "give it in megapascals")] = (
        Field(None, description="slope of the curve at the origin; a table's own by default")
    )
    poisson_ratio: Annotated[Number | None, Field(ge=0, lt=0.5)] = None
    yield_stress_MPa: Annotated[Number | None, Field(ge=1, le=200)] = Field(
        None, description="instead of [output] yield_stress_MPa: tells overloaded area"
    )
    law: Literal["linear", "ramberg-osgood", "tabulated"] | None = Field(
        None, description="the curve; default: the base's, or linear"
    )
    alpha: Annotated[Number | None, Field(ge=0)] = Field(
        None, description="ramberg-osgood: strain = s/E + alpha (s/s0)^(n-1) s/E"
    )
    reference_stress_MPa: Annotated[Number | None, Field(gt=0)] = Field(
        None, description="ramberg-osgood: s0"
    )
    exponent: Annotated[Number | None, Field(ge=1)] = Field(None, description="ramberg-osgood: n")
    strain: tuple[Number, ...] = Field((), description="tabulated: true strains, rising from 0")
    stress_MPa: tuple[Number, ...] = Field(
        (), description="tabulated: true stresses, from 0, not falling"
    )
    sources: tuple[str, ...] = Field((), description="who measured what; printed in results")


class WearTable(SceneTable):
    """What `tkamb wear` does with the scene; its options go before these keys. A run reads none."""

    close: Closing = Field(
        DEFAULT_CLOSING,
        description="how recorded frames become a cycle: 'interpolate' leads from the last frame "
        "to the first, 'there-and-back' goes the same way back, 'as recorded' takes the frames "
        "alone",
    )
    material: str | None = Field(
        None, description="a wear material's name, or a material file (.toml) beside the scene"
    )
    law: str | None = Field(None, description="a wear law; default: the material's own")
    wear_factor_mm3_per_Nm: Annotated[Number | None, Field(ge=0, le=1e-3)] = Field(
        None, description="instead of the material's"
    )


class OutputTable(SceneTable):
    """What is written and how it is read."""

    directory: Path | None = None
    yield_stress_MPa: Number = Field(21.0, ge=1, le=200)
    axis: Literal["flexion", "cycle", "time"] = Field(
        "flexion", description="the report's horizontal axis"
    )
    cycle_s: tuple[Number, Number] | None = Field(
        None,
        description="s, 0 and 100 % of the gait cycle; default: two foot strikes of "
        "[ground_reaction], where it shows them",
    )
    activity: Activity | None = Field(
        None, description="the report draws what instrumented knees measured in it"
    )
    notes: list[str] = Field(default_factory=list, description="printed in the report")
    answers: dict[str, str] = Field(
        default_factory=dict,
        description="words of a question -> its answer: a note then, and no flag",
    )

    @model_validator(mode="after")
    def _cycle_rises(self) -> Self:
        if self.cycle_s and self.cycle_s[0] >= self.cycle_s[1]:
            raise ValueError("'cycle_s' must rise")
        return self
