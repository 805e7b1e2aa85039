"""A contact model of your own.

A Winkler bed in a dozen lines: springs side by side that know nothing of material or thickness. The
base class finds the approach that carries a load, `check_contact_model` of `tkamb.testing` would
hold it to the contract, and an entry point would give it a name (contact_model.md).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import matplotlib.pyplot as plt
import numpy as np

import tkamb
from tkamb.contact.model import ContactModel
from tkamb.contact.result import ContactResult
from tkamb.contact.samples import gaps_along_normals
from tkamb.run.press import load_pair

MESHES = Path(tkamb.__file__).parent / "io" / "starter" / "files"


@dataclass(frozen=True)
class Winkler(ContactModel):
    """Pressure = modulus times penetration."""

    name: ClassVar[str] = "winkler"
    assumes: ClassVar[str] = "springs of one stiffness per area"
    needs: ClassVar[str] = "a closed insert"

    resolution: float = 2e-3  # m, of the map
    modulus: float = 1e11  # Pa/m

    def evaluate(self, state, pose, guess=None):
        """Return the contact at a pose."""
        gap = gaps_along_normals(state.surface, state.pair.femoral, pose)
        return ContactResult.of(state, pose, self.modulus * np.maximum(-gap, 0.0), gap)


pair, pose = load_pair(
    MESHES / "femoral_component.stl", MESHES / "insert.stl", "mm",
    (-6.9, 30.7, 0, 0, 0, 0), "fixed", "polyethylene", "+x,+y,+z", "right",
)  # fmt: skip
approach = {}
for modulus in (0.5e11, 1e11, 2e11):
    model = Winkler(modulus=modulus)
    approach[modulus] = 1e3 * model.press(model.prepare(pair), 1500.0, pose).approach

figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
axes.loglog(approach.keys(), approach.values(), "o-", color="#009E73")
axes.set(xlabel="modulus (Pa/m)", ylabel="approach (mm)")
axes.set_xticks(list(approach), [f"{modulus:.0e}" for modulus in approach])
axes.set_yticks([0.1, 0.15, 0.2], ["0.10", "0.15", "0.20"])
axes.minorticks_off()
figure.savefig("plug_in_model.png", dpi=100)

# On paraboloids the load is pi sqrt(R1 R2) modulus approach²: twice the modulus, 1/sqrt(2).
ratio = approach[2e11] / approach[1e11]
assert abs(ratio * np.sqrt(2.0) - 1.0) < 0.05, ratio
