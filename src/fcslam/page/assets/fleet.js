// The state of the mission, as the service gave it last.

import { distance } from "./geometry.js";
import { Outdated, ask, at, json, report, unlessSame } from "./service.js";

const MOST_CLOSURES = 5000; // that the page asks for
const MOST_SAMPLES = 300; // looks at a robot that the page remembers, five minutes

export const fleet = {
  counts: null, mission: null, robots: [], maps: [], verdicts: [], edits: [], regions: [], accepted: [],
  trails: new Map(), since: new Map(), samples: new Map(), // by session; live poses after the path, and what the plots show
  until: Infinity, // the moment that the map shows: paths and evidence until then
  selected: null, scan: null, readOnly: false, mayEdit: false, readAt: 0,
};
let release = null, placedNow = null; // the closures that were placed last

export const robotNamed = (session) => fleet.robots.find((r) => r.session === session);
export const colourOf = (session) => robotNamed(session)?.color ?? "#777777";
export const firstStamp = () => Math.min(...fleet.robots.map((r) => r.first_s ?? Infinity));
export const keyOf = (c) => [c.channel, c.robot_i, c.stamp_i, c.robot_j, c.stamp_j].map(encodeURIComponent).join("/");
export const isPast = (c) => Math.max(c.stamp_i, c.stamp_j) <= fleet.until;

// Paths grow, and older poses seldom move: the service sends what follows the bytes that the page has.
const received = new Map();
async function trail(name) {
  const path = `trajectories/${encodeURIComponent(name)}.tum`, known = received.get(name);
  const answer = await ask(known ? `${path}?after=${known.bytes}&digest=${known.digest}` : path);
  const text = await answer.text(), after = Number(answer.headers.get("Fcslam-After")), digest = answer.headers.get("Fcslam-Digest");
  const poses = text.split("\n").filter((l) => l && l[0] !== "#").map((l) => {
    const [stamp, x, y, z, qx, qy, qz, qw] = l.split(" ").map(Number);
    return [stamp, x, y, Math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)), z];
  });
  const all = !after ? poses : poses.length ? known.poses.concat(poses) : known.poses;
  if (digest) received.set(name, { bytes: after + text.length, digest, poses: all });
  return all;
}

// Where a robot was at a stamp: x, y, heading and z in its map; undefined if nobody knows.
export function poseAt(name, stamp) {
  const path = fleet.trails.get(name);
  if (!path?.length) return undefined;
  let low = 0, high = path.length - 1;
  while (low < high) { const half = (low + high) >> 1; if (path[half][0] < stamp - 1e-6) low = half + 1; else high = half; }
  return path[low].slice(1);
}

// The closure with both ends in the map; `map` is null if they are in different ones.
export function placed(c) {
  const [map, other] = [c.robot_i, c.robot_j].map((name) => robotNamed(name)?.map ?? null), ends = [poseAt(c.robot_i, c.stamp_i), poseAt(c.robot_j, c.stamp_j)];
  return { ...c, ends, map: map === other && ends.every(Boolean) ? map : null };
}
const listedClosures = (status) => unlessSame(`closures?status=${status}&limit=${MOST_CLOSURES}`, (answer) => answer.json());
export const closures = async (status) => (await listedClosures(status)).map(placed);

// Reads all that is new. One at a time, and another one after it if something happened meanwhile: no answer overtakes a later one.
export async function update(forget) {
  const counts = await json("fleet");
  release ??= counts.version;
  if (counts.version !== release) { at("reload").hidden = false; throw new Outdated("The service has another version: reload the page."); }
  const [maps, verdicts, robots, closed, edits] = await Promise.all(
    [json("maps"), json("verdicts"), json("robots"), listedClosures("accepted"), json("edits")]);
  if (fleet.mission !== null && counts.mission !== fleet.mission) { received.clear(); forget(); }
  const seen = robots.filter((r) => r.map !== null), paths = await Promise.all(seen.map((r) => trail(r.session)));
  const isPlaced = closed === placedNow && seen.length === fleet.trails.size && seen.every((r, i) => paths[i] === fleet.trails.get(r.session) && r.map === robotNamed(r.session)?.map);
  Object.assign(fleet, { counts, mission: counts.mission, maps, verdicts, robots, edits, readOnly: counts.read_only, mayEdit: counts.may_edit, readAt: Date.now() });
  fleet.since = new Map(seen.map((r, i) => [r.session, after(paths[i].at(-1), fleet.since.get(r.session) ?? [])]));
  fleet.trails = new Map(seen.map((r, i) => [r.session, paths[i]]));
  if (!isPlaced) fleet.accepted = closed.map(placed);
  placedNow = closed;
  fleet.regions = edits.filter((e) => e.kind === "region" && !e.undone_by).map((e) => e.content);
}

// Live poses that a path does not have yet: those after its end. A straight line to the robot would cross walls.
function after(end, poses) {
  const off = poses.map((pose) => distance(end.slice(1), pose)), nearest = off.indexOf(Math.min(...off));
  return poses.slice(nearest + 1).slice(-MOST_SAMPLES);
}
// What each look at a robot found; the plots of its card show it.
function sample({ session, packets, quality, last_heard_s }) {
  const all = fleet.samples.get(session) ?? [], last = all.at(-1);
  fleet.samples.set(session, [...all, { packets, sent: last ? packets - last.packets : 0, quality, silent: last_heard_s ?? 0 }].slice(-MOST_SAMPLES));
}

// Poses and times are newer than the map: the service knows them from the packets.
export async function look() {
  const [counts, robots] = await Promise.all([json("fleet"), json("robots")]), known = new Map(robots.map((r) => [r.session, r]));
  for (const robot of fleet.robots) {
    const now = known.get(robot.session);
    if (now?.map === robot.map) Object.assign(robot, { T_map_base: now.T_map_base, z_m: now.z_m });
    if (now?.map === robot.map && now.T_map_base) fleet.since.get(robot.session)?.push(now.T_map_base);
    Object.assign(robot, { last_heard_s: now?.last_heard_s ?? null, ended: now?.ended ?? false });
    if (now) sample(now);
  }
  fleet.counts = counts; fleet.readAt = Date.now();
  const robot = robotNamed(fleet.selected);
  fleet.scan = robot && !report ? { session: robot.session, points: await json(`robots/${encodeURIComponent(robot.robot)}/scans/${robot.epoch}`).catch(() => []) } : null;
}
