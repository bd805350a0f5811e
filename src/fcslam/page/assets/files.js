// What the page gives away: files of the map, and a link to the view that is open.

import { fleet } from "./fleet.js";
import { chart } from "./map.js";
import { button, element, fill } from "./panels.js";
import { ask, at, report } from "./service.js";
import { tell } from "./tools.js";
import { listed } from "./words.js";

// `path` may also be a function that makes the file and returns its path.
const download = (text, path, name) => button(text, async () => {
  try {
    const address = URL.createObjectURL(await (await ask(typeof path === "string" ? path : await path())).blob());
    Object.assign(document.createElement("a"), { href: address, download: `${fleet.mission}-${name}` }).click();
    setTimeout(() => URL.revokeObjectURL(address), 1000);
  } catch (error) { tell(error.message); }
});
async function finish() {
  tell("The run is being finished; a long one takes minutes.");
  const { number } = await (await ask("finalize", { method: "POST" })).json();
  tell("The run is finished.");
  return `missions/${encodeURIComponent(fleet.mission)}/runs/${number}.zip`;
}
const stem = (map) => (map ? `map_${map}` : "map");

export function showFiles() {
  const { maps, readOnly, mayEdit, mission } = fleet, card = (title, text, ...buttons) => { const item = element("li", element("h3", title)); item.append(element("p", text), ...buttons); return item; };
  fill(at("files"), [mission, maps.map((m) => [m.map, m.robots, m.extent, m.in_space, m.georeferenced]), mayEdit], () => [
    ...maps.filter((m) => m.extent).map((m) => card(maps.length > 1 ? `Map of ${listed(m.robots)}` : "Map", "For Nav2 and other programs of ROS: a picture of cells and its description, in one archive.",
      ...[["Map for Nav2", "zip"], ["Picture", "png"], ["Drawing", "svg"], ...(m.in_space ? [["Points in 3D", "ply"]] : []), ...(m.georeferenced ? [["On the earth", "tif"]] : [])].map(([name, end]) => download(`${name} (${end})`, `maps/${m.map}.${end}`, `${stem(m.map)}.${end}`)))),
    card("Paths", "Where each robot was, and when, as text in the format of TUM; and all measurements between scans, in the format g2o.",
      download("Paths (zip)", "trajectories.zip", "paths.zip"), download("Pose graph (g2o)", "pose_graph.g2o", "pose_graph.g2o")),
    ...(report ? [] : [card("Report", "This page as one file that needs no service. It opens in any browser.", download("Report (html)", "report.html", "report.html"))]),
    ...(mayEdit && !readOnly ? [card("Finished run", "The map of all that arrived, and how accurate each square metre is. Unpack it and open it with fcslam show. The robots may go on.", download("Finished run (zip)", finish, "run.zip"))] : []),
    ...(mayEdit && !readOnly ? [card("Mission", "All that the robots sent and all edits. Another service can import it.", download("Mission file", `missions/${encodeURIComponent(mission)}/export`, "mission.sqlite"))] : []),
    card("This view", "A link that opens the same part of the map. It holds no token.", button("Copy the link", () => navigator.clipboard.writeText(location.href).then(() => tell("The link is copied."), () => tell(`Copy it from the address bar: ${location.href}`))), button("Print", () => print())),
  ]);
}

// ---- The view as part of the address ----

export function readAddress() {
  const asked = new URLSearchParams(location.hash.slice(1)), numbers = ["x", "y", "scale", "turn"].map((name) => Number(asked.get(name) ?? Number.NaN));
  return { view: asked.get("view"), robot: asked.get("robot"), map: asked.get("map"), place: numbers.every(Number.isFinite) && numbers[2] > 0 ? numbers : null };
}
let written = "", timer;
export function writeAddress() {
  clearTimeout(timer);
  timer = setTimeout(() => {
    const { view, opened, moved } = chart, parts = { view: document.body.dataset.view };
    if (opened) parts.map = opened;
    if (fleet.selected) parts.robot = fleet.selected;
    if (moved && view) Object.assign(parts, { x: view.x.toFixed(2), y: view.y.toFixed(2), scale: view.scale.toFixed(1), turn: view.turn.toFixed(3) });
    const now = `#${new URLSearchParams(parts)}`;
    if (now !== written) { written = now; history.replaceState(null, "", now); }
  }, 300);
}
