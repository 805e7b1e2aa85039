"""Files to objects and back: scenes, recordings, OpenSim models, meshes, datasets."""

CONTACT_MODEL = "lattice"
"""Contact model of scene files and of the command line, where none is named."""
