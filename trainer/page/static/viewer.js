//! Motions as figures on a floor, with one time line for all of them. The page mounts it in a view, and a file of `generate -o x.html`
//! has it inside.
//!
//! `mount` takes an element with a `canvas.figure` for each motion and a `.viewer-bar` for the controls, and fills both. Under each
//! figure a strip shows when its feet stand, when they slide and how far waypoints were missed. Positions are 16-bit numbers: a
//! coordinate is `origin + step * number` metres.

/** @typedef {{parents: number[], sides: string, head: number | null}} Body */
/** A waypoint is its frame, its joint and its place in metres. @typedef {[number, number, number, number, number]} Waypoint */
/** Measures of the exact motion: the share of steps in which a foot slides, and the mean jerk in m/s³. @typedef {{skating: number, jerk: number}} Measures */
/** @typedef {{body: number, fps: number, frames: number, step: number, origin: number[], joints: string, waypoints: Waypoint[], measures?: Measures}} Motion */
/** @typedef {{bodies: Body[], motions: Motion[]}} Motions */
/** @typedef {[number, number, number]} Point */
/** @typedef {{x: number, y: number, scale: number, depth: number}} Dot */
/** What `characters` gives: see character.js. @typedef {import("./character.js").Character} Character */
/** `live`: frames are appended, and the newest one is shown. @typedef {{whole?: boolean, live?: boolean, onTime?: (seconds: number) => void, characters?: () => Promise<{read: (bytes: ArrayBuffer) => Promise<Character>}>}} Options */
/** How figures are drawn; kept for the next figures of the page. @type {{body: string, character: Character | null}} */
const chosen = { body: "capsules", character: null };

const START = { yaw: -0.65, pitch: 0.26, zoom: 1 };
/** Seconds that the end is shown before the motion begins again. */
const PAUSE = 0.6;
/** A foot is down below this height in metres, and slides above this speed in metres a second, as in the metric `skating_ratio`. */
const [DOWN, SLIDES] = [0.05, 0.5];
/** Distances from a waypoint in metres that are near, and that are far. */
const [NEAR, FAR] = [0.05, 0.2];
const COLOURS = ["panel", "grid", "trail", "shadow", "body", "left", "right", "told", "stands", "slides"];
/** Radii in metres along a leg and an arm, from the trunk. */
const [LEG, ARM] = [[0.095, 0.085, 0.055, 0.04, 0.03], [0.075, 0.055, 0.042, 0.034, 0.028]];
/** Light across a capsule: place, and part of white or, below zero, of black. */
const LIGHT = /** @type {[number, number][]} */ ([[0, 0], [0.3, 0.34], [0.6, 0], [1, -0.38]]);
/** Frames of a stream that are kept. */
const LIVE = 600;
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];

const clamp = (/** @type {number} */ value, /** @type {number} */ low, /** @type {number} */ high) => Math.min(Math.max(value, low), high);

/** A colour `#rrggbb` nearer to white, or below zero to black. @param {string} colour @param {number} part */
function lit(colour, part) {
  const mixed = [1, 3, 5].map((at) => Math.round(parseInt(colour.slice(at, at + 2), 16) * (1 - Math.abs(part)) + (part > 0 ? 255 * part : 0)));
  return mixed.some(Number.isNaN) ? colour : `rgb(${mixed.join()})`;
}

/** Metres, `[frames, joints, 3]`. @param {Motion} motion */
export function decode(motion) {
  const bytes = Uint8Array.from(atob(motion.joints), (letter) => letter.charCodeAt(0));
  const numbers = new DataView(bytes.buffer);
  const joints = new Float32Array(bytes.length / 2);
  for (let i = 0; i < joints.length; i += 1) joints[i] = (motion.origin[i % 3] ?? 0) + motion.step * numbers.getInt16(2 * i, true);
  return joints;
}

/** The lowest joint without children on each side. @param {Body} body @param {Float32Array} joints @param {number} frames @returns {number[]} */
function feetOf(body, joints, frames) {
  const count = body.parents.length;
  const height = (/** @type {number} */ joint) => {
    let sum = 0;
    for (let t = 0; t < frames; t += 1) sum += joints[3 * (t * count + joint) + 1] ?? 0;
    return sum;
  };
  return ["l", "r"].flatMap((side) => {
    const ends = body.parents.map((_, joint) => joint).filter((joint) => body.sides[joint] === side && !body.parents.includes(joint));
    return ends.length === 0 ? [] : [ends.reduce((low, joint) => (height(joint) < height(low) ? joint : low))];
  });
}

/** Radii of each bone's ends in metres, for a height of 1.7 m: legs and arms grow thinner outwards. @param {Body} body @param {Float32Array} joints @param {number} frames @returns {[number, number][]} */
function radiiOf(body, joints, frames) {
  const dense = body.parents.length > 30 ? 0.7 : 1;
  const legs = new Set();
  for (const foot of feetOf(body, joints, frames)) for (let at = foot; body.sides[at] !== "m" && !legs.has(at); at = body.parents[at] ?? 0) legs.add(at);
  const deep = (/** @type {number} */ joint) => {
    let count = 0;
    for (let at = joint; body.sides[at] !== "m" && body.parents[at] !== at; at = body.parents[at] ?? 0) count += 1;
    return count;
  };
  return body.parents.map((_, joint) => {
    if (body.sides[joint] === "m") return joint === body.head ? [0.05 * dense, 0.05 * dense] : [0.115 * dense, 0.105 * dense];
    const thick = (/** @type {number} */ order) => dense * ((legs.has(joint) ? LEG : ARM)[Math.min(LEG.length - 1, order)] ?? 0);
    // The bone that leaves the trunk is as thick as the trunk's edge.
    return [thick(Math.max(0, deep(joint) - 1)), thick(deep(joint))];
  });
}

/** For each foot and step: 0 in the air, 1 on the ground, 2 sliding over it. @param {Body} body @param {Float32Array} joints @param {number} frames @param {number} fps @returns {Uint8Array[]} */
export function contacts(body, joints, frames, fps) {
  const count = body.parents.length;
  const steps = Math.max(0, frames - 1);
  return feetOf(body, joints, frames).map((foot) => {
    const at = (/** @type {number} */ t, /** @type {number} */ axis) => joints[3 * (t * count + foot) + axis] ?? 0;
    const speeds = Array.from({ length: steps }, (_, t) => Math.hypot(at(t + 1, 0) - at(t, 0), at(t + 1, 2) - at(t, 2)) * fps);
    return Uint8Array.from(speeds, (speed, t) => {
      if (at(t, 1) >= DOWN || at(t + 1, 1) >= DOWN) return 0;
      const mean = speeds.slice(Math.max(0, t - 2), t + 3).reduce((sum, one) => sum + one, 0) / 5;
      return speed > SLIDES && mean > SLIDES ? 2 : 1;
    });
  });
}

/** Places above the last bone of a neck, in parts of it. @param {Point[]} points @param {number} from @param {number} to */
const headOf = (points, from, to) => (/** @type {number} */ part) => /** @type {Point} */ ((points[to] ?? [0, 0, 0]).map((at, k) => at + part * (at - (points[from]?.[k] ?? 0))));

/** A motion with all that drawing it needs. @param {Motion} motion @param {Body} body @param {HTMLCanvasElement} canvas */
function prepare(motion, body, canvas) {
  const { frames, fps, waypoints } = motion;
  const joints = decode(motion);
  const count = body.parents.length;
  const width = 3 * count;
  const value = (/** @type {number} */ at) => joints[at] ?? 0;
  const low = [Infinity, Infinity];
  const high = [-Infinity, -Infinity];
  let [bottom, top, wide] = [Infinity, -Infinity, 0];
  for (let t = 0; t < frames; t += 1) {
    const root = t * width;
    [value(root), value(root + 2)].forEach((place, k) => {
      low[k] = Math.min(low[k] ?? 0, place);
      high[k] = Math.max(high[k] ?? 0, place);
    });
    for (let j = 0; j < count; j += 1) {
      const at = root + 3 * j;
      bottom = Math.min(bottom, value(at + 1));
      top = Math.max(top, value(at + 1));
      wide = Math.max(wide, Math.hypot(value(at) - value(root), value(at + 2) - value(root + 2)));
    }
  }
  // The camera's course: the root's, averaged over a second.
  const reach = Math.max(1, Math.round(fps / 2));
  /** @type {[number, number][]} */
  const course = [];
  for (let t = 0; t < frames; t += 1) {
    const [from, to] = [Math.max(0, t - reach), Math.min(frames - 1, t + reach)];
    let [x, z] = [0, 0];
    for (let s = from; s <= to; s += 1) {
      x += value(s * width);
      z += value(s * width + 2);
    }
    course.push([x / (to - from + 1), z / (to - from + 1)]);
  }
  const feet = contacts(body, joints, frames, fps);
  const slides = Array.from({ length: Math.max(0, frames - 1) }, (_, t) => feet.some((foot) => foot[t] === 2));
  const misses = waypoints.map(([frame, joint, x, y, z]) => {
    const at = 3 * (frame * count + joint);
    return Math.hypot(value(at) - x, value(at + 1) - y, value(at + 2) - z);
  });
  const strip = document.createElement("canvas");
  strip.className = "strip";
  strip.setAttribute("aria-hidden", "true");
  const measures = document.createElement("p");
  measures.className = "measures";
  const sliding = motion.measures?.skating ?? (slides.length === 0 ? 0 : slides.filter(Boolean).length / slides.length);
  const jerk = motion.measures ? ` · jerk ${motion.measures.jerk.toFixed(1)} m/s³` : "";
  const missed = misses.length === 0 ? "" : ` · waypoints missed by ${(100 * misses.reduce((sum, one) => sum + one, 0) / misses.length).toFixed(1)} cm in the mean`;
  if (feet.length > 0) measures.textContent = `feet slide in ${(100 * sliding).toFixed(1)} % of the steps${jerk}${missed}`;
  canvas.after(strip, measures);
  return {
    canvas, strip, measures, body, joints, count, width, course, feet, sliding, misses, fps, frames, waypoints,
    radii: radiiOf(body, joints, frames),
    bones: body.parents.map((parent, joint) => /** @type {[number, number]} */ ([parent, joint])).filter(([parent, joint]) => parent !== joint),
    height: clamp(top - Math.min(0, bottom), 1.2, 2.4),
    wide: clamp(wide, 0.3, 3),
    middle: /** @type {[number, number]} */ ([((low[0] ?? 0) + (high[0] ?? 0)) / 2, ((low[1] ?? 0) + (high[1] ?? 0)) / 2]),
    extent: Math.hypot((high[0] ?? 0) - (low[0] ?? 0), (high[1] ?? 0) - (low[1] ?? 0)),
    visible: true, dirty: true,
  };
}

/** @typedef {ReturnType<typeof prepare>} Panel */

/** The controls, made as elements so that no text becomes markup. @param {Element} bar @param {boolean} several @param {Options} options */
function controls(bar, several, options) {
  const ownCharacters = options.characters !== undefined;
  /** @template {keyof HTMLElementTagNameMap} K @param {K} tag @param {string} name @param {string} [text] @param {Record<string, string>} [more] @returns {HTMLElementTagNameMap[K]} */
  const make = (tag, name, text = "", more = {}) => {
    const element = document.createElement(tag);
    if (name) element.className = name;
    element.append(text);
    for (const [key, value] of Object.entries(more)) element.setAttribute(key, value);
    return element;
  };
  /** @param {string} text @param {HTMLElement} field */
  const labelled = (text, field) => {
    const label = make("label", "");
    label.append(...(field.tagName === "SELECT" ? [`${text} `, field] : [field, ` ${text}`]));
    return label;
  };
  const play = make("button", "play", "Play", { type: "button", "aria-keyshortcuts": "Space" });
  const time = make("input", "time", "", { type: "range", min: "0", max: "1", value: "0", step: "1", "aria-label": "Time" });
  const clock = make("output", "clock", "0.00 s");
  const speed = make("select", "speed");
  for (const value of SPEEDS) speed.append(make("option", "", String(value), value === 1 ? { selected: "" } : {}));
  const follow = make("input", "follow", "", { type: "checkbox", checked: "" });
  const over = make("input", "over", "", { type: "checkbox" });
  const from = make("button", "from", "Loop from here", { type: "button", "aria-keyshortcuts": "i" });
  const to = make("button", "to", "to here", { type: "button", "aria-keyshortcuts": "o" });
  const all = make("button", "all", "All of it", { type: "button", "aria-keyshortcuts": "u", hidden: "" });
  const reset = make("button", "reset", "Reset view", { type: "button", "aria-keyshortcuts": "0" });
  const body = make("select", "body");
  for (const value of ["capsules", "bones", ...(chosen.character && ownCharacters ? ["character"] : [])]) body.append(make("option", "", value, value === chosen.body ? { selected: "" } : {}));
  const file = make("input", "file", "", { type: "file", accept: ".glb,.vrm" });
  const character = make("label", "own", "Your character");
  character.title = "A GLB file with a skeleton. It stays in this browser.";
  character.append(file);
  const wrong = make("output", "wrong", "", { role: "alert", hidden: "" });
  const own = ownCharacters ? [character, wrong] : [];
  const overTime = options.live ? [] : [play, time, clock, from, to, all, labelled("Speed", speed)];
  bar.replaceChildren(...overTime, labelled("Follow", follow), ...(several ? [labelled("Over each other", over)] : []), labelled("Body", body), ...own, reset);
  return { play, time, clock, speed, follow, over, from, to, all, body, file, wrong, reset };
}

/** Shows motions in the figures of an element, until it is closed. @param {HTMLElement} root @param {Motions} motions @param {Options} [options] */
export function mount(root, motions, options = {}) {
  const ended = new AbortController();
  const { signal } = ended;
  const canvases = /** @type {HTMLCanvasElement[]} */ ([...root.querySelectorAll("canvas.figure")]);
  const panels = motions.motions.flatMap((motion, i) => {
    const [canvas, body] = [canvases[i], motions.bodies[motion.body]];
    return canvas && body ? [prepare(motion, body, canvas)] : [];
  });
  const fastest = Math.max(...panels.map((panel) => panel.fps));
  const duration = Math.max(...panels.map((panel) => (panel.frames - 1) / panel.fps));
  const bar = root.querySelector(".viewer-bar") ?? root.appendChild(document.createElement("div"));
  const ui = controls(bar, panels.length > 1, options);
  const view = { ...START };
  let [time, playing, speed, last, asked] = [0, false, 1, 0, false];
  let [begin, end] = [0, duration];
  if (options.live) for (const panel of panels) {
    panel.feet = [];
    panel.strip.remove();
    panel.measures.remove();
  }
  /** @type {Record<string, string>} */
  let colours = {};

  const readColours = () => {
    const style = getComputedStyle(root);
    colours = Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  };
  const stir = () => panels.forEach((panel) => { panel.dirty = true; });

  /** Where a figure is at `time`: between two frames their mixture, behind the last one that. @param {Panel} panel */
  const pose = (panel) => {
    const at = clamp(time * panel.fps, 0, panel.frames - 1);
    const frame = Math.floor(at + 1e-6);
    const next = Math.min(frame + 1, panel.frames - 1);
    const share = Math.max(0, at - frame);
    const mix = (/** @type {number | undefined} */ a, /** @type {number | undefined} */ b) => (a ?? 0) + ((b ?? 0) - (a ?? 0)) * share;
    /** @type {Point[]} */
    const points = [];
    for (let j = 0; j < panel.count; j += 1) {
      const [a, b] = [frame * panel.width + 3 * j, next * panel.width + 3 * j];
      points.push([mix(panel.joints[a], panel.joints[b]), mix(panel.joints[a + 1], panel.joints[b + 1]), mix(panel.joints[a + 2], panel.joints[b + 2])]);
    }
    const [here, there] = [panel.course[frame] ?? [0, 0], panel.course[next] ?? [0, 0]];
    return { points, frame, centre: /** @type {[number, number]} */ ([mix(here[0], there[0]), mix(here[1], there[1])]) };
  };

  /** A function from metres to pixels, the scale there, and how near it is. @param {Panel} panel @param {[number, number]} centre @param {[number, number]} size */
  const camera = (panel, centre, size) => {
    const follow = ui.follow.checked;
    const body = Math.max(1.3 * panel.height, 0.5 * panel.height + 1.8 * panel.wide);
    const span = follow ? body : Math.max(body, 0.9 * panel.height + 0.8 * panel.extent);
    const [x0, z0] = follow ? centre : panel.middle;
    const y0 = 0.5 * panel.height;
    const distance = 3 * span;
    const scale = (Math.min(size[0], size[1]) * view.zoom) / span;
    const [sin, cos, up, tip] = [Math.sin(view.yaw), Math.cos(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
    /** @param {Point} point @returns {Dot} */
    const project = ([x, y, z]) => {
      const [dx, dy, dz] = [x - x0, y - y0, z - z0];
      const [right, near] = [dx * cos - dz * sin, dx * sin + dz * cos];
      const depth = near * up + dy * tip;
      const local = (scale * distance) / Math.max(distance - depth, 0.05 * distance);
      return { x: size[0] / 2 + local * right, y: size[1] / 2 - local * (dy * up - near * tip), scale: local, depth };
    };
    /** @type {import("./character.js").Lens} */
    const lens = { at: [x0, y0, z0], turn: [sin, cos, up, tip], scale, distance };
    return { project, lens, x0, z0, radius: 1.25 * span };
  };

  /** A canvas of the right size and its context, or nothing if it is not shown. @param {HTMLCanvasElement} canvas */
  const sheet = (canvas) => {
    const ratio = devicePixelRatio || 1;
    const size = /** @type {[number, number]} */ ([canvas.clientWidth, canvas.clientHeight]);
    const context = canvas.getContext("2d");
    if (!size[0] || !size[1] || !context) return null;
    const [w, h] = [Math.round(size[0] * ratio), Math.round(size[1] * ratio)];
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, size[0], size[1]);
    return { context, size };
  };

  /** @param {Panel} panel */
  const draw = (panel) => {
    const shown = sheet(panel.canvas);
    if (!shown) return;
    const { context, size } = shown;
    const { points, frame, centre } = pose(panel);
    const { project, lens, x0, z0, radius } = camera(panel, centre, size);
    context.lineCap = "round";
    const colour = (/** @type {string} */ name) => colours[name] ?? "";
    /** @param {Dot} a @param {Dot} b @param {number} width @param {string} name */
    const line = (a, b, width, name) => {
      context.strokeStyle = colour(name);
      context.lineWidth = width;
      context.beginPath();
      context.moveTo(a.x, a.y);
      context.lineTo(b.x, b.y);
      context.stroke();
    };
    /** @param {Dot} at @param {number} pixels @param {string} name */
    const disc = (at, pixels, name) => {
      context.fillStyle = colour(name);
      context.beginPath();
      context.arc(at.x, at.y, pixels, 0, 2 * Math.PI);
      context.fill();
    };

    // The floor is round, so that it has no corner that turns.
    const cell = radius > 6 ? 0.5 * Math.ceil(radius / 6) : 0.5;
    for (const along of [false, true]) {
      const [middle, other] = along ? [z0, x0] : [x0, z0];
      for (let v = Math.ceil((middle - radius) / cell) * cell; v <= middle + radius; v += cell) {
        const half = Math.sqrt(Math.max(0, radius * radius - (v - middle) * (v - middle)));
        const tip = (/** @type {number} */ w) => project(along ? [w, 0, v] : [v, 0, w]);
        line(tip(other - half), tip(other + half), 1, "grid");
      }
    }
    const floor = (/** @type {Point | undefined} */ point) => project([point?.[0] ?? 0, 0, point?.[2] ?? 0]);
    for (const [a, b] of panel.bones) line(floor(points[a]), floor(points[b]), 0.035 * floor(points[b]).scale, "shadow");
    context.strokeStyle = colour("trail");
    context.lineWidth = 2;
    context.beginPath();
    for (let t = 0; t <= frame; t += 1) {
      const at = floor([panel.joints[t * panel.width] ?? 0, 0, panel.joints[t * panel.width + 2] ?? 0]);
      if (t) context.lineTo(at.x, at.y);
      else context.moveTo(at.x, at.y);
    }
    context.stroke();

    const place = (/** @type {Waypoint} */ [, , x, y, z]) => project([x, y, z]);
    panel.waypoints.forEach((here, i) => {
      const before = panel.waypoints[i - 1];
      context.globalAlpha = 0.45;
      if (before && before[1] === here[1]) line(place(before), place(here), 1.5, "told");
      context.globalAlpha = here[0] <= frame ? 1 : 0.5;
      disc(place(here), 4, "told");
    });
    context.globalAlpha = 1;

    /** A bone with round ends, lit from above. @param {Dot} a @param {Dot} b @param {[number, number]} radii @param {string} name */
    const capsule = (a, b, radii, name) => {
      const [ra, rb] = [radii[0] * a.scale, radii[1] * b.scale];
      const along = Math.atan2(b.y - a.y, b.x - a.x);
      const shape = new Path2D();
      shape.arc(a.x, a.y, ra, along + Math.PI / 2, along - Math.PI / 2);
      shape.arc(b.x, b.y, rb, along - Math.PI / 2, along + Math.PI / 2);
      shape.closePath();
      const [x, y, thick] = [(a.x + b.x) / 2, (a.y + b.y) / 2, Math.max(ra, rb)];
      const up = Math.cos(along) < 0 ? -1 : 1;
      const [dx, dy] = [Math.sin(along) * thick * up, -Math.cos(along) * thick * up];
      const light = context.createLinearGradient(x + dx, y + dy, x - dx, y - dy);
      for (const [at, part] of LIGHT) light.addColorStop(at, lit(colour(name), part));
      context.fillStyle = light;
      context.fill(shape);
      context.strokeStyle = colour("panel");
      context.lineWidth = 1;
      context.stroke(shape);
    };

    /** Far bones first, each with an edge of the background, so that one passes visibly in front of another. @param {Panel} figure @param {Point[]} points @param {boolean} ghost */
    const body = (figure, points, ghost) => {
      /** @type {Record<string, string>} */
      const names = { m: "body", l: "left", r: "right" };
      const small = (0.55 * figure.height) / 1.7;
      const origin = /** @type {Point} */ ([0, 0, 0]);
      const bones = figure.bones.map(([from, to]) => ({ a: project(points[from] ?? origin), b: project(points[to] ?? origin), from, to }));
      bones.sort((one, two) => one.a.depth + one.b.depth - two.a.depth - two.b.depth);
      const solid = !ghost && ui.body.value === "capsules";
      for (const bone of bones) {
        const side = figure.body.sides[bone.to] ?? "m";
        const name = ghost ? "told" : names[side] ?? "body";
        const radii = figure.radii[bone.to] ?? [0, 0];
        if (solid) {
          capsule(bone.a, bone.b, [radii[0] * (figure.height / 1.7), radii[1] * (figure.height / 1.7)], name);
          if (bone.to !== figure.body.head) continue;
          const crown = headOf(points, bone.from, bone.to);
          capsule(project(crown(0.1)), project(crown(0.6)), [0.1 * (figure.height / 1.7), 0.095 * (figure.height / 1.7)], name);
          continue;
        }
        const width = ((figure.count > 30 ? 0.6 : 1) * (side === "m" ? 0.1 : 0.085) * small * (bone.a.scale + bone.b.scale)) / 2;
        if (!ghost) line(bone.a, bone.b, width + 2, "panel");
        line(bone.a, bone.b, ghost ? 0.6 * width : width, name);
        if (bone.to !== figure.body.head) continue;
        disc(project(headOf(points, bone.from, bone.to)(0.35)), 0.115 * (figure.height / 1.7) * bone.b.scale, name);
      }
    };
    if (ui.over.checked) {
      context.globalAlpha = 0.4;
      for (const other of panels) if (other !== panel) body(other, pose(other).points, true);
      context.globalAlpha = 1;
    }
    if (ui.body.value === "character" && chosen.character?.fits(panel.body)) chosen.character.paint(context, size, lens, panel.body, points);
    else body(panel, points, false);
    drawStrip(panel);
    panel.dirty = false;
  };

  /** Feet and waypoints over time. @param {Panel} panel */
  const drawStrip = (panel) => {
    const shown = panel.feet.length > 0 || panel.waypoints.length > 0 ? sheet(panel.strip) : null;
    if (!shown) return;
    const { context, size: [width, height] } = shown;
    const x = (/** @type {number} */ seconds) => (duration > 0 ? (seconds / duration) * width : 0);
    const row = height / 3;
    panel.feet.forEach((foot, at) => {
      context.fillStyle = colours.grid ?? "";
      context.fillRect(0, at * row + 1, x((panel.frames - 1) / panel.fps), row - 2);
      for (let t = 0; t < foot.length; ) {
        const state = foot[t] ?? 0;
        const from = t;
        while (t < foot.length && foot[t] === state) t += 1;
        if (state === 0) continue;
        context.fillStyle = colours[state === 2 ? "slides" : "stands"] ?? "";
        context.fillRect(x(from / panel.fps), at * row + 1, Math.max(1, x((t - from) / panel.fps)), row - 2);
      }
    });
    panel.waypoints.forEach(([frame], i) => {
      const miss = panel.misses[i] ?? 0;
      context.fillStyle = colours[miss <= NEAR ? "stands" : miss <= FAR ? "told" : "slides"] ?? "";
      const tall = clamp(miss / FAR, 0.25, 1) * (row - 2);
      context.fillRect(x(frame / panel.fps) - 1, 3 * row - tall, 3, tall);
    });
    context.fillStyle = colours.panel ?? "";
    context.globalAlpha = 0.7;
    context.fillRect(0, 0, x(begin), height);
    context.fillRect(x(end), 0, width - x(end), height);
    context.globalAlpha = 1;
    context.fillStyle = colours.body ?? "";
    context.fillRect(x(Math.min(time, duration)) - 0.75, 0, 1.5, height);
  };

  ui.time.max = String(Math.max(1, Math.round(duration * fastest)));
  const show = () => {
    const at = Math.min(time, duration);
    const frame = Math.round(at * fastest);
    ui.time.value = String(frame);
    const text = `${at.toFixed(2)} of ${duration.toFixed(2)} s, frame ${frame}`;
    ui.clock.textContent = text;
    ui.time.setAttribute("aria-valuetext", text);
    ui.all.hidden = begin === 0 && end === duration;
    options.onTime?.(at);
  };
  const ask = () => {
    if (asked || signal.aborted) return;
    asked = true;
    requestAnimationFrame(tick);
  };
  const tick = (/** @type {number} */ now) => {
    asked = false;
    if (signal.aborted) return;
    // An element that was not in the document yet had no colours.
    if (!colours.panel) readColours();
    if (playing) {
      time += Math.min(0.25, (now - last) / 1000) * speed;
      last = now;
      // A loop of a part has no pause, so that it can be judged as one.
      if (time > end + (end === duration && begin === 0 ? PAUSE * speed : 0) || time < begin) time = begin;
      stir();
    }
    show();
    for (const panel of panels) if (panel.visible && panel.dirty) draw(panel);
    if (playing) ask();
  };
  const update = () => {
    stir();
    ask();
  };
  const setPlaying = (/** @type {boolean} */ on) => {
    playing = on;
    last = performance.now();
    ui.play.textContent = on ? "Stop" : "Play";
    if (on && time >= end) time = begin;
    update();
  };
  const goTo = (/** @type {number} */ seconds) => {
    setPlaying(false);
    time = clamp(seconds, 0, duration);
    update();
  };
  const step = (/** @type {number} */ frames) => goTo((Math.round(Math.min(time, duration) * fastest) + frames) / fastest);
  const turn = (/** @type {number} */ yaw, /** @type {number} */ pitch) => {
    view.yaw += yaw;
    view.pitch = clamp(view.pitch + pitch, -0.3, 1.55);
    update();
  };
  const zoom = (/** @type {number} */ factor) => {
    view.zoom = clamp(view.zoom * factor, 0.2, 8);
    update();
  };
  const reset = () => {
    Object.assign(view, START);
    update();
  };
  const setSpeed = (/** @type {number} */ by) => {
    ui.speed.selectedIndex = clamp(ui.speed.selectedIndex + by, 0, ui.speed.options.length - 1);
    speed = Number(ui.speed.value);
  };
  /** @param {number} from @param {number} to */
  const loop = (from, to) => {
    if (to - from < 1 / fastest) return;
    [begin, end] = [from, to];
    update();
  };
  const loopFrom = () => loop(Math.min(time, duration), end > time ? end : duration);
  const loopTo = () => loop(begin < time ? begin : 0, Math.min(time, duration));
  const loopAll = () => loop(0, duration);

  /** Reads the chosen file, here in the browser. */
  const dress = async () => {
    const file = ui.file.files?.[0];
    if (!file || !options.characters) return;
    let wrong = "";
    try {
      const character = await (await options.characters()).read(await file.arrayBuffer());
      if (!panels.some((panel) => character.fits(panel.body))) wrong = "these motions have another skeleton than a person's";
      // Drawn once here, so that a browser without the graphics for it says so.
      else character.ready();
      if (wrong === "") Object.assign(chosen, { character, body: "character" });
    } catch (error) {
      wrong = error instanceof Error ? error.message : String(error);
    }
    if (signal.aborted) return;
    ui.wrong.hidden = wrong === "";
    ui.wrong.textContent = wrong && `${file.name}: ${wrong}.`;
    if (wrong) return;
    if (![...ui.body.options].some((option) => option.value === "character")) ui.body.add(new Option("character"));
    ui.body.value = "character";
    update();
  };

  /** @param {EventTarget} target @param {string} name @param {(event: any) => void} act @param {AddEventListenerOptions} [more] */
  const on = (target, name, act, more = {}) => target.addEventListener(name, act, { signal, ...more });
  on(ui.play, "click", () => setPlaying(!playing));
  on(ui.time, "input", () => goTo(Number(ui.time.value) / fastest));
  on(ui.speed, "change", () => setSpeed(0));
  on(ui.follow, "change", update);
  on(ui.over, "change", update);
  on(ui.body, "change", () => {
    chosen.body = ui.body.value;
    update();
  });
  on(ui.file, "change", () => void dress());
  on(ui.from, "click", loopFrom);
  on(ui.to, "click", loopTo);
  on(ui.all, "click", loopAll);
  on(ui.reset, "click", reset);

  for (const { canvas } of panels) {
    /** @type {Map<number, PointerEvent>} */
    const fingers = new Map();
    on(canvas, "pointerdown", (/** @type {PointerEvent} */ event) => {
      fingers.set(event.pointerId, event);
      canvas.setPointerCapture(event.pointerId);
    });
    on(canvas, "pointermove", (/** @type {PointerEvent} */ event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const other = [...fingers.values()].find((finger) => finger.pointerId !== event.pointerId);
      if (other) {
        const apart = (/** @type {PointerEvent} */ finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
        zoom(apart(event) / Math.max(1, apart(before)));
      } else turn((before.clientX - event.clientX) * -0.008, (event.clientY - before.clientY) * 0.008);
      fingers.set(event.pointerId, event);
    });
    for (const name of ["pointerup", "pointercancel"]) on(canvas, name, (/** @type {PointerEvent} */ event) => fingers.delete(event.pointerId));
    on(canvas, "dblclick", reset);
    // The wheel scrolls the page unless the figure was chosen.
    const wheel = (/** @type {WheelEvent} */ event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return;
      event.preventDefault();
      zoom(Math.exp(-0.0015 * event.deltaY));
    };
    on(canvas, "wheel", wheel, { passive: false });
  }

  on(options.whole ? document : root, "keydown", (/** @type {KeyboardEvent} */ event) => {
    const target = /** @type {HTMLInputElement} */ (event.target);
    const where = target.tagName;
    if (event.ctrlKey || event.metaKey || event.altKey || where === "SELECT" || where === "TEXTAREA") return;
    if (where === "INPUT" && target.type !== "range" && target.type !== "checkbox") return;
    /** @type {Record<string, [number, number]>} */
    const arrows = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    const often = event.shiftKey ? 10 : 1;
    /** @type {Record<string, () => void>} */
    const keys = {
      " ": () => setPlaying(!playing), ArrowLeft: () => step(-often), ArrowRight: () => step(often),
      Home: () => goTo(0), End: () => goTo(duration), "[": () => setSpeed(-1), "]": () => setSpeed(1),
      "+": () => zoom(1.15), "=": () => zoom(1.15), "-": () => zoom(1 / 1.15), 0: reset,
      i: loopFrom, o: loopTo, u: loopAll,
      f: () => {
        ui.follow.checked = !ui.follow.checked;
        update();
      },
    };
    const [arrow, key] = [arrows[event.key], keys[event.key]];
    if (where === "CANVAS" && arrow) turn(...arrow);
    else if (event.key === " " && (where === "BUTTON" || where === "SUMMARY" || target.type === "checkbox")) return;
    else if (where === "INPUT" && event.key.startsWith("Arrow") && target.type !== "range") return;
    else if (key) key();
    else return;
    event.preventDefault();
  });

  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const panel = panels.find((panel) => panel.canvas === entry.target);
      if (!panel) continue;
      panel.visible = entry.isIntersecting;
      panel.dirty = true;
    }
    ask();
  });
  const sized = new ResizeObserver(update);
  for (const { canvas } of panels) {
    seen.observe(canvas);
    sized.observe(canvas);
  }
  const recolour = () => {
    readColours();
    update();
  };
  on(matchMedia("(prefers-color-scheme: dark)"), "change", recolour);
  recolour();

  return {
    duration,
    goTo,
    play: setPlaying,
    /** Adds a frame to a stream. @param {number[][]} points metres */
    append(points) {
      const panel = panels[0];
      const [x = 0, , z = 0] = points[0] ?? [];
      if (!panel) return;
      if (panel.joints.length < LIVE * panel.width) {
        const room = new Float32Array(LIVE * panel.width);
        room.set(panel.joints);
        panel.joints = room;
      }
      if (panel.frames === LIVE) {
        panel.joints.copyWithin(0, (LIVE / 2) * panel.width);
        panel.course.splice(0, LIVE / 2);
        panel.frames = LIVE / 2;
      }
      panel.joints.set(points.flat(), panel.frames * panel.width);
      const [x0, z0] = panel.course[panel.frames - 1] ?? [x, z];
      panel.course.push([x0 + 0.15 * (x - x0), z0 + 0.15 * (z - z0)]);
      panel.frames += 1;
      time = (panel.frames - 1) / panel.fps;
      update();
    },
    /** Ends it; the figures stay as they are. */
    close() {
      ended.abort();
      seen.disconnect();
      sized.disconnect();
      for (const { strip, measures } of panels) {
        strip.remove();
        measures.remove();
      }
    },
  };
}
