/* Surfaces: the triangles of cloths and bodies, the farthest first, lit from above the reader's left shoulder. */
const LIGHT = [-0.35, 0.46, 0.81]; // to the right, upwards, towards the reader; of length 1

function hasFaces(panel) { return Boolean(panel.faces && panel.faces.length); }

/* For each agent 1 if its network has faces, as its surface is drawn instead; null if no network has. */
function coveredAgents(panel) { return hasFaces(panel) ? panel.covered : null; }

/* The normal of a triangle of points in m, of length 1. */
function normalOf(p, q, r) {
  const u = q.map((x, d) => x - p[d]), v = r.map((x, d) => x - p[d]);
  const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]], size = Math.hypot(...n) || 1;
  return n.map(x => x / size);
}

function dotOf(a, b) { return a.reduce((sum, x, d) => sum + x * b[d], 0); }

/* The faces with no broken edge: of the bonds in a set of indices. */
function wholeFaces(panel, broken) {
  if (!broken.size) return panel.faces;
  const key = (a, b) => Math.min(a, b) * panel.N + Math.max(a, b), torn = new Set([...broken].map(n => key(...panel.bonds[n])));
  return panel.faces.filter(([a, b, c]) => !torn.has(key(a, b)) && !torn.has(key(b, c)) && !torn.has(key(a, c)));
}

/* Triangles with their corners, m, depth, light from 0 to 1, and whether the reader sees their back. */
function facesInOrder(panel, eye, all, broken) {
  return wholeFaces(panel, broken).filter(face => face.every(i => all.there[i])).map(face => {
    const corners = face.map(i => placeOf(all, i)), middle = [0, 1, 2].map(d => (corners[0][d] + corners[1][d] + corners[2][d]) / 3);
    const normal = normalOf(...corners), seen = eye.rows.map(row => dotOf(row, normal)), back = panel.D === 3 && seen[2] < 0;
    const lit = panel.D < 3 ? 0.6 : clamp(dotOf(seen, LIGHT) * (back ? -1 : 1), 0, 1);
    return { corners, face, depth: eye.depth(...middle), lit, back };
  }).sort((p, q) => p.depth - q.depth);
}

/* The colour of a face in frame k: by the quantity that the reader has chosen, or its first corner's look or role. */
function faceColour(panel, face, back, k) {
  const shade = panel.frames[k].shade, mean = shade ? Math.round(face.reduce((sum, i) => sum + shade[i], 0) / 3) : 0;
  if (panel.tint && shade) return panel.tint[mean];
  const look = panel.looks[panel.look[face[0]]], own = roleColour[panel.roles[face[0]]];
  if (look && look.colours) return look.colours[Math.round(mean / 255 * (look.colours.length - 1))];
  return back ? roleColour.learner : own === roleColour.agent ? paint.accent : own;
}

/* Front and back in two colours without a look, paler with distance. */
function drawFaces(pen, eye, panel, all, broken, k) {
  const dark = state.dark ? "#0b0f14" : paint.ink;
  pen.lineWidth = 0.7 * eye.ratio; pen.lineJoin = "round";
  for (const { corners, face, depth, lit, back } of facesInOrder(panel, eye, all, broken)) {
    const colour = faceColour(panel, face, back, k);
    const shaded = lit < 0.55 ? mix(colour, dark, 0.45 + lit) : mix("#ffffff", colour, 0.7 * (lit - 0.55));
    pen.fillStyle = pen.strokeStyle = mix(shaded, paint.paper, 0.8 + 0.2 * depth);
    pen.beginPath();
    for (const p of corners) pen.lineTo(eye.x(...p), eye.y(...p));
    pen.closePath(); pen.fill(); pen.stroke();
  }
}
