"""The model's README: README.template.md, filled with the model's numbers."""

from pathlib import Path

import numpy as np

from knee_bend import anthropometry as body
from knee_bend import button, ligaments, squat
from knee_bend import dimensions as d
from knee_bend.implant import FEMORAL, INSERT

TEMPLATE = Path(__file__).with_name("README.template.md")
ANGLES = np.arange(0, 121, 15)


def readme(motion, patella, bend):
    """Return the README's text for KneeMotion, PatellaPoses and Squat."""
    flexion = np.degrees(motion.coordinates[:, 5])
    frames = [int(np.argmin(np.abs(flexion - angle))) for angle in ANGLES]
    words = {
        **_implant(),
        **_subject(bend),
        "motion": _motion_rows(motion, frames),
        "patella_table": _patella_rows(flexion, patella, frames),
        "squat": _squat_rows(flexion, bend, frames),
        "strains": _strains(motion.coordinates, frames),
        "attachments": _attachments(),
    }
    text = TEMPLATE.read_text(encoding="utf-8")
    for word, value in words.items():
        text = text.replace(f"@{word}@", value)
    return text


def _number(value):
    """Return a number as text, without trailing zeros or a negative zero."""
    return f"{round(float(value), 3) + 0.0:g}"


def _point(point):
    return "(" + ", ".join(_number(x) for x in point) + ")"


def _row(cells):
    return "| " + " | ".join(cells) + " |"


def _size(part):
    vertices, _ = part.mesh()
    return " × ".join(f"{x:.1f}" for x in np.ptp(vertices, axis=0))


def _implant():
    arcs = ["| from, deg | to, deg | radius, mm |", "|---|---|---|"]
    arcs += [_row([_number(x) for x in arc]) for arc in d.SAGITTAL_ARCS]
    top, distal = np.radians(d.FLANGE_TAPER_PHI)
    radii = {start: radius for start, _, radius in d.SAGITTAL_ARCS}
    words = {
        "coronal": d.CORONAL_RADIUS,
        "ridge": d.CONDYLE_SPACING_HALF,
        "ridge_top": d.RIDGE_HALF_AT_FLANGE_TOP,
        "groove": d.GROOVE_RADIUS,
        "groove_top": round(float(FEMORAL.groove_depth(top)), 1),
        "groove_distal": round(float(FEMORAL.groove_depth(distal)), 1),
        "notch": d.NOTCH_PHI[0],
        "notch_width": d.NOTCH_WIDTH_HALF,
        "thickness": d.FEMORAL_THICKNESS,
        "insert_thickness": d.INSERT_THICKNESS,
        "dish_anterior": d.DISH_RADIUS_ANTERIOR,
        "dish_posterior": d.DISH_RADIUS_POSTERIOR,
        "dish_coronal": d.DISH_CORONAL_RADIUS,
        "low_point": d.DISH_LOW_POINT_AP,
        "eminence": d.EMINENCE_HEIGHT,
        "conform_coronal": round(d.CORONAL_RADIUS / d.DISH_CORONAL_RADIUS, 2),
        "conform_distal": round(radii[-30.0] / d.DISH_RADIUS_ANTERIOR, 2),
        "conform_posterior": round(radii[35.0] / d.DISH_RADIUS_POSTERIOR, 2),
        "dome": d.DOME_RADIUS,
        "button": 2.0 * d.BUTTON_RADIUS,
        "button_thickness": -button.mesh()[0][:, 0].min(),
    }
    return {
        **{key: _number(value) for key, value in words.items()},
        "arcs": "\n".join(arcs),
        "femoral_size": _size(FEMORAL),
        "insert_size": _size(INSERT),
    }


def _subject(bend):
    words = {
        "mass": d.MASS_KG,
        "height": d.HEIGHT,
        "thigh": round(body.THIGH.length, 1),
        "shank": round(body.SHANK.length, 1),
        "foot": round(body.FOOT_MASS, 2),
        "ankle": round(squat.ankle_height(), 1),
        "patella": d.PATELLA_MASS_KG,
        "ramp": d.RAMP_S,
        "rotation": d.AXIAL_ROTATION_END,
        "contact_start": d.CONTACT_AP_START,
        "contact_end": d.CONTACT_AP_END,
        "ligament": d.PATELLAR_LIGAMENT_LENGTH,
        "lean_start": d.SHANK_LEAN[0],
        "lean_end": d.SHANK_LEAN[1],
        "cop_start": d.CENTRE_OF_PRESSURE[0],
        "cop_end": d.CENTRE_OF_PRESSURE[1],
        "share_start": d.LEG_SHARE[0],
        "share_end": d.LEG_SHARE[1],
        "trunk": round(float(np.degrees(bend.trunk_lean[-1]))),
    }
    return {
        **{key: _number(value) for key, value in words.items()},
        "origin": _point(d.QUADRICEPS_ORIGIN),
        "tuberosity": _point(d.TUBEROSITY),
    }


def _motion_rows(motion, frames):
    rows = []
    for k in frames:
        ap, si, ml, rotation, adduction, flexion = motion.coordinates[k]
        values = [ap, si, ml, np.degrees(rotation), np.degrees(adduction), *motion.contact[k, :, 0]]
        rows.append(_row([f"{np.degrees(flexion):.1f}", *(f"{v + 0.0:.2f}" for v in values)]))
    return "\n".join(rows).replace("-0.00", "0.00")


def _patella_rows(flexion, patella, frames):
    rows = []
    for k in frames:
        p = patella[k]
        angles = [np.degrees(p.rotation), np.degrees(p.contact_phi)]
        cells = [f"{flexion[k]:.1f}", *(f"{a:.1f}" for a in angles)]
        cells += [f"{p.ligament_ratio:.2f}", f"{p.contact_ratio:.2f}"]
        rows.append(_row([*cells, f"{np.degrees(p.quadriceps_wrap):.1f}"]))
    return "\n".join(rows)


def _squat_rows(flexion, bend, frames):
    rows = []
    for k in frames:
        leans = np.degrees([bend.shank_lean[k], bend.trunk_lean[k]])
        cells = [f"{flexion[k]:.1f}", *(f"{a:.1f}" for a in leans)]
        weight = bend.force[k, 1] / (d.MASS_KG * d.GRAVITY)
        rows.append(_row([*cells, f"{weight:.3f}", f"{bend.point[k, 0]:.1f}"]))
    return "\n".join(rows)


def _strains(coordinates, frames):
    head = _row(["bundle", "slack length, mm", *(f"{angle} deg" for angle in ANGLES)])
    rows = [head, "|---|---|" + "---|" * len(ANGLES)]
    for bundle in ligaments.BUNDLES:
        strain = 100.0 * ligaments.strains(bundle, coordinates)[frames]
        slack = ligaments.slack_length(bundle, coordinates)
        rows.append(_row([bundle.name, f"{slack:.2f}", *(f"{s + 0.0:.1f}" for s in strain)]))
    return "\n".join(rows)


def _attachments():
    return "\n".join(
        _row([b.name, _point(b.femur), _point(b.tibia), _number(b.stiffness)])
        for b in ligaments.BUNDLES
    )
