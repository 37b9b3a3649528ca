//! Runs: a table of all of them, newest first, with the reason in the row.

import { get } from "../api.js";
import { ago, date, duration } from "../format.js";
import { badge, bar, isOver, mainStages, outcome, prose, reached, reason, runState } from "../parts.js";
import { address, go, remember } from "../router.js";
import { serverNow } from "../session.js";
import { html, nothing } from "../vendor/lit-html.js";

const PAGE = 50;
/** Runs that can be compared at once. */
const MOST = 20;
const STATES = ["all", "running", "failed", "finished", "paused", "cancelled"];

/** @param {Context} context @returns {View} */
export function runs(context) {
  /** @type {Run[]} Newest first. */
  let list = [];
  let more = false;
  let fetching = false;
  const query = new URLSearchParams(location.search);
  let words = query.get("q") ?? "";
  /** @type {Set<string>} Ticked, to be compared. */
  const ticked = new Set();
  let state = STATES.includes(query.get("state") ?? "") ? /** @type {string} */ (query.get("state")) : "all";

  /** @param {AbortSignal} signal */
  async function load(signal) {
    const newest = /** @type {Run[]} */ (await get(`/v1/runs?limit=${PAGE}`, signal)).reverse();
    if (list.length === 0) more = newest.length >= PAGE;
    const known = new Set(newest.map((run) => run.run));
    list = [...newest, ...list.filter((run) => !known.has(run.run))];
  }

  async function older() {
    if (fetching) return;
    fetching = true;
    context.draw();
    try {
      const last = list[list.length - 1]?.run ?? "";
      const before = /** @type {Run[]} */ (await get(`/v1/runs?limit=${PAGE}&before=${encodeURIComponent(last)}`)).reverse();
      more = before.length >= PAGE;
      list = [...list, ...before];
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
    context.draw();
  }

  /** @param {Run} run */
  function shows(run) {
    if (state !== "all" && run.state !== state) return false;
    const text = `${run.run} ${run.pipeline} ${run.owner?.name ?? ""} ${run.owner?.project ?? ""} ${runState(run)} ${reason(run)}`.toLowerCase();
    return words.toLowerCase().split(/\s+/).every((word) => text.includes(word));
  }

  /** @param {Run} run */
  function row(run) {
    const [done, all, part] = reached(run);
    const seconds = mainStages(run).reduce((sum, stage) => sum + stage.wall_s, 0);
    const owner = run.owner?.project ? `${run.owner.name} (${run.owner.project})` : (run.owner?.name ?? "");
    const created = run.times?.created_ms;
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
      <td class="reach"><span class="num">${done}/${all}</span>${isOver(run) ? nothing : bar(part, `${run.run}, all stages`)}</td>
      <td class="why" dir="auto">${run.state === "finished" ? outcome(run) : reason(run) ? html`<span class="clamp">${prose(reason(run))}</span>` : nothing}</td>
      <td class="wide dim" title=${created ? date(created) : ""}>${created ? ago(created, serverNow()) : ""}</td>
      <td class="num wide">${seconds > 0 ? duration(seconds) : ""}</td>
      <td class="wide dim">${owner}</td>
    </tr>`;
  }

  function render() {
    const shown = list.filter(shows);
    /** @param {Event} event */
    const search = (event) => {
      words = /** @type {HTMLInputElement} */ (event.currentTarget).value;
      keep();
    };
    return html`<div class="row head"><h1 tabindex="-1">Runs</h1></div>
      <div class="row filters"><label class="field grow"><span class="unseen">Filter runs</span><input type="search" placeholder="Filter by name, state, owner or reason   /" .value=${words} @input=${search}></label>
        <div class="chips" role="group" aria-label="State">${STATES.map((name) => html`<button type="button" aria-pressed=${name === state ? "true" : "false"} @click=${() => { state = name; keep(); }}>${name}</button>`)}</div></div>
      ${shown.length === 0
        ? html`<p class="card dim">${list.length === 0 ? html`Nothing has run yet. <a href="/">Now</a> shows how to begin.` : more ? "None of the newest runs is like this." : "No run is like this."}</p>`
        : html`<div class="card table"><table class="runs"><caption class="unseen">Runs, newest first</caption>
            <thead><tr><th scope="col"><span class="unseen">Compare</span></th><th scope="col">State</th><th scope="col">Run</th><th scope="col" class="wide">Pipeline</th><th scope="col">Stages</th><th scope="col">Reason or result</th><th scope="col" class="wide">Submitted</th><th scope="col" class="num wide">Work</th><th scope="col" class="wide">Owner</th></tr></thead>
            <tbody>${shown.map(row)}</tbody></table></div>`}
      ${ticked.size > 0 ? html`<div class="tray" role="group" aria-label="Runs to compare"><span>${ticked.size === 1 ? "Tick another run to compare" : `${ticked.size} runs`}</span><span class="grow"></span><button type="button" @click=${() => { ticked.clear(); context.draw(); }}>None</button><button type="button" class="main" ?disabled=${ticked.size < 2} @click=${() => go(`/compare?${[...ticked].map((run) => `run=${encodeURIComponent(run)}`).join("&")}`)}>Compare</button></div>` : nothing}
      ${more ? html`<p class="center"><button type="button" ?disabled=${fetching} @click=${older}>${fetching ? "Loading…" : "Older runs"}</button></p>` : nothing}`;
  }

  return { title: "Runs", every: 3000, load, render };
}
