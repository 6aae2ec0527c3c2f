"use strict";
// Mission hypotheses as balls with fading trails over the map of the whole mission; `tools` are the helpers of page.js.
function playWhole({ byId, f8, i4, i2, clock, colours }) {
  const code = JSON.parse(byId("moving").textContent);
  const [mapWidth] = code.size, UNIT = 16, PIECES = 12, PACES = [1, 10, 60, 300, 600];
  const times = f8(code.time_s), counts = i4(code.num_vertices), steps = i4(code.step), places = i2(code.place);
  const start = times[0], span = Math.max(times[times.length - 1] - start, 1e-3), trail = span / 20;
  const canvas = byId("whole-map"), pen = canvas.getContext("2d"), slider = byId("whole-time"), playButton = byId("whole-play");
  let colour = colours();
  const state = { time: start, pace: 1, before: 0, isPlaying: false };
  const SLIDES = Number(slider.max);

  const begins = new Int32Array(counts.length + 1);
  counts.forEach((count, track) => { begins[track + 1] = begins[track] + count; });
  const seen = new Float32Array(2 * (PIECES + 1)); // where a track is and was, newest first; NaN where it is not
  function place(track, time, at) {
    let low = begins[track], high = begins[track + 1] - 1;
    if (time < times[steps[low]] || time > times[steps[high]]) { seen[at] = NaN; return; }
    while (high - low > 1) { const middle = (low + high) >> 1; if (times[steps[middle]] <= time) low = middle; else high = middle; }
    const from = times[steps[low]], share = high > low ? (time - from) / (times[steps[high]] - from) : 0;
    seen[at] = (places[2 * low] + share * (places[2 * high] - places[2 * low])) / UNIT;
    seen[at + 1] = (places[2 * low + 1] + share * (places[2 * high + 1] - places[2 * low + 1])) / UNIT;
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio) || 1, height = Math.round(canvas.clientHeight * ratio) || 1;
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    pen.setTransform(width / mapWidth, 0, 0, width / mapWidth, 0, 0);
    pen.clearRect(0, 0, ...code.size);
    const pieces = Array.from({ length: PIECES }, () => new Path2D()), balls = new Path2D(), drawn = new Set();
    for (let track = 0; track < counts.length; track++) {
      for (let piece = 0; piece <= PIECES; piece++) place(track, Math.max(state.time - (piece * trail) / PIECES, start), 2 * piece);
      // Of balls in one place one is drawn, and of those that rest no trail.
      const spot = Math.round(2 * seen[0]) * 65536 + Math.round(2 * seen[1]);
      if (seen[0] === seen[0] && !drawn.has(spot)) { drawn.add(spot); balls.moveTo(seen[0] + 3, seen[1]); balls.arc(seen[0], seen[1], 3, 0, 2 * Math.PI); }
      for (let piece = 0; piece < PIECES; piece++) {
        const at = 2 * piece;
        if (!(Math.abs(seen[at] - seen[at + 2]) + Math.abs(seen[at + 1] - seen[at + 3]) > 0.1)) continue;
        pieces[piece].moveTo(seen[at], seen[at + 1]); pieces[piece].lineTo(seen[at + 2], seen[at + 3]);
      }
    }
    pen.strokeStyle = colour.future; pen.lineWidth = 1.6;
    for (let piece = PIECES - 1; piece >= 0; piece--) { pen.globalAlpha = 0.7 * (1 - piece / PIECES); pen.stroke(pieces[piece]); }
    pen.globalAlpha = 1;
    pen.strokeStyle = colour.card; pen.lineWidth = 1.6; pen.stroke(balls);
    pen.fillStyle = colour.future; pen.fill(balls);
  }
  function show(time) {
    state.time = Math.min(Math.max(time, start), start + span);
    slider.value = String(Math.round((SLIDES * (state.time - start)) / span));
    const words = clock(state.time);
    byId("whole-moment").textContent = words; slider.setAttribute("aria-valuetext", words);
    draw();
  }
  function play(isPlaying) {
    state.isPlaying = isPlaying;
    playButton.textContent = isPlaying ? "Pause" : "Play";
    if (!isPlaying) return;
    if (state.time >= start + span) show(start);
    state.before = performance.now();
    requestAnimationFrame(frame);
  }
  // A page that was hidden for a while goes on where it was.
  function frame(now) {
    if (!state.isPlaying) return;
    const passed = Math.min(Math.max(now - state.before, 0) / 1000, 0.1);
    state.before = now;
    show(state.time + passed * state.pace);
    if (state.time >= start + span) play(false); else requestAnimationFrame(frame);
  }

  const pace = byId("whole-pace");
  state.pace = PACES.find((fast) => span / fast <= 60) ?? PACES[PACES.length - 1];
  for (const fast of PACES) pace.append(new Option(`${fast} ×`, String(fast), false, fast === state.pace));
  pace.addEventListener("change", () => { state.pace = Number(pace.value); });
  playButton.addEventListener("click", () => play(!state.isPlaying));
  slider.addEventListener("input", () => show(start + (span * Number(slider.value)) / SLIDES));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { colour = colours(); draw(); });
  new ResizeObserver(draw).observe(canvas);
  show(start);
}
