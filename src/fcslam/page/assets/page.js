// The page: it follows the service, and hands what is new to the map and to the panels.

import { readAddress, showFiles, writeAddress } from "./files.js";
import { fleet, look, robotNamed, update } from "./fleet.js";
import { chart, fit, fitAll, forgetShapes, levelWalls, openMap, readTheme, redraw, stayOpen, zoom } from "./map.js";
import {
  decide, forgetCards, locate, pickOnMap, refreshEvidence, select, show, showAge, showAttention, showControls, showEdits, showEvidence, showFacts,
  showFleet, showHistory, showLearning, showMaps, showRobot, slide,
} from "./panels.js";
import { at, follow, json, link, pause, report } from "./service.js";
import { onChange, save, spin, start, stop, tell } from "./tools.js";

const LOOK_MS = 1000; // how often the page asks where the robots are
const TURN_RAD = Math.PI / 36;

// Another mission was opened: the page forgets what it knows of the one before.
function forget() {
  stop();
  Object.assign(fleet, { selected: null, scan: null, until: Infinity, trails: new Map(), since: new Map(), samples: new Map() });
  Object.assign(chart, { opened: null, view: null, moved: false, followed: false, closure: null, beside: null });
  at("moment").value = at("moment").max;
  at("closure").hidden = true;
  forgetCards(); forgetShapes();
}

let asked = readAddress(); // the view of the address, until the map is there
function openAsked() {
  if (!asked || !fleet.maps.length) return;
  const map = fleet.maps.find((m) => m.robots.includes(asked.map));
  if (map) openMap(map.map);
  if (robotNamed(asked.robot)) fleet.selected = asked.robot;
  if (asked.place) { const [x, y, scale, turn] = asked.place; Object.assign(chart, { view: { x, y, scale, turn }, moved: true }); }
  asked = null;
}

function showAll() {
  document.title = `fcslam: ${fleet.mission}`;
  at("mission").textContent = fleet.mission;
  showMaps(); showAge(); showFleet(); showAttention(); showControls(); showHistory(); showEdits(); showFiles();
}
async function read() {
  await update(forget);
  link.connected = true;
  stayOpen();
  openAsked();
  if (!chart.moved) fit();
  showAll();
  await refreshEvidence();
  if (at("learning").hidden || at("learning").open) await showLearning();
  redraw();
}
// One update at a time, and another one after it if something happened meanwhile: no answer overtakes a later one.
let updating = null, isOld = false;
function refresh() {
  isOld = true;
  updating ??= (async () => { try { while (isOld) { isOld = false; await read(); } } finally { updating = null; } })();
  return updating;
}
const say = (text) => { at("status").textContent = text; at("status").dataset.kind = "alert"; };
const open = () => follow(refresh, say);

// ---- What the user does ----

for (const tab of document.querySelectorAll("nav button")) tab.addEventListener("click", () => show(tab.dataset.view));
for (const tool of document.querySelectorAll("[data-tool]"))
  tool.addEventListener("click", () => {
    if (tool.ariaPressed === "true") return stop();
    if (matchMedia("(max-width: 700px)").matches) show("map");
    start(tool.dataset.tool);
  });
for (const turn of document.querySelectorAll("[data-turn]")) turn.addEventListener("click", () => spin(turn.dataset.turn * TURN_RAD));
const acts = {
  "zoom-in": () => zoom(1.4), "zoom-out": () => zoom(1 / 1.4), fit: fitAll, save, cancel: stop, veto: () => decide("veto"), pin: () => decide("pin"), locate,
  level: () => levelWalls().then(showControls, (error) => tell(error.message)),
  follow: () => { chart.followed = !chart.followed; if (chart.followed) { showRobot(fleet.selected); chart.followed = true; } showControls(); },
  reload: () => location.reload(),
};
for (const [id, act] of Object.entries(acts)) at(id).addEventListener("click", act);
for (const layer of document.querySelectorAll("#layers input")) layer.addEventListener("change", redraw);
for (const id of ["decision", "of-robot", "two-robots"]) at(id).addEventListener("change", () => showEvidence().catch((error) => tell(error.message)));
at("moment").addEventListener("input", slide);
at("facts").addEventListener("toggle", () => { if (at("facts").open) showFacts().catch(() => {}); });
at("learning").addEventListener("toggle", () => { if (at("learning").open) showLearning(); });
at("area-name").addEventListener("keydown", (e) => { if (e.key === "Enter") save(); if (e.key === "Escape") stop(); });
at("login").addEventListener("submit", (e) => {
  e.preventDefault();
  link.token = at("token").value;
  sessionStorage.setItem("token", link.token);
  at("login").hidden = true; tell("");
  open();
});
document.addEventListener("keydown", (e) => { if (e.key === "Escape" && !at("tool").hidden) stop(); });
chart.onRobot = select;
chart.onClosure = pickOnMap;
chart.onView = writeAddress;
onChange(async () => { fleet.edits = await json("edits"); showEdits(); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", readTheme);

// Silence is no event, and robots move while the next map is drawn.
let isLooking = false;
setInterval(async () => {
  showAge();
  if (fleet.readOnly || document.hidden || !fleet.robots.length || !link.connected || isLooking) return;
  isLooking = true;
  try {
    await look();
    if (link.connected) { showAge(); showFleet(); showAttention(); redraw(); }
  } catch { /* the stream of events says so */ }
  isLooking = false;
}, LOOK_MS);

// A hidden page has no stream.
if (!report) document.addEventListener("visibilitychange", () => { if (document.hidden) pause(); else open(); });
readTheme();
show(asked.view && at(`view-${asked.view}`) ? asked.view : asked.view === "map" ? "map" : "fleet");  // with the verdict
open();
