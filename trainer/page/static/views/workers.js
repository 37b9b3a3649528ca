//! Workers: who is here, what they hold and held, and what waits for them.

import { get, runPath } from "../api.js";
import { count, date, duration, plain, time } from "../format.js";
import { History, inWords } from "../history.js";
import { timeLine } from "../lanes.js";
import { badge, command, firstLine, joinCommand, mainStages, prose } from "../parts.js";
import { address } from "../router.js";
import { serverNow } from "../session.js";
import { html, nothing } from "../vendor/lit-html.js";

/** Lanes that are drawn, and events that are listed. */
const [LANES, EVENTS] = [24, 60];
/** Stretches of time to look at, in hours. @type {[number, string][]} */
const STRETCHES = [[1, "1 h"], [6, "6 h"], [24, "1 day"], [168, "7 days"]];

/** Lanes of workers out of what happened. @param {HistoryRow[]} rows Oldest first. @param {number} now @returns {import("../lanes.js").Lane[]} */
export function lanesOf(rows, now) {
  /** @type {Map<string, import("../lanes.js").Lane & {open: (import("../lanes.js").Bar & {run: string, stage: string}) | null}>} */
  const lanes = new Map();
  /** @type {Map<string, number>} A colour for each run. */
  const lines = new Map();
  const lane = (/** @type {string} */ name) => {
    const known = lanes.get(name) ?? { name, bars: [], marks: [], open: null };
    lanes.set(name, known);
    return known;
  };
  const end = (/** @type {ReturnType<typeof lane>} */ it, /** @type {number} */ at) => {
    if (it.open) it.open.to = at;
    it.open = null;
  };
  const endAll = (/** @type {HistoryRow} */ row) => {
    for (const it of lanes.values()) if (it.open && it.open.run === row.run && (!row.stage || it.open.stage === row.stage)) end(it, row.at_ms);
  };
  for (const row of rows) {
    const at = row.at_ms;
    const it = row.worker ? lane(row.worker) : null;
    const mark = (/** @type {string} */ sign, /** @type {string} */ tone, target = it) => target?.marks.push({ at, sign, tone, text: `${target.name}: ${inWords(row)}` });
    if (row.kind === "granted" || row.kind === "adopted") {
      if (!it || !row.run || !row.stage) continue;
      end(it, at);
      if (!lines.has(row.run)) lines.set(row.run, lines.size % 8);
      it.open = { from: at, to: now, text: `${row.run} / ${row.stage}`, href: address("runs", row.run, row.stage), line: lines.get(row.run), run: row.run, stage: row.stage };
      it.bars.push(it.open);
      if (row.kind === "adopted") mark("+", "good");
    } else if (row.kind === "lost" || row.kind === "left") {
      if (it) end(it, at);
      mark("✕", row.kind === "lost" ? "bad" : "idle");
    } else if (row.kind === "joined" || row.kind === "returned") mark("▸", "good");
    else if (row.kind === "regrouped") {
      const without = /without ([^;]+?)(?:, with |$)/.exec(row.why ?? "")?.[1]?.split(", ") ?? [];
      for (const name of without) if (lanes.has(name)) end(lane(name), at);
      for (const other of lanes.values()) if (other.open?.run === row.run && other.open?.stage === row.stage) mark("↻", "warn", other);
    } else if (row.kind === "released" || row.kind === "retried") {
      if (it) end(it, at);
      else endAll(row);
      mark("↻", "warn");
    } else if (row.kind === "finished" || row.kind === "failed" || row.kind === "ended") endAll(row);
  }
  return [...lanes.values()];
}
/** Waiting runs whose stages are asked for. */
const WAITING = 20;

/** @param {Context} context @returns {View} */
export function workers(context) {
  /** @type {WorkerRow[]} */
  let list = [];
  /** @type {{run: Run, stage: Stage}[]} */
  let queue = [];
  let beats = 0;
  let withGone = false;
  let hours = 6;
  let history = since(hours);

  /** @param {number} hours */
  function since(hours) {
    return new History({ since: String(Math.round(serverNow() - hours * 3600e3)) });
  }

  /** @param {AbortSignal} signal */
  async function load(signal) {
    list = await get("/v1/workers", signal);
    await history.load(signal);
    if (beats % 3 === 0) {
      const list = /** @type {RunList} */ (await get("/v1/runs?limit=100&state=running", signal));
      const waiting = list.items.filter((run) => run.wants_workers).slice(0, WAITING);
      const runs = /** @type {Run[]} */ (await Promise.all(waiting.map((run) => get(runPath(run.run), signal))));
      queue = runs.flatMap((run) => mainStages(run).filter((stage) => stage.wants_workers).map((stage) => ({ run, stage })));
    }
    beats += 1;
  }

  /** @param {WorkerRow} worker */
  function row(worker) {
    const [run, stage, part] = worker.task?.split("/") ?? [];
    return html`<tr><td>${badge(worker.state)}</td><th scope="row">${worker.worker}</th>
      <td>${run && stage ? html`<a href=${address("runs", run, stage)}>${run} / ${stage}</a>${part ? html` <span class="dim">${/^\d+$/.test(part) ? `shard ${part}` : part}</span>` : nothing}` : nothing}</td>
      <td class="wide">${worker.backend}</td><td class="wide dim">${plain(worker.instruction_set)}</td><td class="wide dim num">${worker.pid}</td></tr>`;
  }

  function times() {
    const now = serverNow();
    const lanes = lanesOf(history.rows, now).filter((lane) => lane.bars.length > 0 || lane.marks.length > 0);
    const order = (/** @type {string} */ name) => list.findIndex((worker) => worker.worker === name && worker.state !== "gone") === -1;
    const sorted = lanes.sort((a, b) => Number(order(a.name)) - Number(order(b.name)) || a.name.localeCompare(b.name, "en", { numeric: true }));
    const shown = sorted.slice(0, LANES);
    const from = Math.max(now - hours * 3600e3, history.rows[0]?.at_ms ?? now);
    const marks = shown.flatMap((lane) => lane.marks);
    const events = history.rows.filter((row) => row.worker || row.kind === "regrouped").reverse().slice(0, EVENTS);
    /** @param {number} wanted */
    const choose = (wanted) => () => {
      hours = wanted;
      history = since(hours);
      void context.refresh();
    };
    return html`<section aria-labelledby="lanes"><div class="row"><h2 id="lanes">Time line</h2><span class="grow"></span>
        <div class="chips" role="group" aria-label="Hours">${STRETCHES.map(([stretch, text]) => html`<button type="button" aria-pressed=${stretch === hours ? "true" : "false"} @click=${choose(stretch)}>${text}</button>`)}</div></div>
      ${shown.length === 0
        ? html`<p class="card dim">Nothing happened in this time.</p>`
        : html`<div class="card">${timeLine(shown, [from, now], `${count(shown.length, "worker")} over ${duration((now - from) / 1000)}, with ${count(marks.filter((mark) => mark.tone === "bad").length, "loss", "losses")} and ${count(history.rows.filter((row) => row.kind === "regrouped").length, "regrouping")}`)}
          <p class="dim small legend"><span class="good-text">▸</span> came <span class="bad-text">✕</span> was lost <span class="warn-text">↻</span> the gang went on with others <span class="good-text">+</span> was taken in. Grey: nothing was done, squeezed.</p>
          ${sorted.length > LANES ? html`<p class="dim">and ${count(sorted.length - LANES, "more worker")}</p>` : nothing}
          <details class="values"><summary>What happened</summary><ol class="events">${events.map((row) => html`<li><time title=${date(row.at_ms)}>${time(row.at_ms)}</time> ${row.worker ? html`<b>${row.worker}</b> ` : nothing}${row.run && row.stage ? html`<a href=${address("runs", row.run, row.stage)}>${row.run} / ${row.stage}</a> ` : nothing}<span dir="auto">${plain(inWords(row))}</span></li>`)}</ol></details></div>`}</section>`;
  }

  function render() {
    const order = ["working", "leaving", "idle", "silent", "unreachable", "gone"];
    const here = list.filter((worker) => worker.state !== "gone");
    const gone = list.length - here.length;
    const shown = [...(withGone ? list : here)].sort((a, b) => order.indexOf(a.state) - order.indexOf(b.state) || a.worker.localeCompare(b.worker, "en", { numeric: true }));
    const working = here.filter((worker) => worker.state === "working").length;
    return html`<div class="row head"><h1 tabindex="-1">Workers</h1><span class="dim">${count(here.length, "worker")}, ${working} at work</span></div>
      ${queue.length > 0 ? html`<section aria-labelledby="queue"><h2 id="queue">What waits</h2><ul class="cards">${queue.slice(0, 20).map(({ run, stage }) => html`<li class="card want warn"><p class="what"><a href=${address("runs", run.run, stage.name)}><b>${run.run} / ${stage.name}</b></a></p><p class="why">${prose(firstLine(stage.message))}</p>${command(joinCommand(stage.wants_workers ?? 1, stage.message), context)}</li>`)}</ul>
        ${queue.length > 20 ? html`<p class="dim">and ${count(queue.length - 20, "more stage")}</p>` : nothing}</section>` : nothing}
      ${shown.length === 0
        ? html`<section class="card empty"><p>No worker is here. One joins from this machine or another:</p>${command(joinCommand(1), context)}</section>`
        : html`<section aria-labelledby="here"><h2 id="here">Here</h2><div class="card table" tabindex="0" role="group" aria-label="Workers"><table class="workers"><caption class="unseen">Workers</caption><thead><tr><th scope="col">State</th><th scope="col">Worker</th><th scope="col">Works on</th><th scope="col" class="wide">Backend</th><th scope="col" class="wide">Instructions</th><th scope="col" class="wide num">Process</th></tr></thead><tbody>${shown.map(row)}</tbody></table></div></section>`}
      ${gone > 0 ? html`<p><label class="check"><input type="checkbox" .checked=${withGone} @change=${() => { withGone = !withGone; context.draw(); }}> ${count(gone, "worker")} that left</label></p>` : nothing}
      ${times()}`;
  }

  return { title: "Workers", every: 1000, load, render, hears: (row) => row.worker !== undefined || row.run !== undefined };
}
