"""The insert as a lattice of springs: grid, cells, stiffness and solution."""
