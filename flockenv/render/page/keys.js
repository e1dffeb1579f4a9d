/* The start of the live page: tabs, keys, and what is done with each message. */

function openTab(name) {
  for (const tab of document.querySelectorAll("[role=tab]")) {
    const on = tab.id === "tab-" + name;
    tab.setAttribute("aria-selected", on); tab.tabIndex = on ? 0 : -1;
    $(tab.getAttribute("aria-controls")).hidden = !on;
  }
  live.tab = name;
}

function startTabs() {
  const tabs = [...document.querySelectorAll("[role=tab]")];
  tabs.forEach((tab, n) => {
    tab.onclick = () => openTab(tab.id.slice(4));
    tab.onkeydown = event => {
      const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!by) return;
      const next = tabs[(n + by + tabs.length) % tabs.length];
      event.preventDefault(); openTab(next.id.slice(4)); next.focus();
    };
  });
  openTab("rules");
}

const LIVE_KEYS = {
  g: () => openGallery($("gallery").hidden), s: () => saveOrStop(), l: () => live.ask({ type: "share", camera: cameraNumbers() }), "?": () => showKeys(),
  Escape: () => { if (!$("gallery").hidden && live.room) openGallery(false); else { choose(null, null); takeTool("choose"); } },
  "1": () => openTab("rules"), "2": () => openTab("values"), "3": () => openTab("agent"), "4": () => openTab("measures"), "5": () => openTab("compare"),
  n: () => nextAgent(1), p: () => nextAgent(-1),
};

function liveKey(event) {
  if (steeringKey(event, true)) return true;
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
  choose(lane, chosen.agent === null ? 0 : (chosen.agent + by + N) % N);
}

function showKeys() {
  const rows = [
    ["space", "play or pause"], ["← →", "one step back or on"], ["Home, End", "to the start, to the newest moment"], ["↑ ↓", "faster, slower"], ["+ − r", "zoom; the whole world"],
    ["Shift + arrows", "pan, or turn a world in 3-D"], ...Object.values(TOOLS).map(([key, title]) => [key, title]), ["n, p", "choose the next agent, the one before"],
    ["1 to 5", "Rules, Values, Agent, Measures, Compare"], ["W A S D, arrows, gamepad", "steer, where you are a player"], ["g", "all worlds"], ["s, l", "save; link to this moment"], ["d", "dark or light"], ["Esc", "put the tool down"],
    ["wheel, pinch", "zoom"], ["drag the ground", "pan, or turn in 3-D (with Shift: pan)"], ["double click", "the whole world"],
  ];
  const list = element("dl");
  for (const [key, text] of rows) { const term = element("dt"); term.append(element("kbd", key)); list.append(term, element("dd", text)); }
  openDialog("Keys and gestures", list);
}

/* The numbers of a camera, for a link. */
function cameraNumbers() { const { x, y, zoom, yaw, tilt, follow } = views[0].camera; return { x, y, zoom, yaw, tilt, ...(follow === null ? {} : { follow }) }; }

function takeCamera({ camera }) {
  if (!camera) return;
  for (const view of views) Object.assign(view.camera, camera);
  refresh();
}

/* A list under the time bar: what is drawn besides agents. */
function startDrawnList() {
  const colour = element("select"), field = element("select");
  colour.id = "colour"; field.id = "field"; colour.setAttribute("aria-label", "colour of agents"); field.setAttribute("aria-label", "field under agents");
  field.append(...["", "density", "flow"].map(name => { const option = element("option", name ? `field: ${name}` : "no field"); option.value = name; return option; }));
  colour.onchange = () => { live.want.colour = colour.value; live.lastFrame = 0; refresh(); };
  field.onchange = () => { live.want.field = field.value; live.lastFrame = 0; refresh(); };
  $("theme").before(colour, field);
}

function showColours(room) {
  const colour = $("colour"), now = live.want.colour;
  colour.replaceChildren(...["", ...(room.colours || [])].map(name => { const option = element("option", `colour: ${name.replace(/_/g, " ") || "role"}`); option.value = name; option.selected = name === now; return option; }));
}

/* Asks for what the open tab shows; called once per picture. */
function keepAsking() {
  if (!live.room || !$("gallery").hidden) return;
  readGamepad();
  if (chosen.agent !== null && (state.playing || performance.now() - chosen.askedAt > 400)) askLook();
  if (live.tab === "measures" && performance.now() - (keepAsking.last || 0) > 250) { keepAsking.last = performance.now(); live.ask({ type: "measures" }); }
}

function takeRoom(room) {
  $("gallery").hidden = true;
  if (chosen.agent !== null && (chosen.lane >= room.lanes.length || chosen.agent >= state.group.panels[chosen.lane].N)) choose(null, null);
  if (live.want.colour && !(room.colours || []).includes(live.want.colour)) live.want.colour = "";
  if (takeRoom.shown !== room.name) { takeRoom.shown = room.name; curves.clear(); choose(null, null); openTab("rules"); $("toast").className = "toast"; showHint(0); if (matchMedia("(prefers-reduced-motion: reduce)").matches && room.playing) live.play(false); }
  $("measures").dataset.names = "";
  const typing = document.activeElement && document.activeElement.closest("#rules .typing, #values input[type=text], #values input[type=number]");
  const dragging = document.querySelector(".value.dragging") || sending.timer || pressedSlider();
  if (!typing && !dragging) keepFocus(() => { showRules(room); showValues(room); showCompare(room); });
  showColours(room); showTools(room);
}

/* Does something that makes the controls anew; the value that had the keyboard has it afterwards. */
function keepFocus(act) {
  const node = document.activeElement, path = node && node.dataset.path, section = node && node.closest("[role=tabpanel]");
  act();
  const again = path && section && section.querySelector(`[data-path="${CSS.escape(path)}"]`);
  if (again) again.focus({ preventScroll: true });
}

/* True while a slider is being dragged: its row must not be made anew. */
function pressedSlider() { return Boolean(document.querySelector("#sheet input[type=range]:active")); }

function start() {
  makeTools(); startTabs(); startDrawnList(); showLook();
  $("worlds").onclick = () => openGallery(true);
  $("again").onclick = () => { const on = state.playing; source.seek(0); if (on) source.play(true); };
  $("seed").onchange = () => live.send({ type: "seed", seed: Math.max(0, Math.round($("seed").valueAsNumber) || 0) });
  $("save").onclick = saveOrStop;
  $("share").onclick = LIVE_KEYS.l;
  $("help").onclick = showKeys;
  $("open").onclick = () => { const on = $("sheet").classList.toggle("on"); $("open").setAttribute("aria-expanded", on); $("open").textContent = on ? "Close" : "Change"; };
  document.addEventListener("keyup", event => { steeringKey(event, false); });
  addEventListener("blur", () => { if (held.size) { held.clear(); steer([0, 0]); } });
  live.on("room", takeRoom);
  live.on("look", message => { if (message.agent === chosen.agent) { chosen.look = message; if (live.tab === "agent") showLook(); refresh(); } });
  live.on("measures", takeMeasures); live.on("costs", showCosts); live.on("gallery", showGallery);
  live.on("yaml", showYaml); live.on("link", showLink); live.on("camera", takeCamera); live.on("replay", takeReplay); live.on("record", showRecording);
  live.on("notice", ({ text, busy }) => { tell(text, false, busy); $("toast").dataset.busy = busy ? "1" : ""; });
  live.on("error", ({ text, about }) => {
    if (about === "look" || about === "frame") return; // the agent, or its world, is there no more
    tell(text, true);
    if (live.room) keepFocus(() => { showRules(live.room); showValues(live.room); });
  });
  live.on("welcome", ({ open }) => { if (!open) openGallery(true); });
  live.connect();
}

source = live;
state.group = { panels: [], start: 0, end: 1 };
startClock();
start();
