// Draws what /stream sends, and stops the plants. Needs nothing of the page's framework, so that it works without it.
"use strict";
(() => {
  const SPAN = 10; // seconds shown
  const COLOURS = ["#1f77b4", "#d95f02", "#2ca02c", "#9467bd"];
  const MODES = {
    disarmed: "disarmed", armed_effort: "ARMED: follows the controller", armed_position: "ARMED: moves by itself", e_stop: "E-STOP", fault: "FAULT", silent: "SILENT",
  };
  const away = (p) => p.theta - p.goal; // from upright; a hinge's is taken within half a turn
  // Title by unit, and value; what slides has metres and newtons.
  const ROWS = [
    [{ rad: "angle from upright [rad]", m: "position [m]" }, (p) => (p.unit === "m" ? p.theta : Math.atan2(Math.sin(away(p)), Math.cos(away(p))))],
    [{ rad: "velocity [rad/s]", m: "velocity [m/s]" }, (p) => p.theta_dot],
    [{ rad: "command [N m]", m: "command [N]" }, (p) => p.command],
    [{ rad: "disturbance [N m]", m: "disturbance [N]" }, (p) => p.disturbance],
    [{ rad: "applied effort [N m]", m: "applied effort [N]" }, (p) => p.applied],
  ];
  const state = { plants: {}, series: {}, frames: 0, drawn: 0, connected: false, stopPressed: 0, stopAnswered: 0, fps: 0 };
  window.pendulumConsole = state;

  // --- joints ---------------------------------------------------------------------------------------------
  // A plant of several joints is drawn whole where its links hang on each other; its lines are those of one joint, chosen here.
  const chosen = {}; // plant -> name of the joint whose lines are drawn
  const several = (plant) => plant.joints && plant.joints.length > 1;

  function choose(name, plant) {
    const joints = plant.joints || [];
    if (!joints.some((joint) => joint.name === chosen[name])) chosen[name] = joints.length ? joints[0].name : undefined;
    return Object.assign(plant, joints.find((joint) => joint.name === chosen[name]), { name: undefined });
  }

  let offered = "";
  function offerJoints() {
    const place = document.getElementById("joints");
    if (!place) return;
    const plants = Object.entries(state.plants).filter(([, plant]) => several(plant)).map(([name, plant]) => [name, plant.joints.map((joint) => joint.name)]);
    if (JSON.stringify(plants) === offered) return;
    offered = JSON.stringify(plants);
    place.replaceChildren(...plants.map(([name, joints]) => {
      const label = document.createElement("label"), list = document.createElement("select");
      label.append(`Lines of ${name || "/"}: joint `, list);
      list.dataset.joints = name;
      list.append(...joints.map((joint) => Object.assign(document.createElement("option"), { value: joint, textContent: joint })));
      list.value = chosen[name];
      list.onchange = () => { chosen[name] = list.value; state.series[name] = []; tape.stale = true; };
      return label;
    }));
  }

  // --- the stop ---------------------------------------------------------------------------------------------
  // A press is an order. The page repeats it until the server has taken it, the server until each plant has answered, and what
  // each answered stands until somebody acknowledges it.
  const LIMIT = 500; // ms after which a server that does not answer is shown as such
  const alarms = { sending: null, tries: 0, why: "", order: null, lost: null, server: null, only: [], notes: [] };
  state.alarms = alarms;

  async function request(path) {
    const limit = new AbortController();
    const timer = setTimeout(() => limit.abort(), LIMIT);
    try {
      const answer = await fetch(path, { method: "POST", signal: limit.signal, keepalive: true });
      if (!answer.ok) throw new Error(await answer.text());
      return await answer.json();
    } catch (error) {
      throw error.name === "AbortError" ? new Error("no answer within 0.5 s") : error;
    } finally {
      clearTimeout(timer);
    }
  }

  // Stops one plant, or all where none is named.
  function stop(node = "", button = document.getElementById("e_stop")) {
    // A touch is a pointerdown and a click: one press.
    if (Date.now() - state.stopPressed < 50 && state.stopNode === node) return;
    state.stopPressed = Date.now();
    state.stopNode = node;
    if (button) { button.classList.add("pressed"); setTimeout(() => button.classList.remove("pressed"), 400); }
    const first = alarms.sending === null;
    // A stop of all that is still under way stays one of all.
    alarms.only = !node || (!first && !alarms.only.length) ? [] : [...new Set([...(first ? [] : alarms.only), node])];
    sessionStorage.setItem("stops", JSON.stringify([state.stopPressed, alarms.only]));
    alarms.sending = state.stopPressed;
    alarms.tries = 0;
    showAlarms();
    if (first) send();
  }

  async function send() {
    while (alarms.sending !== null) {
      const pressed = alarms.sending;
      alarms.tries += 1;
      try {
        alarms.order = await request(`/e_stop?${alarms.only.map((node) => `node=${encodeURIComponent(node)}`).join("&")}`);
        state.stopAnswered = Date.now();
        if (alarms.sending === pressed) { alarms.sending = null; alarms.why = ""; sessionStorage.removeItem("stops"); }
      } catch (error) {
        alarms.why = state.failure = String(error.message || error);
        showAlarms();
        await new Promise((again) => setTimeout(again, 150));
      }
    }
    showAlarms();
  }

  // In the capture phase and wherever the focus is: a stop must not depend on what was clicked last. Space is left to
  // fields that take text, Enter to everything that takes it.
  window.addEventListener("keydown", (event) => {
    const target = event.target, inside = (what) => target instanceof Element && target.closest(what);
    const text = inside("input:not([type=range]), textarea, [contenteditable]");
    const takesEnter = text || (inside("button, a, select, summary, [role=button], [role=slider]") && !inside("#e_stop"));
    if (event.code === "Escape" || (event.code === "Space" && !text) || (/^(Numpad)?Enter$/.test(event.code) && !takesEnter)) {
      event.preventDefault();
      event.stopPropagation();
      if (!event.repeat) stop();
    }
  }, true);
  // pointerdown is 100 ms earlier than click; click is what screen readers, voice control and scripts send.
  for (const kind of ["pointerdown", "click"]) {
    document.addEventListener(kind, (event) => {
      const button = event.target.closest && event.target.closest("#e_stop, [data-stop]");
      if (button) stop(button.dataset.stop || "", button);
    }, true);
  }
  if (sessionStorage.getItem("stops")) {
    [state.stopPressed, alarms.only] = JSON.parse(sessionStorage.getItem("stops"));
    alarms.sending = state.stopPressed;
    send();
  }
  // The page is loaded anew when its server was: what was ordered of the last one is kept across that.
  let kept = sessionStorage.getItem("order");
  if (kept) [alarms.server, alarms.order] = JSON.parse(kept);

  function keep() {
    const now = alarms.order ? JSON.stringify([alarms.server, { ...alarms.order, since: 0 }]) : null;
    if (now === kept) return;
    kept = now;
    if (now) sessionStorage.setItem("order", now);
    else sessionStorage.removeItem("order");
  }

  const clock = (time) => new Date(time).toLocaleTimeString();
  const seconds = (ms) => `${(ms / 1000).toFixed(1)} s`;
  const spaceOf = (node) => node.slice(0, node.lastIndexOf("/")) || "/";

  // What has to be seen: [class, text, label of its button, what the button does].
  function pending() {
    const rows = [];
    if (alarms.sending !== null && (alarms.tries > 1 || Date.now() - state.stopPressed > LIMIT)) {
      rows.push(["bad", `E-STOP HAS NOT REACHED THE CONSOLE'S SERVER for ${seconds(Date.now() - state.stopPressed)} (${alarms.why || "no answer"}). ` +
        "It is repeated. Use the hardware's own stop."]);
    }
    if (alarms.lost !== null) {
      rows.push(["bad", `NO ANSWER FROM THE CONSOLE'S SERVER for ${seconds(performance.now() - alarms.lost)}: what is drawn is old. Use the hardware's own stop.`]);
    }
    const order = alarms.order;
    // What was answered once is no longer known to hold while nobody says so.
    const unknown = rows.length > 0 || !state.frames;
    if (order && unknown) {
      const said = Object.entries(order.rows).map(([node, row]) => `${spaceOf(node)} ${row.state === "stopped" ? "was stopped" : "had not answered"}`);
      rows.push(["bad", `UNCONFIRMED. Last known: ${said.join(", ") || "no plant on the graph"}.`]);
    } else if (order) {
      const entries = Object.entries(order.rows), stopped = entries.filter(([, row]) => row.state === "stopped");
      const all = stopped.length === entries.length;
      rows.push([all ? "good" : "bad", all
        ? `STOPPED: ${entries.map(([node, row]) => `${spaceOf(node)} after ${row.after.toFixed(2)} s`).join(", ") || "no plant on the graph yet; each is stopped as it comes"}.`
        : `STOP ORDERED ${order.since.toFixed(1)} s ago: ${stopped.length} of ${entries.length} plants say that they are stopped.`,
        entries.length && !stopped.length ? null : "Acknowledge", () => request("/e_stop/acknowledge")]);
      for (const [node, row] of entries) {
        if (row.state === "stopped") { if (!all) rows.push(["good", `${spaceOf(node)} is stopped: ${row.text}`]); continue; }
        rows.push(["bad", `${spaceOf(node)} ${row.state === "asked" ? "HAS NOT ANSWERED" : "NO LONGER ANSWERS"} for ${row.silent_for.toFixed(1)} s` +
          `${row.text ? ` (${row.text})` : ""}. It is asked again until it does.`, "Give up on it",
          () => request(`/e_stop/give_up?node=${encodeURIComponent(node)}`)]);
      }
    }
    alarms.notes.forEach((one) => rows.push(["note", `${clock(one.at)}: ${one.text}${one.count > 1 ? ` (${one.count} times)` : ""}`, "Seen",
      async () => { alarms.notes.splice(alarms.notes.indexOf(one), 1); }]));
    return rows;
  }

  let alarmed = "";
  function showAlarms() {
    const place = document.getElementById("alarms");
    if (!place) return;
    const rows = pending(), buttons = JSON.stringify(rows.map(([kind, , label]) => [kind, label]));
    // Texts change ten times a second, buttons stay: who is about to press one must find it where it was.
    if (buttons !== alarmed) {
      alarmed = buttons;
      place.replaceChildren(...rows.map(([kind, , label]) => {
        const line = document.createElement("div");
        line.className = kind;
        line.append(document.createElement("span"));
        if (label) {
          const button = document.createElement("button");
          button.type = "button"; button.textContent = label;
          line.append(button);
        }
        return line;
      }));
    }
    rows.forEach(([, text, label, act], row) => {
      const span = place.children[row].firstChild;
      if (span.textContent !== text) span.textContent = text;
      if (label) place.children[row].lastChild.onclick = () => Promise.resolve(act()).catch((error) => { alarms.why = String(error.message); }).then(showAlarms);
    });
  }

  function note(text, kind = text) {
    const same = alarms.notes.find((other) => other.kind === kind);
    if (same) { same.count += 1; same.text = text; same.at = Date.now(); return; }
    alarms.notes.push({ kind, text, count: 1, at: Date.now() });
    if (alarms.notes.length > 4) alarms.notes.shift();
  }

  // The last picture's age is judged here, not by what the browser draws: a server that is frozen sends nothing, and closes nothing.
  let heard = performance.now() + 2000; // a page that has just been opened is given time to connect
  setInterval(() => {
    const silent = performance.now() - heard;
    if (silent > LIMIT && alarms.lost === null) alarms.lost = heard;
    showAlarms();
  }, 100);

  function say(text, bad) {
    const place = document.getElementById("link");
    if (place && place.textContent !== text) {
      place.textContent = text;
      place.className = bad ? "bad" : "";
    }
  }

  function connect() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/stream`);
    // A server that takes the connection and then reports nothing is tried anew, too.
    const patience = setInterval(() => { if (performance.now() - heard > 3000) { heard = performance.now() - LIMIT - 1; socket.close(); } }, 1000);
    socket.onopen = () => { state.connected = true; behind = Infinity; };
    socket.onmessage = (event) => { take(JSON.parse(event.data)); };
    socket.onclose = () => {
      clearInterval(patience);
      state.connected = false;
      say("no connection to the console, trying again", true);
      setTimeout(connect, 500);
    };
  }

  // The server's clock is the time axis: a browser that is late draws late, but nothing distorted.
  let behind = Infinity;
  const serverTime = () => performance.now() / 1000 - behind;

  function take(message) {
    const now = message.t, frame = message.plants;
    if (alarms.lost !== null) {
      note(`the console's server did not answer for ${seconds(performance.now() - alarms.lost)}; it does again`, "server");
      alarms.lost = null;
    }
    heard = performance.now();
    // An order that nobody has acknowledged outlives the server that took it: one that was started anew is given it again.
    if (alarms.server !== null && alarms.server !== message.server && alarms.order && !message.stop) {
      if (alarms.order.all) stop();
      else Object.keys(alarms.order.rows).forEach((node) => stop(node, null));
    } else if (alarms.sending === null || message.stop) alarms.order = message.stop;
    alarms.server = message.server;
    keep();
    behind = Math.min(behind, performance.now() / 1000 - now);
    state.frames += 1;
    for (const [name, plant] of Object.entries(frame)) {
      choose(name, plant);
      const before = state.plants[name];
      plant.moved = before && before.stamp_ns === plant.stamp_ns ? before.moved : now;
      const series = (state.series[name] ||= []);
      if (plant.theta !== undefined && plant.moved === now) series.push([now, ...ROWS.map(([, value]) => value(plant))]);
      while (series.length && series[0][0] < now - SPAN - 1) series.shift();
    }
    for (const name of Object.keys(state.plants)) if (!(name in frame)) note(`${name || "/"} is gone from the graph (its last state: ${MODES[state.plants[name].mode] || state.plants[name].mode || "unknown"})`);
    state.plants = frame;
    offerJoints();
    for (const name of Object.keys(state.series)) if (!(name in frame) && !state.series[name].length) delete state.series[name];
  }

  // More than two device pixels to a point cost four times the drawing, and nobody sees them on a moving line.
  const ratioOf = () => Math.min(2, window.devicePixelRatio || 1);

  function context(id) {
    const canvas = document.getElementById(id);
    if (!canvas || !canvas.clientWidth) return null;
    const ratio = ratioOf(), width = canvas.clientWidth, height = canvas.clientHeight;
    const fresh = canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio);
    if (fresh) { canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); }
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    return [c, width, height, fresh];
  }

  const tick = (value) => (value === 0 ? "0" : Math.abs(value) < 0.1 ? value.toFixed(3) : value.toPrecision(3));
  // Asking for the style makes the browser work it out; it changes with the colour scheme only.
  let inks = {};
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { inks = {}; tape.stale = true; });
  const ink = (name) => (inks[name] ||= getComputedStyle(document.documentElement).getPropertyValue(name));

  function drawPendulum(names) {
    const place = context("pendulum");
    if (!place) return;
    const [c, width, height] = place;
    c.clearRect(0, 0, width, height);
    const x = width / 2, y = height / 2, length = 0.36 * height;
    c.strokeStyle = ink("--line"); c.lineWidth = 1;
    c.setLineDash([4, 4]);
    c.beginPath(); c.moveTo(x, y - 1.2 * length); c.lineTo(x, y + 1.2 * length); c.stroke();
    c.setLineDash([]);
    names.forEach((name, index) => {
      const plant = state.plants[name];
      // The server knows the mechanism; joints of no known one have nothing to draw, their positions are in the lines.
      if (!plant?.points) return;
      const colour = COLOURS[index % COLOURS.length];
      // A cart beyond the picture is drawn at its edge, with its pole.
      const foot = plant.slides ? Math.max(30 - x, Math.min(width - 30 - x, length * plant.points[0][0])) : 0;
      const shift = plant.slides ? foot - length * plant.points[0][0] : 0;
      const points = plant.points.map(([right, up]) => [x + shift + length * right, y - length * up]);
      const [bx, by] = points[points.length - 1];
      const stale = serverTime() - plant.moved > 0.5;
      c.globalAlpha = stale ? 0.3 : 0.85;
      c.setLineDash(stale ? [5, 5] : []);
      c.strokeStyle = c.fillStyle = colour;
      c.lineWidth = 7 - 3 * index;
      if (plant.slides) {
        c.fillRect(x + foot - 26 + 3 * index, y - 9 + 2 * index, 52 - 6 * index, 18 - 4 * index);
        c.lineWidth = 1;
        c.beginPath(); c.moveTo(0, y + 12); c.lineTo(width, y + 12); c.stroke();
        c.lineWidth = 7 - 3 * index;
      }
      if (plant.circle) {
        c.lineWidth = 1;
        c.beginPath(); c.ellipse(x, y, length * plant.circle[0], length * plant.circle[1], 0, 0, 2 * Math.PI); c.stroke();
        c.lineWidth = 7 - 3 * index;
      }
      c.beginPath(); c.moveTo(...points[0]); points.slice(1).forEach(([px, py]) => c.lineTo(px, py)); c.stroke();
      points.slice(1, -1).forEach(([px, py]) => { c.beginPath(); c.arc(px, py, 6, 0, 7); c.fill(); });
      c.beginPath(); c.arc(bx, by, 13 - 2 * index, 0, 7);
      if (index) { c.lineWidth = 3; c.stroke(); } else c.fill();
      // Torques as arcs about the axis: 13 N m are three quarters of a turn; applied outside, disturbance inside.
      [[plant.applied, 34 + 14 * index, colour], [plant.disturbance, 27 + 14 * index, ink("--faint")]].forEach(([effort, radius, stroke]) => {
        if (!effort || plant.slides) return;
        const turn = 1.5 * Math.PI * Math.max(-1, Math.min(1, effort / 13));
        c.strokeStyle = stroke; c.lineWidth = 4;
        c.beginPath(); c.arc(x, y, radius, -Math.PI / 2, -Math.PI / 2 - turn, turn > 0); c.stroke();
      });
      c.globalAlpha = 1;
      c.setLineDash([]);
    });
    c.fillStyle = ink("--ink");
    if (names.some((name) => !state.plants[name]?.slides)) { c.beginPath(); c.arc(x, y, 4, 0, 7); c.fill(); }
  }

  // The lines are on a tape, a ring of pixel columns: what is new is drawn at its end, and a picture copies the last SPAN
  // seconds of it. Drawing each line anew for each picture kept a core busy where there is no graphics card.
  const AHEAD = 8; // columns that are kept empty before the newest one
  const tape = { canvas: document.createElement("canvas"), stale: true, ranges: [], last: {}, cleared: null, checked: 0 };

  function drawPlots(names, now) {
    const place = context("plots");
    if (!place) return;
    const [c, width, height, fresh] = place;
    const left = 50, right = width - 6, each = (height - 22) / ROWS.length, ratio = ratioOf();
    const columns = Math.max(1, Math.round((right - left) * ratio)), perSecond = columns / SPAN;
    const boxes = ROWS.map((_, row) => [row * each + 14, (row + 1) * each - 4]);
    if (fresh || tape.stale || tape.columns !== columns) {
      Object.assign(tape, { stale: false, columns, ring: columns + 128 });
      tape.canvas.width = tape.ring;
      tape.canvas.height = Math.round(height * ratio);
      forget();
    }
    if (now - tape.checked > 0.5 || now < tape.checked) fit(names, now);
    const unseen = names.flatMap((name) => (state.series[name] || []).filter((point) => !(point[0] <= tape.last[name]?.[0])));
    if (unseen.some((point) => ROWS.some((_, row) => outside(point[row + 1], tape.ranges[row])))) fit(names, now);
    if (tape.relabel) { frame(c, width, height, boxes, left, right); tape.relabel = false; }

    const t = tape.canvas.getContext("2d");
    const end = Math.floor(now * perSecond);
    if (tape.cleared === null || Math.abs(end - tape.cleared) > tape.ring) {
      forget();
      tape.cleared = end + AHEAD;
    }
    for (; tape.cleared < end + AHEAD; tape.cleared += 1) t.clearRect(tape.cleared % tape.ring, 0, 1, tape.canvas.height);
    names.forEach((name, index) => extend(t, name, index, end - columns, perSecond, boxes, ratio));

    // The ring is cut where it begins: two pieces at most for each box.
    const first = ((end - columns) % tape.ring + tape.ring) % tape.ring, piece = Math.min(columns, tape.ring - first);
    for (const [top, bottom] of boxes) {
      const y = Math.round(top * ratio), tall = Math.round(bottom * ratio) - y;
      c.clearRect(left, y / ratio, right - left, tall / ratio);
      c.drawImage(tape.canvas, first, y, piece, tall, left, y / ratio, piece / ratio, tall / ratio);
      if (piece < columns) {
        c.drawImage(tape.canvas, 0, y, columns - piece, tall, left + piece / ratio, y / ratio, (columns - piece) / ratio, tall / ratio);
      }
    }
    c.strokeStyle = ink("--faint"); c.lineWidth = 0.5;
    boxes.forEach(([top, bottom], row) => {
      const [low, high] = tape.ranges[row] || [0, 0];
      if (!(low < 0 && high > 0)) return;
      const zero = bottom + low / (high - low) * (bottom - top);
      c.beginPath(); c.moveTo(left, zero); c.lineTo(right, zero); c.stroke();
    });
  }

  const outside = (value, range) => value !== undefined && range && (value < range[0] || value > range[1]);

  // Draw everything again with the next picture.
  function forget() {
    tape.last = {};
    tape.cleared = null;
    tape.relabel = true;
    tape.canvas.getContext("2d").clearRect(0, 0, tape.canvas.width, tape.canvas.height);
  }

  // Ranges end at round numbers and shrink late, so that they stay where they are for most pictures.
  function fit(names, now) {
    tape.checked = now;
    let changed = false;
    ROWS.forEach((_, row) => {
      let low = Infinity, high = -Infinity;
      for (const name of names) for (const point of state.series[name] || []) {
        const value = point[row + 1];
        if (point[0] > now - SPAN && value !== undefined) { low = Math.min(low, value); high = Math.max(high, value); }
      }
      if (!(high >= low)) { low = -1; high = 1; }
      const room = Math.max(0.04 * (high - low), 2e-3);
      const step = 10 ** Math.floor(Math.log10(high - low + 2 * room)) / 2;
      const wanted = [Math.floor((low - room) / step) * step, Math.ceil((high + room) / step) * step];
      const present = tape.ranges[row];
      const fits = present && low >= present[0] && high <= present[1];
      if (!fits || 2 * (wanted[1] - wanted[0]) <= present[1] - present[0]) { tape.ranges[row] = wanted; changed = true; }
    });
    if (changed) forget();
  }

  function extend(t, name, index, oldest, perSecond, boxes, ratio) {
    const series = state.series[name] || [];
    let at = series.length;
    const seen = tape.last[name]?.[0] ?? -Infinity;
    while (at > 0 && series[at - 1][0] > seen) at -= 1;
    if (at === series.length) return;
    t.strokeStyle = COLOURS[index % COLOURS.length]; t.lineWidth = (index ? 1.8 : 1.3) * ratio;
    ROWS.forEach((_, row) => {
      const [top, bottom] = boxes[row], [low, high] = tape.ranges[row];
      const y = (value) => (bottom - (value - low) / (high - low) * (bottom - top)) * ratio;
      let before = tape.last[name];
      t.beginPath();
      for (const point of series.slice(at)) {
        const value = point[row + 1], from = before;
        before = point;
        // Where nothing came for a while there is no line: a gap is a gap.
        if (value === undefined || !from || from[row + 1] === undefined || point[0] - from[0] > 0.3) continue;
        const x0 = from[0] * perSecond, x1 = point[0] * perSecond;
        if (x0 < oldest) continue;
        // The second plant's line is dashed, the third's dotted: told apart without colour.
        if (index && Math.floor(x0 / (6 * ratio)) % (index + 1) === index) continue;
        const shift = Math.floor(x0 / tape.ring) * tape.ring;
        t.moveTo(x0 - shift, y(from[row + 1])); t.lineTo(x1 - shift, y(value));
        if (x1 - shift >= tape.ring) { t.moveTo(x0 - shift - tape.ring, y(from[row + 1])); t.lineTo(x1 - shift - tape.ring, y(value)); }
      }
      t.stroke();
    });
    tape.last[name] = series[series.length - 1];
  }

  function frame(c, width, height, boxes, left, right) {
    c.clearRect(0, 0, width, height);
    c.font = "11px system-ui, sans-serif";
    c.lineWidth = 1; c.strokeStyle = ink("--line"); c.fillStyle = ink("--faint");
    boxes.forEach(([top, bottom], row) => {
      const [low, high] = tape.ranges[row];
      c.strokeRect(left - 1.5, top - 1.5, right - left + 3, bottom - top + 3);
      const units = [...new Set(Object.values(state.plants).map((plant) => plant.unit || "rad"))];
      c.textAlign = "left"; c.fillText([...(units.length ? units : ["rad"])].sort().reverse().map((unit) => ROWS[row][0][unit]).join(", "), left, top - 4);
      c.textAlign = "right"; c.fillText(tick(high), left - 5, top + 9); c.fillText(tick(low), left - 5, bottom);
    });
    c.textAlign = "center";
    for (let second = 0; second <= SPAN; second += 2) {
      c.fillText(second ? `-${second} s` : "now", right - second / SPAN * (right - left) - (second ? 0 : 10), height - 5);
    }
  }

  const described = { at: 0, text: "" };
  function describe(names, now) {
    const place = document.getElementById("plants");
    if (!place) return;
    const shown = names.filter((name) => state.plants[name]).map((name) => {
      const plant = state.plants[name];
      const age = now - plant.moved;
      if (age > 0.5) return [name, "silent", `no state for ${age.toFixed(0)} s; before that: ${MODES[plant.mode] || plant.mode || "unknown"}`];
      const rate = plant.rate ? ` · ${Number(plant.rate).toFixed(1)} Hz` : "";
      const jitter = plant.jitter ? ` · jitter ${(Number(plant.jitter) / 1000).toFixed(2)} ms (99 %)` : "";
      if (plant.mode === "armed_effort" && plant.reason.includes("no fresh command")) return [name, plant.mode, `${rate}${jitter}`, "ARMED, no commander: zero torque"];
      return [name, plant.mode, `${plant.reason.replace(`${plant.mode}: `, "")}${rate}${jitter}`];
    });
    if (JSON.stringify(shown) !== described.text) {
      described.text = JSON.stringify(shown);
      place.replaceChildren(...shown.map(([name, mode, rest, title_ = MODES[mode] || mode]) => {
        const line = document.createElement("div");
        line.dataset.plant = name;
        const place_ = names.indexOf(name), dot = document.createElement("i");
        dot.style.borderTopColor = COLOURS[place_ % COLOURS.length]; dot.className = place_ ? "dashed" : "";
        const title = document.createElement("b"); title.textContent = name || "/";
        const badge = document.createElement("span"); badge.className = mode; badge.textContent = ` ${title_} `;
        line.append(dot, title, badge, rest);
        return line;
      }));
    }
    if (!names.length) place.textContent = "No plant in this ROS domain yet.";
    if (state.connected) say(`${names.length} plant${names.length === 1 ? "" : "s"} · ${state.fps} pictures/s`, false);
  }

  let taken = 0, counted = performance.now();
  function draw(time) {
    const names = [...new Set([...Object.keys(state.series), ...Object.keys(state.plants)])].sort().reverse();
    const now = serverTime();
    drawPendulum(names);
    drawPlots(names, now);
    state.drawn += 1;
    if (time - described.at > 100) { describe(names, now); described.at = time; }
    if (time - counted > 1000) { state.fps = Math.round((state.frames - taken) * 1000 / (time - counted)); taken = state.frames; counted = time; }
    requestAnimationFrame(draw);
  }
  connect();
  requestAnimationFrame(draw);
})();
