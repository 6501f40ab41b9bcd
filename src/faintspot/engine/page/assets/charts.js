// Strip charts, histogram, bars.

import { cleared, ink, ticks } from "./drawing.js";
import { inWords } from "./message.js";

const SHORT = new Intl.NumberFormat("en", { notation: "compact" });
const inTime = (us) => us < 1e3 ? `${inWords(us)} µs` : us < 1e6 ? `${inWords(us / 1e3)} ms` : `${inWords(us / 1e6)} s`;
const GAP_S = 1; // longest gap that a line crosses
const LEFT = 52, BOTTOM = 20, TOP = 6, RIGHT = 8;

/** Draw axes with a grid; return functions from values to canvas positions. */
function axes(canvas, low, high, yTicks) {
  const { context, width, height } = cleared(canvas);
  const y = (value) => height - BOTTOM - (value - low) / (high - low) * (height - BOTTOM - TOP);
  context.textBaseline = "middle";
  context.textAlign = "right";
  context.lineWidth = 1;
  for (const [value, label] of yTicks) {
    context.strokeStyle = ink.grid;
    context.beginPath();
    context.moveTo(LEFT, Math.round(y(value)) + 0.5);
    context.lineTo(width - RIGHT, Math.round(y(value)) + 0.5);
    context.stroke();
    context.fillStyle = ink.soft;
    context.fillText(label, LEFT - 6, y(value));
  }
  context.textBaseline = "alphabetic";
  context.textAlign = "center";
  return { context, width, height, y };
}

function yTicksOf(low, high, logarithmic, inWordsOf = SHORT.format) {
  if (!logarithmic) return ticks(low, high, 3).map((value) => [value, inWords(Number(value.toPrecision(6)))]);
  const values = [];
  for (let power = Math.ceil(low - 1e-9); power <= high; power++) values.push([power, inWordsOf(10 ** power)]);
  return values;
}

/**
 * Draw lines against time, seconds before now.
 * lines: [{values, colour, dash}], NaN: no data, crossed as other gaps are. marks: values; those above 0 get a tick.
 */
export function drawStrip(canvas, times, seconds, lines, { from, to, logarithmic = false, marks } = {}) {
  const seen = lines.flatMap((line) => Array.from(line.values).filter(Number.isFinite))
    .map((value) => logarithmic ? Math.log10(Math.max(value, 1e-3)) : value);
  let low = from ?? Math.min(...seen), high = to ?? Math.max(...seen);
  if (logarithmic) [low, high] = [Math.floor(low * 2) / 2, Math.ceil(high * 2 + 1e-9) / 2];
  if (!(Number.isFinite(low) && Number.isFinite(high))) [low, high] = [0, 1];
  const rise = high - low || Math.abs(high) || 1;
  if (to === undefined && !logarithmic) high += 0.08 * rise;
  if (!(high > low)) high = low + 1;
  const { context, width, height, y } = axes(canvas, low, high, yTicksOf(low, high, logarithmic, inTime));
  const x = (time) => width - RIGHT + time / seconds * (width - LEFT - RIGHT);
  context.fillStyle = ink.soft;
  for (const time of ticks(-seconds, 0, width < 420 ? 3 : 6)) {
    context.textAlign = time === 0 ? "right" : "center";
    context.fillText(time === 0 ? "now" : `${time} s`, x(time), height - 5);
  }
  context.save();
  context.beginPath();
  context.rect(LEFT, 0, width - LEFT - RIGHT + 1, height - BOTTOM + 1);
  context.clip();
  if (marks) {
    context.strokeStyle = ink.bad;
    context.lineWidth = 2;
    context.beginPath();
    for (let i = 0; i < times.length; i++) {
      if (marks[i] > 0) { context.moveTo(x(times[i]), TOP); context.lineTo(x(times[i]), TOP + 8); }
    }
    context.stroke();
  }
  for (const { values, colour, dash } of lines) {
    context.strokeStyle = ink[colour];
    context.setLineDash(dash ? [3, 3] : []);
    context.lineWidth = 1.5;
    context.beginPath();
    let before = -Infinity;
    for (let i = 0; i < times.length; i++) {
      if (!Number.isFinite(values[i])) continue;
      const v = y(logarithmic ? Math.log10(Math.max(values[i], 1e-3)) : values[i]);
      if (times[i] - before < GAP_S) context.lineTo(x(times[i]), v); else context.moveTo(x(times[i]), v);
      before = times[i];
    }
    context.stroke();
  }
  context.restore();
}

/** Draw a histogram of the latencies with logarithmic axes. */
export function drawHistogram(canvas, { from_us: edges, counts }, marks) {
  const most = Math.ceil(Math.log10(Math.max(...counts, 10)));
  const labels = yTicksOf(0, most, true);
  const { context, width, height, y } = axes(canvas, 0, most, labels);
  const step = edges.length > 1 ? edges[1] / edges[0] : 2 ** 0.25;
  const low = Math.log10(edges[0]), high = Math.log10(edges[edges.length - 1] * step);
  const x = (value) => LEFT + (Math.log10(value) - low) / (high - low) * (width - LEFT - RIGHT);
  context.fillStyle = ink.first;
  counts.forEach((count, i) => {
    if (!count) return;
    const top = y(Math.max(Math.log10(count), 0.06));
    context.fillRect(x(edges[i]) + 0.5, top, Math.max(1, x(edges[i] * step) - x(edges[i]) - 1), height - BOTTOM - top);
  });
  context.fillStyle = ink.soft;
  context.textAlign = "center";
  for (let power = Math.ceil(low); power <= high; power++) {
    for (const factor of high - low < 1.6 ? [1, 2, 5] : [1]) {
      const value = factor * 10 ** power;
      if (Math.log10(value) <= high) context.fillText(inTime(value), x(value), height - 5);
    }
  }
  context.strokeStyle = ink.second;
  context.setLineDash([4, 3]);
  for (const value of marks.filter(Number.isFinite)) {
    context.beginPath();
    context.moveTo(x(value), TOP);
    context.lineTo(x(value), height - BOTTOM);
    context.stroke();
  }
  context.setLineDash([]);
}

/** Draw values as bars from zero. */
export function drawBars(canvas, values) {
  const reach = Math.max(...values.map(Math.abs), 1e-9);
  const { context, width, y } = axes(canvas, -reach, reach, yTicksOf(-reach, reach, false));
  const step = (width - LEFT - RIGHT) / values.length;
  context.fillStyle = ink.first;
  values.forEach((value, i) => {
    context.fillRect(LEFT + i * step, Math.min(y(0), y(value)), Math.max(1, step - 1), Math.abs(y(value) - y(0)) || 1);
  });
}
