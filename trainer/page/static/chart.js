//! Curves: fetched, smoothed and drawn.

import { get } from "./api.js";
import { grouped, number, plain } from "./format.js";
import uPlot from "./vendor/uPlot.esm.js";

/** Points that a chart asks for: about two a pixel. */
const POINTS = 800;

/** The curves of a run, or of one stage of it, by stage and key. @param {string} run @param {string | null} stage @param {AbortSignal} signal @param {number} [points] @returns {Promise<Map<string, Map<string, Curve>>>} */
export async function curves(run, stage, signal, points = POINTS) {
  const query = new URLSearchParams({ run, buckets: String(points) });
  if (stage) query.set("stage", stage);
  const answer = /** @type {{series: {stage: string, key: string, total: number, x: number[], mean: (number | null)[], nan: number[]}[]}} */ (
    await get(`/v1/metrics?${query}`, signal)
  );
  /** @type {Map<string, Map<string, Curve>>} */
  const found = new Map();
  for (const { stage: name, key, total, x, mean, nan } of answer.series) {
    const keys = found.get(name) ?? new Map();
    keys.set(key, { total, x, mean, nan });
    found.set(name, keys);
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

/** Charts whose cursors go together. */
const together = uPlot.sync("stride");

/** One chart, with an element that stays the same while its curve grows. */
export class Chart {
  /** @param {string} key @param {number} height */
  constructor(key, height = 190) {
    this.key = key;
    this.height = height;
    this.element = document.createElement("div");
    this.element.className = "plot";
    /** @type {uPlot | null} */
    this.plot = null;
    /** @type {Curve | null} */
    this.curve = null;
    this.log = false;
    this.averaged = false;
    this.again = () => this.make();
    this.watch = new ResizeObserver(() => this.fit());
    this.watch.observe(this.element);
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

  /** @param {Curve} curve @param {boolean} log @param {boolean} smooth */
  show(curve, log, smooth) {
    const averaged = smooth && isRough(curve.mean);
    const anew = log !== this.log || averaged !== this.averaged || !this.curve;
    const same = !anew && this.curve?.total === curve.total && this.curve.x.length === curve.x.length;
    [this.curve, this.log, this.averaged] = [curve, log, averaged];
    if (anew) this.make();
    else if (!same) this.plot?.setData(this.data());
  }

  /** @returns {(number | null)[][]} */
  data() {
    const curve = this.curve ?? { x: [], mean: [], total: 0 };
    const usable = (/** @type {number | null} */ value) => (value === null || !Number.isFinite(value) || (this.log && value <= 0) ? null : value);
    const raw = curve.mean.map(usable);
    return this.averaged ? [curve.x, raw, smoothed(raw, weightFor(raw.length))] : [curve.x, raw];
  }

  make() {
    const width = this.element.clientWidth;
    if (width === 0 || !this.curve) return;
    this.plot?.destroy();
    const [line, faint, dim, grid] = [colour("--line-1"), colour("--line-1-faint"), colour("--dim"), colour("--edge")];
    const axis = { stroke: dim, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1, size: 4 }, font: "11px system-ui, sans-serif" };
    const value = (/** @type {unknown} */ _, /** @type {number | null} */ at) => (at === null || at === undefined ? "–" : number(at));
    const raw = { label: plain(this.key), stroke: this.averaged ? faint : line, width: this.averaged ? 1 : 1.5, points: { show: this.curve.x.length < 40, size: 4, fill: line }, value, spanGaps: true };
    const series = [{ label: "step", value: (/** @type {unknown} */ _, /** @type {number | null} */ at) => (at === null || at === undefined ? "–" : grouped(at)) }, raw];
    if (this.averaged) series.push({ label: "smooth", stroke: line, width: 1.8, points: { show: false, size: 0, fill: line }, value, spanGaps: true });
    this.plot = new uPlot(
      {
        width,
        height: this.height,
        series,
        scales: { x: { time: false }, y: { distr: this.log ? 3 : 1 } },
        axes: [
          { ...axis, size: 26, values: (/** @type {unknown} */ _, /** @type {number[]} */ at) => at.map(steps) },
          { ...axis, size: 52, values: (/** @type {unknown} */ _, /** @type {(number | null)[]} */ at) => at.map((tick) => (tick === null ? "" : number(tick))) },
        ],
        cursor: { sync: { key: together.key }, drag: { x: true, y: false }, points: { size: 6 } },
        legend: { live: true },
        hooks: { draw: [(/** @type {any} */ plot) => this.mark(plot)] },
      },
      this.data(),
      this.element,
    );
  }

  /** A red tick where a value was no number. @param {any} plot */
  mark(plot) {
    const curve = this.curve;
    const hasNan = (/** @type {number} */ at) => (curve?.nan?.[at] ?? 0) > 0;
    if (!curve || !curve.x.some((_, at) => hasNan(at))) return;
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.strokeStyle = colour("--bad");
    ctx.lineWidth = 2;
    curve.x.forEach((_, at) => {
      if (!hasNan(at)) return;
      const x = plot.valToPos(curve.x[at], "x", true);
      if (x < bbox.left || x > bbox.left + bbox.width) return;
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + 10);
      ctx.stroke();
    });
    ctx.restore();
  }
}

/** `12k`. @param {number} step */
function steps(step) {
  if (step >= 1e6) return `${number(step / 1e6)}M`;
  if (step >= 1e4) return `${number(step / 1e3)}k`;
  return grouped(step);
}
