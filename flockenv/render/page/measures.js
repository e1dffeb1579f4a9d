/* The tab "Measures": curves of what the server measures, a colour for each world; costs of effects, and the time for a picture. */
const curves = new Map();

function takeMeasures(message) {
  Object.assign(live.timing, message.timing);
  message.lanes.forEach((values, n) => {
    for (const [name, value] of Object.entries(values)) {
      const key = `${n} ${name}`, curve = curves.get(key) || { times: [], values: [] };
      if (curve.times.length && message.time < curve.times[curve.times.length - 1]) while (curve.times.length && curve.times[curve.times.length - 1] >= message.time) { curve.times.pop(); curve.values.pop(); }
      if (curve.times[curve.times.length - 1] !== message.time && value.value !== null) { curve.times.push(message.time); curve.values.push(value.value); }
      if (curve.times.length > 600) { curve.times.shift(); curve.values.shift(); }
      curves.set(key, curve);
    }
  });
  showMeasures(message);
}

function showMeasures(message) {
  const box = $("measures"), names = [...new Set(message.lanes.flatMap(l => Object.keys(l)))];
  if (box.dataset.names !== names.join()) {
    box.dataset.names = names.join();
    box.replaceChildren(...namesOfLanes(), ...names.map(name => {
      const first = message.lanes.find(l => l[name])[name], row = element("div", undefined, "measure"), top = element("div", undefined, "top"), value = element("b"), canvas = element("canvas");
      row.title = first.title || ""; row.dataset.name = name; canvas.height = 36; canvas.width = 320;
      top.append(element("span", name.replace(/_/g, " ")), value); row.append(top, canvas);
      return row;
    }), costBox(), timingBox());
  }
  for (const row of box.querySelectorAll(".measure[data-name]")) {
    const { name } = row.dataset;
    const values = message.lanes.flatMap((lane, n) => [...(n ? [" "] : []), valueOfLane(lane[name], message.lanes.length > 1 ? laneColour(n) : "")]);
    row.querySelector("b").replaceChildren(...values, unitOf(message.lanes.find(lane => lane[name])[name]));
    drawSparks(row.querySelector("canvas"), message.lanes.map((_, n) => curves.get(`${n} ${name}`)));
  }
  showTiming();
}

function plainNumber(x) { return Number.isInteger(x) && Math.abs(x) < 1e6 ? String(x).replace("-", "−") : number(x); }

function unitOf(measure) { return measure && measure.unit && measure.unit !== "1" ? " " + raised(measure.unit) : ""; }

/* The colour of a world among several. */
function laneColour(n) { return [paint.accent, roleColour.pursuer, roleColour["learner 2"], paint.goal][n]; }

/* The names of several worlds in the order of their values, above their colours. */
function namesOfLanes() {
  const { lanes } = live.room, row = element("div", undefined, "measure"), top = element("div", undefined, "top"), names = element("b");
  if (lanes.length < 2) return [];
  names.append(...lanes.flatMap((lane, n) => [underlined(lane.name, laneColour(n)), " "]));
  top.append(element("span", "world"), names); row.append(top);
  return [row];
}

function underlined(text, colour) {
  const out = element("span", text);
  if (colour) out.style.borderBottom = `2px solid ${colour}`;
  return out;
}

function valueOfLane(measure, colour) { return underlined(measure && measure.value !== null ? plainNumber(measure.value) : "–", colour); }

/* Curves of one measure, a colour for each world, on shared axes; a world without the measure has none. */
function drawSparks(canvas, lines) {
  fit(canvas);
  const pen = canvas.getContext("2d"), known = lines.filter(Boolean), all = known.flatMap(l => l.values), times = known.flatMap(l => l.times), w = canvas.width, h = canvas.height, pad = 3;
  const low = Math.min(...all), high = Math.max(...all), from = Math.min(...times), to = Math.max(...times);
  pen.clearRect(0, 0, w, h); pen.lineWidth = 1.6; pen.lineJoin = "round";
  pen.strokeStyle = paint.grid; pen.beginPath(); pen.moveTo(0, h - pad); pen.lineTo(w, h - pad); pen.stroke();
  lines.forEach((line, n) => {
    if (!line) return;
    pen.strokeStyle = laneColour(n); pen.beginPath();
    line.values.forEach((v, k) => pen.lineTo(pad + (w - 2 * pad) * (line.times[k] - from) / (to - from || 1), h - pad - (h - 2 * pad) * (v - low) / (high - low || 1)));
    pen.stroke();
  });
}

function costBox() {
  const box = element("div"), button = element("button", "measure what each effect costs"), out = element("div");
  out.id = "costs";
  button.onclick = () => { live.ask({ type: "costs" }); out.replaceChildren(element("p", "Measuring takes some seconds; the world goes on.", "lead")); };
  box.append(heading("Time"), button, out);
  box.style.marginTop = "18px";
  return box;
}

function showCosts(message) {
  const box = $("costs");
  if (box) box.replaceChildren(plainTable(message.rows.map(row => [row.name.replace(/_/g, " "), `${number(row.cost)} µs/step`])));
}

function timingBox() { const box = element("div"); box.id = "timing"; return box; }

function showTiming() {
  const box = $("timing"), t = live.timing;
  if (!box) return;
  box.replaceChildren(heading("Frames"), plainTable([["frames per second", live.rate.shown.toFixed(0)], ["drawing", `${drawn.ms.toFixed(1)} ms`], ["physics", t.step === undefined ? "–" : `${t.step.toFixed(2)} ms/step`], ["encoding", t.encode === undefined ? "–" : `${t.encode.toFixed(2)} ms`], ["round trip to the server", t.round === undefined ? "–" : `${t.round.toFixed(1)} ms`]]));
}
