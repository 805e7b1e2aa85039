"""Files into clean SI objects: patient, motion, force plate, meshes."""
