"""Contact alone: two meshes, a pose, a load."""
