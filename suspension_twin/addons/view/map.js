// SPDX-License-Identifier: Apache-2.0
// The path from above, coloured by its gap, on a 2D canvas.

import { palette } from "./charts.js";

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

function niceStep(span, most) {
  const raw = span / most, power = 10 ** Math.floor(Math.log10(raw)), part = raw / power;
  return (part > 5 ? 10 : part > 2 ? 5 : part > 1 ? 2 : 1) * power;
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
