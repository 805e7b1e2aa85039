"""A synthetic gait run with muscles, EMG and measured forces, and consistent contributions."""

from dataclasses import replace

import numpy as np

from synthetic_run import MASS_KG, WEIGHT_N, make_run
from tkamb.run.recorded import compare_measured
from tkamb.run.results import Results

GROUPS = {
    "knee extensors": ("recfem", "vasint", "vaslat", "vasmed"),
    "thigh to shank": ("bflh", "bfsh", "grac", "sart", "semimem", "semiten", "tfl"),
    "thigh to foot": ("gaslat", "gasmed"),
    "across the hip": ("glmed1", "glmed2", "glmax1", "psoas"),
    "shank to foot": ("soleus", "tibant", "perlong"),
}
CHANNELS = {"vaslat": "VL", "semimem": "SM", "gasmed": "MG", "glmed1": "GM", "glmed2": "GM"}
CHANNELS |= {"soleus": "SOL", "tibant": "TA"}
ACROSS = (*GROUPS["thigh to shank"], *GROUPS["thigh to foot"])
STRENGTH_N = 900.0
PLAIN_COLUMNS = ["time_s", "flexion_deg", "status", "force_si_N", "force_total_N", "force_total_BW"]
PLAIN_COLUMNS += ["quadriceps_N", "patellar_ligament_N", "patellofemoral_N"]
PLAIN_COLUMNS += [
    f"{side}_{kind}"
    for side in ("medial", "lateral")
    for kind in ("force_N", "force_equilibrium_N")
]
"""Columns from the run without muscles. They are few, so that the report is drawn fast."""


def muscle_run(frames: int = 56) -> Results:
    """Return the run. One frame has failed, and the last two have no measured force."""
    plain = make_run("gait", frames, maps=False)
    s = np.linspace(0, 1, frames)
    columns = {name: plain.columns[name] for name in PLAIN_COLUMNS}
    failed = np.array([status == "singular" for status in columns["status"]])
    columns["status"] = ["failed: singular" if bad else "ok" for bad in failed]
    names = [name for group in GROUPS.values() for name in group]
    for k, name in enumerate(names):
        activation = 0.04 + 0.5 * np.exp(-(((s - (k + 1) / len(names)) / 0.12) ** 2))
        columns[f"activation_{name}"] = np.where(failed, np.nan, activation)
        columns[f"muscle_{name}_N"] = STRENGTH_N * columns[f"activation_{name}"]
        if name in CHANNELS:
            columns[f"envelope_{name}"] = np.clip(1.7 * activation + 0.1 * np.sin(40 * s), 0, 1)
    for k, name in enumerate(("hip_rotation", "knee_flexion")):
        columns[f"reserve_{name}_Nm"] = np.where(failed, np.nan, 7.0 / (1 + 4 * k) * np.sin(6 * s))
    for side, share in (("medial", 0.55), ("lateral", 0.45)):
        parts = {name: share * columns[f"muscle_{name}_N"] for name in ACROSS}
        parts["quadriceps"] = share * columns["quadriceps_N"]
        parts["ligaments"] = np.full(frames, 30.0)
        external = columns[f"{side}_force_equilibrium_N"] - sum(parts.values())
        for name, part in (parts | {"external": external}).items():
            columns[f"{side}_from_{name}_N"] = part
        measured = 0.9 * columns[f"{side}_force_equilibrium_N"] + 40 * np.sin(9 * s)
        columns[f"measured_{side}_N"] = np.where(s > 0.97, np.nan, measured)
    columns["measured_total_N"] = columns["measured_medial_N"] + columns["measured_lateral_N"]
    return replace(plain, columns=columns, summary=_summary(plain.summary, columns))


def _summary(plain: dict, columns: dict) -> dict:
    emg = {
        name: {"channel": channel, "pearson_r": 0.81 if name != "glmed2" else -0.2, "rmse": 0.2}
        for name, channel in CHANNELS.items()
    }
    reserves = {
        name: {"largest_Nm": size, "percent_of_largest_moment": share, "frames_above_5_percent": n}
        for name, size, share, n in (("hip_rotation", 7.2, 55.0, 31), ("knee_flexion", 1.4, 4.0, 0))
    }
    return plain | {
        "muscle_groups": {group: list(names) for group, names in GROUPS.items()},
        "emg": {"settings": {"use": "report"}, "muscles": emg},
        "reserves": reserves,
        "measured": compare_measured(columns, ("total", "medial", "lateral"), WEIGHT_N),
        "body_mass_kg": MASS_KG,
    }
