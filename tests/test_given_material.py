"""A user's material: [material] of a scene, a file for `press`, and in Python."""

import json

import numpy as np
import pytest

from scenes import MODEL, write_scene
from tkamb.cli import main
from tkamb.contact.materials import LinearElastic, Material, material
from tkamb.errors import InputError
from tkamb.io.given_material import given_material, material_as_json, named_material
from tkamb.io.scene import load_scene
from tkamb.run.identity import scene_hash
from tkamb.run.press import press_meshes
from tkamb.run.simulation import simulate
from tkamb.studies.wear.setup import wear_setup

CURVE = {"strain": (0.0, 0.01, 0.05, 0.2), "stress_MPa": (0.0, 6.0, 15.0, 22.0)}
POSE = (-6.9, 30.7, 0.0, 0.0, 0.0, 0.0)
FEMORAL, INSERT = MODEL / "femoral_component.stl", MODEL / "insert.stl"


def test_each_law_follows_its_formula():
    strain = np.array([-0.05, 0.0, 0.004, 0.05])
    linear = given_material({"young_modulus_MPa": 800, "poisson_ratio": 0.4})
    assert isinstance(linear.law, LinearElastic)
    assert linear.stress(strain) == pytest.approx(800e6 * strain)
    numbers = {"alpha": 0.05, "reference_stress_MPa": 9.0, "exponent": 4.0}
    ramberg_osgood = given_material(
        {"young_modulus_MPa": 800, "poisson_ratio": 0.4, "law": "ramberg-osgood", **numbers}
    )
    stress = ramberg_osgood.stress(strain)
    total_strain = stress / 800e6 + 0.05 * np.abs(stress / 9e6) ** 3 * stress / 800e6
    assert total_strain == pytest.approx(strain, abs=1e-12)
    table = given_material({"poisson_ratio": 0.4, "law": "tabulated", **CURVE})
    assert table.stress(CURVE["strain"]) / 1e6 == pytest.approx(CURVE["stress_MPa"])
    scaled_curve = {"poisson_ratio": 0.4, "law": "tabulated", **CURVE}
    scaled_curve["young_modulus_MPa"] = 2 * table.young_modulus / 1e6
    assert given_material(scaled_curve).stress(strain) == pytest.approx(2 * table.stress(strain))


def test_a_base_gives_the_missing_values_and_the_sources():
    assert given_material({"base": "polyethylene"}) == material("polyethylene")
    stiffer = given_material({"base": "polyethylene", "young_modulus_MPa": 900.0})
    base = material("polyethylene")
    assert (stiffer.young_modulus, stiffer.poisson_ratio) == (900e6, base.poisson_ratio)
    assert stiffer.law == base.law and stiffer.name == "polyethylene (changed)"
    assert any("Halloran" in source for source in stiffer.sources)
    linear = given_material({"base": "polyethylene", "law": "linear"})
    assert isinstance(linear.law, LinearElastic)
    record = material_as_json(stiffer)
    assert (record["young_modulus_MPa"], record["law"]) == (900.0, "ramberg-osgood")


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"poisson_ratio": 0.4}, "'young_modulus_MPa' is missing"),
        ({"young_modulus_MPa": 500}, "'poisson_ratio' is missing"),
        ({"young_modulus_MPa": 500, "poisson_ratio": 0.5}, "Poisson's ratio 0.5"),
        ({"young_modulus_MPa": "500", "poisson_ratio": 0.4}, "cannot be '500'"),
        ({"young_modulus_MPa": 500, "poisson_ratio": 0.4, "alpha": 0.1}, "not a key of the law"),
        ({"poisson_ratio": 0.4, "law": "tabulated", "strain": (0.0, 0.1)}, "needs 'stress_MPa'"),
        ({"poisson_ratio": 0.4, "law": "tabulated", **CURVE, "strain": (0, 1, 2, 1)}, "no stress"),
        ({"base": "polyethilene"}, "did you mean"),
        ({"base": "polyethylene", "young_modulus": 1.0}, "unknown key"),
        ({"young_modulus_MPa": 5, "poisson_ratio": 0.4, "name": "polyethylene"}, "built-in"),
        ({"young_modulus_MPa": 5, "poisson_ratio": 0.4, "law": "hooke"}, "no law 'hooke'"),
    ],
)
def test_an_impossible_material_is_refused(table, words):
    with pytest.raises(InputError, match=words):
        given_material(table)


@pytest.fixture(scope="module")
def soft(tmp_path_factory):
    """Return the path of a material file."""
    path = tmp_path_factory.mktemp("material") / "soft.toml"
    text = 'young_modulus_MPa = 300.0\npoisson_ratio = 0.45\nsources = ["measured here"]\n'
    path.write_text(text, encoding="utf-8")
    return path


def test_press_accepts_a_file_a_name_or_a_material_and_reports_it(soft, capsys):
    command = ["press", str(FEMORAL), str(INSERT), "--load", "1500", "--pose"]
    command += [*map(str, POSE), "--contact", "foundation-linear", "--resolution", "3", "--json"]
    assert main([*command, "--material", str(soft)]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["material"]["young_modulus_MPa"] == 300.0
    assert output["material"]["sources"] == ["measured here"]
    assert output["known_error"] == "not measured"
    options = {"pose": POSE, "contact": "foundation-linear", "resolution_mm": 3.0}
    reference = press_meshes(FEMORAL, INSERT, 1500.0, material=named_material(soft), **options)
    assert reference.result.approach * 1e3 == pytest.approx(output["approach_mm"])
    # the pressure is E over h times the depth: load and E in the same ratio give the same depth
    scaled_load = press_meshes(
        FEMORAL, INSERT, 1500.0 * 561.5 / 300.0, material="polyethylene-linear", **options
    )
    assert scaled_load.result.approach == pytest.approx(reference.result.approach, rel=1e-3)
    assert main([*command, "--material", "soft.tml"]) == 2
    assert "no material 'soft.tml'" in capsys.readouterr().err


def test_contact_summary_and_wear_use_the_scene_s_material(tmp_path):
    scene_values = {"young_modulus_MPa": 300.0, "poisson_ratio": 0.45, "yield_stress_MPa": 12.0}
    changes = {f"material__{key}": value for key, value in scene_values.items()}
    path = write_scene(
        tmp_path,
        contact__material=None,
        contact__resolution_mm=4.0,
        output__yield_stress_MPa=None,
        **changes,
    )
    scene, frames = load_scene(path), slice(60, 61)
    run = simulate(scene, frames=frames)
    linear = {"contact__material": "polyethylene-linear", "contact__resolution_mm": 4.0}
    plain = simulate(write_scene(tmp_path / "plain", **linear), frames=frames)
    peak = "medial_peak_pressure_MPa"
    assert run[peak][0] < plain[peak][0]
    record = run.summary["material"]
    assert (record["name"], record["young_modulus_MPa"], record["law"]) == ("own", 300.0, "linear")
    assert run.summary["yield_stress_MPa"] == 12.0
    assert run.summary["known_error"] == "not measured"
    assert plain.summary["material"]["young_modulus_MPa"] == 561.5
    assert wear_setup(path, frames=2, resolution_mm=6.0).engine.material.young_modulus == 300e6


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"material__base": "polyethylene"}, "name two materials"),
        (
            {"contact__material": None, "material__base": "polyethylene", "material__e": 3},
            "unknown",
        ),
        (
            {"contact__material": None, "material__base": "polyethylene"}
            | {"material__yield_stress_MPa": 20.0},
            "both give yield_stress_MPa",
        ),
    ],
)
def test_contradicting_declarations_are_refused(tmp_path, changes, words):
    with pytest.raises(InputError, match=words):
        load_scene(write_scene(tmp_path, **changes))


def test_materials_change_the_identity_of_a_run_and_wear_keys_do_not(tmp_path):
    plain = load_scene(write_scene(tmp_path / "a"))
    with_wear = load_scene(write_scene(tmp_path / "b", wear__close="as recorded"))
    other = load_scene(
        write_scene(tmp_path / "c", contact__material=None, material__base="polyethylene-linear")
    )
    hashes = [scene_hash(loaded) for loaded in (plain, with_wear, other)]
    assert hashes[0] == hashes[1] != hashes[2]


def test_an_override_of_the_material_replaces_the_material_of_the_scene():
    path = MODEL / "scene.toml"  # names [contact] material and [output] yield_stress_MPa
    scene = load_scene(path, {"material.base": "polyethylene", "material.yield_stress_MPa": 25.0})
    assert scene.material is not None and scene.material.yield_stress_MPa == 25.0
    scene = load_scene(path, {"material": {"base": "polyethylene", "young_modulus_MPa": 900.0}})
    assert given_material(scene.insert_material).young_modulus == pytest.approx(900e6)
    with pytest.raises(InputError, match="two materials"):
        load_scene(path, {"material.base": "polyethylene", "contact.material": "polyethylene"})


def test_an_override_by_a_built_in_name_replaces_the_scene_s_own_material(tmp_path):
    path = write_scene(tmp_path, contact__material=None, material__base="polyethylene")
    named = load_scene(path, {"contact.material": "polyethylene-linear"})
    assert named.material is None and named.contact.material == "polyethylene-linear"


def test_a_law_of_the_user_s_own_is_not_described_as_the_built_in_law_that_it_changes():
    class Half(LinearElastic):
        def stress(self, strain, young_modulus):
            return 0.5 * super().stress(strain, young_modulus)

    own = Material("own", 500e6, 0.4, Half())
    assert not own.is_linear
    assert material_as_json(own)["law"] == "Half"
