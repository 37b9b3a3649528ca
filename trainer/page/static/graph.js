//! The stages of a run as a graph: what is read stands left of what reads it.

import { duration, plain } from "./format.js";
import { isDone, pace, share, sign, tone } from "./parts.js";
import { address } from "./router.js";
import { svg, html } from "./vendor/lit-html.js";

const [WIDTH, HEIGHT, GAP_X, GAP_Y, EDGE] = [152, 58, 34, 14, 4];
/** Above this a list says more than a graph. */
export const MOST = 60;

/** Columns of stages: each stands behind all that it needs. @param {Stage[]} stages @returns {Stage[][]} */
export function columns(stages) {
  /** @type {Map<string, number>} */
  const depth = new Map();
  const known = new Set(stages.map((stage) => stage.name));
  // Stages come in topological order.
  for (const stage of stages) {
    const before = (stage.needs ?? []).filter((name) => known.has(name)).map((name) => depth.get(name) ?? 0);
    depth.set(stage.name, before.length === 0 ? 0 : Math.max(...before) + 1);
  }
  /** @type {Stage[][]} */
  const all = [];
  for (const stage of stages) (all[depth.get(stage.name) ?? 0] ??= []).push(stage);
  const filled = all.filter((column) => column);
  // Stages stand as near as may be to the mean height of what they read, so that fewer edges cross.
  /** @type {Map<string, number>} */
  const row = new Map();
  const direct = edgesOf(stages);
  for (const column of filled) {
    const mean = (/** @type {Stage} */ stage) => {
      const rows = (direct.get(stage.name) ?? []).map((name) => row.get(name)).filter((at) => at !== undefined);
      return rows.length === 0 ? 0 : rows.reduce((sum, at) => sum + at, 0) / rows.length;
    };
    column.sort((a, b) => mean(a) - mean(b));
    const middle = (column.length - 1) / 2;
    column.forEach((stage, at) => row.set(stage.name, at - middle));
  }
  return filled;
}

/** What each stage reads directly: an edge to what another of its inputs reads already says nothing new. @param {Stage[]} stages @returns {Map<string, string[]>} */
export function edgesOf(stages) {
  /** @type {Map<string, Set<string>>} */
  const above = new Map();
  /** @type {Map<string, string[]>} */
  const edges = new Map();
  for (const stage of stages) {
    const needs = (stage.needs ?? []).filter((name) => above.has(name));
    const further = new Set(needs.flatMap((name) => [...(above.get(name) ?? [])]));
    edges.set(stage.name, needs.filter((name) => !further.has(name)));
    above.set(stage.name, new Set([...needs, ...further]));
  }
  return edges;
}

/** @param {string} text @param {number} most */
const cut = (text, most) => (text.length > most ? `${text.slice(0, most - 1)}…` : text);

/** @param {Run} run @param {Stage[]} stages @param {Map<string, SettingsOfStage>} settings */
export function graph(run, stages, settings) {
  const all = columns(stages);
  const tallest = Math.max(1, ...all.map((column) => column.length));
  const [width, height] = [all.length * (WIDTH + GAP_X) - GAP_X + 2 * EDGE, tallest * (HEIGHT + GAP_Y) - GAP_Y + 2 * EDGE];
  /** @type {Map<string, [number, number]>} */
  const places = new Map();
  all.forEach((column, x) => {
    const top = (height - (column.length * (HEIGHT + GAP_Y) - GAP_Y)) / 2;
    column.forEach((stage, y) => places.set(stage.name, [EDGE + x * (WIDTH + GAP_X), top + y * (HEIGHT + GAP_Y)]));
  });
  const direct = edgesOf(stages);
  const edges = stages.flatMap((stage) =>
    (direct.get(stage.name) ?? []).flatMap((name) => {
      const [from, to] = [places.get(name), places.get(stage.name)];
      if (!from || !to) return [];
      const [x0, y0, x1, y1] = [from[0] + WIDTH, from[1] + HEIGHT / 2, to[0], to[1] + HEIGHT / 2];
      const bend = Math.min(40, (x1 - x0) / 2);
      return [svg`<path class="edge" d=${`M${x0} ${y0}C${x0 + bend} ${y0} ${x1 - bend} ${y1} ${x1} ${y1}`}></path>`];
    }),
  );
  const node = (/** @type {Stage} */ stage) => {
    const [x, y] = places.get(stage.name) ?? [0, 0];
    const { from, why } = settings.get(stage.name) ?? {};
    const reason = plain(why?.text ?? "");
    const below = stage.state === "cached" && from ? `from ${from}` : stage.state === "running" && stage.progress.total > 0 ? pace(stage, undefined) : isDone(stage) && stage.wall_s > 0 ? `${stage.state} · ${duration(stage.wall_s)}` : stage.state;
    return svg`<a href=${address("runs", run.run, stage.name)} class=${`node ${tone(stage.state)}`}>
      <rect class="box" x=${x} y=${y} width=${WIDTH} height=${HEIGHT} rx="8"></rect>
      <rect class="edge-mark" x=${x} y=${y + 8} width="3" height=${HEIGHT - 16}></rect>
      <title>${`${stage.name}, ${stage.kind}${reason ? `: ${reason}` : ""}`}</title>
      <text class="name" x=${x + 14} y=${y + 22}>${sign(stage.state)} ${cut(stage.name, 15)}</text>
      <text class="kind" x=${x + 14} y=${y + 40}>${cut(below, 17)}</text>
      ${stage.state === "running" ? svg`<rect class="track" x=${x + 14} y=${y + 47} width=${WIDTH - 28} height="3" rx="1.5"></rect><rect class="done" x=${x + 14} y=${y + 47} width=${(WIDTH - 28) * share(stage.progress)} height="3" rx="1.5"></rect>` : ""}
    </a>`;
  };
  return html`<div class="graph" tabindex="0" role="group" aria-label="Graph of stages">
    <svg class=${width > 1000 ? "large" : ""} viewBox=${`0 0 ${width} ${height}`} width=${width} height=${height}>${edges}${stages.map(node)}</svg>
  </div>`;
}
