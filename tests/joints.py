"""Knees with known solutions: two rigid spheres on an elastic foundation, flat or dished."""

from functools import cache

import numpy as np

from contact_bodies import dished_insert, flat_insert, graded_sphere, joined
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.geometry.frames import KNEE_COORDINATES
from tkamb.knee.ligament_laws import StackedLaws, TwoLine
from tkamb.knee.ligaments import BundleArrays
from tkamb.knee.released import released_indices
from tkamb.knee.released_forces import SCALE, JointEquilibrium, ReleasedForces, unit_residual

BALL, HALF, HEIGHT = 25e-3, 20e-3, 10e-3
"""m: radius of the spheres, half of their distance, thickness of the insert under the spheres."""
DISH = 40e-3
LINEAR = material("polyethylene-linear")
ALL = ("ap", "si", "ml", "axial_rotation", "adduction")


def spheres():
    return joined(*(graded_sphere(BALL, (0, 0, side * HALF)) for side in (-1, 1)))


@cache
def flat_joint():
    return ContactPair(spheres(), flat_insert(HEIGHT, 12e-3, 34e-3), LINEAR)


@cache
def dished_joint(radius=DISH):
    def height(x, z):
        return HEIGHT + radius - np.sqrt(radius**2 - x**2 - (np.abs(z) - HALF) ** 2)

    return ContactPair(spheres(), dished_insert(height, 16e-3, 36e-3, 0.5e-3), LINEAR)


def bundles(ends=(), stiffness=1e5):
    """Return two-line bundles from triples (femoral point, point on the shank, slack length)."""
    femur = np.array([femoral for femoral, _, _ in ends], float).reshape(-1, 3)
    shank = np.array([tibial for _, tibial, _ in ends], float).reshape(-1, 3)
    slack = np.array([length for _, _, length in ends], float)
    return BundleArrays(femur, shank, StackedLaws.of([TwoLine(stiffness)] * len(ends)), slack)


def joint_equations(external, released=ALL, ligaments=None):
    """Return the equilibrium of a joint under an external wrench; a moment balances flexion."""
    indices = released_indices(released)
    keeping = [
        unit_residual(name, np.zeros(3))
        for i, name in enumerate(KNEE_COORDINATES)
        if i not in indices
    ]
    bundle_arrays = bundles() if ligaments is None else ligaments
    return JointEquilibrium(
        np.asarray(external, float), bundle_arrays, None, np.array(keeping).T, indices
    )


def push(force, point=(0.0, 0.0, 0.0)):
    """Return the wrench (6,) of a force on the shank at a point."""
    return np.concatenate([force, np.cross(point, force)])


def find_equilibrium(model, state, external, start, released=ALL, ligaments=None):
    """Return coordinates (6,), contact and balance of a joint in equilibrium."""
    joint = joint_equations(external, released, ligaments)
    forces = ReleasedForces(joint, model.probe(state), np.asarray(start, float))
    balance = forces.balance()
    return forces.at(balance), forces.contact(balance), balance


def distance_between(one, other):
    """Return the distance of two coordinates (6,), m; rotations times the lever arm."""
    return float(np.abs((np.asarray(one) - other) * SCALE).max())
