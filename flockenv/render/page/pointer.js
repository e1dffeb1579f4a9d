/* Camera by pointer and touch: the wheel or a pinch zooms, dragging pans, or turns a world in 3-D (with Shift it pans), a double click shows all. */
const pointers = new Map();

function pixelOf(canvas, event) {
  const box = canvas.getBoundingClientRect();
  return [(event.clientX - box.left) / box.width * canvas.width, (event.clientY - box.top) / box.height * canvas.height];
}

function resetCamera(view) { Object.assign(view.camera, newCamera(view.panel.D), view.home || {}); refresh(); }

function pan(view, dx, dy) {
  view.camera.follow = null;
  view.camera.x += dx / view.canvas.width / view.camera.zoom;
  view.camera.y += dy / view.canvas.height / view.camera.zoom;
}

function turn(view, dx, dy) {
  view.camera.yaw += 3 * dx / view.canvas.width;
  view.camera.tilt = clamp(view.camera.tilt - 3 * dy / view.canvas.height, 0, Math.PI);
}

/* What one finger scrolls: the stage, if it holds several worlds that are not all in sight; null if they are. */
function scrolledBy(view, event) {
  const stage = view.canvas.closest(".stage");
  return event.pointerType === "touch" && pointers.size === 1 && views.length > 1 && stage.scrollHeight > stage.clientHeight + 1 ? stage : null;
}

/* Moves the camera with one pointer or two; others: pointers by number, with their last pixel. */
function moveCamera(view, event, now, before) {
  if (pointers.size === 2) {
    const [, other] = [...pointers.entries()].find(([id]) => id !== event.pointerId);
    const far = Math.hypot(now[0] - other.at[0], now[1] - other.at[1]), was = Math.hypot(before[0] - other.at[0], before[1] - other.at[1]);
    zoomAt(view.camera, view.canvas, (now[0] + other.at[0]) / 2, (now[1] + other.at[1]) / 2, far / Math.max(was, 1));
    pan(view, (now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
  } else if (view.panel.D === 3 && !event.shiftKey) turn(view, now[0] - before[0], now[1] - before[1]);
  else pan(view, now[0] - before[0], now[1] - before[1]);
}

/* A second finger makes a pinch of what the first one began with a tool. */
function dropTools(take, event, at) {
  for (const held of pointers.values()) if (held.taken) { held.taken = false; take("cancel", event, at); }
}

/* Listens to a view's canvas. A tool of the live page may take a press for itself: view.tool(kind, event, pixel) -> true.
kind: hover, leave, and of a press down, move, up or cancel. */
function steerCamera(view) {
  const { canvas } = view, take = (kind, event, at) => view.tool ? view.tool(kind, event, at) : false;
  canvas.addEventListener("wheel", event => {
    if (!event.ctrlKey && document.documentElement.scrollHeight > innerHeight + 1) return; // the wheel scrolls the page
    event.preventDefault();
    zoomAt(view.camera, canvas, ...pixelOf(canvas, event), Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)));
    refresh();
  }, { passive: false });
  canvas.addEventListener("pointerdown", event => {
    const at = pixelOf(canvas, event), taken = pointers.size === 0 && event.button === 0 && take("down", event, at);
    if (pointers.size) dropTools(take, event, at);
    pointers.set(event.pointerId, { at, taken, y: event.clientY });
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", event => {
    const now = pixelOf(canvas, event), held = pointers.get(event.pointerId);
    if (!held) { take("hover", event, now); return; }
    const stage = held.taken ? null : scrolledBy(view, event);
    if (held.taken) take("move", event, now); else if (stage) stage.scrollTop += held.y - event.clientY; else moveCamera(view, event, now, held.at);
    Object.assign(held, { at: pixelOf(canvas, event), y: event.clientY });
    refresh();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, event => {
    const held = pointers.get(event.pointerId);
    pointers.delete(event.pointerId);
    if (held && held.taken) take(name === "pointerup" ? "up" : "cancel", event, pixelOf(canvas, event));
  });
  canvas.addEventListener("pointerleave", event => { if (!pointers.has(event.pointerId)) take("leave", event, pixelOf(canvas, event)); });
  canvas.addEventListener("dblclick", () => resetCamera(view));
}

/* The camera by keys: + and - zoom, 0 shows all, Shift and an arrow pan (2-D) or turn (3-D). */
function cameraKey(key) {
  const each = act => { views.forEach(act); refresh(); return true; };
  if (key === "+" || key === "=") return each(v => zoomAt(v.camera, v.canvas, v.canvas.width / 2, v.canvas.height / 2, 1.25));
  if (key === "-") return each(v => zoomAt(v.camera, v.canvas, v.canvas.width / 2, v.canvas.height / 2, 0.8));
  if (key === "r") return each(resetCamera);
  const step = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[key];
  return step ? each(v => (v.panel.D === 3 ? turn : pan)(v, 0.05 * step[0] * v.canvas.width, 0.05 * step[1] * v.canvas.height)) : false;
}
