// The map of robots with 3D LiDARs from above: the points of its file, coloured by height, up to a cut.

import { fleet } from "./fleet.js";
import { Failed, at, unlessSame } from "./service.js";

const VOXEL_M = 0.1, LAYER_M = 0.05; // points of a layer are drawn in any order
const RENEW_MS = 10000; // a map has megabytes
const OVER_LOWEST_M = 2, OVER_HIGHEST_M = 0.5; // where the cut is at first: below ceilings

let shown = null, redraw = () => {}; // the cloud on the map
export const onHeights = (act) => { redraw = act; };

// The points of a PLY file, the lowest first.
function pointsOf(buffer) {
  const text = new TextDecoder("latin1").decode(buffer.slice(0, 2000)), start = text.indexOf("end_header\n") + 11, places = {};
  let row = 0;
  for (const [, type, name] of text.slice(0, start).matchAll(/^property (\w+) (\w+)$/gm)) { places[name] = row; row += { float: 4, uchar: 1 }[type]; }
  const count = Number(text.match(/^element vertex (\d+)$/m)[1]), data = new DataView(buffer, start), at = (k, name) => data.getFloat32(k * row + places[name], true);
  let low = Infinity, high = -Infinity;
  for (let k = 0; k < count; k++) { const z = at(k, "z"); low = Math.min(low, z); high = Math.max(high, z); }
  const layer = (k) => Math.floor((at(k, "z") - low) / LAYER_M), next = new Uint32Array(count ? Math.floor((high - low) / LAYER_M) + 2 : 1);
  for (let k = 0; k < count; k++) next[layer(k) + 1]++;
  for (let k = 1; k < next.length; k++) next[k] += next[k - 1];
  const x = new Float32Array(count), y = new Float32Array(count), z = new Float32Array(count), colours = new Uint32Array(count);
  for (let k = 0; k < count; k++) {
    const to = next[layer(k)]++, [red, green, blue] = ["red", "green", "blue"].map((name) => data.getUint8(k * row + places[name]));
    x[to] = at(k, "x"); y[to] = at(k, "y"); z[to] = at(k, "z");
    colours[to] = (0xff000000 | (blue << 16) | (green << 8) | red) >>> 0;
  }
  return { x, y, z, colours };
}

// The newest points that have come, as for tiles.
const clouds = new Map();
function cloudOf(index) {
  const key = `${fleet.mission}/${index}`, kept = clouds.get(key) ?? { points: null, cut: null, isAsked: false };
  clouds.set(key, kept);
  if (!kept.isAsked) {
    kept.isAsked = true;
    unlessSame(`maps/${index}.ply`, async (answer) => pointsOf(await answer.arrayBuffer()))
      .then((points) => { if (points !== kept.points) { kept.points = points; redraw(); } })
      .catch((error) => { if (error instanceof Failed) kept.points = null; })
      .finally(() => { if (!fleet.readOnly) setTimeout(() => { kept.isAsked = false; }, RENEW_MS); });
  }
  return kept;
}
export function forgetHeights() { clouds.clear(); }

export const heightText = (value) => `${(Math.round(10 * value) / 10 + 0).toFixed(1).replace("-", "−")} m`;
// The slider, and where it is at first.
function showCut(index, { points: { z } }) {
  const slider = at("height"), low = z[0], high = z.at(-1);
  if (shown.cut === null) {
    const floors = fleet.robots.filter((r) => r.map === index).flatMap((r) => (fleet.trails.get(r.session) ?? []).map((pose) => pose[4]));
    const [lowest, highest] = [Math.min, Math.max].map((pick) => floors.reduce((end, z_m) => pick(end, z_m), floors[0] ?? low));
    shown.cut = Math.min(high, Math.max(lowest + OVER_LOWEST_M, highest + OVER_HIGHEST_M));
  }
  Object.assign(slider, { min: low.toFixed(1), max: (high + 0.1).toFixed(1), value: shown.cut });
  at("cut-height").textContent = slider.ariaValueText = heightText(shown.cut);
  at("lowest").textContent = heightText(z[Math.floor(0.02 * z.length)]); // where the colours of the file begin and end
  at("highest").textContent = heightText(z[Math.floor(0.98 * z.length)]);
}
at("height").addEventListener("input", () => { shown.cut = Number(at("height").value); redraw(); });

let sheet = null;
export function drawHeights(pen, index, view, w, h) {
  shown = cloudOf(index);
  at("cut").hidden = !shown.points?.z.length;
  if (at("cut").hidden) return;
  showCut(index, shown);
  const [width, height] = [pen.canvas.width, pen.canvas.height], { x, y, z, colours } = shown.points, k = view.scale * width / w, c = k * Math.cos(view.turn), s = k * Math.sin(view.turn);
  const side = Math.max(1, Math.ceil(VOXEL_M * (Math.abs(c) + Math.abs(s)))), half = side / 2;
  const left = width / 2 - c * view.x + s * view.y - half, top = height / 2 + s * view.x + c * view.y - half;
  if (sheet?.width !== width || sheet.height !== height) sheet = new OffscreenCanvas(width, height);
  const brush = sheet.getContext("2d"), image = brush.createImageData(width, height), pixels = new Uint32Array(image.data.buffer);
  for (let n = 0; n < z.length && z[n] <= shown.cut; n++) {
    const column = Math.round(left + c * x[n] - s * y[n]), row = Math.round(top - s * x[n] - c * y[n]);
    const from = Math.max(0, column), until = Math.min(width, column + side);
    if (from < until) for (let v = Math.max(0, row), last = Math.min(height, row + side); v < last; v++) pixels.fill(colours[n], v * width + from, v * width + until);
  }
  brush.putImageData(image, 0, 0);
  pen.drawImage(sheet, 0, 0, w, h);
}
