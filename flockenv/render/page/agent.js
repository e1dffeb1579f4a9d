/* The tab "Agent": what one agent does, feels and sees; the tab "Measures"; both ask the server only while they are open. */

function choose(lane, agent) {
  chosen.lane = lane; chosen.agent = agent; chosen.look = null;
  if (agent !== null) { openTab("agent"); askLook(); } else showLook();
  refresh();
}

function askLook() {
  if (chosen.agent === null || performance.now() - chosen.askedAt < 90) return;
  chosen.askedAt = performance.now();
  live.ask({ type: "look", lane: chosen.lane, agent: chosen.agent });
}

function cells(row, ...texts) { row.append(...texts.map(text => { const cell = element("td"); cell.append(text); return cell; })); return row; }

function heading(text) { return element("h2", text); }

function showLook() {
  const box = $("agent"), look = chosen.look;
  if (chosen.agent === null) { box.replaceChildren(element("p", "Click an agent to see its forces, what it observes, and where it goes.", "empty")); return; }
  if (!look) { if (!box.querySelector("h2")) box.replaceChildren(element("p", "Looking …", "empty")); return; }
  const parts = [agentHead(look), forcesOf(look)];
  if (look.reward && look.reward.length) parts.push(tableOf("Return so far, by term", look.reward.map(r => [r.name.replace(/_/g, " "), number(r.total)])));
  if (look.observation && look.observation.length) parts.push(observationOf(look));
  const at = box.scrollTop;
  if (document.activeElement && document.activeElement.closest("#agent select")) return; // a list is open
  box.replaceChildren(...parts);
  box.scrollTop = at;
}

function agentHead(look) {
  const box = element("div"), row = element("div", undefined, "row"), panel = state.group.panels[chosen.lane] || state.group.panels[0];
  box.append(heading(`${look.role} ${look.agent}`));
  const speed = Math.hypot(...look.vel), facts = [["speed", `${number(speed)} m/s`], ["position", look.pos.map(x => number(x)).join(", ") + " m"], ["neighbours", String(look.neighbours.length)]];
  box.append(plainTable(facts));
  const follow = element("button", views[chosen.lane] && views[chosen.lane].camera.follow === look.agent ? "stop following" : "follow");
  follow.onclick = () => { const { camera } = views[chosen.lane]; camera.follow = camera.follow === look.agent ? null : look.agent; if (camera.follow !== null && camera.zoom < 2) camera.zoom = 3; refresh(); };
  row.append(follow);
  const players = live.room.players || [], now = (panel.lane.players || [])[look.agent];
  if (players.length && now !== undefined) row.append("steered by", playerSelect(players, now, player => {
    live.edit({ kind: "player", learners: [look.agent], player }, views.length > 1 ? chosen.lane : null);
    if (player === "you") tell(STEER);
  }));
  box.append(row);
  return box;
}

function playerSelect(players, now, act) {
  const select = element("select");
  select.append(...players.map(player => { const option = element("option", player); option.selected = player === now; return option; }));
  select.setAttribute("aria-label", "player");
  select.onchange = () => { act(players[select.selectedIndex]); select.blur(); };
  return select;
}

function plainTable(rows) {
  const table = element("table", undefined, "read");
  table.append(...rows.map(texts => cells(element("tr"), ...texts)));
  return table;
}

function tableOf(title, rows) { const box = element("div"); box.append(heading(title), plainTable(rows)); return box; }

/* Each force with the colour of its arrow, its size in N, and how much of a behaviour's steering was granted. */
function forcesOf(look) {
  const sizes = look.forces.map(f => Math.hypot(...f.vector)), most = Math.max(...sizes, 1e-12), box = element("div");
  box.append(heading("Forces"));
  const rows = look.forces.map((force, n) => {
    const row = element("tr"), name = element("span"), swatch = element("span", undefined, "swatch"), gauge = element("div", undefined, "gauge"), bar = element("i");
    swatch.style.background = force.kind === "total" ? paint.ink : forceColour(n);
    name.append(swatch, force.name.replace(/_/g, " "));
    if (force.granted !== undefined && force.granted !== null && force.granted < 0.995) name.append(element("small", ` ${Math.round(100 * force.granted)} % granted`));
    bar.style.width = `${100 * sizes[n] / most}%`; bar.style.background = swatch.style.background;
    gauge.append(bar);
    const cell = element("td");
    cell.append(name, gauge);
    row.append(cell, element("td", `${number(sizes[n])} N`));
    return row;
  });
  const table = element("table", undefined, "read");
  table.append(...rows);
  box.append(rows.length ? table : element("p", "No force acts on it.", "lead"));
  return box;
}

function observationOf(look) {
  const rows = look.observation.flatMap(slot => {
    const name = element("span", slot.name.replace(/_/g, " ")), many = Array.isArray(slot.value) && Array.isArray(slot.value[0]) ? slot.value : [[slot.value].flat()];
    if (slot.meaning) name.title = slot.meaning;
    return many.filter(each => each.length).map((each, n) => [n ? "" : name, each.map(plainNumber).join(", ") + unitOf(slot)]);
  });
  return tableOf("What it observes", rows);
}

// ---- measures

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
    box.replaceChildren(...names.map(name => {
      const first = message.lanes.find(l => l[name])[name], row = element("div", undefined, "measure"), top = element("div", undefined, "top"), value = element("b"), canvas = element("canvas");
      row.title = first.title || ""; row.dataset.name = name; canvas.height = 36; canvas.width = 320;
      top.append(element("span", name.replace(/_/g, " ")), value); row.append(top, canvas);
      return row;
    }), costBox(), timingBox());
  }
  for (const row of box.querySelectorAll(".measure")) {
    const { name } = row.dataset;
    row.querySelector("b").textContent = message.lanes.map(l => l[name] && l[name].value !== null ? plainNumber(l[name].value) : "–").join("  |  ") + unitOf(message.lanes[0][name]);
    drawSparks(row.querySelector("canvas"), message.lanes.map((_, n) => curves.get(`${n} ${name}`)).filter(Boolean));
  }
  showTiming();
}

function plainNumber(x) { return Number.isInteger(x) && Math.abs(x) < 1e6 ? String(x).replace("-", "−") : number(x); }

function unitOf(measure) { return measure && measure.unit && measure.unit !== "1" ? " " + measure.unit : ""; }

/* Curves of one measure, a colour for each world, on shared axes. */
function drawSparks(canvas, lines) {
  fit(canvas);
  const pen = canvas.getContext("2d"), all = lines.flatMap(l => l.values), times = lines.flatMap(l => l.times), w = canvas.width, h = canvas.height, pad = 3;
  const low = Math.min(...all), high = Math.max(...all), from = Math.min(...times), to = Math.max(...times);
  pen.clearRect(0, 0, w, h); pen.lineWidth = 1.6; pen.lineJoin = "round";
  pen.strokeStyle = paint.grid; pen.beginPath(); pen.moveTo(0, h - pad); pen.lineTo(w, h - pad); pen.stroke();
  lines.forEach((line, n) => {
    pen.strokeStyle = n ? forceColour(n - 1) : paint.accent; pen.beginPath();
    line.values.forEach((v, k) => pen.lineTo(pad + (w - 2 * pad) * (line.times[k] - from) / (to - from || 1), h - pad - (h - 2 * pad) * (v - low) / (high - low || 1)));
    pen.stroke();
  });
}

function costBox() {
  const box = element("div"), button = element("button", "measure what each effect costs"), out = element("div");
  out.id = "costs";
  button.onclick = () => { live.ask({ type: "costs" }); out.replaceChildren(element("p", "Measuring; the world waits a moment.", "lead")); };
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
  box.replaceChildren(heading("A picture"), plainTable([["pictures a second", live.rate.shown.toFixed(0)], ["drawing", `${drawn.ms.toFixed(1)} ms`], ["physics", t.step === undefined ? "–" : `${t.step.toFixed(2)} ms/step`], ["encoding", t.encode === undefined ? "–" : `${t.encode.toFixed(2)} ms`], ["answer from the server", t.round === undefined ? "–" : `${t.round.toFixed(1)} ms`]]));
}
