"""A patient from an OpenSim model, a recording and meshes: what `tkamb import` does."""
