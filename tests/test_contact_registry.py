"""Contact models by name, and the conformance test of every model."""

import shutil
import sys
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scenes import write_scene
from tkamb import named_classes
from tkamb.cli import main
from tkamb.contact.foundation import ElasticFoundation
from tkamb.contact.registry import (
    BUILT_IN,
    contact_class,
    contact_descriptions,
    contact_model,
    contact_names,
)
from tkamb.errors import InputError
from tkamb.io.scene import load_scene
from tkamb.run.identity import CONTACT_CODE, contact_code, foreign_code
from tkamb.run.reproduction import verify_results
from tkamb.run.results_folder import write_results
from tkamb.run.simulation import simulate
from tkamb.show.comparison import compare_folders
from tkamb.studies import tradeoff
from tkamb.studies.cohort import run as cohort_run
from tkamb.studies.cohort.plan import load_cohort
from tkamb.studies.measures import Job
from tkamb.testing import ConformanceError, check_contact_model

pytestmark = pytest.mark.usefixtures("plain_report")

PLUGIN = Path(__file__).parent / "plugin"
COARSE = 2.0
"""mm: resolution of volume models. Chosen because the conformance test needs no finer grid."""


@pytest.fixture
def plugin(monkeypatch):
    """Make the package of the contact model "winkler" importable."""
    monkeypatch.syspath_prepend(str(PLUGIN))
    yield
    for name in [n for n in sys.modules if n.startswith("tkamb_winkler")]:
        del sys.modules[name]


@pytest.mark.parametrize("name", sorted(BUILT_IN))
def test_built_in_models_conform(name):
    fine = name in ("hertz", "foundation", "foundation-linear")
    check_contact_model(contact_model(name, resolution=(1.0 if fine else COARSE) * 1e-3))


def test_a_model_of_another_package_is_found_and_conforms(plugin):
    assert "winkler" in contact_names()
    model = contact_model("winkler", resolution=1e-3, modulus=1e11)
    assert type(model).__module__ == "tkamb_winkler.model"
    assert model.modulus == 1e11
    check_contact_model(model)


def test_a_contact_model_of_another_package_needs_thirty_lines():
    folder = PLUGIN / "tkamb_winkler"
    source = (folder / "model.py").read_text(encoding="utf-8")
    assert len(source.splitlines()) <= 30
    sources = [path.read_text(encoding="utf-8") for path in folder.glob("*.py")]
    assert sum(len(text.splitlines()) for text in sources) == len(source.splitlines()) + 1
    page = (PLUGIN.parents[1] / "docs" / "contact_model.md").read_text(encoding="utf-8")
    assert source in page


def test_without_the_package_its_name_is_unknown():
    with pytest.raises(InputError, match=r"there are: .*foundation") as error:
        contact_model("winkler")
    assert "hertz" in str(error.value)


def test_descriptions_cover_every_name_in_one_line(plugin):
    lines = contact_descriptions()
    assert set(lines) == set(contact_names()) >= {"hertz", "foundation", "winkler"}
    for line in lines.values():
        assert line.startswith("assumes ")
        assert "; needs " in line
        assert "\n" not in line


@pytest.mark.parametrize("name", ["hertz", "winkler"])
def test_a_name_clash_is_an_error(name, monkeypatch):
    points = [
        EntryPoint(name, "first.module:Model", "tkamb.contact"),
        EntryPoint(name, "second.module:Model", "tkamb.contact"),
    ]
    monkeypatch.setattr(named_classes, "installed", lambda group, path: points)
    with pytest.raises(InputError, match=f"two contact models are called '{name}'"):
        contact_names()


@pytest.mark.parametrize("value", ["not_there.at_all:Model", "tkamb.units:DEGREE"])
def test_an_entry_point_that_is_not_a_model_is_an_input_error(value, monkeypatch):
    point = EntryPoint("broken", value, "tkamb.contact")
    monkeypatch.setattr(named_classes, "installed", lambda group, path: [point])
    with pytest.raises(InputError, match="contact model 'broken'"):
        contact_class("broken")
    assert "broken" in contact_descriptions()["broken"]


@pytest.mark.parametrize("resolution", [0.0, -1.0, float("nan"), float("inf")])
def test_resolution_must_be_a_length(resolution):
    with pytest.raises(InputError, match="resolution"):
        contact_model("foundation", resolution=resolution * 1e-3)


def test_an_unknown_option_is_named():
    with pytest.raises(InputError, match=r"no option 'stiffness'.*law"):
        contact_model("foundation", resolution=1e-3, stiffness=1.0)


@dataclass(frozen=True)
class Sucking(ElasticFoundation):
    """Model with a wrench when the bodies are apart."""

    def evaluate(self, state, pose, guess=None):
        result = super().evaluate(state, pose, guess)
        object.__setattr__(result, "wrench_on_insert", result.wrench_on_insert + 1.0)
        return result


@dataclass(frozen=True)
class Forgetful(ElasticFoundation):
    """Model with pressures that integrate to twice its wrench."""

    def evaluate(self, state, pose, guess=None):
        result = super().evaluate(state, pose, guess)
        object.__setattr__(result, "pressure", 2 * result.pressure)
        return result


@dataclass(frozen=True)
class Suggestible(ElasticFoundation):
    """Model with a result that depends on the initial guess."""

    def press(self, state, load, pose, guess=None):
        result = super().press(state, load, pose, guess)
        if guess is not None:
            object.__setattr__(result, "approach", 0.9 * result.approach + 0.1 * guess.approach)
        return result


@dataclass(frozen=True)
class Flat(ElasticFoundation):
    """Model with an approach of zero at every pose."""

    def evaluate(self, state, pose, guess=None):
        result = super().evaluate(state, pose, guess)
        object.__setattr__(result, "approach", 0.0)
        return result


@dataclass(frozen=True)
class Unmoved(ElasticFoundation):
    """Model with a press that leaves the femoral component at first touch."""

    def press(self, state, load, pose, guess=None):
        result = super().press(state, load, pose, guess)
        return replace(result, pose=state.pair.pose_at_approach(pose, 0.0))


@pytest.mark.parametrize(
    ("model", "requirement"),
    [
        (Flat, "the approach is the travel since touch"),
        (Unmoved, "pressing moves the femoral component"),
        (Sucking, "no wrench when apart"),
        (Forgetful, "integral of pressure"),
        (Suggestible, "an initial guess does not change the result"),
    ],
)
def test_the_conformance_test_detects_a_faulty_model(model, requirement):
    with pytest.raises(ConformanceError, match=requirement):
        check_contact_model(model(resolution=2e-3))


def test_models_with_equal_options_are_equal():
    assert contact_model("foundation", resolution=1.5e-3) == contact_model(
        "foundation", resolution=1.5e-3
    )
    assert contact_model("foundation", resolution=1.5e-3).resolution == pytest.approx(1.5e-3)
    assert np.isclose(contact_model("hertz").resolution, 1e-3)


def test_the_identity_of_a_run_includes_the_code_of_its_contact_model(tmp_path, monkeypatch):
    """A change of another package changes results, but neither the scene nor tkamb's code."""
    packages = tmp_path / "packages"
    shutil.copytree(PLUGIN, packages)
    monkeypatch.syspath_prepend(str(packages))
    table = {"contact.model": "winkler", "contact.resolution_mm": 3.0}
    scene = load_scene(write_scene(tmp_path / "scene"), table)
    folders = [tmp_path / name for name in ("before", "after")]
    source = packages / "tkamb_winkler" / "model.py"
    for folder in folders:
        write_results(simulate(scene, frames=slice(0, 1), directory=folder), folder)
        assert verify_results(folder).notes == ()
        if folder == folders[0]:
            source.write_text(source.read_text() + "\n# a change\n")
    words = "computed by another code of the contact model 'winkler'"
    assert verify_results(folders[0]).notes == (words,)
    assert any("code of the contact model" in note for note in compare_folders(folders).notes)
    with pytest.raises(InputError, match="another code of the contact model"):
        simulate(scene, frames=slice(0, 1), directory=folders[0], resume=True)
    for name in [n for n in sys.modules if n.startswith("tkamb_winkler")]:
        del sys.modules[name]


def test_an_error_of_a_plug_in_names_the_plug_in(plugin, tmp_path, monkeypatch, capsys):
    run = ["run", str(write_scene(tmp_path / "scene")), "--contact", "winkler", "--resolution", "3"]
    run += ["--frames", "0:1", "--out", str(tmp_path / "out")]
    model = contact_class("winkler")
    code = "def evaluate(self, *pose):\n    return np.linalg.inv(np.zeros((2, 2)))\n"
    names = {}
    exec(code, vars(sys.modules[model.__module__]), names)  # plug-in code that fails in NumPy
    monkeypatch.setattr(model, "evaluate", names["evaluate"])
    monkeypatch.chdir(tmp_path)
    assert main(run) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert "contact model 'winkler' (tkamb_winkler, " in line
    assert "raised LinAlgError: Singular matrix; details are in " in line
    assert "unexpected error" not in line


def test_code_of_tkamb_is_not_foreign(plugin):
    assert foreign_code(contact_model("foundation")) is None
    winkler = contact_model("winkler", resolution=1e-3, modulus=1e11)
    assert foreign_code(winkler) == contact_code("winkler") != contact_code("foundation")


def test_identities_of_cohort_and_trade_off_include_plug_in_code(plugin, tmp_path, monkeypatch):
    scene = write_scene(tmp_path / "scene")
    text = f"set = {{ 'contact.model' = '%s' }}\n[[trial]]\nname = 'bend'\nscene = '{scene}'\n"
    keys = []
    for model in ("foundation", "winkler"):
        path = tmp_path / f"{model}.toml"
        path.write_text(text % model)
        keys.append(cohort_run._identity(load_cohort(path)).get(CONTACT_CODE))
    assert keys == [None, {"winkler": contact_code("winkler")}]
    keys_of_rows = []
    monkeypatch.setattr(tradeoff, "row_key", lambda *what: keys_of_rows.append(what) or "key")
    monkeypatch.setattr(tradeoff, "measure_apart", lambda job: None)
    monkeypatch.setattr(tradeoff, "compared", lambda *what: None)
    reference = SimpleNamespace(hash="", values={})
    list(tradeoff.run_tradeoff([Job("sphere", "winkler", 2.0)], {"sphere": reference}))
    assert contact_code("winkler") in keys_of_rows[0]
