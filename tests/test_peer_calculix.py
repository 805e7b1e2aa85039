"""CalculiX: its deck, its process and, if it is installed, its results."""

import json
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from lattice_bodies import dished_insert
from tkamb.contact.lattice.meshing.grid import build_grid
from tkamb.contact.materials import material, tabulated_material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import knee_pose
from tkamb.geometry.surface import Surface
from tkamb.run.decks import Deck, press_problem
from tkamb.studies import calculix as peer
from tkamb.studies.calculix import PeerRun, measure_by_calculix, press_by_calculix, run_calculix
from tkamb.studies.cases import balls, block, dishes, study_case
from tkamb.studies.references import read_references
from tkamb.studies.tradeoff import run_peer

ROOT = Path(__file__).parents[1]
WITH_CALCULIX = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX is not installed")
LINEAR, NONLINEAR = "polyethylene-linear", "polyethylene"


def two_condyles(material_name):
    insert = block(dishes(8e-3, 34e-3, 11e-3), (30e-3, 46e-3), 1e-3)
    return ContactPair(balls(22e-3, 11e-3, sectors=64), insert, material(material_name))


def deck(**changes):
    lattice = build_grid(dished_insert(cells=24), 6e-3)
    patch = Surface(np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0.0]]), np.array([[0, 1, 2]]), "patch")
    arguments = {"lattice": lattice, "patch": patch, "material": material(LINEAR),
                 "bearing": "fixed", "load": 1000.0, "element": "C3D8I"} | changes  # fmt: skip
    return Deck(**arguments)


def test_an_undeformed_insert_has_the_gaps_of_its_smooth_surface():
    """The nodes lie on the smooth surface above facets of 2 mm, and the gaps start there."""
    insert = block(lambda x, z: 8e-3 + (x**2 + z**2) / 120e-3, (16e-3, 16e-3), 2e-3)
    bodies = ContactPair(balls(22e-3, 0.0), insert, material(LINEAR))
    problem = press_problem(bodies, 500.0, knee_pose(np.zeros(6)), 1.0)
    displacement = np.zeros((len(problem.lattice.nodes), 4))
    displacement[:, 0] = np.arange(1, len(displacement) + 1)
    deformed = peer._deformed_map(problem, PeerRun({"NINSERT": displacement}, 0.0, 0.0, 0))
    pose = knee_pose([0, 40e-3, 0, 0, 0, 0])
    gap = peer._gaps(problem, pose, deformed)
    x, y, z = problem.map.points.T
    smooth = y + problem.map.lift
    near = np.hypot(x, z) < 5e-3
    assert np.abs(problem.map.lift[near]).max() > 5e-6
    exact = 40e-3 - np.sqrt(22e-3**2 - x[near] ** 2 - z[near] ** 2) - smooth[near]
    np.testing.assert_allclose(gap[near], exact, atol=2e-6)


def fake_program(folder, monkeypatch, script):
    """Replace CalculiX by a shell script."""
    program = folder / "ccx"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")


def test_the_deck_contains_nodes_and_cells_of_the_lattice_in_millimetres():
    linear_deck = deck()
    lines = linear_deck.text.splitlines()
    start = lines.index("*NODE, NSET=NALL") + 1
    count = len(linear_deck.lattice.nodes)
    nodes = np.array([line.split(",") for line in lines[start : start + count]], float)
    assert nodes[:, 0] == pytest.approx(np.arange(1, count + 1))
    assert nodes[:, 1:] / 1e3 == pytest.approx(linear_deck.lattice.nodes, abs=1e-10)
    start = lines.index("*ELEMENT, TYPE=C3D8I, ELSET=INSERT") + 1
    cells = [line.split(",") for line in lines[start : start + len(linear_deck.lattice.cells)]]
    assert (np.array(cells, int)[:, 1:] - 1 == linear_deck.lattice.cells).all()
    assert "*STEP, INC=300" in lines
    assert "*STEP, INC=300, NLGEOM" in deck(material=material(NONLINEAR)).text.splitlines()


def test_materials_and_bearings_that_calculix_lacks_are_refused():
    with pytest.raises(InputError, match="bottom"):
        _ = deck(bearing="mobile").text
    tabulated = tabulated_material("table", [0.0, 0.01, 0.05], [0.0, 5e6, 15e6], 0.45)
    with pytest.raises(InputError, match="a law that CalculiX does not have"):
        _ = deck(material=tabulated).text


def test_without_calculix_the_error_gives_the_install_command(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match=r"CalculiX.*not installed.*apt-get"):
        list(run_peer([study_case("two condyles")], read_references()))


def test_a_slow_or_failed_run_gives_a_measure_with_the_reason(tmp_path, monkeypatch):
    fake_program(tmp_path, monkeypatch, "exec sleep 60")
    measure = measure_by_calculix(study_case("sphere"), 6.0, longest=0.3)
    assert "stopped after 0.3 s" in measure.status
    assert not measure.values
    fake_program(tmp_path, monkeypatch, "echo '*ERROR in material: no modulus'; exit 201")
    measure = measure_by_calculix(study_case("sphere"), 6.0)
    assert "no modulus" in measure.status


def test_a_run_without_output_is_an_error(tmp_path, monkeypatch):
    fake_program(tmp_path, monkeypatch, "echo done")
    with pytest.raises(ComputationError, match="no output"):
        run_calculix("")


@WITH_CALCULIX
def test_the_pressures_of_calculix_integrate_to_the_load():
    answer = press_by_calculix(two_condyles(LINEAR), 1000.0, np.eye(4), 4.0)
    assert answer.balance == pytest.approx(1, abs=2e-3)
    result = answer.result
    assert result.medial.force == pytest.approx(result.lateral.force, rel=1e-4)
    assert -result.wrench_on_insert[1] == pytest.approx(1000.0, rel=2e-3)
    assert answer.run.iterations > 1
    assert 10 < answer.run.peak_rss_MB < 1000


@pytest.mark.slow
@WITH_CALCULIX
@pytest.mark.parametrize(("load", "varus"), [(1000.0, 0.0), (2500.0, 0.0), (2500.0, 0.3)])
def test_linear_lattice_and_fe_agree_with_calculix(load, varus):
    pair, pose = two_condyles(LINEAR), knee_pose([0, 0, 0, 0, np.radians(varus), 0])
    peer = press_by_calculix(pair, load, pose, 2.0).result
    for name, approach, peak in (("lattice", 0.02, 0.04), ("fe", 0.015, 0.02)):
        model = contact_model(name, resolution=2e-3)
        result = model.press(model.prepare(pair), load, pose)
        assert result.approach == pytest.approx(peer.approach, rel=approach)
        assert result.pressure.max() == pytest.approx(peer.pressure.max(), rel=peak)
        for side in ("medial", "lateral"):
            force = getattr(peer, side).force
            assert getattr(result, side).force == pytest.approx(force, rel=0.02)


@pytest.mark.slow
@WITH_CALCULIX
@pytest.mark.parametrize("varus", [0.0, 0.3])
def test_small_strain_agrees_with_finite_strain_of_calculix(varus):
    pair, pose = two_condyles(NONLINEAR), knee_pose([0, 0, 0, 0, np.radians(varus), 0])
    peer = press_by_calculix(pair, 2000.0, pose, 2.0).result
    model = contact_model("lattice", resolution=2e-3)
    result = model.press(model.prepare(pair), 2000.0, pose)
    assert result.approach == pytest.approx(peer.approach, rel=0.05)
    assert result.pressure.max() == pytest.approx(peer.pressure.max(), rel=0.05)
    assert result.medial.force == pytest.approx(peer.medial.force, rel=0.03)


def test_the_page_agrees_with_its_script_and_data(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "scripts" / "measure"))
    script = runpy.run_path(str(ROOT / "scripts" / "measure" / "peer_calculix.py"))
    rows = json.loads(
        (ROOT / "scripts" / "data" / "peer_calculix.json").read_text(encoding="utf-8")
    )
    text = (ROOT / "docs" / "development" / "peer_calculix.md").read_text(encoding="utf-8")
    assert script["with_block"](text, script["block"](rows), "peer") == text, (
        "run scripts/measure/peer_calculix.py --page"
    )
