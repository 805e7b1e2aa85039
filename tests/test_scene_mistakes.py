"""If one key is missing or changed, the error is always an error of tkamb."""

import importlib.machinery
import importlib.util
import signal
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mistakes import keep_meshes
from scenes import MODEL, as_toml
from tkamb.knee import patella_search
from tkamb.knee.patella import PatellaStatus

ROOT = Path(__file__).parents[1]
SCENE = MODEL / "scene.toml"


@pytest.fixture(scope="module")
def script():
    """Return the script as a module."""
    loader = importlib.machinery.SourceFileLoader(
        "mistakes_in", f"{ROOT}/scripts/study/scene_mistakes"
    )
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("mistakes_in", loader))
    loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def kept_meshes():
    """Read the meshes of all scenes once."""
    with pytest.MonkeyPatch.context() as patch:
        keep_meshes(patch)
        yield


@pytest.fixture
def attempt(script, tmp_path, kept_meshes):
    """Return a function that tries a scene's content in a new folder."""
    handler = signal.signal(signal.SIGPROF, script._too_long)
    yield lambda content: script.attempt(as_toml(content), tmp_path / "scene.toml")
    signal.signal(signal.SIGPROF, handler)


def content_of(script, path=SCENE):
    return script.absolute(tomllib.loads(path.read_text(encoding="utf-8")), path.parent.resolve())


def jobs_of(script, content):
    return [
        (way, words, value)
        for way in script.keys(content)
        for words, value in script.changes(script.value_at(content, way), way[-1]).items()
    ]


def test_the_unchanged_scene_runs(script, attempt):
    assert attempt(content_of(script)) == ("run", "")


@pytest.mark.parametrize("first", range(4))
def test_every_change_of_one_key_runs_or_is_refused(script, attempt, first):
    """The test tries every fifteenth change of the shipped scene; the script tries all changes."""
    content = content_of(script)
    for way, words, value in jobs_of(script, content)[first * 7 :: 60]:
        verdict, message = attempt(script.changed(content, way, value))
        assert verdict in ("run", "refused"), f"{way} {words}: {message}"


@pytest.mark.slow
@pytest.mark.parametrize("axes", ["-x,+y,-z", "+z,+y,-x", "+x,-y,-z"])
@pytest.mark.parametrize("part", ["insert", "patella"])
def test_a_part_with_other_axes_and_a_searched_patella(script, attempt, part, axes):
    content = content_of(script)
    content["patella"] = {"motion": "solved"}
    content["implant"][part]["axes"] = axes
    verdict, message = attempt(content)
    assert verdict in ("run", "refused"), message


def test_a_moment_that_does_not_change_its_sign_is_a_lost_patella(monkeypatch):
    """Searches from the two ends of an interval may end at different poses of the patella."""
    first, second = (
        SimpleNamespace(coordinates=np.array([0.0, 0.0, turn]), moment=moment)
        for turn, moment in ((0.0, 1.0), (0.1, -1.0))
    )
    search = object.__new__(patella_search._Search)
    monkeypatch.setattr(patella_search._Search, "_chord", lambda *_: None)
    for wrong in (1.0, float("nan")):
        monkeypatch.setattr(
            patella_search._Search,
            "at_rotation",
            lambda self, start, turn, wrong=wrong: SimpleNamespace(
                coordinates=np.array([0.0, 0.0, turn]), moment=wrong
            ),
        )
        with pytest.raises(patella_search._Lost) as lost:
            search.between(first, second)
        assert lost.value.status is PatellaStatus.MOMENT


def test_a_joint_centre_without_markers_is_refused(script, attempt):
    content = content_of(script)
    content["tibia"] = {
        "kind": "markers",
        "file": content["tibia"]["file"],
        "markers_mm": {"a": [0.0, 0.0, 0.0]},
        "joint_centre": [
            {"name": "k", "markers_mm": {}, "centre_mm": [0.0] * 3, "tibia_mm": [0.0] * 3}
        ],
    }
    verdict, message = attempt(content)
    assert verdict == "refused" and "markers_mm" in message
