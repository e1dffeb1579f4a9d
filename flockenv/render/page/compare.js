/* Side by side in worlds of one seed: players of a task (the tab "Players"), or methods and steps of a scene (the tab "Compare"). */

function showCompare(room) {
  const box = $("compare");
  if (room.kind === "task") { box.replaceChildren(); return; }
  box.replaceChildren(...compareMethods(room));
}

/* A button that sends a message. */
function sender(text, make) {
  const button = element("button", text);
  button.onclick = () => live.send(make());
  return button;
}

const STEER = "You steer: W A S D or the arrow keys, hold the pointer where to go, or a gamepad.";

function comparePlayers(room) {
  const now = room.lanes.map(lane => lane.player || (lane.players || [])[0]), wanted = [...now];
  const rows = wanted.map((player, n) => {
    const row = element("div", undefined, "row"), drop = element("button", "×", "remove");
    drop.setAttribute("aria-label", `remove world ${n + 1}`); drop.disabled = wanted.length === 1;
    drop.onclick = () => live.send({ type: "lanes", players: wanted.filter((_, k) => k !== n) });
    row.append(wanted.length > 1 ? `World ${n + 1} is steered by` : "Steered by", playerSelect(room.players, player, choice => { live.edit({ kind: "player", learners: "all", player: choice }, n); if (choice === "you") tell(STEER); }), ...(wanted.length > 1 ? [drop] : []));
    return row;
  });
  const others = room.players.filter(p => !now.includes(p) && p !== "you"), more = element("div", undefined, "row");
  if (wanted.length < 4) more.append("Add a world steered by", ...(others.length ? others : room.players).slice(0, 6).map(p => sender(p, () => ({ type: "lanes", players: [...wanted, p] }))));
  const all = room.players.includes("rules") && room.players.includes("ppo") ? [sender("rules | ppo | you", () => ({ type: "lanes", players: ["rules", "ppo", "you"] }))] : [];
  const about = wanted.length > 1 ? [element("p", "All worlds begin with the same seed. Their returns are drawn under them.", "lead")] : [];
  return [heading("Players"), ...about, ...rows, more, ...(wanted.length === 1 ? all : [])];
}

/* Sliders for noise, delay and missed neighbours between the world and its players. */
function disturbances(room) {
  const now = { noise: 0, delay: 0, dropped: 0, ...(room.disturbance || {}) };
  const slider = (name, title, high, step, unit) => {
    const row = element("div", undefined, "control"), input = element("input"), out = element("span", `${now[name]} ${unit}`, "field");
    input.type = "range"; input.min = 0; input.max = high; input.step = step; input.value = now[name]; input.setAttribute("aria-label", title);
    input.oninput = () => { now[name] = input.valueAsNumber; out.textContent = `${now[name]} ${unit}`; };
    input.onchange = () => live.edit({ kind: "disturb", ...now });
    row.append(element("label", title), out, input);
    return row;
  };
  return [heading("Disturbances"), slider("noise", "sensor noise", 1, 0.01, ""), slider("delay", "delay of actions", 20, 1, "decisions"), slider("dropped", "share of neighbours missed", 1, 0.01, "")];
}

function compareMethods(room) {
  const method = controlAt("integrator"), dt = controlAt("dt"), same = { method: null, dt: null };
  const parts = [heading("Another method or time step"), element("p", "A second world begins with the same seed, side by side. Measures shows the distance between the two over time.", "lead")];
  if (dt) {
    const row = element("div", undefined, "row");
    row.append("Compare with a time step of", ...[2, 0.5, 0.1].map(f => sender(`${shortNumber(dt.value * f)} s`, () => ({ type: "lanes", variants: [same, { method: null, dt: dt.value * f }] }))));
    parts.push(row);
  }
  if (method && method.choices) {
    const row = element("div", undefined, "row");
    row.append("or with the method", playerSelect(["…", ...method.choices], "…", choice => { if (choice !== "…") live.send({ type: "lanes", variants: [same, { method: choice, dt: null }] }); }));
    parts.push(row);
  }
  if (room.lanes.length > 1) parts.push(sender("back to one world", () => ({ type: "lanes", variants: [same] })));
  return parts;
}
