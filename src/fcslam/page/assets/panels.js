// The panels beside the map. Texts are set as text, because a name is never markup.

import { colourOf, closures, firstStamp, fleet, keyOf, placed, robotNamed } from "./fleet.js";
import { between, distance, middle, turned } from "./geometry.js";
import { heightText } from "./heights.js";
import { chart, choose, goTo, openMap, redraw, showLayers } from "./map.js";
import { ask, at, json, link, report } from "./service.js";
import { change, tell } from "./tools.js";
import { attention, count, dayOf, decisionOf, duration, editOf, history, lackOf, listed, metres, moment, nameOf, plotsOf, sensorOf, stateOf, verdictOf } from "./words.js";

const LISTED = 200; // rows of the table of evidence
const NEAR_M = 5; // pairs with both ends so near each other show the same place

export function element(tag, text = "", more = {}) {
  const made = Object.assign(document.createElement(tag), more);
  made.append(text);
  return made;
}
export function button(text, act, more = {}) {
  const made = element("button", text, more);
  made.addEventListener("click", act);
  return made;
}
function row(...cells) {
  const made = document.createElement("tr"), [first, ...others] = cells;
  made.append(element("th", first, { scope: "row" }), ...others.map((text) => element("td", text)));
  return made;
}
// Fills a list only if it changes, so that it stays open, scrolled and focused.
const filled = new WeakMap();
export function fill(list, content, children) {
  const text = JSON.stringify(content);
  if (filled.get(list) === text) return;
  filled.set(list, text);
  list.replaceChildren(...children());
}
export function swatch(colour) {
  const made = element("span", "", { className: "swatch" });
  made.style.background = colour;
  return made;
}

export function show(view) {
  tell("");
  document.body.dataset.view = view;
  for (const tab of document.querySelectorAll("nav button")) {
    tab.ariaCurrent = tab.dataset.view === view ? "page" : "false";
    if (tab.dataset.view === view) tab.scrollIntoView({ block: "nearest", inline: "nearest" });
  }
  if (view === "history") showHistory();
  if (view === "evidence") showEvidence().catch((error) => tell(error.message));
  redraw();
}
export function select(session) {
  fleet.selected = fleet.selected === session ? null : session;
  fleet.scan = null;
  if (!fleet.selected) chart.followed = false;
  showFleet(); showControls(); redraw();
}
// Opens the map of a robot where it is.
export function showRobot(session) {
  const robot = robotNamed(session);
  fleet.selected = session;
  if (robot?.T_map_base) { openMap(robot.map); showMaps(); goTo(robot.T_map_base); }
  showFleet(); showControls();
}
export function showControls() {
  at("follow").disabled = !robotNamed(fleet.selected)?.T_map_base;
  at("follow").ariaPressed = String(chart.followed);
  at("level").ariaPressed = String(Boolean(chart.view?.turn));
}

// ---- Maps and their state ----

export function showMaps() {
  showLayers();
  const title = (m) => `${listed(m.robots)}${m.floor && `, floor ${m.floor}`}`;
  at("tabs").hidden = fleet.maps.length < 2;
  fill(at("tabs"), [chart.index, fleet.maps.map(title)], () => fleet.maps.map((m) => {
    const tab = button(title(m), () => { choose(m.map); showMaps(); }, { ariaPressed: String(m.map === chart.index) });
    tab.dataset.map = m.map;
    return tab;
  }));
  at("empty").hidden = !link.connected || fleet.robots.length > 0;
  if (!at("empty").hidden) at("first-robot").textContent = `fcslam play RECORDING --server ${location.origin} --state FOLDER`;
}
export function showAge() {
  const { counts, readOnly } = fleet;
  if (!counts) return;
  at("age").textContent = readOnly || counts.map_age_s === null ? "" : `${counts.worker_ready ? lackOf(counts) || "The map is up to date" : "The worker starts; the first start compiles code for a minute"}. `;
  if (!link.connected) return; // the status says why
  at("status").textContent = readOnly ? "Finished run" : counts.worker_ready ? "Live" : "The map catches up after a start";
  at("status").dataset.kind = readOnly || counts.worker_ready ? "ok" : "wait";
}

// ---- Fleet: one card for each robot. Its elements stay, or a slow click would find another one below it. ----

const cards = new Map();
function cardOf(name) {
  const card = element("li"), state = element("p", "", { className: "state" }), more = element("details"), facts = element("p"), earlier = element("ul"), plots = element("dl", "", { className: "plots" });
  const choice = button("", () => { const isNew = fleet.selected !== name; if (isNew) showRobot(name); else select(name); }, { className: "name" });
  more.append(element("summary", "Details"), facts, plots, earlier);
  card.append(choice, state, more);
  cards.set(name, { card, choice, state, facts, plots, earlier });
  return cards.get(name);
}
// The last minutes of a robot, since the page is open: a line for each measure, with its newest value.
function showPlots(list, samples) {
  if (samples.length < 2 || !list.parentElement.open) return;
  list.replaceChildren(...plotsOf(samples).flatMap(({ name, values, newest }) => {
    const line = Object.assign(document.createElement("canvas"), { width: 240, height: 32, role: "img", ariaLabel: `${name}: ${newest}` }), pen = line.getContext("2d"), most = Math.max(...values, 1e-9);
    pen.strokeStyle = getComputedStyle(list).getPropertyValue("--accent"); pen.lineWidth = 1.5;
    for (const [k, value] of values.entries()) pen.lineTo((k / (values.length - 1)) * 240, 30 - (28 * value) / most);
    pen.stroke();
    return [element("dt", `${name}: ${newest}`), element("dd", line)];
  }));
}
export function forgetCards() { cards.clear(); }

// The decision about each map, and what it rests on.
function showVerdicts() {
  const { verdicts, counts, readOnly } = fleet, lack = readOnly || !counts ? "" : lackOf(counts);
  fill(at("verdicts"), [verdicts, lack], () => verdicts.map((one) => {
    const { kind, text } = verdictOf(one, lack), card = element("li"), why = element("details", element("summary", "Why"));
    card.dataset.kind = kind;
    if (verdicts.length > 1) card.append(element("h3", `Map of ${listed(one.robots)}`));
    card.append(element("p", text, { className: "state" }));
    if (one.where.length) card.append(button("Show where", () => showPlaces(one.map, one.where)));
    why.append(...one.details.map((line) => element("p", line)));
    if (one.details.length) card.append(why);
    return card;
  }));
}
// Places of a map, on the layer of its accuracy.
function showPlaces(map, places) {
  at("layer-quality").checked = true;
  choose(map); showMaps();
  chart.marks = places;
  goTo(middle(places));
}

export function showFleet() {
  const newest = fleet.robots.filter((r) => !fleet.robots.some((o) => o.robot === r.robot && o.epoch > r.epoch)), list = at("robots");
  const shown = newest.map((robot) => {
    const { card, choice, state, facts, plots, earlier } = cards.get(robot.session) ?? cardOf(robot.session), { kind, text } = stateOf(robot, fleet.robots, fleet.readOnly);
    fill(choice, [robot.robot, robot.color], () => [swatch(robot.color), robot.robot]);
    choice.ariaPressed = String(robot.session === fleet.selected);
    card.dataset.kind = kind;
    state.textContent = text;
    const heard = fleet.readOnly || robot.last_heard_s === null ? [] : [`heard ${duration(robot.last_heard_s)} ago`], sent = fleet.counts.metrics[`uplink_bytes_${robot.robot}`];
    const parts = [`drove ${metres(robot.path_length_m)}`, `${count(robot.keyscans, "scan")} on the map`, ...(robot.z_m === null ? [] : [`height ${heightText(robot.z_m)}`]), ...(robot.floor ? [`floor ${robot.floor}`] : []), ...(sent ? [`${(sent / 1000).toLocaleString("en", { maximumFractionDigits: 0 })} kB sent`] : []), ...heard];
    facts.textContent = `${parts.join("; ")}. ${Object.entries(robot.detectors).filter(([channel]) => Object.keys(fleet.counts.metrics).some((name) => name.startsWith(`words_${channel}_`))).map(([channel, made]) => `Detector (${channel}): ${made}.`).join(" ")}`;
    showPlots(plots, fleet.samples.get(robot.session) ?? []);
    const before = fleet.robots.filter((r) => r.robot === robot.robot && r.epoch < robot.epoch);
    fill(earlier, before.map((r) => [r.session, r.path_length_m]), () => before.map((r) => element("li", `Drive ${r.epoch + 1}, ${r.first_s === null ? "not on the map" : `from ${moment(r.first_s, firstStamp(), true)}`}: ${metres(r.path_length_m)}`)));
    return card;
  });
  if (shown.length !== list.children.length || shown.some((card, k) => card !== list.children[k])) list.replaceChildren(...shown);
  const { maps } = fleet, extent = maps.length === 1 && maps[0].extent, size = extent ? `, ${(extent[2] - extent[0]).toFixed(0)} × ${(extent[3] - extent[1]).toFixed(0)} m` : "";
  at("summary").textContent = newest.length ? `${count(newest.length, "robot")} on ${maps.length === 1 ? `one map${size}` : count(maps.length, "map")}` : "No robot yet";
  showVerdicts();
}

export function showAttention() {
  const found = fleet.counts ? attention(fleet) : [];
  at("needs").hidden = !found.length;
  at("needs").textContent = found.length;
  fill(at("attention"), found.map((one) => [one.text, one.help]), () => found.length ? found.map((one) => {
    const card = element("li", element("p", one.text, { className: "state" })), act = one.do;
    card.dataset.kind = one.kind;
    card.append(element("p", one.help), button(one.action, () => {
      if (act.robot) showRobot(act.robot);
      if (act.view) show(act.view);
    }));
    return card;
  }) : [element("li", "No robot needs you. Whether to use the map is under Fleet.", { className: "well" })]);
}

// ---- Evidence ----

const residual = (c) => { if (c.map === null) return null; const [dx, dy, angle] = between(c.T_i_j, between(...c.ends)); return [Math.hypot(dx, dy), Math.abs(angle)]; };
const offBy = (length) => (length < 0.001 ? "under 1 mm" : length < 0.1 ? `${(1000 * length).toFixed(0)} mm` : metres(length));
const time = (stamp) => moment(stamp, firstStamp());
const COLUMNS = [
  ["Robot", (c) => c.robot_i], ["and robot", (c) => c.robot_j], ["First seen", (c) => Math.min(c.stamp_i, c.stamp_j), time], ["Again", (c) => Math.max(c.stamp_i, c.stamp_j), time],
  ["Seen by", sensorOf], ["Off by", (c) => residual(c)?.[0] ?? Infinity, (value) => (value === Infinity ? "two maps" : offBy(value))],
];
let sorting = { column: 3, down: true }, listedNow = [];
export async function showEvidence() {
  const decision = at("decision").value, all = decision === "accepted" ? fleet.accepted : await closures(decision), names = fleet.robots.map((r) => r.session), kept = at("of-robot").value;
  fill(at("of-robot"), names, () => [new Option("all", ""), ...names.map((name) => new Option(name, name))]);
  at("of-robot").value = names.includes(kept) ? kept : "";
  const robot = at("of-robot").value, value = COLUMNS[sorting.column][1];
  const chosen = all.filter((c) => (!robot || c.robot_i === robot || c.robot_j === robot) && (!at("two-robots").checked || robotNamed(c.robot_i)?.robot !== robotNamed(c.robot_j)?.robot));
  listedNow = chosen.sort((a, b) => { const [x, y] = [value(a), value(b)]; return (sorting.down ? -1 : 1) * (x < y ? -1 : x > y ? 1 : 0); }).slice(0, LISTED);
  at("closures").textContent = `${count(chosen.length, "pair")} ${decisionOf({ status: decision })}${chosen.length > LISTED ? `; the table has the first ${LISTED}` : chosen.length ? "" : at("two-robots").checked ? ". Untick the box to see those of one robot." : "."}`;
  fill(document.querySelector("#pairs thead tr"), sorting, () => COLUMNS.map(([title], k) => {
    const head = element("th", button(title, () => { sorting = { column: k, down: sorting.column === k && !sorting.down }; showEvidence(); }), { scope: "col" });
    head.ariaSort = sorting.column === k ? (sorting.down ? "descending" : "ascending") : "none";
    return head;
  }));
  fill(at("list"), listedNow.map((c) => [keyOf(c), c.ends]), () => listedNow.map((c) => {
    const line = element("tr");
    line.append(...COLUMNS.map(([, of, words = String], k) => element("td", k ? words(of(c)) : button(words(of(c)), () => pick(c)))));
    line.dataset.key = keyOf(c);
    return line;
  }));
  mark();
  await checkChosen();
}
const mark = () => { for (const line of at("list").children) line.ariaCurrent = String(chart.closure && line.dataset.key === keyOf(chart.closure)); };
// The chosen pair as it is now.
async function checkChosen() {
  const asked = chart.closure;
  if (!asked) return;
  const now = report ? asked : await json(`closures/${keyOf(asked)}`).catch((error) => { if (error.status !== 404) throw error; });
  if (chart.closure !== asked) return; // another one by now
  chart.closure = now ? placed(now) : null;
  if (chart.closure) showClosure();
  else { at("closure").hidden = true; tell("The chosen pair is no longer there: one of its robots was removed."); }
}
export const refreshEvidence = () => (document.body.dataset.view === "evidence" ? showEvidence() : checkChosen());

function supporting(c) {
  const close = (a, b) => a.every((end, k) => distance(end, b[k]) < NEAR_M);
  return fleet.accepted.filter((o) => o.map === c.map && keyOf(o) !== keyOf(c) &&
    ((o.robot_i === c.robot_i && o.robot_j === c.robot_j && close(o.ends, c.ends)) || (o.robot_i === c.robot_j && o.robot_j === c.robot_i && close([o.ends[1], o.ends[0]], c.ends)))).length;
}
function showClosure() {
  const c = chart.closure, rows = [["Decision", decisionOf(c)], ["Why", c.explanation], ["When", `${time(c.stamp_i)} and ${time(c.stamp_j)}`], ["Stamps", `${c.stamp_i.toFixed(2)} s and ${c.stamp_j.toFixed(2)} s`]], off = residual(c);
  if (!off) rows.push(["Off by", "its ends are on two maps"]);
  else rows.push(["Off by", `${offBy(off[0])} and ${(Math.abs(turned(off[1])) * 180 / Math.PI).toFixed(1)}° from the map`], ["Supported", `by ${count(supporting(c), "pair")} within ${NEAR_M} m`]);
  if (c.similarity > 0.0005) rows.push(["Looks alike", `${(100 * c.similarity).toFixed(0)} % of the features`]);
  fill(at("sides"), [c.robot_i, c.robot_j, colourOf(c.robot_i), colourOf(c.robot_j)], () => c.robot_i === c.robot_j ? [swatch(colourOf(c.robot_i)), `${c.robot_i}, earlier and later`] : [swatch(colourOf(c.robot_i)), c.robot_i, " and ", swatch(colourOf(c.robot_j)), c.robot_j]);
  at("facts-of-closure").replaceChildren(...rows.map((cells) => row(...cells)));
  at("closure").hidden = false;
  mark();
}
export async function pick(closure) {
  chart.closure = closure;
  showClosure(); redraw();
  at("closure").focus(); // its buttons are next for the keyboard
  const overlay = at("overlay"), key = keyOf(closure);
  overlay.hidden = true;
  const picture = await ask(`closures/${key}.png`).then((a) => a.blob()).then(createImageBitmap).catch(() => null);
  if (!picture || !chart.closure || keyOf(chart.closure) !== key) return; // a run without scans has no picture
  overlay.getContext("2d").drawImage(picture, 0, 0);
  overlay.ariaLabel = `Walls that ${closure.robot_i} and ${closure.robot_j} saw, laid on each other`;
  overlay.hidden = false;
}
export function pickOnMap(key) {
  const found = fleet.accepted.find((c) => keyOf(c) === key);
  show("evidence");
  pick(found);
}
export function locate() {
  const { map, ends, robot_i } = chart.closure;
  openMap(map ?? robotNamed(robot_i)?.map ?? chart.index); showMaps();
  show("map");
  at("layer-closures").checked = true;
  goTo(middle(map === null ? [ends[0] ?? [0, 0]] : ends));
}
export const decide = (kind) => { const { robot_i, robot_j, stamp_i, stamp_j } = chart.closure; return change("edits", { kind, content: { robot_i, robot_j, stamps: [stamp_i, stamp_j] } }); };

// ---- History and edits ----

// Each step of the slider passes equally many scans: robots may drive days apart.
const allStamps = () => [...fleet.trails.values()].flatMap((path) => path.map((p) => p[0])).sort((a, b) => a - b);
export function setMoment(until) {
  const stamps = allStamps(), seen = stamps.filter((stamp) => stamp <= until).length, isNow = seen === stamps.length;
  fleet.until = isNow ? Infinity : until;
  if (document.activeElement !== at("moment")) at("moment").value = isNow ? 1000 : Math.floor((1000 * seen) / stamps.length);
  at("until").textContent = at("moment").ariaValueText = isNow ? "now" : moment(until, firstStamp(), true);
  at("share").textContent = isNow ? "" : `${seen.toLocaleString("en")} of ${count(stamps.length, "scan")}; the map itself is today's.`;
  redraw();
}
export function slide() {
  const stamps = allStamps();
  setMoment(stamps[Math.max(0, Math.ceil((stamps.length * at("moment").value) / at("moment").max) - 1)] ?? Infinity);
}
export function showHistory() {
  if (document.body.dataset.view !== "history") return;
  const events = history(fleet), first = firstStamp();
  fill(at("events"), events, () => events.map((e, k) => {
    const day = e.time === Infinity ? "Edits" : dayOf(e.time), item = element("li"), isNew = day && day !== (events[k - 1]?.time === Infinity ? "Edits" : dayOf(events[k - 1]?.time ?? 0));
    if (isNew) item.append(element("h3", day));
    item.append(e.time === Infinity ? element("span", `${new Date(1000 * e.at).toLocaleString()}: ${e.text}`) : button(`${moment(e.time, first)}: ${e.text}`, () => setMoment(e.time)));
    return item;
  }));
}
export function showEdits() {
  const { edits, mayEdit, readOnly } = fleet;
  for (const one of document.querySelectorAll(".admin")) one.hidden = !mayEdit;
  document.querySelector('[data-tool="join"]').hidden = fleet.maps.length < 2;
  at("locked").textContent = mayEdit ? "" : readOnly ? "This run is finished. Change it with “fcslam edit”, and map it again." : "Your token may look, and change nothing. Ask for the token of an administrator.";
  fill(at("edits"), [mayEdit, edits], () => edits.length ? edits.toReversed().map((e) => {
    const item = element("li", `${editOf(e)}`, { className: e.undone_by ? "undone" : "" });
    item.append(element("small", `Edit ${e.number}, ${e.author}, ${new Date(1000 * e.time_s).toLocaleString()}${e.undone_by ? `; taken back by edit ${e.undone_by}` : ""}`));
    if (mayEdit && !e.undone_by && e.kind !== "undo") item.append(button("Undo", () => change(`edits/${e.number}/undo`), { ariaLabel: `Undo edit ${e.number}` }));
    return item;
  }) : [element("li", "No edits.")]);
}

// ---- Numbers and training ----

export async function showFacts() {
  const [metrics, config] = await Promise.all([json("metrics.json"), ask("config.yaml").then((a) => a.text())]);
  at("config").textContent = config;
  at("metrics").replaceChildren(...metrics.map(({ name, value, unit }) => row(nameOf(name), value === null ? "–" : Number(value.toPrecision(4)).toLocaleString("en", { maximumFractionDigits: 6 }), unit === "1" ? "" : unit)));
}
// The rounds of a federated training, newest first.
export async function showLearning() {
  const rounds = await json("learning").catch(() => []), names = [...new Set(rounds.flatMap((r) => [...Object.keys(r.losses), ...Object.keys(r.measures)]))];
  at("learning").hidden = !rounds.length;
  at("learned").textContent = `${count(rounds.length, "round")}, ${rounds.filter((r) => r.released).length} released`;
  at("of-rounds").replaceChildren(...["Round", "Robots", "Left out", ...names.map((name) => name.replaceAll("_", " "))].map((title) => element("th", title, { scope: "col" })));
  at("rounds").replaceChildren(...rounds.toReversed().map((r) => row(`${r.round}${r.released ? ", released" : ""}`, r.robots.join(", "), [r.reason, r.left_out].filter(Boolean).join("; "), ...names.map((name) => (r.losses[name] ?? r.measures[name])?.toFixed(3) ?? "–"))));
}
