"""A recorded squat: subject JW.

Markers and force plates of a two-legged squat. The pose of the implant was not recorded, so that
adduction, axial rotation and AP follow from the equilibrium of contact, ligaments and muscle.
The ratio of patellar ligament to quadriceps falls with flexion, because the lever arms at the
patella change. It runs in a clone of the repository, which has models/, and needs
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
