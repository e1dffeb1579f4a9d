/* The start of the live page: tabs, lists under the time bar, and what is done with each message of the server. */

function openTab(name) {
  if ($("tab-" + name).hidden) return;
  for (const tab of document.querySelectorAll("[role=tab]")) {
    const on = tab.id === "tab-" + name;
    tab.setAttribute("aria-selected", on); tab.tabIndex = on ? 0 : -1;
    $(tab.getAttribute("aria-controls")).hidden = !on;
  }
  live.tab = name;
}

function startTabs() {
  const tabs = [...document.querySelectorAll("[role=tab]")];
  tabs.forEach(tab => {
    tab.onclick = () => openTab(tab.id.slice(4));
    tab.onkeydown = event => {
      const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!by) return;
      const open = tabs.filter(each => !each.hidden), next = open[(open.indexOf(tab) + by + open.length) % open.length];
      event.preventDefault(); openTab(next.id.slice(4)); next.focus();
    };
  });
  openTab("rules");
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
  colour.replaceChildren(...["", ...room.colours].map(name => { const option = element("option", `colour: ${name.replace(/_/g, " ") || "role"}`); option.value = name; option.selected = name === now; return option; }));
}

/* Asks for what the open tab shows; called once per picture. */
function keepAsking() {
  if (!live.room || !$("gallery").hidden) return;
  readGamepad();
  if (chosen.agent !== null && (state.playing || performance.now() - chosen.askedAt > 400)) askLook();
  if (live.tab === "measures" && performance.now() - (keepAsking.last || 0) > 250) { keepAsking.last = performance.now(); live.ask({ type: "measures" }); }
}

/* What is left of another world is put away; with a wish for less motion the new one begins at rest. */
function enter(room) {
  showRoom.shown = room.name;
  live.want = { colour: "", field: "" }; $("field").value = "";
  curves.clear(); choose(null, null); openTab("rules"); tell(""); showHint(0);
  if (matchMedia("(prefers-reduced-motion: reduce)").matches && room.playing) live.play(false);
}

/* Shows a message about the room beside the worlds: controls, tools, lists. */
function showRoom(room) {
  if ($("saved") && $("saved").textContent === "Loading …") $("dialog").close();
  if (live.opening || showRoom.shown !== room.name) { live.opening = false; openGallery(false); } // another page may change the world that a gallery covers
  if (showRoom.shown !== room.name) enter(room);
  if (chosen.agent !== null && (chosen.lane >= room.lanes.length || chosen.agent >= state.group.panels[chosen.lane].N)) choose(null, null);
  if (live.want.colour && !room.colours.includes(live.want.colour)) live.want.colour = "";
  $("measures").dataset.names = "";
  const typing = document.activeElement && document.activeElement.closest("#rules .typing, #values input[type=text], #values input[type=number]");
  const dragging = document.querySelector(".value.dragging") || sending.timer || pressedSlider();
  if (!typing && !dragging) keepFocus(() => { showRules(room); showValues(room); showCompare(room); });
  showColours(room); showTools(room);
}

/* Does something that makes the controls anew; the value that had the keyboard has it afterwards, or else the first button of its tab. */
function keepFocus(act) {
  const node = document.activeElement, path = node && node.dataset.path, section = node && node.closest("[role=tabpanel]");
  act();
  if (!section || node.isConnected) return;
  const again = path && section.querySelector(`[data-path="${CSS.escape(path)}"]`) || section.querySelector(".add") || section.querySelector("select, button, input");
  if (again) again.focus({ preventScroll: true });
}

/* True while a slider is being dragged: its row must not be made anew. */
function pressedSlider() { return Boolean(document.querySelector("#sheet input[type=range]:active")); }

/* Begins again with the seed that was typed, if it is one. */
function readSeed() {
  const field = $("seed"), seed = field.valueAsNumber;
  if (Number.isSafeInteger(seed) && seed >= 0) { live.send({ type: "seed", seed }); return; }
  tell(`seed = ${field.value || "nothing"}: must be an integer from 0 to ${Number.MAX_SAFE_INTEGER}`, true);
  if (live.room) field.value = live.room.seed;
}

/* On a small screen the seed and the switch of trails are in the sheet. */
function startMore() {
  const small = matchMedia("(max-width: 900px)"), seed = document.querySelector(".seed"), trails = $("trails").parentElement;
  const place = () => { if (small.matches) $("more").append(seed, trails); else { $("again").before(seed); $("colour").before(trails); } };
  small.addEventListener("change", place);
  place();
}

function start() {
  makeTools(); startTabs(); startDrawnList(); startMore(); showLook();
  $("worlds").onclick = () => openGallery(true);
  $("again").onclick = () => live.send({ type: "seed" });
  $("seed").onchange = readSeed;
  $("save").onclick = saveOrStop;
  $("share").onclick = LIVE_KEYS.l;
  $("help").onclick = showKeys;
  $("open").onclick = () => { const on = $("sheet").classList.toggle("on"); $("open").setAttribute("aria-expanded", on); $("open").textContent = on ? "Close" : "Change"; };
  document.addEventListener("keyup", event => { steeringKey(event, false); });
  addEventListener("blur", () => { if (pressed.size) { pressed.clear(); steer([0, 0]); } });
  live.on("room", showRoom);
  live.on("look", message => { if (message.agent === chosen.agent) { chosen.look = message; if (live.tab === "agent") showLook(); refresh(); } });
  live.on("measures", takeMeasures); live.on("costs", showCosts); live.on("gallery", showGallery);
  live.on("yaml", showYaml); live.on("link", showLink); live.on("camera", takeCamera); live.on("film", takeFilm); live.on("record", showRecording);
  live.on("notice", ({ text, busy }) => { tell(text, false, busy); $("toast").dataset.busy = busy ? "1" : ""; });
  live.on("error", ({ text, about }) => {
    if (about === "look" || about === "frame") return; // the agent, or its world, is there no more
    if (about === "open") live.opening = false;
    if (about === "load" && $("saved") && $("dialog").open) { $("saved").textContent = text; return; } // the text stays, to be mended
    if (about === "record") showRecording({ on: false }); // it ended, as another world was opened
    tell(text, true);
    if (live.room) keepFocus(() => { showRules(live.room); showValues(live.room); });
  });
  live.on("welcome", ({ open }) => { if (!open) { live.room = null; openGallery(true); } });
  live.connect();
}

source = live;
state.group = { panels: [], start: 0, end: 1 };
startClock();
start();
