"""CSV texts of motion, shank lean and ground reaction."""

import numpy as np

from knee_bend import chain


def csv(columns):
    """Return a CSV text; columns: (name, values, decimals) in order."""
    values = [np.round(values, decimals) + 0.0 for _, values, decimals in columns]
    lines = [",".join(name for name, _, _ in columns)]
    for row in zip(*values, strict=True):
        fields = zip(row, columns, strict=True)
        lines.append(",".join(f"{x:.{decimals}f}" for x, (_, _, decimals) in fields))
    return "\n".join([*lines, ""])


def motion_csv(motion, patella):
    """Return the CSV of the knee coordinates and the patella's pose in the femoral frame."""
    ap, si, ml, rotation, adduction, flexion = motion.coordinates.T
    columns = [
        ("time_s", motion.time, 2),
        ("flexion_deg", np.degrees(flexion), 7),
        ("adduction_deg", np.degrees(adduction), 7),
        ("axial_rotation_deg", np.degrees(rotation), 7),
        ("ap_mm", ap, 6),
        ("si_mm", si, 6),
        ("ml_mm", ml, 6),
        ("patella_ap_mm", [p.ap for p in patella], 6),
        ("patella_si_mm", [p.si for p in patella], 6),
        ("patella_rotation_deg", np.degrees([p.rotation for p in patella]), 7),
    ]
    return csv(columns)


def tibia_csv(motion, squat):
    """Return the CSV of the shank's forward lean."""
    return csv([("time_s", motion.time, 2), ("lean_deg", np.degrees(squat.shank_lean), 7)])


def ground_reaction_csv(motion, squat):
    """Return the CSV of the force on the tested foot and its point, in the laboratory's axes."""
    names = ("x", "y", "z")
    columns = [("time_s", motion.time, 2)]
    columns += [(f"force_{n}_N", squat.force[:, i], 5) for i, n in enumerate(names)]
    columns += [(f"point_{n}_mm", squat.point[:, i], 5) for i, n in enumerate(names)]
    return csv(columns)


def in_tibia(point, si_start):
    """Return a point (mm) of the insert frame in the frame of the tibia link."""
    return (point[0], point[1] + chain.insert_height(si_start), point[2])
