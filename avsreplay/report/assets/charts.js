"use strict";
// Time charts on one linked axis: hover, zoom and the chosen scan are shared by all of them.
const Packed = (() => {
  const kinds = { f8: Float64Array, f4: Float32Array, i4: Int32Array, i2: Int16Array, u4: Uint32Array, u1: Uint8Array };
  function unpack(packed) {
    const text = atob(packed.data), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return new kinds[packed.type](bytes.buffer);
  }
  return { unpack };
})();

const Charts = (() => {
  const HEIGHT = 150, LANE = 30;
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  let theme = {};
  function readTheme() {
    theme = { ink: css("--ink"), faint: css("--faint"), line: css("--line"), card: css("--card"), flag: css("--flag"), colours: [] };
    for (let k = 0; k < 6; k++) theme.colours.push(css("--c" + k));
  }
  const colour = (k) => theme.colours[k % theme.colours.length];
  const alpha = (k, a) => colour(k) + Math.round(a * 255).toString(16).padStart(2, "0");

  function figures(v) {
    if (v === null || v === undefined) return "–";
    const size = Math.abs(v);
    return size !== 0 && (size < 1e-4 || size >= 1e6) ? v.toExponential(2) : String(+v.toPrecision(4));
  }

  // All runs on one time axis: undefined where a run has no scan, null where a scan has no value.
  function timeline(runs) {
    if (runs.length === 1) return { t: Array.from(runs[0].t), place: null };
    const t = Array.from(new Set(runs.flatMap((r) => Array.from(r.t)))).sort((a, b) => a - b);
    const at = new Map(t.map((v, k) => [v, k]));
    return { t, place: runs.map((r) => Array.from(r.t, (v) => at.get(v))) };
  }
  function spread(line, run, values, log, factor) {
    const usable = (v) => Number.isFinite(v) && (!log || v > 0) ? v * factor : null;
    if (!line.place) return Array.from(values, usable);
    const out = new Array(line.t.length);
    line.place[run].forEach((k, i) => { out[k] = usable(values[i]); });
    return out;
  }

  // Values between two scans without a value: a line does not show them.
  function alone(values) {
    const out = [], none = (v) => v === null || v === undefined;
    for (let i = 0; i < values.length; i++) if (!none(values[i]) && none(values[i - 1]) && none(values[i + 1])) out.push(i);
    return out;
  }

  // Patterns, so that kinds differ without colour: solid, lines in four directions, dots.
  const tiles = new Map(), swatches = [];
  function pattern(ctx, k, style) {
    const key = [k, style, colour(k), devicePixelRatio].join();
    if (style === 0) return alpha(k, 0.45);
    if (!tiles.has(key)) {
      const n = 8 * devicePixelRatio, tile = document.createElement("canvas"), c = tile.getContext("2d");
      tile.width = tile.height = n;
      c.fillStyle = alpha(k, 0.22); c.fillRect(0, 0, n, n);
      c.strokeStyle = c.fillStyle = colour(k); c.lineWidth = 1.5 * devicePixelRatio;
      const line = (x0, y0, x1, y1) => { c.beginPath(); c.moveTo(x0 * n, y0 * n); c.lineTo(x1 * n, y1 * n); c.stroke(); };
      if (style === 1) { line(-0.25, 0.25, 0.25, -0.25); line(0, 1, 1, 0); line(0.75, 1.25, 1.25, 0.75); }
      if (style === 2) { line(-0.25, 0.75, 0.25, 1.25); line(0, 0, 1, 1); line(0.75, -0.25, 1.25, 0.25); }
      if (style === 3) line(0, 0.5, 1, 0.5);
      if (style === 4) line(0.5, 0, 0.5, 1);
      if (style === 5) { c.beginPath(); c.arc(n / 2, n / 2, n / 5, 0, 7); c.fill(); }
      tiles.set(key, ctx.createPattern(tile, "repeat"));
    }
    return tiles.get(key);
  }

  function axes(log) {
    const tens = (_, splits) => splits.map((v) => Math.abs(Math.log10(v) % 1) < 1e-9 ? v : null);
    const lines = log ? { filter: tens } : {};
    const short = (v) => v !== 0 && (Math.abs(v) >= 1e5 || Math.abs(v) < 1e-3) ? v.toExponential().replace("e+", "e") : String(+v.toPrecision(6));
    const decade = (v) => Math.abs(Math.log10(v) % 1) < 1e-9;
    const words = (ticks) => {  // of many decades every second, third ... is named
      const every = Math.ceil(ticks.filter((v) => v !== null && decade(v)).length / 5);
      return ticks.map((v) => v === null || (log && every > 1 && !(decade(v) && Math.round(Math.log10(v)) % every === 0)) ? "" : short(v));
    };
    const axis = { stroke: () => theme.faint, font: "11px system-ui, sans-serif", grid: { stroke: () => theme.line, width: 1 }, ticks: { stroke: () => theme.line, width: 1, size: 4 } };
    return [
      { ...axis, size: 26, values: (_, ticks) => ticks.map((v) => +v.toFixed(6) + " s") },
      { ...axis, size: 62, grid: { ...axis.grid, ...lines }, ticks: { ...axis.ticks, ...lines }, values: (_, ticks) => words(ticks) },
    ];
  }

  // The y range follows the lines and levels; a band may widen it to at most three times that. Of a
  // measured line only the scans that were used count, unless none was.
  function extent(u, main, i0, i1, all) {
    let a = Infinity, b = -Infinity;
    for (const { at, used } of main) {
      if (!u.series[at].show) continue;
      for (let i = i0; i <= i1; i++) {
        const v = u.data[at][i];
        if (v === null || v === undefined || (!all && used && !used[i])) continue;
        if (v < a) a = v;
        if (v > b) b = v;
      }
    }
    return [a, b];
  }
  function yRange(spec, main) {
    return (u, low, high) => {
      const [i0, i1] = u.series[0].idxs || [0, u.data[0].length - 1];
      let [a, b] = extent(u, main, i0, i1, false);
      if (a > b) [a, b] = extent(u, main, i0, i1, true);
      for (const level of spec.levels) if (level.label !== "truth" || spec.bands.length) { a = Math.min(a, level.y); b = Math.max(b, level.y); }
      if (a > b) return spec.log ? [0.1, 1] : [0, 1];
      if (spec.log) return uPlot.rangeLog(a, b, 10, false);
      if (a === b) { const pad = Math.abs(a) * 0.05 || 0.5; a -= pad; b += pad; }
      const room = b - a;
      if (low !== null && room > 0) { a = Math.max(Math.min(a, low), a - room); b = Math.min(Math.max(b, high), b + room); }
      return uPlot.rangeNum(a, b, 0.08, true);
    };
  }

  /* Text that stays readable over lines, hatching and points: its outline has the colour of the card. */
  function written(ctx, text, x, y) {
    ctx.save();
    ctx.setLineDash([]); ctx.lineJoin = "round"; ctx.lineWidth = 4 * devicePixelRatio; ctx.strokeStyle = theme.card;
    ctx.strokeText(text, x, y); ctx.fillText(text, x, y);
    ctx.restore();
  }
  function background(shared) {
    return (u) => {
      const { ctx, bbox } = u;
      ctx.save();
      ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
      ctx.fillStyle = theme.flag;
      for (const s of shared.spans) if (s.lane === "flagged") {
        const x0 = u.valToPos(s.from - shared.half, "x", true), x1 = u.valToPos(s.to + shared.half, "x", true);
        ctx.fillRect(x0, bbox.top, Math.max(x1 - x0, 1), bbox.height);
      }
      ctx.restore();
    };
  }
  // Triangles at the edge for the values beyond it; returns their number.
  function edges(u, main) {
    const { ctx, bbox } = u, px = devicePixelRatio, { min, max } = u.scales.y, [i0, i1] = u.series[0].idxs || [0, -1];
    let count = 0;
    for (const { at, used, colour: k } of main) {
      if (!used || !u.series[at].show) continue;
      ctx.fillStyle = colour(k);
      for (let i = i0; i <= i1; i++) {
        const v = u.data[at][i];
        if (v === null || v === undefined || (v <= max && v >= min)) continue;
        const x = u.valToPos(u.data[0][i], "x", true), up = v > max, tip = up ? bbox.top + px : bbox.top + bbox.height - px, foot = tip + (up ? 8 : -8) * px;
        ctx.beginPath(); ctx.moveTo(x, tip); ctx.lineTo(x - 5 * px, foot); ctx.lineTo(x + 5 * px, foot); ctx.closePath(); ctx.fill();
        count++;
      }
    }
    return count;
  }
  function foreground(spec, shared, main = [], beyond = null) {
    return (u) => {
      const { ctx, bbox } = u, px = devicePixelRatio;
      const count = edges(u, main);
      if (beyond) beyond.textContent = count ? `▲ ${count} rejected beyond the axis` : "";
      ctx.save();
      ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
      ctx.lineWidth = px; ctx.font = 11 * px + "px system-ui, sans-serif"; ctx.setLineDash([3 * px, 3 * px]);
      for (const level of spec.levels) {
        const y = Math.round(u.valToPos(level.y, "y", true));
        ctx.strokeStyle = ctx.fillStyle = colour(level.colour);
        ctx.beginPath(); ctx.moveTo(bbox.left, y); ctx.lineTo(bbox.left + bbox.width, y); ctx.stroke();
        const below = y - 14 * px < bbox.top;
        ctx.textAlign = "right"; ctx.textBaseline = below ? "top" : "bottom";
        written(ctx, level.label, bbox.left + bbox.width - 4 * px, below ? y + 2 * px : y - 1);
      }
      ctx.strokeStyle = ctx.fillStyle = theme.ink;
      for (const mark of shared.marks) {
        const x = Math.round(u.valToPos(mark.t, "x", true));
        ctx.beginPath(); ctx.moveTo(x, bbox.top); ctx.lineTo(x, bbox.top + bbox.height); ctx.stroke();
        ctx.textAlign = "left"; ctx.textBaseline = "top";
        written(ctx, mark.label, x + 3 * px, bbox.top + 2 * px);
      }
      ctx.restore();
    };
  }

  function options(spec, shared, series, extra) {
    return {
      width: shared.width, height: spec.height || HEIGHT, legend: { show: false }, series, axes: axes(spec.log), padding: [6, 20, 0, 0],
      scales: { x: { time: false }, y: spec.log ? { distr: 3, range: extra.range } : { range: extra.range } },
      bands: extra.bands || [],
      cursor: { sync: { key: "time", scales: ["x", null] }, drag: { x: true, y: false, dist: 4 }, y: false, focus: { prox: -1 } },
      hooks: {
        drawClear: [background(shared)],
        draw: [extra.draw || foreground(spec, shared)],
        setCursor: [(u) => shared.hover(u)],
        setScale: [(u, key) => { if (key === "x") shared.zoomed(u); }],
      },
    };
  }

  function el(tag, attributes, ...children) {
    const node = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes || {})) node.setAttribute(name, value);
    node.append(...children);
    return node;
  }
  function swatch(k, dash, points) {
    const ns = "http://www.w3.org/2000/svg", svg = document.createElementNS(ns, "svg");
    svg.setAttribute("viewBox", "0 0 22 10"); svg.setAttribute("aria-hidden", "true");
    const draw = (tag, attributes) => { const n = document.createElementNS(ns, tag); for (const a in attributes) n.setAttribute(a, attributes[a]); svg.append(n); };
    if (points) [4, 11, 18].forEach((x) => draw("circle", { cx: x, cy: 5, r: 2, style: `fill:var(--c${k % 6})` }));
    else draw("line", { x1: 0, x2: 22, y1: 5, y2: 5, "stroke-width": 2.5, "stroke-dasharray": dash ? "5 3" : "none", style: `stroke:var(--c${k % 6})` });
    return svg;
  }

  function bar(span) {
    const canvas = el("canvas", { width: 22 * devicePixelRatio, height: 10 * devicePixelRatio, "aria-hidden": "true", class: "bar-swatch" });
    const paint = () => { const c = canvas.getContext("2d"); c.clearRect(0, 0, canvas.width, canvas.height); c.fillStyle = pattern(c, span.colour, span.pattern); c.fillRect(0, 0, canvas.width, canvas.height); };
    paint(); swatches.push(paint);
    return canvas;
  }
  function figure(host, spec, shared) {
    const unit = spec.unit ? [" ", el("span", {}, "[" + spec.unit + "]")] : [];
    const caption = el("figcaption", {}, el("h2", {}, spec.title, ...unit));
    const node = el("figure", { class: "chart", id: "chart-" + spec.key, tabindex: "0", role: "group", "aria-label": spec.title + " over time" }, caption);
    host.append(node);
    node.addEventListener("keydown", (event) => shared.key(event, node));
    return { node, caption };
  }
  function finish(u, spec, outputs, shared) {
    const pin = el("div", { class: "pin" });
    u.over.append(pin);
    u.over.addEventListener("click", () => { if (u.cursor.idx !== null && u.cursor.idx !== undefined) shared.choose(u.cursor.idx); });
    return { u, pin, outputs, spec };
  }

  function lineChart(host, spec, shared) {
    const { node, caption } = figure(host, spec, shared);
    const data = [shared.line.t], series = [{}], bands = [], outputs = [], main = [], beyond = el("span", { class: "beyond" });
    caption.append(beyond);
    const columns = (run) => shared.runs[run].columns;
    const add = (run, values, options) => { data.push(spread(shared.line, run, values, spec.log, spec.factor || 1)); series.push(options); return series.length - 1; };
    for (const b of spec.bands) {
      const hidden = { stroke: "transparent", width: 0, points: { show: false } };
      const high = columns(0)[b.stem + "_hi"], low = columns(0)[b.stem + "_lo"];
      bands.push({ series: [add(0, high, hidden), add(0, low, hidden)], fill: () => alpha(b.colour, 0.16) });
      if (b.sigma) {
        const wider = high.map((v, k) => 1.5 * v - 0.5 * low[k]), lower = low.map((v, k) => 1.5 * v - 0.5 * high[k]);
        bands.push({ series: [add(0, wider, hidden), add(0, lower, hidden)], fill: () => alpha(b.colour, 0.08) });
      }
    }
    for (const s of spec.series) {
      const dots = { show: true, size: 4, width: 1, stroke: () => colour(s.colour), fill: () => colour(s.colour) };
      const single = { size: 5, width: 1, stroke: () => colour(s.colour), fill: () => colour(s.colour), filter: (u, at, show) => show ? null : alone(u.data[at]) };
      const at = add(s.run || 0, columns(s.run || 0)[s.column], { label: s.label, stroke: () => colour(s.colour), width: 1.6, dash: s.dash ? [6, 4] : undefined, points: s.points ? dots : single, paths: s.points ? () => null : undefined, spanGaps: false });
      main.push({ at, used: s.measured ? shared.used[s.run || 0] : null, colour: s.colour });
      const output = el("output", {}, "–"), key = el("button", { type: "button", class: "key", "aria-pressed": "true", title: "show or hide" }, swatch(s.colour, s.dash, s.points), s.label, output);
      key.addEventListener("click", () => { const show = key.getAttribute("aria-pressed") !== "true"; key.setAttribute("aria-pressed", String(show)); u.setSeries(at, { show }); });
      caption.append(key);
      outputs.push({ at, output });
    }
    const u = new uPlot(options(spec, shared, series, { range: yRange(spec, main), bands, draw: foreground(spec, shared, main, beyond) }), data, node);
    return finish(u, spec, outputs, shared);
  }

  // Lanes: what the detector flagged, by reason; what was injected, by kind; what the robot was told to do.
  function strip(host, shared) {
    const names = ["flagged", "injected", "action"].filter((n) => n !== "action" || shared.spans.some((s) => s.lane === n));
    const spec = { key: "state", title: "States", unit: "", levels: [], bands: [], height: 36 + LANE * names.length, log: false };
    const { node, caption } = figure(host, spec, shared);
    const words = Array.from(new Set(shared.spans.map((s) => s.lane + " " + s.word)));
    for (const word of words) {
      const first = shared.spans.find((s) => s.lane + " " + s.word === word);
      const key = el("button", { type: "button", class: "key", title: "go to the first" }, bar(first), first.word.replaceAll("_", " "));
      key.addEventListener("click", () => shared.choose(first.first));
      caption.append(key);
    }
    if (!words.length) caption.append(el("span", {}, "every scan was used"));
    const draw = (u) => {
      foreground(spec, shared)(u);
      const { ctx, bbox } = u, px = devicePixelRatio, tall = bbox.height / names.length;
      ctx.save();
      ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
      ctx.font = 11 * px + "px system-ui, sans-serif"; ctx.textBaseline = "middle"; ctx.textAlign = "left";
      for (const s of shared.spans) {
        const k = s.colour, top = bbox.top + tall * names.indexOf(s.lane) + 2 * px;
        const x0 = u.valToPos(s.from - shared.half, "x", true), wide = Math.max(u.valToPos(s.to + shared.half, "x", true) - x0, 2 * px);
        ctx.fillStyle = pattern(ctx, k, s.pattern); ctx.fillRect(x0, top, wide, tall - 4 * px);
        ctx.strokeStyle = colour(k); ctx.lineWidth = px; ctx.strokeRect(x0, top, wide, tall - 4 * px);
        const text = s.word.replaceAll("_", " ");
        const left = Math.max(x0, bbox.left), seen = Math.min(x0 + wide, bbox.left + bbox.width) - left;
        if (ctx.measureText(text).width < seen - 6 * px) { ctx.fillStyle = theme.ink; written(ctx, text, left + 4 * px, top + tall / 2 - 2 * px); }
      }
      ctx.restore();
    };
    const lanes = options(spec, shared, [{}, { show: false }], { range: () => [0, names.length], draw });
    lanes.axes[1] = { ...lanes.axes[1], splits: () => names.map((_, k) => k + 0.5), values: () => [...names].reverse(), grid: { show: false } };
    const u = new uPlot(lanes, [shared.line.t, shared.line.t.map(() => 0)], node);
    u.over.addEventListener("mousemove", (event) => {
      const t = u.posToVal(event.offsetX, "x"), lane = names[Math.floor(event.offsetY / u.over.clientHeight * names.length)];
      const hit = shared.spans.filter((s) => s.lane === lane && s.from - shared.half <= t && t <= s.to + shared.half);
      u.over.title = hit.map((s) => `${s.lane}: ${s.word.replaceAll("_", " ")}, ${s.from.toFixed(2)} s to ${s.to.toFixed(2)} s`).join("\n");
    });
    return finish(u, spec, [], shared);
  }

  // Width of a chart in a host whose children stand in columns; more: a folded host of the same form.
  function widthIn(host, wide, columns) {
    const gap = 12, count = columns || getComputedStyle(host).gridTemplateColumns.split(" ").length;
    return Math.max((wide - gap * (count - 1)) / count - 14, 240);
  }
  // Whether each scan of a run on the common axis was used.
  function usedScans(line, run, k) {
    if (!run.used) return null;
    const values = Packed.unpack(run.used);
    if (!line.place) return values;
    const out = new Array(line.t.length);
    line.place[k].forEach((at, i) => { out[at] = values[i]; });
    return out;
  }

  // host, more: of the charts that are shown and that are folded. hooks: hover(idx or null), choose(idx).
  function build(host, more, page, hooks) {
    readTheme();
    const runs = page.runs.map((r) => ({ name: r.name, t: Packed.unpack(r.t), columns: Object.fromEntries(Object.entries(r.columns).map(([n, p]) => [n, Packed.unpack(p)])) }));
    const line = timeline(runs), t = line.t;
    const all = [];
    let chosen = 0, hovered = null, syncing = false, waiting = false;
    const steps = t.slice(1).map((v, k) => v - t[k]).sort((a, b) => a - b);
    const shared = { runs, line, spans: page.spans, marks: page.marks, half: (steps[steps.length >> 1] || 1) / 2, width: widthIn(host, host.clientWidth), choose: hooks.choose };
    shared.used = page.runs.map((run, k) => usedScans(line, run, k));
    shared.hover = (u) => {
      const inside = u.cursor.left >= 0 && u.cursor.idx !== null && u.cursor.idx !== undefined;
      hovered = inside ? u.cursor.idx : null;
      if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; readouts(); hooks.hover(hovered); }); }
    };
    shared.zoomed = (source) => {
      if (syncing) return;
      syncing = true;
      const { min, max } = source.scales.x;
      for (const c of all) if (c.u !== source) c.u.setScale("x", { min, max });
      syncing = false;
      pins();
      const whole = min <= t[0] && max >= t[t.length - 1];
      if (hooks.zoomed) hooks.zoomed(whole ? null : [min, max]);
    };
    shared.key = (event, node) => {
      if (event.target !== node || event.ctrlKey || event.metaKey || event.altKey) return;
      const step = event.shiftKey ? 10 : 1, last = t.length - 1;
      const moves = { ArrowLeft: chosen - step, ArrowRight: chosen + step, Home: 0, End: last };
      if (event.key in moves) hooks.choose(Math.min(Math.max(moves[event.key], 0), last));
      else if (event.key === "+" || event.key === "=") zoom(0.5);
      else if (event.key === "-") zoom(2);
      else if (event.key === "0" || event.key === "Escape") reset();
      else return;
      event.preventDefault();
    };
    if (page.states) all.push(strip(host, shared));
    for (const spec of page.charts) all.push(lineChart(spec.first || !more ? host : more, spec, shared));
    if (t.length === 1 && all.length) reset();

    function readouts() {
      const k = hovered === null ? chosen : hovered;
      for (const c of all) for (const o of c.outputs) o.output.textContent = figures(c.u.data[o.at][k]);
    }
    function pins() {
      for (const c of all) {
        const x = c.u.valToPos(t[chosen], "x");
        c.pin.style.transform = `translateX(${x - 1}px)`;
        c.pin.style.display = x >= 0 && x <= c.u.over.clientWidth ? "" : "none";
      }
    }
    function zoom(factor) {
      const { min, max } = all[0].u.scales.x, half = (max - min) * factor / 2, middle = t[chosen];
      const a = Math.max(t[0], middle - half), b = Math.min(t[t.length - 1], middle + half);
      if (b > a) all[0].u.setScale("x", { min: a, max: b });
    }
    function zoomTo(a, b) { if (b > a) all[0].u.setScale("x", { min: a, max: b }); }
    function reset() {
      const half = t.length > 1 ? 0 : 0.5;  // a single scan is drawn in the middle of one second
      all[0].u.setScale("x", { min: t[0] - half, max: t[t.length - 1] + half });
    }
    function choose(k) { chosen = k; pins(); readouts(); }
    function resize(wide = host.clientWidth, columns = 0) {
      const width = widthIn(host, wide, columns);
      for (const c of all) if (c.u.width !== width) c.u.setSize({ width, height: c.u.height });
      requestAnimationFrame(pins);
    }
    function repaint() { readTheme(); swatches.forEach((paint) => paint()); for (const c of all) c.u.redraw(false, true); }
    return { t, runs, choose, reset, resize, repaint, zoomTo };
  }
  return { build };
})();
