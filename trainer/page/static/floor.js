//! A path on the floor as the input of a draw, made with mouse, finger or arrow keys.
//!
//! The floor is seen from above. The figure starts at the dot and faces up; x is to its left, z is ahead of it.

import { html, svg } from "./vendor/lit-html.js";

/** Metres on the floor. @typedef {[number, number]} Place */

/** Metres of the floor to each side, ahead and behind. */
const [SIDE, AHEAD, BEHIND] = [3, 5, 1];
/** Metres between two places of a pointer, and metres of an arrow key. */
const [APART, STEP] = [0.1, 0.5];
/** Places of a path beside its start. */
const MOST = 80;
/** Seconds between two positions, height of a standing figure's pelvis in metres, and speed without a length in metres a second. */
const [EVERY, HEIGHT, SPEED] = [0.25, 0.93, 1];
/** Shortest motion without a length in seconds. */
const SHORTEST = 2;

/** @type {Place} */
const START = [0, 0];

/** @param {Place} a @param {Place} b */
const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

/** Metres. @param {Place[]} path */
export const lengthOf = (path) => path.reduce((sum, place, at) => sum + distance(path[at - 1] ?? START, place), 0);

/** Positions of the pelvis, as seconds and x, y, z in metres, at one speed. @param {Place[]} path @param {number | undefined} seconds @returns {[number, number, number, number][]} */
export function positions(path, seconds) {
  const length = lengthOf(path);
  if (length === 0) return [];
  const time = seconds ?? Math.max(SHORTEST, length / SPEED);
  // The last position is before the end, because the last frame is.
  const steps = Math.max(1, Math.floor((time - 0.05) / EVERY));
  let [at, passed] = [0, 0];
  return Array.from({ length: steps + 1 }, (_, step) => {
    const wanted = (length * step) / steps;
    for (;;) {
      const [from, to] = [path[at - 1] ?? START, path[at] ?? START];
      const part = distance(from, to);
      if (wanted > passed + part && at < path.length - 1) {
        passed += part;
        at += 1;
        continue;
      }
      const share = part === 0 ? 0 : Math.min(1, (wanted - passed) / part);
      const place = (/** @type {0 | 1} */ axis) => Number((from[axis] + (to[axis] - from[axis]) * share).toFixed(3));
      return [Number((step * EVERY).toFixed(2)), place(0), HEIGHT, place(1)];
    }
  });
}

/** @param {Place[]} path */
export const toText = (path) => path.map(([x, z]) => `${Number(x.toFixed(2))},${Number(z.toFixed(2))}`).join(" ");

/** The path of an address; what is no place is left out. @param {string} text @returns {Place[]} */
export const fromText = (text) => text.split(" ").slice(0, MOST).flatMap((word) => {
  const [x, z, more] = word.split(",").map(Number);
  return word !== "" && x !== undefined && z !== undefined && more === undefined && Number.isFinite(x) && Number.isFinite(z) ? [inside([x, z])] : [];
});

/** @param {Place} place @returns {Place} */
const inside = ([x, z]) => [Math.min(SIDE, Math.max(-SIDE, x)), Math.min(AHEAD, Math.max(-BEHIND, z))];

/** A change of the path as it is now, which may be newer than the one that is drawn. @typedef {(path: Place[]) => Place[]} Change */

/** @param {Place[]} path */
const endOf = (path) => path[path.length - 1] ?? START;

/** The floor with a path. @param {Place[]} path @param {(change: Change) => void} walk */
export function floor(path, walk) {
  /** @param {PointerEvent} event @returns {Place} */
  const under = (event) => {
    const box = /** @type {Element} */ (event.currentTarget).getBoundingClientRect();
    const [right, down] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    return inside([SIDE - 2 * SIDE * right, AHEAD - (AHEAD + BEHIND) * down]);
  };
  /** @param {PointerEvent} event */
  const begin = (event) => {
    /** @type {Element} */ (event.currentTarget).setPointerCapture(event.pointerId);
    const place = under(event);
    walk(() => [place]);
  };
  /** @param {PointerEvent} event */
  const move = (event) => {
    const held = /** @type {Element} */ (event.currentTarget).hasPointerCapture(event.pointerId);
    const place = under(event);
    if (held) walk((path) => (path.length < MOST && distance(endOf(path), place) >= APART ? [...path, place] : path));
  };
  /** @param {KeyboardEvent} event */
  const press = (event) => {
    /** @type {Record<string, Place>} */
    const arrows = { ArrowUp: [0, STEP], ArrowDown: [0, -STEP], ArrowLeft: [STEP, 0], ArrowRight: [-STEP, 0] };
    const arrow = arrows[event.key];
    if (arrow) walk((path) => (path.length < MOST ? [...path, inside([endOf(path)[0] + arrow[0], endOf(path)[1] + arrow[1]])] : path));
    else if (event.key === "Backspace" || event.key === "Delete") walk((path) => path.slice(0, -1));
    else return;
    event.preventDefault();
  };
  const lines = [];
  for (let v = -SIDE; v <= SIDE; v += 1) lines.push(svg`<line x1=${v} x2=${v} y1=${-AHEAD} y2=${BEHIND}></line>`);
  for (let v = -AHEAD; v <= BEHIND; v += 1) lines.push(svg`<line x1=${-SIDE} x2=${SIDE} y1=${v} y2=${v}></line>`);
  const end = endOf(path);
  const drawn = [START, ...path].map(([x, z]) => `${-x},${-z}`).join(" ");
  const says = path.length === 0 ? "no path" : `a path of ${lengthOf(path).toFixed(1)} m`;
  return html`<svg class="floor" viewBox=${`${-SIDE} ${-AHEAD} ${2 * SIDE} ${AHEAD + BEHIND}`} tabindex="0" role="img"
    aria-label=${`The floor from above with ${says}. Arrow keys lengthen the path by half a metre, Backspace shortens it.`}
    @pointerdown=${begin} @pointermove=${move} @keydown=${press}>
    ${svg`<g class="cells">${lines}</g><polyline class="trace" points=${drawn}></polyline><circle class="begins" r="0.12"></circle><path class="faces" d="M-.1-.2 0-.42 .1-.2Z"></path>${path.length > 0 ? svg`<circle class="ends" cx=${-end[0]} cy=${-end[1]} r="0.09"></circle>` : ""}`}</svg>`;
}
