"use strict";
// The 3D view: model at the estimated and at the true pose, scan points coloured by residual or intensity, planned path, line of sight.
const Scene = (() => {
  const V = {
    add: (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]], sub: (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]],
    mul: (a, s) => [a[0] * s, a[1] * s, a[2] * s], dot: (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
    cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
    size: (a) => Math.hypot(a[0], a[1], a[2]), unit: (a) => { const n = Math.hypot(a[0], a[1], a[2]) || 1; return [a[0] / n, a[1] / n, a[2] / n]; },
  };
  function times(a, b) { // column-major 4x4 product
    const out = new Float32Array(16);
    for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) { let s = 0; for (let k = 0; k < 4; k++) s += a[k * 4 + r] * b[c * 4 + k]; out[c * 4 + r] = s; }
    return out;
  }
  function perspective(fov, aspect, near, far) {
    const f = 1 / Math.tan(fov / 2), d = 1 / (near - far);
    return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * d, -1, 0, 0, 2 * near * far * d, 0]);
  }
  function lookAt(eye, centre, up) {
    const z = V.unit(V.sub(eye, centre)), x = V.unit(V.cross(up, z)), y = V.cross(z, x);
    return new Float32Array([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -V.dot(x, eye), -V.dot(y, eye), -V.dot(z, eye), 1]);
  }
  function poseAt(columns, k) { // rows x y z qx qy qz qw, active rotation
    const p = columns.subarray(7 * k, 7 * k + 7);
    if (!p.every(Number.isFinite)) return null;
    const [X, Y, Z, x, y, z, w] = p;
    return new Float32Array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0, 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0, 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0, X, Y, Z, 1]);
  }
  const apply = (m, v) => [0, 1, 2].map((r) => m[r] * v[0] + m[4 + r] * v[1] + m[8 + r] * v[2] + m[12 + r]);
  const IDENTITY = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
  const RAMP = [[70, 110, 200], [40, 165, 170], [120, 205, 90], [253, 231, 37]];
  const COLOUR = { estimate: [0.34, 0.71, 0.91, 0.5], truth: [0.18, 0.76, 0.6, 1], path: [1, 0.56, 0.29, 1], sight: [0.55, 0.6, 0.68, 0.6], flown: [0.9, 0.54, 0.84, 1], cone: [0.18, 0.76, 0.6, 0.7], x: [1, 0.56, 0.29, 1], y: [0.18, 0.76, 0.6, 1], z: [0.34, 0.71, 0.91, 1] };

  const VERTEX = "attribute vec3 place; attribute vec3 normal; attribute vec3 tint; uniform mat4 lens, pose; uniform float bead; varying vec3 n, c; void main() { n = (pose * vec4(normal, 0.0)).xyz; c = tint; gl_Position = lens * pose * vec4(place, 1.0); gl_PointSize = bead; }";
  const FRAGMENT = "precision mediump float; uniform vec4 colour; uniform vec3 light; uniform float mode; varying vec3 n, c; void main() { if (mode > 1.5) { vec2 d = gl_PointCoord - 0.5; if (dot(d, d) > 0.25) discard; gl_FragColor = vec4(c, 1.0); } else if (mode > 0.5) { float s = 0.35 + 0.65 * abs(dot(normalize(n), light)); gl_FragColor = vec4(colour.rgb * s, colour.a); } else gl_FragColor = colour; }";

  function program(gl) {
    const make = (kind, text) => { const s = gl.createShader(kind); gl.shaderSource(s, text); gl.compileShader(s); if (!gl.getShaderParameter(s, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(s)); return s; };
    const p = gl.createProgram();
    gl.attachShader(p, make(gl.VERTEX_SHADER, VERTEX)); gl.attachShader(p, make(gl.FRAGMENT_SHADER, FRAGMENT));
    gl.bindAttribLocation(p, 0, "place"); gl.linkProgram(p);
    const at = { place: 0, normal: gl.getAttribLocation(p, "normal"), tint: gl.getAttribLocation(p, "tint") };
    for (const name of ["lens", "pose", "bead", "colour", "light", "mode"]) at[name] = gl.getUniformLocation(p, name);
    gl.useProgram(p);
    return at;
  }

  // Faces with a normal each, and the edges where the surface bends or ends; a bare cloud gives neither.
  function model(vertices, faces) {
    const n = faces.length, place = new Float32Array(3 * n), normal = new Float32Array(3 * n), edges = [], seen = new Map(), count = vertices.length / 3;
    const at = (i) => [vertices[3 * i], vertices[3 * i + 1], vertices[3 * i + 2]];
    for (let f = 0; f < n; f += 3) {
      const corners = [at(faces[f]), at(faces[f + 1]), at(faces[f + 2])];
      const up = V.unit(V.cross(V.sub(corners[1], corners[0]), V.sub(corners[2], corners[0])));
      for (let k = 0; k < 3; k++) {
        place.set(corners[k], 3 * (f + k)); normal.set(up, 3 * (f + k));
        const a = Math.min(faces[f + k], faces[f + (k + 1) % 3]), b = Math.max(faces[f + k], faces[f + (k + 1) % 3]), id = a * count + b;
        const known = seen.get(id);
        if (known) known.flat = known.flat || Math.abs(V.dot(known.up, up)) > 0.94; else seen.set(id, { a, b, up, flat: false });
      }
    }
    for (const e of seen.values()) if (!e.flat) edges.push(...at(e.a), ...at(e.b));
    return { place, normal, edges: new Float32Array(edges) };
  }
  function ball(vertices) { // centre of the box and the radius about it
    if (!vertices.length) return { centre: [0, 0, 0], radius: 0 };
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let i = 0; i < vertices.length; i++) { low[i % 3] = Math.min(low[i % 3], vertices[i]); high[i % 3] = Math.max(high[i % 3], vertices[i]); }
    return { centre: V.mul(V.add(low, high), 0.5), radius: V.size(V.sub(high, low)) / 2 };
  }
  function ramp(level) {
    const x = Math.min(level / 254, 1) * 3, k = Math.min(Math.floor(x), 2), f = x - k;
    return [0, 1, 2].map((i) => (RAMP[k][i] * (1 - f) + RAMP[k + 1][i] * f) / 255);
  }

  function decode(scene) {
    const c = scene.clouds, out = { cap: c.cap_m, brightest: c.brightest };
    for (const name of ["scan", "size", "centre", "step", "points", "residual", "intensity"]) out[name] = c[name] && Packed.unpack(c[name]);
    out.start = []; let total = 0;
    for (const size of out.size) { out.start.push(total); total += size; }
    return out;
  }
  function cloudAt(clouds, k) { // the cloud of the scan nearest to k, if it is near
    let best = -1;
    for (let i = 0; i < clouds.scan.length; i++) if (best < 0 || Math.abs(clouds.scan[i] - k) < Math.abs(clouds.scan[best] - k)) best = i;
    const stride = clouds.scan.length > 1 ? (clouds.scan[clouds.scan.length - 1] - clouds.scan[0]) / (clouds.scan.length - 1) : 0;
    return best >= 0 && Math.abs(clouds.scan[best] - k) <= Math.max(stride / 2, 0) ? best : -1;
  }
  function cloudArrays(clouds, i, levels) {
    const size = clouds.size[i], place = new Float32Array(3 * size), tint = new Float32Array(3 * size);
    for (let j = 0; j < size; j++) {
      const at = clouds.start[i] + j, level = levels[at];
      for (let a = 0; a < 3; a++) place[3 * j + a] = clouds.centre[3 * i + a] + clouds.step[i] * clouds.points[3 * at + a];
      tint.set(level === 255 ? [0.85, 0.85, 0.85] : ramp(level), 3 * j);
    }
    return { place, tint, size };
  }

  function build(host, scene, t) {
    const canvas = document.createElement("canvas");
    canvas.tabIndex = 0; canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "3D view of the target, its scan and the planned path");
    const gl = canvas.getContext("webgl", { antialias: true, alpha: false });
    host.hidden = false;
    if (!gl) { host.append("This browser has no WebGL, so there is no 3D view."); return { choose() {}, resize() {} }; }
    const at = program(gl), vertices = Packed.unpack(scene.vertices), faces = Packed.unpack(scene.faces);
    const estimate = Packed.unpack(scene.estimate), truth = Packed.unpack(scene.truth), clouds = decode(scene);
    const mesh = model(vertices, faces), bounds = ball(vertices);
    const flight = scene.flight ? { axis: scene.flight.axis, near: scene.flight.near_m, cones: Packed.unpack(scene.flight.cones) } : null;
    const usual = (scene.flown || []).length ? 1.7 : 1;  // the last metres of a flight are in view, too
    const flown = (scene.flown || []).map((part) => ({ first: part.first, points: Packed.unpack(part.points) }));
    const paths = scene.paths.map((p) => ({ t: p.t_s, points: Packed.unpack(p.points) }));
    const buffer = (data) => { const b = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, b); gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW); return b; };
    const fixed = { place: buffer(mesh.place), normal: buffer(mesh.normal), edges: buffer(mesh.edges), bare: buffer(vertices) };
    const scratch = gl.createBuffer(), scratchTint = gl.createBuffer();
    let chosen = 0, yaw = 0.55, pitch = 0.35, zoom = usual, whole = false, bright = false, dirty = true;

    const note = document.createElement("span"), bar = document.createElement("div"), legend = document.createElement("ul");
    bar.className = "bar"; legend.className = "legend";
    const button = (text, act) => { const b = document.createElement("button"); b.type = "button"; b.textContent = text; b.addEventListener("click", act); bar.append(b); return b; };
    const all = flight ? ball([...vertices, ...paths[0].points]) : null, [less, more] = flight ? ["Whole flight", "Last metres"] : ["Target only", "Whole scene"];
    const fit = button(more, () => { whole = !whole; zoom = whole ? 1 : usual; fit.textContent = whole ? less : more; draw(); });
    button("Reset view", () => { yaw = 0.55; pitch = 0.35; zoom = whole ? 1 : usual; draw(); });
    if (clouds.cap && clouds.intensity) { const by = button("Colour by intensity", () => { bright = !bright; by.textContent = bright ? "Colour by residual" : "Colour by intensity"; rescale(); draw(); }); }
    bar.append(note);
    const entry = (colour, text) => { const li = document.createElement("li"), i = document.createElement("i"); i.style.background = colour; li.append(i, text); legend.append(li); };
    if (faces.length) entry("#56b4e9", flight ? "target" : "model at the estimate");
    if (truth.some(Number.isFinite)) entry("#2fc39a", faces.length ? "model at the true pose (edges)" : "true pose");
    if (paths.length) entry("#ff8f4a", "planned path");
    if (flown.length) entry("#e58ad6", "gripper and its path so far, relative to the target");
    if (flight) { entry("#e58ad6", "gripper and its path so far"); if (flight.cones.length) entry("#2ec299", "approach cones"); } else entry("#8c99ad", "line of sight");
    const scale = document.createElement("li"); scale.className = "ramp";
    const rescale = () => { const [name, top] = bright ? ["intensity", clouds.brightest.toPrecision(3)] : ["residual", (clouds.cap * 1000).toPrecision(3) + " mm"]; scale.replaceChildren(name + " 0", document.createElement("b"), top); };
    if (clouds.cap || clouds.intensity) { bright = !clouds.cap; rescale(); legend.append(scale); }
    host.append(canvas, bar, legend);

    function bind(b, slot, data) {
      if (slot < 0) return;
      gl.bindBuffer(gl.ARRAY_BUFFER, b);
      if (data) gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
      gl.enableVertexAttribArray(slot); gl.vertexAttribPointer(slot, 3, gl.FLOAT, false, 0, 0);
    }
    function shape(kind, count, place, pose, colour, mode, more = {}) {
      gl.disableVertexAttribArray(at.normal); gl.disableVertexAttribArray(at.tint);
      bind(place.buffer, at.place, place.data);
      if (more.normal) bind(more.normal, at.normal);
      if (more.tint) bind(scratchTint, at.tint, more.tint);
      gl.uniformMatrix4fv(at.pose, false, pose); gl.uniform4fv(at.colour, colour); gl.uniform1f(at.mode, mode); gl.uniform1f(at.bead, more.bead || 1);
      gl.drawArrays(kind, 0, count);
    }
    const lines = (data, pose, colour, kind = gl.LINES) => shape(kind, data.length / 3, { buffer: scratch, data: new Float32Array(data) }, pose, colour, 0);
    function triad(pose, length) { ["x", "y", "z"].forEach((a, i) => { const tip = [0, 0, 0]; tip[i] = length; lines([0, 0, 0, ...tip], pose, COLOUR[a]); }); }
    function sight(centre, radius) {
      const out = V.unit(centre), side = V.unit(V.cross(out, Math.abs(out[2]) < 0.9 ? [0, 0, 1] : [0, 1, 0])), up = V.cross(out, side), ring = [];
      for (let k = 0; k < 24; k++) ring.push(V.add(centre, V.add(V.mul(side, radius * Math.cos(k * Math.PI / 12)), V.mul(up, radius * Math.sin(k * Math.PI / 12)))));
      const data = [];
      ring.forEach((p, k) => { data.push(...p, ...ring[(k + 1) % 24]); if (k % 6 === 0) data.push(0, 0, 0, ...p); });
      return data;
    }

    function paint() {
      dirty = false;
      const px = devicePixelRatio, w = Math.round(canvas.clientWidth * px), h = Math.round(canvas.clientHeight * px);
      if (!w || !h) return;
      if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
      const pose = poseAt(estimate, chosen) || IDENTITY, real = poseAt(truth, chosen), found = cloudAt(clouds, chosen);
      const target = flight ? (whole ? [0, 0, 0] : all.centre) : apply(pose, bounds.centre), away = flight ? all.radius : V.size(target) || 1;
      const radius = flight ? (whole ? 1.5 * flight.near : 1.1 * all.radius) : bounds.radius || 0.2 * away, eyes = flight ? flight.axis : V.mul(target, -1);
      const up = Math.abs(eyes[2]) > 0.7 * V.size(eyes) ? [0, -1, 0] : [0, 0, 1];
      const centre = whole && !flight ? V.mul(target, 0.5) : target, reach = (whole && !flight ? 0.62 * away + radius : radius) * 2.4 * zoom;
      const back = V.unit(eyes), side = V.unit(V.cross(up, back)), lift = V.cross(back, side);
      const dir = V.add(V.mul(V.add(V.mul(back, Math.cos(yaw)), V.mul(side, Math.sin(yaw))), Math.cos(pitch)), V.mul(lift, Math.sin(pitch)));
      const eye = V.add(centre, V.mul(dir, reach));
      const lens = times(perspective(0.75, w / h, reach * 0.02, reach * 6 + 4 * away), lookAt(eye, centre, up));
      gl.viewport(0, 0, w, h); gl.clearColor(0.063, 0.082, 0.11, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST); gl.enable(gl.BLEND); gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      gl.uniformMatrix4fv(at.lens, false, lens); gl.uniform3fv(at.light, V.unit(V.add(dir, V.mul(side, 0.4))));
      if (flight) lines(flight.cones, IDENTITY, COLOUR.cone); else { lines(sight(target, radius), IDENTITY, COLOUR.sight); triad(IDENTITY, 0.12 * away); }
      triad(pose, (flight ? 0.25 : 0.6) * radius);
      if (real) faces.length ? shape(gl.LINES, mesh.edges.length / 3, { buffer: fixed.edges }, real, COLOUR.truth, 0) : triad(real, 0.5 * radius);
      if (!faces.length && vertices.length) shape(gl.POINTS, vertices.length / 3, { buffer: fixed.bare }, pose, COLOUR.estimate, 0, { bead: 2 * px });
      const path = paths.filter((p) => p.t <= t[chosen] + 1e-9).pop();
      if (flight) lines(path.points.subarray(0, 3 * (chosen + 1)), IDENTITY, COLOUR.flown, gl.LINE_STRIP); // first: it hides the plan
      if (path) lines(path.points, IDENTITY, COLOUR.path, gl.LINE_STRIP);
      if (flight) {
        const end = 3 * (chosen + 1);
        shape(gl.POINTS, 1, { buffer: scratch, data: path.points.slice(end - 3, end) }, IDENTITY, COLOUR.flown, 2, { tint: new Float32Array(COLOUR.flown.slice(0, 3)), bead: 11 * px });
      }
      for (const part of flown) if (part.first <= chosen) {  // fixed to the target: the frame in which it is at rest
        const so_far = part.points.subarray(0, 3 * (chosen - part.first + 1)), end = so_far.length;
        lines(so_far, pose, COLOUR.flown, gl.LINE_STRIP);
        if (part === flown.filter((p) => p.first <= chosen).pop()) shape(gl.POINTS, 1, { buffer: scratch, data: so_far.slice(end - 3, end) }, pose, COLOUR.flown, 2, { tint: new Float32Array(COLOUR.flown.slice(0, 3)), bead: 11 * px });
      }
      if (found >= 0) { const c = cloudArrays(clouds, found, bright ? clouds.intensity : clouds.residual); shape(gl.POINTS, c.size, { buffer: scratch, data: c.place }, IDENTITY, COLOUR.sight, 2, { tint: c.tint, bead: 4 * px }); }
      if (faces.length) { gl.depthMask(false); shape(gl.TRIANGLES, mesh.place.length / 3, { buffer: fixed.place }, pose, COLOUR.estimate, 1, { normal: fixed.normal }); gl.depthMask(true); }
      note.textContent = flight ? "frame of the fixture {C}" : found >= 0 ? `${clouds.size[found]} points of scan ${clouds.scan[found]}` : "no points of this scan";
      canvas.dataset.painted = String(chosen);
    }
    function draw() { if (!dirty) { dirty = true; requestAnimationFrame(paint); } }
    function turn(dx, dy) { yaw -= dx; pitch = Math.min(Math.max(pitch + dy, -1.5), 1.5); draw(); }

    let held = null;
    canvas.addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); canvas.focus({ preventScroll: true }); });
    canvas.addEventListener("pointermove", (e) => { if (held) { turn((e.clientX - held[0]) * 0.008, (e.clientY - held[1]) * 0.008); held = [e.clientX, e.clientY]; } });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { held = null; });
    canvas.addEventListener("wheel", (e) => { if (document.activeElement === canvas) { e.preventDefault(); zoom *= Math.exp(e.deltaY * 0.001); draw(); } }, { passive: false });
    canvas.addEventListener("keydown", (e) => {
      const turns = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
      if (e.key in turns) turn(...turns[e.key]);
      else if (e.key === "+" || e.key === "=") { zoom *= 0.8; draw(); }
      else if (e.key === "-") { zoom *= 1.25; draw(); }
      else return;
      e.preventDefault();
    });
    requestAnimationFrame(paint);
    return { choose(k) { chosen = k; draw(); }, resize: draw };
  }
  return { build };
})();
