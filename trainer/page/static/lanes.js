//! Time lines: a lane each for workers or stages, with bars of work and marks of what happened. Times in which nothing was done are
//! squeezed.

import { date, duration, plain, time } from "./format.js";
import { html, nothing, svg } from "./vendor/lit-html.js";

/** @typedef {{from: number, to: number, text: string, href?: string, line?: number, tone?: string}} Bar */
/** @typedef {{at: number, sign: string, text: string, tone?: string}} Mark */
/** @typedef {{name: string, href?: string, bars: Bar[], marks: Mark[]}} Lane */

/** Share of the width that a squeezed time has, and the share of all work from which one is squeezed. */
const [SQUEEZED, IDLE] = [0.025, 0.04];
const [LANE, TOP, BAR] = [44, 24, 16];

/** Places of moments from 0 to 1, with the times that were squeezed. @param {{from: number, to: number}[]} busy @param {[number, number]} all */
export function squeeze(busy, all) {
  const sorted = busy.filter(({ from, to }) => to >= from).sort((a, b) => a.from - b.from);
  /** @type {{from: number, to: number, idle: boolean}[]} */
  const parts = [];
  let at = all[0];
  for (const { from, to } of sorted) {
    if (from > at) parts.push({ from: at, to: from, idle: true });
    const last = parts[parts.length - 1];
    if (last && !last.idle && from <= last.to) last.to = Math.max(last.to, to);
    else if (to > at || from >= at) parts.push({ from: Math.max(at, from), to, idle: false });
    at = Math.max(at, to);
  }
  if (at < all[1]) parts.push({ from: at, to: all[1], idle: true });
  const worked = parts.reduce((sum, part) => sum + (part.idle ? 0 : part.to - part.from), 0);
  const least = worked * IDLE;
  const long = parts.filter((part) => part.idle && worked > 0 && part.to - part.from > least);
  const rest = parts.reduce((sum, part) => sum + (long.includes(part) ? 0 : part.to - part.from), 0) || 1;
  const share = 1 - long.length * SQUEEZED;
  let x = 0;
  const placed = parts.map((part) => {
    const width = long.includes(part) ? SQUEEZED : ((part.to - part.from) / rest) * share;
    x += width;
    return { ...part, x: x - width, width, squeezed: long.includes(part) };
  });
  /** @param {number} ms */
  const place = (ms) => {
    const part = placed.find((part) => ms <= part.to) ?? placed[placed.length - 1];
    if (!part) return 0;
    return part.x + part.width * Math.min(1, Math.max(0, (ms - part.from) / (part.to - part.from || 1)));
  };
  return { place, gaps: placed.filter((part) => part.squeezed), parts: placed };
}

const percent = (/** @type {number} */ share) => `${(share * 100).toFixed(3)}%`;

/** @param {Lane[]} lanes @param {[number, number]} all from and to in milliseconds @param {string} label */
export function timeLine(lanes, all, label) {
  const { place, gaps, parts } = squeeze(lanes.flatMap((lane) => lane.bars), all);
  const height = TOP + lanes.length * LANE + 4;
  // A time stands where work begins, if there is room for it.
  /** @type {{x: number, at: number}[]} */
  const ticks = [];
  for (const part of parts) if (!part.idle && part.x <= 0.86 && part.x - (ticks[ticks.length - 1]?.x ?? -1) > 0.2) ticks.push({ x: part.x, at: part.from });
  const long = all[1] - all[0] > 86400e3;
  const bar = (/** @type {Bar} */ it, /** @type {number} */ y) => {
    const [x, to] = [place(it.from), place(it.to)];
    const width = Math.max(0.003, to - x);
    const says = `${plain(it.text)}, ${long ? date(it.from) : time(it.from)}, ${duration((it.to - it.from) / 1000) || "at once"}`;
    const shape = svg`<svg x=${percent(x)} y=${y} width=${percent(width)} height=${BAR}>
      <rect class=${`lane-bar ${it.tone ?? `line-${(it.line ?? 0) + 1}`}`} width="100%" height="100%" rx="3"></rect>
      ${width > 0.07 ? svg`<text class="lane-text" x="5" y="12">${plain(it.text)}</text>` : nothing}</svg>`;
    return it.href ? svg`<a href=${it.href}><title>${says}</title>${shape}</a>` : svg`<g><title>${says}</title>${shape}</g>`;
  };
  return html`<div class="lanes" tabindex="0" role="group" aria-label=${label}>
    <svg width="100%" height=${height}>
      ${gaps.map((gap) => svg`<rect class="lane-gap" x=${percent(gap.x)} y=${TOP - 4} width=${percent(gap.width)} height=${height - TOP}><title>${`nothing for ${duration((gap.to - gap.from) / 1000)}`}</title></rect>`)}
      ${ticks.map(({ x, at }) => svg`<line class="lane-tick" x1=${percent(x)} x2=${percent(x)} y1=${TOP - 8} y2=${height}></line><text class="lane-time" x=${percent(x)} dx="3" y="12">${long ? date(at) : time(at)}</text>`)}
      ${lanes.map((lane, i) => {
        const y = TOP + i * LANE;
        return svg`<line class="lane-floor" x1="0" x2="100%" y1=${y + 37} y2=${y + 37}></line>
          <text class="lane-name" x="0" y=${y + 13}>${plain(lane.name)}</text>
          ${lane.bars.map((it) => bar(it, y + 19))}
          ${lane.marks.map((mark) => svg`<text class=${`lane-mark ${mark.tone ?? "idle"}`} x=${percent(place(mark.at))} y=${y + 32}>${mark.sign}<title>${`${plain(mark.text)}, ${time(mark.at)}`}</title></text>`)}`;
      })}
    </svg></div>`;
}
