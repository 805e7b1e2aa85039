"""Blocks of cells for the lattice's tests."""

import numpy as np

from tkamb.contact.lattice.meshing.cells import CORNERS, join_springs


def block(counts, edges, stretch=0.0):
    """Return nodes (n, 3), index (n, 3), cells (c, 8) and springs (s, 2) of a block.

    `stretch` is the rise of the corners relative to the height: it stretches the columns to a dish
    and shears the cells.
    """
    sizes = np.asarray(counts) + 1
    index = np.stack(np.meshgrid(*[np.arange(n) for n in sizes], indexing="ij"), -1).reshape(-1, 3)
    number = np.arange(len(index)).reshape(sizes)
    base = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), -1).reshape(-1, 3)
    cells = np.stack([number[tuple((base + corner).T)] for corner in CORNERS], axis=1)
    nodes = index * np.asarray(edges, float)
    t = index / np.asarray(counts)
    dish = (t[:, 0] - 0.4) ** 2 + 0.7 * (t[:, 2] - 0.6) ** 2
    nodes[:, 1] *= 1 + stretch * dish
    nodes[:, 0] += 0.1 * stretch * edges[0] * np.sin(5 * t[:, 1] + 3 * t[:, 2])
    return nodes, index, cells, join_springs(cells, len(index)).ends


def uniform_strain(nodes, strain):
    """Return the displacement (n, 3) of a uniform strain [xx, yy, zz, xy, yz, zx]."""
    xx, yy, zz, xy, yz, zx = strain
    return nodes @ np.array([[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]])
