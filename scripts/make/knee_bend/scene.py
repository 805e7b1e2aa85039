"""The scene file's text."""

from knee_bend import dimensions as d
from knee_bend import ligaments
from knee_bend.tables import in_tibia

HEAD = """\
# A deep knee bend on a cruciate-retaining, fixed-bearing right knee.
# Written by scripts/make/deep_knee_bend; README.md says where every number comes from.

[patient]
urdf = "patient.urdf"
side = "right"
mass_kg = {mass:.1f}
sex = "male"
height_mm = {height:.0f}

[motion]
file = "motion.csv"
interpretation = "coordinates"
angle_unit = "deg"
length_unit = "mm"
cutoff_Hz = "none"

[motion.columns]
time = "time_s"
flexion = "flexion_deg"
adduction = "adduction_deg"
axial_rotation = "axial_rotation_deg"
ap = "ap_mm"
si = "si_mm"
ml = "ml_mm"
patella_ap = "patella_ap_mm"
patella_si = "patella_si_mm"
patella_rotation = "patella_rotation_deg"

[tibia]
kind = "sagittal"
file = "tibia.csv"
columns = {{ time = "time_s", angle = "lean_deg" }}
angle_unit = "deg"
ankle_mm = [0.0, {ankle:.3f}, 0.0]

[ground_reaction]
file = "ground_reaction.csv"
length_unit = "mm"
applied = "cop"
cutoff_Hz = "none"

[ground_reaction.columns]
time = "time_s"
force_1 = "force_x_N"
force_2 = "force_y_N"
force_3 = "force_z_N"
point_1 = "point_x_mm"
point_2 = "point_y_mm"
point_3 = "point_z_mm"

[implant.femoral]
mesh = "femoral_component.stl"
unit = "mm"

[implant.insert]
mesh = "insert.stl"
unit = "mm"
bearing = "fixed"

[implant.patella]
mesh = "patellar_button.stl"
unit = "mm"

[quadriceps]
origin = {{ link = "femur", point_mm = {quadriceps} }}
insertion = {{ link = "patella", point_mm = {superior} }}
half_thickness_mm = {half:.1f}

[patellar_ligament]
proximal = {{ link = "patella", point_mm = {inferior} }}
distal = {{ link = "tibia", point_mm = {tuberosity} }}
length_mm = {length:.1f}

[patella]
motion = "recorded"

[contact]
model = "lattice"
resolution_mm = 1.0
material = "polyethylene"
friction = 0.05

[wear]
close = "there-and-back"

[output]
yield_stress_MPa = 21.0
axis = "flexion"
activity = "squat"  # of instrumented knees, for the report
notes = [
  "Nobody was measured: geometry, motion and ground reaction are made to fit each other.",
  "Without motion in the first and last frame, friction is zero and the residuals jump.",
]
"""

LIGAMENT = """
[[ligament]]
name = "{name}"
proximal = {{ link = "femur", point_mm = {femur} }}
distal = {{ link = "tibia", point_mm = {tibia} }}
law = "two-line"
stiffness_N_per_mm = {stiffness}
slack_length_mm = {slack:.3f}
"""


def _point(point):
    return "[" + ", ".join(f"{x:.3f}" for x in point) + "]"


def scene_toml(coordinates):
    """Return the scene's text for knee coordinates (f, 6), mm and rad."""
    si_start = coordinates[0, 1]
    text = HEAD.format(
        mass=d.MASS_KG,
        height=d.HEIGHT,
        ankle=d.ANKLE_HEIGHT_SHARE * d.HEIGHT,
        quadriceps=_point(d.QUADRICEPS_ORIGIN),
        superior=_point(d.SUPERIOR_POLE),
        inferior=_point(d.INFERIOR_POLE),
        tuberosity=_point(in_tibia(d.TUBEROSITY, si_start)),
        half=d.QUADRICEPS_HALF_THICKNESS,
        length=d.PATELLAR_LIGAMENT_LENGTH,
    )
    for bundle in ligaments.BUNDLES:
        text += LIGAMENT.format(
            name=bundle.name,
            femur=_point(bundle.femur),
            tibia=_point(in_tibia(bundle.tibia, si_start)),
            stiffness=bundle.stiffness,
            slack=ligaments.slack_length(bundle, coordinates),
        )
    return text
