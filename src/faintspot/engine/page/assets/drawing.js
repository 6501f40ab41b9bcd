// Shared by all drawings: canvas in screen pixels, colours, ticks.

// Cividis (Nunez, Anderton and Renslow 2018), readable with any colour vision: every 32nd colour.
const CIVIDIS = [[0, 34, 78], [26, 56, 111], [63, 78, 109], [92, 101, 110], [120, 123, 116], [150, 146, 114],
  [183, 172, 101], [219, 199, 79], [254, 232, 56]];

export const COLOURS = Uint32Array.from({ length: 256 }, (_, i) => {
  const place = i / 255 * (CIVIDIS.length - 1), first = Math.min(Math.floor(place), CIVIDIS.length - 2);
  const [r, g, b] = [0, 1, 2].map((k) =>
    Math.round(CIVIDIS[first][k] + (place - first) * (CIVIDIS[first + 1][k] - CIVIDIS[first][k])));
  return (255 << 24 | b << 16 | g << 8 | r) >>> 0;
});

export function cssColour(value) {
  const c = COLOURS[Math.max(0, Math.min(255, Math.round(255 * value)))];
  return `rgb(${c & 255} ${c >> 8 & 255} ${c >> 16 & 255})`;
}

/** Read the page's colours, which differ between light and dark mode. */
export const ink = {};
function readInk() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["text", "soft", "back", "panel", "line", "grid", "first", "second", "third", "bad", "note"]) {
    ink[name] = style.getPropertyValue(`--${name}`).trim();
  }
}
readInk();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", readInk);

/** Return the drawing context of a canvas, cleared, in CSS pixels, and its size. */
export function cleared(canvas) {
  const scale = Math.min(devicePixelRatio || 1, 2);
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = "12px system-ui, sans-serif";
  return { context, width, height };
}

/** Return about `about` round values between two ends. */
export function ticks(low, high, about) {
  const raw = (high - low) / about, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find((factor) => factor * power >= raw) * power;
  const values = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) values.push(k * step);
  return values;
}
