// What the service says. Tokens go in a header and never in an address, which logs would keep: so events are read with fetch.

const API = "api/v1/", RETRY_MS = 2000;
const SILENT_MS = 15000; // the service says something every 5 s: after so long, the connection is dead
export const at = (id) => document.getElementById(id);

export class Refused extends Error {}
export class Failed extends Error { // the service answered, and says what is wrong
  constructor(message, status) { super(message); this.status = status; }
}
export class Outdated extends Error {}

export const link = { token: sessionStorage.getItem("token") ?? "", connected: false };

// A report holds the responses itself and asks nobody.
export const report = at("responses") && JSON.parse(at("responses").textContent);
const bytesOf = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
function reported(path) {
  if (path === "events") // nothing changes any more
    return new Response(new ReadableStream({ start: (stream) => stop.signal.addEventListener("abort", () => stream.error(new Error("ended"))) }));
  const { texts, pictures, files } = report;
  if (path in texts) return new Response(texts[path]);
  if (path in pictures) return new Response(bytesOf(pictures[path]));
  if (path in files) return new Response(new Blob([bytesOf(files[path])]).stream().pipeThrough(new DecompressionStream("gzip")));
  throw new Error(`${path}: not in this report`);
}

export async function ask(path, { method = "GET", body } = {}) {
  const signal = method === "GET" ? stop.signal : undefined; // what nobody waits for any more must not wait for a dead connection
  if (report) return reported(path);
  const headers = { ...(link.token && { Authorization: `Bearer ${link.token}` }), ...(body && { "Content-Type": "application/json" }) };
  const answer = await fetch(API + path, { method, headers, body: body && JSON.stringify(body), signal });
  if (answer.ok) return answer;
  if (answer.status === 401 || (answer.status === 403 && method === "GET")) {
    at("login").hidden = false;
    throw new Refused("This page needs a token that is valid");
  }
  throw new Failed((await answer.json().catch(() => ({}))).error ?? `${path}: ${answer.status}`, answer.status);
}
export const json = async (path) => (await ask(path)).json();

// Reads something again only if it changed: `make` turns a response into what the page keeps.
const kept = new Map();
export async function unlessSame(path, make) {
  const answer = await ask(path), tag = answer.headers.get("ETag"), known = kept.get(path);
  if (tag && known?.tag === tag) { answer.body?.cancel(); return known.made; }
  const made = await make(answer);
  kept.set(path, { tag, made });
  return made;
}

// Follows the events: `changed` reads what is new, `say` tells how the connection is. A new attempt ends those before it.
let attempt = 0, stop = new AbortController();
export async function follow(changed, say) {
  stop.abort();
  const mine = ++attempt, ended = new AbortController();
  stop = ended;
  let fault = null, silence;
  const heard = () => { clearTimeout(silence); silence = setTimeout(() => ended.abort(), SILENT_MS); };
  const news = () => changed().then(() => { link.connected = mine === attempt; }, (error) => { fault = error; ended.abort(); });
  try {
    if (!report) heard();
    const reader = (await ask("events")).body.pipeThrough(new TextDecoderStream()).getReader();
    news(); // what is there already; events tell of changes only
    let rest = "";
    for (;;) {
      const { value, done } = await reader.read();
      if (done) throw new Error("the stream ended");
      if (!report) heard();
      const parts = (rest + value).split("\n\n");
      rest = parts.pop();
      if (parts.some((p) => p.startsWith("event: live"))) news();
    }
  } catch (error) {
    if (mine !== attempt) return;
    link.connected = false;
    const reason = fault ?? error;
    if (reason instanceof Refused || reason instanceof Outdated) say(reason.message);
    else {
      say(`${reason instanceof Failed ? reason.message : "No connection to the service"}; trying again`);
      setTimeout(() => { if (mine === attempt) follow(changed, say); }, RETRY_MS);
    }
  } finally {
    clearTimeout(silence);
    ended.abort(); // a browser opens six connections to a host, and each stream holds one
  }
}
// A hidden page has no stream.
export function pause() { attempt++; link.connected = false; stop.abort(); }
