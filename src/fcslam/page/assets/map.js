// The map: tiles, layers, and how the pointer and the keys move it.

import { colourOf, fleet, isPast, keyOf, poseAt, robotNamed } from "./fleet.js";
import { distance, middle, movedPoint } from "./geometry.js";
import { drawHeights, forgetHeights, heightText, onHeights } from "./heights.js";
import { Failed, Refused, ask, at, json, report } from "./service.js";

const WORLD_M = 512, TILE_PX = 512, MOST_TILES = 48, RETRY_MS = 2000;
const BAR_PX = 120; // longest scale bar
const NEAR_M = 1.5; // a path ends so near its robot, or there is a gap: nobody knows the way between
const CLICK_PX = 8; // a click this near a line or a robot selects it
const RECENT_S = 120; // the path of the last minutes is drawn in full, the rest faint
const DARKEST_WALL = 150, UNKNOWN = 205, FREE = 254; // grey values of tiles

export const canvas = at("map");
const pen = canvas.getContext("2d", { willReadFrequently: false }), tiles = new Map();
export const chart = {
  view: null, // x, y: metres in the middle; scale: pixels of a metre; turn: radians
  index: 0, opened: null, // the open map, and a robot of it: maps get other numbers when they join or part
  beside: null, // { map, pose }: another map that is laid on it
  moved: false, // until the user moves the map, all of it is shown
  followed: false, closure: null, marks: [], // a selected closure; points to show
  tool: null, // takes clicks and drags, and draws
  onRobot: () => {}, onClosure: () => {}, onView: () => {},
};
let version = 0, queued = false;

// Reading the size of an element lays the page out, so it is read when it changes.
const size = { w: 0, h: 0 };
const measure = () => { size.w = canvas.clientWidth; size.h = canvas.clientHeight; };
measure();

// ---- Colours ----

let theme = {};
export function readTheme() {
  const style = getComputedStyle(document.documentElement);
  const names = ["floor", "wall", "unknown", "grid", "ink", "surface", "accent", "laser", "camera", "alert", "area", "keepout", "erase", "free", "plan", "appeared", "disappeared"];
  theme = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  forgetTiles();
}
const channels = (colour) => [1, 3, 5].map((k) => Number.parseInt(colour.slice(k, k + 2), 16));

// Grey values of a tile as colours of the theme.
function recoloured(picture) {
  const sheet = new OffscreenCanvas(picture.width, picture.height), brush = sheet.getContext("2d");
  brush.drawImage(picture, 0, 0);
  const image = brush.getImageData(0, 0, picture.width, picture.height), pixels = new Uint32Array(image.data.buffer);
  const stops = [[0, channels(theme.wall)], [DARKEST_WALL, channels(theme.wall)], [UNKNOWN, channels(theme.unknown)], [FREE, channels(theme.floor)], [256, channels(theme.floor)]];
  const table = Uint32Array.from({ length: 256 }, (_, grey) => {
    const k = stops.findIndex(([value]) => value > grey), [low, from] = stops[k - 1], [high, to] = stops[k], share = (grey - low) / (high - low);
    const [r, g, b] = from.map((c, n) => Math.round(c + share * (to[n] - c)));
    return grey === UNKNOWN ? 0 : (0xff000000 | (b << 16) | (g << 8) | r) >>> 0; // another map may lie below
  });
  for (let k = 0; k < pixels.length; k++) pixels[k] = table[pixels[k] & 255];
  brush.putImageData(image, 0, 0);
  return sheet.transferToImageBitmap();
}

// ---- Where things are ----

const cosSin = (turn) => [Math.cos(turn), Math.sin(turn)];
export function onScreen([x, y]) {
  const { view } = chart, [c, s] = cosSin(view.turn), dx = x - view.x, dy = y - view.y;
  return [size.w / 2 + (c * dx - s * dy) * view.scale, size.h / 2 - (s * dx + c * dy) * view.scale];
}
export function onMap([px, py]) {
  const { view } = chart, [c, s] = cosSin(view.turn), u = (px - size.w / 2) / view.scale, v = (size.h / 2 - py) / view.scale;
  return [view.x + c * u + s * v, view.y - s * u + c * v];
}

function cornersOf(index) {
  const extent = fleet.maps.find((m) => m.map === index)?.extent;
  return extent ? [0, 2].flatMap((i) => [1, 3].map((j) => [extent[i], extent[j]])) : [];
}
// Shows all of the open map and of the one beside it, or of the paths while there are no cells.
export function fit() {
  const { beside } = chart, turn = chart.view?.turn ?? 0, [c, s] = cosSin(turn), inset = size.w > 700 ? 40 : 10;
  const cells = [...cornersOf(chart.index), ...(beside ? cornersOf(beside.map).map((corner) => movedPoint(beside.pose, corner)) : [])];
  const points = cells.length ? cells : fleet.robots.flatMap((r) => (r.map === chart.index ? (fleet.trails.get(r.session) ?? []).map((p) => p.slice(1, 3)) : []));
  if (points.length) {
    const along = points.map(([x, y]) => [c * x - s * y, s * x + c * y]);
    const [low, high] = [Math.min, Math.max].map((pick) => [0, 1].map((k) => along.reduce((end, p) => pick(end, p[k]), along[0][k])));
    const [u, v] = [0, 1].map((k) => (low[k] + high[k]) / 2);
    chart.view = { x: c * u + s * v, y: -s * u + c * v, scale: Math.min((size.w - inset) / (high[0] - low[0] + 2), (size.h - inset) / (high[1] - low[1] + 2)), turn };
  }
  redraw();
}
export function fitAll() { chart.moved = false; chart.followed = false; fit(); }
export function openMap(index) {
  chart.index = index;
  chart.opened = fleet.maps.find((m) => m.map === index)?.robots[0] ?? null;
}
export function choose(index) { openMap(index); chart.beside = null; chart.marks = []; fitAll(); }
// The map in which the same robot is stays open.
export function stayOpen() {
  const now = fleet.maps.find((m) => m.robots.includes(chart.opened)) ?? fleet.maps[0];
  if (chart.opened !== null && !now?.robots.includes(chart.opened)) chart.moved = false;
  openMap(now?.map ?? 0);
  version++;
}
export function goTo([x, y], scale = 40) {
  chart.view = { turn: 0, ...chart.view, x, y, scale: Math.max(chart.view?.scale ?? 0, scale) };
  chart.moved = true; chart.followed = false;
  redraw();
}
export function forgetTiles() { for (const { picture } of tiles.values()) picture?.close(); tiles.clear(); redraw(); }

// Turns the map so that most walls are level, or back.
export async function levelWalls() {
  chart.view.turn = chart.view.turn ? 0 : -(await json(`maps/${chart.index}/walls`)).direction_rad;
  fitAll();
}

// ---- Tiles ----

async function renew(kept, answer) {
  const tag = answer.headers.get("ETag");
  if (tag && tag === kept.tag) return answer.body?.cancel(); // most tiles stay as they are
  const picture = await createImageBitmap(await answer.blob());
  kept.picture?.close();
  Object.assign(kept, { picture: recoloured(picture), tag });
  picture.close();
}
// The newest picture of a tile that has come; a newer one is asked for once, and replaces it whatever happens meanwhile.
function tile(index, z, x, y) {
  const key = `${index}/${z}/${x}/${y}`, kept = tiles.get(key) ?? { picture: null, version: -1, isAsked: false };
  tiles.delete(key); tiles.set(key, kept); // the last one of all: those that are not drawn leave first
  if (kept.version < version && !kept.isAsked) {
    const asked = version;
    kept.isAsked = true;
    ask(`maps/${index}/tiles/${z}/${x}/${y}.png`).then((answer) => renew(kept, answer)).then(() => { kept.version = asked; })
      .catch((error) => {
        if (!report && !(error instanceof Refused)) return new Promise((done) => setTimeout(done, RETRY_MS));
        kept.version = asked; // a report has no more of them, and a refused token gets none
      })
      .finally(() => { kept.isAsked = false; redraw(); });
  }
  return kept.picture;
}

// Draws the tiles of a map that are in a view; returns their number.
function drawTiles(brush, index, { x, y, scale, turn }, w, h) {
  const map = fleet.maps.find((m) => m.map === index);
  if (!map?.extent) return 0;
  const z = Math.max(0, Math.min(map.zoom, Math.round(Math.log2(scale * WORLD_M / TILE_PX)))), side = WORLD_M / 2 ** z, [c, s] = cosSin(turn).map(Math.abs);
  const reach = [(c * w + s * h) / 2 / scale, (s * w + c * h) / 2 / scale], middleOf = [x, y];
  const low = [0, 1].map((k) => Math.floor(Math.max(middleOf[k] - reach[k], map.extent[k]) / side)), high = [0, 1].map((k) => Math.min(middleOf[k] + reach[k], map.extent[2 + k]));
  const seam = turn === 0 ? 0 : 0.7 / scale; // turned tiles overlap, or the ground shines through
  let drawn = 0;
  brush.save();
  brush.translate(w / 2, h / 2); brush.rotate(-turn); brush.scale(scale, scale); brush.translate(-x, y);
  brush.imageSmoothingEnabled = turn !== 0 || scale * side < 2 * TILE_PX;
  for (let u = low[0]; u * side < high[0]; u++)
    for (let v = low[1]; v * side < high[1]; v++) {
      drawn++;
      const picture = tile(index, z, u, v);
      if (picture) brush.drawImage(picture, u * side, -(v + 1) * side, side + seam, side + seam);
    }
  brush.restore();
  return drawn;
}

// ---- Layers ----

export const isShown = (layer) => at(`layer-${layer}`).checked && !at(`layer-${layer}`).parentElement.hidden;
const isInSpace = () => Boolean(fleet.maps.find((m) => m.map === chart.index)?.in_space);
export function redraw() { if (!queued) { queued = true; requestAnimationFrame(draw); } }

// A robot's path until the moment, in metres of the map: all of it, its last minutes, and its last pose. Poses nearer than a pixel are left out.
const ways = new Map();
function wayOf(name) {
  const all = fleet.trails.get(name), level = Math.ceil(Math.log2(chart.view.scale)), known = ways.get(name);
  if (known && known.all === all && known.until === fleet.until && known.level === level) return known;
  const way = { all, until: fleet.until, level, path: new Path2D(), recent: new Path2D(), last: undefined }, near = 2 ** -level;
  const newest = Math.min(fleet.until, all?.at(-1)?.[0] ?? 0);
  let drawn = null;
  for (const p of all ?? []) {
    if (p[0] > fleet.until) break;
    if (!drawn || Math.hypot(p[1] - drawn[1], p[2] - drawn[2]) >= near) {
      way.path.lineTo(p[1], p[2]);
      if (newest - p[0] < RECENT_S) way.recent.lineTo(p[1], p[2]);
      drawn = p;
    }
    way.last = p;
  }
  if (way.last) for (const path of [way.path, way.recent]) path.lineTo(way.last[1], way.last[2]);
  ways.set(name, way);
  return way;
}

// The accepted closures of a channel in the open map, until the moment.
const links = new Map();
function linksOf(channel) {
  const known = links.get(channel);
  if (known && known.all === fleet.accepted && known.until === fleet.until && known.map === chart.index) return known.path;
  const path = new Path2D();
  for (const c of fleet.accepted) if (c.channel === channel && c.map === chart.index && isPast(c)) { const [[x, y], [u, v]] = c.ends; path.moveTo(x, y); path.lineTo(u, v); }
  links.set(channel, { all: fleet.accepted, until: fleet.until, map: chart.index, path });
  return path;
}

// A path in metres of the map.
function strokeWay(path, colour, width, alpha = 1, fill = 0) {
  const { view } = chart, [c, s] = cosSin(view.turn), k = view.scale;
  pen.save();
  pen.translate(size.w / 2, size.h / 2); pen.transform(k * c, -k * s, -k * s, -k * c, 0, 0); pen.translate(-view.x, -view.y);
  pen.globalAlpha = alpha; pen.strokeStyle = colour; pen.lineWidth = width / k; pen.lineJoin = "round"; pen.stroke(path);
  if (fill) { pen.globalAlpha = fill; pen.fillStyle = colour; pen.fill(path, "evenodd"); }
  pen.restore();
}
export function outline(points, { colour = theme.accent, fill = 0, width = 2, dash = [], closed = true }) {
  pen.save();
  pen.beginPath();
  for (const point of points) pen.lineTo(...onScreen(point)); // the first one begins the way
  if (closed) pen.closePath();
  pen.strokeStyle = pen.fillStyle = colour; pen.lineWidth = width; pen.setLineDash(dash); pen.stroke();
  pen.globalAlpha = fill;
  if (fill) pen.fill();
  pen.restore();
}
export function label(text, [px, py], colour = theme.ink, size = 13) {
  pen.font = `600 ${size}px system-ui, sans-serif`; pen.textAlign = "center";
  pen.lineWidth = 4; pen.lineJoin = "round"; pen.strokeStyle = theme.surface; pen.strokeText(text, px, py);
  pen.fillStyle = colour; pen.fillText(text, px, py);
}
// Places the name of a robot above it, or below if another name is there.
let named = [];
function nameRobot(text, [px, py]) {
  const half = 4 * text.length, isTaken = (y) => named.some(([x, v, wide]) => Math.abs(x - px) < wide + half && Math.abs(v - y) < 15);
  const y = isTaken(py - 18) ? py + 28 : py - 18;
  named.push([px, y, half, text]);
}
export function dot(point, colour = theme.accent, radius = 5) {
  pen.beginPath(); pen.arc(...onScreen(point), radius, 0, 2 * Math.PI);
  pen.fillStyle = colour; pen.fill(); pen.strokeStyle = theme.surface; pen.lineWidth = 2; pen.stroke();
}

// Regions are tied to a keyscan, and are drawn where that is now. Each use has a look of its own.
function drawRegion({ use, name, session, stamp, polygon }) {
  const tied = robotNamed(session)?.map === chart.index && poseAt(session, stamp);
  if (!tied) return;
  const corners = polygon.map((corner) => movedPoint(tied, corner));
  const look = { area: ["area", 0.12, []], "keep-out": ["keepout", 0.25, []], erase: ["erase", 0, [6, 4]], free: ["free", 0, [2, 4]] }[use] ?? ["ink", 0, []];
  outline(corners, { colour: theme[look[0]], fill: look[1], dash: look[2] });
  const words = { "keep-out": "keep out", erase: "erased", free: "free" }[use] ?? name;
  if (words) label(words, onScreen(middle(corners)), theme[look[0]]);
}

function drawRobot(robot) {
  const colour = colourOf(robot.session), { path, recent, last } = wayOf(robot.session);
  if (!last) return;
  const isNow = fleet.until === Infinity, pose = isNow ? robot.T_map_base : last.slice(1), isChosen = robot.session === fleet.selected;
  if (isShown("paths")) {
    strokeWay(path, colour, 1.5, isChosen ? 0.9 : 0.4);
    strokeWay(recent, colour, isChosen ? 4 : 3);
    const since = fleet.since.get(robot.session) ?? [];
    if (isNow && since.length) outline(distance(last.slice(1), since[0]) < NEAR_M ? [last.slice(1), ...since] : since, { colour, width: 3, closed: false });
  }
  if (isEarlierDrive(robot)) return; // an earlier drive has a path and no robot
  if (robot.ended) { dot(pose, colour, isChosen ? 7 : 5); if (isShown("names")) nameRobot(robot.robot, onScreen(pose)); return; }
  if (isNow && fleet.scan?.session === robot.session && isShown("scan")) {
    pen.fillStyle = colour;
    for (const point of fleet.scan.points) { const [x, y] = onScreen(movedPoint(pose, point)); pen.fillRect(x - 1.5, y - 1.5, 3, 3); }
  }
  const [px, py] = onScreen(pose);
  pen.save();
  pen.translate(px, py); pen.rotate(-pose[2] - chart.view.turn);
  pen.beginPath(); pen.moveTo(14, 0); pen.lineTo(-9, 9); pen.lineTo(-5, 0); pen.lineTo(-9, -9); pen.closePath();
  pen.lineJoin = "round"; pen.lineWidth = isChosen ? 7 : 4; pen.strokeStyle = isChosen ? theme.accent : theme.surface; pen.stroke();
  pen.fillStyle = colour; pen.fill();
  pen.restore();
  if (isShown("names")) nameRobot(isInSpace() ? `${robot.robot}, z ${heightText((isNow ? robot.z_m : null) ?? last[4])}` : robot.robot, [px, py]);
}
const isEarlierDrive = (robot) => fleet.robots.some((r) => r.robot === robot.robot && r.epoch > robot.epoch);

function drawGrid() {
  const step = barMetres(), w = size.w, h = size.h, corners = [[0, 0], [w, 0], [0, h], [w, h]].map(onMap);
  const [low, high] = [Math.min, Math.max].map((pick) => [0, 1].map((k) => pick(...corners.map((corner) => corner[k]))));
  const path = new Path2D();
  for (let x = Math.ceil(low[0] / step) * step; x < high[0]; x += step) { path.moveTo(x, low[1]); path.lineTo(x, high[1]); }
  for (let y = Math.ceil(low[1] / step) * step; y < high[1]; y += step) { path.moveTo(low[0], y); path.lineTo(high[0], y); }
  strokeWay(path, theme.grid, 1, 0.5);
}

// What the service knows of a map besides its cells: shapes, which are read when their layer is switched on.
const LOOKS = { // colour, width of the line, filling
  quality: { good: ["free", 0.5, 0.15], bad: ["keepout", 0.5, 0.4] },
  plan: { plan: ["plan", 1.5, 0], missing: ["disappeared", 6, 0], new: ["appeared", 6, 0], moved: ["area", 6, 0] },
  changes: { appeared: ["appeared", 3, 1], disappeared: ["disappeared", 3, 1] },
  tags: { tag: ["camera", 2, 0.4] },
};
const shapes = new Map();
export function forgetShapes() { shapes.clear(); forgetHeights(); redraw(); }
// The newest ones that have come, as for tiles; an answer that comes after another mission was opened is dropped with its key.
function shapesOf(layer) {
  const path = `maps/${chart.index}/layers/${layer}`, key = `${fleet.mission}/${path}`, kept = shapes.get(key) ?? { found: [], version: -1, isAsked: false };
  shapes.set(key, kept);
  if (kept.version < version && !kept.isAsked) {
    const asked = version;
    kept.isAsked = true;
    json(path).then((found) => { Object.assign(kept, { found: found.map((one) => ({ ...one, path: new Path2D(one.path) })), version: asked, isAsked: false }); redraw(); })
      .catch((error) => {
        if (error instanceof Failed) { kept.found = []; at("message").textContent = error.message; }
        setTimeout(() => { kept.isAsked = false; }, RETRY_MS); // the next drawing after that asks again
      });
  }
  return kept.found;
}
function drawShapes(layer) {
  const found = shapesOf(layer);
  for (const { kind, path } of found) { const [colour, width, fill] = LOOKS[layer][kind]; strokeWay(path, theme[colour], width, 1, fill); }
  for (const { kind, text, x, y } of found) if (text) label(text, onScreen([x, y]), theme[LOOKS[layer][kind][0]]);
}
// The layers of the service that the open map has.
export function showLayers() {
  const known = fleet.maps.find((m) => m.map === chart.index)?.layers ?? [];
  for (const layer of Object.keys(LOOKS)) at(`layer-${layer}`).parentElement.hidden = !known.includes(layer);
  at("layer-heights").parentElement.hidden = !isInSpace();
}

function draw() {
  queued = false;
  const { w, h } = size, ratio = devicePixelRatio, { view } = chart;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) { canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio); if (!chart.moved && view) return fit(); }
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.fillStyle = theme.unknown; pen.fillRect(0, 0, w, h);
  if (!view) return;
  if (chart.followed && robotNamed(fleet.selected)?.T_map_base) [view.x, view.y] = robotNamed(fleet.selected).T_map_base;
  let drawn = drawTiles(pen, chart.index, view, w, h);
  if (chart.beside) {
    const { pose: [x, y, a], map } = chart.beside, c = Math.cos(a), s = Math.sin(a), dx = view.x - x, dy = view.y - y;
    pen.globalAlpha = 0.7; drawn += drawTiles(pen, map, { x: c * dx + s * dy, y: c * dy - s * dx, scale: view.scale, turn: view.turn + a }, w, h); pen.globalAlpha = 1;
  }
  // A tile in view stays, or each drawing would ask for it again.
  for (const [key, { picture }] of tiles) { if (tiles.size <= Math.max(MOST_TILES, drawn)) break; picture?.close(); tiles.delete(key); }
  if (isShown("heights")) drawHeights(pen, chart.index, view, w, h);
  else at("cut").hidden = true;
  for (const layer of Object.keys(LOOKS)) if (isShown(layer)) drawShapes(layer);
  if (isShown("grid")) drawGrid();
  if (isShown("closures")) for (const [channel, colour] of [["lidar", theme.laser], ["camera", theme.camera], ["tag", theme.free]]) strokeWay(linksOf(channel), colour, 1, 0.5);
  if (isShown("areas")) for (const region of fleet.regions) drawRegion(region);
  named = [];
  const chosen = fleet.selected, shown = fleet.robots.filter((r) => r.map === chart.index && r.T_map_base && !r.removed);
  for (const robot of shown.filter((r) => r.session !== chosen)) drawRobot(robot);
  for (const robot of shown.filter((r) => r.session === chosen)) drawRobot(robot); // on top
  for (const [x, y, , text] of named) label(text, [x, y]);
  if (chart.closure) {
    const ends = chart.closure.ends.filter((end, k) => end && robotNamed([chart.closure.robot_i, chart.closure.robot_j][k])?.map === chart.index);
    if (chart.closure.map === chart.index) outline(ends, { colour: theme.laser, width: 4, closed: false });
    for (const end of ends) dot(end, theme.laser, 7);
  }
  for (const mark of chart.marks) dot(mark, theme.alert, 7);
  chart.tool?.draw();
  showScale();
  chart.onView();
}

// The longest bar of 1, 2 or 5 times a power of ten metres that is short enough.
function barMetres() {
  const most = BAR_PX / chart.view.scale, power = 10 ** Math.floor(Math.log10(most));
  return power * [5, 2, 1].find((k) => k * power <= most);
}
function showScale() {
  const bar = barMetres();
  at("bar").style.width = `${bar * chart.view.scale}px`;
  const text = `${bar < 1 ? bar.toPrecision(1) : bar} m`;
  if (at("metres").textContent !== text) at("metres").textContent = text; // a new text lays the page out
}

// ---- What the pointer and the keys do ----

// The robot or else the accepted closure at a point of the canvas.
function hit(point) {
  const robot = fleet.robots.find((r) => r.map === chart.index && r.T_map_base && distance(onScreen(r.T_map_base), point) < 2 * CLICK_PX);
  if (robot) return chart.onRobot(robot.session);
  let best = CLICK_PX, found;
  if (isShown("closures"))
    for (const c of fleet.accepted) {
      if (c.map !== chart.index || !isPast(c)) continue;
      const [[ax, ay], [bx, by]] = c.ends.map(onScreen), [x, y] = point;
      const along = Math.max(0, Math.min(1, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2 || 1)));
      const off = Math.hypot(x - ax - along * (bx - ax), y - ay - along * (by - ay));
      if (off < best) { best = off; found = c; }
    }
  if (found) chart.onClosure(keyOf(found));
}

// Keeps the point of the canvas where it is.
export function zoom(factor, point = [size.w / 2, size.h / 2]) {
  const { view } = chart;
  if (!view) return;
  const widest = Math.sqrt(size.w * size.h / MOST_TILES) / WORLD_M; // so many tiles fill the canvas
  const held = onMap(point);
  view.scale = Math.max(Math.min(widest, view.scale), Math.min(2000, view.scale * factor));
  const off = onMap(point);
  view.x += held[0] - off[0]; view.y += held[1] - off[1];
  chart.moved = true;
  redraw();
}
function pan(dx, dy) {
  if (!chart.view) return;
  const [x, y] = onMap([size.w / 2 - dx, size.h / 2 - dy]);
  Object.assign(chart.view, { x, y });
  chart.moved = true; chart.followed = false;
  redraw();
}

const fingers = new Map(); // where they and the mouse are, by pointer
let pressed = null, isDragging = false;
canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(-e.deltaY / 500), [e.offsetX, e.offsetY]); }, { passive: false });
canvas.addEventListener("pointerdown", (e) => {
  canvas.setPointerCapture(e.pointerId);
  fingers.set(e.pointerId, [e.offsetX, e.offsetY]);
  pressed = fingers.size === 1 ? [e.offsetX, e.offsetY] : null;
  isDragging = false;
});
canvas.addEventListener("pointermove", (e) => {
  const old = fingers.get(e.pointerId), now = [e.offsetX, e.offsetY];
  if (chart.view) { const [x, y] = onMap(now); at("pointer").textContent = `x ${x.toFixed(2)} m, y ${y.toFixed(2)} m`; chart.tool?.hover?.([x, y]); }
  if (!old || !chart.view) return;
  const other = [...fingers].find(([id]) => id !== e.pointerId)?.[1];
  fingers.set(e.pointerId, now);
  isDragging ||= !pressed || distance(pressed, now) >= CLICK_PX;
  if (other) zoom(distance(now, other) / Math.max(1, distance(old, other)), other);
  else if (isDragging && chart.tool?.drag && pressed) chart.tool.drag(onMap(pressed), onMap(old), onMap(now));
  else pan(now[0] - old[0], now[1] - old[1]);
});
canvas.addEventListener("pointerup", (e) => {
  if (pressed && !isDragging && chart.view) { if (chart.tool) chart.tool.click(onMap([e.offsetX, e.offsetY])); else hit([e.offsetX, e.offsetY]); }
  else if (pressed && isDragging) chart.tool?.dropped?.();
});
for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => { fingers.delete(e.pointerId); pressed = null; });
canvas.addEventListener("keydown", (e) => {
  if (e.ctrlKey || e.altKey || e.metaKey) return; // shortcuts of the browser
  const keys = { ArrowLeft: () => pan(60, 0), ArrowRight: () => pan(-60, 0), ArrowUp: () => pan(0, 60), ArrowDown: () => pan(0, -60), "+": () => zoom(1.4), "=": () => zoom(1.4), "-": () => zoom(1 / 1.4), 0: fitAll };
  const press = chart.tool?.keys?.[e.key] ?? keys[e.key];
  if (press) { e.preventDefault(); press(); }
});
onHeights(redraw);
new ResizeObserver(() => { measure(); redraw(); }).observe(canvas);
