//! What several views draw: states, bars, small curves, commands to copy.

import { count, duration, grouped, number, plain, rate } from "./format.js";
import { html, nothing, svg } from "./vendor/lit-html.js";

/** @type {Record<string, string>} */
const ICONS = {
  stride: "M14.5 3.500a1.800 1.800 0 1 0 .1 0ZM13 8l-1.500 5 3.800 3 .7 5M11.500 13l-2.300 4-3.700 1.500M13 8l-4 1.500-1.200 3M13 8l3 3 3-.4",
  now: "M4 13h4l2.500-7 4 13 2.500-6h3",
  runs: "M4 6h16M4 12h16M4 18h10",
  models: "M12 3 20 7.500v9L12 21l-8-4.500v-9L12 3ZM4 7.500l8 4.500 8-4.500M12 12v9",
  data: "M4 5h16v14H4zM4 10h16M10 10v9",
  draw: "M4 20l4-1L19 8l-3-3L5 16l-1 4ZM14 7l3 3",
  workers: "M4 5h16v6H4zM4 13h16v6H4zM7.500 8h.01M7.500 16h.01",
  store: "M5 6c0-3.500 14-3.500 14 0v12c0 3.500-14 3.500-14 0V6Zm0 0c0 3.500 14 3.500 14 0M5 12c0 3.500 14 3.500 14 0",
  person: "M12 12a4 4 0 1 0-.01 0ZM5 20c1-7 13-7 14 0",
  copy: "M9 9h11v11H9zM5 15H4V4h11v1",
  check: "M5 12.500l4.500 4.500L19 7.500",
};

/** @param {string} name */
export const icon = (name) =>
  html`<svg class="icon" viewBox="0 0 24 24" aria-hidden="true" focusable="false">${svg`<path d=${ICONS[name] ?? ""}></path>`}</svg>`;

/** A state's colour and sign; colour alone says nothing. @type {Record<string, [string, string]>} */
const STATES = {
  running: ["run", "●"],
  finished: ["good", "✓"],
  ran: ["good", "✓"],
  resumed: ["good", "✓"],
  cached: ["good", "≡"],
  failed: ["bad", "✕"],
  paused: ["warn", "‖"],
  interrupted: ["warn", "‖"],
  queued: ["warn", "◔"],
  cancelled: ["idle", "⊘"],
  skipped: ["idle", "⊘"],
  waiting: ["idle", "○"],
  ready: ["warn", "◔"],
  idle: ["idle", "○"],
  working: ["run", "●"],
  leaving: ["idle", "◌"],
  unreachable: ["bad", "✕"],
  silent: ["warn", "◔"],
  gone: ["idle", "⊘"],
};

/** @param {string} state */
export const tone = (state) => STATES[state]?.[0] ?? "idle";
/** @param {string} state */
export const sign = (state) => STATES[state]?.[1] ?? "○";

/** @param {string} state @param {string} [word] */
export const badge = (state, word = state) =>
  html`<span class="badge ${tone(state)}"><span aria-hidden="true">${sign(state)}</span> ${word}</span>`;

/** A run's state in one word. @param {{state: string, interrupted?: boolean, queued?: boolean}} run */
export const runState = (run) => {
  if (run.state === "paused" && run.interrupted) return "interrupted";
  return run.state === "running" && run.queued ? "queued" : run.state;
};

/** @param {{state: string}} run */
export const isOver = (run) => run.state === "finished" || run.state === "failed" || run.state === "cancelled";

/** The stages that were asked for, without trials. @param {Run} run */
export const mainStages = (run) =>
  run.stages.filter((stage) => !stage.of && !(stage.state === "skipped" && stage.message === "not asked for"));

/** @param {Stage} stage */
export const isDone = (stage) => stage.state === "ran" || stage.state === "cached" || stage.state === "resumed";

/** How far a run is: `[done, all, share]`, where a stage at work counts for its part. @param {Run} run @returns {[number, number, number]} */
export function reached(run) {
  const stages = mainStages(run);
  const done = stages.filter(isDone).length;
  const part = stages.filter((stage) => stage.state === "running").reduce((sum, stage) => sum + share(stage.progress), 0);
  return [done, stages.length, stages.length === 0 ? 0 : (done + part) / stages.length];
}

/** @param {Progress} progress */
export const share = (progress) => (progress.total > 0 ? Math.min(1, progress.done / progress.total) : 0);

/** Why a run that failed did so: its first failed stage. @param {Run} run */
export const failed = (run) => mainStages(run).find((stage) => stage.state === "failed") ?? run.stages.find((stage) => stage.state === "failed");

/** The first line of a message. @param {string | null | undefined} text */
export const firstLine = (text) => (text ?? "").split("\n", 1)[0] ?? "";

/** Words of a message: what stands between backticks is code, and digests are as long as one can compare them. @param {string | null | undefined} text */
export function prose(text) {
  const parts = plain(text ?? "").split(/(`[^`\n]+`|sha256:[0-9a-f]{64})/);
  return parts.map((part) => {
    if (part.startsWith("sha256:")) return html`<code title=${part}>${part.slice(0, 19)}…</code>`;
    return part.length > 2 && part.startsWith("`") && part.endsWith("`") ? html`<code>${part.slice(1, -1)}</code>` : part;
  });
}

/** One sentence on how a run stands. @param {Run} run */
export function reason(run) {
  const broken = failed(run);
  if (run.state === "failed" && broken) return `${broken.name}: ${firstLine(broken.message)}`;
  if (run.storage) return run.storage.what;
  const waits = mainStages(run).find((stage) => stage.wants_workers);
  if (waits) return `${waits.name} ${firstLine(waits.message)}`;
  const at = mainStages(run).filter((stage) => stage.state === "running");
  if (at.length > 0) return at.map((stage) => stage.name).join(", ");
  const ready = mainStages(run).find((stage) => stage.state === "ready" && stage.message);
  return ready ? `${ready.name}: ${firstLine(ready.message)}` : "";
}

/** The result of a stage that matters most, as `[name, value]`. @param {Stage} stage @returns {[string, number] | undefined} */
export function headline(stage) {
  const wanted = ["fid", "latent_fid", "recognised", "r_precision_top1", "mpjpe_mm", "loss"];
  const key = wanted.find((key) => key in stage.metrics) ?? Object.keys(stage.metrics)[0];
  return key === undefined ? undefined : [key, stage.metrics[key] ?? NaN];
}

/** What the last evaluation of a run measured. @param {Run} run */
export function outcome(run) {
  const measured = mainStages(run).filter((stage) => isDone(stage) && stage.kind.startsWith("evaluate"));
  const last = measured[measured.length - 1];
  const result = last && headline(last);
  return last && result ? `${last.name}: ${result[0]} ${number(result[1])}` : "";
}

/** @param {number} part from 0 to 1 @param {string} label @param {string} [kind] */
export const bar = (part, label, kind = "run") => {
  const percent = Math.round(part * 1000) / 10;
  return html`<svg class="bar ${kind}" viewBox="0 0 100 4" preserveAspectRatio="none" role="progressbar" aria-label=${label}
    aria-valuemin="0" aria-valuemax="100" aria-valuenow=${Math.round(percent)}>${svg`<rect class="rest" width="100" height="4"></rect><rect class="part" width=${percent} height="4"></rect>`}</svg>`;
};

/** A small curve without axes. @param {{x: number[], mean: (number | null)[]} | undefined} curve @param {string} label */
export function spark(curve, label) {
  const points = (curve?.x ?? []).map((x, at) => ({ x, y: curve?.mean[at] ?? NaN })).filter(({ y }) => Number.isFinite(y));
  if (points.length < 2) return html`<svg class="spark" viewBox="0 0 100 28" aria-hidden="true"></svg>`;
  const xs = points.map(({ x }) => x);
  const ys = points.map(({ y }) => y);
  const [x0, x1] = [xs[0] ?? 0, xs[xs.length - 1] ?? 1];
  // What is far beyond all others, such as the first step, would flatten the rest.
  const sorted = [...ys].sort((a, b) => a - b);
  const high = sorted[Math.floor(sorted.length * 0.98)] ?? 1;
  const low = sorted[0] ?? 0;
  /** @param {{x: number, y: number}} point */
  const place = ({ x, y }) =>
    `${(((x - x0) / (x1 - x0 || 1)) * 100).toFixed(1)},${(26 - (Math.min(1, (y - low) / (high - low || 1)) * 24)).toFixed(1)}`;
  const line = points.map(place).join(" ");
  const says = `${label}: ${number(ys[0])} at first, ${number(ys[ys.length - 1])} now`;
  return html`<svg class="spark" viewBox="0 0 100 28" preserveAspectRatio="none" role="img" aria-label=${says}>
    ${svg`<polygon points=${`0,28 ${line} 100,28`}></polygon><polyline points=${line}></polyline>`}</svg>`;
}

/** A command with a button that copies it. @param {string} text @param {Context} context */
export function command(text, context) {
  /** @param {Event} event */
  async function copy(event) {
    const shown = /** @type {HTMLElement} */ (event.currentTarget).parentElement?.querySelector("code");
    try {
      await navigator.clipboard.writeText(text);
      context.say("Copied.");
    } catch {
      // A page without TLS has no clipboard: the text is marked, for the keyboard.
      if (shown) getSelection()?.selectAllChildren(shown);
      context.say("Marked: copy it with the keyboard.");
    }
  }
  return html`<div class="command"><code tabindex="0">${text}</code><button type="button" class="quiet" aria-label="Copy the command" @click=${copy}>${icon("copy")}</button></div>`;
}

/** Steps and rate of a stage at work. @param {Stage} stage @param {number | undefined} perSecond */
export function pace(stage, perSecond) {
  const { done, total, unit } = stage.progress;
  if (total === 0) return stage.wall_s > 0 ? `for ${duration(stage.wall_s)}` : "";
  const speed = perSecond ? ` · ${rate(perSecond, unit)}` : "";
  return `${grouped(done)} of ${grouped(total)} ${unit}${speed}`;
}

/** Time left in words. @param {Stage} stage @param {number | undefined} perSecond */
export function left(stage, perSecond) {
  const { done, total } = stage.progress;
  return perSecond && perSecond > 0 && total > done ? `${duration((total - done) / perSecond)} left` : "";
}

/** A name and a value. @param {string} name @param {unknown} value */
export const fact = (name, value) => (value === nothing || value === "" ? nothing : html`<div class="fact"><dt>${plain(name)}</dt><dd dir="auto">${typeof value === "string" ? plain(value) : value}</dd></div>`);

/** A question before something that cannot be taken back. @param {string} question */
export const sure = (question) => confirm(question);

/** The command that lets workers join. @param {number} workers @param {string | null} [message] names the labels that a stage requires, such as `gpu=h100` */
export const joinCommand = (workers, message) => {
  const labels = /labelled `([\w.,=\/-]+)`/.exec(message ?? "")?.[1]?.split(",") ?? [];
  const join = `trainer worker join ${location.origin}${labels.map((label) => ` --label ${label}`).join("")}`;
  return workers > 1 ? `${join}   # on ${count(workers, "machine")}, or as often on this one` : join;
};
