// SPDX-License-Identifier: Apache-2.0
// Signals, spectrum and map on 2D canvases.

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
let palette = {};
export function readColours() {
  for (const name of ["ink", "soft", "grid", "measured", "simulated", "good", "fair", "bad", "card", "sky", "road", "body"])
    palette[name] = css(name);
  return palette;
}

// A context in CSS pixels, sharp on any screen; null while the canvas is not to be seen.
function begin(canvas) {
  const scale = Math.min(window.devicePixelRatio || 1, 2), w = canvas.clientWidth, h = canvas.clientHeight;
  if (w < 20 || h < 20) return null;
  if (canvas.width !== Math.round(w * scale) || canvas.height !== Math.round(h * scale)) {
    canvas.width = Math.round(w * scale);
    canvas.height = Math.round(h * scale);
  }
  const c = canvas.getContext("2d");
  c.setTransform(scale, 0, 0, scale, 0, 0);
  c.clearRect(0, 0, w, h);
  c.font = "11px system-ui, sans-serif";
  c.lineJoin = "round";
  return { c, w, h };
}

export function niceStep(span, most) {
  const raw = span / most, power = 10 ** Math.floor(Math.log10(raw)), part = raw / power;
  return (part > 5 ? 10 : part > 2 ? 5 : part > 1 ? 2 : 1) * power;
}

let limit = 1; // half the height of the time chart in m/s², changes smoothly

export function drawSignals(canvas, measured, simulated, events, now) {
  const on = begin(canvas);
  if (!on) return;
  const { c, w, h } = on, left = 34, bottom = 18, top = 4, t0 = now - 10;
  let largest = 0.5;
  for (const rows of [measured, simulated])
    for (const [t, v] of rows) if (t >= t0 && t <= now) largest = Math.max(largest, Math.abs(v));
  limit += (1.08 * largest - limit) * (1.08 * largest > limit ? 0.4 : 0.03);
  const x = (t) => left + ((t - t0) / 10) * (w - left - 4), y = (v) => top + ((limit - v) / (2 * limit)) * (h - top - bottom);
  c.strokeStyle = palette.grid;
  c.fillStyle = palette.soft;
  c.lineWidth = 1;
  const step = niceStep(2 * limit, Math.max(2, h / 34));
  c.textAlign = "right";
  c.textBaseline = "middle";
  for (let v = Math.ceil(-limit / step) * step; v <= limit; v += step) {
    c.beginPath();
    c.moveTo(left, y(v));
    c.lineTo(w - 4, y(v));
    c.stroke();
    c.fillText(Math.abs(v) < step / 10 ? "0" : String(+v.toPrecision(3)), left - 5, y(v));
  }
  c.textAlign = "center";
  c.textBaseline = "top";
  for (let t = Math.ceil(t0 / 2) * 2; t <= now; t += 2) if (t >= 0) c.fillText(`${t.toFixed(0)} s`, Math.max(x(t), left + 8), h - bottom + 4);
  c.save();
  c.beginPath();
  c.rect(left, 0, w - left, h - bottom);
  c.clip();
  for (const event of events) {
    if (event.t < t0) continue;
    c.strokeStyle = palette.fair;
    c.setLineDash([4, 3]);
    c.beginPath();
    c.moveTo(x(event.t), 0);
    c.lineTo(x(event.t), h);
    c.stroke();
    c.setLineDash([]);
  }
  for (const [rows, colour, width] of [[measured, palette.measured, 1.6], [simulated, palette.simulated, 1.3]]) {
    c.strokeStyle = colour;
    c.lineWidth = width;
    c.beginPath();
    let last = -1e9;
    for (const [t, v] of rows) {
      if (t < t0 - 0.1 || t > now + 0.05) continue;
      if (t - last > 0.3) c.moveTo(x(t), y(v));
      else c.lineTo(x(t), y(v));
      last = t;
    }
    c.stroke();
  }
  c.restore();
}

export function drawSpectrum(canvas, spectrum) {
  const on = begin(canvas);
  if (!on) return;
  const { c, w, h } = on, left = 38, bottom = 18, top = 4;
  c.fillStyle = palette.soft;
  if (!spectrum) {
    c.textAlign = "center";
    c.fillText("after some seconds of driving", w / 2, h / 2);
    return;
  }
  const f = spectrum.f, high = Math.min(f[f.length - 1], 50), low = f[0];
  let most = 1e-6;
  for (let i = 0; i < f.length; i++) most = Math.max(most, spectrum.measured[i], spectrum.simulated[i]);
  const topPower = Math.ceil(Math.log10(most)), powers = 4;
  const x = (v) => left + (Math.log(v / low) / Math.log(high / low)) * (w - left - 6);
  const y = (v) => top + ((topPower - Math.log10(Math.max(v, 1e-12))) / powers) * (h - top - bottom);
  c.strokeStyle = palette.grid;
  c.lineWidth = 1;
  c.textAlign = "right";
  c.textBaseline = "middle";
  for (let p = topPower; p >= topPower - powers; p--) {
    c.beginPath();
    c.moveTo(left, y(10 ** p));
    c.lineTo(w - 6, y(10 ** p));
    c.stroke();
    c.fillText(`1e${p}`, left - 5, Math.max(y(10 ** p), 7));
  }
  c.textAlign = "center";
  c.textBaseline = "top";
  for (const v of [0.5, 1, 2, 5, 10, 20, 50]) {
    if (v < low || v > high) continue;
    c.beginPath();
    c.moveTo(x(v), top);
    c.lineTo(x(v), h - bottom);
    c.stroke();
    c.fillText(String(v), Math.min(x(v), w - 12), h - bottom + 4);
  }
  c.save();
  c.beginPath();
  c.rect(left, top, w - left, h - bottom - top);
  c.clip();
  for (const name of ["measured", "simulated"]) {
    c.strokeStyle = palette[name];
    c.lineWidth = 1.6;
    c.beginPath();
    f.forEach((v, i) => (i ? c.lineTo(x(v), y(spectrum[name][i])) : c.moveTo(x(v), y(spectrum[name][i]))));
    c.stroke();
  }
  c.restore();
}

const mix = (a, b, k) => a.map((v, i) => Math.round(v + (b[i] - v) * k));
const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));

// Green up to the low gap, over yellow to red at the high one; grey where nothing is known.
export function gapColour(value, low, high) {
  if (value < 0) return palette.road;
  const k = Math.min(Math.max((value - low) / Math.max(high - low, 1e-9), 0), 1);
  const [g, y, r] = [palette.good, palette.fair, palette.bad].map(rgb);
  return `rgb(${(k < 0.5 ? mix(g, y, 2 * k) : mix(y, r, 2 * k - 1)).join(",")})`;
}

export function drawMap(canvas, path, events, pose, low, high) {
  const on = begin(canvas);
  if (!on) return;
  const { c, w, h } = on;
  if (!path.length) {
    c.fillStyle = palette.soft;
    c.textAlign = "center";
    c.fillText("The path appears when the vehicle moves.", w / 2, h / 2);
    return;
  }
  let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const [x, y] of path) {
    x0 = Math.min(x0, x); x1 = Math.max(x1, x); y0 = Math.min(y0, y); y1 = Math.max(y1, y);
  }
  const span = Math.max(x1 - x0, ((y1 - y0) * w) / Math.max(h - 30, 1), 20) * 1.12, s = w / span;
  const sx = (x) => w / 2 + (x - (x0 + x1) / 2) * s, sy = (y) => (h - 16) / 2 - (y - (y0 + y1) / 2) * s;
  c.lineWidth = 5;
  c.lineCap = "round";
  for (let i = 1; i < path.length; i++) {
    const [a, b] = [path[i - 1], path[i]];
    if (Math.hypot(a[0] - b[0], a[1] - b[1]) > 15) continue; // wound on, or an outage
    c.strokeStyle = gapColour(b[2], low, high);
    c.beginPath();
    c.moveTo(sx(a[0]), sy(a[1]));
    c.lineTo(sx(b[0]), sy(b[1]));
    c.stroke();
  }
  c.fillStyle = palette.ink;
  for (const event of events) {
    if (event.x === null) continue;
    c.beginPath();
    c.arc(sx(event.x), sy(event.y), 4, 0, 7);
    c.fill();
  }
  if (pose) {
    c.save();
    c.translate(sx(pose.p[0]), sy(pose.p[1]));
    c.rotate(-pose.yaw);
    c.fillStyle = palette.ink;
    c.strokeStyle = palette.card;
    c.lineWidth = 1.5;
    c.beginPath();
    c.moveTo(11, 0);
    c.lineTo(-7, 6);
    c.lineTo(-4, 0);
    c.lineTo(-7, -6);
    c.closePath();
    c.fill();
    c.stroke();
    c.restore();
  }
  const bar = niceStep(span / 4, 1);
  c.fillStyle = c.strokeStyle = palette.soft;
  c.lineWidth = 2;
  c.beginPath();
  c.moveTo(8, h - 8);
  c.lineTo(8 + bar * s, h - 8);
  c.stroke();
  c.textBaseline = "middle";
  c.textAlign = "left";
  c.fillText(`${bar} m`, 14 + bar * s, h - 8);
  c.textAlign = "right";
  c.fillText("north up", w - 6, h - 8);
}
