"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const slider = document.getElementById("frame");
const watchers = [];  // what else follows the slider: functions of the frame

function draw(parent, name, attributes) {  // an element of an SVG picture
  const made = document.createElementNS(parent.namespaceURI, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent.append(made);
  return made;
}

const plots = [...document.querySelectorAll("figure.plot")].map(figure => {
  const svg = figure.querySelector("svg"), name = figure.id.slice("figure-".length);
  const [left, right, top, bottom] = svg.dataset.box.split(" ").map(Number);
  const [low, high] = svg.dataset.range.split(" ").map(Number);
  const line = draw(svg, "line", {class: "cursor", y1: top, y2: bottom});
  const value = at => low + (at - left) / (right - left) * (high - low);
  svg.addEventListener("pointermove", event => {
    const box = svg.getBoundingClientRect();
    show(nearest(value((event.clientX - box.left) / box.width * svg.viewBox.baseVal.width)));
  });
  return {
    figure, svg, name, line, left, right, top, bottom, scale: 1,
    place: x => left + (x - low) / (high - low) * (right - left),
    readout: figure.querySelector(".readout"), ...data.panels[name],
  };
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

function readoutSpan(plot, line, frame) {
  const span = document.createElement("span"), swatch = document.createElement("i");
  const value = line.values[frame], digits = plot.scale === 1 ? line.digits : 0;
  swatch.style.borderTop = `3px ${line.dashed ? "dashed" : "solid"} ${line.colour}`;
  const number = value === null ? "–" : written(value * plot.scale, digits);
  span.append(swatch, `${line.label} ${number}`);
  return span;
}

function show(frame) {
  slider.value = frame;
  const status = data.status[frame] === "ok" ? "" : ", " + data.status[frame].replaceAll("_", " ");
  const place = document.getElementById("place");
  place.textContent = place.title = `${data.frames[frame]}: ${data.place[frame]}${status}`;
  for (const plot of plots) {
    const at = plot.place(data.x[frame]);
    plot.line.setAttribute("x1", at);
    plot.line.setAttribute("x2", at);
    plot.readout.replaceChildren(...plot.lines.map(line => readoutSpan(plot, line, frame)));
  }
  for (const watcher of watchers) watcher(frame);
}
