/* Crowds: stamps of agents, drawn once per direction, are copied into pixels, which is some ten times faster than paths. */
const CROWD = 900, TURNS = 48, PHASES = 2;
const stamps = new Map();
let layer = null;

/* The coverage, 0 to 255, of an agent in one direction at one fraction of a pixel: a mask and its place around the pixel. */
function makeStamp(form, size, reach, turn, fx, fy) {
  const most = Math.max(size, reach), middle = Math.ceil(most + 1.5), side = 2 * middle + 1;
  const canvas = document.createElement("canvas"), x = middle + fx / PHASES + 0.25, y = middle + fy / PHASES + 0.25;
  canvas.width = canvas.height = side;
  const pen = canvas.getContext("2d", { willReadFrequently: true });
  pen.fillStyle = pen.strokeStyle = "#fff";
  const aim = turn < 0 ? NaN : turn / TURNS * 2 * Math.PI;
  if (form === "agent") stamp(pen, x, y, size, reach, aim);
  else if (form === "dot") { disc(pen, x, y, reach); pen.fill(); }
  else { polygon(pen, form, x, y, aim, reach); pen.fill(); }
  return trimmed(pen.getImageData(0, 0, side, side).data, side, middle);
}

/* The part of a stamp that is not empty: its width, height, the place of its corner from the middle, and its coverage. */
function trimmed(pixels, side, middle) {
  let left = side, right = 0, top = side, bottom = 0;
  for (let i = 0; i < side * side; i++) {
    if (pixels[4 * i + 3] < 4) continue;
    const column = i % side, row = (i - column) / side;
    left = Math.min(left, column); right = Math.max(right, column + 1); top = Math.min(top, row); bottom = Math.max(bottom, row + 1);
  }
  const wide = Math.max(0, right - left), high = Math.max(0, bottom - top), mask = new Uint8Array(wide * high);
  for (let row = 0; row < high; row++) for (let column = 0; column < wide; column++) mask[row * wide + column] = pixels[4 * ((top + row) * side + left + column) + 3];
  return { wide, high, dx: left - middle, dy: top - middle, mask };
}

const forms = new Map();

/* A small number for a form: "agent", "dot", or the corners of a polygon. */
function formNumber(form) {
  const name = typeof form === "string" ? form : JSON.stringify(form);
  if (!forms.has(name)) forms.set(name, forms.size);
  return forms.get(name);
}

/* The last kind of stamp: most agents follow one of their size. */
const recent = { which: -1, s: -1, r: -1, table: [] };

/* The stamp of a form at a size and reach rounded to quarters of a pixel; made when it is first needed. */
function stampOf(form, which, size, reach, turn, fx, fy) {
  const s = Math.round(4 * size), r = Math.round(4 * reach), n = 4 * (turn + 1) + 2 * fx + fy;
  if (recent.which !== which || recent.s !== s || recent.r !== r) Object.assign(recent, { which, s, r, table: [] });
  return recent.table[n] || (recent.table[n] = findStamp(form, which, s, r, turn, fx, fy));
}

function findStamp(form, which, s, r, turn, fx, fy) {
  const key = (((which * 512 + s) * 512 + r) * 64 + turn + 1) * 4 + 2 * fx + fy;
  let found = stamps.get(key);
  if (!found) {
    if (stamps.size > 20000) stamps.clear();
    stamps.set(key, found = makeStamp(form, s / 4, r / 4, turn, fx, fy));
  }
  return found;
}

/* Pixels of the size of a canvas, empty: {canvas, image, words}. */
function emptyLayer(w, h) {
  if (!layer || layer.canvas.width !== w || layer.canvas.height !== h) {
    const canvas = document.createElement("canvas");
    canvas.width = w; canvas.height = h;
    const pen = canvas.getContext("2d", { willReadFrequently: true }), image = pen.createImageData(w, h);
    layer = { canvas, pen, image, words: new Int32Array(image.data.buffer) };
  } else layer.words.fill(0);
  return layer;
}

/* The covered pixels of a stamp, counted from its middle in a picture w pixels wide, and their coverage: without the gaps
that its mask has. */
function pixelsOf(stamp, w) {
  if (stamp.w === w) return stamp;
  const { wide, high, dx, dy, mask } = stamp, count = mask.reduce((n, s) => n + (s > 0), 0);
  stamp.w = w; stamp.places = new Int32Array(count); stamp.covers = new Uint8Array(count);
  let n = 0;
  for (let row = 0; row < high; row++) for (let column = 0; column < wide; column++) {
    const s = mask[row * wide + column];
    if (s) { stamp.places[n] = (dy + row) * w + dx + column; stamp.covers[n++] = s; }
  }
  return stamp;
}

/* A pixel after a colour (0xbbggrr) covers it by s of 255; x * 257 + 257 >> 16 is x / 255, rounded down. */
function covered(under, s, colour) {
  if (under === 0 || (under ^ colour) << 8 === 0) return (s + ((255 - s) * (under >>> 24) * 257 + 257 >> 16) << 24) | colour;
  const alpha = s + (255 - s) * (under >>> 24) / 255, t = s / alpha;
  const r = (under & 255) + ((colour & 255) - (under & 255)) * t;
  const g = (under >> 8 & 255) + ((colour >> 8 & 255) - (under >> 8 & 255)) * t;
  const b = (under >> 16 & 255) + ((colour >> 16 & 255) - (under >> 16 & 255)) * t;
  return (alpha << 24) | (b << 16) | (g << 8) | r;
}

const MARGIN = 128; // pixels; more than any stamp reaches beyond the picture
let plane = null;

/* The coverage of a crowd in one colour, a byte per pixel, none yet: a quarter of the memory, and no stamp is cut off at an
edge. Tiny agents take half the time that they take in `blit`. */
function emptyPlane(w, h) {
  const wide = w + 2 * MARGIN, size = wide * (h + 2 * MARGIN);
  if (!plane || plane.wide !== wide || plane.cover.length !== size) plane = { wide, cover: new Uint8Array(size) }; else plane.cover.fill(0);
  return plane;
}

/* Adds a stamp to a plane, its middle at a pixel of the picture; the rule is that of `covered`. */
function addCover({ wide, cover }, stamp, x, y) {
  const { places, covers } = pixelsOf(stamp, wide), middle = (y + MARGIN) * wide + x + MARGIN, count = places.length;
  for (let n = 0; n < count; n++) {
    const at = middle + places[n], s = covers[n];
    cover[at] = s + ((255 - s) * cover[at] * 257 + 257 >> 16);
  }
}

/* Writes a plane in its colour into the pixels of the picture. */
function unfoldPlane({ wide, cover }, words, w, h, colour) {
  for (let y = 0, at = 0; y < h; y++) for (let x = 0, from = (y + MARGIN) * wide + MARGIN; x < w; x++, from++) words[at++] = cover[from] && (cover[from] << 24 | colour);
}

/* Copies a stamp in one colour over what is there, its middle at a pixel. */
function blit(words, w, h, stamp, x, y, colour, opacity) {
  const x0 = x + stamp.dx, y0 = y + stamp.dy;
  if (opacity === 1 && x0 >= 0 && y0 >= 0 && x0 + stamp.wide <= w && y0 + stamp.high <= h) {
    const { places, covers } = pixelsOf(stamp, w), middle = y * w + x, count = places.length;
    for (let n = 0; n < count; n++) { const at = middle + places[n]; words[at] = covered(words[at], covers[n], colour); }
    return;
  }
  const first = Math.max(0, -x0), last = Math.min(stamp.wide, w - x0), end = Math.min(stamp.high, h - y0);
  for (let row = Math.max(0, -y0); row < end; row++) for (let column = first; column < last; column++) {
    const s = (stamp.mask[row * stamp.wide + column] * opacity) | 0, at = (y0 + row) * w + x0 + column;
    if (s) words[at] = covered(words[at], s, colour);
  }
}

function word(colour) { const [r, g, b] = channels(colour); return (b << 16) | (g << 8) | r; }

/* How the agents of each look, and those without one, are stamped: form, size as a function of shade, colours, opacities. */
function stampStyles(panel, eye) {
  const plain = panel.kinds.map(role => new Uint32Array(panel.tint ? panel.tint.map(word) : new Array(256).fill(word(roleColour[role]))));
  const at = (list, shade) => list[Math.round(shade / 255 * (list.length - 1))], shades = [...Array(256).keys()];
  const looks = panel.looks.map(look => panel.kinds.map(role => ({
    form: look.form === "polygon" ? look.vertices : "dot", number: formNumber(look.form === "polygon" ? look.vertices : "dot"), least: look.form === "point" ? data.point * eye.w : 0,
    size: look.size ? shades.map(s => at(look.size, s) * eye.m) : null, turns: look.form === "polygon",
    colours: new Uint32Array(panel.tint ? panel.tint.map(word) : shades.map(s => word(look.colours ? at(look.colours, s) : roleColour[role]))), opacity: shades.map(s => at(look.opacity, s)),
  })));
  return { plain: plain.map(colours => ({ form: "agent", number: formNumber("agent"), size: null, colours, opacity: null, turns: true, least: 0 })), looks };
}

/* Agents by depth in 3-D, the farthest first; in order in 2-D. */
function drawingOrder(panel, eye, all) {
  if (panel.D < 3) return null;
  const depth = new Float32Array(panel.N), order = new Uint32Array(panel.N), count = new Uint32Array(257);
  for (let i = 0; i < panel.N; i++) depth[i] = eye.depth(all.pos[3 * i], all.pos[3 * i + 1], all.pos[3 * i + 2]);
  for (let i = 0; i < panel.N; i++) count[1 + (depth[i] * 255 | 0)]++;
  for (let b = 0; b < 256; b++) count[b + 1] += count[b];
  for (let i = 0; i < panel.N; i++) order[count[depth[i] * 255 | 0]++] = i;
  return { order, depth };
}

/* The reach of a dart in a crowd shrinks with its number, so that agents can still be told apart. */
function leastReach(panel, eye) { return Math.max(1.2 * eye.ratio, eye.least * Math.min(1, Math.sqrt(2500 / panel.N))); }

function fade(colour, ground, share) {
  const part = n => Math.round((colour >> n & 255) * share + (ground >> n & 255) * (1 - share));
  return (part(16) << 16) | (part(8) << 8) | part(0);
}

/* The colour that all agents of a crowd have, or -1. */
function oneColour(panel, styles) { return panel.D > 2 || panel.tint || panel.looks.length || styles.plain.length > 1 ? -1 : styles.plain[0].colours[0]; }

/* True if an agent is a billboard: those are images, drawn over the stamps, in order. */
function floats(panel, i) { return panel.look[i] >= 0 && !panel.tint && panel.looks[panel.look[i]].form === "billboard"; }

function drawCrowd(pen, eye, panel, all, k, hidden) {
  const { w, h, a, b, tx, ty } = eye, pixels = emptyLayer(w, h), styles = stampStyles(panel, eye), shade = panel.frames[k].shade;
  const sorted = drawingOrder(panel, eye, all), least = leastReach(panel, eye), paper = word(paint.paper), pos = all.pos, one = oneColour(panel, styles), bytes = one < 0 ? null : emptyPlane(w, h), dotNumber = formNumber("dot"), soft = [], { flat } = eye, perTurn = TURNS / (2 * Math.PI);
  for (let n = 0; n < panel.N; n++) {
    const i = sorted ? sorted.order[n] : n;
    if (!all.there[i] || melts(panel, i) || hidden && hidden[i]) continue;
    const x = a[0] * pos[3 * i] + a[1] * pos[3 * i + 1] + a[2] * pos[3 * i + 2] + tx, y = b[0] * pos[3 * i] + b[1] * pos[3 * i + 1] + b[2] * pos[3 * i + 2] + ty;
    if (floats(panel, i)) { soft.push({ i, x, y, depth: sorted ? sorted.depth[i] : 1 }); continue; }
    if (!(x > -50 && y > -50 && x < w + 50 && y < h + 50)) continue;
    const style = panel.look[i] < 0 ? styles.plain[panel.kind[i]] : styles.looks[panel.look[i]][panel.kind[i]];
    const s = shade ? shade[i] : 0, depth = sorted ? Math.round(16 * sorted.depth[i]) / 16 : 1, swell = sorted ? 0.7 + 0.5 * depth : 1;
    const size = (style.size ? style.size[s] : panel.radius[i] * eye.m) * swell;
    let reach = style.form === "agent" ? Math.max(size, least * swell) : Math.max(size, style.least);
    let form = style.form, which = style.number, turn = -1;
    if (form === "agent" && (panel.tied[i] || reach < 2.2)) { form = "dot"; which = dotNumber; reach = Math.max(size, panel.tied[i] ? data.bond * w : 0.6 * reach); }
    else if (style.turns && all.aim[i] === all.aim[i]) turn = (Math.round((flat ? all.aim[i] : eye.angle(all.aim[i])) * perTurn) + 2 * TURNS) % TURNS;
    const px = Math.floor(x), py = Math.floor(y), mark = stampOf(form, which, Math.min(size, 60), Math.min(reach, 60), turn, (x - px) * PHASES | 0, (y - py) * PHASES | 0);
    if (bytes) { addCover(bytes, mark, px, py); continue; }
    const colour = sorted ? fade(style.colours[s], paper, 0.45 + 0.55 * depth) : style.colours[s];
    blit(pixels.words, w, h, mark, px, py, colour, style.opacity && !panel.tint ? style.opacity[s] : 1);
  }
  if (bytes) unfoldPlane(bytes, pixels.words, w, h, one);
  pixels.pen.putImageData(pixels.image, 0, 0);
  pen.drawImage(pixels.canvas, 0, 0);
  for (const body of soft) drawLook(pen, eye, panel, body, k, sorted ? 0.7 + 0.5 * body.depth : 1);
}
