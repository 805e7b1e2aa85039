"""All numbers of the model. Lengths are in mm and angles in deg, unless the name says otherwise.

The sagittal profile of the femoral component is described by the direction of its outward
normal: phi = 0 distal, 90 posterior, -90 anterior.
"""

# --- femoral component -------------------------------------------------------------------
SAGITTAL_ARCS = (
    # from phi, to phi, radius
    (-100.0, -78.0, 80.0),  # anterior flange
    (-78.0, -30.0, 38.0),  # trochlea
    (-30.0, 12.0, 33.0),  # distal
    (12.0, 35.0, 26.0),  # transition
    (35.0, 100.0, 20.0),  # posterior: its centre is the origin of the femoral frame
    (100.0, 150.0, 17.0),  # far posterior, deep flexion
)
ORIGIN_PHI = 60.0
"""The femoral origin is the centre of the arc with this normal."""

CORONAL_RADIUS = 22.0
CONDYLE_SPACING_HALF = 23.0
GROOVE_RADIUS = 27.0
RIDGE_HALF_AT_FLANGE_TOP = 17.0
WIDTH_HALF = 35.0
WIDTH_HALF_AT_FLANGE_TOP = 25.0
FLANGE_TAPER_PHI = (-100.0, -25.0)
"""Ridges and edges widen from the first to the last of these normals."""
FEMORAL_EDGE_FILLET = 2.5
NOTCH_PHI = (50.0, 72.0)
"""The notch opens at the first and has its full width from the second on."""
NOTCH_WIDTH_HALF = 8.5
NOTCH_FILLET = 1.5
FEMORAL_THICKNESS = 9.0
FEMORAL_THICKNESS_AT_FLANGE_TOP = 6.5

# --- insert ------------------------------------------------------------------------------
INSERT_THICKNESS = 9.5
DISH_LOW_POINT_AP = -2.0
DISH_RADIUS_ANTERIOR = 50.0
DISH_RADIUS_POSTERIOR = 80.0
DISH_CORONAL_RADIUS = 25.0
EMINENCE_HEIGHT = 4.0
INSERT_DEPTH_HALF = 24.0
INSERT_WIDTH_HALF = 37.0
POSTERIOR_NOTCH_DEPTH = 7.0
POSTERIOR_NOTCH_WIDTH = 9.0
INSERT_EDGE_FILLET = 2.0

# --- patellar button ---------------------------------------------------------------------
DOME_RADIUS = 25.0
BUTTON_RADIUS = 17.0
BUTTON_THICKNESS = 9.0

# --- subject -----------------------------------------------------------------------------
MASS_KG = 75.0
HEIGHT = 1750.0
PATELLA_MASS_KG = 0.1

# --- motion ------------------------------------------------------------------------------
FRAMES = 101
DURATION_S = 4.0
RAMP_S = 1.0
FLEXION_END = 120.0
AXIAL_ROTATION_END = 6.0
CONTACT_AP_START = -2.0
CONTACT_AP_END = -5.5
SHANK_LEAN = (4.0, 32.0)
"""Forward lean of the shank, standing and at the bottom of the squat."""

# --- extensor mechanism ------------------------------------------------------------------
QUADRICEPS_ORIGIN = (32.0, 205.0, 0.0)
"""Origin of the vastus intermedius on the anterior shaft of the femur, in the femoral frame."""
SUPERIOR_POLE = (8.0, 20.0, 0.0)
INFERIOR_POLE = (6.0, -21.0, 0.0)
"""Ends of quadriceps and patellar ligament on the patella, in the patellar frame."""
TUBEROSITY = (38.0, -19.0, 3.0)
"""Tibial tuberosity, in the insert frame."""
PATELLAR_LIGAMENT_LENGTH = 50.0
QUADRICEPS_HALF_THICKNESS = 3.5
QUADRICEPS_WIDTH_HALF = 5.0
PATELLA_CENTRE_OF_MASS = (4.0, 0.0, 0.0)

# --- squat -------------------------------------------------------------------------------
GRAVITY = 9.80665
ANKLE_HEIGHT_SHARE = 0.039
"""Height of the ankle centre above the floor, share of body height."""
CENTRE_OF_PRESSURE = (18.0, 66.0)
"""Distance in front of the ankle, standing and at the bottom."""
LEG_SHARE = (0.5, 0.7)
"""Share of body weight on the tested leg, standing and at the bottom."""
FOOT_SPACING_HALF = 88.0
"""Half the distance of the ankles, which are under the hips: the legs are upright from in front."""
