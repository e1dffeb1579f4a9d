/* Metaballs: discs that melt into their neighbours, as in the pictures of render/metaballs.py. */
const surfaces = { w: 0, h: 0, sums: null, image: null, canvas: null };

/* True if an agent is part of a surface; with colours by a quantity, each is a disc of its own. */
function melts(panel, i) { return panel.look[i] >= 0 && !panel.tint && panel.looks[panel.look[i]].form === "metaball"; }

/* The sums of a surface on a grid of w by h: field, and red, green, blue and opacity times it. */
function emptySums(w, h) {
  if (surfaces.w !== w || surfaces.h !== h) {
    const canvas = document.createElement("canvas");
    canvas.width = w; canvas.height = h;
    Object.assign(surfaces, { w, h, sums: new Float32Array(5 * w * h), image: canvas.getContext("2d").createImageData(w, h), canvas });
  } else surfaces.sums.fill(0);
  return surfaces;
}

function addField({ sums, w, h }, x, y, reach, colour, opacity) {
  if (!(reach > 0)) return;
  const left = Math.max(0, Math.floor(x - reach)), right = Math.min(w - 1, Math.ceil(x + reach));
  const top = Math.max(0, Math.floor(y - reach)), bottom = Math.min(h - 1, Math.ceil(y + reach)), [r, g, b] = channels(colour);
  for (let row = top; row <= bottom; row++) {
    for (let column = left; column <= right; column++) {
      const rest = 1 - ((column - x) ** 2 + (row - y) ** 2) / reach ** 2;
      if (rest <= 0) continue;
      const field = rest * rest, at = 5 * (row * w + column);
      sums[at] += field; sums[at + 1] += field * r; sums[at + 2] += field * g; sums[at + 3] += field * b; sums[at + 4] += field * opacity;
    }
  }
}

/* Turns sums into pixels; the edge is a few hundredths of the level wide, so that it is smooth. */
function fillSurface({ sums, image, canvas }) {
  const level = (1 - 1 / data.metaball ** 2) ** 2, pixels = image.data;
  for (let n = 0; n < pixels.length / 4; n++) {
    const field = sums[5 * n], cover = clamp((field / level - 0.94) / 0.12, 0, 1);
    for (let c = 0; c < 3; c++) pixels[4 * n + c] = cover ? sums[5 * n + 1 + c] / field : 0;
    pixels[4 * n + 3] = cover ? 255 * cover * sums[5 * n + 4] / field : 0;
  }
  canvas.getContext("2d").putImageData(image, 0, 0);
}

function drawMetaballs(pen, eye, panel, all, k) {
  if (panel.tint || !panel.looks.some(look => look.form === "metaball")) return;
  const coarse = panel.N > 2000 ? 2 : 1, found = emptySums(Math.ceil(eye.w / coarse), Math.ceil(eye.h / coarse));
  for (let i = 0; i < panel.N; i++) {
    if (!all.there[i] || !melts(panel, i)) continue;
    const p = [all.pos[3 * i], all.pos[3 * i + 1], all.pos[3 * i + 2]], look = panel.looks[panel.look[i]], { at, colour } = lookColour(panel, look, i, k);
    const size = (look.size ? look.size[at] : panel.radius[i]) * eye.m * (panel.D < 3 ? 1 : 0.7 + 0.5 * eye.depth(...p)), reach = data.metaball * size;
    for (const [x, y] of eye.sightings(eye.x(...p), eye.y(...p), reach)) addField(found, x / coarse, y / coarse, reach / coarse, colour, look.opacity[at]);
  }
  fillSurface(found);
  pen.drawImage(found.canvas, 0, 0, coarse * found.w, coarse * found.h);
}
