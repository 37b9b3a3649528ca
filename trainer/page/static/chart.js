//! Curves: fetched, smoothed and drawn.
//!
//! A bucket's least and most are a band around its mean, so that no value is lost however many one pixel stands for. A part that is
//! marked with the mouse is fetched again, in buckets of its own.

import { get } from "./api.js";
import { date, grouped, number, plain } from "./format.js";

/** Points that a chart asks for: about two a pixel. */
const POINTS = 800;

/** What is asked for: runs, a stage, keys, the axis, and the part of it. @typedef {{runs: string[], stage?: string | null, keys?: string[], axis?: Axis, from?: number, to?: number, points?: number}} Asked */
/** @typedef {"step" | "time" | "hours"} Axis */
/** @typedef {Curve & {run: string, stage: string, key: string}} Series */
/** @typedef {{label: string, curve: Curve, line?: number}} Line */
/** @typedef {{log?: boolean, smooth?: boolean, axis?: Axis, ticks?: number[]}} Look */

/** @param {Asked} asked @param {AbortSignal} [signal] @returns {Promise<Series[]>} */
export async function series(asked, signal) {
  const query = new URLSearchParams({ buckets: String(asked.points ?? POINTS) });
  for (const run of asked.runs) query.append("run", run);
  for (const key of asked.keys ?? []) query.append("key", key);
  if (asked.stage) query.set("stage", asked.stage);
  if (asked.axis && asked.axis !== "step") query.set("x", asked.axis);
  if (asked.from !== undefined) query.set("from", String(asked.from));
  if (asked.to !== undefined) query.set("to", String(asked.to));
  return (await get(`/v1/metrics?${query}`, signal)).series;
}

/** The curves of a run, or of one stage of it, by stage and key. @param {string} run @param {string | null} stage @param {AbortSignal} signal @param {number} [points] @returns {Promise<Map<string, Map<string, Curve>>>} */
export async function curves(run, stage, signal, points = POINTS) {
  /** @type {Map<string, Map<string, Curve>>} */
  const found = new Map();
  for (const curve of await series({ runs: [run], stage, points }, signal)) {
    const keys = found.get(curve.stage) ?? new Map();
    keys.set(curve.key, curve);
    found.set(curve.stage, keys);
  }
  return found;
}

/** The key that says most of a training. @param {Map<string, Curve> | undefined} keys */
export function mainKey(keys) {
  const names = [...(keys?.keys() ?? [])];
  return names.find((name) => name === "loss") ?? names.find((name) => /(^|[._])loss/.test(name)) ?? names[0];
}

/** Loss first, then the rest by name. @param {Iterable<string>} keys */
export function inOrder(keys) {
  const rank = (/** @type {string} */ key) => (key === "loss" ? 0 : /loss/.test(key) ? 1 : 2);
  return [...keys].sort((a, b) => rank(a) - rank(b) || a.localeCompare(b));
}

/** An average that leaves out what is no number; its first values are not drawn to zero. @param {(number | null)[]} values @param {number} weight @returns {(number | null)[]} */
export function smoothed(values, weight) {
  let [sum, mass] = [0, 0];
  return values.map((value) => {
    if (value === null || !Number.isFinite(value)) return null;
    sum = weight * sum + (1 - weight) * value;
    mass = weight * mass + (1 - weight);
    return sum / mass;
  });
}

/** The weight of an average over about a thirtieth of so many points. @param {number} points */
const weightFor = (points) => Math.min(0.97, Math.max(0.4, 1 - 30 / Math.max(points, 31)));

/** Whether an average says more than the values: they go up and down from one to the next. @param {(number | null)[]} values */
export function isRough(values) {
  const all = values.filter((value) => value !== null);
  if (all.length < 12) return false;
  const range = Math.max(...all) - Math.min(...all);
  let bends = 0;
  for (let at = 2; at < all.length; at += 1) bends += Math.abs((all[at] ?? 0) - 2 * (all[at - 1] ?? 0) + (all[at - 2] ?? 0));
  return range > 0 && bends / (all.length - 2) > range * 0.01;
}

/** What a curve says, for those who do not see it. @param {string} key @param {Curve} curve */
export function inWords(key, curve) {
  const points = curve.x.map((x, at) => ({ x, y: curve.mean[at] ?? NaN })).filter(({ y }) => Number.isFinite(y));
  const [first, last] = [points[0], points[points.length - 1]];
  key = plain(key);
  if (!first || !last) return `${key}: no number yet`;
  const least = points.reduce((low, point) => (point.y < low.y ? point : low));
  return `${key}: ${number(first.y)} at step ${grouped(first.x)}, ${number(last.y)} at step ${grouped(last.x)}, least ${number(least.y)} at step ${grouped(least.x)}, of ${grouped(curve.total)} values`;
}

/** @param {string} name */
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Colours of lines; behind the last one they begin again with dashes. */
export const COLOURS = 8;
const DASHES = [[], [7, 4], [2, 3]];

/** Charts whose cursors go together. */
const together = uPlot.sync("stride");

/** @param {unknown} _ @param {number | null | undefined} at */
const value = (_, at) => (at === null || at === undefined ? "–" : number(at));

/** One chart, with an element that stays the same while its curves grow. */
export class Chart {
  /** @param {number} height @param {(from: number, to: number) => Promise<Line[]>} [finer] fetches a part of the lines */
  constructor(height = 190, finer) {
    this.height = height;
    this.finer = finer;
    this.element = document.createElement("div");
    this.element.className = "plot";
    /** @type {uPlot | null} */
    this.plot = null;
    /** @type {Line[]} */
    this.lines = [];
    /** A part that was marked, in finer buckets. @type {Line[] | null} */
    this.part = null;
    /** @type {Look} */
    this.look = {};
    this.made = "";
    this.again = () => this.make();
    this.watch = new ResizeObserver(() => this.fit());
    this.watch.observe(this.element);
    this.element.addEventListener("dblclick", () => {
      if (!this.part) return;
      this.part = null;
      this.update();
    });
    addEventListener("stride-colours", this.again);
  }

  close() {
    this.watch.disconnect();
    removeEventListener("stride-colours", this.again);
    this.plot?.destroy();
    this.plot = null;
  }

  fit() {
    const width = this.element.clientWidth;
    if (width === 0) return;
    if (this.plot) this.plot.setSize({ width, height: this.height });
    else this.make();
  }

  /** @param {Line[]} lines @param {Look} look */
  show(lines, look) {
    const seen = (/** @type {Line[]} */ all) => all.map(({ curve }) => `${curve.total}/${curve.x.length}`).join();
    const same = seen(lines) === seen(this.lines) && look.ticks?.length === this.look.ticks?.length;
    if (look.axis !== this.look.axis) this.part = null;
    [this.lines, this.look] = [lines, look];
    if (this.shape() !== this.made) this.make();
    else if (!same && !this.part) this.update();
  }

  shown() {
    return this.part ?? this.lines;
  }

  /** Everything but the numbers: with the same shape a plot can go on. */
  shape() {
    const lines = this.shown().map((line) => [line.label, line.line, this.isAveraged(line), this.hasBand(line)]);
    return JSON.stringify([lines, this.look.log ?? false, this.look.axis ?? "step"]);
  }

  /** @param {Line} line */
  isAveraged(line) {
    return Boolean(this.look.smooth) && isRough(line.curve.mean);
  }

  /** A band says something where a bucket has several values. Of many lines the bands would hide each other. @param {Line} line */
  hasBand(line) {
    return this.shown().length <= 2 && (line.curve.count ?? []).some((count) => count > 1);
  }

  update() {
    if (this.shape() !== this.made) this.make();
    else this.plot?.setData(this.data());
  }

  /** @returns {(number | null)[][]} */
  data() {
    const usable = (/** @type {number | null | undefined} */ at) => (at === null || at === undefined || !Number.isFinite(at) || (this.look.log && at <= 0) ? null : at);
    const tables = this.shown().map((line) => {
      const { x, mean, min, max } = line.curve;
      const raw = mean.map(usable);
      /** @type {(number | null)[][]} */
      const table = [x];
      if (this.hasBand(line)) table.push((max ?? mean).map(usable), (min ?? mean).map(usable));
      table.push(raw);
      if (this.isAveraged(line)) table.push(smoothed(raw, weightFor(raw.length)));
      return table;
    });
    if (tables.length === 0) return [[]];
    return tables.length === 1 ? tables[0] ?? [[]] : uPlot.join(tables);
  }

  make() {
    const width = this.element.clientWidth;
    if (width === 0 || this.shown().length === 0) return;
    this.plot?.destroy();
    this.made = this.shape();
    const { log, axis = "step" } = this.look;
    const [dim, grid] = [colour("--dim"), colour("--edge")];
    const drawn = { stroke: dim, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1, size: 4 }, font: "11px system-ui, sans-serif" };
    const x = (/** @type {unknown} */ _, /** @type {number | null} */ at) => (at === null || at === undefined ? "–" : axis === "step" ? grouped(Math.round(at)) : axis === "time" ? date(at) : `${number(at)} h`);
    /** @type {object[]} */
    const columns = [{ label: axis, value: x }];
    /** @type {object[]} */
    const bands = [];
    const many = this.shown().length > 1;
    for (const [place, line] of this.shown().entries()) {
      const at = line.line ?? place;
      const name = `--line-${(at % COLOURS) + 1}`;
      const dash = DASHES[Math.floor(at / COLOURS) % DASHES.length];
      const [full, averaged] = [colour(name), this.isAveraged(line)];
      const label = plain(line.label);
      const common = { spanGaps: true, value };
      if (this.hasBand(line)) {
        const edge = { ...common, stroke: "transparent", width: 0, points: { show: false } };
        bands.push({ series: [columns.length, columns.length + 1], fill: `${full}2e` });
        columns.push({ ...edge, label: many ? `${label} most` : "most" }, { ...edge, label: many ? `${label} least` : "least" });
      }
      columns.push({ ...common, label, dash, stroke: averaged ? `${full}59` : full, width: averaged ? 1 : 1.5, points: { show: line.curve.x.length < 40, size: 4, fill: full } });
      if (averaged) columns.push({ ...common, label: many ? `${label} smooth` : "smooth", dash, stroke: full, width: 1.8, points: { show: false } });
    }
    this.plot = new uPlot(
      {
        width,
        height: this.height,
        ms: 1,
        series: columns,
        bands,
        scales: { x: { time: axis === "time" }, y: { distr: log ? 3 : 1 } },
        axes: [
          axis === "step" ? { ...drawn, size: 26, values: (/** @type {unknown} */ _, /** @type {number[]} */ at) => at.map(steps) } : { ...drawn, size: axis === "time" ? 40 : 26 },
          { ...drawn, size: 52, values: (/** @type {unknown} */ _, /** @type {(number | null)[]} */ at) => at.map((tick) => (tick === null ? "" : number(tick))) },
        ],
        cursor: { sync: { key: together.key }, drag: { x: true, y: false }, points: { size: 6 } },
        legend: { live: true, show: !many },
        hooks: { draw: [(/** @type {any} */ plot) => this.mark(plot)], setSelect: [(/** @type {any} */ plot) => void this.refine(plot)] },
      },
      this.data(),
      this.element,
    );
  }

  /** Fetches the marked part. @param {any} plot */
  async refine(plot) {
    const { left, width } = plot.select;
    if (width < 4 || !this.finer) return;
    const part = await this.finer(plot.posToVal(left, "x"), plot.posToVal(left + width, "x")).catch(() => null);
    if (!part || this.plot !== plot || !part.some((line) => line.curve.x.length > 1)) return;
    this.part = part;
    this.update();
  }

  /** Red ticks above where a value was no number, small marks below where a checkpoint was saved. @param {any} plot */
  mark(plot) {
    const { ctx, bbox } = plot;
    const place = (/** @type {number} */ at) => {
      const x = plot.valToPos(at, "x", true);
      return x < bbox.left || x > bbox.left + bbox.width ? null : x;
    };
    ctx.save();
    ctx.strokeStyle = colour("--bad");
    ctx.lineWidth = 2;
    for (const { curve } of this.shown()) {
      curve.nan?.forEach((count, at) => {
        const x = count > 0 ? place(curve.x[at] ?? NaN) : null;
        if (x === null) return;
        ctx.beginPath();
        ctx.moveTo(x, bbox.top);
        ctx.lineTo(x, bbox.top + 10);
        ctx.stroke();
      });
    }
    ctx.fillStyle = colour("--good");
    const size = 4 * devicePixelRatio;
    for (const tick of this.look.ticks ?? []) {
      const x = place(tick);
      if (x === null) continue;
      const y = bbox.top + bbox.height;
      ctx.beginPath();
      ctx.moveTo(x, y - 1.6 * size);
      ctx.lineTo(x + size, y);
      ctx.lineTo(x - size, y);
      ctx.fill();
    }
    ctx.restore();
  }
}

/** `12k`. @param {number} step */
function steps(step) {
  if (step >= 1e6) return `${number(step / 1e6)}M`;
  if (step >= 1e4) return `${number(step / 1e3)}k`;
  return grouped(step);
}
