//! A sweep: which trial fell at which rung, what the best ones have in common, and the best.

import { number, plain } from "./format.js";
import { badge, bar, sign, tone } from "./parts.js";
import { address } from "./router.js";
import { inText } from "./settings.js";
import { html, nothing, svg } from "./vendor/lit-html.js";

const [WIDTH, HEIGHT, PAD] = [640, 230, 40];

/** Marked ranges of the axes, from 0 to 1, by run and stage. @type {Map<string, Map<string, [number, number]>>} */
const brushes = new Map();

/** @typedef {{name: string, place: (trial: Trial) => number | null, ends: [string, string], words: string[]}} Axis */

/** A searched value, which may have more digits than matter. @param {unknown} value */
const short = (value) => (typeof value === "number" ? number(value) : value === undefined ? "" : inText(value));

/** @param {Trial} trial */
const lastResult = (trial) => trial.results.findLast((result) => result !== null) ?? null;

/** @param {Sweep} sweep @returns {Axis[]} */
function axesOf(sweep) {
  const paths = [...new Set(sweep.trials.flatMap((trial) => Object.keys(trial.values)))];
  const axes = paths.map((path) => axisOf(path, sweep.trials.map((trial) => trial.values[path]), (trial) => trial.values[path]));
  return [...axes, axisOf(sweep.metric, sweep.trials.map(lastResult).filter((result) => result !== null), lastResult)];
}

/** @param {string} name @param {unknown[]} values @param {(trial: Trial) => unknown} of @returns {Axis} */
function axisOf(name, values, of) {
  const numbers = values.filter((value) => typeof value === "number" && Number.isFinite(value)).map(Number);
  if (numbers.length > 0 && numbers.length === values.filter((value) => value !== undefined).length) {
    const [low, high] = [Math.min(...numbers), Math.max(...numbers)];
    // What spans more than a decade is drawn by its logarithm.
    const scale = low > 0 && high / low > 10 ? Math.log : (/** @type {number} */ value) => value;
    const place = (/** @type {Trial} */ trial) => {
      const value = of(trial);
      return typeof value === "number" && Number.isFinite(value) ? (scale(value) - scale(low)) / (scale(high) - scale(low) || 1) : null;
    };
    return { name, place, ends: [number(low), number(high)], words: [] };
  }
  const words = [...new Set(values.map(inText))].sort();
  const place = (/** @type {Trial} */ trial) => (of(trial) === undefined ? null : words.indexOf(inText(of(trial))) / Math.max(1, words.length - 1));
  return { name, place, ends: [words[0] ?? "", words[words.length - 1] ?? ""], words };
}

/** @param {Run} run @param {Sweep} sweep @param {Context} context */
export function sweepView(run, sweep, context) {
  const axes = axesOf(sweep);
  const id = `${run.run}/${sweep.stage}`;
  const brush = brushes.get(id) ?? new Map();
  brushes.set(id, brush);
  const isIn = (/** @type {Trial} */ trial) =>
    axes.every((axis) => {
      const range = brush.get(axis.name);
      const at = axis.place(trial);
      return !range || (at !== null && at >= range[0] - 1e-9 && at <= range[1] + 1e-9);
    });
  const best = sweep.trials.find((trial) => trial.trial === sweep.best);
  const shown = sweep.trials.filter(isIn);
  const least = sweep.mode === "min" ? "least" : "most";
  const ranked = [...shown].sort((a, b) => b.results.length - a.results.length || ((lastResult(a) ?? Infinity) - (lastResult(b) ?? Infinity)) * (sweep.mode === "min" ? 1 : -1));
  const paths = axes.slice(0, -1).map((axis) => axis.name);
  return html`<div class="sweep">
    <p class="dim">${sweep.stage}: ${sweep.search} by ${sweep.metric}, ${least} is best; ${number(sweep.spent)} of ${number(sweep.planned)} steps, where all trials in full were ${number(sweep.full)}.</p>
    ${best ? html`<section class="card winner" aria-label="Best trial"><p class="what"><span class="star">★</span> <b>Trial ${best.trial}</b> is best${sweep.over ? "" : " so far"}: ${plain(sweep.metric)} <b>${number(lastResult(best))}</b></p>
      <dl class="facts">${Object.entries(best.values).map(([path, value]) => html`<div class="fact"><dt>${plain(path)}</dt><dd dir="auto">${plain(short(value))}</dd></div>`)}</dl>
      <p class="actions">${trialStage(run, sweep, best)}</p></section>` : nothing}
    ${sweep.over ? nothing : bar(sweep.planned > 0 ? Math.min(1, sweep.spent / sweep.planned) : 0, `Steps of the sweep of ${sweep.stage}`)}
    <div class="charts">${sweep.rungs.length > 1 ? rungs(sweep, isIn) : nothing}${parallel(sweep, axes, brush, isIn, context)}</div>
    <div class="card table" tabindex="0" role="group" aria-label=${`Trials of ${sweep.stage}`}><table><caption>${shown.length === sweep.trials.length ? `${shown.length} trials` : `${shown.length} of ${sweep.trials.length} trials are marked`}, best first</caption>
      <thead><tr><th scope="col">Trial</th><th scope="col">State</th>${paths.map((path) => html`<th scope="col">${plain(path)}</th>`)}${sweep.rungs.map((rung) => html`<th scope="col" class="num">after ${number(rung)}</th>`)}</tr></thead>
      <tbody>${ranked.map((trial) => html`<tr class=${trial.trial === sweep.best ? "best" : ""}><th scope="row">${trial.trial}${trial.trial === sweep.best ? " ★ best" : ""}</th><td>${badge(trial.state === "stopped" ? "skipped" : trial.state, trial.state)}</td>${paths.map((path) => html`<td class="num">${plain(short(trial.values[path]))}</td>`)}${sweep.rungs.map((_, at) => html`<td class="num">${at < trial.results.length ? (trial.results[at] === null ? "failed" : number(trial.results[at])) : ""}</td>`)}</tr>`)}</tbody></table></div>
  </div>`;
}

/** A link to the last training of a trial. @param {Run} run @param {Sweep} sweep @param {Trial} trial */
function trialStage(run, sweep, trial) {
  const begins = `${sweep.stage}.t${String(trial.trial).padStart(2, "0")}.r`;
  const stage = run.stages.findLast((stage) => stage.name.startsWith(begins) && !stage.name.endsWith(".eval"));
  return stage ? html`<a class="button" href=${address("runs", run.run, stage.name)}>Its curves</a>` : nothing;
}

/** Who fell where: the metric after each rung, a line for each trial. @param {Sweep} sweep @param {(trial: Trial) => boolean} isIn */
function rungs(sweep, isIn) {
  const all = sweep.trials.flatMap((trial) => trial.results.filter((result) => result !== null)).map(Number).sort((a, b) => a - b);
  if (all.length === 0) return nothing;
  // A trial far beyond the others would flatten the rest.
  const [low, high] = sweep.mode === "min" ? [all[0] ?? 0, all[Math.floor(all.length * 0.95)] ?? 1] : [all[Math.floor(all.length * 0.05)] ?? 0, all[all.length - 1] ?? 1];
  const x = (/** @type {number} */ at) => PAD + 20 + (at / Math.max(1, sweep.rungs.length - 1)) * (WIDTH - 2 * PAD - 40);
  const y = (/** @type {number} */ value) => HEIGHT - PAD - Math.min(1, Math.max(0, (value - low) / (high - low || 1))) * (HEIGHT - 2 * PAD);
  const fell = sweep.rungs.map((_, at) => sweep.trials.filter((trial) => trial.state === "stopped" && trial.results.length === at + 1).length);
  const says = `${sweep.metric} after each rung; ${fell.map((many, at) => `${many} stopped after ${number(sweep.rungs[at])} steps`).join(", ")}`;
  return html`<figure class="card chart"><figcaption>Who fell where</figcaption><svg class="plain-chart" viewBox=${`0 0 ${WIDTH} ${HEIGHT}`} role="img" aria-label=${says}>
    ${sweep.rungs.map((rung, at) => svg`<line class="axis" x1=${x(at)} x2=${x(at)} y1=${PAD - 12} y2=${HEIGHT - PAD + 6}></line>
      <text x=${x(at)} y=${HEIGHT - 16} text-anchor="middle">${number(rung)} steps</text>${(fell[at] ?? 0) > 0 ? svg`<text class="fell" x=${x(at)} y="18" text-anchor="middle">${fell[at]} stopped</text>` : nothing}`)}
    <text x="4" y=${y(low) + 4}>${number(low)}</text><text x="4" y=${y(high) + 4}>${number(high)}</text>
    ${sweep.trials.map((trial) => {
      const points = trial.results.flatMap((result, at) => (result === null ? [] : [[x(at), y(result)]]));
      const end = points[points.length - 1];
      const state = trial.trial === sweep.best ? "is-best" : isIn(trial) ? "" : "is-out";
      return end ? svg`<g class=${`trial ${state}`}><title>${`trial ${trial.trial}, ${trial.state}`}</title>${points.length > 1 ? svg`<polyline points=${points.map((point) => point.join()).join(" ")}></polyline>` : nothing}
        <text class=${`end ${tone(trial.state === "stopped" ? "skipped" : trial.state)}`} x=${end[0]} y=${(end[1] ?? 0) + 4} text-anchor="middle">${trial.trial === sweep.best ? "★" : trial.state === "stopped" ? "×" : sign(trial.state)}</text></g>` : nothing;
    })}</svg></figure>`;
}

/** Parallel coordinates: drag along an axis to mark a range of it. @param {Sweep} sweep @param {Axis[]} axes @param {Map<string, [number, number]>} brush @param {(trial: Trial) => boolean} isIn @param {Context} context */
function parallel(sweep, axes, brush, isIn, context) {
  const [top, bottom] = [PAD + 4, HEIGHT - 26];
  const x = (/** @type {number} */ at) => PAD + 14 + (at / Math.max(1, axes.length - 1)) * (WIDTH - 2 * PAD - 28);
  const y = (/** @type {number} */ share) => bottom - share * (bottom - top);
  const change = (/** @type {Axis} */ axis, /** @type {[number, number] | null} */ range) => {
    if (range && range[1] - range[0] < 0.999) brush.set(axis.name, range);
    else brush.delete(axis.name);
    context.draw();
  };
  const drag = (/** @type {Axis} */ axis) => (/** @type {PointerEvent} */ event) => {
    const target = /** @type {SVGElement} */ (event.currentTarget);
    const box = target.getBoundingClientRect();
    const share = (/** @type {PointerEvent} */ at) => Math.min(1, Math.max(0, 1 - (at.clientY - box.top) / (box.height || 1)));
    const from = share(event);
    event.preventDefault();
    target.setPointerCapture(event.pointerId);
    const move = (/** @type {PointerEvent} */ at) => change(axis, [Math.min(from, share(at)), Math.max(from, share(at))]);
    const end = (/** @type {PointerEvent} */ at) => {
      target.removeEventListener("pointermove", move);
      if (Math.abs(share(at) - from) < 0.03) change(axis, null);
    };
    target.addEventListener("pointermove", move);
    target.addEventListener("pointerup", end, { once: true });
    target.addEventListener("pointercancel", end, { once: true });
  };
  const press = (/** @type {Axis} */ axis) => (/** @type {KeyboardEvent} */ event) => {
    const [low, high] = brush.get(axis.name) ?? [0, 1];
    const clamp = (/** @type {number} */ at) => Math.min(1, Math.max(0, at));
    /** @type {Record<string, () => [number, number] | null>} */
    const keys = {
      ArrowUp: () => (event.shiftKey ? [low, clamp(high + 0.1)] : [clamp(low + 0.1), high]),
      ArrowDown: () => (event.shiftKey ? [low, clamp(high - 0.1)] : [clamp(low - 0.1), high]),
      Escape: () => null,
    };
    const chosen = keys[event.key];
    if (!chosen) return;
    event.preventDefault();
    const range = chosen();
    if (!range || range[0] < range[1]) change(axis, range);
  };
  const metric = axes[axes.length - 1];
  return html`<figure class="card chart"><figcaption class="row"><span>What the best have in common</span><span class="grow"></span>${brush.size > 0 ? html`<button type="button" class="quiet" @click=${() => { brush.clear(); context.draw(); }}>Show all</button>` : nothing}</figcaption>
    <svg class="plain-chart" viewBox=${`0 0 ${WIDTH} ${HEIGHT}`} role="group" aria-label="Parallel coordinates of the trials">
      ${sweep.trials.map((trial) => {
        const points = axes.flatMap((axis, at) => {
          const share = axis.place(trial);
          return share === null ? [] : [`${x(at)},${y(share)}`];
        });
        const share = metric?.place(trial);
        const quality = share === null || share === undefined ? 0 : sweep.mode === "min" ? 1 - share : share;
        const state = !isIn(trial) ? "is-out" : trial.trial === sweep.best ? "is-best" : quality > 0.75 ? "is-good" : "";
        return svg`<g class=${`trial ${state}`}><title>${`trial ${trial.trial}`}</title><polyline points=${points.join(" ")}></polyline></g>`;
      })}
      ${axes.map((axis, at) => {
        const range = brush.get(axis.name);
        const says = `${plain(axis.name)}, from ${axis.ends[0]} to ${axis.ends[1]}${range ? `, marked from ${Math.round(range[0] * 100)} to ${Math.round(range[1] * 100)} percent` : ""}. Arrows move the lower end, with Shift the upper one; Escape shows all.`;
        return svg`<line class="axis" x1=${x(at)} x2=${x(at)} y1=${top} y2=${bottom}></line>
          ${range ? svg`<rect class="brush" x=${x(at) - 7} width="14" y=${y(range[1])} height=${Math.max(3, y(range[0]) - y(range[1]))} rx="3"></rect>` : nothing}
          <text class="axis-name" x=${x(at)} y="16" text-anchor="middle">${plain(axis.name).split(".").slice(-2).join(".")}</text>
          <text x=${x(at)} y=${top - 7} text-anchor="middle">${axis.ends[1]}</text><text x=${x(at)} y=${bottom + 18} text-anchor="middle">${axis.ends[0]}</text>
          <rect class="grip" tabindex="0" role="slider" aria-label=${says} aria-valuemin="0" aria-valuemax="100" aria-valuenow=${Math.round((range?.[0] ?? 0) * 100)} x=${x(at) - 22} width="44" y=${top} height=${bottom - top} @pointerdown=${drag(axis)} @keydown=${press(axis)}></rect>`;
      })}
    </svg><p class="dim small">Drag along an axis to mark a part of it; press it once to show all.</p></figure>`;
}
