"""Named presets: what a study chose, laid over any scene by `tkamb run SCENE --as NAME`."""
