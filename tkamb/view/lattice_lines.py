"""The contact model's grid as lines: what one looks at when a map is in doubt."""

import numpy as np

from tkamb.case import Case
from tkamb.contact.lattice.meshing.cells import FACES
from tkamb.contact.lattice.meshing.grid import build_grid
from tkamb.geometry.frames import Array
from tkamb.units import MILLIMETRE


def lattice_lines(case: Case) -> Array:
    """Return the edges (s, 2, 3) m of the lattice's outer cell faces, insert frame.

    The grid is the lattice models' at the scene's resolution, whichever model was run; without
    [contact] there is none.

    Raises:
        InputError: the insert cannot be meshed.
    """
    if case.scene.contact is None or case.insert is None:
        return np.empty((0, 2, 3))
    lattice = build_grid(case.insert, case.scene.contact.resolution_mm * MILLIMETRE)
    faces = lattice.cells[:, FACES].reshape(-1, 4)
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    outer = faces[first[count == 1]]
    edges = np.stack([outer, np.roll(outer, -1, axis=1)], axis=2).reshape(-1, 2)
    return np.asarray(lattice.nodes[np.unique(np.sort(edges, axis=1), axis=0)])
