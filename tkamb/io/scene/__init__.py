"""The scene file, and the case that is read from it."""

from tkamb.io.scene.scene import Scene, load_scene, scene_schema, with_overrides, with_preset

__all__ = ["Scene", "load_scene", "scene_schema", "with_overrides", "with_preset"]
