/* Saving and sharing: YAML, a link to this moment, PNG, WebM, GIF, a replay in one file. */

function download(name, blob) {
  const link = element("a");
  link.href = URL.createObjectURL(blob); link.download = name;
  document.body.append(link); link.click(); link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

function fileName(suffix) { return `${live.room.name.replace(/[^\w-]+/g, "_") || "world"}${suffix}`; }

function openDialog(title, ...parts) {
  const box = $("dialog"), close = element("button", "Close"), row = element("div", undefined, "row");
  close.onclick = () => box.close();
  row.append(close);
  box.replaceChildren(element("h2", title), ...parts, row);
  if (!box.open) box.showModal();
  return row;
}

function showYaml({ text, note }) {
  const area = element("textarea", text);
  area.spellcheck = false; area.value = text; area.setAttribute("aria-label", "the record as YAML");
  const about = element("p", note, "lead");
  about.id = "saved"; about.setAttribute("role", "status");
  const row = openDialog("Save", about, area);
  const act = (name, run) => { const button = element("button", name); button.onclick = run; row.prepend(button); };
  act("Replay …", () => beginRecording("replay"));
  act("GIF …", () => beginRecording("gif"));
  act("WebM …", () => { $("dialog").close(); film(); });
  act("PNG", savePicture);
  act("Load this text", () => { about.textContent = live.send({ type: "load", yaml: area.value }) || "Loading …"; });
  act("YAML", () => download(fileName(".yaml"), new Blob([area.value], { type: "text/yaml" })));
}

/* All worlds of the stage on one canvas, side by side, on paper. */
function composed() {
  const out = element("canvas"), first = views[0].canvas;
  out.width = views.reduce((sum, v) => sum + v.canvas.width, 0); out.height = first.height;
  return out;
}

function compose(out) {
  const pen = out.getContext("2d");
  let x = 0;
  pen.fillStyle = paint.paper; pen.fillRect(0, 0, out.width, out.height);
  for (const { canvas } of views) { pen.drawImage(canvas, x, 0); x += canvas.width; }
}

function savePicture() {
  const out = composed();
  render(); compose(out);
  out.toBlob(blob => download(fileName(".png"), blob));
}

let filming = null;
/* Begins or ends a film of what is on the stage. */
function film() {
  if (filming) { filming.stop(); return; }
  const out = composed(), recorder = new MediaRecorder(out.captureStream(30), { videoBitsPerSecond: 6e6 }), chunks = [];
  const draw = () => { if (filming) { compose(out); requestAnimationFrame(draw); } };
  recorder.ondataavailable = event => chunks.push(event.data);
  recorder.onstop = () => { filming = null; $("save").textContent = "Save"; download(fileName(".webm"), new Blob(chunks, { type: "video/webm" })); };
  filming = recorder; recorder.start(); draw();
  $("save").textContent = "Stop filming";
  tell("Filming. Press “Stop filming” to save the film.");
}

async function showLink({ text }) {
  const hash = "#w=" + text;
  history.replaceState(null, "", location.pathname + location.search + hash);
  const whole = location.href;
  try { await navigator.clipboard.writeText(whole); tell("The link to this moment is copied."); } catch { tell("The link to this moment is in the address bar."); }
}

function saveOrStop() {
  if (filming) film();
  else if (live.recording) live.send({ type: "record", on: false, form: live.recording });
  else live.ask({ type: "save" });
}

/* The server records; form: what it makes of that when the recording stops, "replay" or "gif". */
function beginRecording(form) { $("dialog").close(); live.form = form; live.send({ type: "record", on: true }); }

function takeFilm({ form, html, data: text }) {
  if (form === "gif") download(fileName(".gif"), new Blob([Uint8Array.from(atob(text), c => c.charCodeAt(0))], { type: "image/gif" }));
  else download(fileName(".html"), new Blob([html], { type: "text/html" }));
}

function showRecording({ on, note }) {
  if (note) tell(note);
  live.recording = on ? live.form : null;
  $("save").textContent = on ? "Stop recording" : "Save";
  if (on) tell(`Recording. Press “Stop recording” to save it as ${live.form === "gif" ? "a GIF; worlds in 3-D are drawn from above" : "a replay in one file"}. It begins anew if time goes back or an agent is added or removed.`);
}
