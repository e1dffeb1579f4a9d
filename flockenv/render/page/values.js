/* The tab "Values": every value of the record, by the part that it belongs to. */
function showValues(room) {
  const open = new Set([...document.querySelectorAll("#values details[open]")].map(d => d.dataset.part)), parts = new Map();
  for (const control of room.controls) {
    const part = control.path.includes(".") ? control.path.slice(0, control.path.lastIndexOf(".")) : "";
    if (!parts.has(part)) parts.set(part, []);
    parts.get(part).push(control);
  }
  const groups = [...parts].map(([part, controls]) => {
    const group = element("details"), head = element("summary", room.titles[part] || part);
    group.dataset.part = part; group.open = open.has(part) || !part && !open.size;
    head.append(element("small", String(controls.length)));
    group.append(head, ...controls.map(controlRow));
    return group;
  });
  const search = findField("find a value", groups.flatMap(group => [...group.querySelectorAll(".control")]), row => `${row.textContent} ${row.title}`, word => {
    for (const group of groups) { group.hidden = !group.querySelector(".control:not([hidden])"); if (word) group.open = !group.hidden; }
  });
  search.id = "find";
  $("values").replaceChildren(search, ...groups);
}

function controlRow(control) {
  const row = element("div", undefined, "control"), label = element("label", control.title), field = element("span", undefined, "field");
  row.title = explained(control);
  if (control.restarts) { const mark = element("span", "↺", "restarts"); mark.title = "begins again at time 0"; label.append(mark); }
  if (control.kind === "choice" || control.kind === "variant") field.append(selectOf(control));
  else if (control.kind === "switch") field.append(checkOf(control));
  else if (control.kind === "number" || control.kind === "integer") { row.append(label, field, ...numberInputs(control, field)); return row; }
  else { const input = textOf(control); field.append(input, raised(control.unit || "")); }
  row.append(label, field);
  return row;
}

function checkOf(control) {
  const input = element("input");
  input.type = "checkbox"; input.checked = control.value; input.setAttribute("aria-label", spokenName(control));
  input.onchange = () => setValue(control, input.checked);
  return input;
}

function textOf(control) {
  const input = element("input");
  input.type = "text"; input.value = control.value === null ? "" : typeof control.value === "object" ? JSON.stringify(control.value) : String(control.value); input.placeholder = "none";
  input.setAttribute("aria-label", spokenName(control));
  input.onchange = () => setValue(control, parsed(control, input.value));
  return input;
}

/* A number's field, and a slider if its range is known or can be guessed from its value. */
function numberInputs(control, field) {
  const input = element("input"), low = isNumber(control.low) ? control.low : Math.min(0, 3 * (control.value || 0)), high = isNumber(control.high) ? control.high : Math.max(3 * Math.abs(control.value || 0), 1);
  input.type = "number"; input.step = control.kind === "integer" ? "1" : "any"; input.value = control.value === null ? "" : control.value; input.dataset.path = control.path;
  input.setAttribute("aria-label", spokenName(control));
  field.append(input, raised(control.unit || ""));
  const slider = element("input");
  slider.type = "range"; slider.min = low; slider.max = high; slider.step = control.kind === "integer" ? "1" : "any"; slider.value = control.value === null ? low : control.value;
  slider.setAttribute("aria-label", `${spokenName(control)}, slider`);
  slider.oninput = () => { const value = rounded(control, slider.valueAsNumber); input.value = value; setValue(control, value, true); };
  slider.onchange = () => setValue(control, rounded(control, slider.valueAsNumber));
  input.onchange = () => {
    const value = parsed(control, input.value);
    if (value === undefined) { input.value = control.value === null ? "" : control.value; return; }
    slider.value = value; setValue(control, value);
  };
  return [slider];
}
