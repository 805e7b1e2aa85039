"""The page of `tkamb live` in a headless browser: keys, sliders, failed states, saved states."""

import io

import numpy as np
import pytest
from PIL import Image

import tkamb
from headless import Page
from scenes import MODEL

IDLE = "tkamb.bench && !tkamb.bench.busy && !tkamb.bench.waiting"


@pytest.fixture(scope="module")
def page(chromium, tmp_path_factory):
    changes = {"contact.model": "foundation", "contact.resolution_mm": 3.0}
    knee, motion, _ = tkamb.read_scene(tkamb.load_scene(MODEL / "scene.toml", changes))
    server = tkamb.live(knee, motion.q[60], load=800.0, folder=tmp_path_factory.mktemp("kept"))
    page = Page(chromium).open(server.url)
    page.wait(f"{IDLE} && tkamb.bench.reference")
    yield page
    page.close()
    server.close()


def state_after(page, action):
    """Do an action, and return the state of the page after all answers."""
    page.evaluate(action)
    page.wait(f"{IDLE} && !tkamb.bench.timer")
    return page.evaluate(
        """() => ({mark: document.getElementById("mark").textContent,
          stale: document.body.classList.contains("stale"),
          request: tkamb.bench.answer.request, numbers: tkamb.bench.answer.numbers,
          shown: document.querySelector("[data-name=medial_force_N]").textContent})"""
    )


def change(group, key, value):
    return f"() => tkamb.bench.change('{group}', '{key}', {value}, false)"


def test_the_page_of_a_knee_object_has_no_frames(page):
    assert page.problems == []
    assert page.evaluate("() => document.getElementById('pose-frame')") is None
    assert page.evaluate("() => tkamb.bench.answer.request.load_N") == 800.0
    assert page.evaluate("() => document.getElementById('pose-thickness_mm')") is None
    assert page.evaluate("() => document.getElementById('pose-quadriceps_N')") is None
    assert page.evaluate("() => document.getElementById('patella').hidden")


def test_a_key_moves_a_slider_and_the_fine_model_is_computed(page):
    page.evaluate("() => document.getElementById('pose-flexion_deg').focus()")
    before = page.evaluate("() => tkamb.bench.state.flexion_deg")
    page.press("ArrowRight")
    page.wait(f"{IDLE} && tkamb.bench.answer.request.flexion_deg > {before}")
    page.wait(f"{IDLE} && tkamb.bench.answer.request.resolution_mm === 3")
    assert page.evaluate("() => document.getElementById('mark').className") == ""


def test_a_failed_state_shows_its_reason_and_the_last_valid_numbers_in_grey(page):
    central = state_after(page, change("pose", "ap_mm", 0.0))
    assert not central["stale"]
    dislocated = state_after(page, change("pose", "ap_mm", 55.0))
    assert dislocated["stale"] and "does not lie over the insert" in dislocated["mark"]
    assert (dislocated["shown"], dislocated["request"]) == (central["shown"], central["request"])
    beyond = state_after(page, change("pose", "ap_mm", 70.0))
    assert beyond["stale"] and "-60 to 60" in beyond["mark"]
    page.forgive("400")
    assert not state_after(page, change("pose", "ap_mm", 0.0))["stale"]


def test_a_ticked_coordinate_is_released(page):
    prescribed = state_after(page, change("pose", "adduction_deg", 0.5))
    released = state_after(page, "() => tkamb.bench.inputs['release adduction_deg'].click()")
    assert released["request"]["released"] == ["si", "adduction"]
    assert released["numbers"]["adduction_deg"] != pytest.approx(0.5, abs=0.01)
    assert released["numbers"]["medial_share"] != pytest.approx(
        prescribed["numbers"]["medial_share"], abs=1
    )
    state_after(page, "() => tkamb.bench.inputs['release adduction_deg'].click()")


def test_a_saved_state_has_a_row_and_a_scene_that_runs(page):
    state_after(page, change("tibial", "slope_deg", 4.0))
    page.evaluate("() => document.getElementById('keep').click()")
    page.wait("document.getElementById('saved').textContent.startsWith('saved: ')")
    path = page.evaluate("() => document.getElementById('saved').textContent").split(": ")[1]
    row = page.evaluate("() => document.getElementById('kept').rows[1].innerText").split()
    peak = tkamb.simulate(path, frames=slice(0, 1))["medial_peak_pressure_MPa"][0]
    assert f"{peak:.1f}" in row
    assert page.problems == []


def test_the_saved_picture_has_the_map_and_text_below_it(page):
    state_after(page, "() => document.getElementById('reset').click()")
    assert page.evaluate("() => tkamb.bench.answer.request.tibial.slope_deg") == 0.0
    picture = np.asarray(Image.open(io.BytesIO(page.saved("#picture"))).convert("RGB"), int)
    pane = page.evaluate("() => document.getElementById('pane').clientHeight")
    assert picture.shape[0] > pane
    colourful = np.ptp(picture[:pane], axis=2) > 60  # viridis; bones and metal are nearly grey
    assert colourful.any(axis=0).sum() > 30
    assert (picture[pane:] < 100).any() and (picture[pane:] == 255).mean() > 0.8


def test_every_text_has_enough_contrast(page):
    """The limit is 4.5 to 1 (WCAG 2.2, criterion 1.4.3). Hidden elements are not checked."""
    assert page.evaluate(CONTRAST) == []


CONTRAST = """() => {
  const numbers = (text) => text.match(/[0-9.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((x) => x / 255)
    .map((x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4))
    .reduce((sum, x, k) => sum + [0.2126, 0.7152, 0.0722][k] * x, 0);
  const ground = (element) => {
    for (let one = element; one; one = one.parentElement) {
      const rgba = numbers(getComputedStyle(one).backgroundColor);
      if (rgba.length === 3 || rgba[3] > 0.5) return rgba.slice(0, 3);
    }
    return [255, 255, 255];
  };
  const weak = [];
  for (const way of ["", "stale"]) {
    if (way) document.body.classList.add(way);
    for (const element of document.querySelectorAll("body *")) {
      const own = [...element.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
      if (!own || !element.checkVisibility() || ["SCRIPT", "STYLE"].includes(element.tagName)) {
        continue;
      }
      const [a, b] = [light(numbers(getComputedStyle(element).color)), light(ground(element))];
      const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
      if (ratio < 4.5) weak.push(`${element.tagName} ${element.textContent} ${ratio.toFixed(2)}`);
    }
    if (way) document.body.classList.remove(way);
  }
  return weak;
}"""
