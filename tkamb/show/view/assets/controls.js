"use strict";
// The page around the scene: slider, layers, cameras, numbers, colour bars, contact models.

const CAMERAS = {
  "oblique": {from: [0.36, 0.17, -0.34]},
  "anterior": {from: [0.52, 0.06, 0]},
  "medial": {from: [0, 0.04, -0.52]},
  "lateral": {from: [0, 0.04, 0.52]},
  "top of insert": {
    from: [-0.0004, 0.21, 0], at: [0, 0.012, 0],
    without: ["femoral component", "bones", "floor", "patella", "ligaments", "extensor lines", "forces"]},
  "whole leg": {from: [1.6, 0.35, -1.6], at: [-0.04, -0.01, 0], arrows: 2.5},
  "button": {without: ["femoral component", "recorded pose", "insert", "worn insert", "bones", "floor",
    "ligaments", "extensor lines", "muscles", "forces", "contact points", "load paths"]},
};
const KNEE = [0, 0.03, 0];
const element = (id) => document.getElementById(id);

function made(tag, text, parent, attributes = {}) {
  const child = document.createElement(tag);
  child.textContent = text;
  for (const [name, value] of Object.entries(attributes)) child.setAttribute(name, value);
  if (parent) parent.appendChild(child);
  return child;
}

const canLook = (name) => name !== "button" || Boolean(tkamb.views[0].button_map);

// The pressed side of the patellar button, from where it faces at this moment.
function beforeButton(mirrored) {
  const {object} = tkamb.node("/tkamb/0/pressure map/button");
  object.updateWorldMatrix(true, false);
  const {elements} = object.matrixWorld, [x, y, z] = elements.slice(4, 7).map((part) => 0.24 * part);
  return {at: elements.slice(12, 15), from: [x, y, mirrored * z]};
}

tkamb.aim = function (name) {
  const {viewer} = tkamb, mirrored = tkamb.views[0].side === "left" ? -1 : 1;
  const camera = name === "button" ? beforeButton(mirrored) : CAMERAS[name], at = camera.at || KNEE;
  const pane = element("pane"), shape = pane.offsetWidth / tkamb.views.length / pane.offsetHeight;
  // The window of one knee without bones shows it from nearer.
  const near = camera.at ? 1 : tkamb.closeness || 1;
  const farther = near * Math.max(1, 0.8 / shape);
  viewer.controls.target.set(...at);
  viewer.camera.position.set(
    at[0] + farther * camera.from[0],
    at[1] + farther * camera.from[1],
    at[2] + farther * mirrored * camera.from[2]);
};

// The button moves with the knee, and so does the camera before it.
tkamb.follow = () => tkamb.camera === "button" && tkamb.aim("button");

tkamb.look = function (name) {
  const camera = CAMERAS[name];
  tkamb.aim(name);
  for (const layer of tkamb.data.layers) {
    const off = (camera.without || []).includes(layer) || tkamb.switchedOff.has(layer);
    tkamb.showLayer(layer, !off);
  }
  for (const {mapMesh} of tkamb.views) if (mapMesh) mapMesh.visible = name !== "button";
  tkamb.camera = name;
  tkamb.arrowLength = tkamb.data.metres_per_body_weight * (camera.arrows || 1);
  showScale();
  tkamb.showFrame(tkamb.frame);
  for (const button of element("cameras").children) {
    button.setAttribute("aria-pressed", button.textContent === name);
  }
  showSwitches();
};

function addCameras() {
  Object.keys(CAMERAS).forEach((name, k) => {
    if (!canLook(name)) return;
    const button = made("button", name, element("cameras"), {title: `key ${k + 1}`});
    button.addEventListener("click", () => tkamb.look(name));
  });
}

// What lies above the worn insert and would hide it.
const UNWORN = ["insert", "pressure map"];

function switchLayer(layer, shown) {
  tkamb.switchedOff[shown ? "delete" : "add"](layer);
  tkamb.showLayer(layer, shown);
}

function addLayers(canAsk) {
  tkamb.switchedOff = new Set(tkamb.data.hidden);
  for (const layer of tkamb.data.layers) {
    if (isEmpty(layer) && !(layer === "lattice" && canAsk)) continue;
    const label = made("label", "", element("layers"));
    const box = made("input", "", label, {type: "checkbox", "data-layer": layer});
    label.append(layer === "recorded pose" ? "recorded pose (ghost)" : layer);
    box.addEventListener("change", () => {
      switchLayer(layer, box.checked);
      if (layer === "worn insert") UNWORN.forEach((other) => switchLayer(other, !box.checked));
      showSwitches();
      if (layer === "lattice" && tkamb.live) tkamb.live.fetchLattice();
    });
  }
}

function isEmpty(layer) {
  return tkamb.views.every((view) =>
    Object.keys(tkamb.node(`${view.root}/${layer}`).children).length === 0);
}

function showSwitches() {
  for (const box of document.querySelectorAll("#layers input")) {
    box.checked = tkamb.layerShown(box.dataset.layer);
  }
}

function addLegends() {
  const {data, views} = tkamb;
  const peak = data.peak_MPa;
  element("pressure-bar").hidden = !(peak > 0);
  element("wear-bar").hidden = !(data.wear_limit_mm > 0);
  element("strain-bar").hidden = !(data.strain_limit > 0);
  element("activation-bar").hidden = !(data.activation_limit > 0);
  colourBar("pressure-bar", data.pressure_scale, peak, 1);
  colourBar("wear-bar", data.wear_scale, data.wear_limit_mm, data.wear_limit_mm < 0.1 ? 3 : 2);
  colourBar("strain-bar", data.strain_scale, 100 * data.strain_limit, 1);
  colourBar("activation-bar", data.activation_scale, 100 * data.activation_limit, 1);
  if (views.length > 1) {
    const head = made("tr", "", element("forces"));
    made("th", "", head, {colspan: 2});
    views.forEach((_, k) => made("th", runLetter(k), head, {class: "number"}));
  }
  const known = new Set();
  for (const view of views) {
    for (const arrow of view.arrows) {
      if (known.has(arrow.name)) continue;
      known.add(arrow.name);
      const row = made("tr", "", element("forces"), {title: arrow.meaning});
      made("i", "", made("td", "", row)).style.background = arrow.colour;
      made("td", views.length > 1 ? arrow.name : `${arrow.name}, ${arrow.meaning}`, row);
      for (const other of views) {
        made("td", "", row, {class: "number"}).arrow = other.arrows.find(
          (one) => one.name === arrow.name);
      }
    }
  }
}

function showScale() {
  const found = tkamb.views.map((view) => `${view.body_weight.toFixed(0)} N`);
  const weights = [...new Set(found)].join(" / ");
  const millimetres = (1000 * tkamb.arrowLength).toFixed(0);
  element("scale").textContent = `${millimetres} mm of arrow = 1 BW = ${weights}`;
}

function colourBar(id, scale, top, digits) {
  const stops = [];
  for (let k = 0; k < 256; k += 15) {
    stops.push(`rgb(${scale[3 * k]},${scale[3 * k + 1]},${scale[3 * k + 2]})`);
  }
  const bar = element(id);
  bar.querySelector(".stripe").style.background = `linear-gradient(to top, ${stops.join(",")})`;
  bar.dataset.low = 0;
  bar.dataset.high = top;
  const ticks = bar.querySelector(".ticks");
  for (const share of [1, 0.75, 0.5, 0.25, 0]) {
    made("span", (share * top).toFixed(digits), ticks).style.bottom = `${100 * share}%`;
  }
}

function addNumbers() {
  const table = element("numbers"), {views} = tkamb;
  element("titles").replaceChildren();
  for (const view of views) made("div", "", element("titles"));
  document.body.classList.toggle("several", views.length > 1);
  if (views.length > 1) {
    const head = made("tr", "", table);
    made("th", "", head);
    views.forEach((_, k) => made("th", runLetter(k), head));
  }
  const names = [...new Set(views.flatMap((view) => view.readings.map((row) => row.name)))];
  for (const name of names) {
    const row = made("tr", "", table);
    made("td", name, row);
    for (const view of views) {
      const found = view.readings.find((one) => one.name === name);
      made("td", "", row, {class: "number"}).values = found && found.values;
    }
  }
  const notes = new Set(views.flatMap((view) => view.notes));
  for (const note of notes) made("li", note, element("notes"));
}

// What a run is called beside others.
function runLetter(k) {
  return String.fromCharCode(65 + k);
}

function showNumbers() {
  const frames = tkamb.views.map(tkamb.frameOf);
  for (const row of element("numbers").rows) {
    [...row.cells].slice(1).forEach((cell, k) => {
      if (cell.tagName === "TD") cell.textContent = cell.values ? cell.values[frames[k]] : "–";
    });
  }
  for (const row of element("forces").rows) {
    if (row.cells[0].tagName === "TH") continue;
    [...row.cells].slice(2).forEach((cell, k) => {
      cell.textContent = inBodyWeights(cell.arrow, frames[k], tkamb.views[k].body_weight);
    });
  }
  [...element("titles").children].forEach((title, k) => {
    const view = tkamb.views[k], place = tkamb.views.length > 1 ? ` · ${view.labels[frames[k]]}` : "";
    const letter = tkamb.views.length > 1 ? `${runLetter(k)}: ` : "";
    title.textContent = `${letter}${view.title} · ${view.side} knee${place}`;
  });
  const words = tkamb.views.map((view, k) => view.statuses[frames[k]]);
  const plain = words.map((word) => (word === "ok" ? "" : word)).filter(Boolean);
  element("status").textContent = [...new Set(plain)].join(" · ");
  element("status").hidden = plain.length === 0;
  element("place").textContent =
    `frame ${tkamb.frame} of ${tkamb.frameCount() - 1}: ${tkamb.views[0].labels[frames[0]]}`;
  element("frame").value = tkamb.frame;
  element("caption").textContent = element("place").textContent;
}

function inBodyWeights(arrow, frame, weight) {
  if (!arrow) return "–";
  const size = Math.hypot(...arrow.forces.subarray(3 * frame, 3 * frame + 3));
  return Number.isFinite(size) ? `${(size / weight).toFixed(2)} BW` : "–";
}

tkamb.go = function (frame) {
  tkamb.showFrame(frame);
  tkamb.follow();
  showNumbers();
  tkamb.live && tkamb.live.frameChanged();
};

function addPlayer() {
  const slider = element("frame"), button = element("play");
  slider.max = tkamb.frameCount() - 1;
  slider.addEventListener("input", () => tkamb.go(Number(slider.value)));
  let started = null;
  const times = tkamb.views.reduce((a, b) => (a.times.length >= b.times.length ? a : b)).times;
  const last = times.length - 1;
  const step = (now) => {
    if (started === null) return;
    const speed = Number(element("speed").value);
    const time = times[0] + started.from + (now - started.at) / 1000 * speed;
    if (time > times[last]) started = {at: now, from: 0};
    let frame = 0;
    while (frame < last && times[frame + 1] <= time) frame++;
    const wanted = time > times[last] ? 0 : frame;
    if (wanted !== tkamb.frame) tkamb.go(wanted);
    requestAnimationFrame(step);
  };
  const restart = () => {
    started = {at: performance.now(), from: times[tkamb.frame] - times[0]};
  };
  tkamb.play = (on) => {
    const was = started !== null;
    if (on) restart(); else started = null;
    button.textContent = on ? "❚❚ pause" : "▶ play";
    if (on && !was) requestAnimationFrame(step);
  };
  button.addEventListener("click", () => tkamb.play(started === null));
  element("speed").addEventListener("change", () => started && restart());
  slider.addEventListener("pointerdown", () => tkamb.play(false));
  tkamb.togglePlay = () => tkamb.play(started === null);
}

function addKeys() {
  document.addEventListener("keydown", (event) => {
    if (["INPUT", "SELECT"].includes(event.target.tagName) && event.target.type !== "checkbox") {
      return;
    }
    const camera = Object.keys(CAMERAS)[Number(event.key) - 1];
    if (event.key === " ") tkamb.togglePlay();
    else if (event.key === "ArrowRight") tkamb.go(tkamb.frame + 1);
    else if (event.key === "ArrowLeft") tkamb.go(tkamb.frame - 1);
    else if (event.key === "n") element("reading").toggleAttribute("open");
    else if (event.key === "t") {
      const {style} = tkamb.viewer.gui.domElement;
      style.display = style.display === "none" ? "" : "none";
    } else if (camera && canLook(camera)) tkamb.look(camera);
    else return;
    event.preventDefault();
  });
}
