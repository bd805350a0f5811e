// The live map. Tokens go in a header and never in an address, which logs would keep: so events are read with fetch.
const API = "api/v1/", WORLD_M = 512, TILE_PX = 512, MOST_TILES = 48, RETRY_MS = 2000;
const LIVE_S = 15; // a robot that was heard so recently is live
const LISTED = 200; // closures in the list; the newest ones
const NEAR_M = 5; // closures with both ends so near each other see the same place
const LOOK_MS = 5000; // how often the page asks whether robots are still heard
const SILENT_MS = 15000; // the service says something every 5 s: after so long, the connection is dead
const MOST_CLOSURES = 5000; // that the page asks for
const BAR_PX = 120; // longest scale bar
const CLICK_PX = 8; // a click this near a closure selects it
// as in maps/palette.py
const COLOURS = ["#0072b2", "#e66100", "#009e73", "#7b4fb5", "#e0a800", "#56b4e9", "#8c564b", "#607d3b"];
const REGION = "#6a1b9a", CLOSURE = { lidar: "#c2185b", camera: "#3d1e8f" };
const at = (id) => document.getElementById(id);

// ---- What the service says ----

let token = sessionStorage.getItem("token") ?? "";
class Refused extends Error {}
class Failed extends Error { // the service answered, and says what is wrong
  constructor(message, status) { super(message); this.status = status; }
}

// A report holds the responses itself and asks nobody.
const report = at("responses") && JSON.parse(at("responses").textContent);
function reported(path) {
  if (path === "events") // nothing changes any more
    return new Response(new ReadableStream({ start: (stream) => stop.signal.addEventListener("abort", () => stream.error(new Error("ended"))) }));
  const { texts, pictures } = report;
  if (path in texts) return new Response(texts[path]);
  if (path in pictures) return new Response(Uint8Array.from(atob(pictures[path]), (c) => c.charCodeAt(0)));
  throw new Error(`${path}: not in this report`);
}

async function ask(path, { method = "GET", body } = {}) {
  const signal = method === "GET" ? stop.signal : undefined; // what nobody waits for any more must not wait for a dead connection
  if (report) return reported(path);
  const headers = { ...(token && { Authorization: `Bearer ${token}` }), ...(body && { "Content-Type": "application/json" }) };
  const answer = await fetch(API + path, { method, headers, body: body && JSON.stringify(body), signal });
  if (answer.ok) return answer;
  if (answer.status === 401 || (answer.status === 403 && method === "GET")) {
    at("login").hidden = false;
    throw new Refused("needs a token that is valid");
  }
  throw new Failed((await answer.json().catch(() => ({}))).error ?? `${path}: ${answer.status}`, answer.status);
}
const json = async (path) => (await ask(path)).json();

// ---- State ----

let version = 0; // of the map: the page counts its changes, of which an edit is one
let mission = null, release = null, readOnly = false, connected = false;
let robots = [], accepted = [], listed = [], selected = null, followed = null;
let trails = new Map(), maps = [], regions = [];
let until = Infinity; // the moment that paths and closures are shown of
const hidden = new Set(); // sessions whose paths are not drawn

// Paths grow, and older poses seldom move: the service sends what follows the bytes that the page has.
const received = new Map();
async function trail(name) {
  const path = `trajectories/${encodeURIComponent(name)}.tum`, known = received.get(name);
  const answer = await ask(known ? `${path}?after=${known.bytes}&digest=${known.digest}` : path);
  const text = await answer.text(), after = Number(answer.headers.get("Fcslam-After")), digest = answer.headers.get("Fcslam-Digest");
  const poses = text.split("\n").filter((l) => l && l[0] !== "#").map((l) => {
    const [stamp, x, y, , , , qz, qw] = l.split(" ").map(Number);
    return [stamp, x, y, 2 * Math.atan2(qz, qw)];
  });
  const all = after ? known.poses.concat(poses) : poses;
  if (digest) received.set(name, { bytes: after + text.length, digest, poses: all });
  return all;
}

// Where a robot was at a keyscan: x, y, heading in its map; undefined if nobody knows.
function pose(name, stamp) {
  const path = trails.get(name);
  if (!path?.length) return undefined;
  let low = 0, high = path.length - 1;
  while (low < high) { const middle = (low + high) >> 1; if (path[middle][0] < stamp - 1e-6) low = middle + 1; else high = middle; }
  return path[low].slice(1);
}

const mapOf = (name) => robots.find((r) => r.session === name)?.map;
const keyOf = (c) => [c.channel, c.robot_i, c.stamp_i, c.robot_j, c.stamp_j].map(encodeURIComponent).join("/");
const colours = new Map(); // a robot keeps its colour, whoever comes after it
const colourOf = (name) => { if (!colours.has(name)) colours.set(name, COLOURS[colours.size % COLOURS.length]); return colours.get(name); };

// The closure with both ends in the map; `map` is null if they are in different ones.
function placed(c, maps) {
  const map = maps.get(c.robot_i), ends = [pose(c.robot_i, c.stamp_i), pose(c.robot_j, c.stamp_j)];
  return { ...c, ends, map: map === maps.get(c.robot_j) && ends.every(Boolean) ? map ?? null : null };
}

// Another mission was opened: the page forgets what it knows of the one before.
function forget() {
  before = selected = followed = opened = view = null;
  until = Infinity; at("moment").value = at("moment").max; moved = false;
  for (const known of [received, hidden, tiles, colours, items]) known.clear();
  at("closure").hidden = true;
}

// One update at a time, and another one after it if something happened meanwhile: no answer overtakes a later one.
let updating = null, isOld = false;
function refresh() {
  isOld = true;
  updating ??= (async () => { try { while (isOld) { isOld = false; await update(); } } finally { updating = null; } })();
  return updating;
}

// Maps get other numbers when they join or part: the one in which the same robot is stays open.
function stayOpen() {
  const now = maps.find((m) => m.robots.includes(opened)) ?? maps[0];
  if (opened !== null && !now?.robots.includes(opened)) moved = false;
  mapIndex = now?.map ?? 0;
}

async function update() {
  const counts = await json("fleet");
  release ??= counts.version;
  if (counts.version !== release) { at("reload").hidden = false; throw new Error("The service has another version: reload the page."); }
  const [now, apart, fleet, closures, edits] = await Promise.all([json("maps"), json("separations"), json("robots"), json(`closures?status=accepted&limit=${MOST_CLOSURES}`), json("edits")]);
  if (mission !== null && counts.mission !== mission) forget();
  mission = counts.mission;
  const seen = fleet.filter((r) => r.T_map_base);
  const paths = await Promise.all(seen.map((r) => trail(r.session)));
  trails = new Map(seen.map((r, i) => [r.session, paths[i]]));
  maps = now;
  readOnly = counts.read_only; robots = fleet;
  for (const robot of robots) colourOf(robot.session);
  stayOpen();
  const of = new Map(fleet.map((r) => [r.session, r.map]));
  accepted = closures.map((c) => placed(c, of));
  document.title = `fcslam: ${counts.mission}`;
  for (const element of document.querySelectorAll(".live")) element.hidden = readOnly;
  regions = edits.filter((e) => e.kind === "region" && !e.undone_by).map((e) => e.content);
  showStatus(counts); showMaps(apart); showRobots(counts); showPairs(); showEdits(edits);
  tellChanges({ maps, robots, accepted, edits });
  await refreshClosures();
  if (at("learning").open) showLearning();
  const leader = robots.find((r) => r.session === followed);
  if (leader?.T_map_base && view) { openMap(leader.map); [view.x, view.y] = leader.T_map_base; }
  if (!moved && !followed) fit();
  redraw();
}

// ---- Panels; texts are set as text, because a name is never markup ----

function element(tag, text = "", more = {}) {
  const made = Object.assign(document.createElement(tag), more);
  made.append(text);
  return made;
}
function row(...cells) {
  const made = document.createElement("tr"), [first, ...others] = cells;
  made.append(element("th", first, { scope: "row" }), ...others.map((text) => element("td", text)));
  return made;
}

// Fills a list only if it changes, so that it stays open, scrolled and focused.
const filled = new WeakMap();
function fill(list, content, children) {
  const text = JSON.stringify(content);
  if (filled.get(list) === text) return;
  filled.set(list, text);
  list.replaceChildren(...children());
}

function showMaps(apart) {
  const label = (m) => `${m.map}${m.floor && `, floor ${m.floor}`}: ${m.robots.join(", ")}`;
  fill(at("maps"), maps.map(label), () => maps.map((m) => new Option(label(m), m.map)));
  at("previews").hidden = maps.length < 2;
  fill(at("previews"), maps.map(label), () => maps.map((m) => {
    const button = element("button", element("canvas", "", { width: 280, height: 200 }), { title: label(m) });
    button.dataset.map = m.map;
    button.append(`map ${m.map}`);
    button.addEventListener("click", () => choose(m.map));
    return button;
  }));
  openMap(mapIndex);
  at("separations").replaceChildren(...apart.map((s) => element("li", s.explanation)));
}

function stateOf(robot) {
  if (robot.removed) return "removed";
  const confirmed = robot.quality > 0 ? `, others confirm its pose (quality ${(100 * robot.quality).toFixed(0)} %)` : "";
  const where = robot.map === null ? "no map yet" : `map ${robot.map}${robot.floor && `, floor ${robot.floor}`}${confirmed}`;
  if (robots.some((r) => r.robot === robot.robot && r.epoch > robot.epoch)) return `${where}, ended: the robot was lost or started again`;
  if (readOnly) return where;
  if (robot.last_heard_s === null) return `${where}, not heard`;
  return `${where}, ${robot.last_heard_s < LIVE_S ? "live" : "offline"}, heard ${robot.last_heard_s.toFixed(0)} s ago`;
}

function showStatus({ worker_ready }) {
  at("status").textContent = readOnly ? "read-only" : worker_ready ? "live" : "the worker is starting; the map stays as it was";
}

// The list of robots changes every few seconds. Its elements stay, or a slow click would find another one below it.
const items = new Map();
function itemOf(name) {
  const item = element("li"), label = element("label"), swatch = element("span", "", { className: "swatch" });
  const box = element("input", "", { type: "checkbox", checked: true }), state = element("span"), more = element("span", "", { className: "small" });
  const button = element("button", "Follow", { ariaLabel: `Follow ${name}`, hidden: readOnly });
  box.addEventListener("change", () => { if (box.checked) hidden.delete(name); else hidden.add(name); redraw(); });
  button.addEventListener("click", () => { followed = followed === name ? null : name; refresh().catch(fail); });
  swatch.style.background = colourOf(name);
  label.append(box, swatch, state);
  item.append(label, " ", button, more);
  const made = { item, state, more, button };
  items.set(name, made);
  return made;
}

function showRobots({ metrics, packets, waiting, applied }) {
  at("load").textContent = `${packets} packets, ${packets - applied} not applied yet, ${waiting} waiting for an earlier one`;
  const list = at("robots"), shown = robots.map((robot) => {
    const name = robot.session, { item, state, more, button } = items.get(name) ?? itemOf(name);
    const bytes = robot.epoch ? 0 : metrics[`uplink_bytes_${robot.robot}`], detectors = Object.entries(robot.detectors).map(([channel, made]) => `${channel}: ${made}`);
    state.textContent = `${name}: ${stateOf(robot)}`;
    more.textContent = [`${robot.path_length_m.toFixed(0)} m`, `${robot.keyscans} keyscans`, ...(bytes ? [`${(bytes / 1000).toFixed(0)} kB sent in all`] : []), ...detectors].join(", ");
    button.ariaPressed = String(followed === name);
    return item;
  });
  if (shown.length !== list.children.length || shown.some((item, k) => item !== list.children[k])) list.replaceChildren(...shown);
}

function showPairs() {
  const counts = new Map();
  for (const c of accepted) { const pair = JSON.stringify([c.robot_i, c.robot_j].sort()); counts.set(pair, (counts.get(pair) ?? 0) + 1); }
  const sorted = [...counts].sort((a, b) => b[1] - a[1]).map(([pair, count]) => [JSON.parse(pair), count]);
  at("pairs").replaceChildren(...sorted.map(([pair, count]) => row(pair.join(" – "), String(count))));
  drawPairs(sorted);
}

// Robots in a circle, those of a map beside each other; a line is the wider, the more closures two robots share.
function drawPairs(counts) {
  const names = [...robots].filter((r) => r.map !== null).sort((a, b) => a.map - b.map).map((r) => r.session), places = new Map();
  names.forEach((name, k) => { const angle = 2 * Math.PI * k / names.length; places.set(name, [150 + 100 * Math.sin(angle), 110 - 80 * Math.cos(angle)]); });
  const drawn = [];
  for (const [[a, b], count] of counts) {
    if (a === b || !places.has(a) || !places.has(b)) continue;
    const [[x1, y1], [x2, y2]] = [places.get(a), places.get(b)];
    drawn.push(shape("line", { x1, y1, x2, y2, "stroke-width": 1 + Math.log2(count) }), shape("text", { x: (x1 + x2) / 2, y: (y1 + y2) / 2 }, count));
  }
  for (const [name, [cx, cy]] of places) drawn.push(shape("circle", { cx, cy, r: 7, fill: colourOf(name) }), shape("text", { x: cx, y: cy < 110 ? cy - 12 : cy + 22 }, `${name} (map ${mapOf(name)})`));
  at("graph").replaceChildren(...drawn);
}
function shape(tag, attributes, text = "") {
  const made = document.createElementNS(at("graph").namespaceURI, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(text);
  return made;
}

async function refreshClosures() {
  const state = at("state").value;
  const of = new Map(robots.map((r) => [r.session, r.map]));
  listed = state === "accepted" ? accepted : (await json(`closures?status=${state}&limit=${MOST_CLOSURES}`)).map((c) => placed(c, of));
  const newest = listed.slice(-LISTED).reverse();
  at("closures").textContent = `${listed.length === MOST_CLOSURES ? "the newest " : ""}${listed.length} ${state}, ${listed.filter((c) => c.robot_i !== c.robot_j).length} of them between robots${listed.length > LISTED ? `; the newest ${LISTED} are listed` : ""}`;
  const label = (c) => `${c.robot_i} – ${c.robot_j}, ${c.channel}, ${c.stamp_i.toFixed(1)} s – ${c.stamp_j.toFixed(1)} s`;
  fill(at("list"), newest.map(keyOf), () => newest.map((c) => new Option(label(c), keyOf(c))));
  if (selected) {
    const asked = selected;
    const now = report ? asked : await json(`closures/${keyOf(asked)}`).catch((error) => { if (error.status !== 404) throw error; });
    if (selected !== asked) return; // another one by now
    selected = now ? placed(now, of) : null;
    if (selected) showClosure();
    else { at("closure").hidden = true; at("message").textContent = "The selected closure is no longer there: one of its robots was removed."; }
  }
}

const turn = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));
function difference([x, y, a], [u, v, b]) { // of two poses: the second in the first
  const c = Math.cos(a), s = Math.sin(a);
  return [c * (u - x) + s * (v - y), c * (v - y) - s * (u - x), turn(b - a)];
}
const distance = (p, q) => Math.hypot(p[0] - q[0], p[1] - q[1]);

function supporting(c) {
  const close = (a, b) => a.every((end, k) => distance(end, b[k]) < NEAR_M);
  return accepted.filter((o) => o.map === c.map && keyOf(o) !== keyOf(c) &&
    ((o.robot_i === c.robot_i && o.robot_j === c.robot_j && close(o.ends, c.ends)) ||
     (o.robot_i === c.robot_j && o.robot_j === c.robot_i && close([o.ends[1], o.ends[0]], c.ends)))).length;
}

function showClosure() {
  const c = selected, rows = [
    ["Robots", `${c.robot_i} (blue) and ${c.robot_j} (orange)`],
    ["Keyscans", `${c.stamp_i.toFixed(2)} s and ${c.stamp_j.toFixed(2)} s`],
    ["Channel", c.channel], ["State", c.status], ["Reason", c.explanation], ["Similarity", c.similarity.toFixed(3)],
  ];
  if (c.map === null) rows.push(["Residual", "the ends are in different maps"]);
  else {
    const [dx, dy, angle] = difference(c.T_i_j, difference(c.ends[0], c.ends[1]));
    rows.push(["Residual", `${(1000 * Math.hypot(dx, dy)).toFixed(0)} mm, ${(Math.abs(angle) * 180 / Math.PI).toFixed(2)}°`], ["Supporting", `${supporting(c)} accepted closures with both ends within ${NEAR_M} m`]);
  }
  at("facts-of-closure").replaceChildren(...rows.map((cells) => row(...cells)));
  at("closure").hidden = false;
  at("list").value = keyOf(c);
}

async function select(closure) {
  selected = closure;
  showClosure();
  redraw();
  const overlay = at("overlay"), key = keyOf(closure);
  overlay.hidden = true;
  const picture = await ask(`closures/${key}.png`).then((a) => a.blob()).then(createImageBitmap).catch(() => null);
  if (!picture || keyOf(selected) !== key) return; // a run without scans has no picture
  overlay.getContext("2d").drawImage(picture, 0, 0);
  overlay.ariaLabel = `Walls that ${closure.robot_i} and ${closure.robot_j} saw, laid on each other`;
  overlay.hidden = false;
}

function showEdits(edits) {
  const text = (e) => `${e.number}: ${e.kind} ${e.kind === "undo" ? `of ${e.content.number}` : about(e.content)}; ${e.author}, ${new Date(1000 * e.time_s).toLocaleString()}`;
  fill(at("edits"), [readOnly, edits], () => edits.length ? edits.toReversed().map((e) => {
    const item = element("li", `${text(e)}${e.undone_by ? `, undone by ${e.undone_by}` : ""} `);
    if (!readOnly && !e.undone_by && e.kind !== "undo") {
      const button = element("button", "Undo", { ariaLabel: `Undo edit ${e.number}` });
      button.addEventListener("click", () => change(`edits/${e.number}/undo`));
      item.append(button);
    }
    return item;
  }) : [element("li", "none")]);
}
const about = (content) => [content.robot_i ?? content.session ?? content.robot, content.robot_j, content.use, content.name, ...(content.stamps ?? []).map((s) => `${s.toFixed(1)} s`)].filter(Boolean).join(" ");

async function change(path, body) {
  try {
    const { number, kind } = await (await ask(path, { method: "POST", body })).json();
    at("message").textContent = `Edit ${number} (${kind}) is stored; the map follows.`;
    showEdits(await json("edits"));
  } catch (error) { fail(error); }
}
const fail = (error) => { at("message").textContent = error.message; };

// ---- What happened since the page was opened ----

const MOST_EVENTS = 200;
let before = null;

function tellChanges(now) {
  if (before) {
    const known = new Map(before.robots.map((r) => [r.session, r])), still = new Set(now.accepted.map(keyOf));
    for (const robot of now.robots) {
      const was = known.get(robot.session);
      if (!was) tell(`${robot.session} begins${robot.epoch ? ", a session after a restart or after being lost" : ""}`);
      else if (was.map !== null && robot.map !== null && was.map !== robot.map) tell(`${robot.session} is in map ${robot.map} now`);
      else if (was.quality === 0 && robot.quality > 0) tell(`others confirm where ${robot.session} is`);
      for (const [channel, made] of Object.entries(robot.detectors)) if (was?.detectors[channel] && was.detectors[channel] !== made) tell(`${robot.session} has another ${channel} detector: ${made}`);
    }
    const were = (m) => new Set(m.robots.map((name) => known.get(name)?.map).filter((map) => map !== null && map !== undefined)).size;
    if (now.maps.some((m) => were(m) > 1)) tell(`maps joined, ${now.maps.length} left`);
    else if (now.maps.length !== before.maps.length && before.maps.length) tell(`maps now: ${now.maps.length}`);
    const lost = before.accepted.filter((c) => c.robot_i !== c.robot_j && !still.has(keyOf(c))).length;
    if (lost) tell(`closures between robots no longer accepted: ${lost}`);
    for (const edit of now.edits.slice(before.edits.length)) tell(`${edit.author}: ${edit.kind}`);
  }
  before = now;
}

function tell(text) {
  at("events").prepend(element("li", `${new Date().toLocaleTimeString()}: ${text}`));
  while (at("events").childElementCount > MOST_EVENTS) at("events").lastChild.remove();
}

async function facts() {
  const [metrics, config] = await Promise.all([json("metrics.json"), ask("config.yaml").then((a) => a.text())]);
  at("config").textContent = config;
  at("metrics").replaceChildren(...metrics.map(({ name, value, unit }) =>
    row(name.replaceAll("_", " "), value === null ? "–" : String(Number(value.toPrecision(4))), unit === "1" ? "" : unit)));
}

// Curves of losses, each over its largest value, and of measures; a dot is a round whose detector was released.
async function showLearning() {
  const rounds = await json("learning").catch(() => []);
  at("learned").textContent = rounds.length ? `${rounds.length} rounds, ${rounds.filter((r) => r.released).length} released` : "No training is connected: fcslam serve --learning FOLDER";
  const names = [...new Set(rounds.flatMap((r) => [...Object.keys(r.losses), ...Object.keys(r.measures)]))];
  const drawn = [], across = (k) => 5 + 290 * k / Math.max(1, rounds.length - 1);
  names.forEach((name, n) => {
    const values = rounds.map((r) => r.losses[name] ?? r.measures[name]), top = rounds[0].losses[name] === undefined ? 1 : Math.max(...values.filter((v) => v !== undefined)) || 1;
    const points = values.flatMap((v, k) => (v === undefined ? [] : [[across(k), 145 - 140 * v / top, rounds[k].released]])), colour = COLOURS[n % COLOURS.length];
    drawn.push(shape("polyline", { points: points.map(([x, y]) => `${x},${y}`).join(" "), fill: "none", stroke: colour }));
    for (const [cx, cy, released] of points) if (released) drawn.push(shape("circle", { cx, cy, r: 3, fill: colour }));
  });
  at("curves").replaceChildren(...drawn);
  at("legend").replaceChildren(...names.map((name, n) => {
    const swatch = element("span", "", { className: "swatch" }), item = element("li", swatch);
    swatch.style.background = COLOURS[n % COLOURS.length];
    item.append(rounds[0].losses[name] === undefined ? name.replaceAll("_", " ") : `${name}: loss, over its largest value`);
    return item;
  }));
  at("rounds").replaceChildren(...rounds.toReversed().map((r) => row(`${r.round}${r.released ? ", released" : ""}`, (r.measures.mma_3px ?? r.measures.revisit_recall)?.toFixed(3) ?? "–", r.robots.join(", "), [r.reason, r.left_out].filter(Boolean).join("; "))));
}

// ---- Map ----

const canvas = at("map"), pen = canvas.getContext("2d"), tiles = new Map();
let view = null, mapIndex = 0, queued = false, moved = false; // until the user moves the map, all of it is shown
let opened = null; // a robot of the open map

// The view of a whole map, or of its paths while it has no cells; undefined if there are none.
function whole(index, width, height) {
  const extent = maps.find((m) => m.map === index)?.extent;
  const low = extent ? extent.slice(0, 2) : [Infinity, Infinity], high = extent ? extent.slice(2) : [-Infinity, -Infinity];
  if (!extent) for (const robot of robots) for (const p of robot.map === index ? trails.get(robot.session) ?? [] : [])
    for (const k of [0, 1]) { low[k] = Math.min(low[k], p[1 + k]); high[k] = Math.max(high[k], p[1 + k]); }
  if (low[0] > high[0]) return undefined;
  const scale = Math.min(width / (high[0] - low[0] + 2), height / (high[1] - low[1] + 2));
  return { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, scale };
}
function fit() { view = whole(mapIndex, canvas.clientWidth, canvas.clientHeight) ?? view; }
function openMap(index) {
  mapIndex = index;
  opened = maps.find((m) => m.map === index)?.robots[0] ?? null;
  at("maps").value = index;
  for (const button of at("previews").children) button.ariaPressed = String(Number(button.dataset.map) === index);
}
function choose(index) { openMap(index); moved = false; followed = null; fit(); redraw(); }

// The path of a robot until the moment, in metres of the map, and its last pose. Poses nearer than a pixel are left out.
const ways = new Map();
function wayOf(name) {
  const all = trails.get(name), level = Math.ceil(Math.log2(view.scale)), known = ways.get(name);
  if (known && known.all === all && known.until === until && known.level === level) return known;
  const way = { all, until, level, path: new Path2D(), last: undefined }, near = 2 ** -level;
  let drawn = null;
  for (const p of all ?? []) {
    if (p[0] > until) break;
    if (!drawn || Math.hypot(p[1] - drawn[1], p[2] - drawn[2]) >= near) { way.path.lineTo(p[1], p[2]); drawn = p; }
    way.last = p;
  }
  if (way.last) way.path.lineTo(way.last[1], way.last[2]);
  ways.set(name, way);
  return way;
}
// Whether a closure was possible until the moment.
const isPast = (c) => Math.max(c.stamp_i, c.stamp_j) <= until;

// metres to pixels of the canvas
const onScreen = (x, y) => [canvas.clientWidth / 2 + (x - view.x) * view.scale, canvas.clientHeight / 2 - (y - view.y) * view.scale];

// The accepted closures of a channel in the open map, until the moment.
const links = new Map();
function linksOf(channel) {
  const known = links.get(channel);
  if (known && known.all === accepted && known.until === until && known.map === mapIndex) return known.path;
  const path = new Path2D();
  for (const c of accepted) if (c.channel === channel && c.map === mapIndex && isPast(c)) { const [[x, y], [u, v]] = c.ends; path.moveTo(x, y); path.lineTo(u, v); }
  links.set(channel, { all: accepted, until, map: mapIndex, path });
  return path;
}

// The newest picture of a tile that has come; a newer one is asked for once, and replaces it whatever happens meanwhile.
function tile(index, z, x, y) {
  const key = `${index}/${z}/${x}/${y}`;
  const kept = tiles.get(key) ?? { picture: null, version: -1, isAsked: false };
  tiles.delete(key); tiles.set(key, kept); // the last one of all: those that are not drawn leave first
  if (kept.version < version && !kept.isAsked) {
    const asked = version;
    kept.isAsked = true;
    ask(`maps/${index}/tiles/${z}/${x}/${y}.png`).then((a) => a.blob()).then(createImageBitmap)
      .then((picture) => { kept.picture?.close(); kept.picture = picture; kept.version = asked; })
      .catch((error) => {
        if (!report && !(error instanceof Refused)) return new Promise((done) => setTimeout(done, RETRY_MS));
        kept.version = asked; // a report has no more of them, and a refused token gets none
      })
      .finally(() => { kept.isAsked = false; redraw(); });
  }
  return kept.picture;
}

// Draws the tiles of a map that are in a view; returns their number.
function drawTiles(pen, index, { x, y, scale }, w, h) {
  const map = maps.find((m) => m.map === index);
  if (!map?.extent) return 0;
  const z = Math.max(0, Math.min(map.zoom, Math.round(Math.log2(scale * WORLD_M / TILE_PX)))), side = WORLD_M / 2 ** z;
  const seen = [x - w / 2 / scale, y - h / 2 / scale, x + w / 2 / scale, y + h / 2 / scale];
  const low = [0, 1].map((k) => Math.floor(Math.max(seen[k], map.extent[k]) / side)), high = [2, 3].map((k) => Math.min(seen[k], map.extent[k]));
  let drawn = 0;
  for (let u = low[0]; u * side < high[0]; u++)
    for (let v = low[1]; v * side < high[1]; v++) {
      drawn++;
      const picture = tile(index, z, u, v);
      if (picture) pen.drawImage(picture, w / 2 + (u * side - x) * scale, h / 2 - ((v + 1) * side - y) * scale, side * scale, side * scale);
    }
  return drawn;
}

// Small pictures of all maps, if there are several; returns the number of their tiles.
function drawPreviews() {
  let drawn = 0;
  if (!at("previews").hidden) for (const button of at("previews").children) {
    const small = button.firstChild, brush = small.getContext("2d"), index = Number(button.dataset.map), all = whole(index, small.width, small.height);
    brush.clearRect(0, 0, small.width, small.height);
    if (all) drawn += drawTiles(brush, index, all, small.width, small.height);
  }
  return drawn;
}

function redraw() { if (!queued) { queued = true; requestAnimationFrame(draw); } }

function draw() {
  queued = false;
  const w = canvas.clientWidth, h = canvas.clientHeight, ratio = devicePixelRatio;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) { canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio); }
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, w, h);
  if (!view) return;
  const drawn = drawPreviews() + drawTiles(pen, mapIndex, view, w, h);
  // A tile in view stays, or each drawing would ask for it again.
  for (const key of tiles.keys()) { if (tiles.size <= Math.max(MOST_TILES, drawn)) break; tiles.delete(key); }
  pen.globalAlpha = 0.4;
  if (at("shown").checked) for (const channel of Object.keys(CLOSURE)) strokeWay(linksOf(channel), CLOSURE[channel], 1);
  pen.globalAlpha = 1;
  for (const robot of robots) {
    if (robot.map !== mapIndex || !robot.T_map_base || hidden.has(robot.session)) continue;
    const colour = colourOf(robot.session), { path, last } = wayOf(robot.session);
    if (!last) continue;
    const [x, y, heading] = until === Infinity ? robot.T_map_base : last.slice(1), [px, py] = onScreen(x, y);
    strokeWay(path, colour, 2);
    pen.save(); pen.translate(px, py); pen.rotate(-heading); pen.fillStyle = colour;
    pen.beginPath(); pen.moveTo(11, 0); pen.lineTo(-7, 6); pen.lineTo(-7, -6); pen.fill(); pen.restore();
  }
  for (const region of regions) drawRegion(region);
  if (selected) drawSelected();
  showScale();
}

// The longest bar of 1, 2 or 5 times a power of ten metres that is short enough.
function showScale() {
  const most = BAR_PX / view.scale, power = 10 ** Math.floor(Math.log10(most)), metres = power * [5, 2, 1].find((k) => k * power <= most);
  at("bar").style.width = `${metres * view.scale}px`;
  at("metres").textContent = `${metres < 1 ? metres.toPrecision(1) : metres} m`;
}

// Areas and keep-out regions are drawn where the keyscan that they are tied to is now.
function drawRegion({ use, name, session, stamp, polygon }) {
  const tied = mapOf(session) === mapIndex && pose(session, stamp);
  if (!tied) return;
  const [x, y, heading] = tied, c = Math.cos(heading), s = Math.sin(heading);
  const corners = polygon.map(([u, v]) => [x + c * u - s * v, y + s * u + c * v]);
  lines([[...corners, corners[0]]], REGION, 2);
  pen.globalAlpha = 0.15; pen.fillStyle = REGION; pen.fill();
  pen.globalAlpha = 1; pen.font = "14px system-ui, sans-serif"; pen.textAlign = "center";
  const [px, py] = onScreen(...[0, 1].map((k) => corners.reduce((sum, corner) => sum + corner[k], 0) / corners.length));
  pen.fillText(name || use, px, py);
}

function lines(ways, colour, width = 2) {
  pen.strokeStyle = colour; pen.lineWidth = width; pen.beginPath();
  for (const way of ways) way.forEach(([x, y], k) => (k ? pen.lineTo(...onScreen(x, y)) : pen.moveTo(...onScreen(x, y))));
  pen.stroke();
}

// A path in metres of the map.
function strokeWay(path, colour, width) {
  const [px, py] = onScreen(0, 0);
  pen.save(); pen.translate(px, py); pen.scale(view.scale, -view.scale);
  pen.strokeStyle = colour; pen.lineWidth = width / view.scale; pen.stroke(path); pen.restore();
}

function drawSelected() {
  const here = [selected.robot_i, selected.robot_j].map((name, k) => mapOf(name) === mapIndex && selected.ends[k]);
  if (selected.map === mapIndex) lines([selected.ends], "#c2185b", 4);
  for (const end of here.filter(Boolean)) { pen.strokeStyle = "#c2185b"; pen.lineWidth = 3; pen.beginPath(); pen.arc(...onScreen(end[0], end[1]), 7, 0, 2 * Math.PI); pen.stroke(); }
}

// The accepted closure at a point of the canvas.
function closureAt(x, y) {
  if (!view || !at("shown").checked) return undefined;
  let best = CLICK_PX, found;
  for (const c of accepted) {
    if (c.map !== mapIndex || !isPast(c)) continue;
    const [[ax, ay], [bx, by]] = c.ends.map((end) => onScreen(end[0], end[1]));
    const along = Math.max(0, Math.min(1, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2 || 1)));
    const off = Math.hypot(x - ax - along * (bx - ax), y - ay - along * (by - ay));
    if (off < best) { best = off; found = c; }
  }
  return found;
}

// Keeps the point of the canvas where it is.
function zoom(factor, x = canvas.clientWidth / 2, y = canvas.clientHeight / 2) {
  if (!view) return;
  const widest = Math.sqrt(canvas.clientWidth * canvas.clientHeight / MOST_TILES) / WORLD_M; // so many tiles fill the canvas
  const scale = Math.max(Math.min(widest, view.scale), Math.min(2000, view.scale * factor)), shift = 1 / view.scale - 1 / scale;
  moved = true;
  view = { x: view.x + (x - canvas.clientWidth / 2) * shift, y: view.y - (y - canvas.clientHeight / 2) * shift, scale };
  redraw();
}
function pan(dx, dy) { if (view) { moved = true; followed = null; view.x -= dx / view.scale; view.y += dy / view.scale; redraw(); } }

// ---- What the user does ----

const fingers = new Map(); // where they and the mouse are, by pointer
let pressed = null;
canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(-e.deltaY / 500), e.offsetX, e.offsetY); }, { passive: false });
canvas.addEventListener("pointerdown", (e) => {
  canvas.setPointerCapture(e.pointerId);
  fingers.set(e.pointerId, [e.offsetX, e.offsetY]);
  pressed = fingers.size === 1 ? [e.offsetX, e.offsetY] : null;
});
canvas.addEventListener("pointermove", (e) => {
  const old = fingers.get(e.pointerId), now = [e.offsetX, e.offsetY];
  if (view) at("pointer").textContent = `x ${(view.x + (now[0] - canvas.clientWidth / 2) / view.scale).toFixed(2)} m, y ${(view.y - (now[1] - canvas.clientHeight / 2) / view.scale).toFixed(2)} m`;
  if (!old) return;
  const other = [...fingers].find(([id]) => id !== e.pointerId)?.[1];
  fingers.set(e.pointerId, now);
  if (other) zoom(distance(now, other) / Math.max(1, distance(old, other)), ...other);
  else pan(now[0] - old[0], now[1] - old[1]);
});
canvas.addEventListener("pointerup", (e) => {
  const closure = pressed && distance(pressed, [e.offsetX, e.offsetY]) < CLICK_PX && closureAt(e.offsetX, e.offsetY);
  if (closure) select(closure);
});
for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => { fingers.delete(e.pointerId); pressed = null; });
canvas.addEventListener("keydown", (e) => {
  if (e.ctrlKey || e.altKey || e.metaKey) return; // shortcuts of the browser
  const keys = { ArrowLeft: () => pan(60, 0), ArrowRight: () => pan(-60, 0), ArrowUp: () => pan(0, 60), ArrowDown: () => pan(0, -60), "+": () => zoom(1.4), "=": () => zoom(1.4), "-": () => zoom(1 / 1.4), 0: () => { moved = false; fit(); redraw(); } };
  if (keys[e.key]) { e.preventDefault(); keys[e.key](); }
});
at("maps").addEventListener("change", (e) => choose(Number(e.target.value)));
// Each step of the slider passes equally many keyscans: robots may drive days apart.
at("moment").addEventListener("input", (e) => {
  const stamps = [...trails.values()].flatMap((path) => path.map((p) => p[0])).sort((a, b) => a - b), share = e.target.value / e.target.max;
  const count = Math.ceil(share * stamps.length);
  until = share === 1 || !stamps.length ? Infinity : stamps[Math.max(0, count - 1)];
  e.target.ariaValueText = until === Infinity ? "now" : `${until.toFixed(1)} s`;
  at("until").textContent = until === Infinity ? "Paths and closures are those of now." : `Until ${until.toFixed(1)} s: ${count} of ${stamps.length} keyscans, ${accepted.filter(isPast).length} of ${accepted.length} closures.`;
  redraw();
});
at("shown").addEventListener("change", redraw);
at("state").addEventListener("change", () => refreshClosures().catch(fail));
at("list").addEventListener("change", (e) => select(listed.find((c) => keyOf(c) === e.target.value)));
const named = () => ({ robot_i: selected.robot_i, robot_j: selected.robot_j, stamps: [selected.stamp_i, selected.stamp_j] });
for (const kind of ["veto", "pin"]) at(kind).addEventListener("click", () => change("edits", { kind, content: named() }));
at("reload").addEventListener("click", () => location.reload());
at("facts").addEventListener("toggle", () => { if (at("facts").open) facts().catch(() => {}); });
at("learning").addEventListener("toggle", () => { if (at("learning").open) showLearning(); });
at("login").addEventListener("submit", (e) => {
  e.preventDefault();
  token = at("token").value; sessionStorage.setItem("token", token);
  at("login").hidden = true; at("message").textContent = "";
  follow();
});
new ResizeObserver(redraw).observe(canvas);

// Silence is no event.
let isLooking = false;
setInterval(async () => {
  if (readOnly || document.hidden || !robots.length || !connected || isLooking) return;
  isLooking = true;
  try {
    const [counts, fleet] = await Promise.all([json("fleet"), json("robots")]);
    const heard = new Map(fleet.map((r) => [r.session, r.last_heard_s]));
    for (const robot of robots) robot.last_heard_s = heard.get(robot.session) ?? null;
    if (connected) { showStatus(counts); showRobots(counts); }
  } catch { /* the stream of events says so */ }
  isLooking = false;
}, LOOK_MS);

let attempt = 0, stop = new AbortController(); // a new attempt ends those before it
async function follow() {
  stop.abort();
  const mine = ++attempt, ended = stop = new AbortController();
  let fault = null, silence;
  const heard = () => { clearTimeout(silence); silence = setTimeout(() => ended.abort(), SILENT_MS); };
  const changed = () => {
    version++;
    refresh().then(() => { connected = mine === attempt; }, (error) => { fault = error; ended.abort(); });
  };
  try {
    if (!report) heard();
    const reader = (await ask("events")).body.pipeThrough(new TextDecoderStream()).getReader();
    changed(); // what is there already; events tell of changes only
    let rest = "";
    for (;;) {
      const { value, done } = await reader.read();
      if (done) throw new Error("the stream ended");
      if (!report) heard();
      const parts = (rest + value).split("\n\n");
      rest = parts.pop();
      if (parts.some((p) => p.startsWith("event: live"))) changed();
    }
  } catch (error) {
    if (mine !== attempt) return;
    connected = false;
    const reason = fault ?? error;
    if (reason instanceof Refused || !at("reload").hidden) at("status").textContent = reason.message;
    else {
      at("status").textContent = `${reason instanceof Failed ? reason.message : "no connection"}; trying again`;
      setTimeout(() => { if (mine === attempt) follow(); }, RETRY_MS);
    }
  } finally {
    clearTimeout(silence);
    ended.abort(); // a browser opens six connections to a host, and each stream holds one
  }
}
// So a hidden page has no stream.
if (!report) document.addEventListener("visibilitychange", () => {
  if (!document.hidden) follow();
  else { attempt++; connected = false; stop.abort(); }
});
follow();
