// Follows words.js in one script; test_words.py has the right answers.
const robot = (more) => ({ session: "a", robot: "a", epoch: 0, map: 0, removed: false, last_heard_s: 1, first_s: 0, last_s: 60, path_length_m: 9, ...more });
const a = robot({}), b = robot({ session: "b", robot: "b" }), alone = { ...b, map: 1 };
const state = (one, all, readOnly = false) => stateOf(one, all, readOnly);
const counts = { lacking_packets: 0, lacking_sessions: 0, lacking_s: 0, free_bytes: 9e10 }, late = { ...counts, lacking_packets: 3, lacking_sessions: 1, lacking_s: 100 };
const need = (more) => attention({ robots: [a], maps: [{ map: 0, robots: ["a"] }], separations: [], quality: {}, counts, contradicted: [], readOnly: false, ...more });
const apart = { maps: [0, 1], candidates: 2, verified: 0, explanation: "few points" };
const closure = { robot_i: "a", stamp_i: 5, robot_j: "b", stamp_j: 8, reason: "found_by_robot" };
const join = { robots: ["b", "a"], places: 7, seen_m: 141.2, contradicting_m: 0.3, elsewhere: 0 };
console.log(JSON.stringify({
  states: [
    state(a, [a]), state(a, [a, b]), state(alone, [a, alone]), state(robot({ map: null }), [a, b]), state(robot({ last_heard_s: 90 }), [a]),
    state(robot({ last_heard_s: 7200 }), [a]), state(robot({ last_heard_s: null }), [a]), state(robot({ removed: true }), [a]),
    state(a, [a, robot({ session: "a+1", epoch: 1 })]), state(a, [a, b], true), state(alone, [a, alone], true),
  ].map(({ kind, text }) => [kind, text]),
  evidence: [evidence([a, b], []).get("a"), evidence([a, b], [closure, { ...closure, stamp_i: 6 }]).get("a")],
  joins: [[], [join], [{ ...join, seen_m: null, places: 9 }, { ...join, elsewhere: 0.5, places: 1 }, { ...join, robots: ["a", "a+1"] }], [join, join, join, join]].map((joins) => joinsOf(a, [a, b, robot({ session: "a+1", epoch: 1 })], joins)),
  well: need({}),
  silent: need({ robots: [robot({ last_heard_s: 90 }), robot({ robot: "c", session: "c", last_heard_s: 60 })] }).map((n) => [n.text, n.action]),
  apart: need({ robots: [a, alone], maps: [{ map: 0, robots: ["a"] }, { map: 1, robots: ["b"] }], separations: [apart] }).map((n) => [n.text, n.help, n.why, n.do]),
  vetoed: need({ robots: [a, alone], maps: [{ map: 0, robots: ["a"] }, { map: 1, robots: ["b"] }], separations: [{ ...apart, reason: "vetoed" }] }).map((n) => n.do),
  disk: need({ counts: { ...counts, free_bytes: 4e8 } }).map((n) => n.text),
  certificate: need({ quality: { 0: { bar: 0.05, cells: [{ good: true }, { good: false }, { good: false }], drives: [{ text: "drive from (1, 2) to (3, 4) again: about 2 m2 more are good then", from: [1, 2], to: [3, 4] }] }, 1: { bar: 0.05, cells: [{ good: false }], drives: [] } } }).map((n) => [n.text, n.help, n.do]),
  accuracy: [{ quality: { 0: { bar: 0.05, cells: [1, 1, 0].map((good) => ({ good })) }, 1: { bar: 0.05, cells: [{ good: 1 }] } }, readOnly: true }, { quality: {}, readOnly: true }, { quality: {}, readOnly: false, maps: [0] }].map(accuracy),
  late: need({ counts: late }).map((n) => n.text),
  lagging: need({ robots: [a, alone], counts: { ...late, lacking_s: 20 }, maps: [{ map: 0, robots: ["a"] }, { map: 1, robots: ["b"] }], separations: [apart] }).map((n) => n.help),
  contradiction: need({ contradicted: [{ ...closure, reason: "maps_contradict", explanation: "why" }] }).map((n) => [n.text, n.do]),
  sensors: ["lidar", "camera", "tag"].map((channel) => sensorOf({ channel })),
  times: [duration(8), duration(59.6), duration(119), duration(7200), duration(90000), duration(260000), moment(1077.5, 1000), moment(1077.5, 1000, true)],
  history: history({ robots: [a, b], accepted: [closure], edits: [{ author: "anna", time_s: 1e9, kind: "region", content: { use: "free", name: "" } }] }).map((e) => [e.time, e.text]),
}));
