"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const steps = data.steps, dt = data.dt, film = data.film;
  const LEFT = 50, RIGHT = 8, TOP = 6, BOTTOM = 20;
  const FONT = "11px system-ui, sans-serif", GRID = "#e4e4e4", INK = "#444", CURSOR = "#b00020";
  let row = 0, playing = false, began = 0, from = 0, drawn = -1;
  let first = 0, last = steps - 1; // first and last step that the plots show
  const plots = [];

  // Numbers lie row by row, as 32-bit floats.
  const series = {};
  for (const [name, one] of Object.entries(data.series)) {
    const text = atob(one.values), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    series[name] = { values: new Float32Array(bytes.buffer), columns: one.columns };
  }
  const at = (line, k) => { const one = series[line.series]; return one.values[k * one.columns + line.column]; };
  const make = (tag, parent, text, kind) => {
    const made = document.createElement(tag);
    if (text !== undefined) made.textContent = text;
    if (kind) made.className = kind;
    parent.appendChild(made);
    return made;
  };
  const short = (value) => {
    if (!Number.isFinite(value)) return "–";
    const size = Math.abs(value);
    return value.toFixed(size >= 100 ? 0 : size >= 10 ? 1 : size >= 0.1 || size === 0 ? 2 : 4);
  };

  function ticks(low, high, count) {
    const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
    const unit = [1, 2, 5, 10].find((factor) => factor * power >= raw) * power, found = [];
    for (let k = Math.ceil(low / unit - 1e-9); k * unit <= high + 1e-9 * unit; k++) found.push(k * unit);
    return found;
  }

  function rangeOf(panel) {
    let low = Infinity, high = -Infinity;
    const take = (value) => {
      if (Number.isFinite(value)) { low = Math.min(low, value); high = Math.max(high, value); }
    };
    if (panel.kind === "stack") {
      for (let k = 0; k < steps; k++) {
        let up = 0, down = 0;
        for (const line of panel.lines) {
          const value = at(line, k);
          if (value > 0) up += value; else if (value < 0) down += value;
        }
        take(up); take(down);
      }
    } else for (const line of panel.lines) for (let k = 0; k < steps; k++) take(at(line, k));
    for (const value of panel.include || []) take(value);
    if (!(low <= high)) [low, high] = [-1, 1];
    const room = high > low ? 0.05 * (high - low) : Math.max(1e-6, 0.1 * Math.abs(high) || 1);
    return [low - room, high + room];
  }

  function makePanel(parent, panel) {
    const box = make("div", parent, undefined, "panel");
    const head = make("h3", box, panel.title + " ");
    make("span", head, panel.unit ? "[" + panel.unit + "]" : "");
    const legend = make("div", box, undefined, "legend"), values = [];
    for (const line of panel.lines) {
      const entry = make("span", legend);
      const chip = make("i", entry, undefined, line.dashed ? "dashed" : undefined);
      chip.style.color = line.color;
      entry.append(line.label);
      values.push(make("b", entry));
    }
    const holder = make("div", box, undefined, "plot");
    holder.style.height = (panel.kind === "gait" ? 26 + 20 * panel.lines.length : panel.height || 150) + "px";
    const base = make("canvas", holder), over = make("canvas", holder);
    base.setAttribute("aria-label", panel.title);
    const plot = { panel, holder, base, over, values, range: panel.kind === "gait" ? [0, 1] : rangeOf(panel), cursor: -1 };
    plots.push(plot);
    const move = (event) => {
      const box = holder.getBoundingClientRect(), inner = box.width - LEFT - RIGHT;
      const share = Math.max(0, Math.min(1, (event.clientX - box.left - LEFT) / inner));
      show(first + share * (last - first));
    };
    // Hovering moves the cursor only while nothing plays; pressing always moves it.
    holder.addEventListener("pointermove", (event) => { if (!playing || event.buttons) { pause(); move(event); } });
    holder.addEventListener("pointerdown", (event) => { pause(); move(event); });
    return plot;
  }

  const xOf = (plot, k) => LEFT + (plot.width - LEFT - RIGHT) * (last > first ? (k - first) / (last - first) : 0);

  function prepare(canvas, width, height) {
    const scale = window.devicePixelRatio || 1;
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
    const brush = canvas.getContext("2d");
    brush.setTransform(scale, 0, 0, scale, 0, 0);
    brush.font = FONT;
    return brush;
  }

  function drawPlot(plot) {
    const { panel, holder } = plot, width = holder.clientWidth, height = holder.clientHeight;
    if (!width || (plot.width === width && plot.height === height && plot.first === first && plot.last === last)) return;
    Object.assign(plot, { width, height, first, last });
    const brush = prepare(plot.base, width, height);
    plot.brush = prepare(plot.over, width, height);
    const [low, high] = plot.range, floor = height - BOTTOM;
    const y = (value) => floor - (value - low) / (high - low) * (floor - TOP);
    brush.lineWidth = 1;
    brush.textBaseline = "top";
    brush.textAlign = "center";
    for (const time of ticks((first + 1) * dt, (last + 1) * dt, Math.max(3, width / 70))) {
      const x = xOf(plot, time / dt - 1);
      brush.strokeStyle = GRID;
      brush.beginPath(); brush.moveTo(x, TOP); brush.lineTo(x, floor); brush.stroke();
      brush.fillStyle = INK;
      if (x > LEFT - 1 && x < width - 34) brush.fillText(String(+time.toFixed(6)), x, floor + 4);
    }
    brush.textAlign = "right";
    brush.fillText("s", width - RIGHT, floor + 4);
    if (panel.kind === "gait") drawGait(plot, brush, floor);
    else {
      brush.textBaseline = "middle";
      for (const value of ticks(low, high, Math.max(2, (floor - TOP) / 32))) {
        brush.strokeStyle = Math.abs(value) < 1e-12 ? "#aaa" : GRID;
        brush.beginPath(); brush.moveTo(LEFT, y(value)); brush.lineTo(width - RIGHT, y(value)); brush.stroke();
        brush.fillStyle = INK;
        brush.fillText(String(+value.toPrecision(6)), LEFT - 5, y(value));
      }
      brush.save();
      brush.beginPath(); brush.rect(LEFT, TOP - 1, width - LEFT - RIGHT, floor - TOP + 2); brush.clip();
      if (panel.kind === "stack") drawStack(plot, brush, y); else drawLines(plot, brush, y);
      brush.restore();
    }
    plot.cursor = -1;
  }

  function drawLines(plot, brush, y) {
    for (const limit of plot.panel.limits || []) {
      brush.strokeStyle = "#000";
      brush.setLineDash([2, 4]);
      brush.beginPath(); brush.moveTo(LEFT, y(limit)); brush.lineTo(plot.width, y(limit)); brush.stroke();
      brush.setLineDash([]);
    }
    for (const line of plot.panel.lines) {
      brush.strokeStyle = line.color;
      brush.lineWidth = line.dashed ? 1.6 : 1.3;
      brush.setLineDash(line.dashed ? [6, 4] : []);
      brush.beginPath();
      let pen = false;
      for (let k = first; k <= last; k++) {
        const value = at(line, k);
        if (!Number.isFinite(value)) { pen = false; continue; }
        if (pen) brush.lineTo(xOf(plot, k), y(value)); else brush.moveTo(xOf(plot, k), y(value));
        pen = true;
      }
      brush.stroke();
    }
    brush.setLineDash([]);
  }

  function drawStack(plot, brush, y) {
    const up = new Float64Array(steps), down = new Float64Array(steps);
    for (const line of plot.panel.lines) {
      brush.fillStyle = line.color;
      for (const [sums, sign] of [[up, 1], [down, -1]]) {
        const edge = new Float64Array(sums);
        let some = false;
        for (let k = first; k <= last; k++) {
          const value = at(line, k);
          if (Number.isFinite(value) && value * sign > 0) { sums[k] += value; some = true; }
        }
        if (!some) continue;
        brush.beginPath();
        brush.moveTo(xOf(plot, first), y(edge[first]));
        for (let k = first; k <= last; k++) brush.lineTo(xOf(plot, k), y(sums[k]));
        for (let k = last; k >= first; k--) brush.lineTo(xOf(plot, k), y(edge[k]));
        brush.fill();
      }
    }
  }

  function drawGait(plot, brush, floor) {
    const lines = plot.panel.lines, tall = (floor - TOP) / lines.length;
    brush.textBaseline = "middle";
    brush.textAlign = "right";
    lines.forEach((line, i) => {
      const top = TOP + i * tall + 0.16 * tall;
      brush.fillStyle = "#f3f3f3";
      brush.fillRect(LEFT, top, plot.width - LEFT - RIGHT, 0.68 * tall);
      brush.fillStyle = line.color;
      for (let k = first; k <= last; k++) {
        if (!(at(line, k) > line.above)) continue;
        const x = Math.max(LEFT, xOf(plot, k - 0.5));
        while (k < last && at(line, k + 1) > line.above) k++;
        brush.fillRect(x, top, Math.max(1, Math.min(plot.width - RIGHT, xOf(plot, k + 0.5)) - x), 0.68 * tall);
      }
      brush.fillStyle = INK;
      let name = line.label;
      while (name.length > 2 && brush.measureText(name).width > LEFT - 8) name = name.slice(0, -2) + "…";
      brush.fillText(name, LEFT - 5, top + 0.34 * tall);
    });
  }

  // ---- the picture -----------------------------------------------------------------------------------------------------
  const picture = document.getElementById("picture"), images = [];
  picture.width = film.width || 640;
  picture.height = film.height || 360;

  function drawPicture() {
    const brush = picture.getContext("2d"), frame = Math.floor(row / film.every);
    if (film.pictures) {
      if (!images[frame]) {
        images[frame] = new Image();
        images[frame].onload = () => { if (Math.floor(row / film.every) === frame) drawPicture(); };
        images[frame].src = "data:image/jpeg;base64," + film.pictures[frame];
      }
      if (!images[frame].complete) return;
      brush.drawImage(images[frame], 0, 0, picture.width, picture.height);
    } else if (film.places) drawSticks(brush, film.places[frame]);
    drawn = frame;
  }

  function drawSticks(brush, places) {
    // The view is from the side and a little above: x points to the right, z up, and y into the picture.
    const all = film.places[0], spread = (axis) => Math.max(...all.map((p) => p[axis])) - Math.min(...all.map((p) => p[axis]));
    const scale = 0.5 * picture.height / Math.max(0.2, spread(0), spread(2)), root = places[0];
    const flat = (p) => [
      picture.width / 2 + scale * (p[0] - root[0] + 0.35 * (p[1] - root[1])),
      picture.height / 2 - scale * (p[2] - root[2] + 0.25 * (p[1] - root[1])),
    ];
    brush.fillStyle = "#eef1f4";
    brush.fillRect(0, 0, picture.width, picture.height);
    brush.strokeStyle = "#0072B2";
    brush.fillStyle = "#D55E00";
    brush.lineWidth = 4;
    brush.lineCap = "round";
    places.forEach((place, i) => {
      const [x, y] = flat(place), parent = film.parents[i];
      if (parent >= 0) {
        const [px, py] = flat(places[parent]);
        brush.beginPath(); brush.moveTo(px, py); brush.lineTo(x, y); brush.stroke();
      }
      brush.fillRect(x - 3, y - 3, 6, 6);
    });
  }

  // ---- the cursor ------------------------------------------------------------------------------------------------------
  const slider = document.getElementById("slider"), clock = document.getElementById("clock");
  const button = document.getElementById("play");
  slider.max = String(steps - 1);

  function show(wanted) {
    row = Math.max(0, Math.min(steps - 1, Math.round(wanted) || 0));
    slider.value = String(row);
    clock.textContent = ((row + 1) * dt).toFixed(2) + " of " + (steps * dt).toFixed(2) + " s";
    drawPicture();
    if (follow()) plots.forEach(drawPlot);
    for (const plot of plots) {
      if (!plot.brush) continue;
      const x = xOf(plot, row);
      plot.brush.clearRect(0, 0, plot.width, plot.height);
      plot.brush.strokeStyle = CURSOR;
      plot.brush.lineWidth = 1.5;
      plot.brush.beginPath(); plot.brush.moveTo(x, 0); plot.brush.lineTo(x, plot.height - BOTTOM); plot.brush.stroke();
      plot.cursor = x;
      plot.panel.lines.forEach((line, i) => {
        const value = at(line, row);
        plot.values[i].textContent = plot.panel.kind === "gait" ? (value > line.above ? "down" : "up") : short(value);
      });
    }
  }

  // If the plots show only a part of the time, they follow the cursor a page at a time.
  const span = document.getElementById("span");
  function follow() {
    const wide = Math.round(Number(span.value) / dt), before = first + "," + last;
    if (!wide || wide >= steps) [first, last] = [0, steps - 1];
    else if (row < first || row > last || last - first !== wide) {
      first = Math.max(0, Math.min(steps - 1 - wide, row - Math.round((row < first ? 0.9 : 0.1) * wide)));
      last = first + wide;
    }
    return before !== first + "," + last;
  }
  span.addEventListener("change", () => show(row));

  function pause() { playing = false; button.textContent = "▶"; }
  function play() {
    if (row >= steps - 1) show(0);
    playing = true; began = performance.now(); from = row;
    button.textContent = "❚❚";
    requestAnimationFrame(turn);
  }
  function turn(now) {
    if (!playing) return;
    const next = from + Math.floor(Math.max(0, now - began) / 1000 * Number(speed.value) / dt);
    show(next);
    if (next >= steps - 1) pause(); else requestAnimationFrame(turn);
  }
  const speed = document.getElementById("speed");
  speed.addEventListener("change", () => { began = performance.now(); from = row; });
  button.addEventListener("click", () => { if (playing) pause(); else play(); });
  slider.addEventListener("input", () => { pause(); show(Number(slider.value)); });
  picture.addEventListener("click", () => button.click());
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    const far = event.shiftKey ? 10 : 1;
    const to = { ArrowLeft: row - far, ArrowRight: row + far, Home: 0, End: steps - 1 }[event.key];
    if (to !== undefined) { event.preventDefault(); pause(); show(to); }
    if (event.key === " " && event.target.tagName !== "SUMMARY") { event.preventDefault(); if (playing) pause(); else play(); }
  });

  // ---- the page --------------------------------------------------------------------------------------------------------
  for (const part of data.sections) {
    const section = make(part.open ? "section" : "details", document.getElementById("plots"));
    make(part.open ? "h2" : "summary", section, part.title);
    if (part.note) make("p", section, part.note, "hint");
    const panels = make("div", section, undefined, part.wide ? "panels wide" : "panels");
    for (const panel of part.panels) makePanel(panels, panel);
    section.addEventListener("toggle", redraw);
  }
  function redraw() { plots.forEach(drawPlot); show(row); }
  new ResizeObserver(redraw).observe(document.getElementById("plots"));
  redraw();

  // These are for tests and for the console of a browser.
  window.episode = {
    show: (k) => { pause(); show(k); },
    state: () => ({ row, time: (row + 1) * dt, picture: drawn, playing, clock: clock.textContent,
      shown: [first, last],
      cursors: plots.filter((plot) => plot.brush).map((plot) => Math.round(first + (plot.cursor - LEFT) / (plot.width - LEFT - RIGHT) * (last - first))),
      values: plots.map((plot) => plot.values.map((value) => value.textContent)) }),
  };
})();
