/* Panels: one world each, as a list of frames with increasing times. A recorded panel has them all, a live one the last.

panel: player, D, N, roles and radius (per agent), low, high, extent, periodic, bonds, tied, look, looks, scenery (by
frame), time (per frame), frames, reward (per frame, or null), outcome.
frame: pos in m (agent, axis), aim in rad (agent; NaN if unknown), heading (0 to 255, as stored), shade, fresh, low, high. */

/* Positions in m of levels 0 to 65535, which span the region and `beyond` of it on both sides. */
function metres(level, low, high) {
  const D = low.length, out = new Float64Array(level.length);
  const first = low.map((l, d) => l - data.beyond * (high[d] - l)), step = low.map((l, d) => (high[d] - l) * (1 + 2 * data.beyond) / 65535);
  for (let i = 0, d = 0; i < level.length; i++) {
    out[i] = first[d] + level[i] * step[d];
    if (++d === D) d = 0;
  }
  return out;
}

/* Directions in rad of stored headings; an agent at rest keeps that of the frame before. */
function angles(heading, before, out = new Float64Array(heading.length)) {
  const unit = 2 * Math.PI / data.directions;
  for (let i = 0; i < heading.length; i++) out[i] = heading[i] < RESTING ? heading[i] * unit : before ? before[i] : NaN;
  return out;
}

/* What follows from the fixed parts of a panel. */
function complete(panel) {
  panel.D = panel.low.length; panel.N = panel.roles.length;
  panel.extent = panel.high.map((h, d) => h - panel.low[d]);
  panel.tied = new Uint8Array(panel.N);
  for (const [a, b] of panel.bonds) panel.tied[a] = panel.tied[b] = 1;
  panel.look = Int16Array.from(panel.look || new Array(panel.N).fill(-1)); panel.looks = panel.looks || [];
  panel.kinds = [...new Set(panel.roles)]; panel.kind = Uint8Array.from(panel.roles, role => panel.kinds.indexOf(role));
  return panel;
}

/* The path from frame k to frame k + 1 of an agent along axis d; zero over a jump, or if a slot holds another agent. */
function stride(panel, k, i, d) {
  const here = panel.frames[k], there = panel.frames[k + 1];
  if (there.fresh && there.fresh[i]) return 0;
  let path = there.pos[i * panel.D + d] - here.pos[i * panel.D + d];
  if (panel.periodic) path -= panel.extent[d] * Math.round(path / panel.extent[d]);
  return Math.abs(path) > data.jump * panel.extent[d] ? 0 : path;
}

/* Frame k and how far (0..1) time has gone on to the next. An ended panel stays in its last frame. */
function moment(panel, t) {
  const k = frameAt(panel.time, t);
  if (k + 1 >= panel.time.length) return { k, f: 0 };
  return { k, f: clamp((t - panel.time[k]) / (panel.time[k + 1] - panel.time[k]), 0, 1) };
}

/* The state of every agent between two frames, in arrays that the next call writes again: pos (agent, axis), aim, there. */
function bodies(panel, { k, f }) {
  const { N, D, periodic } = panel, frame = panel.frames[k], next = f > 0 ? panel.frames[k + 1] : null, fresh = next && next.fresh;
  const out = panel.bodies || (panel.bodies = { pos: new Float64Array(N * 3), aim: new Float64Array(N), there: new Uint8Array(N) });
  const { pos, aim, there } = out, here = frame.pos, heading = frame.heading;
  for (let i = 0; i < N; i++) there[i] = heading[i] === ABSENT ? 0 : 1;
  for (let d = 0; d < D; d++) {
    const extent = panel.extent[d], most = data.jump * extent;
    for (let i = 0, at = d; i < N; i++, at += D) {
      let x = here[at];
      if (next && there[i] && !(fresh && fresh[i])) {
        let path = next.pos[at] - x;
        if (periodic) path -= extent * Math.round(path / extent);
        if (path < most && path > -most) x += f * path;
      }
      pos[3 * i + d] = x;
    }
  }
  if (N > 30000) aim.set(frame.aim); // too small to tell
  else for (let i = 0; i < N; i++) aim[i] = next && there[i] && next.heading[i] < RESTING ? between(frame.aim[i], next.aim[i], f) : frame.aim[i];
  return out;
}

/* The position of an agent among those of `bodies`, m. */
function placeOf(all, i) { return [all.pos[3 * i], all.pos[3 * i + 1], all.pos[3 * i + 2]]; }

/* The direction between two, along the shorter arc; the second if the first is unknown. */
function between(first, second, f) {
  if (first !== first) return second;
  let turn = second - first;
  if (turn > Math.PI) turn -= 2 * Math.PI; else if (turn < -Math.PI) turn += 2 * Math.PI;
  return first + f * turn;
}

/* The scenery of frame k: the last entry that began by then. */
function sceneryAt(panel, k) { return panel.scenery.filter(s => s.from <= k).pop() || panel.scenery[0]; }
