/* Surfaces: the triangles of cloths and bodies, the farthest first, lit from above the reader's left shoulder. */
const LIGHT = [-0.35, 0.45, 0.82];

/* The normal of a triangle of points in m, of length 1. */
function normalOf(p, q, r) {
  const u = q.map((x, d) => x - p[d]), v = r.map((x, d) => x - p[d]);
  const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]], size = Math.hypot(...n) || 1;
  return n.map(x => x / size);
}

function drawFaces(pen, eye, panel, all) {
  const at = i => [all.pos[3 * i], all.pos[3 * i + 1], all.pos[3 * i + 2]];
  const drawn = panel.faces.filter(face => face.every(i => all.there[i])).map(face => {
    const corners = face.map(at), middle = [0, 1, 2].map(d => (corners[0][d] + corners[1][d] + corners[2][d]) / 3);
    const light = panel.D < 3 ? 0.6 : Math.abs(normalOf(...corners).reduce((sum, x, d) => sum + x * LIGHT[d], 0));
    return { corners, kind: panel.kind[face[0]], depth: eye.depth(...middle), light };
  }).sort((p, q) => p.depth - q.depth);
  pen.lineWidth = 0.7 * eye.ratio; pen.lineJoin = "round";
  for (const { corners, kind, depth, light } of drawn) {
    const colour = roleColour[panel.kinds[kind]], lit = light < 0.5 ? mix(colour, state.dark ? paint.paper : paint.ink, 0.5 + light) : mix(state.dark ? paint.ink : paint.paper, colour, 0.9 * (light - 0.5));
    pen.fillStyle = pen.strokeStyle = lit; pen.globalAlpha = 0.75 + 0.25 * depth;
    pen.beginPath();
    for (const p of corners) pen.lineTo(eye.x(...p), eye.y(...p));
    pen.closePath(); pen.fill(); pen.stroke();
  }
  pen.globalAlpha = 1;
}
