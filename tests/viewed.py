"""A short run for tests of the 3D view, and access to the scene graph of its page."""

import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from scenes import fast_scene
from tkamb.run.results_folder import write_results
from tkamb.run.simulation import simulate

MODELS = Path(__file__).parents[1] / "models"
SCENE = fast_scene()
TEMPORARY = []
"""Temporary folders, which are removed at the end of the tests."""


def copied_scene(folder):
    """Return the path of a copy of the shipped scene in a folder."""
    shutil.copytree(SCENE.parent, folder, dirs_exist_ok=True)
    return folder / "scene.toml"


def short_results(folder, scene, every=20, **options):
    """Run every `every`-th frame, write the results, and return them."""
    results = simulate(scene, frames=slice(0, 101, every), **options)
    write_results(results, folder)
    return results


@cache
def shipped_run():
    """Return the folder of a short run of the shipped scene, which all tests share."""
    folder = tempfile.TemporaryDirectory(prefix="tkamb-tests-")
    short_results(Path(folder.name), SCENE)
    TEMPORARY.append(folder)
    return Path(folder.name)


def matrix(browser, path):
    """Return the pose (4, 4) of a node in its parent."""
    values = browser.evaluate(
        f"(() => {{ const o = tkamb.node('{path}').object; o.updateMatrix();"
        "return Array.from(o.matrix.elements); })()"
    )
    return np.array(values).reshape(4, 4).T


def levels(browser, view=0):
    """Return the colour level at every point of the drawn pressure map."""
    values = browser.evaluate(
        f"Array.from(tkamb.node('/tkamb/{view}/pressure map/map/<object>')"
        ".object.geometry.attributes.level.array)"
    )
    return np.array(values)


def force(browser, name, view=0):
    """Return the force (3,), N, of an arrow from its shaft and head; zero if it is hidden."""
    values = browser.evaluate(
        f"""(() => {{
        const view = tkamb.views[{view}], node = tkamb.node(`${{view.root}}/forces/{name}`).object;
        if (!node.visible) return [0, 0, 0];
        const parts = node.children[0].children;
        const shaft = parts.find((one) => one.name === "shaft");
        const head = parts.find((one) => one.name === "head");
        const length = shaft.scale.y + head.scale.y;
        const way = new MeshCat.THREE.Vector3(0, 1, 0).applyQuaternion(node.quaternion);
        return way.multiplyScalar(length / tkamb.arrowLength * view.body_weight).toArray();
        }})()"""
    )
    return np.array(values)


def move_slider(browser, frame):
    """Set the slider of the frames and send its input event."""
    browser.evaluate(
        f"(() => {{ const s = document.getElementById('frame'); s.value = {frame};"
        "s.dispatchEvent(new Event('input')); })()"
    )
