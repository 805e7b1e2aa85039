"""From an insert to cells: the grid, its columns and walls, and the surface that is touched."""
