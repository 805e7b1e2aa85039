"""A short run to look at, and what is read back from the scene graph of its page."""

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
HELD = []
"""Folders that go when the tests end."""


def copied_scene(folder):
    """Return the shipped scene's file in a folder of its own."""
    shutil.copytree(SCENE.parent, folder, dirs_exist_ok=True)
    return folder / "scene.toml"


def short_results(folder, scene, every=20, **given):
    """Run some frames and write the results."""
    results = simulate(scene, frames=slice(0, 101, every), **given)
    write_results(results, folder)
    return results


@cache
def shipped_run():
    """Return the folder of a short run of the shipped scene, the same for all tests."""
    held = tempfile.TemporaryDirectory(prefix="tkamb-tests-")
    short_results(Path(held.name), SCENE)
    HELD.append(held)
    return Path(held.name)


def matrix(browser, path):
    """Return the pose (4, 4) of a node in its parent."""
    found = browser.evaluate(
        f"(() => {{ const o = tkamb.node('{path}').object; o.updateMatrix();"
        "return Array.from(o.matrix.elements); })()"
    )
    return np.array(found).reshape(4, 4).T


def levels(browser, view=0):
    """Return the level of every point of the map that is drawn."""
    found = browser.evaluate(
        f"Array.from(tkamb.node('/tkamb/{view}/pressure map/map/<object>')"
        ".object.geometry.attributes.level.array)"
    )
    return np.array(found)


def force(browser, name, view=0):
    """Return the force (3,) N that an arrow's shaft and head stand for; zero if hidden."""
    found = browser.evaluate(
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
    return np.array(found)


def move_slider(browser, frame):
    """Move the slider as a hand does."""
    browser.evaluate(
        f"(() => {{ const s = document.getElementById('frame'); s.value = {frame};"
        "s.dispatchEvent(new Event('input')); })()"
    )
