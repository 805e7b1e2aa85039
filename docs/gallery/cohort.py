"""A cohort: one knee in three sizes.

A cohort file makes one table of many runs. Here three legs of one shape (`scale`) have the same
motion. Lengths grow with the size, weights with its cube and ligament stiffness with its square, so
that forces in body weights are nearly the same. This is no statistical model of people.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pyarrow.parquet as parquet

import tkamb
from tkamb.studies.cohort.run import run_cohort

SCENE = Path(tkamb.__file__).parent / "io" / "starter" / "files" / "scene.toml"
SIZES = {"small": 0.9, "middle": 1.0, "large": 1.1}

text = f"""
title = "One knee in three sizes"
set = {{ "contact.model" = "foundation", "contact.resolution_mm" = 3.0 }}
[[trial]]
name = "bend"
scene = '{SCENE}'
"""
text += "".join(f'[[subject]]\nname = "{name}"\nscale = {size}\n' for name, size in SIZES.items())

with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "cohort.toml"
    file.write_text(text)
    run_cohort(file, Path(folder) / "out")
    table = parquet.read_table(Path(folder) / "out" / "cohort.parquet").to_pydict()

subject = np.array(table["subject"])
force, peak = (np.array(table[n]) for n in ("force_total_BW", "medial_peak_pressure_MPa"))
flexion = np.array(table["flexion_deg"])

figure, both = plt.subplots(1, 2, figsize=(7.4, 3.2), layout="constrained")
for name, colour in zip(SIZES, ("#A6761D", "#1a1a1a", "#332288"), strict=True):
    own = subject == name
    for axes, values in zip(both, (force, peak), strict=True):
        axes.plot(flexion[own], values[own], "o-", color=colour, label=name)
both[0].set(xlabel="flexion (deg)", ylabel="contact force (BW)", ylim=(0, None))
both[1].set(xlabel="flexion (deg)", ylabel="peak pressure, medial (MPa)", ylim=(0, None))
both[0].legend()
figure.savefig("cohort.png", dpi=100)

spread = np.ptp([force[subject == name].max() for name in SIZES]) / force.max()
assert spread < 0.1, spread
