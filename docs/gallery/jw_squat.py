"""A recorded squat: subject JW.

Markers and plates of a two-legged squat. Nobody recorded where the implant sat, so adduction, axial
rotation and sliding are found: contact, ligaments and muscle line balance. Watch the ratio of
patellar ligament to quadriceps: the patella is a balance beam whose lever shortens as the knee
bends. It runs in a clone of the repository, which has models/, and needs
subject JW's files (models/jw/README.md).
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import tkamb

SCENE = Path(tkamb.__file__).parents[1] / "models" / "jw" / "squat.toml"

scene = tkamb.load_scene(SCENE, {"contact.model": "foundation", "contact.resolution_mm": 2.0})
results = tkamb.simulate(scene, frames=slice(246, 288, 8))  # the second way down
ratio = results["patellar_ligament_N"] / results["quadriceps_N"]
pulling = results["quadriceps_N"] > 100.0

figure, axes = plt.subplots(figsize=(5.4, 3.4), layout="constrained")
axes.plot(results["flexion_deg"][pulling], ratio[pulling], "o-", color="#CC79A7")
axes.set(xlabel="flexion (deg)", ylabel="patellar ligament / quadriceps", title="Subject JW, squat")
figure.savefig("jw_squat.png", dpi=100)

order = np.argsort(results["flexion_deg"][pulling])
straight, bent = ratio[pulling][order][[0, -1]]
assert bent < straight, (straight, bent)
