/* Tools of the stage: choose and drag, add, draw obstacles, erase, lead with the pointer. */
const TOOLS = {
  choose: ["v", "select: click an agent to see its forces; drag an agent or an obstacle to move it", "M4 2l8.5 5-4 1 2.5 4.5-1.6.9-2.5-4.6L4 12z"],
  add: ["a", "add agents: click; with Shift ten at a time", "M8 3v10M3 8h10"],
  obstacle: ["o", "draw an obstacle: drag from its centre; with Shift a block", "M8 2.5a5.5 5.5 0 1 0 0 11a5.5 5.5 0 0 0 0-11z"],
  erase: ["x", "erase: click an agent or an obstacle", "M4 4l8 8M12 4l-8 8"],
  goal: ["f", "agents seek the pointer", "M8 1.5v3M8 11.5v3M1.5 8h3M11.5 8h3M8 5.5a2.5 2.5 0 1 0 0 5a2.5 2.5 0 0 0 0-5z"],
  flee: ["e", "agents flee from the pointer", "M2 8h4M10 8h4M8 2v4M8 10v4M4 6L2 8l2 2M12 6l2 2-2 2M6 4l2-2 2 2M6 12l2 2 2-2"],
};
const tool = { name: "choose", held: null, sentAt: 0 };

function makeTools() {
  for (const [name, [key, title, path]] of Object.entries(TOOLS)) {
    const button = element("button");
    button.title = `${title} (${key})`; button.setAttribute("aria-label", title); button.dataset.tool = name;
    button.append(icon(path));
    button.onclick = () => takeTool(name);
    $("tools").append(button);
  }
  takeTool("choose");
}

function takeTool(name) {
  if (tool.name === "goal" || tool.name === "flee") live.edit({ kind: "pointer", acts: tool.name, at: null });
  tool.name = name; tool.held = null;
  if (name !== "choose") { clearTimeout(showHint.timer); $("hint").textContent = TOOLS[name][1]; } else if (live.room) showHint(0);
  for (const button of $("tools").children) button.setAttribute("aria-pressed", button.dataset.tool === name);
  for (const view of views) view.canvas.style.cursor = name === "choose" ? "default" : "crosshair";
}

/* Shows the tools that a world has: the agents of a task are its own. */
function showTools(room) {
  const has = name => room.kind === "scene" || name === "choose" || room.lanes[0].obstacles.length > 0 && (name === "obstacle" || name === "erase");
  for (const button of $("tools").children) button.hidden = !has(button.dataset.tool);
  $("tools").hidden = [...$("tools").children].filter(button => !button.hidden).length < 2;
}

/* The agent under a pixel, the nearest within reach; null if there is none. */
function agentAt(view, [px, py], more = 1) {
  const { panel, eye } = view, all = panel.bodies;
  if (!eye || !all) return null;
  let best = null, least = Infinity;
  for (let i = 0; i < panel.N; i++) {
    if (!all.there[i]) continue;
    const p = placeOf(all, i), far = Math.hypot(eye.x(...p) - px, eye.y(...p) - py);
    if (far < Math.max(panel.radius[i] * eye.m, eye.least, 10 * eye.ratio) * more && far < least) { best = i; least = far; }
  }
  return best;
}

function isInside([x, y], outline) {
  let inside = false;
  outline.forEach(([x1, y1], k) => {
    const [x2, y2] = outline[(k + 1) % outline.length];
    if (y1 > y !== y2 > y && x < (x2 - x1) * (y - y1) / (y2 - y1) + x1) inside = !inside;
  });
  return inside;
}

/* The obstacle under a pixel; null if there is none. obstacles: {index, at and radius, or outline}. */
function obstacleAt(view, pixel) {
  const { eye } = view, at = eye.under(...pixel), isUnder = o => Math.hypot(eye.x(...o.at) - pixel[0], eye.y(...o.at) - pixel[1]) <= o.radius * eye.m;
  const found = (view.panel.lane.obstacles || []).filter(o => o.outline ? isInside(at, o.outline) : isUnder(o));
  return found.length ? found[found.length - 1] : null;
}

function often(ms) { const now = performance.now(); if (now - tool.sentAt < ms) return false; tool.sentAt = now; return true; }

/* Handles the pointer on a canvas; returns true if the press belongs to the tool and not to the camera. */
function useTool(view, kind, event, pixel) {
  if (!view.eye) return false;
  const lane = views.length > 1 ? view.n : null;
  if (kind === "cancel") { dropHeld(view); return true; }
  if (kind === "down" && isYou(view) && tool.name === "choose" && agentAt(view, pixel) === null && view.panel.D < 3) { tool.held = { you: true }; steerTo(view, pixel); return true; }
  if (tool.held && tool.held.you) { if (kind === "move") steerTo(view, pixel); if (kind === "up") { tool.held = null; steer([0, 0]); } return true; }
  return { choose: useChoose, add: useAdd, obstacle: useObstacle, erase: useErase, goal: usePointer, flee: usePointer }[tool.name](view, kind, event, pixel, lane);
}

/* Ends what a press began, without its effect. */
function dropHeld(view) {
  if (tool.held && tool.held.you) steer([0, 0]);
  tool.held = view.draft = null;
  refresh();
}

function useChoose(view, kind, event, pixel) {
  if (kind === "hover") { view.canvas.style.cursor = agentAt(view, pixel) !== null || obstacleAt(view, pixel) ? "pointer" : "default"; return false; }
  if (kind === "down") {
    const agent = agentAt(view, pixel), obstacle = agent === null ? obstacleAt(view, pixel) : null;
    if (agent === null && !obstacle) { if (view.panel.D < 3 && view.camera.zoom <= 1) choose(null, null); return false; }
    tool.held = { agent, obstacle, from: pixel, moved: false };
    return true;
  }
  const held = tool.held;
  if (!held) return false;
  if (Math.hypot(pixel[0] - held.from[0], pixel[1] - held.from[1]) > 5) held.moved = true;
  if (held.moved && (kind === "up" || kind === "move" && often(33))) {
    const at = view.eye.under(...pixel, held.agent === null ? held.obstacle.at : placeOf(view.panel.bodies, held.agent)), lane = views.length > 1 ? view.n : null;
    if (held.agent !== null) live.edit({ kind: "move_agent", agent: held.agent, pos: at }, lane);
    else if (kind === "up") live.edit({ kind: "move_obstacle", index: held.obstacle.index, centre: at }, lane);
    live.lastFrame = 0;
  }
  if (held.obstacle && held.moved) view.draft = kind === "up" ? null : { at: view.eye.under(...pixel), radius: held.obstacle.radius || 0.5 };
  if (kind === "up") { if (!held.moved && held.agent !== null) choose(view.n, held.agent); tool.held = null; }
  return true;
}

function useAdd(view, kind, event, pixel, lane) {
  if (kind === "down") live.edit({ kind: "add_agents", group: 0, count: event.shiftKey ? 10 : 1, at: view.eye.under(...pixel) }, lane);
  return kind !== "hover" && kind !== "leave";
}

function useObstacle(view, kind, event, pixel, lane) {
  if (kind === "hover" || kind === "leave") return false;
  const at = view.eye.under(...pixel);
  if (kind === "down") { view.draft = { at, radius: 0, block: event.shiftKey }; return true; }
  if (!view.draft) return true;
  const from = view.draft.at, reach = at.map((x, d) => x - from[d]);
  view.draft.radius = Math.hypot(...reach); view.draft.half = reach.map(Math.abs);
  if (kind === "up") {
    const { radius, block, half } = view.draft, least = 3 / view.eye.m;
    view.draft = null;
    if (radius < least) return true;
    const shape = block ? { kind: "block", centre: from, size: from.map((x, d) => 2 * Math.max(d < 2 ? half[d] : radius, least)) } : { kind: "circle", centre: from, radius };
    live.edit({ kind: "add_obstacle", shape }, lane);
  }
  return true;
}

function drawDraft(pen, eye, draft) {
  const x = eye.x(...draft.at), y = eye.y(...draft.at);
  pen.fillStyle = paint.stone; pen.strokeStyle = paint.rim; pen.lineWidth = 1.5 * eye.ratio; pen.globalAlpha = 0.7;
  if (draft.block) { const [a, b] = (draft.half || [0, 0]).map(h => h * eye.m); pen.beginPath(); pen.rect(x - a, y - b, 2 * a, 2 * b); } else disc(pen, x, y, draft.radius * eye.m);
  pen.fill(); pen.stroke(); pen.globalAlpha = 1;
}

function useErase(view, kind, event, pixel, lane) {
  if (kind === "down") {
    const agent = agentAt(view, pixel), obstacle = obstacleAt(view, pixel);
    if (agent !== null) live.edit({ kind: "remove_agents", agents: [agent] }, lane);
    else if (obstacle) live.edit({ kind: "remove_obstacle", index: obstacle.index }, lane);
    else tell("Nothing here to erase.");
  }
  return kind !== "hover" && kind !== "leave";
}

function usePointer(view, kind, event, pixel, lane) {
  if (kind === "leave") live.edit({ kind: "pointer", acts: tool.name, at: null }, lane);
  else if (often(40)) live.edit({ kind: "pointer", acts: tool.name, at: view.eye.under(...pixel) }, lane);
  return kind !== "hover" && kind !== "leave";
}
