"use strict";
// What stands in the scene: unpacks the drawings and hangs their parts into meshcat's scene tree.

const tkamb = {views: [], frame: 0};

const TYPES = {float32: Float32Array, uint8: Uint8Array, int16: Int16Array, uint32: Uint32Array};
const SIDES = 10;

tkamb.unpack = async function (bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const buffer = await new Response(stream).arrayBuffer();
  const size = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  return withArrays(header, buffer, 4 + size);
};

function withArrays(value, buffer, start) {
  if (value === null || typeof value !== "object") return value;
  if (typeof value.at === "number" && value.of in TYPES) {
    return new TYPES[value.of](buffer, start + value.at, value.n);
  }
  for (const key of Object.keys(value)) value[key] = withArrays(value[key], buffer, start);
  return value;
}

tkamb.split = (path) => path.split("/").filter((part) => part.length > 0);
tkamb.node = (path) => tkamb.viewer.scene_tree.find(tkamb.split(path));

tkamb.build = function (data) {
  const viewer = tkamb.viewer;
  tkamb.data = data;
  tkamb.arrowLength = data.metres_per_body_weight;
  dressScene(viewer);
  tkamb.scale = scaleTexture(data.pressure_scale);
  tkamb.views = data.views.map((view, number) => buildView(viewer, view, number));
  for (const layer of data.hidden) tkamb.showLayer(layer, false);
  renderSideBySide(viewer);
};

tkamb.showLayer = function (layer, shown) {
  tkamb.views.forEach((view, number) => {
    tkamb.node(`/tkamb/${number}/${layer}`).object.visible = shown;
  });
  document.body.classList.toggle(`without-${layer.replaceAll(" ", "-")}`, !shown);
  tkamb.viewer.set_dirty();
};

tkamb.layerShown = (layer) => tkamb.node(`/tkamb/0/${layer}`).object.visible;

function dressScene(viewer) {
  const {THREE} = MeshCat;
  viewer.hide_background();
  for (const name of ["Grid", "Axes"]) viewer.set_property([name], "visible", false);
  viewer.delete_path(["Lights"]);
  viewer.set_object(["Lights", "around"], new THREE.HemisphereLight(0xffffff, 0xb0b0b0, 0.58));
  const lamp = new THREE.DirectionalLight(0xffffff, 0.42);
  lamp.position.set(0.4, 0.8, 0.6);
  viewer.camera.add(lamp);
  viewer.camera.add(lamp.target);
  lamp.target.position.set(0, 0, -1);
  viewer.camera.fov = 30;
  viewer.camera.near = 0.005;
  viewer.gui.domElement.style.display = "none";
}

function buildView(viewer, view, number) {
  view.root = `/tkamb/${number}`;
  for (const layer of tkamb.data.layers) tkamb.node(`${view.root}/${layer}`);
  for (const command of view.commands) viewer.handle_command_bytearray(command);
  seeThrough(view);
  view.tubes = view.strands.map((strand) => new Tube(viewer, strand));
  view.pointers = view.arrows.map((arrow) => new Pointer(viewer, arrow));
  for (const marker of view.markers) addMarker(viewer, marker);
  view.runMap = view.map;
  tkamb.showMap(view, view.map);
  if (view.button_map) {
    const path = `${view.root}/pressure map/button`;
    tkamb.viewer.set_object(tkamb.split(path), mapMesh(mapGeometry(view.button_map)));
  }
  if (view.lattice) tkamb.addLattice(view);
  if (view.map) addSideNames(viewer, view);
  return view;
}

// Names beside the insert which side is which, whatever the camera: x is anterior, z lateral.
function addSideNames(viewer, view) {
  const low = [Infinity, Infinity, Infinity], high = low.map((x) => -x), {points} = view.map;
  for (let k = 0; k < points.length; k++) {
    low[k % 3] = Math.min(low[k % 3], points[k]);
    high[k % 3] = Math.max(high[k % 3], points[k]);
  }
  const middle = low.map((x, k) => (x + high[k]) / 2);
  const places = {medial: [middle[0], low[1], low[2]], lateral: [middle[0], low[1], high[2]],
    anterior: [high[0], low[1], middle[2]]};
  const outwards = {medial: [0, -0.5, -1], lateral: [0, -0.5, 1], anterior: [1, -0.4, 0]};
  view.names = Object.entries(places).map(([word, place]) => {
    const sprite = wordSprite(word);
    Object.assign(sprite.userData, {place, outwards: outwards[word]});
    viewer.set_object(tkamb.split(`${view.root}/insert/name ${word}`), sprite);
    return sprite;
  });
}

// They stay legible from afar, where the whole leg is in sight.
const NAME = {away: 0.015, width: 0.024, height: 0.006, near: 0.6};

function sizeSideNames(viewer) {
  const distance = viewer.camera.position.distanceTo(viewer.controls.target);
  const factor = Math.max(1, distance / NAME.near);
  for (const sprite of tkamb.views.flatMap((view) => view.names || [])) {
    const {place, outwards} = sprite.userData;
    sprite.scale.set(factor * NAME.width, factor * NAME.height, 1);
    sprite.position.set(...place.map((x, k) => x + factor * NAME.away * outwards[k]));
  }
}

function wordSprite(word) {
  const {THREE} = MeshCat, canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [256, 64];
  const pen = canvas.getContext("2d");
  pen.font = "600 40px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.lineWidth = 8;
  pen.strokeStyle = "rgba(255, 255, 255, 0.9)";
  pen.strokeText(word, 128, 32);
  pen.fillStyle = "#333333";
  pen.fillText(word, 128, 32);
  const material = new THREE.SpriteMaterial({map: new THREE.CanvasTexture(canvas),
    transparent: true, depthTest: false});
  const sprite = new THREE.Sprite(material);
  sprite.renderOrder = 6;
  return sprite;
}

// A surface that lets see through first writes its depth, then its colour: its own far side stays
// hidden whatever the order of its triangles. The patella comes before the metal behind it.
const SEEN_THROUGH = ["patella", "femoral component", "recorded pose"];

function seeThrough(view) {
  const {THREE} = MeshCat;
  SEEN_THROUGH.forEach((layer, order) => {
    const found = [];
    tkamb.node(`${view.root}/${layer}`).object.traverse((object) => {
      if (object.material && object.material.transparent) found.push(object);
    });
    for (const object of found) {
      // The recorded pose lies a little behind: where both are one, the component is seen.
      const behind = layer === "recorded pose";
      const depth = new THREE.MeshBasicMaterial({colorWrite: false, transparent: true,
        polygonOffset: behind, polygonOffsetFactor: 1, polygonOffsetUnits: 40});
      Object.assign(object.material, {
        polygonOffset: behind, polygonOffsetFactor: 1, polygonOffsetUnits: 40});
      const before = new THREE.Mesh(object.geometry, depth);
      before.renderOrder = 2 + 0.1 * order;
      object.renderOrder = before.renderOrder + 0.05;
      object.material.side = THREE.FrontSide;
      object.add(before);
    }
  });
}

function scaleTexture(colours) {
  const {THREE} = MeshCat, rgba = new Uint8Array(4 * 256);
  for (let k = 0; k < 256; k++) rgba.set([...colours.slice(3 * k, 3 * k + 3), 255], 4 * k);
  const texture = new THREE.DataTexture(rgba, 256, 1, THREE.RGBAFormat);
  texture.magFilter = texture.minFilter = THREE.LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

// The map: a level per point (0 to 1), coloured in the fragment as the colour bar says. Where
// nothing presses the level is negative, and the fragment is cut off. It is drawn 0.1 mm above the
// insert or the button, whose drawn surface is that close to the true one.
tkamb.showMap = function (view, map) {
  view.map = map;
  if (!map) return;
  mapGeometry(map);
  if (view.mapMesh) {  // a new material would be compiled again
    view.mapMesh.geometry.dispose();
    view.mapMesh.geometry = map.geometry;
    return;
  }
  view.mapMesh = mapMesh(map.geometry);
  tkamb.viewer.set_object(tkamb.split(`${view.root}/pressure map/map`), view.mapMesh);
};

function mapGeometry(map) {
  const {THREE} = MeshCat;
  if (!map.geometry) {
    map.geometry = new THREE.BufferGeometry();
    map.geometry.setAttribute("position", new THREE.BufferAttribute(map.points, 3));
    map.geometry.setAttribute("level", new THREE.BufferAttribute(new Float32Array(map.count), 1));
    map.geometry.setIndex(new THREE.BufferAttribute(map.triangles, 1));
  }
  return map.geometry;
}

function mapMesh(geometry) {
  const {THREE} = MeshCat;
  const material = new THREE.ShaderMaterial({
    uniforms: {scale: {value: tkamb.scale}},
    vertexShader: `attribute float level; varying float shade;
      void main() { shade = level;
        vec3 lifted = position + vec3(0.0, 1e-4, 0.0);
        gl_Position = projectionMatrix * modelViewMatrix * vec4(lifted, 1.0); }`,
    fragmentShader: `uniform sampler2D scale; varying float shade;
      void main() { if (shade < 0.0) discard;
        gl_FragColor = texture2D(scale, vec2(shade * 255.0 / 256.0 + 0.5 / 256.0, 0.5)); }`,
    side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: -2, polygonOffsetUnits: -8,
  });
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  return mesh;
}

function addMarker(viewer, marker) {
  const {THREE} = MeshCat, colour = new THREE.Color(marker.colour);
  const ball = new THREE.Mesh(
    new THREE.SphereGeometry(marker.radius, 14, 8), new THREE.MeshLambertMaterial({color: colour}));
  ball.renderOrder = 3;
  ball.material.depthTest = false;
  ball.material.transparent = true;
  viewer.set_object(tkamb.split(marker.path), ball);
}

tkamb.addLattice = function (view) {
  const {THREE} = MeshCat, geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(view.lattice, 3));
  const material = new THREE.LineBasicMaterial({color: 0x33506b, transparent: true, opacity: 0.7});
  const lines = new THREE.LineSegments(geometry, material);
  tkamb.viewer.set_object(tkamb.split(`${view.root}/lattice/lines`), lines);
};

// Names at the edges of the picture what lies there, where the camera looks along an axis.
function nameDirections(camera) {
  const {Vector3} = MeshCat.THREE, turn = camera.matrixWorld.elements;
  const lateral = tkamb.views[0].side === "left" ? -1 : 1;
  const names = [["posterior", "anterior"], ["", ""], ["medial", "lateral"]];
  const at = (x, y, z) => {
    const parts = [x, y, lateral * z].map((part) => (Math.abs(part) > 0.85 ? part : 0));
    const axis = parts.findIndex((part) => part !== 0);
    return axis < 0 ? "" : names[axis][parts[axis] > 0 ? 1 : 0];
  };
  const right = new Vector3(...turn.slice(0, 3)), up = new Vector3(...turn.slice(4, 7));
  const words = {
    right: at(...right.toArray()), left: at(...right.negate().toArray()),
    top: at(...up.toArray()), bottom: at(...up.negate().toArray())};
  for (const [edge, word] of Object.entries(words)) {
    document.getElementById(`to-${edge}`).textContent = word;
  }
}

// One knee beside the other, seen by the same camera.
function renderSideBySide(viewer) {
  const roots = tkamb.views.map((view) => tkamb.node(view.root).object);
  const shown = new MeshCat.THREE.Vector2();
  viewer.render = function () {
    this.controls.update();
    const {x: width, y: height} = this.renderer.getSize(shown), part = width / roots.length;
    this.camera.aspect = part / height;
    this.camera.updateProjectionMatrix();
    this.renderer.setScissorTest(true);
    sizeSideNames(this);
    roots.forEach((root, number) => {
      roots.forEach((other) => { other.visible = other === root; });
      this.renderer.setViewport(number * part, 0, part, height);
      this.renderer.setScissor(number * part, 0, part, height);
      this.renderer.render(this.scene, this.camera);
    });
    roots.forEach((root) => { root.visible = true; });
    this.animator.after_render();
    this.needs_render = false;
    nameDirections(this.camera);
  };
}

// Without a graphics card smooth edges take a third of a frame's time: then only pictures have them.
function newViewer(pane, smooth) {
  const {prototype} = HTMLCanvasElement, usual = prototype.getContext;
  if (!smooth) {
    prototype.getContext = function (kind, wishes) {
      return usual.call(this, kind, {...wishes, antialias: false});
    };
  }
  try {
    const viewer = new MeshCat.Viewer(pane), sized = viewer.set_3d_pane_size;
    // MeshCat takes the height of the window, but on a narrow screen the panel is below the pane.
    viewer.set_3d_pane_size = () => sized.call(viewer, pane.offsetWidth, pane.offsetHeight);
    return viewer;
  } finally {
    prototype.getContext = usual;
  }
}

function softwareGraphics() {
  const context = document.createElement("canvas").getContext("webgl");
  const told = context && context.getExtension("WEBGL_debug_renderer_info");
  const name = told ? context.getParameter(told.UNMASKED_RENDERER_WEBGL) : "";
  const release = context && context.getExtension("WEBGL_lose_context");
  if (release) release.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
