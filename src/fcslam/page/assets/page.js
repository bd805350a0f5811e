// The live map. Tokens go in a header and never in an address, which logs would keep: so events are read with fetch.
const API = "api/v1/", WORLD_M = 256, TILE_PX = 256, MOST_TILES = 400, RETRY_MS = 2000;
// as in maps/palette.py
const COLOURS = ["#0072b2", "#e66100", "#009e73", "#7b4fb5", "#e0a800", "#56b4e9", "#8c564b", "#607d3b"];
const CLOSURE = { lidar: "#c2185b", camera: "#3d1e8f" };
const at = (id) => document.getElementById(id);
const canvas = at("map"), pen = canvas.getContext("2d");
const tiles = new Map();
let token = sessionStorage.getItem("token") ?? "";
let view = null, mapIndex = 0, version = 0, robots = [], closures = [], trails = new Map(), zooms = new Map(), queued = false, readOnly = false;
const hidden = new Set(); // sessions whose paths are not drawn

class Refused extends Error {}

// A report holds the responses itself and asks nobody.
const report = at("responses") && JSON.parse(at("responses").textContent);
function reported(path) {
  if (path === "events") return new Response(new ReadableStream()); // nothing changes any more
  const { texts, pictures } = report;
  if (path in texts) return new Response(texts[path]);
  if (path in pictures) return new Response(Uint8Array.from(atob(pictures[path]), (c) => c.charCodeAt(0)));
  throw new Error(`${path}: not in this report`);
}

async function ask(path, more = {}) {
  if (report) return reported(path);
  const answer = await fetch(API + path, { ...more, headers: token ? { Authorization: `Bearer ${token}` } : {} });
  if (answer.status === 401 || answer.status === 403) { at("login").hidden = false; throw new Refused("needs the token of a viewer"); }
  if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
  return answer;
}
const json = async (path) => (await ask(path)).json();

async function trail(name) {
  const lines = (await (await ask(`trajectories/${encodeURIComponent(name)}.tum`)).text()).split("\n");
  return lines.filter((l) => l && l[0] !== "#").map((l) => l.split(" ").map(Number));
}

async function update(number) {
  const [counts, maps, fleet, accepted] = await Promise.all([json("fleet"), json("maps"), json("robots"), json("closures?status=accepted&limit=5000")]);
  const seen = fleet.filter((r) => r.T_map_base);
  const paths = await Promise.all(seen.map((r) => trail(r.session)));
  trails = new Map(seen.map((r, i) => [r.session, paths[i]]));
  zooms = new Map(maps.map((m) => [m.map, m.zoom]));
  readOnly = counts.read_only; robots = fleet; closures = accepted;
  document.title = `fcslam: ${counts.mission}`;
  if (number !== version) { version = number; tiles.clear(); }
  at("maps").replaceChildren(...maps.map((m) => new Option(`${m.map}${m.floor && `, floor ${m.floor}`}: ${m.robots.join(", ")}`, m.map, false, m.map === mapIndex)));
  at("robots").replaceChildren(...fleet.map(describe));
  at("closures").textContent = `${accepted.filter((c) => c.robot_i !== c.robot_j).length} between robots, ${accepted.filter((c) => c.robot_i === c.robot_j).length} within`;
  if (!view && trails.size) fit();
  redraw();
}

function describe(robot, i) {
  const item = document.createElement("li"), label = document.createElement("label"), box = document.createElement("input");
  const heard = readOnly ? "" : robot.last_heard_s === null ? ", not heard" : `, heard ${robot.last_heard_s.toFixed(0)} s ago`;
  box.type = "checkbox"; box.checked = !hidden.has(robot.session);
  box.addEventListener("change", () => { if (box.checked) hidden.delete(robot.session); else hidden.add(robot.session); redraw(); });
  label.append(box, ` ${robot.session}: ${robot.map === null ? "no map yet" : `map ${robot.map}`}, ${robot.path_length_m.toFixed(0)} m${heard}`); // text: a name is never markup
  label.style.color = COLOURS[i % COLOURS.length];
  item.append(label);
  return item;
}

async function facts() {
  const [metrics, config] = await Promise.all([json("metrics.json"), ask("config.yaml").then((a) => a.text())]);
  at("config").textContent = config;
  at("metrics").replaceChildren(...metrics.map(({ name, value, unit }) => {
    const row = document.createElement("tr");
    for (const text of [name.replaceAll("_", " "), value === null ? "–" : String(Number(value.toPrecision(4))), unit === "1" ? "" : unit]) row.insertCell().textContent = text;
    return row;
  }));
}

function fit() {
  const points = robots.filter((r) => r.map === mapIndex).flatMap((r) => trails.get(r.session) ?? []);
  if (!points.length) return;
  const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  for (const p of points) for (const k of [0, 1]) { low[k] = Math.min(low[k], p[1 + k]); high[k] = Math.max(high[k], p[1 + k]); }
  const scale = Math.min(canvas.clientWidth / (high[0] - low[0] + 10), canvas.clientHeight / (high[1] - low[1] + 10));
  view = { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, scale };
}

// metres to pixels of the canvas
const onScreen = (x, y) => [canvas.clientWidth / 2 + (x - view.x) * view.scale, canvas.clientHeight / 2 - (y - view.y) * view.scale];

function tile(z, x, y) {
  const key = `${version}/${mapIndex}/${z}/${x}/${y}`;
  if (!tiles.has(key)) {
    if (tiles.size >= MOST_TILES) tiles.delete(tiles.keys().next().value);
    tiles.set(key, null);
    ask(`maps/${mapIndex}/tiles/${z}/${x}/${y}.png`).then((a) => a.blob()).then(createImageBitmap)
      .then((picture) => { if (tiles.has(key)) { tiles.set(key, picture); redraw(); } }).catch(() => tiles.delete(key));
  }
  return tiles.get(key);
}

function redraw() { if (!queued) { queued = true; requestAnimationFrame(draw); } }

function draw() {
  queued = false;
  const w = canvas.clientWidth, h = canvas.clientHeight, ratio = devicePixelRatio;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) { canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio); }
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, w, h);
  if (!view) return;
  const z = Math.max(0, Math.min(zooms.get(mapIndex) ?? 0, Math.round(Math.log2(view.scale * WORLD_M / TILE_PX)))), side = WORLD_M / 2 ** z;
  for (let x = Math.floor((view.x - w / 2 / view.scale) / side); x * side < view.x + w / 2 / view.scale; x++)
    for (let y = Math.floor((view.y - h / 2 / view.scale) / side); y * side < view.y + h / 2 / view.scale; y++) {
      const picture = tile(z, x, y);
      if (picture) pen.drawImage(picture, ...onScreen(x * side, (y + 1) * side), side * view.scale, side * view.scale);
    }
  pen.globalAlpha = 0.4;
  for (const c of at("shown").checked ? closures : []) {
    const ends = [pose(c.robot_i, c.stamp_i), pose(c.robot_j, c.stamp_j)];
    if (ends.every(Boolean)) line(ends, CLOSURE[c.channel], 1);
  }
  pen.globalAlpha = 1;
  robots.forEach((r, i) => {
    if (r.map !== mapIndex || !r.T_map_base || hidden.has(r.session)) return;
    const colour = COLOURS[i % COLOURS.length], [x, y, heading] = r.T_map_base, [px, py] = onScreen(x, y);
    line((trails.get(r.session) ?? []).map((p) => [p[1], p[2]]), colour);
    pen.save(); pen.translate(px, py); pen.rotate(-heading); pen.fillStyle = colour;
    pen.beginPath(); pen.moveTo(11, 0); pen.lineTo(-7, 6); pen.lineTo(-7, -6); pen.fill(); pen.restore();
  });
}

function line(points, colour, width = 2) {
  pen.strokeStyle = colour; pen.lineWidth = width; pen.beginPath();
  for (const p of points) pen.lineTo(...onScreen(p[0], p[1]));
  pen.stroke();
}

// Where a robot was at a keyscan; null if it is in another map.
function pose(name, stamp) {
  const path = trails.get(name);
  if (!path?.length || robots.find((r) => r.session === name)?.map !== mapIndex) return null;
  let low = 0, high = path.length - 1;
  while (low < high) { const middle = (low + high) >> 1; if (path[middle][0] < stamp - 1e-6) low = middle + 1; else high = middle; }
  return [path[low][1], path[low][2]];
}

function zoom(factor) { if (view) { view.scale = Math.max(0.1, Math.min(2000, view.scale * factor)); redraw(); } }
function pan(dx, dy) { if (view) { view.x -= dx / view.scale; view.y += dy / view.scale; redraw(); } }

canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(-e.deltaY / 500)); }, { passive: false });
canvas.addEventListener("pointerdown", (e) => canvas.setPointerCapture(e.pointerId));
canvas.addEventListener("pointermove", (e) => { if (e.buttons) pan(e.movementX, e.movementY); });
canvas.addEventListener("keydown", (e) => {
  const keys = { ArrowLeft: () => pan(60, 0), ArrowRight: () => pan(-60, 0), ArrowUp: () => pan(0, 60), ArrowDown: () => pan(0, -60), "+": () => zoom(1.4), "-": () => zoom(1 / 1.4), 0: () => { fit(); redraw(); } };
  if (keys[e.key]) { e.preventDefault(); keys[e.key](); }
});
at("maps").addEventListener("change", (e) => { mapIndex = Number(e.target.value); fit(); redraw(); });
at("login").addEventListener("submit", (e) => { e.preventDefault(); token = at("token").value; sessionStorage.setItem("token", token); at("login").hidden = true; follow(); });
at("shown").addEventListener("change", redraw);
at("facts").addEventListener("toggle", () => { if (at("facts").open) facts().catch(() => {}); });
new ResizeObserver(redraw).observe(canvas);

async function follow() {
  try {
    const reader = (await ask("events")).body.pipeThrough(new TextDecoderStream()).getReader();
    await update(version); // what is there already; events tell of changes only
    at("status").textContent = readOnly ? "read-only" : "live";
    let rest = "";
    for (;;) {
      const { value, done } = await reader.read();
      if (done) throw new Error("the stream ended");
      const parts = (rest + value).split("\n\n");
      rest = parts.pop();
      const newest = parts.filter((p) => p.startsWith("event: live")).pop();
      if (newest) await update(JSON.parse(newest.slice(newest.indexOf("data: ") + 6)).number);
    }
  } catch (error) {
    at("status").textContent = error instanceof Refused ? error.message : "no connection; trying again";
    if (!(error instanceof Refused)) setTimeout(follow, RETRY_MS);
  }
}
follow();
