"use strict";
// The bench: sliders change one state; the latest state is computed, anything older is dropped.

const RELEASABLE = {adduction_deg: "adduction", axial_rotation_deg: "axial_rotation",
  ap_mm: "ap", ml_mm: "ml"};
const SLIDERS = {
  pose: [["frame", "recorded frame", 0, 0, 1], ["flexion_deg", "flexion, deg", -10, 150, 0.5],
    ["adduction_deg", "varus, deg", -8, 8, 0.05], ["axial_rotation_deg", "rotation, deg", -25, 25, 0.1],
    ["ap_mm", "AP, mm", -20, 20, 0.1], ["ml_mm", "ML, mm", -10, 10, 0.1],
    ["load_N", "load, N", 0, 4000, 10], ["quadriceps_N", "quadriceps, N", 0, 4000, 10],
    ["thickness_mm", "thickness, mm", 5, 20, 0.5]],
  femoral: [["varus_deg", "varus, deg", -8, 8, 0.1], ["rotation_deg", "rotation, deg", -10, 10, 0.1],
    ["slope_deg", "flexion, deg", -10, 10, 0.1], ["ap_mm", "AP, mm", -8, 8, 0.1],
    ["ml_mm", "ML, mm", -8, 8, 0.1]],
  tibial: [["varus_deg", "varus, deg", -8, 8, 0.1], ["rotation_deg", "rotation, deg", -15, 15, 0.1],
    ["slope_deg", "slope, deg", -5, 15, 0.1], ["ap_mm", "AP, mm", -8, 8, 0.1],
    ["ml_mm", "ML, mm", -8, 8, 0.1]],
  soft: [["slack_percent", "slack length, %", -10, 10, 0.1]],
};
const TOTALS = [["force_si_N", "contact force, N", 0], ["medial_share", "medial share by deformation, %", 1],
  ["approach_mm", "approach, mm", 3]];
const CONDYLE = [["force_N", "force, N", 0], ["peak_pressure_MPa", "peak, MPa", 1],
  ["mean_pressure_MPa", "mean, MPa", 1], ["area_mm2", "area, mm²", 0],
  ["cop_ap_mm", "centre AP, mm", 1], ["cop_ml_mm", "centre ML, mm", 1]];
const PATELLA = [["patella_tilt_deg", "tilt to lateral, deg", 1], ["patella_shift_mm", "shift to lateral, mm", 1],
  ["button_force_N", "contact force, N", 0], ["button_medial_force_N", "medial facet, N", 0],
  ["button_lateral_force_N", "lateral facet, N", 0], ["button_peak_pressure_MPa", "peak, MPa", 1],
  ["button_area_mm2", "area, mm²", 0]];
const KEPT = [["flexion_deg", "flexion", 1], ["load_N", "load, N", 0], ["medial_share", "M share, %", 1],
  ["medial_peak_pressure_MPa", "M peak, MPa", 1], ["lateral_peak_pressure_MPa", "L peak, MPa", 1],
  ["medial_area_mm2", "M area, mm²", 0], ["lateral_area_mm2", "L area, mm²", 0]];
const SETTLE_MS = 180;
const RETRY_MS = 700;
const COARSE_NAME = "coarse while moving";

function inWords(x, digits, signed = false) {
  if (!Number.isFinite(x)) return "–";
  const text = x.toFixed(digits);
  if (Number(text) === 0) return signed ? "0" : text.replace("-", "");
  return `${signed && x > 0 ? "+" : ""}${text}`.replace("-", "−");
}

class Bench {
  constructor(request) {
    Object.assign(this, request);
    this.state = structuredClone(request.start);
    this.count = {asked: 0, shown: 0, dropped: 0};
    this.inputs = {};
    this.maps = {};
    this.addChoices();
    for (const [group, rows] of Object.entries(SLIDERS)) {
      SLIDERS[group] = rows.filter(([key]) => this.applies(key));
      for (const row of SLIDERS[group]) this.addSlider(group, row);
    }
    element("reset").addEventListener("click", () => this.reset());
    element("reference").addEventListener("click", () => this.makeReference());
    element("keep").addEventListener("click", () => this.keep());
    element("picture").addEventListener("click", () => this.savePicture());
    this.frame = request.frame;
    this.showState();
  }

  // One pose has no frames, a mesh without a design no thickness, a plane patella no tension.
  applies(key) {
    return key === "frame" ? this.frames > 1 : this.start[key] !== null;
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
    const top = {frame: this.frames - 1, load_N: this.most_load_N}[key] || high;
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
    if (key === "thickness_mm") this.drawInsert(value);
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

  // The dishes rise with the thickness; the bottom stays.
  drawInsert(thickness) {
    const mesh = tkamb.node("/tkamb/0/insert/insert/<object>").object;
    const {position} = mesh.geometry.attributes;
    this.insert = this.insert || position.array.slice();
    const rise = (thickness - this.thickness_mm) / 1000, whole = this.thickness_mm / 2000;
    for (let k = 1; k < position.array.length; k += 3) {
      position.array[k] = this.insert[k] + rise * Math.min(1, this.insert[k] / whole);
    }
    position.needsUpdate = true;
  }

  reset() {
    const {contact, resolution_mm} = this.state;
    Object.assign(this.state, structuredClone(this.start), {contact, resolution_mm});
    if (this.thickness_mm !== null) this.drawInsert(this.thickness_mm);
    this.toFrame(this.frame);
  }

  showState() {
    for (const [group, rows] of Object.entries(SLIDERS)) {
      for (const [key] of rows) {
        const value = key === "frame" ? this.frame : this.holder(group)[key];
        const [range, exact] = this.inputs[`${group}-${key}`];
        range.value = value;
        exact.value = Number(value.toFixed(key === "load_N" ? 0 : 2));
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
    this.timer = moving ? setTimeout(() => this.ask(false), SETTLE_MS) : 0;
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
      if (!asked.coarse && !this.preparing) element("mark").textContent = `computing ${asked.request.contact} …`;
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

  // A model that is being prepared: the coarse one is shown, once, and the fine one asked for again.
  waitFor(words, asked) {
    if (this.waiting) return;
    const key = JSON.stringify(asked.request);
    if (this.preparing !== key) {
      this.preparing = key;
      element("mark").className = "coarse";
      element("mark").textContent = `${words} …`;
      const request = structuredClone(asked.request);
      [request.contact, request.resolution_mm] = this.coarse;
      this.waiting = {request, coarse: true, number: asked.number, words};
    }
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.ask(false), RETRY_MS);
  }

  refuse(words) {
    const mark = element("mark");
    mark.className = "failed";
    mark.textContent = words;
    this.preparing = "";
    document.body.classList.add("stale");
    this.refused = words;
  }

  show(packed, asked) {
    const answer = JSON.parse(packed.words), mark = element("mark");
    this.count.shown = asked.number;
    if (answer.status.startsWith("failed: ")) {
      this.refuse(`${answer.status.slice(8)} (grey: the last good state)`);
      return;
    }
    this.answer = answer;
    if (!asked.coarse) this.preparing = "";
    mark.className = asked.coarse ? "coarse" : "";
    const how = asked.words ? `${asked.words} …; shown: ` : `${COARSE_NAME}: `;
    mark.textContent = `${asked.coarse ? how : ""}${answer.label}; ${answer.error}`;
    document.body.classList.remove("stale");
    this.refused = "";
    element("status").hidden = answer.status === "ok";
    element("status").textContent = answer.status;
    if (packed.button_map) tkamb.views[0].button_map.levels = packed.button_map.levels;
    this.drawMap(packed.map, answer);
    for (const [name, pose] of Object.entries(answer.poses)) {
      const path = `/tkamb/0/${name}`;
      tkamb.node(path).object.visible = pose !== null;
      if (pose) tkamb.viewer.set_transform(tkamb.split(path), pose);
    }
    for (const tube of tkamb.views[0].tubes) {
      const line = answer.strands[tube.strand.path.split("/").pop()];
      if (!line) continue;
      tube.strand.points.set(line.points || [NaN]);
      tube.strand.colours.set(line.colours);
      tube.strand.used = line.colours.length / 3;
      tube.shown = -1;
      tube.show(0);
    }
    for (const marker of tkamb.views[0].markers) {
      marker.points.set(answer.centres[marker.path.split("/").pop()] || [NaN, NaN, NaN]);
      placeMarker(marker, 0);
    }
    tkamb.follow();
    tkamb.viewer.set_dirty();
    if (!asked.coarse && !this.reference) this.reference = answer.numbers;
    this.showNumbers();
    document.body.dataset.shown = asked.number;
  }

  drawMap(map, answer) {
    const view = tkamb.views[0], key = answer.map;
    const known = this.maps[key] = this.maps[key] || map;
    known.levels = map.levels;
    if (view.map !== known) {
      view.runMap = known;
      tkamb.showMap(view, known);
    }
    if (tkamb.data.peak_MPa !== answer.scale_MPa) {
      tkamb.data.peak_MPa = answer.scale_MPa;
      element("pressure-bar").querySelector(".ticks").replaceChildren();
      colourBar("pressure-bar", tkamb.data.pressure_scale, answer.scale_MPa, 1);
    }
    tkamb.colourMap(view, 0);
  }

  showNumbers() {
    const {numbers, request} = this.answer;
    const released = Object.entries(RELEASABLE)
      .filter(([, name]) => request.released.includes(name))
      .map(([key]) => [key, `${SLIDERS.pose.find((row) => row[0] === key)[1]}: found`, 2]);
    const single = ([name, ...rest]) => [[name], ...rest];
    this.fill("numbers", ["", "now", "± reference"], [...TOTALS, ...released].map(single));
    this.fill("condyles", ["", "medial", "± ref.", "lateral", "± ref."],
      CONDYLE.map(([name, ...rest]) => [[`medial_${name}`, `lateral_${name}`], ...rest]));
    element("patella").hidden = this.start.quadriceps_N === null;
    this.fill("patella", ["patella", "now", "± ref."], PATELLA.map(single));
    const bundles = Object.keys(numbers).filter((name) => name.endsWith("_strain_percent"))
      .map((name) => name.slice(9, -15));
    this.fill("ligaments", ["", "N", "± ref.", "strain, %", "± ref."], bundles.map((name) =>
      [[`ligament_${name}_N`, `ligament_${name}_strain_percent`], name.replaceAll("_", " "), 1]));
    element("ligament-box").hidden = !bundles.length;
  }

  // Rows of [names of numbers, words, digits]: each number, and how far it is from the reference.
  fill(id, heads, rows) {
    const table = element(id), {numbers} = this.answer, reference = this.reference || {};
    table.replaceChildren();
    const head = made("tr", "", table);
    for (const word of heads) made("th", word, head, {scope: "col"});
    for (const [names, words, digits] of rows) {
      const row = made("tr", "", table);
      made("th", words, row, {scope: "row"});
      for (const name of names) {
        const now = numbers[name], then = reference[name];
        made("td", inWords(now, digits), row, {class: "number", "data-name": name});
        made("td", inWords(now - then, digits, true), row,
          {class: "number", title: `reference: ${inWords(then, digits)}`});
      }
    }
  }

  makeReference() {
    this.reference = this.answer && this.answer.numbers;
    if (this.answer) this.showNumbers();
  }

  // What is kept is computed from rest, as a run of the saved scene computes it.
  async keep(request = structuredClone(this.state)) {
    element("saved").textContent = "saving …";
    const response = await fetch("save", {method: "POST",
      headers: {"Content-Type": "application/json"}, body: JSON.stringify(request)});
    if (response.status === 202 || !response.ok) {
      element("saved").textContent = await response.text();
      if (response.status === 202) setTimeout(() => this.keep(request), RETRY_MS);
      return;
    }
    const packed = await tkamb.unpack(new Uint8Array(await response.arrayBuffer()));
    this.show(packed, {request, coarse: false, number: ++this.count.asked});
    const {saved, numbers, label, status} = JSON.parse(packed.words);
    element("saved").textContent = `saved: ${saved}`;
    element("kept-box").hidden = false;
    const table = element("kept");
    if (!table.rows.length) {
      const head = made("tr", "", table);
      for (const word of ["", "model", ...KEPT.map((row) => row[1])]) {
        made("th", word, head, {scope: "col"});
      }
    }
    const row = made("tr", "", table, {title: status === "ok" ? saved : `${saved}: ${status}`});
    made("th", saved.split("/").slice(-2)[0].replace("kept-", "") + (status === "ok" ? "" : " ⚠"), row,
      {scope: "row"});
    made("td", label, row);
    for (const [name, , digits] of KEPT) {
      made("td", inWords({...request, ...numbers}[name], digits), row, {class: "number"});
    }
  }

  // The knee as it is seen, with the colour bar and what the state is.
  savePicture() {
    tkamb.viewer.render();
    const seen = element("pane").querySelector("canvas"), {answer} = this;
    const scale = seen.width / seen.clientWidth, sheet = document.createElement("canvas");
    const lines = this.captions(answer), foot = 20 * lines.length + 16;
    [sheet.width, sheet.height] = [seen.width, seen.height + foot * scale];
    const pen = sheet.getContext("2d");
    pen.fillStyle = "#ffffff";
    pen.fillRect(0, 0, sheet.width, sheet.height);
    pen.drawImage(seen, 0, 0);
    pen.scale(scale, scale);
    pen.fillStyle = "#1a1a1a";
    pen.font = "13px system-ui, sans-serif";
    lines.forEach((line, k) => pen.fillText(line, 14, seen.clientHeight + 20 * (k + 1)));
    const {data} = tkamb, x = seen.clientWidth - 96, height = 170;
    pen.fillText("pressure, MPa", x, 26);
    for (let k = 0; k < 256; k++) {
      pen.fillStyle = `rgb(${data.pressure_scale.slice(3 * k, 3 * k + 3).join(",")})`;
      pen.fillRect(x, 40 + height * (255 - k) / 256, 18, 1.5);
    }
    pen.fillStyle = "#1a1a1a";
    for (const share of [0, 0.5, 1]) {
      pen.fillText((share * answer.scale_MPa).toFixed(1), x + 26, 44 + height * (1 - share));
    }
    sheet.toBlob((blob) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = "knee.png";
      link.click();
      URL.revokeObjectURL(link.href);
    });
  }

  captions({request, numbers, label, status}) {
    const of = (name, digits) => inWords(numbers[name], digits);
    const condyle = (side) => `${side} ${of(`${side}_force_N`, 0)} N, peak ` +
      `${of(`${side}_peak_pressure_MPa`, 1)} MPa, ${of(`${side}_area_mm2`, 0)} mm²`;
    const patella = Object.keys(numbers).some((name) => name.startsWith("button_")) ?
      [PATELLA.map(([name, words, digits]) => `${words}: ${of(name, digits)}`).join("; ")] : [];
    return [`${element("titles").textContent}: ${inWords(request.flexion_deg, 1)}° of flexion, load ` +
      `${inWords(request.load_N, 0)} N; ${label}`, `${condyle("medial")}; ${condyle("lateral")}`,
      ...patella, ...(status === "ok" ? [] : [status])];
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
  colourBar("strain-bar", data.strain_scale, 100 * data.strain_limit, 1);
  made("div", `${tkamb.views[0].title} · ${tkamb.views[0].side} knee`, element("titles"));
  tkamb.closeness = 0.75;
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
