"""Named presets: the choices of a study, applied to any scene by `tkamb run SCENE --as NAME`."""
