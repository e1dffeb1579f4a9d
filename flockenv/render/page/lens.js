/* Cameras and lenses: from metres to pixels. A camera pans, zooms, follows an agent, and turns a world in 3-D. */

function newCamera(D) { return { D, x: 0, y: 0, zoom: 1, yaw: 0, tilt: 0, follow: null }; }

function isMoved(camera) { return camera.zoom !== 1 || camera.x !== 0 || camera.y !== 0 || camera.yaw !== 0 || camera.tilt !== 0; }

/* Rows of the rotation: to the right, upwards, towards the eye. From above without yaw and tilt. */
function turned({ yaw, tilt }) {
  const c = Math.cos(yaw), s = Math.sin(yaw), ct = Math.cos(tilt), st = Math.sin(tilt);
  return [[c, s, 0], [-s * ct, c * ct, st], [s * st, -c * st, ct]];
}

/* How far a turned box reaches along a row, in m. */
function reachAlong(row, extent) { return row.reduce((sum, r, d) => sum + Math.abs(r) * (extent[d] || 0), 0); }

/* Metres to pixels for one panel on its canvas, and where something is seen again across a periodic edge. */
function lens(panel, canvas, camera) {
  const ratio = window.devicePixelRatio || 1, w = canvas.width, h = canvas.height, pad = 0.025 * Math.min(w, h);
  const low = panel.low, high = panel.high, extent = panel.extent, flat = panel.D < 3 || (!camera.yaw && !camera.tilt);
  const rows = turned(panel.D < 3 ? { yaw: 0, tilt: 0 } : camera);
  const m = camera.zoom * Math.min((w - 2 * pad) / reachAlong(rows[0], extent), (h - 2 * pad) / reachAlong(rows[1], extent));
  const middle = [0, 1, 2].map(d => d < panel.D ? (low[d] + high[d]) / 2 : 0);
  if (panel.D < 3) rows[0][2] = rows[1][2] = 0;
  const a = rows[0].map(r => r * m), b = rows[1].map(r => -r * m);
  const tx = w / 2 + camera.x * camera.zoom * w - a[0] * middle[0] - a[1] * middle[1] - a[2] * middle[2];
  const ty = h / 2 + camera.y * camera.zoom * h - b[0] * middle[0] - b[1] * middle[1] - b[2] * middle[2];
  const deep = reachAlong(rows[2], extent), c = rows[2].map(r => deep ? r / deep : 0);
  const tz = 0.5 - c[0] * middle[0] - c[1] * middle[1] - c[2] * middle[2];
  const left = a[0] * low[0] + tx, right = a[0] * high[0] + tx, top = b[1] * high[1] + ty, bottom = b[1] * low[1] + ty;
  const copies = (x, r, first, last) => !panel.periodic || !flat ? [x] : [x].concat(x - r < first ? [x + last - first] : [], x + r > last ? [x - last + first] : []);
  return {
    m, a, b, rows, tx, ty, flat, left, right, top, bottom, w, h, ratio, least: Math.max(data.reach * w, 6.5 * ratio) * clamp(camera.zoom, 1, 3),
    x: (x, y = 0, z = 0) => a[0] * x + a[1] * y + a[2] * z + tx,
    y: (x, y = 0, z = 0) => b[0] * x + b[1] * y + b[2] * z + ty,
    /* 0: the farthest corner from the eye, 1: the nearest; 1 everywhere in 2-D. */
    depth: (x, y, z) => panel.D < 3 ? 1 : clamp(c[0] * x + c[1] * y + c[2] * z + tz, 0, 1),
    /* The direction on the canvas, in rad anticlockwise, of a heading in the x-y plane. */
    angle: aim => flat ? aim : Math.atan2(-(b[0] * Math.cos(aim) + b[1] * Math.sin(aim)), a[0] * Math.cos(aim) + a[1] * Math.sin(aim)),
    sightings: (x, y, r) => copies(x, r, left, right).flatMap(p => copies(y, r, top, bottom).map(q => [p, q])),
    /* The point under a pixel, (D,) m: in 3-D on the plane through another point, or the middle, that faces the reader. */
    under: (px, py, through = middle) => {
      const right = px - (a[0] * through[0] + a[1] * through[1] + a[2] * through[2] + tx), down = py - (b[0] * through[0] + b[1] * through[1] + b[2] * through[2] + ty);
      return through.slice(0, panel.D).map((c, d) => c + (rows[0][d] * right - rows[1][d] * down) / m);
    },
  };
}

/* Zooms so that the point under the pixel stays there; a little below 1 returns to the whole world. */
function zoomAt(camera, canvas, px, py, factor) {
  const zoom = clamp(camera.zoom * factor, 0.5, 80), less = 1 / zoom - 1 / camera.zoom;
  camera.x += (px / canvas.width - 0.5) * less;
  camera.y += (py / canvas.height - 0.5) * less;
  camera.zoom = zoom;
}
