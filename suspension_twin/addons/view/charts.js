// SPDX-License-Identifier: Apache-2.0
// The colours of the page, and its two charts: signals over time and their spectrum, drawn by uPlot.

/* global uPlot */

const NAMES = ["ink", "soft", "grid", "measured", "simulated", "good", "fair", "bad", "card", "sky", "road", "body"];
export const palette = {};
export function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of NAMES) palette[name] = style.getPropertyValue(`--${name}`).trim();
  return palette;
}

const SPAN = 10; // s of signals that are shown
const PAUSE = 0.1; // s without a sample from which a curve is broken
const SHRINK = 0.5; // s, time constant with which the height follows signals that become smaller
const POWERS = 4; // powers of ten of the spectrum that are shown, down from its peak
const FREQUENCIES = [0.5, 1, 2, 5, 10, 20, 50];

const axis = (size, gap, more) => ({
  font: "11px system-ui, sans-serif", stroke: () => palette.soft, gap, size,
  grid: { stroke: () => palette.grid, width: 1 }, ticks: { show: false }, ...more,
});

// Where a curve is broken, in pixels of the canvas: between its samples that are further than a pause from each other.
function pauses(u, series, first, last) {
  const t = u.data[0], values = u.data[series], at = (i) => Math.round(u.valToPos(t[i], "x", true)), found = [];
  let before = first;
  for (let i = first; i <= last; i++) {
    if (values[i] === undefined) continue;
    if (t[i] - t[before] > PAUSE) found.push([at(before), at(i)]);
    before = i;
  }
  return found;
}

// A chart that fills its box; `more` are its options, `gaps` as uPlot has them.
function chart(box, more, gaps) {
  const curve = (name, width) => ({ stroke: () => palette[name], width, points: { show: false }, ...(gaps ? { gaps } : { spanGaps: true }) });
  const given = {
    width: Math.max(box.clientWidth, 50), height: Math.max(box.clientHeight, 50), padding: [6, 6, 0, 0],
    legend: { show: false }, cursor: { show: false }, series: [{}, curve("measured", 1.6), curve("simulated", 1.3)], ...more,
  };
  const u = new uPlot(given, [[], [], []], box);
  new ResizeObserver(() => {
    if (box.clientWidth > 20 && box.clientHeight > 20) u.setSize({ width: box.clientWidth, height: box.clientHeight });
  }).observe(box);
  return u;
}

export class Signals {
  constructor(box) {
    this.limit = 1; // half the height in m/s²
    this.wall = performance.now();
    this.events = [];
    this.plot = chart(box, {
      scales: { x: { time: false }, y: { range: () => [-this.limit, this.limit] } },
      axes: [axis(25, 8, { grid: { show: false }, space: 60, values: (_u, at) => at.map((t) => (t < 0 ? "" : `${+t.toFixed(3)} s`)) }),
        axis(36, 4, { space: 30, values: (_u, at) => at.map((v) => String(+v.toPrecision(3))) })],
      hooks: { drawAxes: [(u) => this.mark(u)] },
    }, pauses);
  }

  // Rows [s, m/s²] of both signals as they have come.
  take(measured, simulated) {
    const columns = [measured, simulated].map((rows) => [rows.map((row) => row[0]), rows.map((row) => row[1])]);
    this.data = uPlot.join(columns);
  }

  // The last seconds before `now`, with the `events` in them.
  draw(now, events) {
    if (!this.data) return;
    const [t, ...signals] = this.data, since = now - SPAN;
    let largest = 0.5;
    for (let i = t.length - 1; i >= 0 && t[i] >= since; i--)
      if (t[i] <= now) for (const signal of signals) largest = Math.max(largest, Math.abs(signal[i] ?? 0));
    const wall = performance.now(), kept = Math.exp((this.wall - wall) / 1000 / SHRINK);
    this.wall = wall;
    this.limit = Math.max(1.08 * largest, kept * this.limit);
    this.events = events;
    this.plot.batch(() => {
      this.plot.setData(this.data, false);
      this.plot.setScale("x", { min: since, max: now });
    });
  }

  mark(u) {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.strokeStyle = palette.fair;
    ctx.setLineDash([4, 3]);
    for (const { t } of this.events) {
      if (t < u.scales.x.min || t > u.scales.x.max) continue;
      const x = u.valToPos(t, "x", true);
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
    }
    ctx.restore();
  }
}

export class Spectrum {
  constructor(box) {
    const decades = (top) => Array.from({ length: POWERS + 1 }, (_, i) => 10 ** (top - POWERS + i));
    this.top = 0; // power of ten at the upper edge
    this.plot = chart(box, {
      scales: { x: { time: false, distr: 3, range: (_u, low, high) => [low, high] }, y: { distr: 3, range: () => [10 ** (this.top - POWERS), 10 ** this.top] } },
      axes: [axis(25, 8, { splits: (u) => FREQUENCIES.filter((f) => f >= u.scales.x.min && f <= u.scales.x.max), filter: (_u, at) => at, values: (_u, at) => at.map(String) }),
        axis(36, 4, { splits: () => decades(this.top), filter: (_u, at) => at, values: (_u, at) => at.map((v) => `1e${Math.round(Math.log10(v))}`) })],
    });
  }

  // `spectrum`: frequencies in Hz and densities of both signals in (m/s²)²/Hz.
  draw(spectrum) {
    const tiny = (values) => values.map((v) => Math.max(v, 1e-12));
    let most = 1e-6;
    for (const signal of [spectrum.measured, spectrum.simulated]) for (const v of signal) most = Math.max(most, v);
    this.top = Math.ceil(Math.log10(most));
    this.plot.setData([spectrum.f, tiny(spectrum.measured), tiny(spectrum.simulated)]);
  }

  redraw() { this.plot.redraw(); }
}
