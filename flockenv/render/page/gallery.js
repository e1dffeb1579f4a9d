/* The gallery of all worlds that ship, with pictures; and what to try in the one that is open. */

/* Shows or hides the gallery; what it covers takes no keyboard meanwhile. */
function openGallery(on) {
  if ($("gallery").hidden === !on) return;
  $("gallery").hidden = !on;
  for (const covered of document.querySelectorAll("header, .work > :not(.gallery, dialog, .toast), footer")) covered.inert = on;
  if (on) { live.ask({ type: "gallery" }); $("gallery").focus(); return; }
  if (views.length) views[0].canvas.focus({ preventScroll: true });
  live.lastFrame = 0; refresh();
}

function showGallery({ entries }) {
  const intro = element("div", undefined, "intro"), families = new Map();
  intro.append(element("small", "flockenv"), element("h2", "Pick a world"), element("p", "Change anything while it runs: rules, agents, obstacles, players. Stop time, go back, and try again."));
  for (const entry of entries) {
    const family = entry.family || (entry.kind === "task" ? "Tasks" : "Scenes");
    if (!families.has(family)) families.set(family, []);
    families.get(family).push(entry);
  }
  const parts = [...families].flatMap(([family, members]) => {
    const title = element("h3", family), cards = element("div", undefined, "cards");
    if (members[0].kind === "task") title.append(element("small", "hand-written rules, a trained policy and you can play them, side by side"));
    cards.append(...members.map(cardOf));
    return [title, cards];
  });
  const cards = parts.flatMap(part => [...part.querySelectorAll(".card")]);
  const find = findField("find a world", cards, card => card.textContent, () => {
    for (const group of parts.filter(part => part.matches(".cards"))) group.hidden = group.previousElementSibling.hidden = !group.querySelector(".card:not([hidden])");
  });
  $("gallery").replaceChildren(intro, find, ...parts);
}

function cardOf(entry) {
  const card = element("button", undefined, "card");
  if (entry.picture) {
    const image = element("img");
    image.src = entry.picture; image.alt = ""; image.loading = "lazy";
    card.append(image);
  } else card.append(element("div", "∴", "blank"));
  card.append(element("strong", entry.title), element("span", entry.description || ""));
  card.dataset.name = entry.name;
  card.title = entry.description || "";
  card.onclick = () => { live.opening = true; tell(`Opening ${entry.title} …`, false, true); live.send({ type: "open", what: entry.name }); };
  return card;
}

/* True on a small screen, where the sheet opens by a button. */
function isNarrow() { return $("open").offsetParent !== null; }

const HINTS = [
  [STEER, room => room.lanes.some(lane => (lane.players || []).includes("you"))],
  ["Try: drag a blue number in the rules sideways.", room => room.sentences.length && !isNarrow()],
  ["Try: press Change, then drag a blue number sideways.", room => room.sentences.length && isNarrow()],
  ["Try: click an agent to see the forces on it.", () => true],
  ["Try: drag an agent, or draw an obstacle (o).", room => room.kind === "scene"],
  ["Try: press ← to step back in time; it is exact.", () => !isNarrow()],
  ["Try: under Players, steer yourself, or put rules, ppo and yourself side by side.", room => room.kind === "task"],
  ["Try: drag the world to turn it, use the wheel to zoom.", room => room.lanes[0].low.length === 3],
  ["Try: let the agents seek the pointer (f) or flee from it (e).", room => room.kind === "scene"],
];

/* One hint after another, twelve seconds each, while no tool is in use. */
function showHint(n = 0) {
  clearTimeout(showHint.timer);
  if (tool.name !== "choose") return;
  const fits = live.room ? HINTS.filter(([, test]) => test(live.room)) : [];
  if (fits.length) $("hint").textContent = fits[n % fits.length][0];
  showHint.timer = setTimeout(showHint, 12000, n + 1);
}
