/* The tab "Rules": the world as sentences whose values can be changed; and the list of all values. */

function showRules(room) {
  const box = $("rules"), task = room.kind === "task";
  $("tab-rules").textContent = task ? "Players" : "Rules";
  $("tab-compare").hidden = task;
  if (task && live.tab === "compare") openTab("rules");
  if (task) { box.replaceChildren(element("p", room.about, "lead"), ...comparePlayers(room), ...disturbances(room)); return; }
  if (!room.sentences.length) { box.replaceChildren(element("p", "This world has no rules in words. Its numbers are under Values.", "empty")); return; }
  const lead = element("p", "Drag a blue value sideways, or click it to type.", "lead"), part = each => each.path.split("[")[0];
  const lines = (...parts) => parts.flatMap(name => room.sentences.filter(each => part(each) === name)).map(sentenceLine);
  box.replaceChildren(
    lead, ...lines("groups", "effects", "obstacles", "population"), adder(),
    heading("Space, time and method"), ...lines("space", "", "integrator", "constraints"),
  );
}

function sentenceLine(sentence) {
  const line = element("p", undefined, "sentence");
  for (const part of sentence.parts) line.append(part.path === null ? part.text : valueInWords(controlAt(part.path) || controlOfPart(part), part.unit));
  if (sentence.removable) {
    const button = element("button", "×", "remove");
    button.title = "take this rule out"; button.setAttribute("aria-label", "take this rule out");
    button.onclick = () => live.edit({ kind: "remove", path: sentence.path });
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
  list.hidden = true;
  button.setAttribute("aria-expanded", "false");
  button.onclick = () => {
    list.hidden = !list.hidden; button.setAttribute("aria-expanded", !list.hidden);
    if (!list.hidden) { list.replaceChildren(element("p", "Looking …", "empty")); live.ask({ type: "additions" }); }
  };
  live.listeners.additions = [message => list.replaceChildren(...message.additions.map(choiceOf))];
  box.append(button, list);
  return box;
}

function choiceOf(addition) {
  const choice = element("button", addition.title);
  choice.append(element("small", addition.description));
  choice.onclick = () => live.edit({ kind: "add", path: addition.path, value: addition.value });
  return choice;
}

/* The tab "Values": every value of the record, by the part that it belongs to. */
function showValues(room) {
  const open = new Set([...document.querySelectorAll("#values details[open]")].map(d => d.dataset.part)), parts = new Map();
  for (const control of room.controls) {
    const part = control.path.includes(".") ? control.path.slice(0, control.path.lastIndexOf(".")) : "";
    if (!parts.has(part)) parts.set(part, []);
    parts.get(part).push(control);
  }
  const search = element("input");
  search.type = "text"; search.placeholder = "find a value"; search.style.width = "100%"; search.id = "find"; search.setAttribute("aria-label", "find a value");
  const groups = [...parts].map(([part, controls]) => {
    const group = element("details"), head = element("summary", part ? partTitle(room, part) : "the world");
    group.dataset.part = part; group.open = open.has(part) || !part && !open.size;
    head.append(element("small", String(controls.length)));
    group.append(head, ...controls.map(controlRow));
    return group;
  });
  search.oninput = () => {
    const word = search.value.toLowerCase();
    for (const group of groups) {
      let any = false;
      for (const row of group.querySelectorAll(".control")) { const fits = row.textContent.toLowerCase().includes(word) || row.title.toLowerCase().includes(word) || group.textContent.toLowerCase().includes(word) && !word; row.hidden = !fits; any = any || fits; }
      group.hidden = !any; if (word) group.open = any;
    }
  };
  $("values").replaceChildren(search, ...groups);
}

/* A part's name: the first words of its sentence, or its path. */
function partTitle(room, part) {
  const sentence = room.sentences.find(each => each.path === part);
  const words = sentence ? sentence.parts.map(p => p.text).join("").split(/[,.;(]/)[0].trim() : "";
  if (words) return words.length > 46 ? words.slice(0, 44) + " …" : words;
  return part.replace(/_/g, " ").replace(/s?\[(\d+)\]/g, (_, n) => ` ${Number(n) + 1}`).replace(/\./g, ", ");
}

function controlRow(control) {
  const row = element("div", undefined, "control"), label = element("label", control.title), field = element("span", undefined, "field");
  row.title = explained(control);
  if (control.restarts) { const mark = element("span", "↺", "restarts"); mark.title = "begins again at time 0"; label.append(mark); }
  if (control.kind === "choice" || control.kind === "variant") field.append(selectOf(control));
  else if (control.kind === "switch") field.append(checkOf(control));
  else if (control.kind === "number" || control.kind === "integer") { row.append(label, field, ...numberInputs(control, field)); return row; }
  else { const input = textOf(control); field.append(input, control.unit || ""); }
  row.append(label, field);
  return row;
}

function checkOf(control) {
  const input = element("input");
  input.type = "checkbox"; input.checked = control.value; input.setAttribute("aria-label", control.title);
  input.onchange = () => setValue(control, input.checked);
  return input;
}

function textOf(control) {
  const input = element("input");
  input.type = "text"; input.value = control.value === null ? "" : typeof control.value === "object" ? JSON.stringify(control.value) : String(control.value); input.placeholder = "none";
  input.setAttribute("aria-label", control.title);
  input.onchange = () => setValue(control, parsed(control, input.value));
  return input;
}

/* A number's field, and a slider if its range is known or can be guessed from its value. */
function numberInputs(control, field) {
  const input = element("input"), low = isNumber(control.low) ? control.low : Math.min(0, 3 * (control.value || 0)), high = isNumber(control.high) ? control.high : Math.max(3 * Math.abs(control.value || 0), 1);
  input.type = "number"; input.step = control.kind === "integer" ? "1" : "any"; input.value = control.value === null ? "" : control.value; input.dataset.path = control.path;
  input.setAttribute("aria-label", control.title);
  field.append(input, control.unit || "");
  const slider = element("input");
  slider.type = "range"; slider.min = low; slider.max = high; slider.step = control.kind === "integer" ? "1" : "any"; slider.value = control.value === null ? low : control.value;
  slider.setAttribute("aria-label", `${control.title}, slider`);
  slider.oninput = () => { const value = rounded(control, slider.valueAsNumber); input.value = value; setValue(control, value, true); };
  slider.onchange = () => setValue(control, rounded(control, slider.valueAsNumber));
  input.onchange = () => { const value = parsed(control, input.value); if (value !== undefined) { slider.value = value; setValue(control, value); } };
  return [slider];
}
