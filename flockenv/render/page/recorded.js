/* The recorded source: groups of panels with all their frames, played back in the page. */

function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out;
}

function unpack(panel) {
  complete(panel);
  const { N, D } = panel, pos = metres(new Uint16Array(bytes(panel.pos).buffer), panel.low, panel.high), heading = bytes(panel.heading);
  const parts = Object.fromEntries(["shade", "fresh"].map(name => [name, panel[name] ? bytes(panel[name]) : null]));
  panel.frames = [];
  panel.time.forEach((_, k) => {
    const cut = list => list && list.subarray(k * N, (k + 1) * N), turns = cut(heading);
    panel.frames.push({ pos: pos.subarray(k * N * D, (k + 1) * N * D), heading: turns, aim: angles(turns, k ? panel.frames[k - 1].aim : null), shade: cut(parts.shade), fresh: cut(parts.fresh) });
  });
  panel.end = panel.time[panel.time.length - 1];
}

function unpackGroup(group) {
  group.panels.forEach(unpack);
  group.ticks = [...new Set(group.panels.flatMap(p => p.time))].sort((a, b) => a - b);
  group.start = group.ticks[0];
  group.end = group.ticks[group.ticks.length - 1];
  const returns = group.panels.flatMap(p => p.reward || []);
  group.worst = returns.reduce((a, b) => Math.min(a, b), 0);
  group.best = returns.reduce((a, b) => Math.max(a, b), 0);
}

const recorded = {
  last: null,
  around: () => 190,
  aroundPanel: () => 62,
  hasEnded: panel => state.time >= panel.end - EPS,
  words: () => "running",
  speedChanged() {},
  play(on) {
    if (on && state.time >= state.group.end - EPS) state.time = state.group.start;
    this.last = null;
    showPlaying(on);
    refresh();
  },
  seek(t) { state.time = clamp(t, state.group.start, state.group.end); refresh(); },
  step(by) {
    const ticks = state.group.ticks, k = frameAt(ticks, state.time);
    this.play(false);
    this.seek(by < 0 && state.time > ticks[k] + EPS ? ticks[k] : ticks[clamp(k + by, 0, ticks.length - 1)]);
  },
  advance(now) {
    if (!state.playing) return false;
    // A tab that was hidden must not leap.
    if (this.last !== null) state.time += Math.min(0.1, (now - this.last) / 1000) * state.speed;
    this.last = now;
    if (state.time < state.group.end) return true;
    state.time = state.group.end;
    this.play(false);
    return false;
  },
  choose(n) {
    const group = data.groups[n];
    if (!group) return;
    state.time = group.start; this.last = null;
    present(group); showSpan(group);
    [...$("tasks").children].forEach((b, k) => b.setAttribute("aria-pressed", k === n));
  },
  key(event) {
    const page = { PageUp: -1, PageDown: 1 }[event.key];
    if (page) { this.choose(data.groups.indexOf(state.group) + page); return true; }
    if (/^[0-9]$/.test(event.key)) { this.choose((+event.key + 9) % 10); return true; }
    return false;
  },
  /* The page's address may say #task=1&t=4.2&pause: a moment that one can link to. */
  follow() {
    const want = new URLSearchParams(location.hash.slice(1)), still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.choose(clamp((parseInt(want.get("task"), 10) || 1) - 1, 0, data.groups.length - 1));
    const t = parseFloat(want.get("t"));
    if (Number.isFinite(t)) this.seek(t);
    this.play(want.has("play") || !(want.has("t") || want.has("pause") || still));
  },
  start() {
    data.groups.forEach(unpackGroup);
    document.querySelector("h1").textContent = data.title;
    if (data.groups.length > 1) $("tasks").append(...data.groups.map((group, n) => {
      const button = element("button", group.title);
      button.onclick = () => this.choose(n);
      return button;
    }));
    else $("taskkeys").remove();
    addEventListener("hashchange", () => this.follow());
    this.follow();
  },
};

source = recorded;
startClock();
source.start();
