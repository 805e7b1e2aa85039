"""A synthetic, self-consistent run: two Hertzian contacts that roll over a dished insert.

The force of each condyle is F = (2/3) p0 pi a b, with the area pi a b and the mean pressure
(2/3) p0. Muscle forces, equilibrium and shares are consistent with it.
"""

from typing import Any

import numpy as np

from tkamb.geometry.frames import Array, knee_pose
from tkamb.run.maps import ContactMaps
from tkamb.run.results import Results

MASS_KG = 75.0
WEIGHT_N = MASS_KG * 9.80665
CENTRES_Z = (-23e-3, 23e-3)


def dished_top(spacing: float = 1.5e-3) -> tuple[Array, Array]:
    """Return points (n, 3) and triangles (k, 3) of an insert's top with two dishes."""
    x = np.arange(-24e-3, 24e-3 + spacing / 2, spacing)
    z = np.arange(-36e-3, 36e-3 + spacing / 2, spacing)
    gx, gz = np.meshgrid(x, z, indexing="ij")
    dish = np.minimum((gz - CENTRES_Z[0]) ** 2, (gz - CENTRES_Z[1]) ** 2) / 0.08
    y = 9e-3 + gx**2 / 0.16 + dish
    inside = (gx / 24.1e-3) ** 2 + np.maximum(np.abs(gz) - 12e-3, 0) ** 2 / 24.1e-3**2 < 1
    inside &= ~((np.abs(gz) < 7e-3) & (gx < -14e-3))
    index = np.arange(gx.size).reshape(gx.shape)
    corners = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    whole = np.logical_and.reduce([inside.ravel()[c] for c in corners])
    a, b, c, d = (c[whole] for c in corners)
    triangles = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    used, triangles = np.unique(triangles, return_inverse=True)
    points = np.stack([gx, y, gz], -1).reshape(-1, 3)[used]
    return points, triangles.reshape(-1, 3)


def make_run(kind: str = "bend", frames: int = 101, *, maps: bool = True) -> Results:
    """Return a deep knee bend ("bend") or a gait cycle of a left knee with flags ("gait")."""
    columns = _bend(frames) if kind == "bend" else _gait(frames)
    _derived(columns)
    contact_maps = _maps(columns) if maps else None
    if kind == "gait":
        _spoil(columns)
    return Results(columns, _summary(kind, columns), contact_maps)


def _bend(frames: int) -> dict[str, Any]:
    s = np.linspace(0, 1, frames)
    total = WEIGHT_N * (1.1 + 2.6 * s**1.3 - 0.25 * np.exp(-(((s - 1) / 0.08) ** 2)))
    medial = total * (0.58 - 0.08 * s)
    quadriceps = WEIGHT_N * (0.3 + 3.6 * s**1.1)
    return {
        "time_s": 3.0 * s,
        "flexion_deg": 120 * s,
        "adduction_deg": 1.2 * np.sin(3 * s),
        "axial_rotation_deg": 6 * s,
        "total": total,
        "medial_force_N": medial,
        "medial_share_equilibrium": 0.60 - 0.12 * s,
        "medial_cop_ap_mm": 4 - 7 * s + 1.5 * np.sin(4 * s),
        "lateral_cop_ap_mm": 4 - 14 * s + 2 * np.sin(4 * s),
        "quadriceps_N": quadriceps,
        "patellar_ligament_N": quadriceps * (1 - 0.5 * s),
        "patellofemoral_N": quadriceps * (0.2 + 0.75 * s),
        "ground_reaction_si_N": 0.5 * WEIGHT_N * (1 - 0.1 * s),
        "external_flexion_moment_Nm": 5 + 60 * s,
        "external_adduction_moment_Nm": 8 + 4 * np.sin(5 * s),
        "ligament_PCL_anterolateral_N": np.maximum(0, 180 * (s - 0.4)),
        "ligament_MCL_anterior_N": 60 * np.exp(-4 * s),
        "status": ["ok"] * frames,
    }


def _gait(frames: int) -> dict[str, Any]:
    s = np.linspace(0, 1, frames)
    swing = np.exp(-(((s - 0.73) / 0.1) ** 2))
    stance = np.exp(-(((s - 0.14) / 0.08) ** 2))
    late = np.exp(-(((s - 0.48) / 0.08) ** 2))
    total = WEIGHT_N * (0.35 + 2.1 * stance + 2.3 * late)
    quadriceps = WEIGHT_N * (0.1 + 1.0 * stance + 0.2 * late)
    return {
        "time_s": 2.0 + 1.1 * s,
        "flexion_deg": 5 + 12 * stance + 55 * swing,
        "adduction_deg": 1.0 * np.sin(6 * s),
        "axial_rotation_deg": -3 + 5 * swing,
        "total": total,
        "medial_force_N": total * (0.62 + 0.05 * np.sin(6 * s)),
        "medial_share_equilibrium": 0.66 + 0.06 * np.sin(6 * s),
        "medial_cop_ap_mm": -2 + 3 * np.cos(6.28 * s),
        "lateral_cop_ap_mm": -3 + 4 * np.cos(6.28 * s + 0.6),
        "quadriceps_N": quadriceps,
        "patellar_ligament_N": quadriceps * 0.95,
        "patellofemoral_N": quadriceps * 0.4,
        "ground_reaction_si_N": WEIGHT_N * (1.0 * stance + 1.05 * late),
        "external_flexion_moment_Nm": 30 * stance - 25 * late,
        "external_adduction_moment_Nm": 28 * stance + 22 * late,
        "status": ["ok"] * frames,
    }


def _derived(columns: dict[str, Any]) -> None:
    s = np.linspace(0, 1, len(columns["status"]))
    total = columns.pop("total")
    columns["lateral_force_N"] = total - columns["medial_force_N"]
    columns["force_total_N"] = total
    columns["force_total_BW"] = total / WEIGHT_N
    columns["force_ap_N"] = -0.1 * total
    columns["force_ml_N"] = 0.03 * total
    columns["force_si_N"] = total * np.sqrt(1 - 0.1**2 - 0.03**2)
    columns["medial_force_equilibrium_N"] = total * columns["medial_share_equilibrium"]
    columns["lateral_force_equilibrium_N"] = total - columns["medial_force_equilibrium_N"]
    columns["patellofemoral_tangential_N"] = 0.02 * columns["patellofemoral_N"]
    columns["quadriceps_wrap_deg"] = np.maximum(0, columns["flexion_deg"] - 75)
    for axis, share in (("ap", 0.1), ("si", -0.6), ("ml", 0.05)):
        columns[f"hip_force_{axis}_N"] = share * WEIGHT_N * (1 + s)
        columns[f"hip_moment_{axis}_Nm"] = 10 * share * (1 + 3 * s)
    columns["ground_reaction_ap_N"] = 0.1 * columns["ground_reaction_si_N"]
    columns["ground_reaction_ml_N"] = -0.04 * columns["ground_reaction_si_N"]
    for side, z in zip(("medial", "lateral"), CENTRES_Z, strict=True):
        force = columns[f"{side}_force_N"]
        peak = 1.5e6 * force ** (1 / 3)
        area = 1.5 * force / peak
        columns[f"{side}_area_mm2"] = area * 1e6
        columns[f"{side}_mean_pressure_MPa"] = force / area / 1e6
        columns[f"{side}_peak_pressure_MPa"] = peak / 1e6
        columns[f"{side}_cop_ml_mm"] = np.full(len(s), z * 1e3)
        columns[f"{side}_area_above_yield"] = np.maximum(0, 1 - (21e6 / peak) ** 2)
        columns[f"{side}_thickness_mm"] = 9 + 0.02 * columns[f"{side}_cop_ap_mm"] ** 2
        columns[f"{side}_slip_mm"] = (5 if side == "medial" else 9) * s
    columns["approach_mm"] = 0.05 + 0.1 * s
    columns["residual_ap_N"] = 0.02 * total * np.sin(5 * s)
    columns["residual_ml_N"] = 0.03 * total * np.cos(4 * s)
    columns["residual_axial_Nm"] = 2 * np.sin(7 * s)
    columns["residual_sensitivity_N"] = 0.01 * total
    columns["condition_number"] = 20 + 60 * (1 - s) ** 4
    columns["body_seconds"] = np.full(len(s), 0.004)
    columns["contact_seconds"] = np.full(len(s), 0.05)
    columns["iterations"] = np.full(len(s), 6.0)


def _spoil(columns: dict[str, Any]) -> None:
    """Add one failed frame and six flagged frames."""
    frames = len(columns["status"])
    for k in range(frames // 2, frames // 2 + 6):
        columns["status"][k] = "raw_filtered_differ"
    failed = frames // 5
    columns["status"][failed] = "singular"
    for name, values in columns.items():
        if name not in ("time_s", "flexion_deg", "adduction_deg", "axial_rotation_deg", "status"):
            values[failed] = np.nan


def _maps(columns: dict[str, Any]) -> ContactMaps:
    points, triangles = dished_top()
    frames = len(columns["status"])
    pressure = np.zeros((frames, len(points)))
    gap = np.full((frames, len(points)), 5e-3)
    for side, z in zip(("medial", "lateral"), CENTRES_Z, strict=True):
        b = np.sqrt(columns[f"{side}_area_mm2"] * 1e-6 / np.pi * 0.7)
        a = b / 0.7
        dx = points[None, :, 0] - columns[f"{side}_cop_ap_mm"][:, None] * 1e-3
        r2 = (dx / a[:, None]) ** 2 + ((points[None, :, 2] - z) / b[:, None]) ** 2
        peak = columns[f"{side}_peak_pressure_MPa"][:, None] * 1e6
        pressure = np.maximum(pressure, peak * np.sqrt(np.maximum(0, 1 - r2)))
        gap = np.minimum(gap, 1e-4 * (r2 - 1))
    force = np.zeros((frames, len(points), 3))
    force[..., 1] = -pressure * 1.5e-3**2
    coordinates = np.zeros((frames, 6))
    coordinates[:, 1] = 35e-3
    coordinates[:, 5] = np.deg2rad(columns["flexion_deg"])
    arrays = {
        "points_m": points,
        "triangles": triangles,
        "time_s": columns["time_s"],
        "pressure_Pa": pressure,
        "gap_m": gap,
        "nodal_force_N": force,
        "femoral_pose": knee_pose(coordinates),
    }
    return ContactMaps(arrays, {"model": "synthetic", "frame": "insert"})


def _summary(kind: str, columns: dict[str, Any]) -> dict[str, Any]:
    return {
        "scene": f"{kind}.toml",
        "scene_sha256": "0" * 64,
        "versions": {"tkamb": "0.0", "numpy": np.__version__},
        "command": f"tkamb run {kind}.toml",
        "seconds": {"body": 0.4, "contact": 5.1, "total": 6.0},
        "contact": {"model": "synthetic", "resolution_mm": 1.5, "material": "none"},
        "side": "right" if kind == "bend" else "left",
        "body_mass_kg": MASS_KG,
        "height_mm": 1750.0 if kind == "bend" else None,
        "yield_stress_MPa": 21.0,
        "axis": "flexion" if kind == "bend" else "cycle",
        "notes": ["made up for tests; no patient"],
    }
