//! One stage: its curves, numbers and log.

import { CallError, get, runPath } from "../api.js";
import { CAUSES, OTHERWISE, whatToDo } from "../advice.js";
import { Chart, curves, inOrder, inWords, series } from "../chart.js";
import { count, date, duration, grouped, number, plain, rate, short, size, time } from "../format.js";
import { attemptsOf, History } from "../history.js";
import { Log } from "../log.js";
import { badge, bar, command, fact, firstLine, isOver, joinCommand, left, pace, prose, share } from "../parts.js";
import { Rates } from "../rates.js";
import { address } from "../router.js";
import { serverNow } from "../session.js";
import { settingsOf } from "../settings.js";
import { Thumbnails } from "../thumbnails.js";
import { html, nothing } from "../vendor/lit-html.js";

const CURVES_EVERY = 4;
/** Charts at first; a stage of many losses has a button for the rest. */
const FIRST = 12;
/** Rows of the table under a chart. */
const ROWS = 12;

/** @param {Context} context @param {string} name @param {string} stageName @returns {View} */
export function stage(context, name, stageName) {
  /** @type {Run | null} */
  let run = null;
  let beats = 0;
  const rates = new Rates();
  const log = new Log(name, stageName, context.draw);
  /** @type {Map<string, Curve>} */
  let keys = new Map();
  /** @type {Map<string, Chart>} */
  const charts = new Map();
  const thumbnails = new Thumbnails(name, stageName, context.draw);
  let [logScale, smooth, all, words] = [false, true, false, ""];
  let finalSeen = false;
  /** @type {History | null} */
  let history = null;
  let because = "";
  let asOf = "";

  const find = () => run?.stages.find((stage) => stage.name === stageName);

  /** @param {AbortSignal} signal */
  async function load(signal) {
    run = /** @type {Run} */ (await get(runPath(name), signal));
    rates.see(run);
    const it = find();
    const live = it?.state === "running" || it?.state === "ready";
    if (it && it.state !== "waiting" && ((live && beats % CURVES_EVERY === 0) || !finalSeen)) {
      keys = (await curves(name, stageName, signal)).get(stageName) ?? new Map();
      finalSeen = !live;
    }
    if (live) finalSeen = false;
    if (it && asOf !== `${it.key} ${it.state}`) await explain(it, signal);
    else if (live && beats % CURVES_EVERY === 0) await history?.load(signal);
    if (it && (live || beats === 0 || !isOver(run))) await log.load(signal);
    if (it?.key && beats % CURVES_EVERY === 0 && (live || beats === 0)) await thumbnails.load(signal);
    void thumbnails.appear().catch((error) => {
      // The next beat shows that the server is away.
      if (!(error instanceof CallError)) throw error;
    });
    beats += 1;
  }

  /** Fetches why it was computed, and what happened to it: in an earlier run if the result is from there. @param {Stage} it @param {AbortSignal} signal */
  async function explain(it, signal) {
    const settings = await settingsOf(name, signal);
    const known = settings.stages.find((stage) => stage.stage === stageName);
    // In the first run of a pipeline all is new.
    because = settings.previous || known?.from ? plain(known?.why?.text ?? "") : "";
    const source = known?.from ?? name;
    if (history?.asked.run !== source) history = new History({ run: source });
    await history.load(signal);
    asOf = `${it.key} ${it.state}`;
  }

  /** @param {string} key @param {Curve} curve */
  function chart(key, curve) {
    let shown = charts.get(key);
    const finer = (/** @type {number} */ from, /** @type {number} */ to) => series({ runs: [name], stage: stageName, keys: [key], from, to }).then((all) => all.map((part) => ({ label: key, curve: part })));
    if (!shown) charts.set(key, (shown = new Chart(200, finer)));
    shown.show([{ label: key, curve }], { log: logScale, smooth, ticks: history?.checkpoints(stageName) ?? [] });
    const step = Math.max(1, Math.ceil(curve.x.length / ROWS));
    const rows = curve.x.map((x, at) => ({ x, y: curve.mean[at] ?? null })).filter((_, at) => at % step === 0 || at === curve.x.length - 1);
    return html`<figure class="card chart"><figcaption dir="auto">${plain(key)}</figcaption><div role="img" aria-label=${inWords(key, curve)}>${shown.element}</div>
      <details class="values"><summary>As a table</summary><div class="table"><table><caption class="unseen">${plain(key)} by step</caption><thead><tr><th scope="col" class="num">Step</th><th scope="col" class="num">Value</th></tr></thead>
        <tbody>${rows.map(({ x, y }) => html`<tr><td class="num">${grouped(x)}</td><td class="num">${number(y)}</td></tr>`)}</tbody></table></div></details></figure>`;
  }

  function curvesOf() {
    if (keys.size === 0) return nothing;
    const wanted = inOrder(keys.keys()).filter((key) => key.toLowerCase().includes(words.toLowerCase()));
    const shown = all ? wanted : wanted.slice(0, FIRST);
    const flip = (/** @type {() => void} */ change) => () => {
      change();
      context.draw();
    };
    /** @param {Event} event */
    const search = (event) => {
      words = /** @type {HTMLInputElement} */ (event.currentTarget).value;
      context.draw();
    };
    return html`<section aria-labelledby="curves"><div class="row"><h2 id="curves">Curves</h2>
        ${keys.size > 4 ? html`<label class="field grow"><span class="unseen">Curves that contain</span><input type="search" placeholder=${`Find among ${keys.size}`} .value=${words} @input=${search}></label>` : html`<span class="grow"></span>`}
        <label class="check"><input type="checkbox" .checked=${smooth} @change=${flip(() => (smooth = !smooth))}> smooth</label>
        <label class="check"><input type="checkbox" .checked=${logScale} @change=${flip(() => (logScale = !logScale))}> log scale</label></div>
      <div class="charts">${shown.map((key) => chart(key, /** @type {Curve} */ (keys.get(key))))}</div>
      ${wanted.length > shown.length ? html`<p class="center"><button type="button" @click=${flip(() => (all = true))}>${count(wanted.length - shown.length, "more curve")}</button></p>` : nothing}
      <p class="dim small">The band is the least and the most of what one pixel stands for. ${history && history.checkpoints(stageName).length > 0 ? html`<span class="good-text" aria-hidden="true">▲</span> is a checkpoint. ` : nothing}A red tick is a value that was no number. Drag over a chart to zoom, press twice to see all of it.</p></section>`;
  }

  /** @param {Stage} it */
  function numbers(it) {
    const names = Object.keys(it.metrics).sort();
    if (names.length === 0) return nothing;
    return html`<section aria-labelledby="numbers"><h2 id="numbers">${it.state === "running" ? "Newest values" : "Results"}</h2>
      <div class="card"><dl class="facts numbers">${names.map((name) => fact(name, number(it.metrics[name])))}</dl></div></section>`;
  }

  function attempts() {
    const all = attemptsOf(history?.rows ?? [], stageName).slice(-ROWS).reverse();
    if (all.length === 0) return nothing;
    return html`<section aria-labelledby="attempts"><h2 id="attempts">Attempts</h2><div class="card table" tabindex="0" role="group" aria-label="Attempts"><table><caption class="unseen">Attempts at ${stageName}, newest first</caption>
      <thead><tr><th scope="col">Attempt</th><th scope="col">Worker</th><th scope="col">Began</th><th scope="col" class="num">Took</th><th scope="col">Ended</th></tr></thead>
      <tbody>${all.map(({ number: attempt, worker, from, to, end }) => html`<tr><th scope="row">${attempt ?? ""}</th><td>${worker}</td><td class="dim" title=${date(from)}>${time(from)}</td><td class="num">${duration(((to ?? serverNow()) - from) / 1000)}</td><td dir="auto">${to === null ? html`<span class="dim">at work</span>` : html`<span class="clamp">${prose(plain(end))}</span>`}</td></tr>`)}</tbody></table></div></section>`;
  }

  function render() {
    const it = find();
    if (!run) return nothing;
    if (!it) return html`<p class="path"><a href="/runs">Runs</a> / <a href=${address("runs", name)}>${name}</a></p><h1 tabindex="-1">${name} has no stage ${stageName}</h1>`;
    const perSecond = rates.of(run, it);
    const readers = run.stages.filter((other) => other.needs?.includes(stageName));
    const links = (/** @type {string[]} */ names) => names.map((other, at) => html`${at > 0 ? ", " : ""}<a href=${address("runs", name, other)}>${other}</a>`);
    return html`
      <p class="path"><a href="/runs">Runs</a> / <a href=${address("runs", name)}>${name}</a></p>
      <div class="row head"><h1 tabindex="-1">${it.name}</h1>${badge(it.state)}<span class="dim">${it.kind}</span></div>
      ${it.state === "failed" ? html`<section class="card cause"><p class="why" dir="auto">${prose(it.message)}</p><p>${prose(whatToDo(it.message) ?? OTHERWISE)} <a href=${CAUSES}>Causes of failed stages</a></p><p class="actions"><a class="button" href=${address("runs", name)}>To the run</a></p></section>` : nothing}
      ${it.wants_workers ? html`<section class="card want warn"><p class="what">${prose(firstLine(it.message))}</p>${command(joinCommand(it.wants_workers, it.message), context)}</section>` : nothing}
      <div class="card summary">
        ${it.state === "running" && it.progress.total > 0 ? bar(share(it.progress), it.name) : nothing}
        <dl class="facts">
          ${fact("Progress", it.progress.total > 0 ? pace(it, it.state === "running" ? perSecond : undefined) : "")}
          ${fact("Left", it.state === "running" ? left(it, perSecond) : "")}
          ${fact("Speed", it.state === "ran" && it.wall_s > 0 && it.progress.total > 1 ? rate(it.progress.total / it.wall_s, it.progress.unit) : "")}
          ${fact("Time", it.wall_s > 0 ? duration(it.wall_s) : "")}
          ${fact("Memory", it.peak_memory ? html`<span title="The most that one worker's process had at once">${size(it.peak_memory)}</span>` : "")}
          ${fact("Why", because)}
          ${fact("Attempt", it.attempt > 0 ? String(it.attempt) : "")}
          ${fact("Workers", it.workers.join(", "))}
          ${fact("Instruction set", it.instruction_set ?? "")}
          ${fact("Reads", it.needs?.length ? links(it.needs) : "")}
          ${fact("Read by", readers.length > 0 ? links(readers.map((other) => other.name)) : "")}
          ${fact("Key", it.key ? html`<code title=${it.key}>${short(it.key)}</code>` : "")}
          ${Object.entries(it.outputs).map(([output, digest]) => fact(`Gives ${output}`, html`<code title=${digest}>${short(digest)}</code>`))}
          ${fact("State", it.state !== "failed" && !it.wants_workers ? firstLine(it.message) : "")}
        </dl></div>
      ${curvesOf()}${thumbnails.render()}${numbers(it)}${attempts()}${log.render()}`;
  }

  const close = () => {
    thumbnails.close();
    for (const shown of charts.values()) shown.close();
  };
  return { title: `${stageName} of ${name}`, every: 1000, load, render, hears: (row) => row.run === name, close };
}
