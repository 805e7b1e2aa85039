"""Decks of one frame for CalculiX and FEBio."""

import shutil
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from kept_runs import keep
from scenes import write_scene
from tkamb.cli import main
from tkamb.contact.materials import material
from tkamb.errors import InputError
from tkamb.io.starter import lay_out
from tkamb.run.decks import contact_quads, frame_press
from tkamb.run.results_folder import read_results
from tkamb.run.simulation import simulate
from tkamb.studies.calculix import peer_result, run_calculix

pytestmark = pytest.mark.usefixtures("plain_report")

COARSE_MM = 4.0
WITH_CALCULIX = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX is not installed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Results folder of one frame of the starter knee, by finite elements at small strain."""
    root = tmp_path_factory.mktemp("deck")
    scene = lay_out(root / "knee")
    text = scene.read_text().replace('model = "lattice"', 'model = "fe"')
    text = text.replace('material = "polyethylene"', 'material = "polyethylene-linear"')
    scene.write_text(text)
    results = simulate(scene, frames=slice(2, 3), resolution_mm=COARSE_MM)
    return keep(results, root / "run")


@pytest.fixture(scope="module")
def pressed(folder):
    """Return the contact problem and the result of the frame."""
    return frame_press(folder, 0)


@WITH_CALCULIX
def test_calculix_balances_the_load_of_the_deck(pressed):
    result, balance = peer_result(pressed.problem, run_calculix(pressed.deck("ccx")))
    assert balance == pytest.approx(1.0, abs=2e-3)
    assert -result.wrench_on_insert[1] == pytest.approx(pressed.problem.load, rel=2e-3)
    # The deck has the facets of the femur. Their centres are 10 µm off the smooth surface (median).
    assert result.approach == pytest.approx(pressed.approach, abs=1e-5)


@pytest.mark.slow
@WITH_CALCULIX
def test_calculix_agrees_with_a_frame_of_the_shipped_knee(tmp_path):
    """The tolerances are the differences of lattice and CalculiX at 2 mm in the trade-off study."""
    settings = {"contact__model": "fe", "contact__material": "polyethylene-linear"}
    scene = write_scene(tmp_path / "knee", **settings)
    out = tmp_path / "run"
    run = ["run", str(scene), "--frames", "50:51", "--resolution", "3", "--out", str(out)]
    assert main(run) == 0
    pressed = frame_press(out, 0)
    result, _ = peer_result(pressed.problem, run_calculix(pressed.deck("ccx")))
    assert result.approach == pytest.approx(pressed.approach, rel=0.006)
    assert result.pressure.max() == pytest.approx(pressed.peak_pressure, rel=0.047)


def test_the_deck_states_frame_model_approach_and_load(folder, pressed, tmp_path, capsys):
    out = tmp_path / "frame.inp"
    command = ["export", str(folder), "--deck", "ccx", "--frame", "0", "--out", str(out)]
    assert main(command) == 0
    lines = out.read_text().splitlines()
    assert lines[0].startswith("** Frame 0 of ") and "by fe at 4 mm" in lines[0]
    assert any(f"approach since first touch {pressed.approach * 1e3:.6g} mm" in k for k in lines)
    assert f"load {pressed.problem.load:.6g} N" in capsys.readouterr().out


def test_the_febio_deck_has_the_same_bodies_and_the_approach(pressed):
    root = ElementTree.fromstring(pressed.deck("feb"))
    assert root.get("version") == "4.0"
    texts = [element.text.split(",") for element in root.findall("Mesh/Nodes/node")]
    nodes = np.array(texts, float) * 1e-3
    lattice, patch = pressed.problem.lattice, pressed.problem.patch
    count = len(lattice.nodes)
    np.testing.assert_allclose(nodes[:count], lattice.nodes, atol=1e-10)
    cells = [
        element.text.split(",") for element in root.findall("Mesh/Elements[@name='insert']/elem")
    ]
    np.testing.assert_array_equal(np.array(cells, int) - 1, lattice.cells)
    displacement = nodes[count:] - patch.vertices
    np.testing.assert_allclose(
        displacement, [[0, pressed.problem.depth, 0]] * len(displacement), atol=1e-10
    )
    (travel,) = root.findall("Rigid/rigid_bc[@type='rigid_displacement']/value")
    assert float(travel.text) == pytest.approx(-pressed.approach * 1e3)
    quads = contact_quads(lattice)
    a, b, c, d = (lattice.nodes[quads[:, k]] for k in range(4))
    vertical = np.cross(c - a, d - b)[:, 1]
    assert len(quads) > 50 and (vertical > 0).all()  # outward of the articular surface is upward
    assert set(np.unique(lattice.contact_triangles)) == set(np.unique(quads))


def test_a_deck_states_its_differences_from_the_run(folder, pressed, tmp_path, capsys):
    (line,) = pressed.notes
    assert "Material 'polyethylene-linear', linear: E 561.5 MPa, nu 0.45" in line
    assert "the run's model assumes finite elements" in line
    results = read_results(folder)
    post = {"post_force_N": 123.0, "post_peak_pressure_MPa": 9.5}
    columns = results.columns | {name: np.array([value]) for name, value in post.items()}
    summary = results.summary | {"side": "left", "lateral_axis": "-z"}
    other = keep(replace(results, columns=columns, summary=summary), tmp_path / "other")
    for kind, suffix in (("ccx", "inp"), ("feb", "feb")):
        out = tmp_path / f"frame.{suffix}"
        assert main(["export", str(other), "--deck", kind, "--frame", "0", "--out", str(out)]) == 0
        output = capsys.readouterr().out
        for words in ("not in this deck: 123 N, peak 9.5 MPa", "show its mirror image"):
            assert words in out.read_text() and words in output
        assert "z medial" in out.read_text()
    assert main(["export", str(other), "--vtp", "--out", str(tmp_path / "vtp")]) == 0
    assert "without the post's pressure" in capsys.readouterr().out


def test_a_febio_deck_of_a_nonlinear_material_is_refused(pressed):
    pair = replace(pressed.problem.pair, material=material("polyethylene"))
    nonlinear = replace(pressed, problem=replace(pressed.problem, pair=pair))
    with pytest.raises(InputError, match="polyethylene-linear"):
        nonlinear.deck("feb")


@pytest.mark.parametrize(("frame", "words"), [("7", "no frame 7"), ("-2", "no frame -2")])
def test_a_missing_frame_is_refused_in_one_line(folder, tmp_path, capsys, frame, words):
    out = tmp_path / "frame.inp"
    command = ["export", str(folder), "--deck", "ccx", f"--frame={frame}", "--out", str(out)]
    assert main(command) == 2
    output = capsys.readouterr().err
    assert words in output and output.count("\n") == 1 and not out.exists()
