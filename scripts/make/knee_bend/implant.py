"""The implant of the shipped knee, from `dimensions`, by tkamb.studies.designs."""

from knee_bend import dimensions as d
from tkamb.studies.designs.design import Articulation
from tkamb.studies.designs.femoral import FemoralComponent
from tkamb.studies.designs.insert import Insert

FEMORAL = FemoralComponent(
    medial_arcs=d.SAGITTAL_ARCS,
    lateral_arcs=d.SAGITTAL_ARCS,
    origin_phi=d.ORIGIN_PHI,
    coronal_radius=d.CORONAL_RADIUS,
    ridge_half=d.CONDYLE_SPACING_HALF,
    ridge_half_at_flange_top=d.RIDGE_HALF_AT_FLANGE_TOP,
    groove_radius=d.GROOVE_RADIUS,
    width_half=d.WIDTH_HALF,
    width_half_at_flange_top=d.WIDTH_HALF_AT_FLANGE_TOP,
    taper_phi=d.FLANGE_TAPER_PHI,
    edge_fillet=d.FEMORAL_EDGE_FILLET,
    notch_phi=d.NOTCH_PHI,
    notch_half=d.NOTCH_WIDTH_HALF,
    notch_fillet=d.NOTCH_FILLET,
    thickness=d.FEMORAL_THICKNESS,
    thickness_at_flange_top=d.FEMORAL_THICKNESS_AT_FLANGE_TOP,
)
DISH_RADII = (d.DISH_RADIUS_ANTERIOR, d.DISH_RADIUS_POSTERIOR)
INSERT = Insert(
    medial_dish_radii=DISH_RADII,
    lateral_dish_radii=DISH_RADII,
    coronal_radius=d.DISH_CORONAL_RADIUS,
    thickness=d.INSERT_THICKNESS,
    low_point_ap=d.DISH_LOW_POINT_AP,
    dish_half=d.CONDYLE_SPACING_HALF,
    eminence_height=d.EMINENCE_HEIGHT,
    depth_half=d.INSERT_DEPTH_HALF,
    width_half=d.INSERT_WIDTH_HALF,
    notch_depth=d.POSTERIOR_NOTCH_DEPTH,
    notch_width=d.POSTERIOR_NOTCH_WIDTH,
    edge_fillet=d.INSERT_EDGE_FILLET,
)
ARTICULATION = Articulation(FEMORAL, INSERT)
