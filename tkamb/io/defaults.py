"""What is taken where nothing is named, in scene files and on the command line alike."""

CONTACT_MODEL = "lattice"
