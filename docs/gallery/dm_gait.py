"""A recorded gait: subject DM.

The motion is fluoroscopy of the implant, with markers and force plates. Only the quadriceps pulls
here, so that the force is below the 2.3 to 2.6 body weights that instrumented knees measure in
walking (D'Lima 2007, Kutzner 2010): hamstrings, gastrocnemius and hip muscles are missing, and most
frames are flagged. It runs in a clone of the repository, which has models/, and needs
subject DM's files (models/dm/README.md).
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import tkamb

SCENE = Path(tkamb.__file__).parents[1] / "models" / "dm" / "scene.toml"

scene = tkamb.load_scene(SCENE, {"contact.model": "foundation", "contact.resolution_mm": 2.0})
results = tkamb.simulate(scene, frames=slice(0, 61, 6))  # stance

figure, axes = plt.subplots(figsize=(5.4, 3.4), layout="constrained")
axes.axhspan(2.3, 2.61, color="#e2e2e2", label="mean peaks in vivo")
axes.plot(results["cycle_percent"], results["force_total_BW"], "o-k", label="contact, total")
weight = scene.patient.mass_kg * 9.80665
axes.plot(
    results["cycle_percent"], results["quadriceps_N"] / weight, "s--", color="#882255",
    label="quadriceps",
)  # fmt: skip
axes.set(xlabel="cycle (%)", ylabel="force (BW)", ylim=(0, None), title="Subject DM, stance")
axes.legend()
figure.savefig("dm_gait.png", dpi=100)

peak = np.nanmax(results["force_total_BW"])
assert 1.0 < peak < 2.3, peak
