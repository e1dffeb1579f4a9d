/* Values that can be dragged, typed or chosen; one piece for sentences and for the list of all values.

control: see flockenv/play/controls.py; kind is number, integer, choice, switch, text, or variant (the kind of a record). */

function controlAt(path) { return live.room.controls.find(c => c.path === path); }

function shortNumber(x) { return typeof x !== "number" ? String(x) : Number.isInteger(x) ? String(x).replace("-", "−") : String(Number(x.toPrecision(4))).replace("-", "−"); }

function valueText(control) {
  const { value } = control;
  if (value === null || value === undefined) return "none";
  if (Array.isArray(value)) return value.map(shortNumber).join(" × ");
  return typeof value === "number" ? shortNumber(value) : typeof value === "boolean" ? (value ? "yes" : "no") : String(value);
}

/* What a drag by some pixels makes of a number: along its range if it has one, else by a share of its size. */
function draggedValue(control, from, pixels) {
  const { low, high } = control, bounded = isNumber(low) && isNumber(high) && high - low < 1e4;
  let x;
  if (control.kind === "integer") x = from + Math.trunc(pixels / 6) * Math.max(1, Math.round(Math.abs(from) / 40));
  else if (bounded && !(from > 0 && low >= 0 && from < (high - low) / 20)) x = from + pixels / 300 * (high - low);
  else x = from === 0 ? pixels / 100 : from * Math.exp(pixels / 120);
  return rounded(control, x);
}

function isNumber(x) { return typeof x === "number" && Number.isFinite(x); }

function rounded(control, x) {
  const value = clamp(x, isNumber(control.low) ? control.low : -Infinity, isNumber(control.high) ? control.high : Infinity);
  return control.kind === "integer" ? Math.round(value) : Number(value.toPrecision(3));
}

/* A field that hides all nodes without the word that is typed; found: is called after each change of the word. */
function findField(label, nodes, textOf = node => node.textContent, found = () => {}) {
  const field = element("input", undefined, "find");
  field.type = "text"; field.placeholder = label; field.setAttribute("aria-label", label);
  field.oninput = () => {
    const word = field.value.trim().toLowerCase();
    for (const node of nodes) node.hidden = !textOf(node).toLowerCase().includes(word);
    found(word);
  };
  return field;
}

const sending = { path: null, timer: 0, value: null };

/* Sends a value: at once, or every 40 ms while it is dragged; one that restarts only when the pointer is released. */
function setValue(control, value, dragging = false) {
  control.value = value;
  if (dragging && control.restarts) return;
  if (!dragging) { clearTimeout(sending.timer); sending.timer = 0; live.set(control.path, control.kind === "variant" ? { kind: value } : value); live.lastFrame = 0; return; }
  sending.path = control.path; sending.value = value;
  if (sending.timer) return;
  live.set(control.path, value); live.lastFrame = 0;
  sending.timer = setTimeout(() => { sending.timer = 0; if (sending.value !== value) live.set(sending.path, sending.value); }, 40);
}

function explained(control) {
  return [control.title, control.description, isNumber(control.low) || isNumber(control.high) ? `from ${isNumber(control.low) ? shortNumber(control.low) : "−∞"} to ${isNumber(control.high) ? shortNumber(control.high) : "∞"} ${control.unit || ""}` : "", control.restarts === null || control.restarts === undefined ? "" : control.restarts ? "begins again at time 0" : "acts at once"].filter(Boolean).join("\n");
}

/* Exponents of units, such as m/s^2, as they are printed. */
function raised(text) { return text.replace(/\^2/g, "²").replace(/\^3/g, "³"); }

function withUnit(control, unit) { return valueText(control) + (!unit || unit === "1" ? "" : unit === "degrees" ? "°" : ` ${raised(unit)}`); }

/* The name of a value for a reader who does not see what is around it, such as "weight, effect 1: separation". */
function spokenName(control) {
  const owner = live.room.titles[control.path.includes(".") ? control.path.slice(0, control.path.lastIndexOf(".")) : ""];
  return owner ? `${control.title}, ${owner}` : control.title;
}

/* A value within a line of words. */
function valueInWords(control, unit) {
  if (control.kind === "choice" || control.kind === "variant") return choiceInWords(control);
  if (control.kind === "switch") return buttonValue(control, unit, () => setValue(control, !control.value));
  if (control.kind !== "number" && control.kind !== "integer") return buttonValue(control, unit, node => typeValue(node, control, unit));
  const node = element("span", withUnit(control, unit), "value");
  node.tabIndex = 0; node.title = explained(control); node.dataset.path = control.path;
  node.setAttribute("role", "spinbutton"); node.setAttribute("aria-label", spokenName(control));
  if (isNumber(control.low)) node.setAttribute("aria-valuemin", control.low);
  if (isNumber(control.high)) node.setAttribute("aria-valuemax", control.high);
  const show = () => { node.textContent = withUnit(control, unit); node.setAttribute("aria-valuenow", isNumber(control.value) ? control.value : 0); node.setAttribute("aria-valuetext", node.textContent); };
  show();
  let from = null;
  node.onpointerdown = event => { from = { x: event.clientX, value: isNumber(control.value) ? control.value : 1, moved: false }; node.setPointerCapture(event.pointerId); event.preventDefault(); node.focus(); };
  node.onpointermove = event => {
    if (!from || Math.abs(event.clientX - from.x) < 3 && !from.moved) return;
    from.moved = true; node.classList.add("dragging");
    setValue(control, draggedValue(control, from.value, event.clientX - from.x), true); show();
  };
  node.onpointerup = () => { if (!from) return; const { moved } = from; from = null; node.classList.remove("dragging"); if (moved) { setValue(control, control.value); node.blur(); } else typeValue(node, control, unit); };
  node.onpointercancel = () => { from = null; node.classList.remove("dragging"); };
  node.onkeydown = event => {
    const by = { ArrowUp: 12, ArrowRight: 12, ArrowDown: -12, ArrowLeft: -12, PageUp: 60, PageDown: -60 }[event.key];
    if (by) { event.preventDefault(); setValue(control, draggedValue(control, isNumber(control.value) ? control.value : 1, by)); show(); }
    if (event.key === "Enter") { event.preventDefault(); typeValue(node, control, unit); }
  };
  return node;
}

function buttonValue(control, unit, act) {
  const node = element("button", withUnit(control, unit), "value choice");
  node.title = explained(control); node.dataset.path = control.path;
  node.onclick = () => act(node);
  return node;
}

function choiceInWords(control) {
  const node = selectOf(control);
  node.className = "value choice";
  return node;
}

function selectOf(control) {
  const node = element("select");
  node.title = explained(control); node.setAttribute("aria-label", spokenName(control)); node.dataset.path = control.path;
  node.append(...control.choices.map(choice => { const option = element("option", String(choice)); option.selected = choice === control.value; return option; }));
  node.onchange = () => setValue(control, control.choices[node.selectedIndex]);
  return node;
}

/* Reads what was typed: a number, perhaps with its unit, several numbers, or a word; null for nothing. What cannot be read is undefined, and a line says so. */
function parsed(control, text) {
  const clean = text.trim().replace(/−/g, "-"), refuse = () => { tell(`${control.title} = ${text.trim() || "nothing"}: must be ${control.kind === "integer" ? "an integer" : "a number"}`, true); };
  if (clean === "" || clean === "none") return control.optional || control.kind === "text" ? null : refuse();
  if (control.kind === "number" || control.kind === "integer") { const x = Number(withoutUnit(clean, control.unit)); return Number.isFinite(x) ? x : refuse(); }
  try { return JSON.parse(clean); } catch { const many = clean.split(/[\s,×]+/).map(Number); return Array.isArray(control.value) && many.every(Number.isFinite) ? many : clean; }
}

function withoutUnit(text, unit) {
  const ends = [unit, raised(unit || ""), unit === "degrees" ? "°" : ""].filter(end => end && end !== "1" && text.endsWith(end));
  return ends.length ? text.slice(0, -ends[0].length).trim() || "?" : text;
}

function typeValue(node, control, unit) {
  const input = element("input", undefined, "value typing");
  input.type = "text"; input.value = Array.isArray(control.value) || control.value && typeof control.value === "object" ? JSON.stringify(control.value) : control.value === null ? "" : String(control.value);
  input.setAttribute("aria-label", spokenName(control));
  const close = keep => {
    input.onblur = null;
    const value = keep ? parsed(control, input.value) : undefined;
    if (input.parentNode) input.replaceWith(node);
    if (value !== undefined && JSON.stringify(value) !== JSON.stringify(control.value)) { setValue(control, value); node.textContent = withUnit(control, unit); }
    node.focus();
  };
  input.onkeydown = event => { event.stopPropagation(); if (event.key === "Enter") close(true); if (event.key === "Escape") close(false); };
  input.onblur = () => close(true);
  node.replaceWith(input); input.focus(); input.select();
}
