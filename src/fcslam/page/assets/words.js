// What the page says. Pure functions: they know no document and no service, so tests run them alone.

export const HEARD_S = 15; // a robot that was heard so recently is connected
const GONE_S = 3600; // a robot that is silent for longer has ended its work
const CLOCK_S = 1e9; // later stamps count from 1970, smaller ones from an arbitrary start
const LOW_DISK_BYTES = 2e9;
const LOOK_ALIKE = 0.5; // maps that fit so well elsewhere, as a share, may show places that only look alike
const MOST_JOINS = 3; // that the card of a robot names
const LATE_S = 5, LAGGING_S = 30; // a map that lacks older news is not current; so old, somebody should know
const CONTRADICTIONS = ["joins_contradicting_maps", "maps_contradict"];

export function duration(seconds) {
  const units = [["s", 60], ["min", 60], ["h", 24]];
  let amount = seconds;
  for (const [unit, next] of units) {
    if (Math.round(amount) < next) return `${Math.round(amount)} ${unit}`;
    amount /= next;
  }
  return Math.round(amount) === 1 ? "1 day" : `${Math.round(amount)} days`;
}

// A stamp as a time of the clock, or as time since the first stamp if the stamps count from an arbitrary start.
export function moment(stamp, first, inFull = false) {
  if (stamp >= CLOCK_S) return inFull ? new Date(1000 * stamp).toLocaleString() : new Date(1000 * stamp).toLocaleTimeString();
  const seconds = Math.max(0, Math.floor(stamp - first));
  return `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")} min${inFull ? " into the drive" : ""}`;
}
export const dayOf = (stamp) => (stamp >= CLOCK_S ? new Date(1000 * stamp).toLocaleDateString(undefined, { dateStyle: "full" }) : "");

export function listed(names) {
  return names.length < 2 ? (names[0] ?? "") : `${names.slice(0, -1).join(", ")} and ${names.at(-1)}`;
}
export const count = (number, noun) => `${number.toLocaleString("en")} ${noun}${number === 1 ? "" : "s"}`;
export const metres = (length) => (length < 10 ? `${length.toFixed(2)} m` : length < 1000 ? `${length.toFixed(1)} m` : `${(length / 1000).toFixed(2)} km`);

const isEarlier = (robot, robots) => robots.some((r) => r.robot === robot.robot && r.epoch > robot.epoch);
const isAlone = (robot, robots) => !robots.some((r) => r.map === robot.map && r.robot !== robot.robot && !r.removed);
const hasOthers = (robot, robots) => robots.some((r) => r.robot !== robot.robot && !r.removed);

// What a robot does, in words, and what that means: ok, wait, alert or past.
export function stateOf(robot, robots, readOnly) {
  const say = (kind, text) => ({ kind, text });
  if (robot.removed) return say("past", "Removed by hand; the map is without it");
  if (isEarlier(robot, robots)) return say("past", "Earlier drive, ended");
  const place = robot.map === null ? "not on a map yet" : !hasOthers(robot, robots) ? "on its map" : isAlone(robot, robots) ? "not joined with the others yet" : "on the shared map";
  if (readOnly) return say(place === "not joined with the others yet" || robot.map === null ? "wait" : "ok", `Finished, ${place}`);
  if (robot.last_heard_s === null) return say("past", `Not heard since the service started; ${place}`);
  if (robot.last_heard_s >= GONE_S) return say("past", `Switched off ${duration(robot.last_heard_s)} ago, ${place}`);
  if (robot.last_heard_s >= HEARD_S) return say("alert", `Silent for ${duration(robot.last_heard_s)}: switched off, or without network`);
  return say(place === "on its map" || place === "on the shared map" ? "ok" : "wait", `Maps, ${place}`);
}

// Places that each session and other robots both saw, in words: the evidence for its place on the shared map.
export function evidence(robots, accepted) {
  const owner = new Map(robots.map((r) => [r.session, r.robot])), shared = new Map(robots.map((r) => [r.session, new Map()]));
  for (const c of accepted) {
    const [i, j] = [owner.get(c.robot_i), owner.get(c.robot_j)];
    if (i === undefined || j === undefined || i === j) continue;
    for (const [mine, other] of [[shared.get(c.robot_i), j], [shared.get(c.robot_j), i]]) mine.set(other, (mine.get(other) ?? 0) + 1);
  }
  const say = (others) => `Saw the same places as ${listed([...others.keys()].sort())}, ${count([...others.values()].reduce((a, b) => a + b), "time")}`;
  return new Map([...shared].map(([session, others]) => [session, others.size ? say(others) : "Nobody else has seen its places yet"]));
}

// On what evidence a robot shares a map with others, those from fewest places first.
export function joinsOf(robot, robots, joins) {
  const others = robots.filter((r) => r.robot !== robot.robot).map((r) => r.session);
  const found = joins.filter((j) => j.robots.includes(robot.session)).map((j) => ({ ...j, other: j.robots.find((name) => others.includes(name)) })).filter((j) => j.other).sort((a, b) => a.places - b.places);
  const say = ({ other, places, seen_m, contradicting_m, elsewhere }) => {
    const walls = seen_m === null ? "their maps could not be compared" : `${seen_m.toFixed(0)} m of wall seen by both, ${Math.round((100 * contradicting_m) / (seen_m || 1))} % contradict`;
    return `Joined with ${other}: ${count(places, "place")}, ${walls}.${elsewhere >= LOOK_ALIKE ? " Look-alike places are possible." : ""}`;
  };
  const more = found.length > MOST_JOINS ? [`${count(found.length - MOST_JOINS, "more join")}, from more places.`] : [];
  return [...found.slice(0, MOST_JOINS).map(say), ...more].join(" ");
}

// How accurate the maps are, by their certificates.
export function accuracy({ quality, readOnly, maps }) {
  if (!readOnly) return maps.length ? "How accurate the map is, its finished run tells: see Download." : "";
  const cells = Object.values(quality).flatMap((one) => one.cells), [first] = Object.values(quality);
  return cells.length ? `${cells.filter((c) => c.good).length.toLocaleString("en")} of ${cells.length.toLocaleString("en")} m² of the map are accurate to ${Math.round(100 * first.bar)} cm.` : "";
}

// What the drawn map lacks; empty if it is current.
export function lackOf({ lacking_packets, lacking_sessions, lacking_s }) {
  const sessions = lacking_sessions ? `, ${count(lacking_sessions, "drive")} among them` : "";
  return lacking_s > LATE_S ? `The map lacks the last ${duration(lacking_s)}: ${count(lacking_packets, "message")} of robots${sessions}` : "";
}

// Why two maps are apart, and what would help.
function separation(s, maps, lack) {
  const [first, second] = s.maps.map((k) => maps.find((m) => m.map === k)?.robots ?? []);
  const seen = s.verified ? "They may have been at the same place, but the evidence is weak or contradicts itself." : s.candidates ? "Some places look alike, but their walls do not fit." : "They have not seen the same place yet.";
  const text = first.length + second.length > 2 ? `${listed(first)} on one map, ${listed(second)} on another.` : `${first} and ${second} have separate maps.`;
  if (s.reason === "vetoed") return { kind: "wait", text, help: "Somebody said that they did not see the same place. If they did, take that edit back.", why: s.explanation, action: "Open edits", do: { view: "edits" } };
  if (lack) return { kind: "wait", text, help: `${lack}. They may be joined when it has caught up.`, why: s.explanation, action: "Show both maps", do: { map: s.maps[1], beside: s.maps[0] } };
  const help = `${seen} Drive ${second[0]} through an area that ${first[0]} has mapped, for at least 10 m.`;
  return { kind: "wait", text, help, why: s.explanation, action: "Show both maps", do: { map: s.maps[1], beside: s.maps[0] } };
}

// What needs a person, most urgent first; nothing in the normal case.
export function attention({ robots, maps, separations, quality, counts, contradicted, readOnly }) {
  const found = [];
  if (!readOnly && counts.free_bytes !== null && counts.free_bytes < LOW_DISK_BYTES)
    found.push({ kind: "alert", text: `The disk of the service has ${(counts.free_bytes / 1e9).toFixed(1)} GB left.`, help: "Download what you need and free some space, or the service will refuse what robots send.", why: "", action: "Open downloads", do: { view: "files" } });
  const silent = robots.filter((robot) => stateOf(robot, robots, readOnly).kind === "alert");
  if (silent.length)
    found.push({ kind: "alert", text: `${listed(silent.map((r) => r.robot))} ${silent.length > 1 ? "have been silent, the first" : "has been silent"} for ${duration(Math.max(...silent.map((r) => r.last_heard_s)))}.`, help: "If the work is done, nothing is wrong. If not, check power and network: a robot keeps what it sees and sends it later.", why: "", ...(silent.length > 1 ? { action: "Show the robots", do: { view: "fleet" } } : { action: "Show where it was", do: { robot: silent[0].session } }) });
  const blamed = new Map();
  for (const c of contradicted) if (CONTRADICTIONS.includes(c.reason)) for (const name of new Set([c.robot_i, c.robot_j])) blamed.set(name, [...(blamed.get(name) ?? []), c]);
  const [worst] = [...blamed].sort((a, b) => b[1].length - a[1].length);
  if (worst)
    found.push({ kind: "alert", text: `What ${worst[0]} measured contradicts the other paths.`, help: "Its wheels may slip, its scanner may have moved, or two places look the same. Look at the places that were left out.", why: worst[1][0].explanation, action: "Show the evidence", do: { view: "evidence", robot: worst[0] } });
  const told = new Set(); // one piece of advice for a map is enough
  for (const s of [...separations].sort((a, b) => b.verified - a.verified || b.candidates - a.candidates || a.maps[0] - b.maps[0])) {
    if (told.has(s.maps[1])) continue;
    told.add(s.maps[1]);
    found.push(separation(s, maps, readOnly ? "" : lackOf(counts)));
  }
  for (const [map, { bar, cells, drives }] of Object.entries(quality))
    if (drives.length)
      found.push({ kind: "wait", text: `${count(cells.filter((c) => !c.good).length, "square metre")} of the map may be off by more than ${metres(bar)}.`, help: drives.map((d) => `${d.text[0].toUpperCase()}${d.text.slice(1)}.`).join(" "), why: "", action: "Show where", do: { quality: Number(map), marks: drives.flatMap((d) => [d.from, d.to]) } });
  if (!readOnly && counts.lacking_s > LAGGING_S)
    found.push({ kind: "wait", text: `${lackOf(counts)}.`, help: "Robots send faster than this machine can map. It will catch up when they pause; the robots' positions stay current.", why: "", action: "Show the robots", do: { view: "fleet" } });
  return found;
}

const DECISIONS = { accepted: "used", verified: "fits, not needed", rejected: "left out", revoked: "taken back", candidate: "not confirmed" };
export const decisionOf = (closure) => DECISIONS[closure.status] ?? closure.status;
const SENSORS = { lidar: "laser scanner", camera: "camera", tag: "tag" };
export const sensorOf = (closure) => SENSORS[closure.channel] ?? closure.channel;

// What happened in a mission, oldest first: drives, first meetings, edits. `time` orders drives; an edit has its own clock.
export function history({ robots, accepted, edits, maps }) {
  const events = [], met = new Map(), owner = new Map(robots.map((r) => [r.session, r.robot]));
  for (const r of robots) {
    if (r.first_s === null) continue;
    events.push({ time: r.first_s, text: `${r.robot} ${r.epoch ? `begins drive ${r.epoch + 1}` : "begins to map"}` });
    events.push({ time: r.last_s, text: `${r.robot}: last scan in the map, after ${metres(r.path_length_m)}` });
  }
  for (const c of accepted) {
    const [i, j] = [owner.get(c.robot_i), owner.get(c.robot_j)], pair = i < j ? `${i} and ${j}` : `${j} and ${i}`, time = Math.max(c.stamp_i, c.stamp_j);
    if (i !== j && !(met.get(pair) <= time)) met.set(pair, time);
  }
  for (const [pair, time] of met) events.push({ time, text: `${pair} saw the same place for the first time` });
  const clocked = robots.some((r) => r.first_s >= CLOCK_S);
  for (const e of edits) events.push({ time: clocked ? e.time_s : Infinity, at: e.time_s, text: `${e.author}: ${editOf(e, maps)}` });
  return events.sort((a, b) => a.time - b.time);
}

const USES = { erase: "erased a part of the map", free: "marked a part as free", "keep-out": "drew a keep-out", area: "named an area" };
// An edit, in words.
export function editOf({ kind, content }) {
  if (kind === "region") return `${USES[content.use] ?? content.use}${content.name ? ` “${content.name}”` : ""}`;
  const both = `${content.robot_i} and ${content.robot_j}`;
  return { veto: `${both}: not the same place`, pin: `${both}: surely the same place`, closure: `joined ${both} by hand`, removal: `removed ${content.robot}`, cut: `cut a part of the drive of ${content.session}`, placement: "moved or turned the map", floor: `${content.session} is on floor ${content.floor}`, undo: `took edit ${content.number} back` }[kind] ?? kind;
}
