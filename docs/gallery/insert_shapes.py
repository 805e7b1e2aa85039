"""Conformity and thickness of an insert: what a designer trades.

A femoral component without cam is pressed at 60 deg of flexion with 1500 N on inserts that differ
in one dimension. It is the conformity (femoral radius near extension over the dish's radius, in the
sagittal plane) or the thickness. models/designs/sweep.toml does the same over a whole bend, and
with malposition.
"""

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.geometry.frames import knee_pose
from tkamb.geometry.surface import Surface
from tkamb.studies.designs.design import load_design
from tkamb.units import MEGAPASCAL, MILLIMETRE

DESIGN = load_design(Path(__file__).parents[2] / "models" / "designs" / "lps_flex")
LOAD, LARGEST_RADIUS = 1500.0, 36.0
CONFORMITIES, THICKNESSES = (0.2, 0.4, 0.6, 0.8, 1.0), (6.0, 8.0, 10.0, 12.0)


def surface(mesh: tuple, name: str) -> Surface:
    """Return a mesh in mm as a surface in m."""
    return Surface(mesh[0] * MILLIMETRE, mesh[1], name)


def pressed(conformity: float = 0.6, thickness: float = 9.0) -> tuple[float, float]:
    """Return area (mm²) and peak pressure (MPa) of the medial condyle."""
    radii = (LARGEST_RADIUS / conformity,) * 2
    shape = {"medial_dish_radii": radii, "lateral_dish_radii": radii, "thickness": thickness}
    insert = replace(DESIGN.insert, post=None, **shape)
    pair = ContactPair(femoral, surface(insert.mesh(), "insert"), material("polyethylene"))
    model = contact_model("lattice", resolution=2e-3)
    pose = knee_pose([insert.low_point_ap * MILLIMETRE, 0, 0, 0, 0, np.radians(60.0)])
    medial = model.press(model.prepare(pair), LOAD, pose).medial
    return medial.area / MILLIMETRE**2, medial.peak_pressure / MEGAPASCAL


femoral = surface(DESIGN.femoral.mesh(), "femoral component")
by_conformity = np.array([pressed(conformity=c) for c in CONFORMITIES])
by_thickness = np.array([pressed(thickness=t) for t in THICKNESSES])

figure, plots = plt.subplots(1, 2, figsize=(7.4, 3.2), layout="constrained")
for axes, x, found, label in (
    (plots[0], CONFORMITIES, by_conformity, "conformity (9 mm thick)"),
    (plots[1], THICKNESSES, by_thickness, "thickness (mm; conformity 0.6)"),
):
    areas = axes.twinx()
    axes.plot(x, found[:, 1], "o-", color="#1a1a1a")
    areas.plot(x, found[:, 0], "s--", color="#A6761D")
    axes.set(xlabel=label, ylim=(0, 30))
    areas.set_ylim(0, 80)
plots[0].set_ylabel("peak pressure, medial (MPa)")
areas.set_ylabel("contact area, medial (mm²)", color="#A6761D")
figure.savefig("insert_shapes.png", dpi=100)

assert (np.diff(by_conformity[:, 0]) > 0).all() and (np.diff(by_conformity[:, 1]) < 0).all()
assert (np.diff(by_thickness[:, 0]) > 0).all() and (np.diff(by_thickness[:, 1]) < 0).all()
