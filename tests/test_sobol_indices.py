"""Sobol' indices and screening: closed forms, comparison with scipy, and Saltelli's design."""

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import sobol_indices as scipy_indices

from test_uncertainty import SCENE, SLOPES, bodies_alone
from tkamb.cli import main
from tkamb.commands.uncertainty import headline
from tkamb.studies.uncertainty.bands import influences
from tkamb.studies.uncertainty.inputs import (
    VariedInput,
    crossed_points,
    noise,
    noise_of_point,
    normal_samples,
)
from tkamb.studies.uncertainty.run import estimate_uncertainty
from tkamb.studies.uncertainty.sensitivity import Screened, screen, screen_lines, sobol_indices

pytestmark = pytest.mark.usefixtures("plain_report")

A, B = 7.0, 0.1


def ishigami(normal):
    """Return Ishigami's function of inputs within ±pi, from standard normal values (n, 3)."""
    x = np.pi * (2.0 * ndtr(normal) - 1.0)
    return np.sin(x[:, 0]) + A * np.sin(x[:, 1]) ** 2 + B * x[:, 2] ** 4 * np.sin(x[:, 0])


def design(function, count, dimensions, seed=1):
    """Return the indices of a function of normal inputs, and its values at A, B and AB."""
    normal = normal_samples("sobol", count, 2 * dimensions, seed)
    points = crossed_points(normal[:, :dimensions], normal[:, dimensions:])
    values = function(np.array([point.normal for point in points]))
    names = [f"x{i}" for i in range(dimensions)]
    indices = sobol_indices(["y"], names, values[:, None, None], count, seed)
    return {index.name: index for index in indices}, values.reshape(dimensions + 2, count)


def test_the_indices_of_ishigamis_function_agree_with_theory_and_scipy():
    indices, values = design(ishigami, 4096, 3)
    v1 = 0.5 * (1 + B * np.pi**4 / 5) ** 2
    v2, v13 = A**2 / 8, 8 * B**2 * np.pi**8 / 225
    variance = v1 + v2 + v13
    for name, first, total in (("x0", v1, v1 + v13), ("x1", v2, v2), ("x2", 0.0, v13)):
        assert indices[name].first == pytest.approx(first / variance, abs=0.02)
        assert indices[name].total == pytest.approx(total / variance, abs=0.02)
        assert 0 < indices[name].total_error < 0.03
    peer = scipy_indices(
        func={"f_A": values[:1], "f_B": values[1:2], "f_AB": values[2:, None]}, n=4096
    )
    computed = [[indices[f"x{i}"].first, indices[f"x{i}"].total] for i in range(3)]
    np.testing.assert_allclose([index[0] for index in computed], peer.first_order, atol=5e-3)
    np.testing.assert_allclose([index[1] for index in computed], peer.total_order, atol=5e-3)


def test_both_indices_of_a_linear_map_are_its_squared_slopes():
    indices, _ = design(lambda x: 3.0 + x @ SLOPES, 1024, len(SLOPES))
    shares = SLOPES**2 / (SLOPES @ SLOPES)
    for i, share in enumerate(shares):
        index = indices[f"x{i}"]
        assert index.first == pytest.approx(share, abs=0.03)
        assert index.total == pytest.approx(share, abs=0.03)
        assert abs(index.first - share) < 4 * index.first_error + 1e-3


def test_rows_with_a_failed_sample_are_omitted_and_a_constant_has_no_index():
    normal = normal_samples("lhs", 256, 4, 3)
    points = crossed_points(normal[:, :2], normal[:, 2:])
    x = np.array([point.normal for point in points])
    y = x @ [2.0, 1.0]
    y[[5, 300, 600]] = np.nan  # in A, in B, in A with the first column of B
    (first, second) = sobol_indices(["y"], ["a", "b"], y[:, None, None], 256, 1)
    assert (first.rows, second.rows) == (253, 254)
    assert first.total == pytest.approx(0.8, abs=0.08)
    assert sobol_indices(["y"], ["a", "b"], np.ones((1024, 1, 1)), 256, 1) == []


@pytest.mark.parametrize("level", [1.0, 0.1, 2310.4567, -1e6 / 3])
def test_a_constant_result_has_no_rows(level):
    assert sobol_indices(["y"], ["a", "b"], np.full((1024, 1, 1), level), 256, 1) == []
    errors = np.random.default_rng(1).standard_normal((256, 1, 2))
    assert influences(["y"], ["a", "b"], np.full((256, 1, 1), level), errors) == []
    assert influences(["y"], ["a", "b"], level + 1e-6 * level * errors[:, None, :, 0], errors)


@pytest.mark.parametrize("count", [60, 240])
def test_an_input_without_effect_has_the_share_of_chance(count):
    """The result is noise. In n samples chance explains 2/n of its variance."""
    random, shares = np.random.default_rng(2), []
    for _ in range(100):
        errors = random.standard_normal((count, 1, 3))
        rows = influences(["y"], list("abc"), random.standard_normal((count, 1, 1)), errors)
        shares += [row.share for row in rows if row.name != "rest"]
    assert np.mean(shares) == pytest.approx(2 / count, rel=0.15)


def test_a_crossed_column_brings_the_noise_of_its_sample():
    time, columns = np.linspace(0.0, 1.0, 5), [0, 1]
    points = crossed_points(np.zeros((3, 2)), np.ones((3, 2)))
    point = points[2 * 3 + 1 * 3 + 2]  # row 2 of A with the second column of B
    np.testing.assert_array_equal(point.normal, [0.0, 1.0])
    crossed_noise = noise_of_point(point, columns, time, 0.1, seed=1)
    np.testing.assert_array_equal(crossed_noise[:, 0], noise(2, time, 2, 0.1, seed=1)[:, 0])
    np.testing.assert_array_equal(crossed_noise[:, 1], noise(5, time, 2, 0.1, seed=1)[:, 1])


def knee_with_varied_loads():
    """Return the knee without contact, in which only segment mass and ground reaction vary."""
    constant = {f"uncertainty__{key}": 0.0 for key in ("ap_mm", "si_mm", "ml_mm", "friction")}
    constant |= {
        f"uncertainty__{key}_deg": 0.0 for key in ("axial_rotation", "adduction", "flexion")
    }
    constant |= {f"uncertainty__centre_of_pressure_{axis}_mm": 0.0 for axis in ("ap", "ml")}
    lengths = ("knee_centre", "muscle_attachment", "tendon_band", "femoral_placement")
    lengths += ("insert_placement", "tuberosity", "dome")
    constant |= {f"uncertainty__{key}_mm": 0.0 for key in lengths}
    constant |= {"uncertainty__insert_placement_deg": 0.0, "uncertainty__muscle_strength": 0.0}
    constant |= {f"uncertainty__ligament_{key}": 0.0 for key in ("stiffness", "strain")}
    return bodies_alone(**constant, uncertainty__segment_mass=0.1, uncertainty__ground_reaction=0.1)


def test_first_order_and_total_index_agree_for_additive_loads(tmp_path):
    folder = tmp_path / "out"
    analysis = estimate_uncertainty(
        knee_with_varied_loads(),
        samples=64,
        method="sobol",
        indices=True,
        frames=slice(40, 41),
        directory=folder,
    )
    assert len(analysis.samples) == 64 * 4
    total = {index.name: index for index in analysis.indices if index.result == "force_total_N"}
    # the loads of masses and ground reaction are additive, so both indices are equal
    for index in total.values():
        assert index.total == pytest.approx(index.first, abs=0.1)
    assert sum(index.first for index in total.values()) == pytest.approx(1.0, abs=0.15)
    assert total["ground_reaction"].total > total["segment_mass"].total
    assert (folder / "indices.csv").read_text().count("\n") > 2
    first = total["ground_reaction"]
    line = f"ground_reaction {first.first:.2f} ± {first.first_error:.2f} alone, {first.total:.2f} ±"
    assert line in "\n".join(headline(analysis))
    assert "up to 2% each is chance" in "\n".join(headline(analysis))  # 2 of 128 samples
    assert main(["verify", str(folder)]) == 0


def test_screening_gives_central_differences_largest_first():
    scene, frames = knee_with_varied_loads(), slice(40, 41)
    rows = [row for row in screen(scene, frames=frames) if row.result == "force_total_BW"]
    assert [row.varied.name for row in rows] == ["ground_reaction", "segment_mass"]
    assert rows[0].minus < 0 < rows[0].plus
    # the result is nearly linear in a factor with mean 1 and a deviation of 10 %
    assert rows[0].slope == pytest.approx(rows[0].plus, rel=0.15)
    lines = screen_lines(rows)
    assert "force_total_BW" in lines[0] and "#|#" in lines[1]


def test_a_screening_lists_failures_and_counts_inputs_of_small_effect():
    def row(name, minus, plus):
        return Screened("force_total_BW", 2.0, 40.0, VariedInput(name, 1.0, "mm"), minus, plus)

    failing, moving = row("a", float("nan"), 1e-9), row("a.much.longer.name", -0.5, 0.4)
    small, no_effect = row("c", 1e-13, -0.001), row("d", 0.0, 0.0)
    lines = screen_lines([failing, moving, small, no_effect])
    assert [line.split()[0] for line in lines[1:3]] == ["a", "a.much.longer.name"]
    assert lines[1].index("failed") + len("failed") == lines[2].index("-0.5") + len("-0.5")
    assert lines[3].split()[:3] == ["2", "more", "inputs:"]
    assert lines[4].startswith("failed: ")
    lines_of_no_effect = screen_lines([no_effect])
    assert lines_of_no_effect[1].split()[:3] == ["1", "more", "inputs:"]


@pytest.mark.parametrize("option", [["--out", "x"], ["--indices"], ["--resume"]])
def test_screening_refuses_options_of_written_results(option, capsys):
    assert main(["uncertainty", str(SCENE), "--screen", *option]) == 2
    message = capsys.readouterr().err.strip()
    assert "--screen" in message and "\n" not in message
