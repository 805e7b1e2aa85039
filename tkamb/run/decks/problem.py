"""One press as a finite-element problem: hexahedra, a rigid patch of the femoral component, a load.

It holds no answer of the lattice's: the femoral component begins where an elastic foundation
would carry the load. The contact nodes lie on the smooth surface that the insert's mesh stands
for, as those of the lattice do; the femoral component is faceted.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from tkamb.contact.lattice.meshing.contact_map import ContactMap, contact_map
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.lattice.meshing.quality import whole_lattice
from tkamb.contact.lattice.problem import SurfaceFromBelow
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE


@dataclass(frozen=True)
class DeckSettings:
    """Which nodes of a deck may touch."""

    touchable_depths: float = 2.0
    """Multiple of the guessed depth: nodes whose gap at first touch is smaller can be touched.
    Chosen: the guess is off by less."""
    largest_normal_y: float = -0.3
    """Largest y of a femoral normal that takes part. Chosen: faces that look farther sideways do
    not press on the insert."""


DECK = DeckSettings()


@dataclass(frozen=True, eq=False)
class PressProblem:
    """The insert's grid, and the femoral component where a solver begins.

    Args:
        pair: the two bodies.
        lattice: grid of the insert, its contact nodes on the smooth surface.
        nodes: (c,) contact nodes.
        map: contact surface.
        floor: femoral component from below.
        pose: (4, 4) at the guessed depth.
        depth: m, guessed.
        touchable: (c,) contact nodes over which `patch` lies.
        patch: femoral triangles, insert frame.
        load: N, along -y.
    """

    pair: ContactPair
    lattice: Lattice
    nodes: Index
    map: ContactMap
    floor: SurfaceFromBelow
    pose: Array
    depth: float
    touchable: Mask
    patch: Surface
    load: float


def press_problem(pair: ContactPair, load: float, pose: Array, grid_mm: float) -> PressProblem:
    """Return a press as a finite-element problem.

    Args:
        pair: the two bodies.
        load: N, along -y.
        pose: (4, 4) pose_femoral_in_insert; its y does not matter.
        grid_mm: edge of the hexahedra.

    Raises:
        InputError: the insert cannot be meshed.
        ComputationError: the load presses nothing together.
    """
    lattice = whole_lattice(pair.insert, grid_mm * MILLIMETRE)
    nodes, surface = contact_map(lattice, pair.insert)
    smooth = lattice.nodes.copy()
    smooth[nodes, 1] += surface.lift
    floor = SurfaceFromBelow(pair.femoral, pair.femoral.rays)
    guess = contact_model("foundation", grid_mm)
    depth = guess.press(guess.prepare(pair), load, pose).approach
    if not depth > 0:
        raise ComputationError("needs a load that presses the bodies together", "deck")
    places, _ = floor.over(surface.points, pair.pose_at_approach(pose, 0.0))
    near = places[:, 1] - surface.points[:, 1] < DECK.touchable_depths * depth
    pressed_pose = pair.pose_at_approach(pose, depth)
    patch = _patch(pair.femoral.moved(pressed_pose), surface.points[near], grid_mm * MILLIMETRE)
    lattice = replace(lattice, nodes=smooth)
    return PressProblem(
        pair, lattice, nodes, surface, floor, pressed_pose, depth, near, patch, load
    )


def _patch(femoral: Surface, points: Array, spacing: float) -> Surface:
    """Return the downward triangles that lie within a cell of points, seen from above."""
    down = np.flatnonzero(femoral.face_normals[:, 1] < DECK.largest_normal_y)
    middle = femoral.triangles[down].mean(axis=1)[:, ::2]
    away, _ = cKDTree(points[:, ::2]).query(middle, distance_upper_bound=spacing)
    used, faces = np.unique(femoral.faces[down[np.isfinite(away)]], return_inverse=True)
    return Surface(femoral.vertices[used], faces.reshape(-1, 3).astype(np.int64), "patch")
