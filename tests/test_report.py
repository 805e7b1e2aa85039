"""report.html: a self-contained page with the numbers of the run, also with failed frames."""

import json
import re
import warnings
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.backends.backend_svg import FigureCanvasSVG

from headless import Page
from synthetic_run import MASS_KG, make_run
from tkamb.contact.flags import AT_EDGE, TOO_NARROW
from tkamb.errors import InputError
from tkamb.run import metrics
from tkamb.run.metrics import map_rows
from tkamb.run.results import PERCENTILES, Results
from tkamb.show.axis import horizontal_axis, round_step, shown_frames
from tkamb.show.headline import cards
from tkamb.show.panels import Line, Panel, panels
from tkamb.show.plots import WIDTH, Sheet, plot
from tkamb.show.pressure_maps import draw_maps, mapped_frames, top_view
from tkamb.show.report import THIRD, report_html, write_report
from tkamb.show.sections import flag_rows, lead, motion_table, reasons
from tkamb.show.style import BLACK, PRESSURE_MAP, svg_text

VOID = {"meta", "br", "input", "img", "link", "hr"}


@pytest.fixture(scope="module")
def bend():
    return make_run("bend")


@pytest.fixture(scope="module")
def gait():
    return make_run("gait")


@pytest.fixture
def unwritten(monkeypatch):
    """Replace the SVG of plots by an empty one, because writing it is slow."""
    monkeypatch.setattr("tkamb.show.report.svg_text", lambda *_: "<svg></svg>")


@pytest.fixture(scope="module")
def page(bend):
    return report_html(bend)


class Checker(HTMLParser):
    """Parser that collects unclosed elements, repeated ids and references to other files."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.outside, self.twice = [], set(), [], []
        self.feed(text)

    def handle_startendtag(self, tag, attributes):
        self.look(attributes)

    def handle_starttag(self, tag, attributes):
        self.look(attributes)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open[-1] == tag, f"</{tag}> closes <{self.open[-1]}>"
        self.open.pop()

    def look(self, attributes):
        for name, value in attributes:
            if name == "id":
                self.twice += [value] if value in self.ids else []
                self.ids.add(value)
            reference = name in ("src", "href", "xlink:href", "action", "data")
            if reference and not value.startswith(("#", "data:")):
                self.outside.append(value)


@pytest.mark.parametrize("kind", ["bend", "gait"])
def test_page_is_self_contained(kind, request):
    text = report_html(request.getfixturevalue(kind))
    checker = Checker(text)
    assert checker.open == []
    assert checker.outside == []
    assert checker.twice == []
    assert "http" not in text.replace("http-equiv", "")
    assert "<h2>Muscles</h2>" not in text
    assert "@import" not in text
    assert all(r.startswith("#") for r in re.findall(r"url\(([^)]*)\)", text))
    assert len(text.encode()) < 5e6


def test_references_inside_the_page_have_a_target(page):
    targets = re.findall(r'(?:href="#|url\(#)([^")]+)', page)
    assert targets
    assert set(targets) <= Checker(page).ids


def curve(page, panel, line):
    """Return the pixels (n, 2) of a curve, the edges of its axes, and their range of values."""
    text = re.search(rf'id="figure-{panel}">.*?</svg>', page, re.DOTALL).group()
    box = [float(v) for v in re.search(r'data-box="([^"]+)"', text).group(1).split()]
    span = [float(v) for v in re.search(r'data-range="([^"]+)"', text).group(1).split()]
    path = re.search(rf'id="{panel}-line-{re.escape(line)}">\s*<path d="([^"]+)"', text).group(1)
    points = re.findall(r"[ML] (\S+) (\S+)", path)
    return np.array(points, float), box, span


@pytest.mark.parametrize(
    ("panel", "line", "of"),
    [
        ("forces", "force_total_BW", lambda r: r["force_total_BW"]),
        ("pressures", "medial_peak_pressure_MPa", lambda r: r["medial_peak_pressure_MPa"]),
        ("ratios", "PL/Q", lambda r: r["patellar_ligament_N"] / r["quadriceps_N"]),
        ("condyles", "lateral_force_N", lambda r: r["lateral_force_N"] / (MASS_KG * 9.80665)),
    ],
)
def test_curves_equal_the_columns(bend, page, panel, line, of):
    pixels, (left, right, top, bottom), (low, high) = curve(page, panel, line)
    assert len(pixels) == len(bend)
    x = low + (pixels[:, 0] - left) / (right - left) * (high - low)
    assert np.allclose(x, bend["flexion_deg"], atol=0.01)
    assert pixels[:, 1].min() > top
    assert pixels[:, 1].max() < bottom
    values = of(bend)
    slope, offset = np.polyfit(values, pixels[:, 1], 1)
    assert slope < 0
    assert np.allclose(slope * values + offset, pixels[:, 1], atol=0.01)


def test_curve_is_in_time_order_without_failed_frames(gait):
    by_flexion = Results(gait.columns, {**gait.summary, "axis": "flexion"}, None)
    pixels, (left, right, *_), (low, high) = curve(
        report_html(by_flexion), "forces", "force_total_BW"
    )
    x = low + (pixels[:, 0] - left) / (right - left) * (high - low)
    computed = ~metrics.failed(gait)
    assert computed.sum() == len(gait) - 1
    assert np.allclose(x, gait["flexion_deg"][computed], atol=0.02)
    assert (np.diff(x) < 0).any()


def test_curves_are_interrupted_where_a_new_cycle_begins(gait):
    time = gait["time_s"]
    summary = {**gait.summary, "cycle_percent_s": [time[30], time[30] + 1.1]}
    axis = horizontal_axis(Results(gait.columns, summary, None))
    assert axis.values[30] == 0.0
    assert axis.values[0] == pytest.approx(70.0)
    x, y = axis.broken(np.arange(101.0))
    assert len(x) == len(y) == 102
    assert np.isnan(x[30])
    assert np.isnan(y[30])


def test_a_single_frame_is_at_0_per_cent_of_the_cycle(gait):
    results = Results({name: values[:1] for name, values in gait.columns.items()}, {}, None)
    assert horizontal_axis(results, "cycle").values == pytest.approx([0.0])


def test_frames_of_the_table_are_at_round_steps():
    assert [round_step(v) for v in (0.09, 10, 10.1, 17, 31, 60)] == [0.1, 10, 15, 20, 50, 100]
    axis = horizontal_axis(make_run("bend", maps=False))
    assert np.allclose(axis.values[axis.stops(13)], np.arange(0, 121, 10), atol=0.6)


def test_headline_numbers_equal_the_columns(bend, gait):
    shown = {card.title: card for card in cards(bend, horizontal_axis(bend))}
    assert shown["Peak resultant contact force"].value == f"{bend['force_total_BW'].max():.2f} BW"
    assert f"{bend['force_total_N'].max():.0f} N" in shown["Peak resultant contact force"].detail
    peak = max(bend[f"{side}_peak_pressure_MPa"].max() for side in ("medial", "lateral"))
    assert shown["Peak contact pressure"].value == f"{peak:.1f} MPa"
    bands = {
        f"{side}_peak_pressure_MPa_{end}": factor * bend[f"{side}_peak_pressure_MPa"]
        for side in ("medial", "lateral")
        for end, factor in (("p05", 0.9), ("p50", 1.1), ("p95", 1.2))
    }
    made = cards(replace(bend, bands=bands), horizontal_axis(bend))
    (card,) = (one for one in made if one.title == "Peak contact pressure")
    assert card.value == f"{1.1 * peak:.1f} ({0.9 * peak:.1f}–{1.2 * peak:.1f}) MPa"
    assert f"with the inputs as given it is {peak:.1f} MPa" in card.detail
    ends = {"p05": 0.9, "p50": 1.1, "p95": 1.2}
    bands = {f"force_si_N_{end}": factor * bend["force_si_N"] for end, factor in ends.items()}
    banded, axis = replace(bend, bands=bands), horizontal_axis(bend)
    force = bend["force_si_N"].max() / metrics.body_weight(bend)
    (card,) = (one for one in cards(banded, axis) if one.title.startswith("Peak forces"))
    assert card.value.startswith(f"total {1.1 * force:.2f}")
    line = lead(banded, axis)[0][1]
    assert line.startswith(f"Total {1.1 * force:.2f} BW")
    assert (
        f"{0.9 * force:.2f}–{1.2 * force:.2f} BW; {force:.2f} BW with the inputs as given" in line
    )
    assert shown["Medial share of the load"].value == "50–58 %"
    assert shown["Frames computed"].value == "101 of 101"
    shown = {card.title: card for card in cards(gait, horizontal_axis(gait))}
    assert shown["Frames computed"].value == "100 of 101"
    assert shown["Frames computed"].warning
    assert "6 are to be read with care" in shown["Frames computed"].detail


def test_the_card_states_a_peak_pressure_at_the_edge_of_the_insert(bend):
    axis = horizontal_axis(bend)

    def peak_card(flags):
        status = list(bend.status)
        status[peak.frame] = flags
        results = replace(bend, columns=bend.columns | {"status": status})
        (card,) = (c for c in cards(results, axis) if c.title == "Peak contact pressure")
        return card

    peak = metrics.peak(bend, "<side>_peak_pressure_MPa")
    other = {"medial": "lateral", "lateral": "medial"}[peak.side]
    assert "edge of the insert" not in peak_card("ok").detail
    assert "edge of the insert" not in peak_card(f"the {other} {AT_EDGE} (within 2.5 mm)").detail
    at_edge = peak_card(f"lateral condyle lifts off; the {peak.side} {AT_EDGE} (within 2.5 mm)")
    assert "reaches the edge of the insert's articular surface" in at_edge.detail
    assert at_edge.warning
    narrow = peak_card(f"the {peak.side} {TOO_NARROW} for the cells: its peak pressure cannot")
    assert "the peak is not resolved" in narrow.detail and narrow.warning


def test_a_card_states_force_and_pressure_on_the_post(bend):
    force, pressure = np.zeros(len(bend)), np.full(len(bend), np.nan)
    axis, title = horizontal_axis(bend), "Peak force on the post"

    def post_card():
        columns = bend.columns | {"post_force_N": force, "post_peak_pressure_MPa": pressure}
        (card,) = (c for c in cards(replace(bend, columns=columns), axis) if c.title == title)
        return card.value, card.detail

    assert title not in {card.title for card in cards(bend, axis)}
    assert post_card() == ("none", "Cam and post are not in contact.")
    force[80], pressure[80] = 0.5 * metrics.body_weight(bend), 32.9
    value, detail = post_card()
    assert value == "0.50 BW" and f"{force[80]:.0f} N at " in detail and "32.9 MPa" in detail


def test_the_flexion_where_wrapping_begins_is_stated_between_two_frames(bend):
    """The quadriceps of this run wraps beyond 75 deg."""

    def stated_flexions(every):
        columns = {name: values[::every] for name, values in bend.columns.items()}
        wrapped = columns["flexion_deg"][columns["quadriceps_wrap_deg"] > 0]
        summary = bend.summary | {"first_wrapping_flexion_deg": wrapped.min()}
        run = Results(columns, summary)
        (card,) = [c for c in cards(run, horizontal_axis(run)) if "quadriceps" in c.title]
        return [float(number) for number in re.findall(r"([\d.]+)°", card.detail.split("wrap")[1])]

    (first,) = stated_flexions(1)
    assert 75 <= first < 77
    low, high = stated_flexions(25)
    assert low <= 75 < high


def test_the_card_states_why_there_is_no_band(bend):
    frame = int(bend["force_total_BW"].argmax())
    table = {"samples": 20, "largest_failed_share": 0.15, "not_varied": [], "varied": []}
    table["causes_of_failure"] = {"no ellipse": 0.9}

    def detail(share):
        lost = {f"force_total_BW_{end}": np.full(len(bend), np.nan) for end in PERCENTILES}
        bands = lost | {"failed_share": np.where(np.arange(len(bend)) == frame, share, 0.0)}
        run = replace(bend, bands=bands, summary=bend.summary | {"uncertainty": table})
        return next(c.detail for c in cards(run, horizontal_axis(run)) if "Uncertainty" in c.title)

    assert "fewer than 20 samples have it, use more" in detail(0.15)
    assert "most often: no ellipse" in detail(0.15)
    assert "more than half of the samples failed" in detail(0.6)


def test_residuals_of_a_released_pose_are_none_only_if_they_are_zero(bend):

    def shown(factor):
        contact = {"released": ["ap", "ml", "axial_rotation"]}
        columns = dict(bend.columns)
        for name in ("residual_ap_N", "residual_ml_N"):
            columns[name] = factor * np.asarray(columns[name], float)
        results = Results(columns, bend.summary | {"contact": contact}, None)
        (card,) = [c for c in cards(results, horizontal_axis(results)) if "Residual" in c.title]
        return card.value

    assert shown(0.0) == "none"
    assert shown(1.0).endswith("%")


def test_a_recorded_axial_rotation_has_a_residual_moment(bend):
    """AP and ML are released, so only the moment of up to 7.6 N·m remains."""
    columns = dict(bend.columns)
    for name in ("residual_ap_N", "residual_ml_N"):
        columns[name] = np.zeros(len(bend))
    columns["residual_axial_Nm"] = np.linspace(-7.6, 3.0, len(bend))
    summary = bend.summary | {"contact": {"released": ["ap", "ml"]}}
    results = Results(columns, summary, None)
    (card,) = [c for c in cards(results, horizontal_axis(results)) if "Residual" in c.title]
    assert card.value == "0.0 %"
    assert "residual axial moment is at most 7.6" in card.detail


def test_several_questions_are_numbered(bend):
    def asked(*questions):
        summary = bend.summary | {"questions": list(questions)}
        (card,) = (c for c in cards(replace(bend, summary=summary), axis) if c.title == title)
        return card.detail

    title, axis = "Questions to answer", horizontal_axis(bend)
    assert asked("is it?") == "is it?"
    assert asked("is it", "or not?") == "Answer them before you use a number. (1) is it (2) or not?"


def test_residuals_are_relative_to_the_superior_inferior_force(bend):
    expected = np.hypot(bend["residual_ap_N"], bend["residual_ml_N"]) / bend["force_si_N"]
    assert np.allclose(metrics.residual_share(bend), expected)
    drawn = {line.name: line for p in panels(bend) if p.name == "residuals" for line in p.lines}
    assert np.allclose(drawn["size"].values, 100 * expected)
    effect = 100 * bend["residual_sensitivity_N"] / bend["force_si_N"]
    assert np.allclose(drawn["effect"].values, effect)
    (card,) = (c for c in cards(bend, horizontal_axis(bend)) if c.title == "Residual force")
    assert f"the total would change by at most {effect.max():.1f}" in card.detail


def test_the_plot_of_residuals_has_no_band(bend):
    """The plot is in per cent of the force, but bands.csv is in N."""
    ends = (("p05", 10.0), ("p50", 20.0), ("p95", 30.0))
    bands = {f"residual_sensitivity_N_{end}": np.full(len(bend), n) for end, n in ends}
    (panel,) = (p for p in panels(replace(bend, bands=bands)) if p.name == "residuals")
    assert [line.name for line in panel.lines if line.band is not None] == []


def test_a_large_known_error_of_pressure_or_area_is_a_warning(bend, unwritten):
    small = {"approach": 0.3, "force": 0.2, "mean_pressure": 0.02, "peak_pressure": 0.04}
    for area, coloured in ((0.03, False), (0.11, True), (None, False)):
        error = "not measured" if area is None else small | {"area": area, "cases": 4}
        summary = bend.summary | {"known_error": error}
        results = Results(bend.columns, summary, None)
        (card,) = [c for c in cards(results, horizontal_axis(results)) if "pressure" in c.title]
        assert card.warning is coloured
        words = ["not measured"] if area is None else ["4 % of the peak", "2 % of the mean"]
        assert all(word in card.detail for word in words)
        (areas,) = [panel for panel in panels(results) if panel.name == "areas"]
        assert areas.warning is coloured
        assert ('class="warning"' in report_html(results)) is coloured


def test_a_second_axis_has_moments_in_per_cent_of_weight_and_height(bend, gait):
    (panel,) = (p for p in panels(bend) if p.name == "external")
    assert panel.second[0] == pytest.approx(100 / (MASS_KG * 9.80665 * 1.75))
    (panel,) = (p for p in panels(gait) if p.name == "external")
    assert panel.second is None


def test_the_share_is_1_if_only_the_medial_condyle_is_loaded():
    run = make_run("bend", frames=5, maps=False)
    run.columns["lateral_force_N"][2] = np.nan
    run.columns["medial_force_N"][3] = run.columns["lateral_force_N"][3] = np.nan
    share = metrics.medial_share(run, "deformation")
    assert share[2] == 1.0
    assert np.isnan(share[3])


def test_table_has_a_row_every_ten_degrees(bend):
    table = motion_table(bend, horizontal_axis(bend))
    assert table.headings[:2] == [("flexion", "deg"), ("resultant force", "BW")]
    assert np.allclose([float(row[0]) for row in table.rows], np.arange(0, 121, 10), atol=0.6)
    assert table.rows[-1][1] == f"{bend['force_total_BW'][-1]:.2f}"


def test_flags_are_listed_with_their_frames(gait):
    rows = flag_rows(gait, horizontal_axis(gait))
    assert ("singular", "1", "20", "20 %") in rows
    assert ("raw filtered differ", "6", "50–55", "50 % to 55 %") in rows


def test_reasons_that_differ_only_in_a_number_share_a_row():
    statuses = [
        "ok",
        "normal 21 deg from vertical; lateral condyle off",
        "normal 34 deg from vertical",
        "failed: singular; normal 9 deg from vertical",
    ]
    assert list(reasons(statuses).items()) == [
        ("failed: singular", [3]),
        ("normal 9–34 deg from vertical", [1, 2, 3]),
        ("lateral condyle off", [1]),
    ]


def test_maps_share_a_scale_up_to_the_largest_pressure(bend):
    axis, view = horizontal_axis(bend), top_view(bend)
    frames = mapped_frames(bend, axis)
    assert len(frames) >= 4
    figure = draw_maps(bend, view, axis, frames)
    largest = bend.maps.pressure_Pa.max() / 1e6
    *maps, bar = figure.axes
    assert bar.get_ylim() == pytest.approx((0.0, largest))
    steps = {tuple(c): k for k, c in enumerate(colormaps[PRESSURE_MAP](range(256), bytes=True))}
    for axes, frame in zip(maps, frames, strict=False):
        _, pressure = axes.images
        colours = np.asarray(pressure.get_array()).reshape(-1, 4)
        step = max(steps[tuple(colour)] for colour in colours if colour[3] == 255)
        highest = bend.maps.pressure_Pa[frame].max() / 1e6
        assert (step + 0.5) * largest / 256 == pytest.approx(highest, rel=0.02)


@pytest.mark.parametrize(
    ("side", "lateral_axis", "medial_is"),
    [("right", "+z", "left"), ("left", "+z", "right"), ("left", "-z", "left")],
)
def test_the_right_of_the_page_is_the_subjects_right(side, lateral_axis, medial_is):
    run = make_run("bend", frames=5)
    run.summary.update(side=side, lateral_axis=lateral_axis)
    x, y = top_view(run).page_coordinates(np.array(3.0), np.array(-23.0))
    assert y == 3.0
    assert (x < 0) == (medial_is == "left")


def test_failed_frames_have_no_map_and_the_nearest_one_is_shown(gait):
    pressure = gait.maps.pressure_Pa.copy()
    pressure[[0, 20]] = np.nan
    arrays = {name: getattr(gait.maps, name) for name in ("points_m", "triangles", "time_s")}
    maps = type(gait.maps)({**arrays, "pressure_Pa": pressure})
    run = Results(gait.columns, gait.summary, maps)
    rows = map_rows(run)
    assert 0 not in rows
    assert rows[1] == 1
    assert mapped_frames(run, horizontal_axis(run))[0] == 1


def without(run, *words):
    """Return a run without contact. Columns with one of the words in their names are NaN."""
    columns = dict(run.columns)
    for name in columns:
        if any(word in name for word in words):
            columns[name] = np.full(len(run), np.nan)
    return Results(columns, {**run.summary, "contact": None}, None)


@pytest.mark.parametrize(
    "words",
    [
        ("medial", "lateral", "approach", "iterations"),
        ("quadriceps", "patell"),
        ("ground", "external"),
        ("_N", "_Nm", "BW", "MPa", "mm", "share", "condition", "yield", "slip", "wrap"),
    ],
)
def test_plots_without_numbers_are_not_shown(bend, words):
    run = without(bend, *words)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = report_html(run)
    assert Checker(text).open == []
    assert "nan" not in re.sub(r"<script.*?</script>|<svg.*?</svg>", "", text, flags=re.DOTALL)
    names = {panel.name for panel in panels(run)}
    assert ("extensor" in names) == ("quadriceps" not in words and "_N" not in words)
    assert ("pressures" in names) == ("medial" not in words and "MPa" not in words)


def test_a_single_frame_and_a_motion_at_one_flexion_are_drawn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one = make_run("bend", frames=5)
        columns = {name: values[2:3] for name, values in one.columns.items()}
        assert Checker(report_html(Results(columns, one.summary, None))).open == []
        still = {**one.columns, "flexion_deg": np.full(5, 90.0)}
        assert Checker(report_html(Results(still, one.summary, one.maps))).open == []


def test_html_in_titles_notes_and_statuses_is_escaped(bend, unwritten):
    summary = {**bend.summary, "title": "</script><b>", "notes": ["<img src=x>"]}
    run = Results({**bend.columns, "status": ["</script>"] * len(bend)}, summary, None)
    checker = Checker(report_html(run))
    assert checker.open == []
    assert checker.outside == []


def test_report_is_reproducible(bend, page):
    assert report_html(bend) == page


def test_slider_data_equal_the_columns(bend, page):
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))
    assert np.allclose(data["x"], bend["flexion_deg"], rtol=1e-4)
    assert data["panels"]["forces"]["unit"] == "BW"
    total = data["panels"]["forces"]["lines"][0]
    assert total["label"] == "resultant"
    assert np.allclose(total["values"], bend["force_total_BW"], rtol=1e-4)


def test_missing_mass_and_unwritable_folder_are_refused(bend, unwritten, tmp_path):
    run = Results(bend.columns, {**bend.summary, "body_mass_kg": None}, None)
    with pytest.raises(InputError, match="body_mass_kg"):
        report_html(run)
    with pytest.raises(InputError, match="cannot be written"):
        write_report(
            Results(bend.columns, bend.summary, None), tmp_path / "missing" / "report.html"
        )


def test_plots_of_results_in_python(bend):
    figure = plot(bend, "pressures", axis="time")
    (axes, *_) = figure.axes
    assert np.array_equal(axes.lines[0].get_xdata(), bend["time_s"])
    with pytest.raises(InputError, match="no plot 'presure'"):
        plot(bend, "presure")
    with pytest.raises(InputError, match="no axis 'angle'"):
        plot(bend, axis="angle")


LIVE = "document.body && document.body.classList.contains('live')"


def test_slider_moves_the_cursor_and_the_numbers(bend, page, tmp_path, chromium):
    path = tmp_path / "report.html"
    path.write_text(page, encoding="utf-8")
    browser = Page(chromium).open(path.as_uri(), LIVE)
    browser.evaluate(
        "(() => { const slider = document.getElementById('frame'); slider.value = 50;"
        "slider.dispatchEvent(new Event('input')); })()"
    )
    assert browser.problems == []
    assert {url.split(":")[0] for url in browser.requests} <= {"file", "data"}
    dom = browser.evaluate("document.documentElement.outerHTML")
    assert "50: flexion 60°" in dom
    assert f"resultant {bend['force_total_BW'][50]:.2f}" in dom
    figure = re.search(r'id="figure-forces">.*?</figure>', dom, re.DOTALL).group()
    left, right, *_ = (float(v) for v in re.search(r'data-box="([^"]+)"', figure)[1].split())
    low, high = (float(v) for v in re.search(r'data-range="([^"]+)"', figure)[1].split())
    cursor = re.search(r'<line class="cursor"[^>]* x1="([^"]+)"', figure)[1]
    at = low + (float(cursor) - left) / (right - left) * (high - low)
    assert at == pytest.approx(60.0, abs=0.01)
    joined = "getComputedStyle(document.querySelector('figure svg path')).strokeLinejoin"
    assert browser.evaluate(joined) == "round"


def test_foreign_scripts_in_the_page_do_not_run(page, tmp_path, chromium):
    path = tmp_path / "report.html"
    foreign = (
        "<script>document.title = 'foreign'</script>"
        "<img src='x.png' onerror=\"document.title = 'foreign'\">"
        "<script src='other.js'></script></body>"
    )
    (tmp_path / "other.js").write_text("document.title = 'foreign'")
    path.write_text(page.replace("</body>", foreign), encoding="utf-8")
    browser = Page(chromium).open(path.as_uri(), LIVE)
    assert browser.evaluate("document.title") != "foreign"
    refused = [line for line in browser.problems if "Content Security Policy" in line]
    assert len(refused) >= 3


def with_bands(run):
    """Return a run with bands of two columns, 80 to 130 % of the nominal values, median 110 %."""
    bands = {
        f"{name}_{end}": factor * run[name]
        for name in ("force_total_BW", "medial_peak_pressure_MPa")
        for end, factor in (("p05", 0.8), ("p50", 1.1), ("p95", 1.3))
    }
    table = {
        "samples": 256,
        "largest_failed_share": 0.125,
        "causes_of_failure": {"no ellipse": 0.9},
        "not_varied": ["segment_mass"],
        "shares_of_variance": {"force_total_N": {"ml": 0.61, "adduction": 0.2, "rest": 0.19}},
    }
    summary = run.summary | {"uncertainty": table}
    return Results(run.columns, summary, run.maps, bands=bands)


def test_a_plot_does_not_depend_on_earlier_plots_of_its_sheet(bend):
    axis, shown = horizontal_axis(bend), panels(bend)
    assert any(one.second for one in shown)
    sheet = Sheet(bend, axis)
    again = {one.name: svg_text(sheet.draw(one), one.name) for one in (*shown, *shown[::-1])}
    for one in shown:
        assert again[one.name] == svg_text(Sheet(bend, axis).draw(one), one.name)


def test_bands_are_drawn_at_their_percentiles_and_stated_in_a_card(bend, page):
    run = with_bands(bend)
    axis = horizontal_axis(run)
    figures = "".join(
        f'<figure id="figure-{one.name}">{svg_text(Sheet(run, axis).draw(one), one.name)}'
        for one in panels(run)
        if one.name in ("forces", "pressures")
    )
    forces = re.search(r'id="figure-forces">.*?</svg>', figures, re.DOTALL).group()
    values, heights = bend["force_total_BW"], curve(figures, "forces", "force_total_BW")[0][:, 1]
    slope, offset = np.polyfit(values, heights, 1)
    median = re.search(r'id="forces-median-force_total_BW">\s*<path d="([^"]+)"', forces).group(1)
    drawn = np.array(re.findall(r"[ML] (\S+) (\S+)", median), float)[:, 1]
    assert np.allclose(drawn, 1.1 * slope * values + offset, atol=0.01)
    shade = re.search(
        r'id="forces-band-force_total_BW">.*? d="([^"]+)".*? y="([^"]+)"', forces, re.DOTALL
    )
    y = np.array(re.findall(r"[ML] \S+ (\S+)", shade.group(1)), float) + float(shade.group(2))
    assert y.min() == pytest.approx(slope * 1.3 * values.max() + offset, abs=0.01)
    assert y.max() == pytest.approx(slope * 0.8 * values.min() + offset, abs=0.01)
    assert "-band-" in re.search(r'id="figure-pressures">.*?</svg>', figures, re.DOTALL).group()
    assert "-band-" not in page
    card = next(one for one in cards(run, axis) if one.title.startswith("Uncertainty of"))
    peak = values.max()
    assert card.value == f"{0.8 * peak:.2f}–{1.3 * peak:.2f} BW"
    for words in ("5 to 95 % of 256", "ML (61%)", "up to 12% of the samples", "segment mass"):
        assert words in card.detail
    assert card.warning


def test_units_change_and_downloads_and_map_show_the_frame_of_the_slider(
    bend, page, tmp_path, chromium
):
    path = tmp_path / "report.html"
    path.write_text(page, encoding="utf-8")
    browser = Page(chromium).open(path.as_uri(), LIVE)
    browser.wait("document.getElementById('figure-map').dataset.ready === 'yes'")
    browser.evaluate("document.querySelector('#bar input[value=N]').click()")
    readout = browser.evaluate("document.querySelector('#figure-forces .readout').textContent")
    frame = int(bend["force_total_N"].argmax())
    total = float(re.search(r"resultant (\d+)", readout)[1])
    assert total == round(bend["force_total_N"][frame])
    table = browser.saved("#figure-forces button[title='save as CSV']").decode().splitlines()
    assert table[0].startswith('"frame","flexion (deg)","resultant (N)"')
    assert float(table[1 + frame].split(",")[2]) == pytest.approx(total, rel=1e-3)
    assert browser.saved("#figure-forces button[title='save as SVG']").startswith(b"<svg")
    assert browser.saved("#figure-map button[title='save as PNG']").startswith(b"\x89PNG")
    coloured = (
        "(() => { const one = document.querySelector('#figure-map canvas'),"
        "all = one.getContext('2d').getImageData(0, 0, one.width, one.height).data;"
        "let n = 0; for (let k = 3; k < all.length; k += 4) n += all[k] > 0; return n / 144; })()"
    )
    drawn = browser.evaluate(coloured)
    area = sum(bend[f"{side}_area_mm2"][frame] for side in ("medial", "lateral"))
    assert drawn == pytest.approx(area, rel=0.1)
    assert browser.problems == []
    assert {url.split(":")[0] for url in browser.requests} <= {"file", "data", "blob"}


def test_the_printed_report_has_at_most_six_pages(page, tmp_path, chromium):
    path = tmp_path / "report.html"
    path.write_text(page, encoding="utf-8")
    printed = Page(chromium).open(path.as_uri(), LIVE).pdf()
    assert 2 <= len(re.findall(rb"/Type /Page\b", printed)) <= 6


def measure_labels(figure):
    """Include all tick labels in the tight bounding boxes of a figure."""
    for axes in figure.axes:
        for axis in (axes.xaxis, *(one.yaxis for one in (axes, *axes.child_axes))):
            for label in axis.get_majorticklabels():
                label.set_in_layout(True)


@pytest.mark.parametrize("width", [WIDTH, THIRD])
@pytest.mark.parametrize("scale", [1.0, 1e-4, 1e7])
def test_a_plot_with_its_labels_fits_and_fills_its_figure(bend, gait, width, scale):
    """Cases: long and short numbers, a level, a range, a second axis, a wide legend."""
    wordy = [Line(f"l{k}", f"a long name {k}", scale * np.arange(101.0), BLACK) for k in range(6)]
    drawn = [(run, panel) for run in (bend, gait) for panel in panels(run)]
    counts = (3, 4, 6) if width == WIDTH else (1, 2)
    made = [Panel(f"{count} lines", "", "N", tuple(wordy[:count])) for count in counts]
    drawn = [(run, panel) for run in (bend, gait) for panel in panels(run)]
    drawn = (drawn if scale == 1.0 and width == WIDTH else []) + [(bend, one) for one in made]
    for run, panel in drawn:
        figure = Sheet(run, horizontal_axis(run), width).draw(panel)
        canvas = FigureCanvasSVG(figure)
        canvas.draw()
        measure_labels(figure)
        inked = figure.axes[0].get_tightbbox(figure._get_renderer())
        size = figure.dpi * figure.get_size_inches()
        assert (inked.min > -1.0).all(), panel.name
        assert (inked.max < size + 1.0).all(), panel.name
        assert inked.width > 0.93 * size[0], panel.name
        assert inked.height > 0.93 * size[1], panel.name
        for second in figure.axes[0].child_axes:
            low, high = second.get_ylim()
            numbers = zip(second.get_yticks(), second.get_yticklabels(), strict=True)
            ends = [one.get_window_extent().x1 for at, one in numbers if low <= at <= high]
            assert second.yaxis.label.get_window_extent().x0 > max(ends), panel.name


def _peak_card(run):
    shown = cards(run, horizontal_axis(run))
    return next(card for card in shown if card.title == "Peak contact pressure")


def test_the_area_above_yield_is_stated_per_condyle():
    run = make_run("bend", 11)
    side = metrics.peak(run, "<side>_peak_pressure_MPa").side
    other = "lateral" if side == "medial" else "medial"
    run.columns[f"{side}_area_above_yield"] = np.full(11, 0.04)
    run.columns[f"{other}_area_above_yield"] = np.full(11, 0.31)
    detail = _peak_card(run).detail
    assert detail.startswith(f"The peak is on the {side} condyle")
    assert f"4 % of the {side} area and 31 % of the {other} area is above yield" in detail


def test_card_and_note_attribute_the_known_error_to_the_contact_model():
    run = make_run("bend", 11)
    run.summary["known_error"] = {
        "peak_pressure": 0.05,
        "mean_pressure": 0.02,
        "area": 0.03,
        "cases": 8,
    }
    assert "error of the contact model alone" in _peak_card(run).detail
    areas = next(panel for panel in panels(run) if panel.name == "areas")
    assert "error of the contact model alone" in areas.note


def test_the_maps_include_the_frame_of_the_largest_pressure():
    run = make_run("bend", 101)
    rows = metrics.map_rows(run)
    last = max(rows)
    for frame in (last, 37):
        run.columns["medial_peak_pressure_MPa"][frame] = 99.0 + frame * (frame != last) + 2 * last
        chosen = mapped_frames(run, horizontal_axis(run))
        assert frame in chosen and len(chosen) <= 8
        titles = [
            axes.get_title()
            for axes in draw_maps(run, top_view(run), horizontal_axis(run), chosen).axes
        ]
        assert ["peak pressure" in title for title in titles if title].count(True) == 1


def test_a_curve_that_coincides_with_another_is_dashed():
    run = make_run("bend", 11)
    run.columns["medial_slip_mm"] = np.linspace(0, 4, 11)
    run.columns["lateral_slip_mm"] = np.linspace(0, 4, 11) + 1e-3
    slip = next(panel for panel in panels(run) if panel.name == "slip")
    assert [line.dashed for line in slip.lines] == [False, True]
    run.columns["lateral_slip_mm"] = np.linspace(0, 5, 11)
    slip = next(panel for panel in panels(run) if panel.name == "slip")
    assert [line.dashed for line in slip.lines] == [False, False]


def test_the_outline_of_the_insert_has_no_steps():
    """Along the anterior edge, neighbouring columns of the grid differ by less than one row."""
    run = make_run("bend", 3)
    view = top_view(run)
    _, opacity = view.insert_picture
    rows, columns = opacity.shape
    edge = np.array(
        [
            np.interp(0.5, opacity[: rows // 2, k], np.arange(rows // 2))
            for k in range(columns // 4, columns // 2 - 20)
        ]
    )
    raw = (view.grey >= 0)[:, columns // 4 - 8 : columns // 2 - 28].argmax(axis=0)
    assert np.abs(np.diff(raw)).max() >= 2  # the edge of the map has steps
    assert np.abs(np.diff(edge)).max() < 1.0
    inside = np.pad(view.grey >= 0, 8)
    assert opacity.sum() == pytest.approx(inside.sum(), rel=0.02)


def test_the_page_of_a_long_recording_shows_a_few_hundred_frames_and_says_so(monkeypatch):
    monkeypatch.setattr("tkamb.show.axis.EVENLY_SHOWN", 20)
    monkeypatch.setattr("tkamb.show.report.EVENLY_SHOWN", 20)
    sizes = []
    for frames in (60, 240):
        run = make_run("bend", frames, maps=False)
        run.columns["quadriceps_N"][33] = 1e5
        shown = shown_frames(run)
        assert {0, 33, frames - 1} <= {*shown.tolist()} and len(shown) < 60
        text = report_html(run)
        assert f"show {len(shown)} of the {frames} computed frames" in text
        sizes.append(len(text))
    assert sizes[1] < 1.05 * sizes[0]
    assert len(shown_frames(make_run("bend", 12, maps=False))) == 12
