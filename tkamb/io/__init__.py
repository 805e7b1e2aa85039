"""Reading and writing of scenes, recordings, OpenSim models, meshes and data sets."""

CONTACT_MODEL = "lattice"
"""Default contact model of scene files and of the command line."""
