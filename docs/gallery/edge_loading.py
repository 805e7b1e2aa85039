"""Half a degree of adduction.

The femoral component is rotated about the anterior axis in steps. Within half a degree, the error
of fluoroscopy, one condyle of this knee takes nearly all of the load. A medial share from a
recorded pose therefore says more about the recording than about the knee.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import tkamb
from tkamb.run.press import press_meshes

MESHES = Path(tkamb.__file__).parent / "io" / "starter" / "files"
ADDUCTIONS = np.array([-0.3, -0.15, 0.0, 0.15, 0.3])  # deg


def force(side):
    """Return a condyle's force, N; one that is off carries nothing."""
    return 0.0 if side is None else side.force


shares, peaks = [], []
for adduction in ADDUCTIONS:
    report = press_meshes(
        MESHES / "femoral_component.stl",
        MESHES / "insert.stl",
        1500.0,
        pose=(-6.9, 30.7, 0, adduction, 0, 0),
        contact="foundation",
        resolution_mm=2.0,
    )
    shares.append(force(report.result.medial) / 1500.0)
    peaks.append(1e-6 * report.result.pressure.max())

figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
left.plot(ADDUCTIONS, shares, "o-", color="#0072B2")
left.set(xlabel="adduction (deg)", ylabel="medial share of the load", ylim=(0, 1))
right.plot(ADDUCTIONS, peaks, "o-", color="#D55E00")
right.set(xlabel="adduction (deg)", ylabel="peak pressure (MPa)")
figure.savefig("edge_loading.png", dpi=100)

moved = abs(shares[-1] - shares[0])
assert moved > 0.5, moved
