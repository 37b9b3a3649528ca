//! Runs: a table of all of them, newest first, with the reason in the row.

import { get } from "../api.js";
import { ago, date, duration } from "../format.js";
import { badge, bar, isOver, prose, runState } from "../parts.js";
import { address, go, remember } from "../router.js";
import { serverNow } from "../session.js";
import { html, nothing } from "../vendor/lit-html.js";

const PAGE = 50;
/** Runs that can be compared at once. */
const MOST = 20;
/** Milliseconds after the last key until the server is asked. */
const PATIENCE = 200;
const STATES = ["all", "running", "failed", "finished", "paused", "cancelled"];

/** @param {Context} context @returns {View} */
export function runs(context) {
  /** @type {RunRow[]} In the list's order. */
  let list = [];
  /** @type {string | undefined} Where the list goes on. */
  let next;
  let known = false;
  let fetching = false;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  let waits;
  const query = new URLSearchParams(location.search);
  let words = query.get("q") ?? "";
  /** @type {Set<string>} Ticked, to be compared. */
  const ticked = new Set();
  let state = STATES.includes(query.get("state") ?? "") ? /** @type {string} */ (query.get("state")) : "all";

  /** @param {string} [after] @param {AbortSignal} [signal] @returns {Promise<RunList>} */
  function part(after, signal) {
    const query = new URLSearchParams({ limit: `${PAGE}` });
    if (words.trim()) query.set("q", words.trim());
    if (state !== "all") query.set("state", state);
    if (after) query.set("after", after);
    return get(`/v1/runs?${query}`, signal);
  }

  /** @param {AbortSignal} signal */
  async function load(signal) {
    const asked = `${state} ${words}`;
    const newest = await part(undefined, signal);
    if (asked !== `${state} ${words}`) return;
    if (list.length <= newest.items.length) next = newest.next;
    const fresh = new Set(newest.items.map((run) => run.run));
    list = [...newest.items, ...list.filter((run) => !fresh.has(run.run))];
    known = true;
  }

  async function older() {
    if (fetching) return;
    fetching = true;
    context.draw();
    try {
      const before = await part(next);
      next = before.next;
      list = [...list, ...before.items];
    } finally {
      fetching = false;
      context.draw();
    }
  }

  function keep() {
    const query = new URLSearchParams();
    if (words) query.set("q", words);
    if (state !== "all") query.set("state", state);
    remember(query);
    clearTimeout(waits);
    waits = setTimeout(() => {
      [list, next, known] = [[], undefined, false];
      void context.refresh();
    }, PATIENCE);
    context.draw();
  }

  /** @param {RunRow} run */
  function row(run) {
    const owner = run.project ? `${run.owner ?? ""} (${run.project})` : (run.owner ?? "");
    /** @param {Event} event */
    const tick = (event) => {
      if (/** @type {HTMLInputElement} */ (event.currentTarget).checked) ticked.add(run.run);
      else ticked.delete(run.run);
      context.draw();
    };
    return html`<tr class=${ticked.has(run.run) ? "ticked" : ""}>
      <td class="tick"><label><span class="unseen">Compare ${run.run}</span><input type="checkbox" .checked=${ticked.has(run.run)} ?disabled=${!ticked.has(run.run) && ticked.size >= MOST} @change=${tick}></label></td>
      <td>${badge(runState(run))}</td>
      <th scope="row"><a href=${address("runs", run.run)}>${run.run}</a></th>
      <td class="wide dim">${run.pipeline}</td>
      <td class="reach"><span class="num">${run.done}/${run.stages}</span>${isOver(run) ? nothing : bar(run.stages > 0 ? run.done / run.stages : 0, `${run.run}, all stages`)}</td>
      <td class="why" dir="auto">${run.note ? html`<span class="clamp">${prose(run.note)}</span>` : nothing}</td>
      <td class="wide dim" title=${date(run.created_ms)}>${ago(run.created_ms, serverNow())}</td>
      <td class="num wide">${run.wall_s > 0 ? duration(run.wall_s) : ""}</td>
      <td class="wide dim">${owner}</td>
    </tr>`;
  }

  function render() {
    /** @param {Event} event */
    const search = (event) => {
      words = /** @type {HTMLInputElement} */ (event.currentTarget).value;
      keep();
    };
    return html`<div class="row head"><h1 tabindex="-1">Runs</h1></div>
      <div class="row filters"><label class="field grow"><span class="unseen">Filter runs</span><input type="search" placeholder="Filter by name, owner or reason   /" .value=${words} @input=${search}></label>
        <div class="chips" role="group" aria-label="State">${STATES.map((name) => html`<button type="button" aria-pressed=${name === state ? "true" : "false"} @click=${() => { state = name; keep(); }}>${name}</button>`)}</div></div>
      ${list.length === 0
        ? html`<p class="card dim">${!known ? "Loading…" : words || state !== "all" ? (next ? "None of the newest runs is like this." : "No run is like this.") : html`Nothing has run yet. <a href="/">Now</a> shows how to begin.`}</p>`
        : html`<div class="card table"><table class="runs"><caption class="unseen">Runs, newest first</caption>
            <thead><tr><th scope="col"><span class="unseen">Compare</span></th><th scope="col">State</th><th scope="col">Run</th><th scope="col" class="wide">Pipeline</th><th scope="col">Stages</th><th scope="col">Reason or result</th><th scope="col" class="wide">Submitted</th><th scope="col" class="num wide">Work</th><th scope="col" class="wide">Owner</th></tr></thead>
            <tbody>${list.map(row)}</tbody></table></div>`}
      ${ticked.size > 0 ? html`<div class="tray" role="group" aria-label="Runs to compare"><span>${ticked.size === 1 ? "Tick another run to compare" : `${ticked.size} runs`}</span><span class="grow"></span><button type="button" @click=${() => { ticked.clear(); context.draw(); }}>None</button><button type="button" class="main" ?disabled=${ticked.size < 2} @click=${() => go(`/compare?${[...ticked].map((run) => `run=${encodeURIComponent(run)}`).join("&")}`)}>Compare</button></div>` : nothing}
      ${next ? html`<p class="center"><button type="button" ?disabled=${fetching} @click=${older}>${fetching ? "Loading…" : "Older runs"}</button></p>` : nothing}`;
  }

  return { title: "Runs", every: 3000, load, render, hears: (row) => row.run !== undefined && row.kind !== "checkpoint" && row.kind !== "granted", close: () => clearTimeout(waits) };
}
