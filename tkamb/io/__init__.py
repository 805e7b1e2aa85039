"""Files to objects and back: scenes, recordings, OpenSim models, meshes, datasets."""
