"""The scene file: the only place that knows its tables. Below it everything is in SI."""

from tkamb.io.scene.scene import Scene, load_scene, scene_schema, with_overrides, with_preset

__all__ = ["Scene", "load_scene", "scene_schema", "with_overrides", "with_preset"]
