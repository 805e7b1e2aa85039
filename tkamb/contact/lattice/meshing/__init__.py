"""From an insert to cells: grid, columns, walls and contact surface."""
