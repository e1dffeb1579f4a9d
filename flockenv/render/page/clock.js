/* The time bar and its keys; what they do is the source's: play(on), seek(t), step(by), start(), end(). */
const PLAY = "M4 2l10 6-10 6z", PAUSE = "M3 2h3.6v12H3zM9.4 2H13v12H9.400z";

function showPlaying(on) {
  state.playing = on;
  $("play").querySelector("path").setAttribute("d", on ? PAUSE : PLAY);
  $("play").setAttribute("aria-label", on ? "pause" : "play");
}

function showSpan(group) { $("when").min = group.start; $("when").max = group.end; }

function showTime() {
  $("when").value = state.time;
  $("clock").replaceChildren(state.time.toFixed(2) + " ", element("small", "/ " + state.group.end.toFixed(2) + " s"));
}

function setSpeed(speed) {
  const k = SPEEDS.reduce((best, s, n) => Math.abs(s - speed) < Math.abs(SPEEDS[best] - speed) ? n : best, 0);
  state.speed = SPEEDS[k]; $("speed").value = k;
}

function hasten(by) { setSpeed(SPEEDS[clamp(SPEEDS.indexOf(state.speed) + by, 0, SPEEDS.length - 1)]); source.speedChanged(); }

const KEYS = {
  " ": () => source.play(!state.playing), "ArrowLeft": () => source.step(-1), "ArrowRight": () => source.step(1), "ArrowUp": () => hasten(1),
  "ArrowDown": () => hasten(-1), "Home": () => source.seek(state.group.start), "End": () => source.seek(state.group.end), "d": () => dress(!state.dark),
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select, textarea, dialog, input:not([type=range]):not([type=checkbox]), [role=spinbutton]")) return;
  if (event.key === " " && event.target.closest("button, summary, input[type=checkbox]")) return; // it has a meaning of its own there
  if (event.key.startsWith("Arrow") && event.target.closest("[role=tab]")) return;
  if (source.key && source.key(event)) { event.preventDefault(); return; }
  if (event.shiftKey && event.key.startsWith("Arrow") || "+=-r".includes(event.key)) { if (cameraKey(event.key)) event.preventDefault(); return; }
  if (KEYS[event.key]) { event.preventDefault(); KEYS[event.key](); }
}

function startClock() {
  document.addEventListener("keydown", onKey);
  $("play").onclick = () => source.play(!state.playing);
  $("first").onclick = () => source.seek(state.group.start);
  $("back").onclick = () => source.step(-1);
  $("next").onclick = () => source.step(1);
  $("theme").onclick = () => dress(!state.dark);
  $("trails").onchange = refresh;
  $("when").oninput = () => { source.play(false); source.seek($("when").valueAsNumber); };
  $("speed").append(...SPEEDS.map((s, k) => { const option = element("option", s + "×"); option.value = k; return option; }));
  $("speed").onchange = () => { state.speed = SPEEDS[$("speed").value]; source.speedChanged(); };
  setSpeed(1);
  addEventListener("resize", () => { if (state.group) { arrange(); refresh(); } });
  const night = matchMedia("(prefers-color-scheme: dark)");
  night.addEventListener("change", () => dress(night.matches));
  dress(night.matches);
}
