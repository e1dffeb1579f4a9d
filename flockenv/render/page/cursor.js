/* A pointer for the keyboard: c shows it or puts it away, arrows move it, Enter presses and releases the tool in hand. */
const cursor = { view: null, at: [0, 0], pressed: false };

function showCursor(on) {
  if (cursor.pressed) useCursor("cancel");
  cursor.pressed = false;
  cursor.view = on ? views.find(view => view.canvas === document.activeElement) || views[0] : null;
  if (on) {
    const { canvas, eye, panel } = cursor.view, all = panel.bodies;
    cursor.at = [canvas.width / 2, canvas.height / 2];
    if (cursor.view.n === chosen.lane && eye && all) { const p = placeOf(all, chosen.agent); cursor.at = [eye.x(...p), eye.y(...p)]; }
    canvas.focus();
    tell("Arrows move the pointer; Enter presses and releases the tool; c hides the pointer.");
  }
  refresh();
}

function useCursor(kind, shiftKey = false) { return useTool(cursor.view, kind, { shiftKey }, cursor.at); }

/* Returns true if a key belongs to the pointer. */
function cursorKey(event) {
  if (event.key === "c") { showCursor(!cursor.view); return true; }
  if (!views.includes(cursor.view) || event.target.closest("button, summary")) return false;
  const { canvas } = cursor.view, step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  if (event.key === "Enter") {
    cursor.pressed = !cursor.pressed && useCursor("down", event.shiftKey);
    if (!cursor.pressed) useCursor("up", event.shiftKey);
  } else if (step) {
    const far = (event.repeat ? 16 : 8) * (window.devicePixelRatio || 1);
    cursor.at = [clamp(cursor.at[0] + far * step[0], 0, canvas.width), clamp(cursor.at[1] + far * step[1], 0, canvas.height)];
    useCursor(cursor.pressed ? "move" : "hover", event.shiftKey);
  } else return false;
  refresh();
  return true;
}

function drawCursor(pen, eye) {
  const [x, y] = cursor.at, r = 10 * eye.ratio;
  pen.strokeStyle = paint.ink; pen.lineWidth = (cursor.pressed ? 3 : 1.6) * eye.ratio; pen.lineCap = "round";
  disc(pen, x, y, cursor.pressed ? 0.6 * r : r);
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { pen.moveTo(x + 0.5 * r * dx, y + 0.5 * r * dy); pen.lineTo(x + 1.5 * r * dx, y + 1.5 * r * dy); }
  pen.stroke();
}
