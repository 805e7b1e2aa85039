"""Sobol' indices and screening: known answers, scipy as a peer, and the design itself."""

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import sobol_indices as scipy_indices

from test_uncertainty import SCENE, SLOPES, bodies_alone
from tkamb.cli import main
from tkamb.commands.uncertainty import headline
from tkamb.studies.uncertainty.bands import influences
from tkamb.studies.uncertainty.inputs import VariedInput
from tkamb.studies.uncertainty.run import estimate_uncertainty
from tkamb.studies.uncertainty.sampling import crossed_points, noise, noise_of_point, normal_samples
from tkamb.studies.uncertainty.sensitivity import Screened, screen, screen_lines, sobol_indices

A, B = 7.0, 0.1


def ishigami(normal):
    """Return Ishigami's function of uniform inputs within ±pi, from normal ones (n, 3)."""
    x = np.pi * (2.0 * ndtr(normal) - 1.0)
    return np.sin(x[:, 0]) + A * np.sin(x[:, 1]) ** 2 + B * x[:, 2] ** 4 * np.sin(x[:, 0])


def design(function, count, dimensions, seed=1):
    """Return what the indices are of a function of normal inputs, and f at A, B and AB."""
    both = normal_samples("sobol", count, 2 * dimensions, seed)
    points = crossed_points(both[:, :dimensions], both[:, dimensions:])
    values = function(np.array([point.normal for point in points]))
    names = [f"x{i}" for i in range(dimensions)]
    found = sobol_indices(["y"], names, values[:, None, None], count, seed)
    return {one.name: one for one in found}, values.reshape(dimensions + 2, count)


def test_ishigami_has_its_known_indices_and_scipy_finds_the_same():
    found, values = design(ishigami, 4096, 3)
    v1 = 0.5 * (1 + B * np.pi**4 / 5) ** 2
    v2, v13 = A**2 / 8, 8 * B**2 * np.pi**8 / 225
    variance = v1 + v2 + v13
    for name, first, total in (("x0", v1, v1 + v13), ("x1", v2, v2), ("x2", 0.0, v13)):
        assert found[name].first == pytest.approx(first / variance, abs=0.02)
        assert found[name].total == pytest.approx(total / variance, abs=0.02)
        assert 0 < found[name].total_error < 0.03
    peer = scipy_indices(
        func={"f_A": values[:1], "f_B": values[1:2], "f_AB": values[2:, None]}, n=4096
    )
    own = [[found[f"x{i}"].first, found[f"x{i}"].total] for i in range(3)]
    np.testing.assert_allclose([o[0] for o in own], peer.first_order, atol=5e-3)
    np.testing.assert_allclose([o[1] for o in own], peer.total_order, atol=5e-3)


def test_of_a_linear_map_both_indices_are_the_squared_slopes():
    found, _ = design(lambda x: 3.0 + x @ SLOPES, 1024, len(SLOPES))
    shares = SLOPES**2 / (SLOPES @ SLOPES)
    for i, share in enumerate(shares):
        one = found[f"x{i}"]
        assert one.first == pytest.approx(share, abs=0.03)
        assert one.total == pytest.approx(share, abs=0.03)
        assert abs(one.first - share) < 4 * one.first_error + 1e-3


def test_rows_with_a_failed_sample_are_left_out_and_a_constant_has_no_index():
    both = normal_samples("lhs", 256, 4, 3)
    points = crossed_points(both[:, :2], both[:, 2:])
    x = np.array([point.normal for point in points])
    y = x @ [2.0, 1.0]
    y[[5, 300, 600]] = np.nan  # of A, of B, of A with the first column of B
    (first, second) = sobol_indices(["y"], ["a", "b"], y[:, None, None], 256, 1)
    assert (first.rows, second.rows) == (253, 254)
    assert first.total == pytest.approx(0.8, abs=0.08)
    assert sobol_indices(["y"], ["a", "b"], np.ones((1024, 1, 1)), 256, 1) == []


@pytest.mark.parametrize("level", [1.0, 0.1, 2310.4567, -1e6 / 3])
def test_a_result_that_no_input_moves_has_no_rows(level):
    """The round-off of its mean was a variance, all of it "rest"."""
    assert sobol_indices(["y"], ["a", "b"], np.full((1024, 1, 1), level), 256, 1) == []
    errors = np.random.default_rng(1).standard_normal((256, 1, 2))
    assert influences(["y"], ["a", "b"], np.full((256, 1, 1), level), errors) == []
    assert influences(["y"], ["a", "b"], level + 1e-6 * level * errors[:, None, :, 0], errors)


@pytest.mark.parametrize("count", [60, 240])
def test_an_input_without_effect_has_the_share_that_chance_gives(count):
    """2/n of what the others leave, as the command line says: here noise alone, n samples."""
    random, shares = np.random.default_rng(2), []
    for _ in range(100):
        errors = random.standard_normal((count, 1, 3))
        rows = influences(["y"], list("abc"), random.standard_normal((count, 1, 1)), errors)
        shares += [one.share for one in rows if one.name != "rest"]
    assert np.mean(shares) == pytest.approx(2 / count, rel=0.15)


def test_the_noise_of_a_crossed_column_is_that_of_the_sample_it_comes_from():
    time, columns = np.linspace(0.0, 1.0, 5), [0, 1]
    points = crossed_points(np.zeros((3, 2)), np.ones((3, 2)))
    one = points[2 * 3 + 1 * 3 + 2]  # row 2 of A with the second column of B
    np.testing.assert_array_equal(one.normal, [0.0, 1.0])
    found = noise_of_point(one, columns, time, 0.1, seed=1)
    np.testing.assert_array_equal(found[:, 0], noise(2, time, 2, 0.1, seed=1)[:, 0])
    np.testing.assert_array_equal(found[:, 1], noise(5, time, 2, 0.1, seed=1)[:, 1])


def stiff_knee():
    """Return the knee without contact in which one bundle's strain and the masses vary."""
    still = {f"uncertainty__{key}": 0.0 for key in ("ap_mm", "si_mm", "ml_mm", "friction")}
    still |= {f"uncertainty__{key}_deg": 0.0 for key in ("axial_rotation", "adduction", "flexion")}
    still |= {f"uncertainty__centre_of_pressure_{axis}_mm": 0.0 for axis in ("ap", "ml")}
    lengths = ("knee_centre", "muscle_attachment", "tendon_band", "femoral_placement")
    lengths += ("insert_placement", "tuberosity", "dome")
    still |= {f"uncertainty__{key}_mm": 0.0 for key in lengths}
    still |= {"uncertainty__insert_placement_deg": 0.0, "uncertainty__muscle_strength": 0.0}
    still |= {f"uncertainty__ligament_{key}": 0.0 for key in ("stiffness", "strain")}
    return bodies_alone(**still, uncertainty__segment_mass=0.1, uncertainty__ground_reaction=0.1)


def test_indices_of_a_scene_add_up_where_loads_add_up(tmp_path, monkeypatch):
    monkeypatch.setattr("tkamb.show.report.report_html", lambda results, progress=None: "page")
    folder = tmp_path / "out"
    found = estimate_uncertainty(
        stiff_knee(),
        samples=64,
        method="sobol",
        indices=True,
        frames=slice(40, 41),
        directory=folder,
    )
    assert len(found.samples) == 64 * 4
    total = {one.name: one for one in found.indices if one.result == "force_total_N"}
    # the loads of masses and plate add up, so first order and total are alike
    for one in total.values():
        assert one.total == pytest.approx(one.first, abs=0.1)
    assert sum(one.first for one in total.values()) == pytest.approx(1.0, abs=0.15)
    assert total["ground_reaction"].total > total["segment_mass"].total
    assert (folder / "indices.csv").read_text().count("\n") > 2
    first = total["ground_reaction"]
    line = f"ground_reaction {first.first:.2f} ± {first.first_error:.2f} alone, {first.total:.2f} ±"
    assert line in "\n".join(headline(found))
    assert "up to 2% each is chance" in "\n".join(headline(found))  # 2 of 128 samples
    assert main(["verify", str(folder)]) == 0


def test_screening_is_the_central_difference_and_says_what_moves_most():
    scene, frames = stiff_knee(), slice(40, 41)
    rows = [row for row in screen(scene, frames=frames) if row.result == "force_total_BW"]
    assert [row.varied.name for row in rows] == ["ground_reaction", "segment_mass"]
    assert rows[0].minus < 0 < rows[0].plus
    # nearly linear in a factor of mean 1: one deviation of 10 % either way
    assert rows[0].slope == pytest.approx(rows[0].plus, rel=0.15)
    lines = screen_lines(rows)
    assert "force_total_BW" in lines[0] and "#|#" in lines[1]


def test_a_screening_counts_the_inputs_that_move_nothing_and_never_one_that_fails():
    def row(name, minus, plus):
        return Screened("force_total_BW", 2.0, 40.0, VariedInput(name, 1.0, "mm"), minus, plus)

    failing, moving = row("a", float("nan"), 1e-9), row("a.much.longer.name", -0.5, 0.4)
    small, none = row("c", 1e-13, -0.001), row("d", 0.0, 0.0)
    lines = screen_lines([failing, moving, small, none])
    assert [line.split()[0] for line in lines[1:3]] == ["a", "a.much.longer.name"]
    assert lines[1].index("failed") + len("failed") == lines[2].index("-0.5") + len("-0.5")
    assert lines[3].split()[:3] == ["2", "more", "inputs:"]
    assert lines[4].startswith("failed: ")
    only = screen_lines([none])
    assert only[1].split()[:3] == ["1", "more", "inputs:"]


@pytest.mark.parametrize("option", [["--out", "x"], ["--indices"], ["--resume"]])
def test_screening_writes_nothing_and_says_so(option, capsys):
    assert main(["uncertainty", str(SCENE), "--screen", *option]) == 2
    said = capsys.readouterr().err.strip()
    assert "--screen" in said and "\n" not in said
