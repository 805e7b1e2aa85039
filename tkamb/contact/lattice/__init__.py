"""Contact models whose insert is a lattice of cells: grid, stiffness and contact solver."""
