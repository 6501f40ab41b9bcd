// The page: keep the newest message of each kind, and draw it with the next screen refresh.

import { Connection } from "./connection.js";
import { drawBars, drawHistogram, drawStrip } from "./charts.js";
import { Controls, element } from "./controls.js";
import { COLOURS, cleared, ink } from "./drawing.js";
import { drawArrows, drawFrame, drawMap, drawSpots, drawValidity, drawWindows, verdict } from "./maps.js";
import { inWords } from "./message.js";

const byId = (id) => document.getElementById(id);
const say = (id, text) => { if (byId(id).textContent !== text) byId(id).textContent = text; };
const known = {}; // the newest message of each kind
let stale = new Set(); // kinds received since the last drawing
let held = false, connected = false, drawnFrames = 0;
let reach = 0.5, flux = [0, 1]; // scales, adjusted slowly

const connection = new Connection({
  onMessage(message) {
    connected = true;
    if (held && message.kind !== "status") return;
    known[message.kind] = message;
    if (stale.size === 0) requestAnimationFrame(draw);
    stale.add(message.kind);
  },
  onAccess: (reply) => controls.access(reply),
  onLost() { connected = false; showState(); },
});
const controls = new Controls(connection);

function draw() {
  const fresh = stale;
  document.documentElement.dataset.frames = ++drawnFrames;
  stale = new Set();
  if (fresh.has("sensor")) sensorCame();
  if (fresh.has("place") || fresh.has("status")) showState();
  if (fresh.has("status")) showStatus();
  if (fresh.has("settings")) controls.settings(known.settings.values.settings);
  if (fresh.has("figures")) showFigures();
  if (!known.sensor) return;
  if (fresh.has("pictures")) showPictures();
  if (fresh.has("now")) showNow();
}

function redraw() {
  stale = new Set(Object.keys(known).filter((kind) => kind !== "sensor"));
  requestAnimationFrame(draw);
}
addEventListener("resize", redraw);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
for (const id of ["windows", "spots", "without-mean"]) byId(id).addEventListener("change", redraw);
byId("hold").addEventListener("click", () => {
  held = !held;
  byId("hold").setAttribute("aria-pressed", held);
  showState();
});

const sensor = () => ({ ...known.sensor.values, ...known.sensor.arrays });
const invalidBits = () => flagList().filter((flag) => flag.invalid).reduce((bits, flag) => bits | flag.bit, 0) || 3;
const flagList = () => known.figures?.values.flags || [];

function sensorCame() {
  const [rows, columns] = known.sensor.values.frame_shape;
  for (const canvas of document.querySelectorAll("canvas[data-shape]")) {
    canvas.style.aspectRatio = `${columns} / ${rows}`;
  }
  for (const panels of document.querySelectorAll("main, #tiles")) panels.hidden = false;
  reach = 0.5;
  flux = [0, 1];
}

// State of the source ------------------------------------------------------------------------------------------

function showState() {
  const place = known.place?.values, status = known.status?.values;
  const state = byId("state");
  const there = connected && place?.there;
  state.dataset.state = there && !held ? "live" : "waiting";
  state.textContent = !connected ? "connecting" : held ? "held" : !place ? "waiting"
    : place.there ? "live" : `waiting for the engine ${place.name}${status?.error ? `: ${status.error}` : ""}`;
  if (!place) return;
  say("name", place.name);
  document.title = `${place.name} · faintspot`;
  const trouble = !connected ? "The server does not answer; check that faintspot live is running."
    : status?.source_refused || status?.estimator_fault || (there && status?.error) || "";
  byId("trouble").hidden = !trouble;
  say("trouble", trouble);
}

// Frames -------------------------------------------------------------------------------------------------

function showPictures() {
  const { values, arrays } = known.pictures, where = sensor();
  if (arrays.raw.shape.join() !== where.frame_shape.join()) return;
  const view = drawFrame(byId("raw"), where, arrays.raw, false);
  if (byId("windows").checked) drawWindows(view, where);
  const denoised = drawFrame(byId("denoised"), where, arrays.denoised, true);
  if (arrays.x && byId("spots").checked) {
    for (const each of [view, denoised]) {
      drawSpots(each, where, arrays.x.data, arrays.y.data, arrays.flags.data, invalidBits());
    }
  }
  say("raw-caption", `${values.frame}: ${values.raw_adu.map((value) => inWords(value)).join(" to ")} ADU`);
  say("denoised-caption", `${values.frame}: ${values.denoised_e.map((value) => inWords(value)).join(" to ")} e⁻`);
}

function showNow() {
  const { values, arrays } = known.now, where = sensor();
  if (arrays.x && arrays.x.data.length === where.subapertures) showSlopes(values, arrays, where);
  showStrips(values, arrays.strip);
  byId("commands-figure").hidden = !arrays.commands;
  if (arrays.commands) {
    const commands = Array.from(arrays.commands.data);
    drawBars(byId("commands"), commands);
    const rms = Math.sqrt(commands.reduce((sum, value) => sum + value * value, 0) / commands.length);
    say("commands-caption", `${commands.length}, rms ${inWords(rms)}`);
  }
  showTiles();
}

function showSlopes(values, arrays, where) {
  let x = arrays.x.data, y = arrays.y.data;
  const flags = arrays.flags.data, invalid = invalidBits();
  const used = Array.from(flags, (flag) => !(flag & invalid));
  const mean = (data) => {
    const kept = Array.from(data).filter((_, i) => used[i]);
    return kept.reduce((sum, value) => sum + value, 0) / Math.max(1, kept.length);
  };
  if (byId("without-mean").checked) {
    const tip = mean(x), tilt = mean(y);
    [x, y] = [x.map((value) => value - tip), y.map((value) => value - tilt)];
  }
  const lengths = Array.from(x, (value, i) => Math.hypot(value, y[i])).filter((_, i) => used[i]).sort((a, b) => a - b);
  const wanted = roundUp(lengths[Math.floor(0.9 * lengths.length)] || reach);
  if (wanted > 1.5 * reach || wanted < reach / 2.1) reach = wanted;
  drawArrows(byId("slopes"), where, x, y, flags, invalid, reach);
  say("slopes-caption", `half a sub-aperture: ${inWords(reach, 2)} px`);

  const light = arrays.flux.data, lit = Array.from(light).filter((_, i) => used[i]);
  const low = Math.min(0, ...lit), high = Math.max(...lit, 1);
  flux = [flux[0] + 0.2 * (low - flux[0]), high > flux[1] ? high : flux[1] + 0.05 * (high - flux[1])];
  drawMap(byId("flux"), where, light, ...flux);
  say("flux-caption", `${values.flux_of}, mean ${inWords(mean(light))} e⁻`);
  colourBar("flux-scale", flux, "e⁻");

  drawValidity(byId("valid"), where, flags, invalid);
  const kinds = [0, 0, 0];
  for (const flag of flags) kinds[verdict(flag, invalid)]++;
  say("valid-caption", `${flags.length - kinds[2]} of ${flags.length} valid`);
  showLegend(flags, kinds);
}

function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(Math.max(value, 1e-4)));
  return [1, 1.5, 2, 3, 5, 7, 10].find((factor) => factor * power >= value) * power;
}

function colourBar(id, [low, high], unit) {
  const place = byId(id);
  if (!place.firstChild) place.append(element("span"), element("canvas"), element("span"));
  const [from, bar, to] = place.children;
  from.textContent = inWords(low, 2);
  to.textContent = `${inWords(high, 3)} ${unit}`;
  const { context, width, height } = cleared(bar);
  for (let i = 0; i < width; i++) {
    const colour = COLOURS[Math.floor(255 * i / width)];
    context.fillStyle = `rgb(${colour & 255} ${colour >> 8 & 255} ${colour >> 16 & 255})`;
    context.fillRect(i, 0, 1.5, height);
  }
}

const SVG = "http://www.w3.org/2000/svg";

/** Show the legend of the map, and how often each flag is set. */
function showLegend(flags, kinds) {
  const words = ["no flag", "valid, flagged", "invalid"];
  const named = flagList().map(({ bit, name }) => [name, flags.filter((flag) => flag & bit).length]);
  const text = named.filter(([, count]) => count).map(([name, count]) => `${name} ${count}`).join(", ");
  const state = JSON.stringify([kinds.map(Boolean), text, ink.first]);
  const place = byId("valid-legend");
  if (place.dataset.state === state) return;
  place.dataset.state = state;
  place.replaceChildren(...kinds.flatMap((count, kind) => count ? [keyOf(kind, words[kind])] : []),
    ...(text ? [element("span", { textContent: `(${text})` })] : []));
}

function keyOf(kind, words) {
  const picture = document.createElementNS(SVG, "svg");
  picture.setAttribute("viewBox", "0 0 16 16");
  const shape = (name, attributes) => {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    picture.append(made);
  };
  shape("rect", { width: 16, height: 16, fill: [ink.first, ink.note, ink.bad][kind], "fill-opacity": kind ? 1 : 0.55 });
  if (kind === 1) shape("circle", { cx: 8, cy: 8, r: 2.5, fill: ink.back });
  if (kind === 2) shape("path", { d: "M4 4l8 8M12 4l-8 8", stroke: ink.back, "stroke-width": 2 });
  return element("span", { className: "key" }, [picture, words]);
}

// Charts -------------------------------------------------------------------------------------------------

const METHOD_COLOURS = ["first", "second", "third", "text"];
const LONGEST_NAME = 20;

function showStrips({ strip: names, strip_s: seconds, strip_methods: methods, flux_of: whose }, { data, shape }) {
  const column = (name) => Float32Array.from({ length: shape[0] }, (_, i) => data[i * shape[1] + names.indexOf(name)]);
  const times = column("time_s");
  const last = (values) => values.findLast(Number.isFinite);
  const typical = column("latency_us"), longest = column("longest_us");
  drawStrip(byId("latency"), times, seconds, [
    { values: longest, colour: "second", dash: true }, { values: typical, colour: "first" },
  ], { logarithmic: true, marks: column("lost") });
  say("latency-caption", "µs: typical (line), longest (dashed), lost frames (ticks)");
  const method = column("method");
  const byMethod = (values) => [...new Set(Object.values(methods))].map((name, i) => (
    { name, values: values.map((value, k) => methods[method[k]] === name ? value : NaN),
      colour: METHOD_COLOURS[i % METHOD_COLOURS.length], dash: i >= METHOD_COLOURS.length }));
  const show = (id, lines, text, unit, limits = { from: 0 }) => {
    drawStrip(byId(id), times, seconds, lines, limits);
    byId(`${id}-caption`).replaceChildren(text, ...lines.map(({ name, values, colour }) => element("span", {
      textContent: `${lines.length > 1 ? ` ${cut(name, LONGEST_NAME)}` : ""} ${inWords(last(values))} ${unit}`,
      title: lines.length > 1 ? name : "", style: lines.length > 1 ? `color: ${ink[colour]}` : "" })));
  };
  show("rms", byMethod(column("rms_px")), "about the mean slopes:", "px");
  const light = column("flux_e");
  const kept = whose === "of the star" ? [{ values: light, colour: "first" }] : byMethod(light);
  show("mean-flux", kept, `${whose}, per sub-aperture:`, "e⁻");
  const strehl = column("strehl"), some = strehl.some(Number.isFinite);
  byId("strehl-figure").hidden = !some;
  if (some) {
    const rms = `(last ${inWords(last(column("rms_nm")))} nm rms)`;
    show("strehl", byMethod(strehl), `true, from the simulated telescope ${rms}:`, "", { from: 0, to: 1 });
  }
}

function showFigures() {
  const { values } = known.figures;
  showTiles();
  if (values.histogram) {
    const { 50: half, 99: most, 99.9: nearly } = values.percentiles_us;
    drawHistogram(byId("histogram"), values.histogram, [half, most]);
    say("histogram-caption", `p50 ${inWords(half)} µs, p99 ${inWords(most)}, p99.9 ${inWords(nearly)}, longest `
      + `${inWords(values.longest_us)}; ${inWords(values.frames)} frames in ${inWords(values.seconds, 2)} s`);
  }
  showMethods(values.methods || []);
  const changes = values.changes || [];
  byId("changes-section").hidden = changes.length === 0;
  byId("changes").replaceChildren(...changes.slice(-8).reverse().map(({ frame, changes: what, where }) => {
    const text = Object.entries(what).map(([name, value]) => `${name} = ${shortened(value)}`).join(", ");
    return element("li", { textContent: `from frame ${frame}: ${text}${where === null ? "" : `, sub-apertures ${where}`}` });
  }));
}

const LONGEST = 80;
const cut = (text, longest) => text.length > longest ? `${text.slice(0, longest)}…` : text;

function shortened(value) {
  const numbers = value && typeof value === "object" && !Array.isArray(value)
    ? Object.entries(value).filter(([, item]) => !Array.isArray(item)) : null;
  const text = numbers ? numbers.map(([name, item]) => `${name} ${item}`).join(", ") : JSON.stringify(value);
  return cut(text, LONGEST);
}

function showMethods(methods) {
  byId("methods-section").hidden = methods.length === 0;
  if (methods.length === 0) return;
  const titles = Object.keys(methods[0].figures);
  const withError = (value, half) => `${inWords(value)}${half === null ? "" : ` ± ${inWords(half, 2)}`}`;
  const cell = ({ mean, half, difference, difference_half: spread, decided }) => {
    const made = element("td", { textContent: withError(mean, half) });
    if (difference !== undefined && difference !== null) {
      const words = `${difference > 0 ? "+" : ""}${withError(difference, spread)}`;
      made.append(element("small", { textContent: words, className: decided ? "decided" : "" }));
    }
    return made;
  };
  byId("methods").replaceChildren(
    element("thead", {}, [element("tr", {}, [element("th", { textContent: "method" }), element("th", { textContent: "frames" }),
      ...titles.map((title) => element("th", { textContent: title }))])]),
    element("tbody", {}, methods.map((method) => element("tr", {}, [element("th", { textContent: method.method, scope: "row" }),
      element("td", { textContent: inWords(method.frames) }), ...titles.map((title) => cell(method.figures[title]))]))),
  );
}

// Numbers ------------------------------------------------------------------------------------------------

function list(id, entries) {
  const place = byId(id);
  const names = entries.map(([name]) => name).join();
  if (place.dataset.names !== names) {
    place.dataset.names = names;
    place.replaceChildren(...entries.map(([name]) =>
      element("div", {}, [element("dt", { textContent: name }), element("dd")])));
  }
  entries.forEach(([, value], i) => {
    const shown = place.children[i].lastChild;
    if (shown.textContent !== value) shown.textContent = value;
  });
}

function showTiles() {
  const figures = known.figures?.values || {}, now = known.now?.values || {}, loop = known.status?.values.loop;
  const camera = known.place?.values.camera_hz;
  const percentiles = figures.percentiles_us || {};
  list("tiles", [
    ["frame", now.frame === undefined ? "–" : String(now.frame)],
    ["frames/s", inWords(figures.rate_hz) + (camera ? ` of ${inWords(camera)}` : "")],
    ["latency p50", `${inWords(percentiles[50])} µs`],
    ["p99", `${inWords(percentiles[99])} µs`],
    ["lost frames", inWords(now.lost)],
    ...(now.method && figures.methods?.length ? [["method", now.method]] : []),
    ...(loop && loop.state !== "none" ? [["loop", loop.state], ...(loop.gain == null ? [] : [["gain", inWords(loop.gain)]])] : []),
  ]);
}

function showStatus() {
  const { values } = known.status;
  say("estimator", values.estimator || "");
  controls.status(values);
  const counters = { ...values.counters };
  if (values.subapertures && counters.processed) {
    counters["iterations per sub-aperture"] = counters.iterations / (counters.processed * values.subapertures);
  }
  delete counters.iterations;
  const missed = known.now?.values.missed || 0;
  list("counters", [
    ...Object.entries(counters).map(([name, value]) => [name.replaceAll("_", " "), inWords(value)]),
    ...(values.latency ? Object.entries(values.latency).filter(([name]) => name !== "count").map(([name, value]) =>
      [`latency ${name.replace("_us", "").replace("_", ".")}, µs`, inWords(value, 4)]) : []),
    ["records missed by this page", inWords(missed)],
    ...Object.entries(values.loaded || {}).map(([estimator, file]) => [`${estimator} loaded from`, file]),
    ...(values.preparing ? [["in preparation", Object.keys(values.preparing.changes).join(", ")]] : []),
  ]);
}
