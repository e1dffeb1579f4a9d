/* Steering by a person: keys, a held pointer, or a gamepad; an action is sent only if it changes. */
const pressed = new Set();
let lastAction = "";

function yourAgent(panel) { const n = (panel.lane.players || []).indexOf("you"); return n < 0 ? null : n; }

function isYou(view) { return yourAgent(view.panel) !== null; }

/* Sends a direction in the world's axes, at most of length 1, as an action of the task; only if it changes. */
function steer([x, y]) {
  const view = views.find(isYou);
  if (!view) return;
  const action = live.room.action || { frame: "world", size: 2 }, agent = yourAgent(view.panel), frame = view.panel.frames[view.panel.frames.length - 1];
  const size = Math.max(1, Math.hypot(x, y)), aim = frame ? frame.aim[agent] : 0;
  let [u, v] = [x / size, y / size];
  if (action.frame === "heading" && !Number.isNaN(aim)) [u, v] = [u * Math.cos(aim) + v * Math.sin(aim), -u * Math.sin(aim) + v * Math.cos(aim)];
  const numbers = new Array(action.size).fill(0);
  numbers[0] = Math.round(u * 100) / 100; if (action.size > 1) numbers[1] = Math.round(v * 100) / 100;
  const text = numbers.join();
  if (text === lastAction) return;
  lastAction = text;
  live.edit({ kind: "input", action: numbers });
}

function steerTo(view, pixel) {
  const i = yourAgent(view.panel), p = placeOf(view.panel.bodies, i), dx = pixel[0] - view.eye.x(...p), dy = view.eye.y(...p) - pixel[1], far = Math.hypot(dx, dy);
  tool.toward = { view, pixel };
  steer(far < 6 ? [0, 0] : [dx / far, dy / far]);
}

const STEERING = { w: [0, 1], a: [-1, 0], s: [0, -1], d: [1, 0], ArrowUp: [0, 1], ArrowLeft: [-1, 0], ArrowDown: [0, -1], ArrowRight: [1, 0] };

function steerByKeys() {
  const sum = [0, 0];
  for (const key of pressed) { sum[0] += STEERING[key][0]; sum[1] += STEERING[key][1]; }
  steer(sum);
}

/* True if a key press steers; keys do so while a person has an agent and time runs. */
function steeringKey(event, down) {
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (!STEERING[key] || event.shiftKey || !views.some(isYou)) return false;
  if (down && !state.playing) return false;
  if (down) pressed.add(key); else pressed.delete(key);
  steerByKeys();
  return true;
}

/* The first gamepad's left stick, read once per picture. */
function readGamepad() {
  const pad = navigator.getGamepads && [...navigator.getGamepads()].find(Boolean);
  if (!pad || !views.some(isYou)) return;
  const [x, y] = pad.axes;
  if (Math.hypot(x, y) > 0.2) { readGamepad.on = true; steer([x, -y]); } else if (readGamepad.on) { readGamepad.on = false; steer([0, 0]); }
}
