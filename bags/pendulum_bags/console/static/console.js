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
  const state = { plants: {}, series: {}, frames: 0, connected: false, stopPressed: 0, stopAnswered: 0, fps: 0 };
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

  function context(id) {
    const canvas = document.getElementById(id);
    if (!canvas) return null;
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    return [c, width, height];
  }

  const tick = (value) => (Math.abs(value) < 0.1 ? value.toFixed(3) : value.toPrecision(3));
  const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);

  function drawPendulum(names) {
    const place = context("pendulum");
    if (!place) return;
    const [c, width, height] = place;
    const x = width / 2, y = height / 2, length = 0.36 * height;
    c.strokeStyle = ink("--line");
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

  function drawPlots(names, now) {
    const place = context("plots");
    if (!place) return;
    const [c, width, height] = place;
    const left = 50, right = width - 6, each = (height - 22) / ROWS.length;
    c.font = "11px system-ui, sans-serif";
    ROWS.forEach(([title], row) => {
      const top = row * each + 14, bottom = (row + 1) * each - 4;
      let low = Infinity, high = -Infinity;
      for (const name of names) for (const point of state.series[name] || []) {
        const value = point[row + 1];
        if (point[0] > now - SPAN && value !== undefined) { low = Math.min(low, value); high = Math.max(high, value); }
      }
      if (!(high >= low)) { low = -1; high = 1; }
      const pad = Math.max(0.08 * (high - low), 5e-3);
      low -= pad; high += pad;
      c.strokeStyle = ink("--line"); c.lineWidth = 1;
      c.strokeRect(left, top, right - left, bottom - top);
      c.fillStyle = ink("--faint");
      c.textAlign = "left"; c.fillText(title, left, top - 3);
      c.textAlign = "right";
      c.fillText(tick(high), left - 4, top + 9); c.fillText(tick(low), left - 4, bottom);
      c.save();
      c.beginPath(); c.rect(left, top, right - left, bottom - top); c.clip();
      names.forEach((name, index) => {
        c.strokeStyle = COLOURS[index % COLOURS.length]; c.lineWidth = 1.3; c.globalAlpha = 0.9;
        c.beginPath();
        let last = -Infinity;
        for (const point of state.series[name] || []) {
          if (point[row + 1] === undefined) continue;
          const px = right - (now - point[0]) / SPAN * (right - left);
          const py = bottom - (point[row + 1] - low) / (high - low) * (bottom - top);
          // Where nothing came for a while there is no line: a gap is a gap.
          if (point[0] - last > 0.3) c.moveTo(px, py); else c.lineTo(px, py);
          last = point[0];
        }
        c.stroke();
      });
      c.restore();
    });
    c.fillStyle = ink("--faint"); c.textAlign = "center";
    for (let second = 0; second <= SPAN; second += 2) {
      c.fillText(second ? `-${second} s` : "now", right - second / SPAN * (right - left) - (second ? 0 : 10), height - 5);
    }
  }

  function describe(names, now) {
    const place = document.getElementById("plants");
    if (!place) return;
    place.replaceChildren(...names.filter((name) => state.plants[name]).map((name, index) => {
      const plant = state.plants[name], line = document.createElement("div");
      line.dataset.plant = name;
      const dot = document.createElement("i"); dot.style.background = COLOURS[index % COLOURS.length];
      const title = document.createElement("b"); title.textContent = name || "/";
      const mode = document.createElement("span"); mode.className = plant.mode; mode.textContent = ` ${plant.mode} `;
      const silent = now - plant.moved > 1 ? ` · no state for ${(now - plant.moved).toFixed(0)} s` : "";
      const rate = plant.rate ? ` · ${Number(plant.rate).toFixed(1)} Hz` : "";
      const jitter = plant.jitter ? ` · jitter ${(Number(plant.jitter) / 1000).toFixed(2)} ms (99 %)` : "";
      const reason = plant.reason.replace(`${plant.mode}: `, "");
      line.append(dot, title, mode, `${reason}${rate}${jitter}${silent}`);
      return line;
    }));
    if (!names.length) place.textContent = "No plant in this ROS domain yet.";
    if (state.connected) say(`${names.length} plant${names.length === 1 ? "" : "s"} · ${state.fps} pictures/s`, false);
  }

  let drawn = 0, counted = performance.now(), described = 0;
  function draw(time) {
    const names = [...new Set([...Object.keys(state.series), ...Object.keys(state.plants)])].sort().reverse();
    const now = serverTime();
    drawPendulum(names);
    drawPlots(names, now);
    drawn += 1;
    if (time - described > 100) { describe(names, now); described = time; }
    if (time - counted > 1000) { state.fps = Math.round(drawn * 1000 / (time - counted)); drawn = 0; counted = time; }
    requestAnimationFrame(draw);
  }
  connect();
  requestAnimationFrame(draw);
})();
