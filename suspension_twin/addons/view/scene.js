// SPDX-License-Identifier: Apache-2.0
// The twin in 3D: its road, its body at the simulated pose, and its wheels at their travel. Plain WebGL 2.

const VERTEX = `#version 300 es
uniform mat4 view; uniform mat4 model; uniform float shade;
in vec3 place; in vec3 normal; out vec3 n; out vec3 world;
void main() {
  vec4 w = model * vec4(place, 1.0);
  world = w.xyz; n = mat3(model) * normal; gl_Position = view * w;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform vec4 colour; uniform vec3 eye; uniform float grid; uniform vec3 sky; uniform float fog;
in vec3 n; in vec3 world; out vec4 result;
void main() {
  vec3 m = normalize(n);
  float light = 0.55 + 0.35 * max(dot(m, normalize(vec3(-0.4, 0.5, 0.8))), 0.0) + 0.10 * max(dot(m, normalize(eye - world)), 0.0);
  vec3 c = colour.rgb * light;
  if (grid > 0.0) {
    vec2 line = abs(fract(world.xy - 0.5) - 0.5) / max(fwidth(world.xy), 1e-4);
    float strength = (1.0 - min(min(line.x, line.y), 1.0)) * 0.22 * clamp(1.0 - length(eye - world) / 30.0, 0.0, 1.0);
    c = mix(c, vec3(0.0), strength);
  }
  c = mix(c, sky, clamp((length(eye - world) - fog) / fog, 0.0, 1.0));
  result = vec4(c, colour.a);
}`;
const SIDE = 4, NODES = 41, REACH = 16, MOST_TILES = 160;

const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
const sub = (a, b) => a.map((v, i) => v - b[i]);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const l = Math.hypot(...a) || 1; return a.map((v) => v / l); };

// 4 by 4 matrices, column after column
function times(a, b) {
  const o = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
    let s = 0;
    for (let k = 0; k < 4; k++) s += a[k * 4 + r] * b[c * 4 + k];
    o[c * 4 + r] = s;
  }
  return o;
}
function perspective(angle, aspect, near, far) {
  const f = 1 / Math.tan(angle / 2), d = near - far;
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / d, -1, 0, 0, (2 * far * near) / d, 0]);
}
function lookAt(eye, at) {
  const z = unit(sub(eye, at)), x = unit(cross([0, 0, 1], z)), y = cross(z, x), dot = (a) => -(a[0] * eye[0] + a[1] * eye[1] + a[2] * eye[2]);
  return new Float32Array([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, dot(x), dot(y), dot(z), 1]);
}
function placed([x, y, z], [qx, qy, qz, qw]) {
  return new Float32Array([
    1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qz * qw), 2 * (qx * qz - qy * qw), 0,
    2 * (qx * qy - qz * qw), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz + qx * qw), 0,
    2 * (qx * qz + qy * qw), 2 * (qy * qz - qx * qw), 1 - 2 * (qx * qx + qy * qy), 0, x, y, z, 1]);
}
const shifted = (x, y, z) => placed([x, y, z], [0, 0, 0, 1]);
const turnedY = (a) => placed([0, 0, 0], [0, Math.sin(a / 2), 0, Math.cos(a / 2)]);

// Triangles with flat normals from polygons; each a list of points, counter-clockwise from outside.
function faces(polygons) {
  const out = [];
  for (const p of polygons) {
    const n = unit(cross(sub(p[1], p[0]), sub(p[2], p[0])));
    for (let i = 2; i < p.length; i++) for (const v of [p[0], p[i - 1], p[i]]) out.push(...v, ...n);
  }
  return new Float32Array(out);
}
function extruded(profile, half) { // profile: [x, z, share of the half width], clockwise seen from the left
  const left = profile.map(([x, z, k]) => [x, k * half, z]), right = profile.map(([x, z, k]) => [x, -k * half, z]), out = [];
  for (let i = 0; i < profile.length; i++) {
    const j = (i + 1) % profile.length;
    out.push([left[i], left[j], right[j], right[i]]);
  }
  const middle = [profile.reduce((s, p) => s + p[0], 0) / profile.length, 0, 0.7];
  for (let i = 0; i < profile.length; i++) {
    const j = (i + 1) % profile.length;
    out.push([left[j], left[i], [middle[0], half, middle[2]]], [right[i], right[j], [middle[0], -half, middle[2]]]);
  }
  return faces(out);
}
function edges(profile, half) { // the same outline as lines
  const out = [], at = ([x, z, k], side) => [x, side * k * half, z];
  for (let i = 0; i < profile.length; i++) {
    const a = profile[i], b = profile[(i + 1) % profile.length];
    for (const side of [1, -1]) out.push(...at(a, side), 0, 0, 1, ...at(b, side), 0, 0, 1);
    out.push(...at(a, 1), 0, 0, 1, ...at(a, -1), 0, 0, 1);
  }
  return new Float32Array(out);
}
function wheelMesh(radius, width) {
  const n = 28, out = [], rim = radius * 0.62, at = (r, i, y) => [r * Math.cos((2 * Math.PI * i) / n), y, r * Math.sin((2 * Math.PI * i) / n)];
  for (let i = 0; i < n; i++) {
    out.push([at(radius, i, width / 2), at(radius, i + 1, width / 2), at(radius, i + 1, -width / 2), at(radius, i, -width / 2)]);
    for (const y of [width / 2, -width / 2]) {
      const ring = [at(radius, i, y), at(rim, i, y), at(rim, i + 1, y), at(radius, i + 1, y)];
      out.push(y > 0 ? ring : ring.reverse());
    }
  }
  return faces(out);
}
function rimMesh(radius, width) {
  const n = 5, out = [], rim = radius * 0.62;
  for (const y of [width * 0.42, -width * 0.42]) for (let i = 0; i < n; i++) {
    const a = (2 * Math.PI * i) / n, w = 0.32, p = [[0, y, 0], [rim * Math.cos(a - w), y, rim * Math.sin(a - w)], [rim * Math.cos(a + w), y, rim * Math.sin(a + w)]];
    out.push(y > 0 ? [p[0], p[2], p[1]] : p);
  }
  return faces(out);
}
const boxMesh = () => {
  const c = (x, y, z) => [x - 0.5, y - 0.5, z - 0.5];
  return faces([
    [c(0, 0, 1), c(1, 0, 1), c(1, 1, 1), c(0, 1, 1)], [c(0, 0, 0), c(0, 1, 0), c(1, 1, 0), c(1, 0, 0)],
    [c(0, 0, 0), c(1, 0, 0), c(1, 0, 1), c(0, 0, 1)], [c(0, 1, 0), c(0, 1, 1), c(1, 1, 1), c(1, 1, 0)],
    [c(1, 0, 0), c(1, 1, 0), c(1, 1, 1), c(1, 0, 1)], [c(0, 0, 0), c(0, 0, 1), c(0, 1, 1), c(0, 1, 0)]]);
};
// Silhouettes in base_link: of a car from its wheelbase and wheel radius, of a tracked vehicle from its wheels.
function bodyProfile(wheels) {
  const xs = wheels.map((w) => w.origin[0] + w.wheel[0]), front = Math.max(...xs), rear = Math.min(...xs), L = front - rear, r = wheels[0].radius;
  if (wheels[0].kind === "revolute")
    return [[rear - 0.7, 2.2 * r, 1], [rear - 0.9, 3.6 * r, 1], [rear + 0.1 * L, 3.9 * r, 0.9], [rear + 0.35 * L, 5.4 * r, 0.55],
      [rear + 0.65 * L, 5.4 * r, 0.55], [rear + 0.75 * L, 3.9 * r, 0.9], [front + 1.1, 3.4 * r, 1], [front + 0.7, 1.7 * r, 1]];
  return [[rear - 0.75, 0.32, 0.94], [rear - 0.88, 0.6, 0.98], [rear - 0.82, 0.98, 0.95], [rear - 0.55, 1.4, 0.74], [rear + 0.12 * L, 1.47, 0.74],
    [rear + 0.48 * L, 1.45, 0.74], [rear + 0.74 * L, 1.0, 0.93], [front + 0.55, 0.86, 0.92], [front + 0.8, 0.62, 0.92], [front + 0.78, 0.3, 0.9]];
}

export class Scene {
  constructor(canvas, colours) {
    this.canvas = canvas;
    const gl = (this.gl = canvas.getContext("webgl2", { antialias: true }));
    if (!gl) throw new Error("no WebGL 2");
    const program = (this.program = gl.createProgram());
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "place");
    gl.bindAttribLocation(program, 1, "normal");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.at = (name) => gl.getUniformLocation(program, name);
    this.places = Object.fromEntries(["view", "model", "colour", "eye", "grid", "sky", "fog"].map((n) => [n, this.at(n)]));
    this.tiles = new Map();
    this.box = this.mesh(boxMesh());
    this.turn = 0.62; this.tilt = 0.24; this.far = 7.5;
    this.colours = colours;
    this.spin = 0;
    this.drag();
  }

  mesh(data, index) {
    const gl = this.gl, array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 24, 0);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 3, gl.FLOAT, false, 24, 12);
    const made = { array, buffer, count: data.length / 6, indices: null };
    if (index) {
      made.indices = gl.createBuffer();
      made.count = index.length;
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made.indices);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, index, gl.STATIC_DRAW);
    }
    gl.bindVertexArray(null);
    return made;
  }

  load(scene) {
    this.scene = scene;
    const wheels = scene.wheels || [];
    if (!wheels.length) return;
    const half = Math.max(...wheels.map((w) => Math.abs(w.origin[1]))) + 0.08;
    this.body = this.mesh(extruded(bodyProfile(wheels), half));
    this.outline = this.mesh(edges(bodyProfile(wheels), half));
    this.tyre = this.mesh(wheelMesh(wheels[0].radius, wheels[0].width));
    this.rim = this.mesh(rimMesh(wheels[0].radius, wheels[0].width));
    const xs = wheels.map((w) => w.origin[0] + w.wheel[0]);
    this.centre = (Math.max(...xs) + Math.min(...xs)) / 2;
    this.size = Math.max(Math.max(...xs) - Math.min(...xs), 2);
    this.clearRoad();
  }

  clearRoad() {
    for (const tile of this.tiles.values()) this.forget(tile);
    this.tiles.clear();
  }

  forget(tile) {
    if (!tile.mesh) return;
    this.gl.deleteBuffer(tile.mesh.buffer);
    this.gl.deleteBuffer(tile.mesh.indices);
    this.gl.deleteVertexArray(tile.mesh.array);
  }

  drag() {
    const c = this.canvas, held = new Map();
    let apart = 0;
    c.addEventListener("pointerdown", (e) => { held.set(e.pointerId, e); c.setPointerCapture(e.pointerId); apart = 0; });
    for (const name of ["pointerup", "pointercancel"]) c.addEventListener(name, (e) => { held.delete(e.pointerId); apart = 0; });
    c.addEventListener("pointermove", (e) => {
      const before = held.get(e.pointerId);
      if (!before) return;
      held.set(e.pointerId, e);
      if (held.size === 1) {
        this.turn -= (e.clientX - before.clientX) * 0.008;
        this.tilt = Math.min(Math.max(this.tilt + (e.clientY - before.clientY) * 0.006, 0.03), 1.5);
      } else {
        const [a, b] = [...held.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (apart) this.zoom(apart / now);
        apart = now;
      }
    });
    c.addEventListener("wheel", (e) => { e.preventDefault(); this.zoom(Math.exp(e.deltaY * 0.001)); }, { passive: false });
  }
  zoom(by) { this.far = Math.min(Math.max(this.far * by, 2.5), 60); }

  // Tiles of the road around a place, the nearest first, two requests at a time.
  async fetchRoad(x, y) {
    if (this.fetching) return;
    const wanted = [], n = Math.ceil(REACH / SIDE), i0 = Math.floor(x / SIDE), j0 = Math.floor(y / SIDE);
    for (let i = i0 - n; i <= i0 + n; i++) for (let j = j0 - n; j <= j0 + n; j++) {
      const d = Math.hypot((i + 0.5) * SIDE - x, (j + 0.5) * SIDE - y);
      if (d < REACH && !this.tiles.has(`${i}/${j}`)) wanted.push([d, i, j]);
    }
    if (!wanted.length) return;
    wanted.sort((a, b) => a[0] - b[0]);
    this.fetching = true;
    try {
      await Promise.all(wanted.slice(0, 4).map(async ([, i, j]) => {
        const answer = await fetch(`road/${i}/${j}`);
        if (!answer.ok) throw new Error("no road");
        this.addTile(i, j, new Float32Array(await answer.arrayBuffer()));
      }));
    } catch { await new Promise((go) => setTimeout(go, 1000)); }
    this.fetching = false;
  }

  addTile(i, j, z) {
    const data = new Float32Array(NODES * NODES * 6), index = [], step = SIDE / (NODES - 1), at = (a, b) => z[b * NODES + a];
    const near = (v, other) => (Number.isNaN(v) ? other : v);
    for (let b = 0; b < NODES; b++) for (let a = 0; a < NODES; a++) {
      const k = b * NODES + a, here = at(a, b);
      const [l, r] = [Math.max(a - 1, 0), Math.min(a + 1, NODES - 1)], [d, u] = [Math.max(b - 1, 0), Math.min(b + 1, NODES - 1)];
      // slopes are shaded four times steeper than they are: a bump of five centimetres is to be seen
      const n = unit([-4 * (near(at(r, b), here) - near(at(l, b), here)) / ((r - l) * step), -4 * (near(at(a, u), here) - near(at(a, d), here)) / ((u - d) * step), 1]);
      data.set([i * SIDE + a * step, j * SIDE + b * step, near(here, 0), ...n], 6 * k);
      if (a && b) {
        const quad = [k - NODES - 1, k - NODES, k, k - 1];
        if (!quad.some((q) => Number.isNaN(z[q]))) index.push(quad[0], quad[1], quad[2], quad[0], quad[2], quad[3]);
      }
    }
    this.tiles.set(`${i}/${j}`, { mesh: index.length ? this.mesh(data, new Uint16Array(index)) : null });
    while (this.tiles.size > MOST_TILES) {
      const [name, tile] = this.tiles.entries().next().value;
      this.forget(tile);
      this.tiles.delete(name);
    }
  }

  paint(mesh, model, colour, alpha = 1, grid = 0, kind = this.gl.TRIANGLES) {
    const gl = this.gl, p = this.places;
    gl.uniformMatrix4fv(p.model, false, model);
    gl.uniform4f(p.colour, ...colour, alpha);
    gl.uniform1f(p.grid, grid);
    gl.bindVertexArray(mesh.array);
    if (mesh.indices) gl.drawElements(kind, mesh.count, gl.UNSIGNED_SHORT, 0);
    else gl.drawArrays(kind, 0, mesh.count);
  }

  // pose: {p, q, yaw}; joints: positions; moved: m driven since the last picture.
  draw(pose, joints, moved) {
    const gl = this.gl, canvas = this.canvas, scale = Math.min(window.devicePixelRatio || 1, 1.5);
    const w = Math.round(canvas.clientWidth * scale), h = Math.round(canvas.clientHeight * scale);
    if (w < 10 || h < 10) return;
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    const sky = rgb(this.colours.sky);
    gl.viewport(0, 0, w, h);
    gl.clearColor(...sky, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!pose || !this.body) return;
    this.fetchRoad(pose.p[0], pose.p[1]);
    const c = Math.cos(pose.yaw), s = Math.sin(pose.yaw), middle = [pose.p[0] + c * this.centre, pose.p[1] + s * this.centre];
    // the camera does not follow the body's bounce, which is what is to be seen
    this.ground = this.ground === undefined || Math.abs(this.ground - pose.p[2]) > 1 ? pose.p[2] : this.ground + (pose.p[2] - this.ground) * 0.02;
    this.yaw = this.yaw === undefined ? pose.yaw : this.yaw + Math.atan2(Math.sin(pose.yaw - this.yaw), Math.cos(pose.yaw - this.yaw)) * 0.12;
    const far = this.far * Math.max(this.size / 2.85, 1) * Math.max(1, 0.95 / (w / h)), a = this.yaw + Math.PI + this.turn, k = Math.cos(this.tilt);
    const at = [middle[0], middle[1], this.ground + 0.55], eye = [at[0] + far * k * Math.cos(a), at[1] + far * k * Math.sin(a), at[2] + far * Math.sin(this.tilt)];
    const p = this.places;
    gl.uniformMatrix4fv(p.view, false, times(perspective(0.75, w / h, 0.2, 200), lookAt(eye, at)));
    gl.uniform3f(p.eye, ...eye);
    gl.uniform3f(p.sky, ...sky);
    gl.uniform1f(p.fog, Math.max(REACH * 0.75, 0.9 * far + REACH * 0.3));
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.disable(gl.CULL_FACE);
    gl.depthMask(true);
    const still = shifted(0, 0, 0), road = rgb(this.colours.road);
    for (const tile of this.tiles.values()) if (tile.mesh) this.paint(tile.mesh, still, road, 1, 1);
    const base = placed(pose.p, pose.q), wheels = this.scene.wheels;
    this.spin += moved / wheels[0].radius;
    const dark = [0.13, 0.14, 0.16], metal = [0.72, 0.74, 0.77], strut = rgb(this.colours.simulated);
    wheels.forEach((wheel, i) => {
      const d = joints && joints.length > i ? joints[i] : wheel.standing, [x, y, z] = jointCentre(wheel, d);
      const model = times(base, times(shifted(x, y, z), turnedY(this.spin)));
      this.paint(this.tyre, model, dark);
      this.paint(this.rim, model, metal);
      // a bar from the wheel up to the body, in the middle of the travel half orange: pressed is more so
      const top = wheel.kind === "prismatic" ? wheel.radius + 0.5 : wheel.origin[2], inner = y - Math.sign(y) * (wheel.width * 0.5 + 0.08);
      const bar = new Float32Array([0.07, 0, 0, 0, 0, 0.07, 0, 0, 0, 0, Math.max(top - z, 0.02), 0, x, inner, (top + z) / 2, 1]);
      const pressed = Math.min(Math.max(0.5 + (d - wheel.standing) / (wheel.kind === "prismatic" ? 0.08 : 0.4), 0), 1);
      this.paint(this.box, times(base, bar), metal.map((v, n) => v + (strut[n] - v) * pressed));
    });
    const sensor = this.scene.imu;
    const dot = new Float32Array([0.09, 0, 0, 0, 0, 0.16, 0, 0, 0, 0, 0.09, 0, ...sensor, 1]);
    this.paint(this.box, times(base, dot), rgb(this.colours.measured));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    gl.enable(gl.CULL_FACE);
    for (const side of [gl.FRONT, gl.BACK]) {
      gl.cullFace(side);
      this.paint(this.body, base, rgb(this.colours.body), 0.46);
    }
    this.paint(this.outline, base, rgb(this.colours.ink), 0.75, 0, gl.LINES);
    gl.depthMask(true);
  }
}

export function jointCentre(wheel, d) {
  const [x, y, z] = wheel.origin, [u, v, w] = wheel.wheel, [a, b, c] = wheel.axis;
  if (wheel.kind === "prismatic") return [x + u + d * a, y + v + d * b, z + w + d * c];
  return [x + u * Math.cos(d) + b * w * Math.sin(d), y + v, z + w * Math.cos(d) - b * u * Math.sin(d)];
}
