"use strict";
// The bench: sliders change one state; the latest state is computed, anything older is dropped.

const RELEASABLE = {adduction_deg: "adduction", axial_rotation_deg: "axial_rotation",
  ap_mm: "ap", ml_mm: "ml"};
const SLIDERS = {
  pose: [["frame", "recorded frame", 0, 0, 1], ["flexion_deg", "flexion, deg", -10, 150, 0.5],
    ["adduction_deg", "varus, deg", -8, 8, 0.05], ["axial_rotation_deg", "rotation, deg", -25, 25, 0.1],
    ["ap_mm", "AP, mm", -20, 20, 0.1], ["ml_mm", "ML, mm", -10, 10, 0.1],
    ["load_N", "load, N", 0, 4000, 10]],
  femoral: [["varus_deg", "varus, deg", -8, 8, 0.1], ["rotation_deg", "rotation, deg", -10, 10, 0.1],
    ["slope_deg", "flexion, deg", -10, 10, 0.1], ["ap_mm", "AP, mm", -8, 8, 0.1],
    ["ml_mm", "ML, mm", -8, 8, 0.1]],
  tibial: [["varus_deg", "varus, deg", -8, 8, 0.1], ["rotation_deg", "rotation, deg", -15, 15, 0.1],
    ["slope_deg", "slope, deg", -5, 15, 0.1], ["ap_mm", "AP, mm", -8, 8, 0.1],
    ["ml_mm", "ML, mm", -8, 8, 0.1]],
  soft: [["slack_percent", "slack length, %", -10, 10, 0.1]],
};
const ROWS = [["force_si_N", "force, N", 0], ["medial_share", "medial share, %", 1],
  ["medial_force_N", "medial force, N", 0], ["lateral_force_N", "lateral force, N", 0],
  ["medial_peak_pressure_MPa", "medial peak, MPa", 1],
  ["lateral_peak_pressure_MPa", "lateral peak, MPa", 1],
  ["medial_mean_pressure_MPa", "medial mean, MPa", 1],
  ["lateral_mean_pressure_MPa", "lateral mean, MPa", 1],
  ["medial_area_mm2", "medial area, mm²", 0], ["lateral_area_mm2", "lateral area, mm²", 0],
  ["approach_mm", "approach, mm", 3]];
const SETTLE_MS = 180;
const RETRY_MS = 700;
const COARSE_NAME = "coarse while moving";

class Bench {
  constructor(request) {
    Object.assign(this, request);
    this.state = structuredClone(request.start);
    this.count = {asked: 0, shown: 0, dropped: 0};
    this.inputs = {};
    this.addChoices();
    for (const [group, rows] of Object.entries(SLIDERS)) {
      for (const row of rows) this.addSlider(group, row);
    }
    element("reset").addEventListener("click", () => this.toFrame(this.frame));
    element("reference").addEventListener("click", () => this.makeReference());
    element("keep").addEventListener("click", () => this.keep());
    element("picture").addEventListener("click", () => this.savePicture());
    this.frame = request.frame;
    this.showState();
  }

  addChoices() {
    for (const name of this.models) {
      made("option", name, element("contact"), {value: name}).selected = name === this.state.contact;
    }
    const spacings = [...new Set([0.7, 1, 1.5, 2, 3, this.state.resolution_mm])].sort((a, b) => a - b);
    for (const mm of spacings) {
      made("option", `${mm} mm`, element("resolution"), {value: mm}).selected =
        mm === this.state.resolution_mm;
    }
    element("contact").addEventListener("change", (event) => {
      this.state.contact = event.target.value;
      this.ask(false);
    });
    element("resolution").addEventListener("change", (event) => {
      this.state.resolution_mm = Number(event.target.value);
      this.ask(false);
    });
  }

  addSlider(group, [key, words, low, high, step]) {
    const row = made("div", "", element(group), {class: "slider"});
    if (group === "pose" && key in RELEASABLE) {
      const box = made("input", "", row, {type: "checkbox", "aria-label": `release ${words}`,
        title: "release: found by equilibrium"});
      box.addEventListener("change", () => {
        const name = RELEASABLE[key], others = this.state.released.filter((one) => one !== name);
        this.state.released = box.checked ? [...others, name] : others;
        if (this.state.released.every((one) => one === "si")) this.state.released = [];
        this.ask(false);
      });
      this.inputs[`release ${key}`] = box;
    } else made("span", "", row);
    const id = `${group}-${key}`;
    made("label", words, row, {for: id});
    const top = key === "frame" ? this.frames - 1 : high;
    const range = made("input", "", row, {id, type: "range", min: low, max: top, step});
    const exact = made("input", "", row, {type: "number", step: "any", "aria-label": words});
    range.addEventListener("input", () => this.change(group, key, Number(range.value), true));
    range.addEventListener("change", () => this.settle());
    exact.addEventListener("change", () => this.change(group, key, Number(exact.value), false));
    this.inputs[id] = [range, exact];
  }

  holder(group) {
    return group === "femoral" || group === "tibial" ? this.state[group] : this.state;
  }

  change(group, key, value, moving) {
    if (key === "frame") {
      this.toFrame(value, moving);
      return;
    }
    this.holder(group)[key] = value;
    this.showState();
    this.ask(moving);
  }

  toFrame(frame, moving = false) {
    this.frame = Math.max(0, Math.min(this.frames - 1, Math.round(frame)));
    Object.assign(this.state, this.recorded[this.frame]);
    tkamb.viewer.set_transform(tkamb.split("/tkamb/0/recorded pose/recorded femoral component"),
      this.ghosts[this.frame]);
    this.showState();
    this.ask(moving);
  }

  showState() {
    for (const [group, rows] of Object.entries(SLIDERS)) {
      for (const [key] of rows) {
        const value = key === "frame" ? this.frame : this.holder(group)[key];
        const [range, exact] = this.inputs[`${group}-${key}`];
        range.value = value;
        exact.value = Number(value.toFixed(key === "load_N" ? 0 : 3));
      }
    }
    for (const [key, name] of Object.entries(RELEASABLE)) {
      this.inputs[`release ${key}`].checked = this.state.released.includes(name);
    }
  }

  settle() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.ask(false), 0);
  }

  // One request is under way at most; the newest state waits, and is asked next.
  ask(moving) {
    clearTimeout(this.timer);
    if (moving) this.timer = setTimeout(() => this.ask(false), SETTLE_MS);
    const request = structuredClone(this.state);
    if (moving) [request.contact, request.resolution_mm] = this.coarse;
    if (this.waiting) this.count.dropped++;
    this.waiting = {request, coarse: moving, number: ++this.count.asked};
    if (!this.busy) this.next();
  }

  async next() {
    this.busy = true;
    while (this.waiting) {
      const asked = this.waiting;
      this.waiting = null;
      if (!asked.coarse) element("mark").textContent = `computing ${asked.request.contact} …`;
      try {
        const response = await fetch("live", {method: "POST",
          headers: {"Content-Type": "application/json"}, body: JSON.stringify(asked.request)});
        if (response.status === 202) {
          this.waitFor(await response.text(), asked);
        } else if (response.ok) {
          this.show(await tkamb.unpack(new Uint8Array(await response.arrayBuffer())), asked);
        } else {
          const words = await response.text();
          if (words !== "overtaken") this.refuse(words);
        }
      } catch (error) {
        this.refuse(`no answer: ${error.message}`);
      }
    }
    this.busy = false;
  }

  // A model that is being prepared: the coarse one is shown, and the fine one asked for again.
  waitFor(words, asked) {
    const mark = element("mark");
    mark.className = "coarse";
    mark.textContent = `${words} …`;
    if (this.waiting) return;
    const request = structuredClone(asked.request);
    [request.contact, request.resolution_mm] = this.coarse;
    this.waiting = {request, coarse: true, number: asked.number, words};
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.ask(false), RETRY_MS);
  }

  refuse(words) {
    const mark = element("mark");
    mark.className = "failed";
    mark.textContent = words;
    element("numbers").classList.add("old");
  }

  show(packed, asked) {
    const answer = JSON.parse(packed.words), mark = element("mark");
    this.count.shown = asked.number;
    if (answer.status.startsWith("failed: ")) {
      this.refuse(`${answer.status.slice(8)} (below: the last good state)`);
      return;
    }
    this.answer = answer;
    mark.className = asked.coarse ? "coarse" : "";
    mark.textContent = asked.coarse
      ? `${asked.words ? `${asked.words} …; shown` : COARSE_NAME}: ${answer.label}` : `${answer.label}; ${answer.error}`;
    element("numbers").classList.remove("old");
    element("status").hidden = answer.status === "ok";
    element("status").textContent = answer.status;
    this.drawMap(packed.map, answer);
    const root = "/tkamb/0";
    tkamb.viewer.set_transform(
      tkamb.split(`${root}/femoral component/femoral component`), answer.pose);
    for (const tube of tkamb.views[0].tubes) {
      const ends = answer.ligaments[tube.strand.path.split("/").pop()];
      if (!ends) continue;
      tube.strand.points.set(ends.flat());
      tube.shown = -1;
      tube.show(0);
    }
    for (const marker of tkamb.views[0].markers) {
      marker.points.set(answer.centres[marker.path.split("/").pop()] || [NaN, NaN, NaN]);
      placeMarker(marker, 0);
    }
    tkamb.viewer.set_dirty();
    if (!asked.coarse && !this.reference) this.reference = answer.numbers;
    this.showNumbers();
    document.body.dataset.shown = asked.number;
  }

  drawMap(map, answer) {
    const view = tkamb.views[0], key = answer.label;
    if (this.mapKey === key) {
      view.map.levels = map.levels;
    } else {
      this.mapKey = key;
      view.runMap = map;
      tkamb.showMap(view, map);
    }
    if (tkamb.data.peak_MPa !== answer.scale_MPa) {
      tkamb.data.peak_MPa = answer.scale_MPa;
      element("pressure-bar").querySelector(".ticks").replaceChildren();
      colourBar("pressure-bar", tkamb.data.pressure_scale, answer.scale_MPa, 1);
    }
    tkamb.colourMap(view, 0);
  }

  showNumbers() {
    const table = element("numbers"), {numbers} = this.answer, reference = this.reference || {};
    table.replaceChildren();
    const head = made("tr", "", table);
    for (const word of ["", "now", "reference", "difference"]) made("th", word, head);
    const ligaments = Object.keys(numbers).filter((name) => name.startsWith("ligament_"))
      .map((name) => [name, `${name.slice(9, -2).replaceAll("_", " ")}, N`, 0]);
    for (const [name, words, digits] of [...ROWS, ...ligaments]) {
      const now = numbers[name], then = reference[name];
      if (now === undefined && then === undefined) continue;
      const row = made("tr", "", table, {"data-name": name});
      made("td", words, row);
      const text = (x) => (Number.isFinite(x) ? x.toFixed(digits).replace("-", "−") : "–");
      made("td", text(now), row, {class: "number"});
      made("td", text(then), row, {class: "number"});
      made("td", Number.isFinite(now - then) ? text(now - then) : "–", row, {class: "number"});
    }
  }

  makeReference() {
    this.reference = this.answer && this.answer.numbers;
    if (this.answer) this.showNumbers();
  }

  async keep() {
    const request = structuredClone(this.state);
    const response = await fetch("save", {method: "POST",
      headers: {"Content-Type": "application/json"}, body: JSON.stringify(request)});
    const words = await response.text();
    element("saved").textContent = response.ok ? `saved: ${words}` : words;
    if (!response.ok) return;
    element("kept-box").hidden = false;
    const table = element("kept"), {numbers} = this.answer;
    if (!table.rows.length) {
      const head = made("tr", "", table);
      for (const word of ["scene", "flexion", "load, N", "M peak", "L peak", "M share, %"]) {
        made("th", word, head);
      }
    }
    const row = made("tr", "", table), text = (x) => (Number.isFinite(x) ? x.toFixed(1) : "–");
    made("td", words.split("/").slice(-2)[0], row);
    for (const value of [request.flexion_deg, request.load_N, numbers.medial_peak_pressure_MPa,
      numbers.lateral_peak_pressure_MPa, numbers.medial_share]) {
      made("td", text(value), row, {class: "number"});
    }
  }

  savePicture() {
    tkamb.viewer.render();
    element("pane").querySelector("canvas").toBlob((blob) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = "knee.png";
      link.click();
      URL.revokeObjectURL(link.href);
    });
  }
}

tkamb.startLive = async function () {
  const request = JSON.parse(document.getElementById("request").textContent);
  const bytes = new Uint8Array(await (await fetch("scene.bin")).arrayBuffer());
  const data = await tkamb.unpack(bytes);
  tkamb.viewer = newViewer(document.getElementById("pane"), !softwareGraphics());
  tkamb.build(data);
  addCameras();
  addLayers(false);
  switchLayer("recorded pose", true);
  colourBar("pressure-bar", data.pressure_scale, data.peak_MPa, 1);
  made("div", `${tkamb.views[0].title} · ${tkamb.views[0].side} knee`, element("titles"));
  tkamb.look("oblique");
  tkamb.viewer.set_3d_pane_size();
  tkamb.bench = new Bench(request);
  tkamb.bench.toFrame(request.frame);
  tkamb.viewer.render();
  document.body.dataset.ready = "yes";
};

tkamb.startLive().catch((error) => {
  document.getElementById("status").hidden = false;
  document.getElementById("status").textContent = `The knee cannot be shown: ${error.message}`;
  console.error(error);
});
