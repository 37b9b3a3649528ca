//! Datasets: their clips with a search over captions, and a clip to be played.

import { CallError, get, runPath } from "../api.js";
import { Clips, FORMATS } from "../features.js";
import { count, duration, grouped, number, plain, short } from "../format.js";
import { Figures } from "../motions.js";
import { fact, isDone } from "../parts.js";
import { address, remember } from "../router.js";
import { html, nothing } from "../vendor/lit-html.js";

/** Rows of the list at once. */
const PAGE = 40;
/** Newest runs whose datasets are listed. */
const RUNS = 30;

/** @param {Context} context @returns {View} */
export function datasets(context) {
  /** @type {{digest: string, run: Run, stage: Stage}[]} */
  let list = [];

  /** @param {AbortSignal} signal */
  async function load(signal) {
    const rows = /** @type {RunList} */ (await get(`/v1/runs?limit=${RUNS}`, signal)).items;
    const runs = /** @type {Run[]} */ (await Promise.all(rows.map((row) => get(runPath(row.run), signal))));
    const all = runs.flatMap((run) => run.stages.filter((stage) => isDone(stage) && stage.kind.startsWith("data.")).flatMap((stage) => Object.values(stage.outputs).map((digest) => ({ digest, run, stage }))));
    list = [...new Map(all.map((it) => [it.digest, it])).values()];
  }

  const render = () => html`<div class="row head"><h1 tabindex="-1">Data</h1></div>
    ${list.length === 0
      ? html`<p class="card dim">No run has read a dataset yet. The stages of kind <code>data.*</code> do.</p>`
      : html`<div class="card table" tabindex="0" role="group" aria-label="Datasets"><table><caption class="unseen">Datasets of the newest runs</caption><thead><tr><th scope="col">Dataset</th><th scope="col">Kind</th><th scope="col">Read by</th></tr></thead>
          <tbody>${list.map(({ digest, run, stage }) => html`<tr><th scope="row"><a href=${address("data", digest)}>${stage.name} <code>${short(digest)}</code></a></th><td>${stage.kind}</td><td><a href=${address("runs", run.run, stage.name)}>${run.run}</a></td></tr>`)}</tbody></table></div>`}`;
  return { title: "Data", every: 10000, load, render };
}

/** @param {Context} context @param {string} digest @returns {View} */
export function dataset(context, digest) {
  const clips = new Clips(digest);
  const figures = new Figures();
  const query = new URLSearchParams(location.search);
  let [words, split, shown] = [query.get("q") ?? "", query.get("split") ?? "all", PAGE];
  /** @type {string} */
  let playing = query.get("clip") ?? "";
  let [wrong, busy, drawn, begun, report] = ["", "", false, false, ""];

  /** @param {AbortSignal} signal */
  async function load(signal) {
    if (begun) return;
    try {
      await clips.open(signal);
      report = await clips.report(signal);
    } catch (error) {
      if (error instanceof CallError || signal.aborted) throw error;
      wrong = error instanceof Error ? error.message : String(error);
    }
    begun = true;
    const wanted = clips.index?.entries.find((entry) => entry.id === playing);
    if (wanted) void play(wanted);
  }

  /** @param {import("../features.js").Entry} entry */
  async function play(entry) {
    [busy, playing, wrong] = [entry.id, entry.id, ""];
    keep();
    try {
      const motions = await clips.motions(entry);
      if (playing !== entry.id) return;
      figures.show(motions, [{ title: captionsOf(entry)[0] ?? entry.id, note: `${entry.id} · ${entry.split} ·` }]);
      drawn = true;
    } catch (error) {
      wrong = error instanceof Error ? error.message : String(error);
    }
    busy = "";
    context.draw();
  }

  /** @param {import("../features.js").Entry} entry */
  const captionsOf = (entry) => entry.captions.map((at) => clips.index?.captions[at]?.text ?? "");

  function keep() {
    const query = new URLSearchParams();
    for (const [name, value] of [["q", words], ["split", split === "all" ? "" : split], ["clip", playing]]) if (name && value) query.set(name, value);
    remember(query);
    context.draw();
  }

  function render() {
    const index = clips.index;
    const head = html`<p class="path"><a href="/data">Data</a></p><div class="row head"><h1 tabindex="-1">Dataset</h1><code class="dim" title=${digest}>${short(digest)}</code></div>`;
    if (!index) return html`${head}<p class="card wrong" role="alert">It cannot be shown: ${plain(wrong)}.</p>`;
    const fps = FORMATS[index.format]?.fps ?? 20;
    const wanted = words.toLowerCase().split(/\s+/).filter((word) => word !== "");
    const found = index.entries.filter((entry) => (split === "all" || entry.split === split) && (wanted.length === 0 || captionsOf(entry).concat(entry.id).some((text) => wanted.every((word) => text.toLowerCase().includes(word)))));
    const splits = ["all", ...new Set(index.entries.map((entry) => entry.split))];
    /** @param {Event} event */
    const search = (event) => {
      words = /** @type {HTMLInputElement} */ (event.currentTarget).value;
      shown = PAGE;
      keep();
    };
    return html`${head}
      <div class="card summary"><dl class="facts">${fact("Clips", grouped(index.clips.length))}${fact("Examples", grouped(index.entries.length))}${fact("Captions", grouped(index.captions.length))}${fact("Length", duration(index.clips.reduce((sum, clip) => sum + clip.frames, 0) / fps))}${fact("Format", index.format)}${splits.slice(1).map((name) => fact(name, grouped(index.entries.filter((entry) => entry.split === name).length)))}</dl></div>
      ${wrong ? html`<p class="wrong" role="alert">${plain(wrong)}</p>` : nothing}
      ${drawn ? figures.element : nothing}
      <div class="row filters clip-filters"><label class="field grow"><span class="unseen">Captions that contain</span><input type="search" placeholder="Find in the captions   /" .value=${words} @input=${search}></label>
        <div class="chips" role="group" aria-label="Split">${splits.map((name) => html`<button type="button" aria-pressed=${name === split ? "true" : "false"} @click=${() => { split = name; keep(); }}>${name}</button>`)}</div></div>
      <p class="dim" role="status">${count(found.length, "example")}</p>
      ${found.length === 0 ? nothing : html`<ul class="list card clips">${found.slice(0, shown).map((entry) => html`<li class=${entry.id === playing ? "playing" : ""}><button type="button" class="quiet" aria-label=${`Play ${plain(entry.id)}`} ?disabled=${busy === entry.id} @click=${() => play(entry)}>▸</button>
        <div class="grow"><p dir="auto">${captionsOf(entry).slice(0, 3).map((text, at) => html`${at > 0 ? html`<span class="dim"> · </span>` : nothing}${plain(text)}`)}</p><p class="dim small">${plain(entry.id)} · ${number(entry.len / fps)} s · ${entry.split}${entry.captions.length > 3 ? ` · ${entry.captions.length} captions` : ""}</p></div></li>`)}</ul>`}
      ${report ? html`<details class="values" ?open=${/left out: [1-9]/.test(report)}><summary>What was left out, and why</summary><pre class="source" tabindex="0">${plain(report)}</pre></details>` : nothing}
      ${found.length > shown ? html`<p class="center"><button type="button" @click=${() => { shown += PAGE; context.draw(); }}>More</button></p>` : nothing}`;
  }

  return { title: "Dataset", every: 0, load, render, close: () => figures.close() };
}
