"""Legibility of a report: distinguishable colours, conclusions of the run, smooth maps."""

import re
from itertools import combinations
from typing import get_args

import numpy as np
import pytest
from matplotlib.colors import Normalize

from synthetic_run import make_run
from tkamb.io.activities import PEAKS_BW, Activity
from tkamb.run.maps import ContactMaps
from tkamb.run.results import Results
from tkamb.show import style
from tkamb.show.axis import horizontal_axis
from tkamb.show.levels import PageGrid, pressure_levels
from tkamb.show.pages import asset
from tkamb.show.panels import panels
from tkamb.show.plots import Sheet
from tkamb.show.pressure_maps import STEP_MM, TopView, draw_pressure
from tkamb.show.sections import conclusions
from tkamb.show.style import new_figure


@pytest.fixture(scope="module")
def bend():
    return make_run("bend", maps=False)


@pytest.fixture(scope="module")
def gait():
    return make_run("gait", maps=False)


def test_a_grid_over_the_insert_interpolates_linearly_and_ends_at_its_edge():
    points = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.01, 0, 0.01], [0, 0, 0.01]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    grid = PageGrid(points, triangles, -1.0, 1.0)
    x, z = np.meshgrid(grid.up, grid.across, indexing="ij")
    values = grid.sample(points @ [200.0, 0.0, -300.0] + 5.0)
    over = values != -1.0
    inside = (x > 0.1) & (x < 9.9) & (z < -0.1) & (z > -9.9)
    assert over[inside].all()
    np.testing.assert_allclose(values[over], (0.2 * x + 0.3 * z)[over] + 5.0, atol=1e-9)
    outside = np.array([0.0, 0, np.inf, np.inf])  # infinite gap: the femur is not above
    level = pressure_levels(np.array([[2.0, 2, 0, 0]]), outside[None], triangles, 4.0)[0]
    assert list(level) == [0.5, 0.5, -0.5, -0.5]


def test_the_grid_shows_the_highest_of_overlapping_triangles():
    """A ledge lies above a floor, with a vertical wall between them."""
    ledge = np.array([[0.0, 2e-3, 0], [0.004, 2e-3, 0], [0.004, 2e-3, 0.01], [0, 2e-3, 0.01]])
    floor = ledge * [2.5, 0, 1]
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7], [1, 2, 6], [1, 6, 5]])
    points = np.concatenate([floor, ledge])[[4, 5, 6, 7, 0, 1, 2, 3]]
    grid = PageGrid(points, np.concatenate([triangles[2:4], triangles[:2]]), 1.0, 1.0)
    x = np.meshgrid(grid.up, grid.across, indexing="ij")[0]
    height = grid.sample(points[:, 1] * 1e3)
    assert (height[x <= 4.0] == pytest.approx(2.0)) and (height[x > 4.5] == pytest.approx(0.0))


def test_the_in_vivo_peaks_of_the_activity_are_shaded_behind_the_force(bend):
    assert set(PEAKS_BW) == set(get_args(Activity))
    (plain,) = (one for one in panels(bend) if one.name == "forces")
    assert plain.span is None
    run = Results(bend.columns, bend.summary | {"activity": "squat"}, None)
    (panel,) = (one for one in panels(run) if one.name == "forces")
    assert panel.span[:2] == (2.1, 2.53)
    assert "Kutzner 2010" in panel.note and "D'Lima 2007" in panel.note
    axes = Sheet(run, horizontal_axis(run)).draw(panel).axes[0]
    (shade,) = [one for one in axes.patches if one.get_gid() == "span"]
    assert (shade.get_y(), shade.get_y() + shade.get_height()) == pytest.approx((2.1, 2.53))


def linear_rgb(colour):
    rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def contrast(colour, ground="#ffffff"):
    """Return the contrast ratio of WCAG 2.1."""
    low, high = sorted(float(linear_rgb(c) @ [0.2126, 0.7152, 0.0722]) for c in (colour, ground))
    return (high + 0.05) / (low + 0.05)


# Machado, Oliveira & Fernandes (2009), severity 1, in linear RGB
VISIONS = {
    "usual": np.eye(3),
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
}


def lab(rgb):
    """Return CIELAB coordinates of a linear sRGB colour."""
    to_xyz = [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
    x = to_xyz @ np.clip(rgb, 0, 1) / [0.95047, 1.0, 1.08883]
    f = np.where(x > 0.008856, np.cbrt(x), 7.787 * x + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("vision", VISIONS)
def test_colours_of_a_plot_can_be_distinguished(vision):
    """Two greys, one half as bright as the other, differ by about 20 units of CIELAB."""
    together = (
        (style.MEDIAL, style.LATERAL, style.BLACK),
        (style.SUPERIOR, style.ANTERIOR, style.RIGHT, style.BLACK),
        sorted(set(style.FORCE_COLOURS.values())),
        style.LIST,
    )
    for group in together:
        assert all(contrast(colour) >= 3.0 for colour in group)
        perceived = [lab(np.array(VISIONS[vision]) @ linear_rgb(colour)) for colour in group]
        assert min(np.linalg.norm(a - b) for a, b in combinations(perceived, 2)) > 20.0


def test_text_has_enough_contrast_with_the_page():
    css = asset("tkamb.show", "report.css")
    bright, dark = (
        dict(re.findall(r"--(\w+): (#\w+)", block))
        for block in re.findall(r":root \{(.*?)\}", css, re.DOTALL)
    )
    for colours in (bright, dark):
        page = colours["page"] if len(colours["page"]) == 7 else "#ffffff"
        assert all(contrast(colours[name], page) >= 4.5 for name in ("ink", "soft", "warn"))
    assert contrast(style.GREY) >= 4.5


def test_a_colour_has_the_same_meaning_in_all_plots(bend):
    meanings = {}
    for panel in panels(bend):
        if panel.name != "ligaments":
            for line in panel.lines:
                meanings.setdefault(line.colour, set()).add(line.label.split(",")[0])
    assert meanings[style.MEDIAL] == {"medial"}
    assert meanings[style.LATERAL] == {"lateral"}
    assert meanings[style.SUPERIOR] == {"superior", "superior–inferior", "axial", "axial rotation"}
    assert not {style.MEDIAL, style.LATERAL, style.SUPERIOR} & {*style.LIST[1:], style.BLACK}


def test_an_arrow_has_the_colour_of_its_curve(bend):
    curves = {
        line.label.split(",")[0]: line.colour
        for panel in panels(bend)
        if panel.name in ("forces", "condyles", "extensor")
        for line in panel.lines
    }
    drawn = style.FORCE_COLOURS
    assert drawn["medial condyle"] == curves["medial"]
    assert drawn["lateral condyle"] == curves["lateral"]
    assert drawn["knee"] == curves["resultant"]
    for name in ("quadriceps", "patellar ligament", "patellofemoral"):
        assert drawn[name] == curves[name]
    assert len(set(drawn.values())) == len(drawn)


def test_conclusions_depend_on_the_run(bend, gait):
    supported, unsupported = conclusions(bend)
    assert any("the quadriceps is the only muscle" in words for words in unsupported)
    assert any("no input was varied" in words for words in unsupported)
    assert any("Results in 1 of 101 frames" in words for words in conclusions(gait)[1])
    one = {"rmse_BW": 0.3, "r_squared": 0.8, "frames_compared": 9}
    summary = bend.summary | {
        "measured": {"total": one, "lateral": one | {"rmse_BW": 0.32, "r_squared": -0.84}},
        "questions": ["is it?"],
        "known_error": "not measured",
        "uncertainty": {"samples": 9},
    }
    supported, unsupported = conclusions(Results(bend.columns, summary, None))
    assert any("total 0.30 BW, lateral 0.32 BW" in words for words in supported)
    assert not any("The share of each condyle" in words for words in supported)
    assert unsupported[0].startswith("Any conclusion, before the question")
    assert any("lateral force: the mean of the measurement" in words for words in unsupported)
    assert any("their error is not measured" in words for words in unsupported)
    assert not any("no input was varied" in words for words in unsupported)


def test_the_opacity_of_a_round_contact_sums_to_its_area():
    size, step = 12.0, 0.5
    z, x = np.meshgrid(np.arange(-size, size + step, step), np.arange(-size, size + step, step))
    n, across = x.size, x.shape[1]
    corner = np.arange(n).reshape(x.shape)[:-1, :-1].ravel()
    triangles = np.concatenate(
        [corner[:, None] + [0, 1, across + 1], corner[:, None] + [0, across + 1, across]]
    )
    points = 1e-3 * np.stack([x.ravel(), np.zeros(n), z.ravel()], axis=1)
    view = TopView(ContactMaps({"points_m": points, "triangles": triangles}), "right", "lateral")
    for radius in (3.9, 4.0, 4.1):
        gap = (x**2 + z**2).ravel() - radius**2
        axes = new_figure(3.0, 3.0).add_subplot()
        draw_pressure(axes, view, np.maximum(-gap, 0.0), Normalize(0.0, radius**2), 1e-3 * gap)
        opacity = np.asarray(axes.images[0].get_array())[..., 3] / 255
        assert opacity.sum() * STEP_MM**2 == pytest.approx(np.pi * radius**2, rel=0.02)
        partly = (opacity > 0) & (opacity < 1)
        assert partly.sum() * STEP_MM > 2 * np.pi * radius
