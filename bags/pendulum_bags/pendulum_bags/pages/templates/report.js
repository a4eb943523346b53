(() => {
  "use strict";
  const element = (id) => document.getElementById(id);
  const read = (id) => JSON.parse(element(id).textContent);

  // -- plots -----------------------------------------------------------------------------------------------------

  const config = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };

  async function unpack(id) {
    const packed = Uint8Array.from(atob(element(id).textContent.trim()), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  }

  async function loadPlotly() {
    const script = document.createElement("script");
    script.textContent = await unpack("plotly-packed");
    document.head.append(script);
    element("plotly-packed").remove();
  }

  function axesOf(graph, letter) {
    return Object.keys(graph._fullLayout).filter((name) => new RegExp(`^${letter}axis\\d*$`).test(name));
  }

  function moveAxes(graph, letter, change) {
    const update = {};
    for (const name of axesOf(graph, letter)) {
      const [low, high] = graph._fullLayout[name].range;
      const [a, b] = change(low, high);
      update[`${name}.range[0]`] = a;
      update[`${name}.range[1]`] = b;
    }
    Plotly.relayout(graph, update);
  }

  function resetAxes(graph) {
    const update = {};
    for (const letter of ["x", "y"]) {
      for (const name of axesOf(graph, letter)) {
        const first = graph.firstRanges[name];
        if (first) update[`${name}.range`] = first.slice();
        else update[`${name}.autorange`] = true;
      }
    }
    Plotly.relayout(graph, update);
  }

  const zoom = (factor) => (low, high) => {
    const middle = (low + high) / 2;
    return [middle - ((middle - low) * factor), middle + ((high - middle) * factor)];
  };
  const pan = (share) => (low, high) => [low + share * (high - low), high + share * (high - low)];
  const keys = {
    "+": (g) => moveAxes(g, "x", zoom(0.7)),
    "=": (g) => moveAxes(g, "x", zoom(0.7)),
    "-": (g) => moveAxes(g, "x", zoom(1 / 0.7)),
    ArrowLeft: (g) => moveAxes(g, "x", pan(-0.15)),
    ArrowRight: (g) => moveAxes(g, "x", pan(0.15)),
    ArrowUp: (g) => moveAxes(g, "y", pan(0.15)),
    ArrowDown: (g) => moveAxes(g, "y", pan(-0.15)),
    0: resetAxes,
  };

  const folded = (place) => place.closest("details:not([open])");

  async function drawAll() {
    const graphs = read("graphs");
    await draw(graphs, document);
    for (const one of document.querySelectorAll("details")) {
      one.addEventListener("toggle", () => one.open && draw(graphs, one));
    }
    document.documentElement.dataset.ready = "true";
  }

  // What is folded has no width yet: its plots are drawn when it is opened.
  async function draw(graphs, part) {
    for (const place of part.querySelectorAll(".graph")) {
      if (place.firstRanges || folded(place)) continue;
      const { data, layout } = graphs[place.dataset.graph];
      if (window.innerWidth < 700) {
        layout.margin.l = 52;
        layout.margin.r = 6;
        layout.font.size = 12;
        layout.dragmode = false; // a finger on a phone scrolls the page
        for (const axis of Object.values(layout)) {
          // Long names of rows would leave no room for the rows.
          if (axis && axis.ticktext) axis.ticktext = axis.ticktext.map((name) => name.replace(/ (less the|difference|\(ratio)/, "<br>$1"));
        }
        const names = data.filter((trace) => trace.showlegend).map((trace) => trace.name);
        const wide = names.reduce((sum, name) => sum + 52 + 6.5 * name.length, 0);
        const more = 19 * Math.max(0, Math.ceil(wide / (window.innerWidth - 70)) - 1);
        layout.margin.t += more;
        layout.height += more;
      }
      place.firstRanges = {};
      for (const [name, axis] of Object.entries(layout)) {
        if (axis && axis.range) place.firstRanges[name] = axis.range.slice();
      }
      // On a phone the tool bar would lie on the legend, and fingers scroll.
      await Plotly.newPlot(place, data, layout, { ...config, displayModeBar: window.innerWidth < 700 ? false : "hover" });
      place.addEventListener("keydown", (event) => {
        const action = keys[event.key];
        if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        action(place);
      });
    }
  }

  function fitToPaper() {
    // Paper is narrower than most screens: draw for its width, and go back afterwards.
    window.addEventListener("beforeprint", () => {
      for (const place of document.querySelectorAll(".js-plotly-plot")) {
        const beside = place.parentElement.classList.contains("side-by-side");
        Plotly.relayout(place, { autosize: false, width: beside ? 325 : 670 });
      }
    });
    window.addEventListener("afterprint", () => {
      for (const place of document.querySelectorAll(".js-plotly-plot")) Plotly.relayout(place, { autosize: true, width: null });
    });
  }

  // Paper has nothing to click on.
  let opened = [];
  window.addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")];
    for (const one of opened) one.open = true;
  });
  window.addEventListener("afterprint", () => {
    for (const one of opened) one.open = false;
  });
  for (const link of document.querySelectorAll("nav a")) {
    link.addEventListener("click", () => {
      const details = document.querySelector(`${link.hash} > details`);
      if (details) details.open = true;
    });
  }

  loadPlotly().then(drawAll).then(fitToPaper).catch((error) => {
    const notice = element("failure");
    notice.hidden = false;
    notice.textContent = `The plots cannot be drawn in this browser (${error.message}); the same figures lie in the folder "figures" beside this page.`;
  });

  // -- animation -------------------------------------------------------------------------------------------------

  const canvas = element("animation");
  if (canvas) {
    const tracks = read("animation-data");
    const brush = canvas.getContext("2d");
    const last = Math.min(tracks.sim.length, tracks.hw.length) - 1;
    const seek = element("seek");
    const play = element("play");
    let frame = 0;
    let started = null;
    seek.max = last;
    element("animation-text").textContent =
      `Simulation (solid, round) and ${canvas.dataset.hardware} (dashed, square) about upright, deviations enlarged ${tracks.factor.toFixed(0)} times.`;

    const link = (angle, colour, dash, square) => {
      const x0 = canvas.width / 2;
      const y0 = canvas.height - 30;
      const x = x0 - Math.sin(angle * tracks.factor) * 230;
      const y = y0 - Math.cos(angle * tracks.factor) * 230;
      brush.strokeStyle = colour;
      brush.fillStyle = colour;
      brush.lineWidth = 4;
      brush.setLineDash(dash);
      brush.beginPath();
      brush.moveTo(x0, y0);
      brush.lineTo(x, y);
      brush.stroke();
      brush.beginPath();
      if (square) brush.rect(x - 10, y - 10, 20, 20);
      else brush.arc(x, y, 12, 0, 2 * Math.PI);
      brush.fill();
    };

    const chain = (points, colour, dash, square) => {
      brush.strokeStyle = colour;
      brush.fillStyle = colour;
      brush.lineWidth = 4;
      brush.setLineDash(dash);
      brush.beginPath();
      points.forEach(([x, y], index) => (index ? brush.lineTo(x, y) : brush.moveTo(x, y)));
      brush.stroke();
      for (const [x, y] of points) {
        brush.beginPath();
        if (square) brush.rect(x - 6, y - 6, 12, 12);
        else brush.arc(x, y, 7, 0, 2 * Math.PI);
        brush.fill();
      }
    };

    const drawChains = () => {
      brush.clearRect(0, 0, canvas.width, canvas.height);
      chain(tracks.sim[frame], "#0072b2", [], false);
      chain(tracks.hw[frame], "#d55e00", [10, 6], true);
    };

    const drawPendulums = () => {
      brush.clearRect(0, 0, canvas.width, canvas.height);
      brush.setLineDash([2, 4]);
      brush.strokeStyle = "#999";
      brush.lineWidth = 1;
      brush.beginPath();
      brush.moveTo(canvas.width / 2, 14);
      brush.lineTo(canvas.width / 2, canvas.height - 30);
      brush.stroke();
      link(tracks.sim[frame], "#0072b2", [], false);
      link(tracks.hw[frame], "#d55e00", [10, 6], true);
      brush.setLineDash([]);
      brush.fillStyle = "#333";
      brush.fillRect(canvas.width / 2 - 22, canvas.height - 30, 44, 12);
    };

    const draw = () => {
      // One angle, or the points of all links.
      if (typeof tracks.sim[frame] === "number") drawPendulums();
      else drawChains();
      element("clock").textContent = `${(frame * tracks.period).toFixed(2)} s`;
    };

    const step = (now) => {
      if (started === null) return;
      // A picture bears the time at which the browser began it, which may lie before the press of the button.
      frame = Math.max(0, Math.min(last, Math.floor((now - started) / 1000 / tracks.period)));
      seek.value = frame;
      draw();
      if (frame < last) requestAnimationFrame(step);
      else stop();
    };
    const stop = () => {
      started = null;
      play.textContent = "Play";
    };
    play.addEventListener("click", () => {
      if (started !== null) return stop();
      if (frame >= last) frame = 0;
      started = performance.now() - frame * tracks.period * 1000;
      play.textContent = "Pause";
      requestAnimationFrame(step);
      return undefined;
    });
    seek.addEventListener("input", () => {
      frame = Number(seek.value);
      if (started !== null) started = performance.now() - frame * tracks.period * 1000;
      draw();
    });
    draw();
  }
})();
