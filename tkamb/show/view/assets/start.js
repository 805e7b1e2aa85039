"use strict";
// Loads the drawings, from the page itself or from its server, and starts.

tkamb.start = async function () {
  const request = JSON.parse(document.getElementById("request").textContent);
  for (const [key, value] of new URLSearchParams(location.hash.slice(1))) request[key] = value;
  const bytes = request.live
    ? new Uint8Array(await (await fetch("scene.bin")).arrayBuffer())
    : Uint8Array.from(atob(document.getElementById("data").textContent), (c) => c.charCodeAt(0));
  const data = await tkamb.unpack(bytes);
  tkamb.viewer = newViewer(document.getElementById("pane"), request.figure || !softwareGraphics());
  tkamb.build(data);
  addCameras();
  addLayers(request.live && request.live.length > 0);
  addLegends();
  addNumbers();
  addPlayer();
  addKeys();
  if (request.live) tkamb.live = new Live(request.live);
  if (request.figure) {
    document.body.classList.add("figure");
    document.getElementById("stage").append(document.getElementById("force-box"));
  }
  tkamb.look(request.view || "oblique");
  tkamb.viewer.set_3d_pane_size();
  tkamb.go(Number(request.frame || 0));
  tkamb.viewer.render();
  document.body.dataset.ready = "yes";
};

// Another contact model on the frame that is shown, computed by the server.
class Live {
  constructor(models) {
    this.choice = document.getElementById("contact");
    for (const name of models) {
      const option = made("option", name, this.choice, {value: name});
      option.selected = name === tkamb.views[0].contact;
    }
    document.getElementById("contact-choice").hidden = models.length === 0;
    this.choice.addEventListener("change", () => this.frameChanged());
    this.button = document.getElementById("cancel");
    this.button.addEventListener("click", () => this.cancel());
    this.latest = 0;
  }

  frameChanged() {
    const view = tkamb.views[0], number = ++this.latest;
    this.rest();
    if (view.map !== view.runMap) {
      tkamb.showMap(view, view.runMap);
      tkamb.colourMap(view, tkamb.frameOf(view));
      tkamb.viewer.set_dirty();
    }
    document.getElementById("answer").textContent = "";
    if (!this.choice.value || this.choice.value === view.contact) return;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.compute(view, number, this.choice.value), 200);
  }

  async fetchLattice() {
    const view = tkamb.views[0], answer = document.getElementById("answer");
    if (view.lattice) return;
    answer.textContent = "building the lattice …";
    const response = await this.ask("lattice", {});
    if (response.ok) {
      view.lattice = (await tkamb.unpack(new Uint8Array(await response.arrayBuffer()))).lattice;
      tkamb.addLattice(view);
      tkamb.viewer.set_dirty();
    }
    answer.textContent = response.ok ? "" : await response.text();
  }

  ask(what, question) {
    return fetch(what, {
      method: "POST",
      headers: {"Content-Type": "application/json"},
      body: JSON.stringify(question),
    });
  }

  // Says what the server is at, and since when, until `rest`.
  watch(number, words) {
    const answer = document.getElementById("answer"), began = performance.now();
    this.rest();
    this.button.hidden = false;
    const tell = () => {
      const seconds = Math.floor((performance.now() - began) / 1000);
      answer.textContent = `${words} … ${seconds} s`;
    };
    tell();
    this.clock = setInterval(async () => {
      tell();
      const response = await this.ask("stage", {});
      const stage = response.ok ? await response.text() : "";
      if (stage && number === this.latest) words = stage;
    }, 500);
  }

  rest() {
    clearInterval(this.clock);
    this.button.hidden = true;
  }

  // The server ends the step that it is at and goes no further.
  async cancel() {
    clearTimeout(this.timer);
    this.choice.value = tkamb.views[0].contact;
    this.frameChanged();
    await (await this.ask("cancel", {})).text();  // unread, the browser calls it aborted
    document.getElementById("answer").textContent = "cancelled";
  }

  async compute(view, number, model) {
    const answer = document.getElementById("answer"), frame = tkamb.frameOf(view);
    this.watch(number, `asking ${model}`);
    const response = await this.ask("contact", {frame, model});
    const packed = response.ok && new Uint8Array(await response.arrayBuffer());
    const refusal = packed ? "" : await response.text();
    if (number !== this.latest) return;
    this.rest();
    if (!packed) {
      answer.textContent = refusal;
      return;
    }
    const found = await tkamb.unpack(packed);
    tkamb.showMap(view, found.map);
    tkamb.colourMap(view, 0);
    tkamb.viewer.set_dirty();
    answer.textContent = found.words;
  }
}

tkamb.start().catch((error) => {
  document.getElementById("status").hidden = false;
  document.getElementById("status").textContent = `The scene cannot be shown: ${error.message}`;
  console.error(error);
});
