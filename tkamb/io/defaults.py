"""Defaults of scene files and of the command line."""

CONTACT_MODEL = "lattice"
