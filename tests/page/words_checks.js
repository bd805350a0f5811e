// Follows words.js in one script; test_words.py has the right answers.
const robot = (more) => ({ session: "a", robot: "a", epoch: 0, map: 0, removed: false, last_heard_s: 1, first_s: 0, last_s: 60, path_length_m: 9, ...more });
const a = robot({}), b = robot({ session: "b", robot: "b" }), alone = { ...b, map: 1 };
const state = (one, all, readOnly = false) => stateOf(one, all, readOnly);
const counts = { lacking_packets: 0, lacking_sessions: 0, lacking_s: 0, free_bytes: 9e10 }, late = { ...counts, lacking_packets: 3, lacking_sessions: 1, lacking_s: 100 };
const need = (more) => attention({ robots: [a], counts, readOnly: false, ...more });
const closure = { robot_i: "a", stamp_i: 5, robot_j: "b", stamp_j: 8 };
console.log(JSON.stringify({
  states: [
    state(a, [a]), state(a, [a, b]), state(alone, [a, alone]), state(robot({ map: null }), [a, b]), state(robot({ last_heard_s: 90 }), [a]),
    state(robot({ last_heard_s: 7200 }), [a]), state(robot({ last_heard_s: 90, ended: true }), [a, b]), state(robot({ last_heard_s: null }), [a]), state(robot({ removed: true }), [a]),
    state(a, [a, robot({ session: "a+1", epoch: 1 })]), state(a, [a, b], true), state(alone, [a, alone], true),
  ].map(({ kind, text }) => [kind, text]),
  well: need({}),
  silent: need({ robots: [robot({ last_heard_s: 90 }), robot({ robot: "c", session: "c", last_heard_s: 60 })] }).map((n) => [n.text, n.action]),
  disk: need({ counts: { ...counts, free_bytes: 4e8 } }).map((n) => n.text),
  verdicts: [[{ sentence: "use this map", use: "use" }, lackOf(counts)], [{ sentence: "do not use this map yet: it moved", use: "wait" }, lackOf({ ...late, lacking_s: 20 })]].map(([one, lack]) => verdictOf(one, lack)),
  late: need({ counts: late }).map((n) => n.text),
  names: ["inter_robot_closures_accepted", "words_lidar_birds-1", "uplink_bytes_robot_1", "map_area"].map(nameOf),
  plots: plotsOf([{ quality: 0.5, silent: 1, sent: 0 }, { quality: 0.75, silent: 2, sent: 3 }]).map(({ name, values, newest }) => [name, values, newest]),
  sensors: ["lidar", "camera", "tag"].map((channel) => sensorOf({ channel })),
  times: [duration(8), duration(59.6), duration(119), duration(7200), duration(90000), duration(260000), moment(1077.5, 1000), moment(1077.5, 1000, true)],
  history: history({ robots: [a, b], accepted: [closure], edits: [{ author: "anna", time_s: 1e9, kind: "region", content: { use: "free", name: "" } }] }).map((e) => [e.time, e.text]),
}));
