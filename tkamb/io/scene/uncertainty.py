"""The scene's table [uncertainty]: by how much each input errs, as a standard deviation.

Every key is one standard deviation of a normal distribution in the key's unit; those called
relative are of a positive factor of mean 1 (lognormal). Zero: that input does not vary.
"""

from typing import Annotated, Self

from pydantic import Field, model_validator

from tkamb.io.scene.table import Count, Number, SceneTable

Length = Annotated[Number, Field(ge=0, le=50)]
Angle = Annotated[Number, Field(ge=0, le=20)]
Share = Annotated[Number, Field(ge=0, le=1)]

_FLUOROSCOPY = "of the recorded pose; default: single-plane fluoroscopy, Mahfouz et al. 2003"
_GIVE = "; no default: give what your laboratory knows"


class CorrelationTable(SceneTable):
    """Two inputs of [uncertainty] that err together."""

    between: tuple[str, str] = Field(
        description="names of two inputs as tornado.csv has them, e.g. ['ap', 'flexion'] or "
        "['ligament_strain.LCL', 'ligament_strain.MCL_deep']; both must vary"
    )
    coefficient: Annotated[Number, Field(ge=-1, le=1)] = Field(
        description="of correlation between the normal errors; those of positive factors are "
        "normal before the exponential"
    )

    @model_validator(mode="after")
    def _of_two(self) -> Self:
        if self.between[0] == self.between[1]:
            raise ValueError(f"'between' names '{self.between[0]}' twice")
        return self


class UncertaintyTable(SceneTable):
    """By how much the inputs err, for `tkamb uncertainty`; each key is a standard deviation.

    A pose error is one offset per sample plus noise per frame; all other errors are one draw per
    sample. Inputs are independent of each other but for those that [[uncertainty.correlation]]
    names.
    """

    seed: Count = Field(1, ge=0, description="of all draws; the same seed gives the same samples")
    ap_mm: Length = Field(0.473, description=_FLUOROSCOPY)
    si_mm: Length = Field(0.449, description="likewise")
    ml_mm: Length = Field(3.031, description="likewise: out of the image plane")
    axial_rotation_deg: Angle = Field(0.771, description="likewise")
    adduction_deg: Angle = Field(0.942, description="likewise")
    flexion_deg: Angle = Field(0.841, description="likewise")
    constant_share: Annotated[Number, Field(ge=0, le=1)] = Field(
        0.5,
        description="share of a pose error's variance that is the same in all frames; the rest "
        "is noise per frame. An assumption, without a source",
    )
    correlation_s: Annotated[Number, Field(ge=0, le=100)] = Field(
        0.1,
        description="correlation time of that noise: AR(1) with exp(-dt/correlation_s); 0 is "
        "white. An assumption, without a source",
    )
    markers_mm: Length = Field(
        0.0,
        description="of each marker of [motion.markers] on shank and thigh, each direction by "
        "itself, the same in all frames" + _GIVE,
    )
    knee_centre_mm: Length = Field(
        0.0,
        description="AP, SI and ML each: the shank, and the knee with it, against the ground "
        "reaction, in the tibia's axes" + _GIVE,
    )
    ground_reaction: Share = Field(0.0, description="relative, force and free moment" + _GIVE)
    centre_of_pressure_ap_mm: Length = Field(
        3.0, description="laboratory x; default: Exell et al. 2012, 3 ± 2 mm"
    )
    centre_of_pressure_ml_mm: Length = Field(3.0, description="laboratory z; likewise")
    segment_mass: Share = Field(0.0, description="relative, all segments together" + _GIVE)
    muscle_strength: Share = Field(
        0.0,
        description="relative, of the muscles of [muscles]: each group of muscles by itself"
        + _GIVE,
    )
    muscle_attachment_mm: Length = Field(
        0.0,
        description="AP, SI and ML each: either end of the lines that pull the patella, and of "
        "the muscles of [muscles] that cross the knee where they leave shank and thigh, each "
        "group by itself" + _GIVE,
    )
    tendon_band_mm: Length = Field(
        3.0,
        description="of band_mm of each wrapped tendon by itself, which stays at or above 0: how "
        "wide the lamina is whose sections the line wraps. An assumption, without a source: bands "
        "of 5 to 15 mm are all defensible, and move the quadriceps by up to 9 % in deep flexion",
    )
    ligament_stiffness: Share = Field(0.0, description="relative, each bundle by itself" + _GIVE)
    ligament_strain: Annotated[Number, Field(ge=0, le=0.1)] = Field(
        0.0,
        description="of each bundle by itself: added to its reference strain, or by which its "
        "slack length is divided: L0/(1 + e)" + _GIVE,
    )
    friction: Annotated[Number, Field(ge=0, le=0.5)] = Field(
        0.017,
        description="of the coefficient, which stays at or above 0; default: as wide as a "
        "uniform distribution over 0.039 to 0.099, measured for CoCr on UHMWPE",
    )
    young_modulus: Share = Field(
        0.0,
        description="relative, of the insert; each sample then prepares its contact anew" + _GIVE,
    )
    yield_stress: Share = Field(
        0.0,
        description="relative, of [output] yield_stress_MPa, which tells overloaded area" + _GIVE,
    )
    wear_factor: Share = Field(
        0.44,
        description="relative, of the wear factor, for `tkamb wear` alone; default: 5 to 95 % are "
        "a factor of two either way of the median. An assumption: laboratories differ by more",
    )
    creep: Share = Field(
        0.0, description="relative, of both constants of creep, for `tkamb wear` alone" + _GIVE
    )
    femoral_placement_mm: Length = Field(
        0.0,
        description="AP, SI and ML each: the femur's ligament and muscle attachments against the "
        "femoral component" + _GIVE,
    )
    insert_placement_mm: Length = Field(
        0.0, description="AP, SI and ML each: the insert on the tibia" + _GIVE
    )
    insert_placement_deg: Angle = Field(
        0.0, description="about AP, SI and ML each: the insert on the tibia" + _GIVE
    )
    tuberosity_mm: Length = Field(
        0.0, description="AP, SI and ML each: the patellar ligament's distal end" + _GIVE
    )
    dome_mm: Length = Field(
        0.0,
        description="AP and SI each: where a recorded patella, the dome of its button, is on the "
        "femur" + _GIVE,
    )
    correlation: tuple[CorrelationTable, ...] = Field(
        (), description="inputs that err together; needs a positive semi-definite matrix"
    )
