"""The scene file, and the case: the scene with the content of its files."""

from tkamb.io.scene.scene import Scene, load_scene, scene_schema, with_overrides, with_preset

__all__ = ["Scene", "load_scene", "scene_schema", "with_overrides", "with_preset"]
