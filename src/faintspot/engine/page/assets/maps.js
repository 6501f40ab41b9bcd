// Images and maps of the sensor, x to the right and y upwards.

import { COLOURS, cleared, cssColour, ink } from "./drawing.js";

const scratch = document.createElement("canvas");

/** Return the mapping from frame pixels to the canvas, as large as fits. */
function placed(canvas, sensor) {
  const view = cleared(canvas);
  const [rows, columns] = sensor.frame_shape;
  const zoom = Math.min(view.width / columns, view.height / rows);
  const left = (view.width - zoom * columns) / 2, bottom = (view.height + zoom * rows) / 2;
  // Pixel i has its centre at i.
  return { ...view, zoom, x: (value) => left + zoom * (value + 0.5), y: (value) => bottom - zoom * (value + 0.5) };
}

/** Draw a frame of bytes; zeros are transparent if it is `hollow`. */
export function drawFrame(canvas, sensor, image, hollow) {
  const view = placed(canvas, sensor);
  const [rows, columns] = image.shape;
  scratch.width = columns;
  scratch.height = rows;
  const context = scratch.getContext("2d");
  const pixels = context.createImageData(columns, rows);
  const words = new Uint32Array(pixels.data.buffer);
  for (let row = 0; row < rows; row++) {
    const from = (rows - 1 - row) * columns, to = row * columns;
    for (let column = 0; column < columns; column++) {
      const value = image.data[from + column];
      words[to + column] = hollow && value === 0 ? 0 : COLOURS[value];
    }
  }
  context.putImageData(pixels, 0, 0);
  view.context.imageSmoothingEnabled = false;
  view.context.drawImage(scratch, view.x(-0.5), view.y(rows - 0.5), view.zoom * columns, view.zoom * rows);
  return view;
}

export function drawWindows(view, sensor) {
  const [height, width] = sensor.window, corners = sensor.corners.data;
  view.context.strokeStyle = "rgb(255 255 255 / 55%)";
  view.context.lineWidth = 1;
  for (let i = 0; i < corners.length; i += 2) {
    const top = view.y(corners[i] + height - 0.5), left = view.x(corners[i + 1] - 0.5);
    view.context.strokeRect(left + 0.5, top + 0.5, view.zoom * width - 1, view.zoom * height - 1);
  }
}

/** Draw rings at valid spots and crosses at invalid ones. */
export function drawSpots(view, sensor, x, y, flags, invalid) {
  const { context } = view, centres = sensor.centres.data;
  const radius = Math.max(3, Math.min(7, view.zoom * sensor.window[0] / 6));
  for (const [colour, width] of [["rgb(0 0 0 / 70%)", 3.5], ["#ff9a4d", 1.6]]) {
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    for (let i = 0; i < x.length; i++) {
      const u = view.x(centres[2 * i] + x[i]), v = view.y(centres[2 * i + 1] + y[i]);
      if (flags[i] & invalid) cross(context, u, v, radius);
      else {
        context.moveTo(u + radius, v);
        context.arc(u, v, radius, 0, 2 * Math.PI);
      }
    }
    context.stroke();
  }
}

function cross(context, u, v, radius) {
  context.moveTo(u - radius, v - radius);
  context.lineTo(u + radius, v + radius);
  context.moveTo(u - radius, v + radius);
  context.lineTo(u + radius, v - radius);
}

/** Draw arrows; a slope of `reach` pixels is half a sub-aperture long. */
export function drawArrows(canvas, sensor, x, y, flags, invalid, reach) {
  const view = placed(canvas, sensor), { context } = view, centres = sensor.centres.data;
  outlines(view, sensor, () => { context.strokeStyle = ink.line; context.lineWidth = 1; context.stroke(); });
  const scale = Math.min(...sensor.window) / 2 / reach;
  context.strokeStyle = context.fillStyle = ink.first;
  context.lineWidth = 1.6;
  for (let i = 0; i < x.length; i++) {
    const u = view.x(centres[2 * i]), v = view.y(centres[2 * i + 1]);
    context.beginPath();
    if (flags[i] & invalid) {
      context.strokeStyle = ink.bad;
      cross(context, u, v, 4);
      context.stroke();
      context.strokeStyle = ink.first;
      continue;
    }
    let dx = view.zoom * scale * x[i], dy = -view.zoom * scale * y[i];
    const length = Math.hypot(dx, dy), most = view.zoom * Math.min(...sensor.window);
    if (length > most) [dx, dy] = [dx * most / length, dy * most / length];
    context.moveTo(u, v);
    context.lineTo(u + dx, v + dy);
    context.stroke();
    head(context, u + dx, v + dy, Math.atan2(dy, dx), Math.min(7, 2 + length / 3));
  }
}

function head(context, u, v, angle, size) {
  context.beginPath();
  context.moveTo(u, v);
  for (const side of [2.6, -2.6]) context.lineTo(u + size * Math.cos(angle + side), v + size * Math.sin(angle + side));
  context.fill();
}

function outlines(view, sensor, paint) {
  const corners = sensor.outlines.shape[1], data = sensor.outlines.data;
  for (let i = 0; i < sensor.outlines.shape[0]; i++) {
    view.context.beginPath();
    for (let k = 0; k < corners; k++) {
      const at = 2 * (i * corners + k);
      view.context.lineTo(view.x(data[at]), view.y(data[at + 1]));
    }
    view.context.closePath();
    paint(i);
  }
}

/** Draw a map of values from `low` to `high`. */
export function drawMap(canvas, sensor, values, low, high) {
  const view = placed(canvas, sensor);
  outlines(view, sensor, (i) => {
    view.context.fillStyle = cssColour((values[i] - low) / (high - low || 1));
    view.context.fill();
  });
}

/** Return the state of a sub-aperture: 0 no flag, 1 flagged but valid, 2 invalid. */
export function verdict(flags, invalid) {
  return flags & invalid ? 2 : flags ? 1 : 0;
}

/** Draw the flags as plain, dotted or crossed cells, readable without colour. */
export function drawValidity(canvas, sensor, flags, invalid) {
  const view = placed(canvas, sensor), { context } = view, centres = sensor.centres.data;
  const size = Math.max(2, view.zoom * Math.min(...sensor.window) / 5);
  outlines(view, sensor, (i) => {
    const kind = verdict(flags[i], invalid);
    context.fillStyle = [ink.first, ink.note, ink.bad][kind];
    context.globalAlpha = kind ? 1 : 0.55;
    context.fill();
    context.globalAlpha = 1;
    if (!kind) return;
    const u = view.x(centres[2 * i]), v = view.y(centres[2 * i + 1]);
    context.beginPath();
    context.lineWidth = 2;
    context.strokeStyle = context.fillStyle = ink.back;
    if (kind === 1) {
      context.arc(u, v, size / 2, 0, 2 * Math.PI);
      context.fill();
    } else {
      cross(context, u, v, size);
      context.stroke();
    }
  });
}
