/* The tab "Rules": the world as sentences whose values can be changed, and rules that can be added; of a task, its players. */

function showRules(room) {
  const box = $("rules"), task = room.kind === "task";
  $("tab-rules").textContent = task ? "Players" : "Rules";
  $("tab-compare").hidden = task;
  if (task && live.tab === "compare") openTab("rules");
  if (task) { box.replaceChildren(element("p", room.about, "lead"), ...comparePlayers(room), ...disturbances(room)); return; }
  if (!room.sentences.length) { box.replaceChildren(element("p", "This world has no rules in words. Its numbers are under Values.", "empty")); return; }
  const lead = element("p", `${room.about} Drag a blue value sideways, or click it to type.`.trim(), "lead"), part = each => each.path.split("[")[0];
  const lines = (...parts) => parts.flatMap(name => room.sentences.filter(each => part(each) === name)).map(sentenceLine);
  box.replaceChildren(
    lead, ...lines("groups", "effects", "obstacles", "population"), adder(),
    heading("Space, time and method"), ...lines("space", "", "integrator", "constraints"),
  );
}

function sentenceLine(sentence) {
  const line = element("p", undefined, "sentence");
  for (const part of sentence.parts) line.append(part.path === null ? raised(part.text) : valueInWords(controlAt(part.path) || controlOfPart(part), part.unit));
  if (sentence.removable) {
    const button = element("button", "×", "remove");
    button.title = "remove"; button.setAttribute("aria-label", `remove: ${line.textContent}`);
    button.onclick = once(button, () => live.edit({ kind: "remove", path: sentence.path })); // a second click would remove the next one
    line.append(button);
  }
  return line;
}

/* The control of a value that is not in the list of all values, such as a number within a long list. */
function controlOfPart(part) {
  const x = Number(part.text), step = part.path.split(".").pop().replace(/\[\d+\]$/, ""), isNumeric = part.text !== "" && Number.isFinite(x);
  const value = isNumeric ? x : { yes: true, no: false, none: null }[part.text] === undefined ? part.text : { yes: true, no: false, none: null }[part.text];
  return { path: part.path, title: step.replace(/_/g, " "), unit: part.unit, description: "", kind: isNumeric ? "number" : typeof value === "boolean" ? "switch" : "text", low: null, high: null, choices: [], value, restarts: null };
}

/* The button that shows which effects this world, as it is now, can have besides its own. */
function adder() {
  const box = element("div"), button = element("button", "+ add a rule", "add"), list = element("div", undefined, "choices");
  const offer = message => {
    const choices = message.additions.map(addition => choiceOf(addition, list));
    list.removeAttribute("aria-busy");
    list.replaceChildren(findField("find a rule", choices), ...choices);
    box.scrollIntoView({ block: "start" });
  };
  list.hidden = true;
  button.setAttribute("aria-expanded", "false");
  button.onclick = () => {
    list.hidden = !list.hidden; button.setAttribute("aria-expanded", !list.hidden);
    if (!list.hidden) { list.replaceChildren(element("p", "Finding the rules that this world can have …", "empty")); live.ask({ type: "additions" }); }
  };
  live.listeners.additions = [offer];
  box.append(button, list);
  return box;
}

/* An action that is not done again while its answer is awaited: then its node is made anew. */
function once(node, act) { return () => { if (node.ariaBusy) return; node.ariaBusy = "true"; act(); }; }

function choiceOf(addition, list) {
  const choice = element("button", addition.title);
  choice.append(element("small", addition.description));
  choice.onclick = once(list, () => live.edit({ kind: "add", path: addition.path, value: addition.value }));
  return choice;
}
