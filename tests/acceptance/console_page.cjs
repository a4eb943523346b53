// The console's page without a browser: what it sends and shows while servers come and go. Run: node console_page.cjs console.js
"use strict";
const assert = require("assert"), fs = require("fs"), vm = require("vm");

const code = fs.readFileSync(process.argv[2], "utf8");
const stored = {}; // what a tab keeps when its page is loaded anew
const sessionStorage = {
  getItem: (key) => stored[key] ?? null, setItem: (key, value) => { stored[key] = String(value); }, removeItem: (key) => { delete stored[key]; },
};

class Element {
  constructor() { this.children = []; this.dataset = {}; this.style = {}; this.classList = { add() {}, remove() {} }; }
  append(...children) { this.children.push(...children); }
  replaceChildren(...children) { this.children = children; }
  get firstChild() { return this.children[0]; }
  get lastChild() { return this.children[this.children.length - 1]; }
  getContext() { return new Proxy({}, { get: () => () => {} }); }
}

function load() {
  const page = { posts: [], up: true, reply: null }, listeners = {}, place = new Element();
  let socket;
  const listen = (kind, act) => { (listeners[kind] ||= []).push(act); };
  const world = {
    sessionStorage, performance, setTimeout, clearTimeout, setInterval, clearInterval, AbortController, Element, Date, JSON, Promise, Error,
    document: {
      getElementById: (id) => (id === "alarms" ? place : null), createElement: () => new Element(), addEventListener: listen, documentElement: {},
    },
    location: { protocol: "http:", host: "here" }, addEventListener: listen, matchMedia: () => ({ addEventListener() {} }),
    requestAnimationFrame() {}, getComputedStyle: () => ({ getPropertyValue: () => "" }),
    fetch: async (path) => { page.posts.push(path); return { ok: page.up, json: async () => page.reply, text: async () => "down" }; },
    WebSocket: class { constructor() { socket = this; } close() {} },
  };
  world.window = world;
  vm.runInContext(code, vm.createContext(world));
  // A server says the same again and again until it says something else, or is silent.
  let said = null;
  page.hear = (server, stop) => { said = { server, stop }; };
  page.silence = () => { said = null; };
  setInterval(() => { if (said) socket.onmessage({ data: JSON.stringify({ t: performance.now() / 1000, plants: {}, ...said }) }); }, 20);
  page.key = (key) => listeners.keydown[0]({ code: key, target: {}, preventDefault() {}, stopPropagation() {} });
  page.stopOne = (stop) => listeners.pointerdown[0]({ target: { closest: () => ({ dataset: { stop }, classList: { add() {}, remove() {} } }) } });
  page.shown = () => place.children.map((line) => `${line.className}: ${line.firstChild.textContent}`).join("\n");
  return page;
}

const some = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
async function until(holds, what) {
  for (const end = Date.now() + 10000; !holds(); await some(20)) assert(Date.now() < end, `waited 10 s for ${what}`);
}
const order = (all = true) => ({ since: 1.0, all, rows: { "/sim/simulator": { state: "stopped", after: 0.02, silent_for: 0.1, text: "latched" } } });

(async () => {
  let page = load();
  page.hear("A", null);
  page.reply = order();
  page.key("Escape");
  await until(() => page.posts.length === 1, "the press to be sent");
  page.hear("A", order());
  await until(() => page.shown().startsWith("good: STOPPED: /sim after 0.02 s"), "the plant's answer");

  page.silence();
  await until(() => page.shown().includes("UNCONFIRMED"), "the words for a silent server");
  assert(!page.shown().includes("good: "), page.shown());

  page.hear("B", null);
  await until(() => page.posts.length === 2 && !("stops" in stored), "the order for a server that was started anew");
  page.hear("B", order());
  await until(() => page.shown().includes("good: "), "the answer by the new server");
  page.silence();

  page = load();
  await until(() => page.shown().includes("UNCONFIRMED. Last known: /sim was stopped"), "what the page knew before it was loaded anew");
  page.reply = order();
  page.hear("C", null);
  await until(() => page.posts.length === 1, "the order of a page that was loaded anew with its server");
  page.hear("C", order());
  await until(() => page.shown().includes("good: "), "the answer by the third server");
  page.hear("C", null);
  await until(() => page.shown() === "", "nothing to show after it was acknowledged");
  assert.deepStrictEqual(stored, {});
  page.silence();
  page = load();
  page.hear("D", null);
  await some(200);
  assert.deepStrictEqual(page.posts, [], "what was acknowledged is not ordered again");

  page.up = false;
  page.stopOne("/a/plant");
  await until(() => page.posts.length > 0, "the stop of one plant");
  assert.strictEqual(page.posts[0], "/e_stop?node=%2Fa%2Fplant");
  page.stopOne("/b/plant");
  await until(() => page.posts.at(-1) === "/e_stop?node=%2Fa%2Fplant&node=%2Fb%2Fplant", "the stop of both");
  page.key("Space");
  page.stopOne("/c/plant");
  page.reply = order();
  page.up = true;
  await until(() => !("stops" in stored), "the stop to be taken");
  assert.strictEqual(page.posts.at(-1), "/e_stop?", "a stop of all stays one of all");
  process.exit(0);
})().catch((error) => { console.error(error); process.exit(1); });
