"""The report's section on muscles: plots of activations, forces and contributions."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.transforms import Bbox

from muscle_run import ACROSS, CHANNELS, GROUPS, muscle_run
from synthetic_run import WEIGHT_N
from test_report import measure_labels
from tkamb.show.axis import horizontal_axis
from tkamb.show.muscles import activation_cells, draw_activations, muscle_panels, reserve_words
from tkamb.show.report import report_html


@pytest.fixture(scope="module")
def run():
    return muscle_run()


def test_forces_of_the_groups_are_the_sums_of_their_muscles(run):
    panel = next(panel for panel in muscle_panels(run) if panel.name == "muscle_forces")
    assert [line.label for line in panel.lines] == list(GROUPS)
    for line in panel.lines:
        total = sum(run[f"muscle_{name}_N"] for name in GROUPS[line.label])
        np.testing.assert_allclose(WEIGHT_N * line.values, total)


@pytest.mark.parametrize("side", ["medial", "lateral"])
def test_contributions_sum_to_the_force_by_equilibrium(run, side):
    panel = next(panel for panel in muscle_panels(run) if panel.name == f"from_{side}")
    whole, *parts = panel.lines
    assert {part.label for part in parts} == {
        "external loads", "ligaments", "knee extensors", "thigh to shank", "thigh to foot",
    }  # fmt: skip
    np.testing.assert_allclose(sum(part.values for part in parts), whole.values, atol=1e-9)


def test_curves_of_a_plot_differ_in_colour_or_dashes(run):
    for panel in muscle_panels(run):
        styles = [(line.colour, line.dashed) for line in panel.lines]
        assert len(set(styles)) == len(styles), panel.name


def test_every_muscle_across_the_knee_and_every_other_channel_has_a_plot(run):
    cells = activation_cells(run)
    drawn = [name for cell in cells for name in cell.muscles]
    assert len(drawn) == len(set(drawn))
    assert set(drawn) == {*GROUPS["knee extensors"], *ACROSS, *CHANNELS}
    channel = next(cell for cell in cells if "glmed1" in cell.muscles)
    assert channel.muscles == ("glmed1", "glmed2")


def test_the_plots_show_activation_and_envelope(run):
    figure = draw_activations(run, horizontal_axis(run))
    titles = {axes.get_title("left"): axes for axes in figure.axes if axes.get_visible()}
    medial = titles["gasmed"]
    np.testing.assert_allclose(medial.lines[0].get_ydata(), run["activation_gasmed"])
    assert len(medial.collections) == 1
    assert medial.get_title("right") == "r 0.81"
    assert len(titles["gaslat"].collections) == 0
    assert titles["GM (2)"].get_title("right") == "r −0.20 to 0.81"


def test_the_maximum_of_an_envelope_beyond_the_plot_is_stated(run):
    envelope = run["envelope_gasmed"]
    high = run.columns | {"envelope_gasmed": 1.5 * envelope / np.nanmax(envelope)}
    figure = draw_activations(replace(run, columns=high), horizontal_axis(run))
    titles = {axes.get_title("left"): axes.get_title("right") for axes in figure.axes}
    assert titles["gasmed"] == "r 0.81, EMG to 1.5"
    assert "EMG" not in titles["GM (2)"]


def test_reserves_are_stated_in_a_sentence(run):
    words = reserve_words(run.summary)
    assert "hip rotation 7.2 N·m (55 %, above 5 % in 31 frames)" in words
    assert "knee flexion 1.4 N·m (4 %)" in words


def test_the_page_has_the_section_on_muscles(run):
    page = report_html(run)
    assert "<h2>Muscles</h2>" in page
    assert "figure-from_medial" in page
    assert "line-measured_medial_N" in page


@pytest.mark.parametrize("kind", ["cycle", "time"])
@pytest.mark.parametrize("count", [3, 5, 13, 15])
def test_small_plots_fill_their_figure_without_overlap(run, kind, count):
    """The bounding boxes include all labels, also above an incomplete last row."""
    groups = {"knee extensors": [*GROUPS["knee extensors"], *ACROSS, *CHANNELS][:count]}
    summary = run.summary | {"muscle_groups": groups, "emg": None}
    shown = replace(run, summary=summary)
    figure = draw_activations(shown, horizontal_axis(shown, kind))
    assert len(figure.axes) == count
    canvas = FigureCanvasSVG(figure)
    canvas.draw()
    measure_labels(figure)
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    (below,) = (text.get_window_extent() for text in figure.texts)
    whole = Bbox.union([*boxes, below])
    size = figure.dpi * figure.get_size_inches()
    assert (whole.min > 0.0).all() and (whole.max < size).all()
    assert whole.height > size[1] - 6.5
    assert count < 5 or whole.width > size[0] - 6.5
    for one, other in combinations([*boxes, below], 2):
        assert not one.overlaps(other)
