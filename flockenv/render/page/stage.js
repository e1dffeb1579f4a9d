/* The stage: the panels side by side with their captions, returns and legend; and the loop that draws them. */

/* The return so far of every player, this one's in full colour, on axes that all panels share. */
function drawCurve(view) {
  const { curve, panel } = view, pen = curve.getContext("2d"), w = curve.width, h = curve.height, g = state.group;
  const ratio = window.devicePixelRatio || 1, pad = 3 * ratio;
  const x = t => pad + (w - 2 * pad) * (t - g.start) / (g.end - g.start || 1);
  const y = r => h - pad - (h - 2 * pad) * (r - g.worst) / (g.best - g.worst || 1);
  pen.clearRect(0, 0, w, h);
  pen.strokeStyle = paint.edge; pen.lineWidth = ratio; pen.beginPath(); pen.moveTo(0, y(0)); pen.lineTo(w, y(0)); pen.stroke();
  for (const other of [...g.panels.filter(p => p !== panel && p.reward), panel]) {
    const { times, returns } = returnsOf(other), last = frameAt(times, state.time);
    if (!times.length) continue;
    pen.strokeStyle = other === panel ? paint.accent : paint.edge; pen.lineWidth = (other === panel ? 2 : 1.3) * ratio;
    pen.lineJoin = "round"; pen.beginPath();
    for (let k = 0; k <= last; k++) pen.lineTo(x(times[k]), y(returns[k]));
    pen.stroke();
    if (other !== panel) continue;
    pen.fillStyle = paint.accent; disc(pen, x(times[last]), y(returns[last]), 3 * ratio); pen.fill();
  }
}

/* The return of a panel over time; a live panel keeps it longer than its frames. */
function returnsOf(panel) { return panel.curve || { times: panel.time, returns: panel.reward }; }

function render() {
  const began = performance.now();
  for (const view of views) {
    const { panel } = view;
    if (!panel.frames.length) continue;
    const now = moment(panel, state.time), ended = source.hasEnded(panel);
    view.figure.classList.toggle("ended", ended);
    view.outcome.textContent = ended ? panel.outcome : source.words(panel);
    if (view.before) view.before(now);
    drawWorld(view, now);
    if (!panel.reward) continue;
    const { times, returns } = returnsOf(panel);
    view.total.textContent = times.length ? number(returns[frameAt(times, state.time)]) : "";
    drawCurve(view);
  }
  showTime();
  drawn.count++; drawn.ms += (performance.now() - began - drawn.ms) * (drawn.count < 5 ? 0.5 : 0.1);
}
/* Number of pictures drawn, and the time for one, ms, averaged over about ten. */
const drawn = { count: 0, ms: 0 };

/* Draws soon. */
function refresh() { state.dirty = true; schedule(); }

/* Looks at the source at the next picture of the screen, and goes on as long as it says so; draws if anything has changed. */
function schedule() {
  if (state.queued) return;
  state.queued = true;
  requestAnimationFrame(now => {
    state.queued = false;
    if (!views.length) return;
    if (source.advance(now)) schedule();
    if (!state.dirty && (!state.playing || source.saves)) return;
    state.dirty = false;
    render();
  });
}

function fit(canvas) {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
  canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
}

const watcher = new ResizeObserver(entries => { entries.forEach(e => fit(e.target)); refresh(); });

function makeView(panel) {
  const figure = element("figure"), caption = element("figcaption"), score = element("div", undefined, "score");
  const player = element("span", panel.player, "player"), outcome = element("span", "", "outcome");
  const canvas = element("canvas", undefined, "world"), curve = element("canvas", undefined, "curve"), box = element("div"), total = element("span");
  player.title = panel.player;
  canvas.setAttribute("role", "img"); canvas.setAttribute("aria-label", panel.player || "the world"); canvas.tabIndex = 0;
  figure.style.setProperty("--aspect", aspectOf(panel));
  box.append(total, element("small", "return"));
  caption.append(player, outcome); score.append(box, curve); figure.append(caption, canvas, ...(panel.reward ? [score] : []));
  watcher.observe(canvas); watcher.observe(curve);
  figure.classList.toggle("unnamed", !panel.player);
  const view = { panel, figure, canvas, curve, player, outcome, total, camera: newCamera(panel.D) };
  steerCamera(view);
  return view;
}

function aspectOf(panel) { return clamp(panel.shape || panel.extent[0] / panel.extent[1], 0.5, 4); }

/* All panels of one size: in as many columns as make them largest with all in sight; where that is too small, as many as fit beside each other. */
function arrange() {
  const panels = $("panels"), style = getComputedStyle(panels), n = views.length, gap = 20, around = source.aroundPanel(views) + (state.group.panels.some(p => p.reward) ? 48 : 0);
  const wide = panels.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight), high = innerHeight - source.around();
  const aspect = clamp(Math.max(...views.map(v => aspectOf(v.panel))), 0.5, 4);
  let best = 0;
  for (let columns = 1; columns <= n; columns++) {
    const rows = Math.ceil(n / columns);
    best = Math.max(best, Math.min((wide - gap * (columns - 1)) / columns, ((high - gap * (rows - 1)) / rows - around) * aspect));
  }
  const least = Math.min(wide, 180), columns = Math.max(1, Math.floor((wide + gap) / (least + gap)));
  if (best < least) best = (wide - gap * (Math.min(n, columns) - 1)) / Math.min(n, columns);
  panels.style.setProperty("--panel", Math.floor(best) + "px");
}

/* One line of the legend: a dart, disc, ring or arrow in a colour, and what it means. */
function legendRow([text, colour, kind]) {
  const row = element("span"), sign = element("i"), shape = kind === "dart" ? data.dart : data.arrow.map(([a, b]) => [2 * a - 1, 3 * b]);
  if (kind === "ring") sign.style.border = "2px solid " + colour; else if (colour) sign.style.background = colour;
  if (kind === "ring" || kind === "disc") sign.style.borderRadius = "50%";
  else sign.style.clipPath = "polygon(" + shape.map(([a, b]) => `${50 + 50 * a}% ${50 - 50 * b}%`).join() + ")";
  row.append(...(kind ? [sign] : []), text);
  return row;
}

function makeLegend(group) {
  const has = test => group.panels.some(p => p.scenery.some(test)), rows = [];
  for (const role of group.panels.every(p => p.colour) ? [] : Object.keys(data.roles)) { // a scale explains other colours
    const shown = p => { const hidden = coveredAgents(p) || []; return p.roles.findIndex((each, i) => each === role && !hidden[i]); };
    const panel = group.panels.find(p => shown(p) >= 0);
    if (!panel) continue;
    const look = panel.looks[panel.look[shown(panel)]];
    rows.push([role, look && look.colours ? look.colours[0] : roleColour[role], look && look.form !== "polygon" ? "disc" : "dart"]);
  }
  if (has(s => s.stones.length || s.walls.length)) rows.push(["obstacle", paint.stone, "disc"]);
  if (has(s => s.marks.some(m => m.kind === "goal"))) rows.push(["goal", paint.goal, "ring"]);
  if (has(s => s.marks.some(m => m.kind === "way"))) rows.push(["path", mix(paint.goal, paint.paper, data.way), "disc"]);
  if (has(s => s.marks.some(m => m.kind === "heading"))) rows.push(["desired heading", paint.goal, "arrow"]);
  if (group.panels.some(p => p.periodic)) rows.push(["dashed edge: the world goes on across it", null, null]);
  $("legend").replaceChildren(...rows.map(legendRow));
}

/* Shows the panels of a group. */
function present(group) {
  state.group = group;
  watcher.disconnect();
  views = group.panels.map(makeView);
  $("panels").replaceChildren(...views.map(v => v.figure));
  makeLegend(group);
  arrange();
  views.forEach(v => { fit(v.canvas); fit(v.curve); });
  refresh();
}

function dress(dark) {
  state.dark = dark;
  const pick = table => Object.fromEntries(Object.entries(table).map(([name, pair]) => [name, pair[dark ? 1 : 0]]));
  paint = pick(data.paper); roleColour = pick(data.roles);
  paint.accent = roleColour.evader; paint.chip = dark ? paint.grid : "#e3e8ef";
  for (const [name, colour] of Object.entries(paint)) document.documentElement.style.setProperty("--" + name, colour);
  document.documentElement.style.colorScheme = document.documentElement.dataset.theme = dark ? "dark" : "light";
  if (state.group) { makeLegend(state.group); refresh(); }
}
