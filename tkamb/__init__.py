"""tkamb: what happens inside a total knee replacement.

    import tkamb
    scene = tkamb.load_scene("models/deep_knee_bend/scene.toml")
    results = tkamb.simulate(scene, contact="foundation")
    model = tkamb.contact_model("hertz", resolution_mm=1.0)

Each name is imported when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tkamb.contact.registry import contact_model
    from tkamb.results import Results
    from tkamb.results_folder import read_results
    from tkamb.scene import Scene, load_scene
    from tkamb.simulation import simulate
    from tkamb.view.show import show

__all__ = [
    "Results",
    "Scene",
    "__version__",
    "contact_model",
    "load_scene",
    "read_results",
    "show",
    "simulate",
]

_HOMES = {
    "Results": "tkamb.results",
    "Scene": "tkamb.scene",
    "contact_model": "tkamb.contact.registry",
    "load_scene": "tkamb.scene",
    "read_results": "tkamb.results_folder",
    "show": "tkamb.view.show",
    "simulate": "tkamb.simulation",
}

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'tkamb' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
