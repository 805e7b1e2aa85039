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
