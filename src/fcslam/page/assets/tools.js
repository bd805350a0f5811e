// What is drawn with the pointer or the keys: measures, regions, a level line, and a map that is laid on another one.

import { fleet } from "./fleet.js";
import { area, between, compose, distance, length, middle, turned } from "./geometry.js";
import { canvas, chart, dot, label, onMap, onScreen, outline, redraw } from "./map.js";
import { ask, at } from "./service.js";
import { count, metres } from "./words.js";

const TURN_RAD = Math.PI / 36;
const BY_HAND = [0.5, 0.1]; // standard deviations of a pose that a person sees: metres, radians

// Each tool: what to do, how many points it needs, and what `Save` sends.
const TOOLS = {
  distance: { say: "Click the ends of what you measure.", least: 2, measure: (points) => metres(length(points)) },
  area: { say: "Click the corners, or drag a box.", least: 3, closed: true, measure: (points) => `${area(points).toFixed(1)} m², ${metres(length([...points, points[0]]))} around` },
  "name-area": { say: "Name it, then click its corners or drag a box.", least: 3, closed: true, use: "area" },
  "keep-out": { say: "Where must robots not enter? Click the corners, or drag a box.", least: 3, closed: true, use: "keep-out" },
  erase: { say: "What should become unknown? Click the corners, or drag a box.", least: 3, closed: true, use: "erase" },
  free: { say: "What is free? Click the corners, or drag a box.", least: 3, closed: true, use: "free" },
  level: { say: "Click two points along a wall. The map turns until that wall is level.", least: 2, most: 2, edit: levelled },
  join: { say: "Drag the faint map until its walls fit; the buttons or [ and ] turn it.", least: 0, edit: joined },
};
let active = null, points = [], pointer = null, isBox = false;

export function start(name) {
  if (active) stop();
  active = TOOLS[name];
  points = []; pointer = null; isBox = false;
  chart.tool = { click, hover, draw, drag: active.closed || name === "join" ? drag : null, dropped: showTool, keys: { Enter: save, Escape: stop, Backspace: back, " ": () => click(centre()), "[": () => spin(TURN_RAD), "]": () => spin(-TURN_RAD) } };
  if (name === "join") lay();
  at("area-name").hidden = name !== "name-area";
  at("area-name").value = "";
  for (const button of document.querySelectorAll("[data-turn]")) button.hidden = name !== "join";
  at("save").hidden = Boolean(active.measure);
  at("say").textContent = active.say;
  at("tool").hidden = false;
  for (const button of document.querySelectorAll("[data-tool]")) button.ariaPressed = String(button.dataset.tool === name);
  (name === "name-area" ? at("area-name") : canvas).focus();
  showTool();
}
export function stop() {
  active = chart.tool = null; points = [];
  if (chart.beside?.isLaid) chart.beside = null;
  at("tool").hidden = true;
  for (const button of document.querySelectorAll("[data-tool]")) button.ariaPressed = "false";
  redraw();
}
const centre = () => onMap([canvas.clientWidth / 2, canvas.clientHeight / 2]);
function click(point) { if (active.least === 0) return; if (isBox || points.length === active.most) points = []; isBox = false; points.push(point); showTool(); }
function hover(point) { pointer = point; if (points.length) redraw(); }
export function back() { points.pop(); showTool(); }

// A box along the screen; or the laid map moves with the pointer.
function drag(from, last, now) {
  if (chart.beside?.isLaid) { const { pose } = chart.beside; chart.beside.pose = [pose[0] + now[0] - last[0], pose[1] + now[1] - last[1], pose[2]]; }
  else { const [[ax, ay], [bx, by]] = [from, now].map(onScreen); points = [[ax, ay], [bx, ay], [bx, by], [ax, by]].map(onMap); isBox = true; }
  showTool();
}
// Turns the laid map around the middle of the screen.
export function spin(angle) {
  if (!chart.beside?.isLaid) return;
  const [x, y] = centre(), turn = compose([x, y, angle], between([x, y, 0], chart.beside.pose));
  chart.beside.pose = turn;
  redraw();
}

function draw() {
  const shown = pointer && points.length && !isBox && points.length !== active.most ? [...points, pointer] : points;
  if (shown.length > 1) outline(shown, { closed: Boolean(active.closed), fill: active.closed ? 0.15 : 0, width: 3 });
  for (const point of points) dot(point);
  if (active.measure && shown.length >= active.least) label(active.measure(shown), onScreen(active.closed ? middle(shown) : shown.at(-1)).map((v, k) => v - 14 * k), undefined, 16);
  if (document.activeElement === canvas && canvas.matches(":focus-visible")) dot(centre(), undefined, 3);
}
function showTool() {
  const enough = points.length >= active.least;
  at("save").disabled = !enough;
  at("measured").textContent = active.measure && enough ? active.measure(points) : points.length ? count(points.length, "point") : "";
  redraw();
}

// ---- Edits ----

// All poses of a map: session, stamp, pose.
const posesOf = (map) => fleet.robots.filter((r) => r.map === map && !r.removed).flatMap((r) => (fleet.trails.get(r.session) ?? []).map(([stamp, ...pose]) => [r.session, stamp, pose]));
const nearest = (poses, point) => poses.reduce((best, p) => (!best || distance(p[2], point) < distance(best[2], point) ? p : best), null);

function region(use) { // tied to the nearest scan, so that it moves with the map
  const [session, stamp, pose] = nearest(posesOf(chart.index), middle(points));
  return { kind: "region", content: { use, name: use === "area" ? at("area-name").value.trim() : "", session, stamp, polygon: points.map((p) => between(pose, [...p, 0]).slice(0, 2)) } };
}
function levelled() {
  const [[ax, ay], [bx, by]] = points, angle = Math.atan2(by - ay, bx - ax), level = turned(2 * angle) / 2; // the shorter way
  const [session, stamp, pose] = posesOf(chart.index)[0];
  return { kind: "placement", content: { session, stamp, pose: compose([0, 0, -level], pose) } };
}
function lay() {
  const other = fleet.maps.find((m) => m.map !== chart.index);
  if (!other) return;
  const [, , to] = nearest(posesOf(chart.index), centre()), [, , from] = posesOf(other.map)[0];
  chart.beside = { map: other.map, pose: [to[0] - from[0], to[1] - from[1], 0], isLaid: true };
}
// The two scans that come nearest to each other tell how the maps fit; the service then aligns their walls.
function joined() {
  const { map, pose } = chart.beside, theirs = posesOf(map).map(([session, stamp, at]) => [session, stamp, compose(pose, at)]);
  let best = null;
  for (const mine of posesOf(chart.index)) { const other = nearest(theirs, mine[2]), off = distance(other[2], mine[2]); if (!best || off < best.off) best = { off, mine, other }; }
  const [[robot_i, stamp_i, i], [robot_j, stamp_j, j]] = [best.mine, best.other];
  return { kind: "closure", content: { robot_i, stamp_i, robot_j, stamp_j, T_i_j: between(i, j), tolerance: BY_HAND } };
}

export async function save() {
  if (!active || active.measure || points.length < active.least) return;
  if (active.use === "area" && !at("area-name").value.trim()) { at("area-name").focus(); return tell("Give the area a name first."); }
  const edit = active.use ? region(active.use) : active.edit();
  stop();
  await change("edits", edit);
}
export const tell = (text) => { at("message").textContent = text; };
let changed = () => {};
export const onChange = (act) => { changed = act; };
export async function change(path, body) {
  try {
    const { number } = await (await ask(path, { method: "POST", body })).json();
    tell(body ? `Saved as edit ${number}; the map follows. You can take it back under Edits.` : "Taken back; the map follows.");
    await changed();
  } catch (error) { tell(error.message); }
}
