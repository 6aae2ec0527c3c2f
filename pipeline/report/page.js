"use strict";
// The interactive map. Reads the page's data block, draws on one canvas; no library, no network.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  document.documentElement.classList.add("script");

  // ---- data ----------------------------------------------------------------
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const f8 = (text) => new Float64Array(bytes(text));
  const f4 = (text) => new Float32Array(bytes(text));
  const i2 = (text) => new Int16Array(bytes(text));
  const i4 = (text) => new Int32Array(bytes(text));
  const readPoints = (code) => code && { time: f8(code.time_s), owner: i2(code.owner), position: f4(code.position_m) };
  const detections = readPoints(data.detections), truth = readPoints(data.truth), poses = readPoints(data.poses);

  const fans = readFans(data.fans);
  const fanAt = new Map(fans.map((fan) => [fan.window * 65536 + fan.agent, fan]));
  const shownOf = new Map(data.agent.map((agent, index) => [agent, index]));

  function readFans(code) {
    const window_ = i2(code.window), agent = i2(code.agent), numK = i2(code.num_hypotheses), numS = i2(code.num_vertices);
    const centre = f4(code.centre_m), scale = f4(code.scale_m);
    const step = i2(code.step), weight = f4(code.weight), hypothesis = i2(code.hypothesis), summary = i2(code.summary);
    const numR = i2(code.num_strands), strand = i2(code.strand);
    const found = [];
    let atS = 0, atK = 0, atH = 0, atR = 0, atB = 0;
    for (let f = 0; f < window_.length; f++) {
      const k = numK[f], s = numS[f];
      const steps = step.subarray(atS, atS + s);
      const strands = Array.from({ length: numR[f] }, (_, r) => {
        const [first, last, hypothesis, share, apart, direction] = strand.subarray(6 * (atR + r), 6 * (atR + r + 1));
        const own = { first, last, hypothesis, share: share / 1000, apart, direction, summary: summary.subarray(6 * atB, 6 * (atB + last - first + 1)) };
        atB += last - first + 1;
        return own;
      });
      found.push({
        window: window_[f], agent: agent[f], numK: k, numS: s, x: centre[2 * f], y: centre[2 * f + 1], scale: scale[f], steps,
        weight: weight.subarray(atK, atK + k), hypothesis: hypothesis.subarray(atH, atH + 2 * k * s),
        strands, now: Math.max(0, steps.indexOf(data.origin_index)), paths: null,
      });
      atS += s; atK += k; atH += 2 * k * s; atR += numR[f];
    }
    return found;
  }

  // Points of one owner, oldest first, so that tracks can be drawn in one go.
  function byOwner(points) {
    const lists = new Map();
    if (points) points.owner.forEach((owner, i) => { if (!lists.has(owner)) lists.set(owner, []); lists.get(owner).push(i); });
    return lists;
  }
  const truthOf = byOwner(truth), posesOf = byOwner(poses);

  // ---- state ---------------------------------------------------------------
  const canvas = byId("map"), pen = canvas.getContext("2d");
  const slider = byId("window"), readout = byId("readout"), moment = byId("moment"), playButton = byId("play");
  const state = { window: 0, x: 0, y: 0, scale: 1, agents: new Set([...data.agents.keys()].filter((agent) => !data.unlikely.includes(agent))), timer: 0, isPrinting: false, isWhole: false, span: data.shown_share };
  const isHidden = (owner) => shownOf.has(owner) && !state.agents.has(shownOf.get(owner));
  const layers = {};
  for (const box of document.querySelectorAll("[data-layer]")) {
    layers[box.dataset.layer] = box.checked;
    box.addEventListener("change", () => { layers[box.dataset.layer] = box.checked; draw(); });
  }

  // ---- words ---------------------------------------------------------------
  const startMs = Number(BigInt(data.start_ns) / 1000000n);
  const isCalendar = startMs >= 946684800000;
  const pad = (value, width = 2) => String(value).padStart(width, "0");
  function clock(seconds) {
    if (isCalendar) {
      const at = new Date(startMs + seconds * 1000);
      return `${at.getUTCFullYear()}-${pad(at.getUTCMonth() + 1)}-${pad(at.getUTCDate())} ${pad(at.getUTCHours())}:${pad(at.getUTCMinutes())}:${pad(at.getUTCSeconds())} UTC`;
    }
    const whole = Math.floor(Math.abs(seconds));
    return `T${seconds < 0 ? "-" : "+"}${pad(Math.floor(whole / 3600))}:${pad(Math.floor(whole / 60) % 60)}:${pad(whole % 60)}`;
  }
  const short = (value) => (Math.abs(value) >= 100 ? Math.round(value).toLocaleString("en-US") : String(Number(value.toPrecision(3))));
  const metres = (value) => (value >= 999.5 ? `${short(value / 1000)} km` : `${short(value)} m`);
  const period = (value) => (value < 99.5 ? `${short(value)} s` : value < 5970 ? `${Math.round(value / 60)} min` : `${short(value / 3600)} h`);

  function geodetic(x, y) {
    const fit = data.geodesy;
    if (!fit) return "";
    const u = (x + data.origin_m[0] - fit.centre_m[0]) / fit.half_m, v = (y + data.origin_m[1] - fit.centre_m[1]) / fit.half_m;
    if (Math.abs(u) > 1 || Math.abs(v) > 1) return "";
    let latitude = 0, longitude = 0;
    fit.exponents.forEach(([i, j], n) => { const term = u ** i * v ** j; latitude += fit.latitude[n] * term; longitude += fit.longitude[n] * term; });
    longitude = ((longitude + 540) % 360) - 180;
    return ` · ${Math.abs(latitude).toFixed(5)}° ${latitude < 0 ? "S" : "N"}, ${Math.abs(longitude).toFixed(5)}° ${longitude < 0 ? "W" : "E"}`;
  }

  // ---- view ----------------------------------------------------------------
  let width = 1, height = 1;
  const screenX = (x) => width / 2 + (x - state.x) * state.scale;
  const screenY = (y) => height / 2 - (y - state.y) * state.scale;

  function extent() { return { left: Infinity, right: -Infinity, low: Infinity, high: -Infinity }; }
  function grow(box, x, y) {
    box.left = Math.min(box.left, x); box.right = Math.max(box.right, x);
    box.low = Math.min(box.low, y); box.high = Math.max(box.high, y);
  }
  // All of the bands, at their full reach.
  function growByFan(box, fan) {
    const [start, end] = shownVertices(fan);
    for (const strand of fan.strands) {
      for (let v = Math.max(start, strand.first); v <= Math.min(end, strand.last); v++) {
        const at = 6 * (v - strand.first), angle = strand.summary[at + 4] / 10000, [x, y] = meanOf(fan, strand, v);
        const a = strand.summary[at + 2] * fan.scale, b = strand.summary[at + 3] * fan.scale;
        const wide = Math.hypot(a * Math.cos(angle), b * Math.sin(angle)), high = Math.hypot(a * Math.sin(angle), b * Math.cos(angle));
        grow(box, x - wide, y - high); grow(box, x + wide, y + high);
      }
    }
  }
  function show(box) {
    if (!(box.right >= box.left)) return;
    const wide = Math.max(box.right - box.left, 1), high = Math.max(box.high - box.low, 1);
    state.x = (box.left + box.right) / 2; state.y = (box.low + box.high) / 2;
    state.scale = Math.min((width - 70) / wide, (height - 90) / high);
    draw();
  }
  // Where everything was seen, and the bands of the window shown: they follow the window until somebody moves the map.
  function fitAll() {
    state.isWhole = true;
    const box = extent();
    for (const points of [detections, truth]) {
      if (points) for (let i = 0; i < points.time.length; i++) grow(box, points.position[2 * i], points.position[2 * i + 1]);
    }
    // Of agents that are rather none nothing is known.
    for (const fan of fans) if (fan.window === state.window && likelihood(fan) >= 0.5) growByFan(box, fan);
    show(box);
  }
  function fitWindow(only) {
    state.isWhole = false;
    const box = extent();
    for (const agent of only === undefined ? state.agents : [only]) {
      const fan = fanAt.get(state.window * 65536 + agent);
      if (fan) growByFan(box, fan);
    }
    show(box);
  }
  function move(x, y) {
    state.isWhole = false;
    state.x += x / state.scale; state.y += y / state.scale;
    draw();
  }
  function zoom(factor, x = width / 2, y = height / 2) {
    state.isWhole = false;
    const scale = Math.min(Math.max(state.scale * factor, 1e-6), 1e4);
    state.x += (x - width / 2) * (1 / state.scale - 1 / scale);
    state.y -= (y - height / 2) * (1 / state.scale - 1 / scale);
    state.scale = scale;
    draw();
  }

  // ---- drawing -------------------------------------------------------------
  const labelBoxes = [];
  const LIGHT = { card: "#ffffff", text: "#1b2430", muted: "#586472", faint: "#eef1f4", past: "#0072b2", future: "#d55e00", truth: "#009e73", sensor: "#cc79a7", obstacle: "#7d8894", detection: "#111820" };
  function colours() {
    if (state.isPrinting) return LIGHT;
    const style = getComputedStyle(document.documentElement);
    return Object.fromEntries(Object.keys(LIGHT).map((name) => [name, style.getPropertyValue(`--${name}`).trim() || LIGHT[name]]));
  }

  // Where a strand is drawn: the mean of its hypotheses, or the one that stands for a way of several.
  function meanOf(fan, strand, v) {
    const at = 6 * (v - strand.first);
    return [fan.x + strand.summary[at] * fan.scale, fan.y + strand.summary[at + 1] * fan.scale];
  }
  function vertexOf(fan, k, v) {
    const at = 2 * (k * fan.numS + v);
    return [fan.x + fan.hypothesis[at] * fan.scale, fan.y + fan.hypothesis[at + 1] * fan.scale];
  }
  const placeOf = (fan, strand, v) => (strand.hypothesis < 0 ? meanOf(fan, strand, v) : vertexOf(fan, strand.hypothesis, v));

  // Paths in metres, made when a fan is first drawn: the canvas scales them.
  function pathsOf(fan) {
    if (fan.paths && fan.paths.span === state.span) return fan.paths;
    const [start, end] = shownVertices(fan), sides = { past: [start, fan.now], future: [fan.now, end] };
    fan.paths = { span: state.span, lines: {}, mean: {}, outer: {}, inner: {} };
    for (const [side, [first, last]] of Object.entries(sides)) {
      fan.paths.lines[side] = Array.from({ length: fan.numK }, (_, k) => line(new Path2D(), (v) => vertexOf(fan, k, v), first, last));
      fan.paths.mean[side] = new Path2D(); fan.paths.outer[side] = new Path2D(); fan.paths.inner[side] = new Path2D();
      for (const strand of fan.strands) {
        const from = Math.max(first, strand.first), to = Math.min(last, strand.last);
        line(fan.paths.mean[side], (v) => placeOf(fan, strand, v), from, to);
        band(fan.paths.outer[side], fan, strand, from, to, false);
        band(fan.paths.inner[side], fan, strand, from, to, true);
      }
    }
    return fan.paths;
  }
  // First and last vertex within the shown part of the window, or the next ones outside it.
  function shownVertices(fan) {
    const low = data.origin_index * (1 - state.span), high = data.origin_index + (data.num_steps - 1 - data.origin_index) * state.span;
    let start = fan.now, end = fan.now;
    while (start > 0 && fan.steps[start] > low) start--;
    while (end < fan.numS - 1 && fan.steps[end] < high) end++;
    return [start, end];
  }
  function line(path, at, first, last) {
    for (let v = first; v <= last; v++) path[v === first ? "moveTo" : "lineTo"](...at(v));
    return path;
  }
  function ellipse(fan, strand, v, isInner) {
    const at = 6 * (v - strand.first), share = isInner ? strand.summary[at + 5] / 10000 : 1, angle = strand.summary[at + 4] / 10000;
    const a = strand.summary[at + 2] * fan.scale * share, b = strand.summary[at + 3] * fan.scale * share;
    const cos = Math.cos(angle), sin = Math.sin(angle), [x, y] = meanOf(fan, strand, v), points = [];
    for (let i = 0; i < 24; i++) {
      const u = a * Math.cos((i * Math.PI) / 12), w = b * Math.sin((i * Math.PI) / 12);
      points.push([x + u * cos - w * sin, y + u * sin + w * cos]);
    }
    return points;
  }
  // The hulls of neighbouring ellipses, all turning the same way: filled together they are their union.
  function band(path, fan, strand, first, last, isInner) {
    if (first > last) return;
    let before = ellipse(fan, strand, first, isInner);
    for (let v = first + 1; v <= last; v++) {
      const after = ellipse(fan, strand, v, isInner);
      hull(before.concat(after)).forEach(([x, y], i) => path[i ? "lineTo" : "moveTo"](x, y));
      path.closePath();
      before = after;
    }
  }
  function hull(points) {
    points.sort((p, q) => p[0] - q[0] || p[1] - q[1]);
    const half = (list) => {
      const chain = [];
      for (const p of list) {
        while (chain.length > 1) {
          const [a, b] = [chain[chain.length - 2], chain[chain.length - 1]];
          if ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
          chain.pop();
        }
        chain.push(p);
      }
      chain.pop();
      return chain;
    };
    return half(points).concat(half(points.slice().reverse()));
  }

  function inMetres(action) {
    pen.save();
    pen.translate(width / 2 - state.x * state.scale, height / 2 + state.y * state.scale);
    pen.scale(state.scale, -state.scale);
    action();
    pen.restore();
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1, colour = colours();
    width = canvas.clientWidth || 1; height = canvas.clientHeight || 1;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.fillStyle = colour.card;
    pen.fillRect(0, 0, width, height);
    pen.lineJoin = "round";
    drawGrid(colour);
    const visible = [...state.agents].map((agent) => fanAt.get(state.window * 65536 + agent)).filter(Boolean);
    labelBoxes.length = 0;
    if (layers.envelopes) inMetres(() => visible.forEach((fan) => drawEnvelopes(fan, colour)));
    if (layers.obstacles) drawObstacles(colour);
    if (layers.everywhere) drawEverywhere(colour);
    if (layers.sensors) drawSensors(colour);
    inMetres(() => visible.forEach((fan) => drawHypotheses(fan, colour)));
    if (layers.truth) drawTruth(colour);
    if (layers.mean) inMetres(() => visible.forEach((fan) => drawMean(fan, colour)));
    if (layers.detections) drawDetections(colour);
    visible.forEach((fan) => drawNow(fan, colour, visible.length));
    if (layers.names) visible.forEach((fan) => { const [x, y] = nowOf(fan)[0]; label(data.agents[fan.agent] + (there(fan.agent) && ` (there: ${there(fan.agent)})`), x + 9, y - 7, colour.text, colour); });
    if (layers.mean) visible.forEach((fan) => drawShares(fan, colour));
    drawFurniture(colour);
  }

  // How likely an agent is there at all in the window shown; nothing where the log says who was seen.
  const probabilityOf = (window_, agent) => ((data.cells[window_] ?? [])[agent] ?? [])[4] ?? null;
  // An agent is drawn as strongly as it is likely there.
  const likelihood = (fan) => Math.max(0.1, probabilityOf(fan.window, fan.agent) ?? 1);
  function there(agent) {
    const probability = probabilityOf(state.window, agent);
    return probability === null ? "" : `${probability > 0.99 ? "> 99" : Math.round(100 * probability)} %`;
  }

  function niceLength(length) {
    const power = 10 ** Math.floor(Math.log10(length));
    return [5, 2, 1].map((factor) => factor * power).find((value) => value <= length * (1 + 1e-9));
  }
  function drawGrid(colour) {
    const pitch = niceLength(160 / state.scale);
    pen.strokeStyle = colour.faint; pen.lineWidth = 1;
    pen.beginPath();
    const [ox, oy] = data.origin_m;
    for (let x = Math.ceil((state.x + ox - width / 2 / state.scale) / pitch) * pitch - ox; screenX(x) < width; x += pitch) { pen.moveTo(screenX(x), 0); pen.lineTo(screenX(x), height); }
    for (let y = Math.ceil((state.y + oy - height / 2 / state.scale) / pitch) * pitch - oy; screenY(y) > 0; y += pitch) { pen.moveTo(0, screenY(y)); pen.lineTo(width, screenY(y)); }
    pen.stroke();
  }
  function drawObstacles(colour) {
    pen.strokeStyle = colour.obstacle; pen.lineWidth = 1;
    for (const item of data.obstacles) {
      pen.beginPath();
      if (item.circle) pen.arc(screenX(item.circle[0]), screenY(item.circle[1]), item.circle[2] * state.scale, 0, 2 * Math.PI);
      else for (const ring of item.rings) { ring.forEach(([x, y], i) => pen[i ? "lineTo" : "moveTo"](screenX(x), screenY(y))); pen.closePath(); }
      // Nobody enters: what of a band would lie inside is covered.
      pen.fillStyle = colour.card; pen.fill("evenodd");
      pen.fillStyle = colour.obstacle; pen.globalAlpha = 0.2; pen.fill("evenodd"); pen.globalAlpha = 1; pen.stroke();
    }
  }
  function drawEnvelopes(fan, colour) {
    const paths = pathsOf(fan);
    for (const side of ["past", "future"]) {
      if (!layers[side]) continue;
      pen.fillStyle = colour[side];
      pen.globalAlpha = 0.12 * likelihood(fan); pen.fill(paths.outer[side]);
      pen.globalAlpha = 0.16 * likelihood(fan); pen.fill(paths.inner[side]);
    }
    pen.globalAlpha = 1;
  }
  function drawHypotheses(fan, colour) {
    const paths = pathsOf(fan), heaviest = Math.max(...fan.weight), base = Math.min(0.75, Math.max(0.16, 2 / Math.sqrt(fan.numK)));
    pen.lineWidth = 1 / state.scale;
    for (const side of ["past", "future"]) {
      if (!layers[side]) continue;
      pen.strokeStyle = colour[side];
      for (let k = 0; k < fan.numK; k++) { pen.globalAlpha = likelihood(fan) * Math.max(0.05, (base * fan.weight[k]) / heaviest); pen.stroke(paths.lines[side][k]); }
    }
    pen.globalAlpha = 1;
  }
  function drawMean(fan, colour) {
    const paths = pathsOf(fan);
    for (const side of ["past", "future"]) {
      if (!layers[side]) continue;
      pen.setLineDash(side === "future" ? [6 / state.scale, 4 / state.scale] : []);
      pen.strokeStyle = colour.card; pen.lineWidth = 4 / state.scale; pen.globalAlpha = 0.6 * likelihood(fan); pen.stroke(paths.mean[side]);
      pen.strokeStyle = colour[side]; pen.lineWidth = 2.2 / state.scale; pen.globalAlpha = likelihood(fan); pen.stroke(paths.mean[side]);
    }
    pen.globalAlpha = 1;
    pen.setLineDash([]);
  }

  // Of hypotheses that go several ways: how many go each, where they are furthest apart.
  function drawShares(fan, colour) {
    if (likelihood(fan) < 0.5) return;
    const [start, end] = shownVertices(fan);
    for (const strand of fan.strands) {
      const side = strand.apart > fan.now ? "future" : "past";
      if (strand.apart < start || strand.apart > end || strand.share === 1 || !layers[side]) continue;
      const [x, y] = placeOf(fan, strand, strand.apart);
      label(`${Math.round(100 * strand.share)} % ${data.directions[strand.direction]}`, screenX(x) + 6, screenY(y) - 4, colour[side], colour);
    }
  }

  const backSeconds = (share) => share * data.origin_index * data.step_s;
  const aheadSeconds = (share) => share * (data.num_steps - 1 - data.origin_index) * data.step_s;
  const shownTimes = () => {
    const now = data.origin_s[state.window];
    return { now, first: now - backSeconds(state.span), last: now + aheadSeconds(state.span) };
  };
  function drawTrack(points, indices, first, last) {
    pen.beginPath();
    let isDown = false;
    for (const i of indices) {
      if (points.time[i] < first || points.time[i] > last) continue;
      pen[isDown ? "lineTo" : "moveTo"](screenX(points.position[2 * i]), screenY(points.position[2 * i + 1]));
      isDown = true;
    }
    pen.stroke();
  }
  function drawTruth(colour) {
    if (!truth) return;
    const { first, last } = shownTimes();
    pen.strokeStyle = colour.truth; pen.lineWidth = 2; pen.lineCap = "round"; pen.setLineDash([1.5, 4.5]);
    for (const [owner, indices] of truthOf) if (!isHidden(owner)) drawTrack(truth, indices, first, last);
    pen.setLineDash([]); pen.lineCap = "butt";
  }
  function drawSensors(colour) {
    if (!poses) return;
    const { now, first } = shownTimes();
    for (const [owner, indices] of posesOf) {
      pen.strokeStyle = pen.fillStyle = colour.sensor; pen.lineWidth = 1.2; // the name of the sensor before has other ones
      pen.globalAlpha = 0.6; drawTrack(poses, indices, first, now); pen.globalAlpha = 1;
      let latest = -1;
      for (const i of indices) { if (poses.time[i] > now) break; latest = i; }
      if (latest < 0) continue;
      const x = screenX(poses.position[2 * latest]), y = screenY(poses.position[2 * latest + 1]);
      pen.beginPath(); pen.moveTo(x, y - 6); pen.lineTo(x + 5.5, y + 4); pen.lineTo(x - 5.5, y + 4); pen.closePath(); pen.fill();
      if (posesOf.size <= 8) label(data.sensors[owner] ?? "", x + 8, y + 4, colour.sensor, colour);
    }
  }
  function drawDetections(colour) {
    if (!detections) return;
    const { now, first, last } = shownTimes(), latest = new Map();
    pen.lineWidth = 1;
    let from = 0, to = detections.time.length;
    while (from < to) { const middle = (from + to) >> 1; if (detections.time[middle] < first) from = middle + 1; else to = middle; }
    for (let i = from; i < detections.time.length && detections.time[i] <= last; i++) {
      const owner = detections.owner[i];
      if (isHidden(owner)) continue;
      const x = screenX(detections.position[2 * i]), y = screenY(detections.position[2 * i + 1]);
      // Of detections that would cover each other one is drawn: dense bursts stay dots.
      const other = latest.get(owner), isLater = detections.time[i] > now + 0.0006;
      if (other && other.isLater === isLater && Math.hypot(x - other.x, y - other.y) < 5) continue;
      latest.set(owner, { x, y, isLater });
      pen.beginPath(); pen.arc(x, y, 3.4, 0, 2 * Math.PI);
      if (isLater) { pen.strokeStyle = colour.detection; pen.globalAlpha = 0.55; pen.stroke(); }
      else {
        pen.strokeStyle = colour.card; pen.globalAlpha = 0.9; pen.stroke();
        pen.fillStyle = colour.detection; pen.globalAlpha = 1 - (0.75 * (now - detections.time[i])) / Math.max(now - first, 1e-9); pen.fill();
      }
    }
    pen.globalAlpha = 1;
  }
  // The whole mission, faintly: where this window lies in it.
  function drawEverywhere(colour) {
    if (!detections) return;
    pen.fillStyle = colour.detection; pen.globalAlpha = 0.22;
    for (let i = 0; i < detections.time.length; i++) {
      const owner = detections.owner[i];
      if (!isHidden(owner)) pen.fillRect(screenX(detections.position[2 * i]) - 1, screenY(detections.position[2 * i + 1]) - 1, 2, 2);
    }
    pen.globalAlpha = 1;
  }
  // Where an agent is at the moment, one place for each way, the likeliest first.
  function nowOf(fan) {
    const there = fan.strands.filter((strand) => strand.first <= fan.now && fan.now <= strand.last);
    const ways = there.filter((strand) => strand.hypothesis >= 0);
    return (ways.length ? ways : there).map((strand) => placeOf(fan, strand, fan.now)).map(([x, y]) => [screenX(x), screenY(y)]);
  }
  function drawNow(fan, colour, count) {
    pen.strokeStyle = colour.text; pen.lineWidth = 1.6;
    pen.globalAlpha = likelihood(fan);
    for (const [x, y] of nowOf(fan)) { pen.beginPath(); pen.arc(x, y, count > 12 ? 4.5 : 6, 0, 2 * Math.PI); pen.stroke(); }
    pen.globalAlpha = 1;
  }
  function label(text, x, y, fill, colour) {
    const shown = text.length > 24 ? `${text.slice(0, 23)}…` : text;
    pen.font = "12px system-ui, sans-serif";
    // A name that would cover another one is left out; zooming in brings it back. At the edge it stands on the other side.
    const wide = pen.measureText(shown).width;
    if (x + wide > width) x -= wide + 18;
    const box = [x, y - 11, x + wide, y + 3];
    if (labelBoxes.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3])) return;
    labelBoxes.push(box);
    pen.lineWidth = 3; pen.strokeStyle = colour.card; pen.fillStyle = fill;
    pen.globalAlpha = 0.8; pen.strokeText(shown, x, y); pen.globalAlpha = 1; pen.fillText(shown, x, y);
  }
  function drawFurniture(colour) {
    const length = niceLength(150 / state.scale), wide = length * state.scale;
    pen.font = "12px system-ui, sans-serif"; pen.textAlign = "center";
    pen.fillStyle = colour.card; pen.globalAlpha = 0.8; pen.fillRect(10, height - 36, wide + 16, 28); pen.globalAlpha = 1;
    pen.strokeStyle = pen.fillStyle = colour.text; pen.lineWidth = 1.5;
    pen.beginPath(); pen.moveTo(18, height - 19); pen.lineTo(18, height - 14); pen.lineTo(18 + wide, height - 14); pen.lineTo(18 + wide, height - 19); pen.stroke();
    pen.fillText(metres(length), 18 + wide / 2, height - 21);
    pen.beginPath(); pen.moveTo(width - 24, 12); pen.lineTo(width - 18, 32); pen.lineTo(width - 24, 27); pen.lineTo(width - 30, 32); pen.closePath(); pen.fill();
    pen.fillText("N", width - 24, 46);
    pen.textAlign = "start";
  }

  // ---- controls ------------------------------------------------------------
  const list = byId("agents");
  const cellTexts = data.agents.map((name, agent) => {
    const item = document.createElement("li"), box = document.createElement("input"), button = document.createElement("button"), text = document.createElement("span");
    box.type = "checkbox"; box.checked = state.agents.has(agent); box.setAttribute("aria-label", `show ${name}`);
    box.addEventListener("change", () => { if (box.checked) state.agents.add(agent); else state.agents.delete(agent); draw(); });
    button.type = "button"; button.textContent = name; button.title = `${name}: zoom to it`;
    button.addEventListener("click", () => { box.checked = true; state.agents.add(agent); fitWindow(agent); });
    item.append(box, button, text);
    list.append(item);
    return text;
  });
  // Of many agents the list shows those whose names hold what is typed, and says how many there are.
  const MOST_LISTED = 60, search = byId("search"), count = byId("agent-count");
  function filter() {
    const wanted = search.value.toLowerCase(), items = [...list.children];
    const found = items.filter((_, agent) => data.agents[agent].toLowerCase().includes(wanted));
    items.forEach((item) => { item.hidden = true; });
    found.slice(0, MOST_LISTED).forEach((item) => { item.hidden = false; });
    count.textContent = found.length > MOST_LISTED ? `${MOST_LISTED} of ${found.length} agents listed: type a part of a name to find others` : wanted ? `${found.length} of ${items.length} agents` : "";
  }
  search.hidden = data.agents.length <= 12;
  search.addEventListener("input", filter);
  filter();

  function setAgents(isShown) {
    for (const box of list.querySelectorAll("input")) box.checked = isShown;
    state.agents = new Set(isShown ? data.agents.keys() : []);
    draw();
  }

  function setWindow(index) {
    state.window = Math.min(Math.max(index, 0), Math.max(data.window.length - 1, 0));
    slider.value = String(state.window);
    const seconds = data.origin_s[state.window];
    const words = data.window.length ? `${clock(seconds)} · window ${data.window[state.window]}` : "no windows";
    moment.textContent = words; slider.setAttribute("aria-valuetext", words);
    cellTexts.forEach((text, agent) => {
      const [status, count, age, spread] = (data.cells[state.window] ?? [])[agent] ?? ["", 0, null, null, null];
      text.textContent = there(agent) + (there(agent) && ", ") + (status && spread === null ? status.replaceAll("_", " ") : count === 0 && spread === null ? "no detections" : `±${metres(spread ?? 0)}, ${period(age ?? 0)}`);
    });
    for (const chart of document.querySelectorAll("svg.chart")) {
      const x = (Number(chart.dataset.left) + seconds * Number(chart.dataset.scale)).toFixed(1), cursor = chart.querySelector(".cursor");
      cursor.setAttribute("transform", `translate(${x - Number(chart.dataset.left)} 0)`); cursor.setAttribute("visibility", "visible");
    }
    if (state.isWhole) fitAll(); else draw();
  }
  function nearestWindow(seconds) {
    let best = 0;
    data.origin_s.forEach((origin, i) => { if (Math.abs(origin - seconds) < Math.abs(data.origin_s[best] - seconds)) best = i; });
    return best;
  }
  function play(isPlaying) {
    clearInterval(state.timer);
    state.timer = isPlaying ? setInterval(() => setWindow((state.window + 1) % Math.max(data.window.length, 1)), Number(byId("pace").value)) : 0;
    playButton.textContent = isPlaying ? "Pause" : "Play";
  }

  const spanBox = byId("span");
  for (const share of new Set([1, 0.5, 0.25, 0.125, data.shown_share])) {
    const option = document.createElement("option");
    option.value = String(share);
    option.textContent = `${period(backSeconds(share))} back, ${period(aheadSeconds(share))} ahead`;
    option.selected = share === state.span;
    spanBox.append(option);
  }
  spanBox.addEventListener("change", () => { state.span = Number(spanBox.value); draw(); });
  slider.max = String(Math.max(data.window.length - 1, 0));
  slider.addEventListener("input", () => setWindow(Number(slider.value)));
  playButton.addEventListener("click", () => play(!state.timer));
  byId("pace").addEventListener("change", () => { if (state.timer) play(true); });
  byId("previous").addEventListener("click", () => setWindow(state.window - 1));
  byId("next").addEventListener("click", () => setWindow(state.window + 1));
  byId("all").addEventListener("click", () => setAgents(true));
  byId("none").addEventListener("click", () => setAgents(false));
  byId("fit-all").addEventListener("click", fitAll);
  byId("fit-window").addEventListener("click", () => fitWindow());
  byId("zoom-in").addEventListener("click", () => zoom(1.5));
  byId("zoom-out").addEventListener("click", () => zoom(1 / 1.5));

  const place = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  const held = new Map();
  canvas.addEventListener("pointerdown", (event) => { held.set(event.pointerId, place(event)); canvas.setPointerCapture(event.pointerId); });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const [x, y] = place(event), before = held.get(event.pointerId);
    if (before) {
      const other = [...held].find(([id]) => id !== event.pointerId)?.[1];
      if (other) zoom(Math.hypot(x - other[0], y - other[1]) / Math.max(Math.hypot(before[0] - other[0], before[1] - other[1]), 1), other[0], other[1]);
      else move(before[0] - x, y - before[1]);
      held.set(event.pointerId, [x, y]);
    }
    const east = state.x + (x - width / 2) / state.scale, north = state.y - (y - height / 2) / state.scale;
    readout.textContent = `east ${(east + data.origin_m[0]).toFixed(1)} m, north ${(north + data.origin_m[1]).toFixed(1)} m${geodetic(east, north)}`;
  });
  canvas.addEventListener("pointerleave", () => { readout.textContent = ""; });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)), ...place(event)); }, { passive: false });
  canvas.addEventListener("dblclick", (event) => zoom(2, ...place(event)));
  const keys = { "+": () => zoom(1.3), "=": () => zoom(1.3), "-": () => zoom(1 / 1.3), 0: fitAll, " ": () => play(!state.timer), ",": () => setWindow(state.window - 1), ".": () => setWindow(state.window + 1) };
  for (const [key, dx, dy] of [["ArrowLeft", -1, 0], ["ArrowRight", 1, 0], ["ArrowUp", 0, 1], ["ArrowDown", 0, -1]]) {
    keys[key] = () => move(60 * dx, 60 * dy);
  }
  canvas.addEventListener("keydown", (event) => { if (keys[event.key] && !event.ctrlKey && !event.metaKey) { event.preventDefault(); keys[event.key](); } });

  for (const chart of document.querySelectorAll("svg.chart")) {
    chart.addEventListener("click", (event) => {
      const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(chart.getScreenCTM().inverse());
      setWindow(nearestWindow((at.x - Number(chart.dataset.left)) / Number(chart.dataset.scale)));
    });
  }
  for (const button of document.querySelectorAll("[data-seconds]")) {
    button.addEventListener("click", () => {
      setWindow(nearestWindow(Number(button.dataset.seconds)));
      fitWindow(shownOf.get(Number(button.dataset.agent)));
      canvas.scrollIntoView({ block: "center" });
      canvas.focus({ preventScroll: true });
    });
  }

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  addEventListener("beforeprint", () => { state.isPrinting = true; draw(); });
  addEventListener("afterprint", () => { state.isPrinting = false; draw(); });
  new ResizeObserver(draw).observe(canvas);
  width = canvas.clientWidth || 1; height = canvas.clientHeight || 1;
  setWindow(data.first_window);
  fitAll();
  if (byId("moving")) playWhole({ byId, f8, i4, i2, clock, colours });
})();
