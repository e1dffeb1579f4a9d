/* The live source: a socket to the server, which plays the worlds; the page asks for each frame when it can draw one. */
const MAGIC = 0x01464c46; // "FLF" and the version 1, little endian: see flockenv/play/frames.py
const BLOCKS = { pos: Uint16Array, heading: Uint8Array, tilt: Int8Array, shade: Uint8Array, identity: Uint16Array, field: Uint8Array, arrows: Int8Array };
const QUESTIONS = { yaml: "save", link: "share" }; // the questions of answers with another name
const SLOW = 12; // ms; slower pictures are drawn only when a frame has come, because those between would keep the page from reading it
const RETRY = 1000; // ms until a page without a connection tries again; each time it waits longer
const live = {
  socket: null, room: null, waiting: false, due: false, askedAt: 0, toldAt: 0, lastFrame: 0, header: {}, want: { colour: "", field: "" }, listeners: {}, timing: {}, last: null,
  asked: new Set(), retry: RETRY, greeted: false, opening: false, rate: { since: 0, count: 0, shown: 0 },

  connect() {
    const url = new URL("ws", location.href);
    url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    url.search = location.search; url.hash = "";
    this.socket = new WebSocket(url);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.waiting = false; // nothing that was asked before is answered any more
      this.send({ type: "hello", version: data.version });
      if (this.greeted) tell(""); else this.begin();
      this.greeted = true; this.retry = RETRY;
    };
    this.socket.onmessage = event => typeof event.data === "string" ? this.take(JSON.parse(event.data)) : this.frame(event.data);
    this.socket.onclose = event => {
      this.waiting = true; this.asked.clear(); showPlaying(false);
      if (event.code === 1001) { tell("The server has ended. Start it again with: flockenv play; then reload this page.", true, true); return; }
      if (event.reason) { tell(`The server has closed this page: ${event.reason}. Reload it to go on.`, true, true); return; }
      tell("The page has lost its server and tries again. If the server has ended, start it with: flockenv play", true, true);
      setTimeout(() => this.connect(), this.retry);
      this.retry = Math.min(1.5 * this.retry, 10000);
    };
  },
  begin() { const link = location.hash.slice(1); if (link.startsWith("w=")) this.send({ type: "link", text: link.slice(2) }); },
  /* Sends a message; returns a line if it is too long, else nothing. */
  send(message) {
    if (!this.socket || this.socket.readyState !== WebSocket.OPEN) return "";
    const text = JSON.stringify(message), long = (message.yaml || message.text || "").length, size = new TextEncoder().encode(text).length;
    if (long <= data.longest && size <= data.largest) { this.socket.send(text); return ""; }
    const line = `${message.type}: ${long > data.longest ? `${long} characters; at most ${data.longest}` : `${size} bytes; at most ${data.largest}`} can be sent`;
    this.asked.delete(message.type); tell(line, true);
    return line;
  },

  /* Sends an edit to one lane (an index) or to all of them (null). */
  edit(edit, lane = null) { this.send({ type: "edit", edit: lane === null ? edit : { ...edit, lane } }); },
  set(path, value, lane = null) { this.edit({ kind: "set", path, value }, lane); },

  /* Asks a question that has one answer, unless the last one is still open. */
  ask(message) {
    if (this.asked.has(message.type)) return;
    this.asked.add(message.type);
    this.send(message);
  },
  on(type, act) { (this.listeners[type] = this.listeners[type] || []).push(act); },
  take(message) {
    this.asked.delete(QUESTIONS[message.type] || message.type);
    if (message.type === "error") this.refused(message.about);
    if (message.type !== "notice" && $("toast").dataset.busy) tell("");
    if (message.type === "room") this.takeRoom(message);
    for (const act of this.listeners[message.type] || []) act(message);
  },

  /* After a refusal a question may be asked again; a frame of colours or fields that there are not, without them. */
  refused(about) {
    this.asked.delete(about);
    if (about === "frame") { this.waiting = false; this.want = { colour: "", field: "" }; }
  },

  /* A message about the room: its worlds are shown anew only if their fixed parts are others than before. */
  takeRoom(room) {
    const same = this.room && this.room.name === room.name && this.room.lanes.map(l => l.key).join() === room.lanes.map(l => l.key).join(), old = state.group.panels;
    this.room = room;
    if (same) room.lanes.forEach((lane, n) => renewPanel(views[n], lane));
    else {
      const kept = old.length === room.lanes.length && this.name === room.name ? views.map(v => ({ ...v.camera })) : [], panels = room.lanes.map(livePanel);
      if (this.name === room.name) panels.forEach((panel, n) => inherit(panel, old[n]));
      this.name = room.name;
      const group = { panels, start: 0, end: Math.max(room.last * room.interval, room.interval), worst: 0, best: 0 };
      present(group); showSpan(group);
      views.forEach((view, n) => prepareView(view, n, kept[n]));
      if (tool.name) takeTool(tool.name);
    }
    showPlaying(room.playing); setSpeed(room.speed);
    document.querySelector("h1").textContent = document.title = room.title;
    $("about").textContent = $("about").title = room.about;
    $("seed").value = room.seed;
    this.lastFrame = 0;
    refresh();
  },

  frame(buffer) {
    const words = new DataView(buffer), size = words.getUint32(4, true);
    if (words.getUint32(0, true) !== MAGIC) { tell("The server speaks another version: reload this page.", true, true); return; }
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, size))), panels = state.group.panels;
    this.waiting = false; this.lastFrame = performance.now();
    this.timing.round = this.lastFrame - this.askedAt;
    this.count();
    this.header = header;
    if (header.lanes.length !== panels.length || header.lanes.some((lane, n) => lane.n !== panels[n].N)) return; // a message about the room is on its way
    let at = 8 + size;
    header.lanes.forEach((lane, n) => {
      const blocks = {};
      for (const name of lane.blocks) {
        const count = blockSize(lane, name);
        blocks[name] = new BLOCKS[name](buffer, at, count);
        at += (blocks[name].byteLength + 3) & ~3;
      }
      takeLane(panels[n], lane, blocks);
      if (views[n]) views[n].field = blocks.field ? { ...lane.field, most: lane.field.high, low: lane.low, high: lane.high, values: blocks.field, arrows: blocks.arrows } : null;
    });
    this.follow(header);
    refresh();
    if (this.due) this.request();
  },
  /* Frames a second, over one second. */
  count() {
    const now = performance.now();
    this.rate.count++;
    if (now - this.rate.since < 1000) return;
    this.rate.shown = this.rate.count * 1000 / (now - this.rate.since);
    this.rate.since = now; this.rate.count = 0;
  },
  follow(header) {
    const group = state.group, end = Math.max(header.last * this.room.interval, this.room.interval);
    if (end !== group.end) { group.end = end; showSpan(group); }
    if (this.askedAt > this.toldAt) { // a frame that was asked for before has the state before
      if (header.playing !== state.playing) showPlaying(header.playing);
      if (header.speed !== state.speed) setSpeed(header.speed);
    }
    for (const panel of group.panels) if (panel.reward) for (const r of panel.curve.returns) { group.worst = Math.min(group.worst, r); group.best = Math.max(group.best, r); }
    Object.assign(this.timing, header.timing);
  },

  /* Asks for a frame, once per picture of the screen; one that is due while another is on its way is asked for when that comes. */
  request() {
    const idle = !state.playing && performance.now() - this.lastFrame < 120;
    this.due = this.waiting && !this.saves;
    if (this.waiting || !this.room || idle || !$("gallery").hidden) return;
    this.waiting = true; this.askedAt = performance.now();
    this.send({ type: "frame", want: { ...this.want, scenery: state.group.panels.map(p => p.sceneryKey === undefined ? -1 : p.sceneryKey) } });
  },
  get saves() { return drawn.ms > SLOW; },
  hasEnded: panel => Boolean(panel.ended),
  words: panel => panel.note || "",
  /* Pixels above and below all panels, and those of each panel's caption. */
  around: () => innerHeight - document.querySelector(".stage").clientHeight + Math.max($("legend").offsetHeight, 44) + 8,
  aroundPanel: shown => shown.some(view => view.panel.player) ? 34 : 0,
  play(on) { showPlaying(on); this.toldAt = performance.now(); this.last = null; this.send({ type: "play", on }); refresh(); },
  seek(t) { this.send({ type: "seek", tick: Math.max(0, Math.round(t / this.room.interval)) }); this.lastFrame = 0; refresh(); },
  step(by) { if (state.playing) this.play(false); this.send({ type: "step", n: by }); this.lastFrame = 0; refresh(); },
  speedChanged() { this.toldAt = performance.now(); this.send({ type: "speed", x: state.speed }); },

  /* Shown time follows the frames one step behind, so that agents move smoothly between two of them. */
  advance(now) {
    this.request();
    keepAsking();
    const times = state.group.panels.map(p => p.time).reduce((a, b) => (b[b.length - 1] || 0) > (a[a.length - 1] || 0) ? b : a), newest = times[times.length - 1] || 0;
    const passed = this.last === null ? 0 : Math.min(0.1, (now - this.last) / 1000) * state.speed;
    this.last = now;
    if (!state.playing || times.length < 2) { state.time = newest; return true; }
    const lag = Math.max(newest - times[times.length - 2], 1e-3), wanted = newest - lag;
    state.time += passed;
    state.time += Math.abs(wanted - state.time) > 4 * lag ? wanted - state.time : 0.08 * (wanted - state.time);
    state.time = clamp(state.time, times[0], newest);
    return true;
  },
  key: event => liveKey(event),
};

/* Number of values in a block of a frame. */
function blockSize(lane, name) {
  if (name === "pos") return lane.n * lane.dimension;
  if (name !== "field" && name !== "arrows") return lane.n;
  const cells = lane.field.shape[0] * lane.field.shape[1];
  return name === "field" ? cells : 2 * cells;
}

/* A list of [value, count] as one value per agent. */
function unroll(runs) { return runs.flatMap(([value, count]) => new Array(count).fill(value)); }

function livePanel(lane) {
  const panel = complete({
    player: lane.name, low: lane.low, high: lane.high, periodic: lane.periodic, roles: unroll(lane.roles), radius: unroll(lane.radius), bonds: pairsOf(lane.bonds, 2),
    faces: pairsOf(lane.faces || [], 3), covered: unroll(lane.covered || []), look: lane.look ? unroll(lane.look) : null, looks: lane.looks || [], scenery: [{ from: 0, stones: [], walls: [], marks: [] }],
    time: [], frames: [], reward: lane.has_returns ? [] : null, curve: { times: [], returns: [] }, outcome: "", lane, shown: null,
  });
  const long = panel.looks.some(look => look.trail);
  panel.most = panel.N <= 64 ? 400 : panel.N <= 400 ? 150 : panel.N <= CROWD ? 60 : long && panel.N <= 6000 ? 50 : 3;
  return panel;
}

/* Keeps a panel whose fixed parts are the same. */
function renewPanel(view, lane) { view.panel.lane = lane; view.panel.player = lane.name; view.player.textContent = view.player.title = lane.name; }

/* The frames of a panel with as many agents, so that nothing blinks while a radius is dragged. */
function inherit(panel, old) {
  if (!old || old.N !== panel.N || old.D !== panel.D) return;
  for (const name of ["time", "frames", "curve", "scenery", "sceneryKey", "low", "high", "extent", "shown"]) panel[name] = old[name];
}

function pairsOf(flat, n) { const out = []; for (let i = 0; i < flat.length; i += n) out.push(flat.slice(i, i + n)); return out; }

/* Puts one lane of a frame into its panel. */
function takeLane(panel, lane, { pos: level, heading, shade, identity }) {
  const { N, D } = panel, spare = panel.spare, pos = spare ? spare.pos : new Float32Array(N * D), before = panel.frames[panel.frames.length - 1];
  for (let d = 0; d < D; d++) {
    const wide = lane.high[d] - lane.low[d], first = lane.low[d] - data.beyond * wide, step = wide * (1 + 2 * data.beyond) / 65535;
    for (let i = 0, from = d * N; i < N; i++) pos[i * D + d] = first + level[from + i] * step;
  }
  const fresh = identity && before && before.identity ? identity.map((number, i) => number === before.identity[i] ? 0 : 1) : null;
  panel.spare = null; panel.broken = lane.broken;
  keepFrame(panel, { pos, heading, aim: spare ? spare.aim : new Float64Array(N), shade: shade || null, identity, fresh }, lane);
}

function keepFrame(panel, frame, lane) {
  const newest = panel.time.length ? panel.time[panel.time.length - 1] : -1;
  if (lane.time < newest - EPS) { panel.time.length = panel.frames.length = 0; dropAfter(panel.curve, lane.time); }
  if (panel.time.length && Math.abs(lane.time - newest) < EPS) { panel.time.pop(); panel.frames.pop(); }
  angles(frame.heading, panel.frames.length ? panel.frames[panel.frames.length - 1].aim : null, frame.aim);
  panel.time.push(lane.time); panel.frames.push(frame);
  while (panel.time.length > panel.most) { panel.time.shift(); panel.spare = panel.frames.shift(); } // its arrays are used again
  const [key, scenery] = lane.scenery;
  if (scenery) { panel.scenery = [{ from: 0, ...scenery }]; panel.sceneryKey = key; panel.legendOld = true; }
  panel.ended = Boolean(lane.stopped); panel.outcome = lane.stopped; if ((panel.colour || {}).name !== (lane.colour || {}).name) panel.legendOld = true;
  panel.colour = lane.colour || null;
  if (live.room.kind === "scene" && isNumber(lane.apart)) panel.note = `${number(lane.apart)} m apart`;
  showRegion(panel, lane);
  if (panel.reward && lane.returns !== null && lane.returns !== undefined) {
    const { times, returns } = panel.curve;
    if (times[times.length - 1] !== lane.time) { times.push(lane.time); returns.push(lane.returns); } else returns[returns.length - 1] = lane.returns;
    if (times.length > 4000) { times.splice(0, 2000); returns.splice(0, 2000); }
  }
}

function dropAfter(curve, time) { while (curve.times.length && curve.times[curve.times.length - 1] > time - EPS) { curve.times.pop(); curve.returns.pop(); } }

/* The region on the stage: it grows at once and shrinks slowly, so that an open plane does not tremble. */
function showRegion(panel, { low, high }) {
  if (panel.periodic) return;
  const first = !panel.shown;
  panel.shown = true;
  for (let d = 0; d < panel.D; d++) {
    const less = low[d] < panel.low[d] || first, more = high[d] > panel.high[d] || first;
    panel.low[d] = less ? low[d] : panel.low[d] + 0.02 * (low[d] - panel.low[d]);
    panel.high[d] = more ? high[d] : panel.high[d] + 0.02 * (high[d] - panel.high[d]);
    panel.extent[d] = panel.high[d] - panel.low[d];
  }
}

let toastTimer = 0;
/* One line for the reader; bad: a refusal; stays: until the next one. */
function tell(text, bad = false, stays = false) {
  const toast = $("toast");
  toast.textContent = text; toast.className = "toast" + (text ? " on" : "") + (bad ? " bad" : ""); toast.dataset.busy = "";
  clearTimeout(toastTimer);
  if (!stays) toastTimer = setTimeout(() => { toast.className = "toast"; }, Math.max(2500, 60 * text.length));
}
