"""tkamb: forces, contact and wear inside a total knee replacement.

    import tkamb
    scene = tkamb.load_scene("models/deep_knee_bend/scene.toml")
    results = tkamb.simulate(scene, contact="foundation")
    model = tkamb.contact_model("hertz", resolution=1e-3)

Each name is imported when it is first used.
"""

import hashlib
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tkamb.contact.registry import contact_model
    from tkamb.io.scene import Scene, load_scene
    from tkamb.knee.knee import Knee
    from tkamb.knee.ligament_laws import QuadraticToe, TwoLine, ligament_law
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.load import LinkPoint
    from tkamb.knee.loads import KneeLoads
    from tkamb.knee.muscles import Muscle, PatellarLigament, SagittalWrap
    from tkamb.knee.parts import Extensor, Implant
    from tkamb.run.read_scene import read_scene
    from tkamb.run.results import Results
    from tkamb.run.results_folder import read_results
    from tkamb.run.simulation import simulate
    from tkamb.show.plots import plot
    from tkamb.show.view.live_window import live
    from tkamb.show.view.show import show as view

__all__ = [
    "Extensor",
    "Implant",
    "Knee",
    "KneeLoads",
    "Ligament",
    "LinkPoint",
    "Muscle",
    "PatellarLigament",
    "QuadraticToe",
    "Results",
    "SagittalWrap",
    "Scene",
    "TwoLine",
    "__version__",
    "contact_model",
    "ligament_law",
    "live",
    "load_scene",
    "plot",
    "read_results",
    "read_scene",
    "simulate",
    "view",
]

_HOMES = {
    "Extensor": "tkamb.knee.parts",
    "Implant": "tkamb.knee.parts",
    "Knee": "tkamb.knee.knee",
    "KneeLoads": "tkamb.knee.loads",
    "Ligament": "tkamb.knee.ligaments",
    "QuadraticToe": "tkamb.knee.ligament_laws",
    "TwoLine": "tkamb.knee.ligament_laws",
    "ligament_law": "tkamb.knee.ligament_laws",
    "LinkPoint": "tkamb.knee.load",
    "Muscle": "tkamb.knee.muscles",
    "PatellarLigament": "tkamb.knee.muscles",
    "SagittalWrap": "tkamb.knee.muscles",
    "Results": "tkamb.run.results",
    "Scene": "tkamb.io.scene",
    "contact_model": "tkamb.contact.registry",
    "live": "tkamb.show.view.live_window",
    "load_scene": "tkamb.io.scene",
    "plot": "tkamb.show.plots",
    "read_results": "tkamb.run.results_folder",
    "read_scene": "tkamb.run.read_scene",
    "view": "tkamb.show.view.show:show",
    "simulate": "tkamb.run.simulation",
}

__version__ = "1.0.0rc1"


@lru_cache(maxsize=4)
def code_identity(part: str = "") -> str:
    """Return the SHA-256 of the source of a subpackage, by default of the whole package.

    Code that only shows results or parses arguments is left out, because it changes no number.

    Args:
        part: path of the subpackage inside the package, like "contact/lattice".
    """
    digest, package = hashlib.sha256(), Path(__file__).parent
    for path in sorted((package / part).rglob("*.py")):
        name = path.relative_to(package)
        is_output = name.parts[0] in ("show", "commands") or name.stem == "cli"
        if not is_output and not name.stem.endswith("_report"):
            digest.update(name.as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'tkamb' has no attribute '{name}'")
    module, _, attribute = _HOMES[name].partition(":")
    value = globals()[name] = getattr(import_module(module), attribute or name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
