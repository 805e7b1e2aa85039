"""The page of the viewer in a headless browser: its scene graph equals the results."""

import numpy as np
import pytest

import tkamb
from headless import Page
from tkamb.run.maps import read_maps
from tkamb.run.results_folder import read_results
from tkamb.show.view.run import open_run
from tkamb.show.view.show import Show, serve_in_background
from viewed import SCENE, force, levels, matrix, move_slider, shipped_run, short_results

FRAMES = (0, 2, 5)


@pytest.fixture(scope="module")
def folder():
    return shipped_run()


@pytest.fixture(scope="module")
def show(folder):
    return Show([open_run(folder)])


@pytest.fixture(scope="module")
def browser(show, chromium, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "knee.html"
    show.write_html(path)
    return Page(chromium).open(path.as_uri())


@pytest.fixture(scope="module")
def live(show, chromium):
    server = show.server()
    serve_in_background(server)
    page = Page(chromium).open(server.url)
    yield server, page
    page.close()
    server.close()


def test_the_file_is_self_contained(browser):
    assert browser.problems == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in browser.requests)


@pytest.mark.parametrize("frame", FRAMES)
def test_the_slider_moves_the_femur_to_its_pose_in_contact_h5(browser, folder, frame):
    move_slider(browser, frame)
    drawn = matrix(browser, "/tkamb/0/femoral component/femoral component")
    np.testing.assert_allclose(
        drawn, read_maps(folder / "contact.h5").femoral_pose[frame], atol=1e-6
    )


@pytest.mark.parametrize("frame", FRAMES)
def test_the_map_shows_the_pressures_of_contact_h5(browser, folder, frame):
    move_slider(browser, frame)
    pressure = read_maps(folder / "contact.h5").pressure_Pa
    drawn, given = levels(browser), pressure[frame]
    loaded = given > 0
    assert loaded.any() and (drawn[~loaded] < 0).all()
    np.testing.assert_allclose(
        drawn[loaded] * pressure.max(), given[loaded], atol=1e-4 * pressure.max()
    )


def test_the_colour_bar_ends_at_the_largest_pressure(browser, folder):
    peak = read_maps(folder / "contact.h5").pressure_Pa.max() / 1e6
    bar = "document.getElementById('pressure-bar')"
    assert browser.evaluate(f"Number({bar}.dataset.low)") == 0
    assert browser.evaluate(f"Number({bar}.dataset.high)") == pytest.approx(peak, rel=1e-9)
    ticks = browser.evaluate(
        f"[...{bar}.querySelectorAll('.ticks span')].map((s) => s.textContent)"
    )
    assert (ticks[0], ticks[-1]) == (f"{peak:.1f}", "0.0")


@pytest.mark.parametrize("frame", FRAMES)
def test_the_arrows_equal_the_forces_of_results_csv(browser, show, frame):
    move_slider(browser, frame)
    results = show.runs[0].results

    def vector(pattern):
        return np.array([results[pattern.format(axis)][frame] for axis in ("ap", "si", "ml")])

    def near(drawn, given):
        assert np.linalg.norm(drawn - given) <= 1e-3 * np.linalg.norm(given)

    near(force(browser, "ground reaction"), vector("ground_reaction_{}_N"))
    near(force(browser, "hip"), vector("hip_force_{}_N"))
    pressed = force(browser, "medial condyle") + force(browser, "lateral condyle")
    near(pressed, vector("force_{}_N") * [1, -1, 1])
    for name, column in (
        ("quadriceps", "quadriceps_N"),
        ("patellar ligament", "patellar_ligament_N"),
    ):
        assert np.linalg.norm(force(browser, name)) == pytest.approx(
            results[column][frame], rel=1e-3
        )
    across = np.hypot(
        results["patellofemoral_N"][frame], results["patellofemoral_tangential_N"][frame]
    )
    assert np.linalg.norm(force(browser, "patellofemoral")) == pytest.approx(across, rel=1e-3)


def test_the_forces_on_the_patella_are_in_equilibrium(browser):
    """Weight and inertia of the patella are below 2 % of its contact force."""
    move_slider(browser, 5)
    pull = force(browser, "quadriceps")
    press = -force(browser, "patellofemoral")
    ligament = -force(browser, "patellar ligament")
    assert np.linalg.norm(pull + press + ligament) < 0.02 * np.linalg.norm(press)


@pytest.mark.parametrize("layer", ["bones", "pressure map", "forces", "recorded pose"])
def test_layers_are_switched_by_their_boxes(browser, layer):
    box = f"document.querySelector('input[data-layer=\"{layer}\"]')"
    shown = f"tkamb.node('/tkamb/0/{layer}').object.visible"
    before = browser.evaluate(shown)
    assert browser.evaluate(f"{box}.checked") == before
    browser.evaluate(f"{box}.click()")
    assert browser.evaluate(shown) is not before
    browser.evaluate(f"{box}.click()")
    assert browser.evaluate(shown) is before


def test_the_numbers_change_with_the_frame(browser, show):
    row = (
        "[...document.querySelectorAll('#numbers tr')].find((r) => r.cells[0].textContent === '{}')"
    )
    for frame in FRAMES:
        move_slider(browser, frame)
        flexion = browser.evaluate(row.format("flexion") + ".cells[1].textContent")
        assert flexion == f"{show.runs[0].results['flexion_deg'][frame]:.1f}°"


def test_slack_ligaments_are_grey(browser, show):
    slack = [
        (strand, frame)
        for strand in show.drawings[0].strands
        if strand.layer == "ligaments"
        for frame in FRAMES
        if show.runs[0].results[f"ligament_{strand.name}_N"][frame] == 0
    ]
    assert slack
    for strand, frame in slack:
        move_slider(browser, frame)
        colour = browser.evaluate(
            f"Array.from(tkamb.node('/tkamb/0/ligaments/{strand.name}/<object>')"
            ".object.geometry.attributes.color.array.slice(0, 3))"
        )
        assert np.ptp(colour) == 0


def test_keys_change_the_frame_and_the_view(browser):
    press = "document.dispatchEvent(new KeyboardEvent('keydown', {{key: '{}'}}))"
    move_slider(browser, 2)
    browser.evaluate(press.format("ArrowRight"))
    assert browser.evaluate("tkamb.frame") == 3
    browser.evaluate(press.format("5"))
    assert browser.evaluate("tkamb.camera") == "top of insert"
    assert not browser.evaluate("tkamb.layerShown('femoral component')")
    browser.evaluate(press.format("1"))
    assert browser.evaluate("tkamb.layerShown('femoral component')")


def test_playing_changes_the_frame(browser):
    move_slider(browser, 0)
    browser.evaluate("tkamb.play(true)")
    moved = browser.evaluate(
        "new Promise((done) => { const t = setInterval(() => { if (tkamb.frame > 0) {"
        "clearInterval(t); done(true); } }, 20); })"
    )
    browser.evaluate("tkamb.play(false)")
    assert moved


def test_a_frame_has_few_enough_triangles_for_software_graphics(browser):
    browser.evaluate("tkamb.look('oblique')")
    browser.evaluate("tkamb.viewer.render()")
    assert browser.evaluate("tkamb.viewer.renderer.info.render.triangles") < 45_000


def test_a_note_states_the_decimation_of_a_surface(browser):
    notes = browser.evaluate("document.getElementById('notes').textContent")
    assert "of 29168 triangles, at most 0." in notes


def test_no_console_error_at_the_end(browser):
    assert browser.problems == []


def test_the_live_window_requests_only_its_own_server(live):
    server, browser = live
    assert browser.problems == []
    assert all(url.startswith((server.url, "data:", "blob:")) for url in browser.requests)


def test_another_contact_model_replaces_the_map_of_a_frame(live):
    _, browser = live
    move_slider(browser, 2)
    before = levels(browser)
    browser.evaluate(
        "(() => { const s = document.getElementById('contact'); s.value = 'hertz';"
        "s.dispatchEvent(new Event('change')); })()"
    )
    words = browser.evaluate(
        "new Promise((done) => { const t = setInterval(() => {"
        "const w = document.getElementById('answer').textContent;"
        "if (w.startsWith('hertz:')) { clearInterval(t); done(w); } }, 50); })"
    )
    after = levels(browser)
    assert "peak" in words and after.shape == before.shape
    assert (after > 0).any() and not np.array_equal(after, before)
    browser.evaluate("document.getElementById('contact').value = 'foundation'")
    move_slider(browser, 2)
    assert np.array_equal(levels(browser), before)
    assert browser.problems == []


def test_a_model_switch_shows_its_progress_and_can_be_cancelled(live):
    server, browser = live
    switch = server.switch
    move_slider(browser, 2)
    before = levels(browser)
    answer = "document.getElementById('answer').textContent"
    with switch._lock:  # the computation has to wait
        browser.evaluate(
            "(() => { const s = document.getElementById('contact'); s.value = 'hertz';"
            "s.dispatchEvent(new Event('change')); })()"
        )
        browser.wait(f"{answer}.startsWith('asking hertz … 1 s')")
        browser.evaluate("document.getElementById('cancel').click()")
        browser.wait(f"{answer} === 'cancelled'")
    assert browser.evaluate("document.getElementById('cancel').hidden")
    assert browser.evaluate("document.getElementById('contact').value") == "foundation"
    assert np.array_equal(levels(browser), before)
    number = switch.cancel()
    assert number == switch._latest
    browser.forgive("400")  # the answer to a cancelled request is an error
    assert browser.problems == []


@pytest.mark.slow
def test_two_contact_models_side_by_side_share_a_scale(folder, chromium, tmp_path):
    other = tmp_path / "hertz"
    other.mkdir()
    short_results(other, SCENE, every=50, contact="hertz")
    page = tmp_path / "both.html"
    Show([open_run(folder), open_run(other)]).write_html(page)
    peaks = [read_maps(one / "contact.h5").pressure_Pa.max() for one in (folder, other)]
    browser = Page(chromium).open(page.as_uri())
    move_slider(browser, 5)
    assert browser.evaluate("tkamb.data.peak_MPa") == pytest.approx(max(peaks) / 1e6)
    for view, one in enumerate((folder, other)):
        given = read_maps(one / "contact.h5").pressure_Pa[-1]
        drawn = levels(browser, view) * max(peaks)
        np.testing.assert_allclose(drawn[given > 0], given[given > 0], atol=1e-4 * max(peaks))
    assert browser.problems == []


def test_a_picture_is_written_as_png(show, chromium, tmp_path):
    show.write_png(tmp_path / "knee.png", (640, 480))
    assert (tmp_path / "knee.png").read_bytes().startswith(b"\x89PNG")


def test_the_lattice_is_drawn_when_its_layer_is_switched_on(live, show):
    _, browser = live
    browser.evaluate("document.querySelector('input[data-layer=\"lattice\"]').click()")
    lines = browser.evaluate(
        "new Promise((done) => { const t = setInterval(() => {"
        "const n = tkamb.node('/tkamb/0/lattice').children.lines;"
        "if (n && n.children['<object>']) { clearInterval(t); done(Array.from("
        "n.children['<object>'].object.geometry.attributes.position.array)); } }, 50); })"
    )
    ends = np.array(lines).reshape(-1, 2, 3)
    low, high = show.runs[0].case.insert.bounds
    assert (ends.min(axis=(0, 1)) > low - 1e-4).all() and (
        ends.max(axis=(0, 1)) < high + 1e-4
    ).all()
    assert 0.5e-3 < np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)) < 1.5e-3
    assert browser.evaluate("tkamb.layerShown('lattice')")
    assert browser.problems == []


def test_results_can_be_viewed_in_a_notebook(folder):
    text = tkamb.view(read_results(folder), frame=1)._repr_html_()
    assert text.startswith("<iframe srcdoc=") and "&lt;script" in text


def test_on_a_narrow_screen_the_panel_is_below_the_knee(browser):
    browser.resize(390, 844)
    box = "document.querySelector('{}').getBoundingClientRect()"
    knee, panel = (browser.evaluate(box.format(one)) for one in ("#pane canvas", "#side"))
    page = browser.evaluate("document.documentElement.scrollWidth")
    browser.resize(1400, 900)
    assert page == knee["width"] == panel["width"] == 390
    assert 0.4 * 844 < knee["bottom"] <= panel["top"] + 1 and panel["bottom"] == 844
