"use strict";
/* What all pieces share: the page's data, its state, colours, and small functions. */
const data = JSON.parse(document.getElementById("data").textContent);
const $ = id => document.getElementById(id);
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8, 16], EPS = 1e-9;
const RESTING = data.directions, ABSENT = 255, NAMED = new Set(["pursuer", "evader", "learner", "learner 2"]);
const state = { group: null, time: 0, playing: false, speed: 1, dark: false, queued: false, dirty: false };
let paint = {}, roleColour = {}, views = [], source = null;

function element(tag, text, kind) {
  const node = document.createElement(tag);
  if (text !== undefined) node.textContent = text;
  if (kind) node.className = kind;
  return node;
}

/* An icon of one path, 16 by 16. */
function icon(path) {
  const svg = document.querySelector("svg").cloneNode(true);
  svg.querySelector("path").setAttribute("d", path);
  return svg;
}

function clamp(value, low, high) { return Math.min(high, Math.max(low, value)); }

function channels(colour) { return [0, 1, 2].map(n => parseInt(colour.slice(1 + 2 * n, 3 + 2 * n), 16)); }

/* A colour between two, as #rrggbb. */
function mix(over, under, share) {
  const a = channels(over), b = channels(under);
  return "#" + a.map((c, n) => Math.round(share * c + (1 - share) * b[n]).toString(16).padStart(2, "0")).join("");
}

/* A number with about four digits, a proper minus, and no exponent where none is needed. */
function number(r) {
  const size = Math.abs(r);
  if (r === 0) return "0";
  return (r < 0 ? "−" : "") + (size >= 1e5 || (size > 0 && size < 1e-3) ? size.toExponential(2) : size.toFixed(size >= 100 ? 1 : size >= 10 ? 2 : 3));
}

/* The last index of a sorted list that is not beyond t. */
function frameAt(times, t) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t + EPS) low = middle; else high = middle - 1;
  }
  return low;
}
