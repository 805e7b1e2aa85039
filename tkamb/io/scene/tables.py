"""The tables of the scene file, with the meaning, unit and limits of each key.

Units are in the key names, and unknown keys are errors. The tables of recordings are in
`recording_tables`.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from tkamb.errors import InputError
from tkamb.io import CONTACT_MODEL
from tkamb.io.activities import Activity
from tkamb.io.recordings.recording_tables import (
    DEFAULT_CLOSING,
    Axes,
    Band,
    Closing,
    EmgTable,
    HalfThickness,
    KneeFreedom,
    LengthUnit,
    Number,
    Offset,
    PatellaFreedom,
    Point,
    SceneTable,
    Switch,
    Turn,
    within,
)
from tkamb.units import MILLIMETRE


class FemoralImplantTable(SceneTable):
    """Femoral component: its mesh and its pose on the femur link."""

    mesh: Path
    unit: LengthUnit
    axes: Axes = "+x,+y,+z"
    position_mm: Offset = Field(
        (0.0, 0.0, 0.0), description="mesh origin in the femur link, anatomical axes"
    )
    rotation_deg: Turn = Field(
        (0.0, 0.0, 0.0), description="intrinsic x-y-z rotation of the mesh in anatomical axes"
    )


class InsertImplantTable(SceneTable):
    """Insert: its mesh gives the insert frame (centre of the flat bottom's rectangle)."""

    mesh: Path
    unit: LengthUnit
    axes: Axes = "+x,+y,+z"
    bearing: Literal["fixed", "mobile"] = Field(
        "fixed",
        description="mobile: the bottom slides on the tray without friction. The lattices and fe "
        "model this; other contact models treat it as fixed, with a notice",
    )


class PatellarImplantTable(SceneTable):
    """Patellar button: its mesh and its pose on the patella link."""

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


STIFFNESS_KEYS = {
    "N/m": ("stiffness_N_per_mm", 1.0 / MILLIMETRE),
    "N per strain": ("stiffness_N_per_strain", 1.0),
}
"""Unit of a ligament law -> key of the scene, and its unit in SI."""


class LigamentWrapTable(SceneTable):
    """A surface that a bundle wraps, fixed to a link.

    `cylinder` (along its z axis) takes `radius_mm` and `length_mm`, `sphere` takes `radius_mm`,
    `ellipsoid` takes `semi_axes_mm`. `section` is the convex section of a mesh, extruded along the
    z axis: of the scene's insert or femoral component (`part`), or a polygon (`outline_mm`). With x
    to the right and y up, a bundle passes clockwise in front of a section (+x) from its proximal to
    its distal end.
    """

    name: str = Field(pattern="^[A-Za-z0-9_]+$")
    shape: Literal["cylinder", "sphere", "ellipsoid", "section"]
    link: str | None = Field(
        None, description="default with part: tibia (in the insert frame) or femur"
    )
    position_mm: Point = Field((0.0, 0.0, 0.0), description="centre, in the link's frame")
    rotation_deg: Turn = Field(
        (0.0, 0.0, 0.0), description="intrinsic x-y-z rotation of the surface in the link's frame"
    )
    # Upper limits: twice the length of a leg for a cylinder without end, and the width of a knee.
    radius_mm: Annotated[Number | None, within(0.1, 100, "give it in millimetres")] = None
    length_mm: Annotated[Number | None, within(0.1, 2000, "give it in millimetres")] = None
    semi_axes_mm: (
        tuple[
            Annotated[Number, within(0.1, 100, "give it in millimetres")],
            Annotated[Number, within(0.1, 100, "give it in millimetres")],
            Annotated[Number, within(0.1, 100, "give it in millimetres")],
        ]
        | None
    ) = None
    part: Literal["insert", "femoral"] | None = Field(
        None, description="component whose section is wrapped"
    )
    band_mm: Band = Field(0.0, description="the outline encloses sections up to this distance")
    offset_mm: HalfThickness = Field(0.0, description="distance of the bundle from the section")
    outline_mm: tuple[tuple[Number, Number], ...] | None = Field(
        None, description="convex polygon (x, y), counter-clockwise, instead of part"
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        wanted = {
            "cylinder": {"radius_mm", "length_mm"},
            "sphere": {"radius_mm"},
            "ellipsoid": {"semi_axes_mm"},
            "section": {"part"} if self.part else {"outline_mm"},
        }[self.shape]
        sizes = ("radius_mm", "length_mm", "semi_axes_mm", "part", "outline_mm")
        given = {key for key in sizes if getattr(self, key) is not None}
        if given != wanted:
            names = (
                "part or outline_mm" if self.shape == "section" else " and ".join(sorted(wanted))
            )
            raise ValueError(f"shape '{self.shape}' takes {names}, and no other size")
        if self.part is None and (self.band_mm or self.offset_mm):
            raise ValueError("band_mm and offset_mm need part")
        if (self.link is None) == (self.part is None):
            raise ValueError("give link, or part without link")
        return self


class LigamentTable(SceneTable):
    """One bundle: tension only, on a straight line or over surfaces.

    `law = "two-line"` (Shin 2007) takes `stiffness_N_per_mm`;
    `law = "quadratic-toe"` (Blankevoort 1991) takes `stiffness_N_per_strain`.
    """

    name: str = Field(pattern="^[A-Za-z0-9_]+$")
    proximal: Attachment
    distal: Attachment
    law: str = Field(description="`two-line`, `quadratic-toe` or the law of a plug-in")
    # Upper limits: ten times a whole cruciate ligament (Race & Amis 1994: 347 N/mm).
    stiffness_N_per_mm: Annotated[Number | None, within(0, 5000, "give it in N/mm, not in N/m")] = (
        Field(None, gt=0)
    )
    stiffness_N_per_strain: Annotated[
        Number | None, within(0, 150000, "give it in N per unit strain")
    ] = Field(None, gt=0)
    # From a short fibre of the capsule to more than the longest superficial MCL.
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
    wrap: tuple[LigamentWrapTable, ...] = Field(
        (), description="surfaces that the bundle wraps; default: it is straight"
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        from tkamb.knee.ligament_laws import LIGAMENT_LAWS

        try:
            key, _ = STIFFNESS_KEYS[LIGAMENT_LAWS.find(self.law).unit]
        except InputError as error:
            raise ValueError(str(error)) from None
        given = [name for name, _ in STIFFNESS_KEYS.values() if getattr(self, name) is not None]
        if given != [key]:
            raise ValueError(f"law '{self.law}' takes {key}, and only that")
        if (self.slack_length_mm is None) == (self.reference_strain is None):
            raise ValueError("give either slack_length_mm or reference_strain")
        return self


class GenericLigamentsTable(SceneTable):
    """A generic set of ligaments, scaled to the implant, for a patient without measured ones.

    The results name its bundles `generic_...`. The table of strains shows whether they suit the
    knee.
    """

    ligaments: tuple[Literal["MCL", "LCL", "PCL", "ACL"], ...] = Field(
        ("MCL", "LCL", "PCL"), min_length=1, description="ligaments that the patient has"
    )


class BoneTable(SceneTable):
    """A bone's mesh, which a line may wrap as well as the implant."""

    mesh: Path
    unit: LengthUnit
    axes: Axes = "+x,+y,+z"
    link: str = Field(description="link in whose frame the mesh is")


HALF_THICKNESS = "distance of the tendon's centre line from the outline"
BAND = (
    "the tendon wraps sections up to this distance from its sagittal plane. 5 mm is the mean "
    "distance of the fibres of a tendon 20 mm wide"
)


class MuscleWrapTable(SceneTable):
    """The sagittal outline that a muscle wraps: that of the femoral component and of `bone`.

    The part of the path from its last point on the femur to the next link passes in front of it.
    """

    bone: BoneTable | None = None
    half_thickness_mm: HalfThickness = Field(3.5, description=HALF_THICKNESS)
    band_mm: Band = Field(5.0, description=BAND)


class MuscleTable(SceneTable):
    """A muscle: a line of action through points of the links.

    Equilibrium determines the force of one muscle only, which must run from the femur to the
    patella.
    """

    name: str = Field(pattern="^[A-Za-z0-9_]+$")
    group: str = Field(
        "",
        description="group of muscles that are shown together; default: a group of its own",
    )
    path: tuple[Attachment, ...] = Field(
        min_length=2, description="from the origin, through any via points, to the insertion"
    )
    wrap: MuscleWrapTable | None = Field(None, description="default: straight between the points")
    # Upper limit: twice the strongest muscles of the lower limb, about 6 kN.
    force_N: Annotated[Number | None, within(1, 15000, "give it in newtons")] = Field(
        None, description="maximal isometric force; not given: the force has no upper bound"
    )


class QuadricepsTable(SceneTable):
    """Quadriceps line: the short form of a [[muscle]] with the name quadriceps and two points.

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

    Static optimisation shares the moments of hip, knee, ankle and subtalar joint among the
    muscles. Those across the knee load it. The equilibrium of the knee gives the quadriceps' force,
    see docs/muscles.md. Without this table only the quadriceps acts.
    """

    model: Path = Field(description="the .osim file")
    coordinates: Path | None = Field(
        None,
        description=".mot or .sto of the model's coordinates; default: fitted to the markers of "
        "[motion] file",
    )
    exponent: Number = Field(2.0, ge=2, le=10, description="p of the cost: sum of w a^p")
    weights: Literal["volume", "equal"] = Field(
        "volume",
        description="w: optimal fibre length times strength, over its mean (volume), or 1 (equal)",
    )
    reserve_Nm: Annotated[Number, Field(ge=0, le=10000)] | dict[str, Number] | None = Field(
        None,
        description="reserve moment that costs as much as one fully active muscle of weight 1: one "
        "number for all balanced coordinates, or a table coordinate = number; 0: no reserve; "
        "default: 10 N·m at knee, ankle and subtalar joint, and no cost (10 kN·m) at the hip",
    )
    least_activation: Number = Field(
        0.0125,
        ge=0,
        le=0.2,
        description="lower bound of every muscle's activation, its resting tone. It loads the knee "
        "even without an external load",
    )
    least_condyle_share: Number = Field(
        0.3,
        ge=0,
        le=0.45,
        description="least share of each condyle in the load of the knee that the muscles keep, "
        "see docs/muscles.md; 0: a condyle may lift off",
    )
    law: Literal["isometric", "hill"] = Field(
        "isometric",
        description="strength: maximal isometric force, or force-length-velocity relation",
    )
    emg: EmgTable | None = Field(None, description="recorded activity of the muscles")


class PatellarLigamentTable(SceneTable):
    """Patellar ligament line: from the patella to the tibial tuberosity.

    It wraps the insert's front lip, if the scene has an insert.
    """

    proximal: Attachment
    distal: Attachment
    # Half the shortest measured length to twice the longest (25 to 65 mm).
    length_mm: Annotated[Number | None, within(12, 130, "give it in millimetres")] = Field(
        None, description="constant length; needed if the patella's motion is solved"
    )
    wrap: Switch = True
    half_thickness_mm: HalfThickness = Field(2.5)
    band_mm: Band = Field(5.0, description="as for a muscle, for the insert's lip")


class PatellaHeadTable(SceneTable):
    """A head of the quadriceps with its share of the quadriceps' tension.

    It wraps the outline that the line of [quadriceps] wraps.
    """

    name: str = Field(pattern="^[A-Za-z0-9_]+$")
    origin: Attachment
    insertion: Attachment
    share: Number = Field(gt=0, le=1, description="the shares of all heads sum to 1")


class PatellaTable(SceneTable):
    """The patella's sagittal motion: recorded, or solved from equilibrium.

    With `released` the patella leaves this plane pose: these coordinates are found in equilibrium
    of the heads of the quadriceps, the ligaments of the patella and the contact of the button. Its
    forces act in the equations of the knee. The plane patella is the initial guess.
    """

    motion: Literal["recorded", "solved"]
    released: tuple[PatellaFreedom, ...] = Field(
        (),
        description="coordinates of the patella in equilibrium: ap, si, flexion and perhaps "
        "others; needs [contact.patellofemoral]",
    )
    head: tuple[PatellaHeadTable, ...] = Field(
        (), description="heads of the quadriceps; default: the line of [quadriceps] alone"
    )
    ligament: tuple[LigamentTable, ...] = Field(
        (),
        description="strands of the patellar ligament (patella to tibia) and retinacula (patella "
        "to femur or tibia) of a released patella",
    )

    @model_validator(mode="after")
    def _released_with_ligaments(self) -> Self:
        if bool(self.released) != bool(self.ligament) or (self.head and not self.released):
            raise ValueError("'released' needs [[patella.ligament]], and the other way round")
        names = [one.name for one in self.head] + [one.name for one in self.ligament]
        if len(set(names)) < len(names) or len(set(self.released)) < len(self.released):
            raise ValueError("a head, ligament or released coordinate is named twice")
        if self.released and not {"ap", "si", "flexion"} <= set(self.released):
            raise ValueError("'released' needs ap, si and flexion: the quadriceps moves them")
        if self.head and abs(sum(head.share for head in self.head) - 1.0) > 1e-6:
            raise ValueError("the shares of the heads do not sum to 1")
        return self


class PatellofemoralTable(SceneTable):
    """The contact of the patellar button with the femoral component.

    The patellofemoral force presses the button at the patella's pose. Without this table the button
    is rigid. The thickness is that of the mesh, which must be closed and have a flat back. Pegs
    below the back do not deform.
    """

    model: str = Field("foundation", description="a name of `tkamb contact list`")
    resolution_mm: Number = Field(0.5, gt=0)
    material: str = Field("polyethylene", description="a name of `tkamb.contact.materials`")
    options: dict[str, Any] = Field(
        default_factory=dict, description="options of the contact model, see `tkamb contact list`"
    )


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
        "none",
        description="'points': the resultants of the deformed contact act in the equations of "
        "motion",
    )
    released: tuple[KneeFreedom, ...] = Field(
        (),
        description=(
            "knee coordinates that are solved from the equilibrium of contact, ligaments and "
            "muscle line: adduction, axial_rotation, ap, si, ml (si is always solved)"
        ),
    )
    post: Switch = Field(
        False,
        description=(
            "cam–post contact: the insert's post and the femoral cam as a second pair of surfaces"
        ),
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="options of the contact model, see `tkamb contact list`"
    )
    patellofemoral: PatellofemoralTable | None = Field(
        None, description="contact of the patellar button; default: the button is rigid"
    )

    @model_validator(mode="after")
    def _released_once(self) -> Self:
        if len(set(self.released)) != len(self.released):
            raise ValueError("'released' names a coordinate twice")
        if self.released and self.adjust:
            raise ValueError(
                "'adjust' and 'released' exclude each other: both "
                "move the femur, by different rules"
            )
        return self


class MaterialTable(SceneTable):
    """The insert's material: elastic constants and a stress-strain curve.

    The curve is true stress against true strain, equal in tension and compression. With `base`
    the keys change a built-in material; without it they must define the whole material.
    """

    base: str | None = Field(None, description="name of a built-in material")
    name: str | None = Field(
        None,
        description="its name in the results; default: 'own', or the base's name with 'changed'",
    )
    # From a gel to ceramics; UHMWPE has 0.4 to 1.5 GPa.
    young_modulus_MPa: Annotated[Number | None, within(0.1, 500000, "give it in megapascals")] = (
        Field(
            None,
            description="slope of the curve at the origin; default of a tabulated curve: its slope",
        )
    )
    poisson_ratio: Annotated[Number | None, Field(ge=0, lt=0.5)] = None
    yield_stress_MPa: Annotated[Number | None, Field(ge=1, le=200)] = Field(
        None,
        description="instead of [output] yield_stress_MPa: pressure above it counts as overload",
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
    strain: tuple[Number, ...] = Field((), description="tabulated: true strains, increasing from 0")
    stress_MPa: tuple[Number, ...] = Field(
        (), description="tabulated: true stresses, from 0, never decreasing"
    )
    sources: tuple[str, ...] = Field(
        (), description="references of the measured values; printed in the results"
    )


class WearTable(SceneTable):
    """Settings of `tkamb wear`; options of the command override them. `tkamb run` ignores them."""

    close: Closing = Field(
        DEFAULT_CLOSING,
        description="how recorded frames become a cycle: 'interpolate' adds frames from the last "
        "to the first, 'there-and-back' adds the same frames in reverse, 'as recorded' adds none",
    )
    material: str | None = Field(
        None, description="a wear material's name, or a material file (.toml) beside the scene"
    )
    law: str | None = Field(None, description="a wear law; default: the material's own")
    wear_factor_mm3_per_Nm: Annotated[Number | None, Field(ge=0, le=1e-3)] = Field(
        None, description="instead of the material's wear factor"
    )


class OutputTable(SceneTable):
    """The results folder and the report."""

    directory: Path | None = None
    yield_stress_MPa: Number = Field(21.0, ge=1, le=200)
    axis: Literal["flexion", "cycle", "time"] = Field(
        "flexion", description="the report's horizontal axis"
    )
    cycle_s: tuple[Number, Number] | None = Field(
        None,
        description="s, times of 0 and 100 % of the gait cycle; default: two foot strikes of "
        "[ground_reaction], if it has them",
    )
    activity: Activity | None = Field(
        None,
        description="the report draws forces that instrumented knees measured in this activity",
    )
    licence: str | None = Field(
        None,
        max_length=200,
        description="licence of the results, for the metadata of all files: an SPDX expression "
        "such as CC-BY-4.0, or words",
    )
    notes: list[str] = Field(default_factory=list, description="printed in the report")
    answers: dict[str, str] = Field(
        default_factory=dict,
        description="words of a question -> the answer; an answered question becomes a note",
    )

    @model_validator(mode="after")
    def _cycle_rises(self) -> Self:
        if self.cycle_s and self.cycle_s[0] >= self.cycle_s[1]:
            raise ValueError("'cycle_s' must rise")
        return self
