/* Drawing of one world on a canvas: ground, scenery, trails, bonds and agents. */

function disc(pen, x, y, r) { pen.beginPath(); pen.arc(x, y, Math.max(r, 0), 0, 2 * Math.PI); }

function polygon(pen, shape, x, y, angle, size) {
  const c = Math.cos(angle) * size, s = Math.sin(angle) * size;
  pen.beginPath();
  for (const [a, b] of shape) pen.lineTo(x + a * c - b * s, y - a * s - b * c);
  pen.closePath();
}

function segment(pen, eye, p, q) { pen.moveTo(eye.x(...p), eye.y(...p)); pen.lineTo(eye.x(...q), eye.y(...q)); }

/* The ground of a world, as a path: its rectangle, turned with the world in 3-D. */
function ground(pen, eye, panel) {
  const [x0, y0] = panel.low, [x1, y1] = panel.high, z = panel.D < 3 ? 0 : panel.low[2];
  pen.beginPath();
  for (const [x, y] of [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) pen.lineTo(eye.x(x, y, z), eye.y(x, y, z));
  pen.closePath();
}

function drawGrid(pen, eye, panel) {
  const extent = Math.max(panel.extent[0], panel.extent[1]) / Math.max(1, eye.zoomed || 1), power = 10 ** Math.floor(Math.log10(extent / 5));
  const step = [1, 2, 5, 10].map(n => n * power).find(s => s * 10 >= extent * (1 - EPS)), z = panel.D < 3 ? 0 : panel.low[2];
  pen.strokeStyle = paint.grid; pen.lineWidth = eye.ratio; pen.beginPath();
  for (let n = Math.ceil(panel.low[0] / step); n * step <= panel.high[0]; n++) segment(pen, eye, [n * step, panel.low[1], z], [n * step, panel.high[1], z]);
  for (let n = Math.ceil(panel.low[1] / step); n * step <= panel.high[1]; n++) segment(pen, eye, [panel.low[0], n * step, z], [panel.high[0], n * step, z]);
  pen.stroke();
}

/* The edges of a turned box that are not those of its ground. */
function drawBox(pen, eye, panel) {
  if (eye.flat) return;
  const [x0, y0, z0] = panel.low, [x1, y1, z1] = panel.high, round = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
  pen.strokeStyle = paint.grid; pen.lineWidth = eye.ratio; pen.beginPath();
  round.forEach(([x, y], n) => {
    const [u, v] = round[(n + 1) % 4];
    segment(pen, eye, [x, y, z0], [x, y, z1]); segment(pen, eye, [x, y, z1], [u, v, z1]);
  });
  pen.stroke();
}

/* Round obstacles: centre and radius; in 3-D with height, if the panel knows it. */
function stonesOf(panel, scene) {
  if (panel.D < 3 || !panel.lane) return scene.stones;
  return panel.lane.obstacles.filter(o => o.radius).map(o => [o.at[0], o.at[1], o.radius, o.at[2]]);
}

/* A ball lit from the upper left. */
function ballColour(pen, x, y, r) {
  const shade = pen.createRadialGradient(x - 0.35 * r, y - 0.4 * r, 0.05 * r, x, y, r);
  shade.addColorStop(0, mix(paint.stone, paint.paper, 0.35)); shade.addColorStop(0.7, paint.stone); shade.addColorStop(1, paint.rim);
  return shade;
}

function drawStones(pen, eye, panel, scene) {
  pen.fillStyle = paint.stone; pen.strokeStyle = paint.rim; pen.lineWidth = 1.2 * eye.ratio;
  for (const [cx, cy, radius, cz] of stonesOf(panel, scene)) {
    const z = cz === undefined ? 0 : cz, r = radius * eye.m;
    for (const [x, y] of eye.sightings(eye.x(cx, cy, z), eye.y(cx, cy, z), r)) {
      if (cz !== undefined) pen.fillStyle = ballColour(pen, x, y, r);
      disc(pen, x, y, r); pen.fill(); pen.stroke();
    }
  }
  pen.fillStyle = paint.stone;
  const z = panel.D < 3 ? 0 : panel.low[2];
  for (const wall of scene.walls) {
    const xs = wall.map(p => eye.x(p[0], p[1], z)), ys = wall.map(p => eye.y(p[0], p[1], z));
    const x = (Math.min(...xs) + Math.max(...xs)) / 2, y = (Math.min(...ys) + Math.max(...ys)) / 2;
    const reach = Math.max(Math.max(...xs) - x, Math.max(...ys) - y);
    for (const [a, b] of eye.sightings(x, y, reach)) {
      pen.beginPath(); xs.forEach((c, k) => pen.lineTo(c - x + a, ys[k] - y + b)); pen.closePath(); pen.fill(); pen.stroke();
    }
  }
}

function drawMark(pen, eye, panel, mark) {
  const z = panel.D < 3 ? 0 : (panel.low[2] + panel.high[2]) / 2;
  const x = eye.x(mark.at[0], mark.at[1], z), y = eye.y(mark.at[0], mark.at[1], z);
  pen.fillStyle = pen.strokeStyle = paint.goal;
  if (mark.kind === "heading") {
    const length = 0.16 * Math.min(eye.right - eye.left, eye.bottom - eye.top) * Math.hypot(...mark.vector);
    polygon(pen, data.arrow, x, y, eye.angle(Math.atan2(mark.vector[1], mark.vector[0])), length);
    pen.globalAlpha = 0.45; pen.fill(); pen.globalAlpha = 1;
    return;
  }
  if (mark.kind === "way") {
    for (const [a, b] of eye.sightings(x, y, mark.radius * eye.m)) {
      disc(pen, a, b, mark.radius * eye.m); pen.fillStyle = mix(paint.goal, paint.paper, data.way); pen.fill();
    }
    return;
  }
  const reach = Math.max(mark.radius * eye.m, 7 * eye.ratio);
  for (const [a, b] of eye.sightings(x, y, reach)) {
    disc(pen, a, b, reach); pen.globalAlpha = 0.14; pen.fill(); pen.globalAlpha = 1;
    pen.lineWidth = 2 * eye.ratio; pen.stroke();
    disc(pen, a, b, 2.5 * eye.ratio); pen.fill();
  }
}

function drawScenery(pen, eye, panel, k) {
  const scene = sceneryAt(panel, k);
  pen.save(); ground(pen, eye, panel);
  if (eye.flat) pen.clip();
  drawStones(pen, eye, panel, scene);
  pen.restore();
  for (const mark of scene.marks) drawMark(pen, eye, panel, mark);
}

/* One piece of the path of agent i behind it, from frame k, as a part of the current path; none over a jump. */
function traceStride(pen, eye, panel, k, i, share) {
  const { D } = panel, pos = panel.frames[k].pos, next = panel.frames[k + 1].pos, p = [pos[i * D], pos[i * D + 1], D < 3 ? 0 : pos[i * D + 2]], q = [...p];
  for (let d = 0; d < D; d++) {
    const path = stride(panel, k, i, d);
    if (path === 0 && Math.abs(next[i * D + d] - pos[i * D + d]) > 0.01 * panel.extent[d]) return;
    q[d] += share * path;
  }
  segment(pen, eye, p, q);
}

function isAbsent(panel, k, i) { return panel.frames[k].heading[i] === ABSENT || panel.frames[k + 1].heading[i] === ABSENT; }

/* Paths behind agents that are drawn by their role, fainter with age; short ones for a crowd. */
function drawTrails(pen, eye, panel, now) {
  const first = frameAt(panel.time, panel.time[now.k] - (panel.N > 8 ? 3 : 12)), count = now.k - first + 1;
  pen.lineCap = "butt";
  for (let k = first; k <= now.k; k++) {
    const share = k === now.k ? now.f : 1, age = (k - first + 1) / count;
    if (k + 1 >= panel.time.length || !share) continue;
    panel.kinds.forEach((role, kind) => {
      pen.beginPath();
      for (let i = 0; i < panel.N; i++)
        if (panel.kind[i] === kind && panel.look[i] < 0 && !panel.tied[i] && !isAbsent(panel, k, i)) traceStride(pen, eye, panel, k, i, share);
      pen.globalAlpha = (state.dark ? 0.12 : 0.06) + (state.dark ? 0.58 : 0.44) * age; pen.strokeStyle = roleColour[role];
      pen.lineWidth = (0.7 + 1.4 * age) * eye.ratio; pen.stroke();
    });
  }
  pen.globalAlpha = 1;
}

/* The colour of an agent with a look, in frame k. */
function lookColour(panel, look, i, k) {
  const shade = panel.frames[k].shade, at = Math.round((shade ? shade[i] : 0) / 255 * (look.opacity.length - 1));
  return { at, colour: look.colours ? look.colours[at] : roleColour[panel.roles[i]] };
}

/* The path behind agents whose look has a trail, in the colours that they had there, fainter with age. */
function drawLookTrails(pen, eye, panel, now, time) {
  panel.looks.forEach((look, which) => {
    if (!look.trail) return;
    pen.lineWidth = Math.max(1, eye.w / 400); pen.lineCap = "butt";
    for (let k = frameAt(panel.time, time - look.trail); k <= now.k; k++) {
      const share = k === now.k ? now.f : 1;
      if (k + 1 >= panel.time.length || !share) continue;
      const left = 1 - Math.max(0, time - panel.time[k + 1]) / look.trail;
      if (left <= 0) continue;
      for (let i = 0; i < panel.N; i++) {
        if (panel.look[i] !== which || isAbsent(panel, k, i)) continue;
        const { at, colour } = lookColour(panel, look, i, k);
        pen.globalAlpha = 0.6 * left * look.opacity[at]; pen.strokeStyle = colour;
        pen.beginPath(); traceStride(pen, eye, panel, k, i, share); pen.stroke();
      }
    }
  });
  pen.globalAlpha = 1;
}

/* The bonds that are broken in frame k, as a set of their indices; of a live panel those of its last frame. */
function brokenBonds(panel, k) {
  return new Set(panel.gone ? panel.gone.flatMap((from, n) => from >= 0 && from <= k ? [n] : []) : panel.broken || []);
}

/* A line for every bond with both ends there, the lowest first; across an edge of a periodic world from either side. None of hidden agents. */
function drawBonds(pen, eye, panel, all, broken, hidden) {
  const layers = panel.D < 3 ? 1 : 12, paths = new Map();
  for (const [n, [a, b]] of panel.bonds.entries()) {
    if (!all.there[a] || !all.there[b] || broken.has(n) || hidden && hidden[a]) continue;
    const p = Array.from(all.pos.subarray(3 * a, 3 * a + 3)), q = Array.from(all.pos.subarray(3 * b, 3 * b + 3)), r = [...q];
    if (panel.periodic) for (let d = 0; d < panel.D; d++) r[d] -= panel.extent[d] * Math.round((q[d] - p[d]) / panel.extent[d]);
    const layer = Math.min(layers - 1, Math.floor(layers * eye.depth(...p.map((x, d) => (x + r[d]) / 2)))), key = layer * 256 + panel.kind[a];
    if (!paths.has(key)) paths.set(key, []);
    paths.get(key).push([p, r]);
    if (panel.periodic && Math.hypot(...q.map((x, d) => x - r[d])) > EPS) paths.get(key).push([q, p.map((x, d) => x + q[d] - r[d])]);
  }
  pen.lineWidth = Math.max(data.bond * eye.w, eye.ratio); pen.lineCap = "round";
  for (const key of [...paths.keys()].sort((a, b) => a - b)) {
    pen.globalAlpha = 0.6 * (0.45 + 0.55 * (layers === 1 ? 1 : (Math.floor(key / 256) + 0.5) / layers)); pen.strokeStyle = roleColour[panel.kinds[key % 256]];
    pen.beginPath();
    for (const [p, q] of paths.get(key)) segment(pen, eye, p, q);
    pen.stroke();
  }
  pen.globalAlpha = 1;
}

/* A soft disc in a colour, opaque in its middle: (1 - d^2)^2 at a share d of its radius, as in render/picture.py. */
const softDiscs = new Map();
function softDisc(colour) {
  if (softDiscs.has(colour)) return softDiscs.get(colour);
  const r = 32, canvas = document.createElement("canvas"), brush = canvas.getContext("2d"), [red, green, blue] = channels(colour);
  canvas.width = canvas.height = 2 * r;
  const shade = brush.createRadialGradient(r, r, 0, r, r, r);
  for (let d = 0; d <= 1; d += 1 / 16) shade.addColorStop(d, `rgba(${red}, ${green}, ${blue}, ${(1 - d * d) ** 2})`);
  brush.fillStyle = shade; brush.fillRect(0, 0, 2 * r, 2 * r);
  softDiscs.set(colour, canvas);
  return canvas;
}

function drawBillboard(pen, x, y, reach, colour, opacity) {
  pen.globalAlpha = opacity; pen.drawImage(softDisc(colour), x - reach, y - reach, 2 * reach, 2 * reach); pen.globalAlpha = 1;
}

function drawLook(pen, eye, panel, body, k, swell) {
  if (melts(panel, body.i)) return;
  const look = panel.looks[panel.look[body.i]], { at, colour } = lookColour(panel, look, body.i, k);
  const reach = (look.size ? look.size[at] : panel.radius[body.i]) * eye.m * swell;
  for (const [x, y] of eye.sightings(body.x, body.y, 1.1 * reach)) {
    if (look.form === "billboard") { drawBillboard(pen, x, y, reach, colour, look.opacity[at]); continue; }
    if (look.form === "polygon") polygon(pen, look.vertices, x, y, Number.isNaN(body.aim) ? 0 : body.aim, reach);
    else disc(pen, x, y, look.form === "point" ? Math.max(reach, data.point * eye.w) : reach);
    pen.fillStyle = colour; pen.globalAlpha = look.opacity[at]; pen.fill(); pen.globalAlpha = 1;
  }
}

/* A translucent body with its outline, and the dart (a dot without a direction) that shows where it heads. */
function stamp(pen, x, y, size, reach, aim) {
  if (size >= data.disc * reach) {
    disc(pen, x, y, size); pen.globalAlpha = 0.25; pen.fill();
    pen.globalAlpha = 0.6; pen.lineWidth = Math.max(1, reach / 12); pen.stroke(); pen.globalAlpha = 1;
  }
  if (Number.isNaN(aim)) disc(pen, x, y, 0.5 * reach); else polygon(pen, data.dart, x, y, aim, 0.94 * reach);
  pen.fill();
}

function drawCross(pen, x, y, reach) {
  const arm = 0.75 * reach;
  pen.lineWidth = 0.28 * reach; pen.lineCap = "round"; pen.globalAlpha = 0.85; pen.beginPath();
  pen.moveTo(x - arm, y - arm); pen.lineTo(x + arm, y + arm); pen.moveTo(x - arm, y + arm); pen.lineTo(x + arm, y - arm);
  pen.stroke(); pen.globalAlpha = 1;
}

/* One agent; body: i, x, y (pixels), depth, aim (on the canvas), there. */
function drawBody(pen, eye, panel, body, k) {
  const colour = bodyColour(panel, body.i, k), swell = panel.D < 3 ? 1 : 0.7 + 0.5 * body.depth;
  if (body.there && panel.look[body.i] >= 0 && !panel.tint) { drawLook(pen, eye, panel, body, k, swell); return; }
  const size = panel.radius[body.i] * eye.m * swell, reach = Math.max(size, eye.least * swell);
  const solid = panel.D < 3 ? colour : mix(colour, paint.paper, 0.45 + 0.55 * body.depth);
  for (const [x, y] of eye.sightings(body.x, body.y, 1.1 * reach)) {
    pen.fillStyle = pen.strokeStyle = solid;
    if (!body.there) { drawCross(pen, x, y, reach); continue; }
    if (panel.tied[body.i]) { disc(pen, x, y, Math.max(size, data.bond * eye.w)); pen.fill(); continue; }
    stamp(pen, x, y, size, reach, body.aim);
    if (size < data.disc * reach) { pen.fillStyle = mix(colour, paint.ink, 0.55); disc(pen, x, y, size); pen.fill(); }
  }
}

/* The colour of an agent: that of its role, or by a quantity that the reader has chosen (`tint`: 256 colours). */
function bodyColour(panel, i, k) {
  const shade = panel.tint && panel.frames[k].shade;
  return shade ? panel.tint[shade[i]] : roleColour[panel.roles[i]];
}

function drawBodies(pen, eye, panel, all, k, hidden) {
  const shown = [];
  for (let i = 0; i < panel.N; i++) {
    if (hidden && hidden[i]) continue;
    if (!all.there[i] && !NAMED.has(panel.roles[i])) continue;
    const p = [all.pos[3 * i], all.pos[3 * i + 1], all.pos[3 * i + 2]];
    shown.push({ i, x: eye.x(...p), y: eye.y(...p), depth: eye.depth(...p), aim: eye.angle(all.aim[i]), there: all.there[i] });
  }
  shown.sort((a, b) => b.there - a.there || a.depth - b.depth);
  for (const body of shown) drawBody(pen, eye, panel, body, k);
}

function drawWorld(view, now) {
  const { panel, canvas, camera } = view, pen = canvas.getContext("2d"), eye = view.eye = lens(panel, canvas, camera);
  pen.clearRect(0, 0, eye.w, eye.h);
  pen.save();
  if (panel.periodic && eye.flat) { ground(pen, eye, panel); pen.clip(); }
  drawGrid(pen, eye, panel); drawBox(pen, eye, panel);
  if (view.under) view.under(pen, eye, now);
  if ($("trails").checked) {
    if (panel.N <= CROWD) drawTrails(pen, eye, panel, now);
    drawLookTrails(pen, eye, panel, now, panel.time[now.k] + now.f * ((panel.time[now.k + 1] || panel.time[now.k]) - panel.time[now.k]));
  }
  drawScenery(pen, eye, panel, now.k);
  if (!eye.flat) drawBorder(pen, eye, panel);
  const all = bodies(panel, now), broken = brokenBonds(panel, now.k), hidden = coveredAgents(panel);
  drawBonds(pen, eye, panel, all, broken, hidden);
  if (hidden) drawFaces(pen, eye, panel, all, broken, now.k);
  drawMetaballs(pen, eye, panel, all, now.k);
  if (panel.N > CROWD) drawCrowd(pen, eye, panel, all, now.k, hidden); else drawBodies(pen, eye, panel, all, now.k, hidden);
  if (view.over) view.over(pen, eye, now, all);
  pen.restore();
  if (eye.flat) drawBorder(pen, eye, panel);
}

/* The edge of the ground, dashed if the world goes on across it. */
function drawBorder(pen, eye, panel) {
  pen.strokeStyle = paint.edge; pen.lineWidth = 1.2 * eye.ratio;
  pen.setLineDash(panel.periodic ? [7 * eye.ratio, 6 * eye.ratio] : []);
  ground(pen, eye, panel); pen.stroke();
  pen.setLineDash([]);
}
