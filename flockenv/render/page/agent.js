/* The tab "Agent": the forces on one agent, what it observes, and its reward; the server is asked only while it is chosen. */

function choose(lane, agent) {
  chosen.lane = lane; chosen.agent = agent; chosen.look = null;
  if (agent !== null) { openTab("agent"); askLook(); }
  showLook();
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
  if (!look) { if (!box.querySelector("h2")) box.replaceChildren(element("p", "Computing its forces …", "empty")); return; }
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
    row.classList.toggle("idle", sizes[n] < 1e-6 * most);
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
