// What the page says. Pure functions: they know no document and no service, so tests run them alone.

export const HEARD_S = 15; // a robot that was heard so recently is connected
const GONE_S = 3600; // a robot that is silent for longer has ended its work
const CLOCK_S = 1e9; // later stamps count from 1970, smaller ones from an arbitrary start
const LOW_DISK_BYTES = 2e9;
const LATE_S = 5, LAGGING_S = 30; // a map that lacks older news is not current; so old, somebody should know

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
  if (robot.ended) return say("past", `Drive ended, ${place}`);
  if (robot.last_heard_s === null) return say("past", `Not heard since the service started; ${place}`);
  if (robot.last_heard_s >= GONE_S) return say("past", `Not heard for ${duration(robot.last_heard_s)}, ${place}`);
  if (robot.last_heard_s >= HEARD_S) return say("alert", `Silent for ${duration(robot.last_heard_s)}: switched off, or without network`);
  return say(place === "on its map" || place === "on the shared map" ? "ok" : "wait", `Maps, ${place}`);
}

// What the plots of a robot show, and the newest value of each in words.
export function plotsOf(samples) {
  const measure = (name, key, say) => { const values = samples.map((one) => one[key]); return { name, values, newest: say(values.at(-1)) }; };
  return [measure("Other drives confirm its pose", "quality", (value) => `${Math.round(100 * value)} %`), measure("Since its last message", "silent", duration), measure("Messages a second", "sent", String)];
}

// Names of metrics in words.
const NAMES = [
  [/^inter_robot_closures_(\w+)$/, "places seen by two robots, $1"], [/^intra_robot_closures_(\w+)$/, "places seen again by one robot, $1"], [/^words_(\w+?)_(.+)$/, "words of the $1 vocabulary, detector $2"],
  [/^uplink_bytes_(.+)$/, "sent by $1"], [/^uplink_rate_(.+)$/, "rate of $1"], [/^downlink_bytes_(.+)$/, "sent to $1"], [/^downlink_rate_(.+)$/, "rate to $1"], [/^turns$/, "messages in the map"], [/^keyscans$/, "scans in the map"], [/^map_error_95$/, "error of the map, 95 % of it"],
];
export function nameOf(metric) {
  const [pattern, words] = NAMES.find(([one]) => one.test(metric)) ?? [];
  return pattern ? metric.replace(pattern, words) : metric.replaceAll("_", " ");
}

// What the drawn map lacks; empty if it is current.
export function lackOf({ lacking_packets, lacking_sessions, lacking_s }) {
  const sessions = lacking_sessions ? `, ${count(lacking_sessions, "drive")} among them` : "";
  return lacking_s > LATE_S ? `The map lacks the last ${duration(lacking_s)}: ${count(lacking_packets, "message")} of robots${sessions}` : "";
}

// The decision about a map. It is an older one while the map lacks something.
export function verdictOf({ sentence, use }, lack) {
  const text = lack ? `So far: ${sentence}. ${lack}.` : `${sentence[0].toUpperCase()}${sentence.slice(1)}.`;
  return { kind: { use: "ok", reserve: "wait", wait: "alert" }[use], text };
}

// What needs a person, most urgent first; nothing in the normal case.
export function attention({ robots, counts, readOnly }) {
  const found = [];
  if (!readOnly && counts.free_bytes !== null && counts.free_bytes < LOW_DISK_BYTES)
    found.push({ kind: "alert", text: `The disk of the service has ${(counts.free_bytes / 1e9).toFixed(1)} GB left.`, help: "Download what you need and free some space, or the service will refuse what robots send.", action: "Open downloads", do: { view: "files" } });
  const silent = robots.filter((robot) => stateOf(robot, robots, readOnly).kind === "alert");
  if (silent.length)
    found.push({ kind: "alert", text: `${listed(silent.map((r) => r.robot))} ${silent.length > 1 ? "have been silent, the first" : "has been silent"} for ${duration(Math.max(...silent.map((r) => r.last_heard_s)))}.`, help: "If the work is done, nothing is wrong. If not, check power and network: a robot keeps what it sees and sends it later.", ...(silent.length > 1 ? { action: "Show the robots", do: { view: "fleet" } } : { action: "Show where it was", do: { robot: silent[0].session } }) });
  if (!readOnly && counts.lacking_s > LAGGING_S)
    found.push({ kind: "wait", text: `${lackOf(counts)}.`, help: "Robots send faster than this machine can map. It will catch up when they pause; the robots' positions stay current.", action: "Show the robots", do: { view: "fleet" } });
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
