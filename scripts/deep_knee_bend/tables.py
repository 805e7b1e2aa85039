"""The recorded columns: motion, shank lean and ground reaction as CSV texts."""

import numpy as np

from deep_knee_bend import chain, ligaments


def csv(columns):
    """Return a CSV text; columns: (name, values, decimals) in order."""
    lines = [",".join(name for name, _, _ in columns)]
    for row in zip(*(values for _, values, _ in columns), strict=True):
        fields = zip(row, columns, strict=True)
        lines.append(",".join(f"{x + 0.0:.{decimals}f}" for x, (_, _, decimals) in fields))
    return "\n".join([*lines, ""]).replace("-0." + "0" * 7 + ",", "0." + "0" * 7 + ",")


def motion_csv(motion, patella):
    """Knee coordinates and the patella's place in the femoral frame."""
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
    """Forward lean of the shank."""
    return csv([("time_s", motion.time, 2), ("lean_deg", np.degrees(squat.shank_lean), 7)])


def ground_reaction_csv(motion, squat):
    """Force on the tested foot and its point, laboratory axes."""
    names = ("x", "y", "z")
    columns = [("time_s", motion.time, 2)]
    columns += [(f"force_{n}_N", squat.force[:, i], 5) for i, n in enumerate(names)]
    columns += [(f"point_{n}_mm", squat.point[:, i], 5) for i, n in enumerate(names)]
    return csv(columns)


def strain_table(coordinates, every=15):
    """Markdown table of the bundles' strains (%) over flexion."""
    flexion = np.degrees(coordinates[:, 5])
    angles = np.arange(0, 121, every)
    frames = [int(np.argmin(np.abs(flexion - angle))) for angle in angles]
    head = " | ".join(f"{angle}" for angle in angles)
    lines = [
        f"| bundle | slack length, mm | {head} |",
        "|---|---|" + "---|" * len(angles),
    ]
    for bundle in ligaments.BUNDLES:
        strain = 100.0 * ligaments.strains(bundle, coordinates)[frames]
        cells = " | ".join(f"{s + 0.0:.1f}" for s in strain)
        slack = ligaments.slack_length(bundle, coordinates)
        lines.append(f"| {bundle.name} | {slack:.2f} | {cells} |")
    return "\n".join(lines)


def in_tibia(point, si_start):
    """A point (mm) of the insert frame in the tibia link."""
    return (point[0], point[1] + chain.insert_height(si_start), point[2])
