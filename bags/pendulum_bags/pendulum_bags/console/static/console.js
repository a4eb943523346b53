// Draws what /stream sends, and stops the plants. Needs nothing of the page's framework, so that it works without it.
"use strict";
(() => {
  const SPAN = 10; // seconds shown
  const COLOURS = ["#1f77b4", "#ff7f0e", "#2ca02c", "#9467bd"];
  const ROWS = [
    ["angle from upright [rad]", (p) => Math.atan2(Math.sin(p.theta - Math.PI), Math.cos(p.theta - Math.PI))],
    ["velocity [rad/s]", (p) => p.theta_dot],
    ["command [N m]", (p) => p.command],
    ["disturbance [N m]", (p) => p.disturbance],
    ["applied effort [N m]", (p) => p.applied],
  ];
  const state = { plants: {}, series: {}, frames: 0, drawn: 0, connected: false, stopPressed: 0, stopAnswered: 0, fps: 0 };
  window.pendulumConsole = state;

  async function stop() {
    const button = document.getElementById("e_stop");
    state.stopPressed = Date.now();
    button.classList.add("pressed");
    try {
      const answer = await fetch("/e_stop", { method: "POST" });
      if (!answer.ok) throw new Error(await answer.text());
      state.stopAnswered = Date.now();
    } catch (error) {
      state.failure = String(error);
      say("E-STOP DID NOT REACH THE SERVER: use the hardware's own stop", true);
    }
    setTimeout(() => button.classList.remove("pressed"), 400);
  }

  // In the capture phase and wherever the focus is: a stop must not depend on what was clicked last. Space is left to
  // fields that take text.
  window.addEventListener("keydown", (event) => {
    const text = event.target instanceof HTMLInputElement && event.target.type !== "range";
    if (event.code === "Escape" || (event.code === "Space" && !text)) {
      event.preventDefault();
      event.stopPropagation();
      if (!event.repeat) stop();
    }
  }, true);
  document.addEventListener("pointerdown", (event) => {
    if (event.target.closest && event.target.closest("#e_stop")) stop();
  });

  function say(text, bad) {
    const place = document.getElementById("link");
    if (place && place.textContent !== text) {
      place.textContent = text;
      place.className = bad ? "bad" : "";
    }
  }

  function connect() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/stream`);
    socket.onopen = () => { state.connected = true; behind = Infinity; };
    socket.onmessage = (event) => { take(JSON.parse(event.data)); };
    socket.onclose = () => {
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
    behind = Math.min(behind, performance.now() / 1000 - now);
    state.frames += 1;
    for (const [name, plant] of Object.entries(frame)) {
      const before = state.plants[name];
      plant.moved = before && before.stamp_ns === plant.stamp_ns ? before.moved : now;
      const series = (state.series[name] ||= []);
      if (plant.theta !== undefined && plant.moved === now) series.push([now, ...ROWS.map(([, value]) => value(plant))]);
      while (series.length && series[0][0] < now - SPAN - 1) series.shift();
    }
    state.plants = frame;
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
      if (!plant || plant.theta === undefined) return;
      const colour = COLOURS[index % COLOURS.length];
      const bx = x + length * Math.sin(plant.theta), by = y + length * Math.cos(plant.theta);
      c.globalAlpha = 0.85;
      c.strokeStyle = c.fillStyle = colour;
      c.lineWidth = 7 - 3 * index;
      c.beginPath(); c.moveTo(x, y); c.lineTo(bx, by); c.stroke();
      c.beginPath(); c.arc(bx, by, 13 - 4 * index, 0, 7); c.fill();
      // Torques as arcs about the axis: 13 N m are three quarters of a turn; applied outside, disturbance inside.
      [[plant.applied, 34 + 14 * index, colour], [plant.disturbance, 27 + 14 * index, ink("--faint")]].forEach(([effort, radius, stroke]) => {
        if (!effort) return;
        const turn = 1.5 * Math.PI * Math.max(-1, Math.min(1, effort / 13));
        c.strokeStyle = stroke; c.lineWidth = 4;
        c.beginPath(); c.arc(x, y, radius, -Math.PI / 2, -Math.PI / 2 - turn, turn > 0); c.stroke();
      });
      c.globalAlpha = 1;
    });
    c.fillStyle = ink("--ink");
    c.beginPath(); c.arc(x, y, 4, 0, 7); c.fill();
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
    names.forEach((name, index) => extend(t, name, COLOURS[index % COLOURS.length], end - columns, perSecond, boxes, ratio));

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

  function extend(t, name, colour, oldest, perSecond, boxes, ratio) {
    const series = state.series[name] || [];
    let at = series.length;
    const seen = tape.last[name]?.[0] ?? -Infinity;
    while (at > 0 && series[at - 1][0] > seen) at -= 1;
    if (at === series.length) return;
    t.strokeStyle = colour; t.lineWidth = 1.3 * ratio;
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
      c.textAlign = "left"; c.fillText(ROWS[row][0], left, top - 4);
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
      const silent = now - plant.moved > 1 ? ` · no state for ${(now - plant.moved).toFixed(0)} s` : "";
      const rate = plant.rate ? ` · ${Number(plant.rate).toFixed(1)} Hz` : "";
      const jitter = plant.jitter ? ` · jitter ${(Number(plant.jitter) / 1000).toFixed(2)} ms (99 %)` : "";
      return [name, plant.mode, `${plant.reason.replace(`${plant.mode}: `, "")}${rate}${jitter}${silent}`];
    });
    if (JSON.stringify(shown) !== described.text) {
      described.text = JSON.stringify(shown);
      place.replaceChildren(...shown.map(([name, mode, rest]) => {
        const line = document.createElement("div");
        line.dataset.plant = name;
        const dot = document.createElement("i"); dot.style.background = COLOURS[names.indexOf(name) % COLOURS.length];
        const title = document.createElement("b"); title.textContent = name || "/";
        const badge = document.createElement("span"); badge.className = mode; badge.textContent = ` ${mode} `;
        line.append(dot, title, badge, rest);
        return line;
      }));
    }
    if (!names.length) place.textContent = "No plant in this ROS domain yet.";
    if (state.connected) say(`${names.length} plant${names.length === 1 ? "" : "s"} · ${state.fps} pictures/s`, false);
  }

  let drawn = 0, counted = performance.now();
  function draw(time) {
    const names = [...new Set([...Object.keys(state.series), ...Object.keys(state.plants)])].sort().reverse();
    const now = serverTime();
    drawPendulum(names);
    drawPlots(names, now);
    drawn += 1; state.drawn += 1;
    if (time - described.at > 100) { describe(names, now); described.at = time; }
    if (time - counted > 1000) { state.fps = Math.round(drawn * 1000 / (time - counted)); drawn = 0; counted = time; }
    requestAnimationFrame(draw);
  }
  connect();
  requestAnimationFrame(draw);
})();
