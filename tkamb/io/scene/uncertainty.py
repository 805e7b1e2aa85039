"""The scene's table [uncertainty]: the standard deviation of the error of each input.

A key is the standard deviation of a normal error, in its unit. A key called relative is that of a
positive (lognormal) factor with mean 1. Zero: the input does not vary.
"""

from dataclasses import asdict, dataclass
from typing import Annotated, Self

from pydantic import Field, model_validator

from tkamb.io.recordings.recording_tables import Count, Number, SceneTable

Length = Annotated[Number, Field(ge=0, le=50)]
Angle = Annotated[Number, Field(ge=0, le=20)]
Share = Annotated[Number, Field(ge=0, le=1)]

_OF_POSE = "recorded coordinate; default: the value for fluoroscopy or for skin markers"
_GIVE = "; 0 by default: give the value of your laboratory"
_TISSUE = (
    "; default: an assumption, for a Monte Carlo study of the kind of Smith et al. (PMC4755512)"
)
_ASSUMED = "; default: an assumption, without a source"


@dataclass(frozen=True)
class FluoroscopyErrorSettings:
    """Standard deviations of a pose from single-plane fluoroscopy.

    Reference: Mahfouz, Hoff, Komistek, Dennis, IEEE Trans Med Imaging 22:1561 (2003),
    doi:10.1109/TMI.2003.820027, implants in a cadaver, against an optical tracker.
    """

    ap_mm: float = 0.473
    """mm, in the image plane; Mahfouz et al. 2003."""
    si_mm: float = 0.449
    """mm, in the image plane; Mahfouz et al. 2003."""
    ml_mm: float = 3.031
    """mm, out of the image plane; Mahfouz et al. 2003."""
    axial_rotation_deg: float = 0.771
    """deg; Mahfouz et al. 2003."""
    adduction_deg: float = 0.942
    """deg; Mahfouz et al. 2003."""
    flexion_deg: float = 0.841
    """deg; Mahfouz et al. 2003."""


@dataclass(frozen=True)
class SkinMarkerErrorSettings:
    """Standard deviations of a pose from skin markers, and of the markers.

    The error of a coordinate from markers follows from the errors `thigh_mm` and `shank_mm` of the
    markers. The other fields are used for coordinates that were not recorded.

    References: doi:10.1016/j.gaitpost.2005.04.012 (Benoit et al. 2006, eight men with pins in
    femur and tibia: knee rotations off by up to 4.4 deg and translations by up to 13 mm in
    walking); PMC8631460 (six patients with a total knee, markers beside fluoroscopy: the thigh's
    cluster off by up to 10 deg and 18 mm, the shank's by up to 7 deg and 17 mm, single markers by
    4 to 16 mm more).
    """

    ap_mm: float = 5.0
    """mm; an assumption: the largest error of Benoit et al. is 2.6 times this value."""
    si_mm: float = 1.0
    """mm; an assumption: contact keeps the condyles on the insert."""
    ml_mm: float = 3.0
    """mm; an assumption: the insert's flanks allow no more."""
    axial_rotation_deg: float = 2.2
    """deg; an assumption: half the largest error of Benoit et al."""
    adduction_deg: float = 2.2
    """deg; an assumption: half the largest error of Benoit et al."""
    flexion_deg: float = 2.2
    """deg; an assumption: half the largest error of Benoit et al. Not used if flexion comes from
    markers: their own deviation then counts."""
    thigh_mm: float = 10.0
    """mm, of each thigh marker in each direction; an assumption: a rigid fit of three markers
    240 mm apart then errs by 3 deg and 6 mm, a third of the largest errors in PMC8631460."""
    shank_mm: float = 6.0
    """mm, of each shank marker in each direction; an assumption: a rigid fit then errs by 2 deg and
    3.5 mm, a third to a fifth of the largest errors in PMC8631460, which occur in swing."""


FLUOROSCOPY_ERROR = FluoroscopyErrorSettings()
SKIN_MARKER_ERROR = SkinMarkerErrorSettings()


class CorrelationTable(SceneTable):
    """Two inputs of [uncertainty] with correlated errors."""

    between: tuple[str, str] = Field(
        description="names of two inputs as tornado.csv has them, e.g. ['ap', 'flexion'] or "
        "['ligament_strain.LCL', 'ligament_strain.MCL_deep']; both must vary"
    )
    coefficient: Annotated[Number, Field(ge=-1, le=1)] = Field(
        description="correlation coefficient of the two errors; for a relative input, of the "
        "logarithm of its factor"
    )

    @model_validator(mode="after")
    def _of_two(self) -> Self:
        if self.between[0] == self.between[1]:
            raise ValueError(f"'between' names '{self.between[0]}' twice")
        return self


class UncertaintyTable(SceneTable):
    """Errors of the inputs, for `tkamb uncertainty`. Each key is a standard deviation.

    A pose error is one offset per sample plus noise per frame. Every other error is one draw per
    sample. Errors are independent, except those in [[uncertainty.correlation]].
    """

    seed: Count = Field(
        1, ge=0, description="seed of all random draws; the same seed gives the same samples"
    )
    ap_mm: Length | None = Field(None, description=_OF_POSE)
    si_mm: Length | None = Field(None, description=_OF_POSE)
    ml_mm: Length | None = Field(None, description=_OF_POSE)
    axial_rotation_deg: Angle | None = Field(None, description=_OF_POSE)
    adduction_deg: Angle | None = Field(None, description=_OF_POSE)
    flexion_deg: Angle | None = Field(None, description=_OF_POSE)
    constant_share: Annotated[Number, Field(ge=0, le=1)] = Field(
        0.5,
        description="share of a pose error's variance in the offset; the rest is noise per frame. "
        "An assumption, without a source",
    )
    correlation_s: Annotated[Number, Field(ge=0, le=100)] = Field(
        0.1,
        description="correlation time of the noise per frame: AR(1) with exp(-dt/correlation_s); "
        "0: white noise. An assumption, without a source",
    )
    markers_mm: Length | None = Field(
        None,
        description="each marker of [motion.markers] on shank and thigh, in each direction, the "
        "same in all frames; default: 10 mm on the thigh, 6 mm on the shank, an assumption after "
        "PMC8631460",
    )
    knee_centre_mm: Length = Field(
        3.0,
        description="AP, SI and ML each: position of shank and knee relative to the ground "
        "reaction, in the tibia's axes" + _ASSUMED,
    )
    frontal_alignment_deg: Angle = Field(
        0.0,
        description="the shank's angle in the frontal plane, about AP through the knee's centre, "
        "relative to the laboratory; 0 by default: `tkamb import --register` estimates it",
    )
    ground_reaction: Share = Field(0.02, description="relative, force and free moment" + _ASSUMED)
    centre_of_pressure_ap_mm: Length = Field(
        3.0,
        description="along laboratory x; default: Exell et al. 2012 (PMID 23259242), 3 ± 2 mm for "
        "a wheel that rolled from one force plate to the next, compared with markers",
    )
    centre_of_pressure_ml_mm: Length = Field(
        3.0, description="along laboratory z; default: as for centre_of_pressure_ap_mm"
    )
    segment_mass: Share = Field(0.1, description="relative, one factor for all segments" + _ASSUMED)
    muscle_strength: Share = Field(
        0.2,
        description="relative, one factor per group of muscles of [muscles]" + _ASSUMED,
    )
    muscle_attachment_mm: Length = Field(
        3.0,
        description="AP, SI and ML each: both ends of the lines that pull the patella, and the "
        "points where muscles of [muscles] that cross the knee leave shank and thigh; one error "
        "per group of muscles" + _ASSUMED,
    )
    tendon_band_mm: Length = Field(
        3.0,
        description="band_mm of each wrapped tendon, never negative in a sample. An assumption, "
        "without a source: 5 to 15 mm are all defensible, and change the quadriceps force by up to "
        "9 % in deep flexion",
    )
    ligament_stiffness: Share = Field(0.3, description="relative, one factor per bundle" + _TISSUE)
    ligament_strain: Annotated[Number, Field(ge=0, le=0.1)] = Field(
        0.02,
        description="strain e of each bundle: added to its reference strain, or its slack length "
        "L0 becomes L0/(1 + e)" + _TISSUE,
    )
    friction: Annotated[Number, Field(ge=0, le=0.5)] = Field(
        0.017,
        description="coefficient of friction, never negative in a sample; default: as wide as a "
        "uniform distribution over 0.039 to 0.099, measured for CoCr on UHMWPE at 3 to 9 MPa "
        "(doi:10.1155/2015/185142, table 5)",
    )
    young_modulus: Share = Field(
        0.0,
        description="relative, of the insert; 0 by default, because each sample would have to "
        "prepare its contact again, and the modulus hardly changes the forces",
    )
    yield_stress: Share = Field(
        0.0,
        description="relative, of the yield stress above which area counts as overloaded",
    )
    wear_factor: Share = Field(
        0.44,
        description="relative, for `tkamb wear` alone; default: the 5th and 95th percentiles are "
        "half and twice the median. An assumption: laboratories differ by more",
    )
    creep: Share = Field(
        0.0, description="relative, of both constants of creep, for `tkamb wear` alone" + _GIVE
    )
    femoral_placement_mm: Length = Field(
        1.0,
        description="AP, SI and ML each: ligament and muscle attachments on the femur, relative to "
        "the femoral component" + _ASSUMED,
    )
    insert_placement_mm: Length = Field(
        1.0, description="AP, SI and ML each: the insert on the tibia" + _ASSUMED
    )
    insert_placement_deg: Angle = Field(
        1.0, description="about AP, SI and ML each: the insert on the tibia" + _ASSUMED
    )
    tuberosity_mm: Length = Field(
        2.0, description="AP, SI and ML each: the patellar ligament's distal end" + _ASSUMED
    )
    dome_mm: Length = Field(
        1.0,
        description="AP and SI each: position of a recorded patella on the femur" + _ASSUMED,
    )
    correlation: tuple[CorrelationTable, ...] = Field(
        (), description="correlated inputs; their matrix must be positive semi-definite"
    )

    def completed(self, from_markers: bool) -> Self:
        """Return the table with default deviations for the pose coordinates that it lacks.

        Args:
            from_markers: whether the knee's motion is from skin markers; otherwise the defaults
                are of fluoroscopy.
        """
        defaults = asdict(SKIN_MARKER_ERROR if from_markers else FLUOROSCOPY_ERROR)
        missing = {
            name: value
            for name, value in defaults.items()
            if name in type(self).model_fields and getattr(self, name) is None
        }
        return self.model_copy(update=missing)
