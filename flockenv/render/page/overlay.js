/* What is shown of one agent and of fields: forces, neighbours, field of view, predicted path; density and flow. */
const chosen = { lane: null, agent: null, look: null, askedAt: 0 };
const FORCE_ROLES = ["pursuer", "evader", "learner 2", "goal", "learner", "agent 2", "agent 4", "agent 3", "agent"];

function forceColour(n) { const name = FORCE_ROLES[n % FORCE_ROLES.length]; return name === "goal" ? paint.goal : roleColour[name]; }

/* An arrow on the canvas from a pixel, with a head. */
function arrow(pen, x, y, dx, dy, colour, width) {
  const size = Math.hypot(dx, dy), head = Math.min(size, 4.2 * width);
  if (size < 1) return;
  const ux = dx / size, uy = dy / size, bx = x + dx - head * ux, by = y + dy - head * uy;
  pen.strokeStyle = pen.fillStyle = colour; pen.lineWidth = width; pen.lineCap = "round";
  pen.beginPath(); pen.moveTo(x, y); pen.lineTo(bx, by); pen.stroke();
  pen.beginPath(); pen.moveTo(x + dx, y + dy); pen.lineTo(bx - 0.55 * head * uy, by + 0.55 * head * ux); pen.lineTo(bx + 0.55 * head * uy, by - 0.55 * head * ux); pen.closePath(); pen.fill();
}

function vectorOn(eye, [x, y, z = 0]) { return [eye.x(x, y, z) - eye.x(0, 0, 0), eye.y(x, y, z) - eye.y(0, 0, 0)]; }

function drawForces(pen, eye, look, x, y) {
  const sizes = look.forces.map(f => Math.hypot(...f.vector)), most = Math.max(...sizes, 1e-12), reach = Math.min(0.16 * Math.min(eye.w, eye.h), 120 * eye.ratio);
  look.forces.forEach((force, n) => {
    if (force.hidden) return;
    const total = force.kind === "total", scale = reach / most, colour = total ? paint.ink : forceColour(n), width = (total ? 3 : 2.4) * eye.ratio;
    const show = v => vectorOn(eye, v).map(c => c / eye.m * scale);
    const granted = force.kind === "behaviour" && isNumber(force.granted) ? force.granted : 1; // dashed: what was not granted
    if (granted < 0.995) { pen.setLineDash([4 * eye.ratio, 4 * eye.ratio]); pen.globalAlpha = 0.5; arrow(pen, x, y, ...show(force.vector), colour, 1.6 * eye.ratio); pen.setLineDash([]); pen.globalAlpha = 1; }
    arrow(pen, x, y, ...show(force.vector.map(c => granted * c)), colour, width);
  });
}

const LINKS = 30; // neighbours that lines are drawn to: the nearest

/* The region that an agent sees: a disc, or a sector around its heading. */
function drawSight(pen, eye, view, x, y, aim) {
  if (!isNumber(view.radius)) return;
  const r = view.radius * eye.m, half = (isNumber(view.fov) ? view.fov : 360) / 360 * Math.PI;
  pen.beginPath();
  if (half >= Math.PI - EPS || Number.isNaN(aim)) pen.arc(x, y, r, 0, 2 * Math.PI);
  else { pen.moveTo(x, y); pen.arc(x, y, r, -aim - half, -aim + half); pen.closePath(); }
  pen.fillStyle = paint.accent; pen.globalAlpha = 0.06; pen.fill();
  pen.strokeStyle = paint.accent; pen.globalAlpha = 0.35; pen.lineWidth = eye.ratio; pen.stroke(); pen.globalAlpha = 1;
}

function drawLinks(pen, eye, panel, all, look, p) {
  pen.strokeStyle = paint.accent; pen.globalAlpha = 0.3; pen.lineWidth = 1.2 * eye.ratio; pen.beginPath();
  const places = look.neighbours.filter(j => j < panel.N && all.there[j]).map(j => {
    const q = placeOf(all, j);
    if (panel.periodic) for (let d = 0; d < panel.D; d++) q[d] -= panel.extent[d] * Math.round((q[d] - p[d]) / panel.extent[d]);
    return q;
  });
  const far = q => Math.hypot(...q.map((x, d) => x - p[d]));
  for (const q of places.sort((a, b) => far(a) - far(b)).slice(0, LINKS)) segment(pen, eye, p, q);
  pen.stroke(); pen.globalAlpha = 1;
}

function drawPath(pen, eye, panel, path) {
  if (!path || path.length < 2) return;
  pen.strokeStyle = paint.ink; pen.globalAlpha = 0.55; pen.setLineDash([2 * eye.ratio, 5 * eye.ratio]); pen.lineWidth = 2 * eye.ratio; pen.lineCap = "round"; pen.beginPath();
  path.forEach((p, k) => {
    const jump = k && panel.periodic && p.some((x, d) => Math.abs(x - path[k - 1][d]) > data.jump * panel.extent[d]);
    if (k && !jump) pen.lineTo(eye.x(...p), eye.y(...p)); else pen.moveTo(eye.x(...p), eye.y(...p));
  });
  pen.stroke(); pen.setLineDash([]); pen.globalAlpha = 1;
}

/* Everything about the chosen agent, over the agents. */
function drawChosen(pen, eye, panel, all) {
  const i = chosen.agent, look = chosen.look;
  if (i === null || i >= panel.N || !all.there[i]) return;
  const p = placeOf(all, i), x = eye.x(...p), y = eye.y(...p), reach = Math.max(panel.radius[i] * eye.m, eye.least) * 1.5;
  if (look && look.agent === i) {
    if (look.view) drawSight(pen, eye, look.view, x, y, eye.angle(all.aim[i]));
    drawLinks(pen, eye, panel, all, look, p);
    drawPath(pen, eye, panel, look.path);
    drawForces(pen, eye, look, x, y);
  }
  disc(pen, x, y, reach); pen.strokeStyle = paint.ink; pen.lineWidth = 2 * eye.ratio; pen.stroke();
}

/* Marks the agents that a person steers. */
function drawYou(pen, eye, panel, all) {
  const players = panel.lane.players || [];
  players.forEach((player, i) => {
    if (player !== "you" || !all.there[i]) return;
    const p = placeOf(all, i), x = eye.x(...p), y = eye.y(...p), reach = Math.max(panel.radius[i] * eye.m, eye.least) * 1.7;
    disc(pen, x, y, reach); pen.strokeStyle = paint.goal; pen.lineWidth = 2.5 * eye.ratio; pen.stroke();
    pen.fillStyle = paint.goal; pen.font = `600 ${12 * eye.ratio}px system-ui, sans-serif`; pen.textAlign = "center"; pen.fillText("you", x, y - reach - 5 * eye.ratio);
  });
}

/* A quantity on a grid as soft shades of the accent colour, under the agents. */
function drawField(pen, eye, panel, field) {
  const [ny, nx] = field.shape, [x0, y0] = field.low, dx = (field.high[0] - x0) / nx, dy = (field.high[1] - y0) / ny, z = panel.D < 3 ? 0 : panel.low[2];
  const small = document.createElement("canvas"), brush = small.getContext("2d"), colour = word(paint.accent);
  small.width = nx; small.height = ny;
  const image = brush.createImageData(nx, ny), words = new Uint32Array(image.data.buffer);
  for (let j = 0; j < ny; j++) for (let i = 0; i < nx; i++) words[(ny - 1 - j) * nx + i] = (field.values[j * nx + i] << 24) | colour;
  brush.putImageData(image, 0, 0);
  pen.save();
  const top = y0 + ny * dy;
  pen.transform(eye.a[0] * dx, eye.b[0] * dx, -eye.a[1] * dy, -eye.b[1] * dy, eye.x(x0, top, z), eye.y(x0, top, z));
  pen.globalAlpha = 0.6; pen.imageSmoothingEnabled = true; pen.imageSmoothingQuality = "high";
  pen.drawImage(small, 0, 0);
  pen.restore();
}

/* A flow on a grid as an arrow for each cell in which there is some. */
function drawFlow(pen, eye, panel, field) {
  const [ny, nx] = field.shape, cells = nx * ny, [x0, y0] = field.low, dx = (field.high[0] - x0) / nx, dy = (field.high[1] - y0) / ny, z = panel.D < 3 ? 0 : panel.low[2];
  for (let k = 0; k < cells; k++) {
    const flow = [field.arrows[k] / 127, field.arrows[cells + k] / 127], size = Math.hypot(...flow);
    if (size < 0.05) continue;
    const [u, v] = vectorOn(eye, flow.map(c => c / size * dx * (0.3 + 0.65 * size))), i = k % nx, at = [x0 + (i + 0.5) * dx, y0 + ((k - i) / nx + 0.5) * dy, z];
    pen.globalAlpha = 0.3 + 0.6 * size;
    arrow(pen, eye.x(...at) - u / 2, eye.y(...at) - v / 2, u, v, paint.accent, 1.8 * eye.ratio);
  }
  pen.globalAlpha = 1;
}

/* What a live view draws under and over its agents, and its tools. */
function prepareView(view, n, camera) {
  const { panel } = view;
  view.n = n;
  view.canvas.setAttribute("aria-label", `${panel.player || "the world"}; press ? for its keys`);
  view.home = homeCamera(panel);
  Object.assign(view.camera, view.home, camera || {});
  view.before = () => {
    if (tool.held && tool.held.you && tool.toward && tool.toward.view === view) steerTo(view, tool.toward.pixel);
    else if (pressed.size && isYou(view)) steerByKeys();
    panel.tint = panel.colour ? ramp() : null;
    showScales(view);
    const { follow } = view.camera, frame = panel.frames[panel.frames.length - 1];
    if (follow !== null && frame && follow < panel.N) centreOn(view, frame.pos.subarray(follow * panel.D, follow * panel.D + panel.D));
  };
  view.under = (pen, eye) => { if (view.field) (view.field.arrows ? drawFlow : drawField)(pen, eye, panel, view.field); };
  view.over = (pen, eye, now, all) => {
    drawYou(pen, eye, panel, all);
    if (chosen.lane === n) drawChosen(pen, eye, panel, all);
    if (view.draft) drawDraft(pen, eye, view.draft);
    if (cursor.view === view) drawCursor(pen, eye);
  };
  view.tool = (kind, event, at) => useTool(view, kind, event, at);
}

/* In 3-D from the side and a little from above, with gravity downwards. */
function homeCamera(panel) {
  if (panel.D < 3) return {};
  const [x, y, z] = panel.lane.up || [0, 0, 1], level = Math.hypot(x, y);
  return level < 0.05 * Math.abs(z) ? { yaw: -0.55, tilt: 1.12 } : { yaw: Math.atan2(-x, y), tilt: Math.atan2(z, level) - 0.35 };
}

function centreOn(view, p) {
  const { camera, panel, canvas } = view, eye = lens(panel, canvas, camera);
  camera.x -= (eye.x(...p) - canvas.width / 2) / canvas.width / camera.zoom;
  camera.y -= (eye.y(...p) - canvas.height / 2) / canvas.height / camera.zoom;
}

/* The 256 colours of a quantity, from little to much. */
function ramp() {
  const stops = [roleColour.evader, roleColour.flockmate, paint.goal, roleColour.learner, roleColour.pursuer], key = stops.join();
  if (ramp.key === key) return ramp.colours;
  ramp.key = key;
  ramp.colours = [...Array(256).keys()].map(s => {
    const at = s / 255 * (stops.length - 1), k = Math.min(Math.floor(at), stops.length - 2);
    return mix(stops[k + 1], stops[k], at - k);
  });
  return ramp.colours;
}

/* The legend with the scales of what colours and the field show, which change with the world: made anew twice a second. */
function showScales({ panel, field }) {
  const shown = panel.colour || field, now = performance.now();
  if (panel.scaled !== Boolean(field)) { panel.scaled = Boolean(field); panel.legendOld = true; }
  if (!panel.legendOld && !(shown && now - (showScales.last || 0) > 500)) return;
  panel.legendOld = false; showScales.last = now;
  makeLegend(state.group);
  if (panel.colour) $("legend").append(scaleOf(panel.colour.name, panel.colour.low, panel.colour.high, panel.colour.unit, ramp()));
  if (field) $("legend").append(scaleOf(field.name, 0, field.most, field.unit, field.arrows ? null : [paint.paper, mix(paint.accent, paint.paper, 0.6)]));
}

/* A quantity with its range; colours: from little to much, or null for one that arrows show. */
function scaleOf(name, low, high, unit, colours) {
  const row = element("span", undefined, "ramp"), bar = element("canvas"), words = name.replace(/_/g, " ");
  if (!colours) { row.append(`${words}: the longest arrow is ${shortNumber(high)}${unitOf({ unit })}`); return row; }
  bar.width = 120; bar.height = 8;
  const pen = bar.getContext("2d"), fill = pen.createLinearGradient(0, 0, 120, 0);
  colours.forEach((c, k) => fill.addColorStop(k / (colours.length - 1), c));
  pen.fillStyle = fill; pen.fillRect(0, 0, 120, 8);
  row.append(`${words}: ${shortNumber(low)}`, bar, `${shortNumber(high)}${unitOf({ unit })}`);
  return row;
}
