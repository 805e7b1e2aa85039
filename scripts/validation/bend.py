"""The shipped deep knee bend compared with the forces that the dissertation reports."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.io.scene import load_scene
from tkamb.run.simulation import simulate


@dataclass(frozen=True)
class BendStudySettings:
    """Comparison of the shipped bend with publications."""

    stride: int = 10
    """Stride of the 101 frames. The contact model is Hertz, because only the forces of the leg are
    compared."""


BEND_STUDY = BendStudySettings()


def bend(scene: Path) -> dict[str, float]:
    """Return {id of published.toml: value} of the shipped knee bend, from first to last frame."""
    result = simulate(scene, contact="hertz", frames=slice(0, 101, BEND_STUDY.stride))
    total, si = (np.asarray(result[f"force_{name}_N"]) for name in ("total", "si"))
    tension, ligament, patella = (
        np.asarray(result[f"{name}_N"])
        for name in ("quadriceps", "patellar_ligament", "patellofemoral")
    )
    flexion = np.asarray(result["flexion_deg"])
    ratio = tension / ligament
    weight = float(total[0] / result["force_total_BW"][0])
    return {
        "si_share": 100.0 * float((np.abs(si) / total).min()),
        "start_force": float(np.asarray(result["force_total_BW"])[0]),
        "peak_force": float(np.asarray(result["force_total_BW"])[-1]),
        "shear_peak": float(np.sqrt(total**2 - si**2).max() / weight),
        "quadriceps_end": float(tension[-1] / weight),
        "pl_q_start": float(ligament[0] / tension[0]),
        "pl_q_end": float(ligament[-1] / tension[-1]),
        "pf_q_start": float(patella[0] / tension[0]),
        "pf_q_end": float(patella[-1] / tension[-1]),
        "medial_share": 100.0 * float(np.median(result["medial_share_equilibrium"])),
        "q_pt_10": float(np.interp(10.0, flexion, ratio)),
        "q_pt_70": float(np.interp(70.0, flexion, ratio)),
    }


def alignment(scene: Path) -> dict[str, float]:
    """Return the largest change of the total force (BW) of the bend by the femoral adjustment."""
    adjusted = load_scene(scene, {"contact.adjust": True, "contact.model": "foundation"})
    result = simulate(adjusted, resolution_mm=2.0, frames=slice(0, 101, BEND_STUDY.stride))
    return {"alignment": float(np.nanmax(np.abs(result["adjust_force_change_BW"])))}
