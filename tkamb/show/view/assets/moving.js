"use strict";
// What moves: tubes, arrows and the frame that they show.

// A tube of fixed topology along m points, whose places and colours are set for each frame. Of the
// points only the first `used` are drawn.
class Tube {
  constructor(viewer, strand) {
    const {THREE} = MeshCat, count = strand.count;
    this.strand = strand;
    this.geometry = new THREE.BufferGeometry();
    for (const name of ["position", "normal", "color"]) {
      const values = new Float32Array(3 * SIDES * count);
      this.geometry.setAttribute(name, new THREE.BufferAttribute(values, 3));
    }
    const index = [];
    for (let ring = 0; ring + 1 < count; ring++) {
      for (let side = 0; side < SIDES; side++) {
        const a = ring * SIDES + side, b = ring * SIDES + (side + 1) % SIDES;
        index.push(a, b, a + SIDES, b, b + SIDES, a + SIDES);
      }
    }
    this.geometry.setIndex(index);
    const material = new THREE.MeshLambertMaterial({
      vertexColors: true, side: THREE.DoubleSide});
    const mesh = new THREE.Mesh(this.geometry, material);
    mesh.frustumCulled = false;
    viewer.set_object(tkamb.split(strand.path), mesh);
    this.node = tkamb.node(strand.path).object;
    this.shown = -1;
  }

  show(frame) {
    const {strand} = this, k = Math.min(frame, strand.frames - 1), n = 3 * strand.count;
    const count = strand.used || strand.count;
    if (k === this.shown) return;
    this.shown = k;
    const points = strand.points.subarray(k * n, k * n + 3 * count);
    this.node.visible = points.every(Number.isFinite);
    if (!this.node.visible) return;
    const colours = strand.colours.subarray(k * n, (k + 1) * n);
    const {position, normal, color} = this.geometry.attributes;
    this.geometry.setDrawRange(0, 6 * SIDES * (count - 1));
    ringFrames(points, count, (ring, at, across, over) => {
      for (let side = 0; side < SIDES; side++) {
        const angle = 2 * Math.PI * side / SIDES, c = Math.cos(angle), s = Math.sin(angle);
        for (let axis = 0; axis < 3; axis++) {
          const to = 3 * (ring * SIDES + side) + axis, out = c * across[axis] + s * over[axis];
          normal.array[to] = out;
          position.array[to] = at[axis] + strand.radius * out;
          color.array[to] = colours[3 * ring + axis] / 255;
        }
      }
    });
    for (const attribute of [position, normal, color]) attribute.needsUpdate = true;
  }
}

// Calls back with each point and two directions across the line there, without twist.
function ringFrames(points, count, ring) {
  const {Vector3} = MeshCat.THREE;
  const at = (k) => new Vector3(points[3 * k], points[3 * k + 1], points[3 * k + 2]);
  const step = (k) => at(k + 1).sub(at(k));
  const along = [];
  for (let k = 0; k < count; k++) {
    const sum = new Vector3();
    let before = k - 1, after = k;
    while (before >= 0 && step(before).length() < 1e-9) before--;
    while (after < count - 1 && step(after).length() < 1e-9) after++;
    if (before >= 0) sum.add(step(before).normalize());
    if (after < count - 1) sum.add(step(after).normalize());
    along.push(sum.length() > 0 ? sum.normalize() : new Vector3(0, 1, 0));
  }
  let across = new Vector3(0, 0, 1);
  if (Math.abs(across.dot(along[0])) > 0.9) across = new Vector3(1, 0, 0);
  for (let k = 0; k < count; k++) {
    across = across.clone().addScaledVector(along[k], -across.dot(along[k])).normalize();
    const over = along[k].clone().cross(across);
    ring(k, at(k).toArray(), across.toArray(), over.toArray());
  }
}

// A force: shaft and head, solid where in sight and faint where something is before it.
class Pointer {
  constructor(viewer, arrow) {
    const {THREE} = MeshCat;
    this.arrow = arrow;
    const body = new THREE.Group();
    for (const faint of [true, false]) {
      const material = new THREE.MeshLambertMaterial({
        color: new THREE.Color(arrow.colour), transparent: faint,
        opacity: faint ? 0.4 : 1, depthTest: !faint, depthWrite: !faint});
      for (const [name, geometry] of [["shaft", unitShaft()], ["head", unitHead()]]) {
        const mesh = new THREE.Mesh(geometry, material);
        mesh.name = faint ? `${name} behind` : name;
        mesh.renderOrder = faint ? 4 : 1;
        body.add(mesh);
      }
    }
    viewer.set_object(tkamb.split(arrow.path), body);
    this.body = body;
    this.node = tkamb.node(arrow.path).object;
  }

  show(frame, bodyWeight) {
    const {Vector3} = MeshCat.THREE, {arrow, node} = this;
    const force = new Vector3().fromArray(arrow.forces, 3 * frame);
    const point = new Vector3().fromArray(arrow.points, 3 * frame);
    const length = force.length() / bodyWeight * tkamb.arrowLength;
    node.visible = Number.isFinite(length + point.length()) && length > 1e-5;
    if (!node.visible) return;
    const way = force.clone().normalize();
    node.quaternion.setFromUnitVectors(new Vector3(0, 1, 0), way);
    node.position.copy(point);
    if (arrow.ends_there) node.position.addScaledVector(way, -length);
    const size = tkamb.arrowLength / tkamb.data.metres_per_body_weight;
    const head = Math.min(0.011 * size, 0.6 * length), width = Math.min(0.0021 * size, 0.1 * length);
    for (const mesh of this.body.children) {
      if (mesh.name.startsWith("head")) {
        mesh.scale.set(2.6 * width, head, 2.6 * width);
        mesh.position.set(0, length - head, 0);
      } else {
        mesh.scale.set(width, length - head, width);
      }
    }
  }
}

function unitShaft() {
  return new MeshCat.THREE.CylinderGeometry(1, 1, 1, 18).translate(0, 0.5, 0);
}

function unitHead() {
  return new MeshCat.THREE.ConeGeometry(1, 1, 24).translate(0, 0.5, 0);
}

tkamb.frameCount = () => Math.max(...tkamb.views.map((view) => view.labels.length));

// The frame of a view at the page's frame: the nearest to the same share of the motion's time.
tkamb.frameOf = function (view) {
  const longest = tkamb.views.find((one) => one.labels.length === tkamb.frameCount());
  if (view.labels.length === longest.labels.length) return tkamb.frame;
  const share = (times, k) => (times[k] - times[0]) / (times[times.length - 1] - times[0] || 1);
  const wanted = share(longest.times, tkamb.frame);
  let nearest = 0;
  view.times.forEach((_, k) => {
    const nearer = Math.abs(share(view.times, k) - wanted);
    if (nearer < Math.abs(share(view.times, nearest) - wanted)) nearest = k;
  });
  return nearest;
};

tkamb.showFrame = function (frame) {
  tkamb.frame = Math.max(0, Math.min(tkamb.frameCount() - 1, frame));
  for (const view of tkamb.views) {
    const k = tkamb.frameOf(view);
    for (const moving of view.moving) {
      const pose = moving.poses.subarray(16 * k, 16 * k + 16), path = tkamb.split(moving.path);
      const found = pose.every(Number.isFinite);
      tkamb.node(moving.path).object.visible = found;
      if (found) tkamb.viewer.set_transform(path, pose);
    }
    for (const tube of view.tubes) tube.show(k);
    for (const pointer of view.pointers) pointer.show(k, view.body_weight);
    for (const marker of view.markers) placeMarker(marker, k);
    tkamb.colourMap(view, k);
  }
  tkamb.viewer.set_dirty();
};

function placeMarker(marker, k) {
  const point = marker.points.subarray(3 * k, 3 * k + 3), node = tkamb.node(marker.path).object;
  node.visible = point.every(Number.isFinite);
  if (node.visible) node.position.set(...point);
}

// A point's level is its share of the largest pressure, negative where nothing presses.
tkamb.colourMap = function (view, k) {
  for (const map of [view.map, view.button_map]) {
    if (!map) continue;
    const {level} = map.geometry.attributes, ofRun = map === view.runMap || map === view.button_map;
    const start = ofRun ? k * map.count : 0;
    for (let i = 0; i < map.count; i++) level.array[i] = map.levels[start + i] / 32767;
    level.needsUpdate = true;
  }
};
