/* Keys of the live page besides those of time (clock.js), the camera (pointer.js), steering and the pointer of the keyboard; and their list. */

const LIVE_KEYS = {
  g: () => openGallery($("gallery").hidden), s: () => saveOrStop(), l: () => live.ask({ type: "share", camera: cameraNumbers() }), "?": () => showKeys(),
  Escape: () => { if (!$("gallery").hidden && live.room) openGallery(false); else { if (cursor.view) showCursor(false); choose(null, null); takeTool("choose"); } },
  "1": () => openTab("rules"), "2": () => openTab("values"), "3": () => openTab("agent"), "4": () => openTab("measures"), "5": () => openTab("compare"),
  n: () => nextAgent(1), p: () => nextAgent(-1), PageUp: () => source.step(-10), PageDown: () => source.step(10),
};

function liveKey(event) {
  if (live.room && cursorKey(event) || steeringKey(event, true)) return true;
  if (!live.room && event.key !== "?") return false;
  const toolName = Object.keys(TOOLS).find(name => TOOLS[name][0] === event.key);
  if (toolName) { takeTool(toolName); return true; }
  if (!LIVE_KEYS[event.key]) return false;
  LIVE_KEYS[event.key]();
  return true;
}

/* Chooses the next agent, so that no pointer is needed. */
function nextAgent(by) {
  const lane = chosen.lane || 0, { N } = state.group.panels[lane];
  if (N) choose(lane, chosen.agent === null ? 0 : (chosen.agent + by + N) % N);
}

function showKeys() {
  const rows = [
    ["space", "play or pause"], ["← →", "one step back or on"], ["PgUp PgDn", "ten steps back or on"], ["Home, End", "to the start, to the newest moment"], ["↑ ↓", "faster, slower"], ["+ − r", "zoom; the whole world"],
    ["Shift + arrows", "pan, or turn a world in 3-D"], ...Object.values(TOOLS).map(([key, title]) => [key, title]), ["n, p", "select the next agent, the previous one"],
    ["c", "a pointer for the keyboard: arrows move it, Enter presses and releases the tool"],
    ["1 to 5", "Rules, Values, Agent, Measures, Compare"], ["W A S D, arrows, gamepad", "steer, where you are a player"], ["g", "all worlds"], ["s, l", "save; link to this moment (while you steer: the buttons)"], ["d", "dark or light"], ["Esc", "no agent selected, and the first tool again"],
    ["wheel, pinch", "zoom"], ["drag the ground", "pan, or turn in 3-D (with Shift: pan)"], ["double click", "the whole world"],
  ];
  const list = element("dl");
  for (const [key, text] of rows) { const term = element("dt"); term.append(element("kbd", key)); list.append(term, element("dd", text)); }
  openDialog("Keys and gestures", list);
}
