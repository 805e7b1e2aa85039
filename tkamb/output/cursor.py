"""The report's frame slider: one cursor in every plot, with the numbers of its frame.

The numbers stand in the page as JSON, rounded to five digits; without scripts, and on paper,
the page reads as before.
"""

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.output.axis import HorizontalAxis
from tkamb.output.panel import Panel
from tkamb.output.panels import centre_panel, panels

if TYPE_CHECKING:
    from tkamb.results import Results


def cursor_bar(results: "Results", axis: HorizontalAxis) -> str:
    """Return the slider, the numbers that it shows and the script that moves it (HTML)."""
    data = json.dumps(cursor_data(results, axis), separators=(",", ":"), allow_nan=False)
    data = data.replace("<", "\\u003c")
    last = len(results) - 1
    return (
        "<div id='bar' hidden><label>frame <input id='frame' type='range' min='0' "
        f"max='{last}' value='0'></label><output id='place'></output></div>\n"
        f"<script type='application/json' id='data'>{data}</script>\n<script>{SCRIPT}</script>"
    )


def cursor_data(results: "Results", axis: HorizontalAxis) -> dict[str, Any]:
    """Return what the cursor shows: places, flexion, status, and the lines of every plot."""
    drawn = (*panels(results), centre_panel(results))
    return {
        "x": _rounded(axis.values),
        "place": [f"{axis.label.split(' (')[0]} {axis.at(k)}" for k in range(len(results))],
        "status": results.status,
        "panels": {panel.name: _lines(panel) for panel in drawn if panel.lines},
    }


def _lines(panel: Panel) -> list[dict[str, Any]]:
    digits = _digits(panel)
    return [
        {
            "label": line.label,
            "colour": line.colour,
            "digits": digits,
            "values": _rounded(line.values),
        }
        for line in panel.lines
    ]


def _digits(panel: Panel) -> int:
    """Return how many decimals show a thousandth of the panel's largest value, at most 4."""
    largest = max(float(np.nanmax(np.abs(line.values))) for line in panel.lines)
    return int(np.clip(2 - np.floor(np.log10(largest)), 0, 4)) if largest > 0 else 0


def _rounded(values: Array) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]


SCRIPT = """
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const slider = document.getElementById("frame");
const plots = [...document.querySelectorAll("figure.plot")].map(figure => {
  const svg = figure.querySelector("svg");
  const [left, right, top, bottom] = svg.dataset.box.split(" ").map(Number);
  const [low, high] = svg.dataset.range.split(" ").map(Number);
  const line = document.createElementNS(svg.namespaceURI, "line");
  line.setAttribute("class", "cursor");
  line.setAttribute("y1", top);
  line.setAttribute("y2", bottom);
  svg.append(line);
  const place = x => left + (x - low) / (high - low) * (right - left);
  const value = at => low + (at - left) / (right - left) * (high - low);
  svg.addEventListener("pointermove", event => {
    const box = svg.getBoundingClientRect();
    show(nearest(value((event.clientX - box.left) / box.width * svg.viewBox.baseVal.width)));
  });
  return {line, place, readout: figure.querySelector(".readout"),
          lines: data.panels[figure.id.slice("figure-".length)]};
});
function nearest(x) {
  const now = Number(slider.value), range = Math.max(...data.x) - Math.min(...data.x) || 1;
  let best = now, least = Infinity;
  data.x.forEach((value, k) => {
    const far = Math.abs(value - x) / range + 0.02 * Math.abs(k - now) / data.x.length;
    if (far < least) { least = far; best = k; }
  });
  return best;
}
function written(value, digits) {
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}
function show(frame) {
  slider.value = frame;
  const status = data.status[frame] === "ok" ? "" : ", " + data.status[frame].replaceAll("_", " ");
  const place = document.getElementById("place");
  place.textContent = place.title = `${frame}: ${data.place[frame]}${status}`;
  for (const plot of plots) {
    const at = plot.place(data.x[frame]);
    plot.line.setAttribute("x1", at);
    plot.line.setAttribute("x2", at);
    plot.readout.replaceChildren(...plot.lines.map(line => {
      const span = document.createElement("span"), value = line.values[frame];
      span.style.color = line.colour;
      span.textContent = `${line.label} ${value === null ? "–" : written(value, line.digits)}`;
      return span;
    }));
  }
}
slider.addEventListener("input", () => show(Number(slider.value)));
document.getElementById("bar").hidden = false;
document.body.classList.add("live");
show(Number(slider.value));
"""
