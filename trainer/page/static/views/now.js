//! Now: what wants a person, what is under way, what ended last.

import { get, post, runPath, CallError } from "../api.js";
import { whatToDo } from "../advice.js";
import { curves, mainKey } from "../chart.js";
import { count, duration, number } from "../format.js";
import { badge, bar, command, failed, firstLine, icon, isOver, joinCommand, left, mainStages, pace, prose, reached, reason, runState, spark } from "../parts.js";
import { Rates } from "../rates.js";
import { address } from "../router.js";
import { controls, may } from "../session.js";
import { html, nothing } from "../vendor/lit-html.js";

/** Runs that are looked at. */
const NEWEST = 40;
/** Runs under way whose state is asked for each time. */
const LIVE = 12;
/** Every how many beats the list and the curves are asked for. */
const [LIST_EVERY, CURVES_EVERY] = [5, 5];

/** @param {Context} context @returns {View} */
export function now(context) {
  /** @type {RunRow[]} The newest runs in short. */
  let rows = [];
  /** @type {Run[]} Those that are under way, and failed ones, in full. */
  let runs = [];
  /** @type {WorkerRow[]} */
  let workers = [];
  let storage = "ok";
  let beats = 0;
  const rates = new Rates();
  /** @type {Map<string, Curve>} */
  const sparks = new Map();

  /** @param {AbortSignal} signal */
  async function load(signal) {
    const whole = beats % LIST_EVERY === 0;
    if (whole) {
      const [list, all, health] = await Promise.all([get(`/v1/runs?limit=${NEWEST}`, signal), get("/v1/workers", signal), get("/v1/health", signal)]);
      // Draws are short, and shown where they were asked for.
      rows = /** @type {RunList} */ (list).items.filter((run) => run.pipeline !== "draw");
      workers = all;
      storage = health.storage;
    }
    const under = rows.filter((row) => !isOver(row)).slice(0, LIVE);
    // A run that failed stays as it is.
    const broken = unmended().filter((row) => !runs.some((run) => run.run === row.run && isOver(run))).slice(0, LIVE);
    const fresh = /** @type {Run[]} */ (await Promise.all([...under, ...broken].map((row) => get(runPath(row.run), signal))));
    const known = new Map([...runs, ...fresh].map((run) => [run.run, run]));
    runs = rows.flatMap((row) => known.get(row.run) ?? []);
    const live = runs.filter((run) => !isOver(run));
    for (const run of live) rates.see(run);
    if (beats % CURVES_EVERY === 0) await Promise.all(live.map((run) => look(run, signal)));
    beats += 1;
  }

  /** @param {Run} run @param {AbortSignal} signal */
  async function look(run, signal) {
    const stage = mainStages(run).find((stage) => stage.state === "running");
    if (!stage) return;
    const keys = (await curves(run.run, stage.name, signal, 80)).get(stage.name);
    const key = mainKey(keys);
    const curve = key ? keys?.get(key) : undefined;
    if (curve) sparks.set(`${run.run}/${stage.name}`, { ...curve, key });
  }

  /** @param {Run} run @param {string} action @param {string} done */
  async function act(run, action, done) {
    try {
      await post(`${runPath(run.run)}/${action}`);
      context.say(done);
    } catch (error) {
      if (!(error instanceof CallError)) throw error;
      context.say(error.message);
    }
    beats = 0;
    await context.refresh();
  }

  /** Failed runs that no later run of their pipeline has made good. */
  function unmended() {
    const later = new Set();
    return rows.filter((run) => {
      const newest = !later.has(run.pipeline);
      later.add(run.pipeline);
      return newest && run.state === "failed";
    });
  }

  /** @param {RunRow} row */
  function failure(row) {
    const run = runs.find((run) => run.run === row.run);
    if (!run) return nothing;
    const stage = failed(run);
    const advice = whatToDo(stage?.message);
    return html`<li class="card want bad">
      <p class="what"><a href=${address("runs", run.run)}><b>${run.run}</b> failed</a>${stage ? html` in <b>${stage.name}</b>` : nothing}</p>
      <p class="why clamp" dir="auto">${prose(firstLine(stage?.message) || "No reason was given.")}</p>
      ${advice ? html`<p class="dim clamp">${prose(advice)}</p>` : nothing}
      <p class="actions"><a class="button main" href=${address("runs", run.run)}>Look at it</a>
        ${controls(run.owner) ? html`<button type="button" @click=${() => act(run, "resume", `${run.run} goes on.`)}>Resume</button>` : nothing}</p>
    </li>`;
  }

  /** @param {Run} run */
  function waiting(run) {
    const stage = mainStages(run).find((stage) => stage.wants_workers);
    const wants = stage?.wants_workers ?? 1;
    return html`<li class="card want warn">
      <p class="what"><a href=${address("runs", run.run)}><b>${run.run}</b> waits for ${count(wants, "worker")}</a></p>
      <p class="why">${stage?.name} ${prose(firstLine(stage?.message))}.</p>
      ${command(joinCommand(wants, stage?.message), context)}
    </li>`;
  }

  /** @param {Run} run */
  function stopped(run) {
    return html`<li class="card want warn">
      <p class="what"><a href=${address("runs", run.run)}><b>${run.run}</b> is ${runState(run)}</a></p>
      <p class="why">${prose(reason(run) || "It goes on from where it stopped.")}</p>
      ${controls(run.owner) ? html`<p class="actions"><button type="button" class="main" @click=${() => act(run, "resume", `${run.run} goes on.`)}>Resume</button></p>` : nothing}
    </li>`;
  }

  function storageTrouble() {
    const run = runs.find((run) => run.storage);
    return html`<li class="card want bad"><p class="what"><b>The store is in trouble</b></p>
      <p class="why">${prose(run?.storage?.what ?? "What is to be stored cannot be, or what is stored cannot be read.")}</p>
      <p class="dim">Training goes on meanwhile; checkpoints are made later. Free some space on the store's disk, or look whether its bucket answers.</p>
      <p class="actions"><a class="button" href="/store">Store</a></p></li>`;
  }

  /** @param {Run} run */
  function card(run) {
    const [done, all, part] = reached(run);
    const at = mainStages(run).filter((stage) => stage.state === "running");
    return html`<li class="card running">
      <div class="row"><h3><a href=${address("runs", run.run)}>${run.run}</a></h3>${badge(runState(run))}<span class="dim grow right">stage ${Math.min(all, done + 1)} of ${all}</span></div>
      ${bar(part, `${run.run}, all stages`)}
      ${at.length === 0 ? html`<p class="dim">${prose(reason(run) || "Between two stages.")}</p>` : nothing}
      ${at.slice(0, 4).map((stage) => {
        const perSecond = rates.of(run, stage);
        const curve = sparks.get(`${run.run}/${stage.name}`);
        const shown = curve?.key ? stage.progress.metrics[curve.key] ?? curve.mean[curve.mean.length - 1] : undefined;
        return html`<div class="at">
          <div class="steps"><p><a href=${address("runs", run.run, stage.name)}><b>${stage.name}</b></a> <span class="dim">${stage.kind}</span></p>
            <p class="num">${pace(stage, perSecond)}</p>
            <p class="left">${left(stage, perSecond)}</p></div>
          ${curve ? html`<a class="curve" href=${address("runs", run.run, stage.name)}>${spark(curve, curve.key ?? "")}<span class="num">${curve.key} ${number(shown)}</span></a>` : nothing}
        </div>`;
      })}
      ${at.length > 4 ? html`<p class="dim">and ${count(at.length - 4, "more stage")} at work</p>` : nothing}
      <p class="dim small">${workersOf(at)}</p>
    </li>`;
  }

  /** @param {Stage[]} stages */
  function workersOf(stages) {
    const names = [...new Set(stages.flatMap((stage) => stage.workers))];
    return names.length === 0 ? "no worker" : `${count(names.length, "worker")}: ${names.slice(0, 6).join(", ")}${names.length > 6 ? ", …" : ""}`;
  }

  /** @param {RunRow} run */
  function ended(run) {
    return html`<li><a class="line-link" href=${address("runs", run.run)}>${badge(runState(run))}<b class="name">${run.run}</b>
      <span class="dim grow clip" dir="auto">${prose(run.note || `${run.done} of ${run.stages} stages`)}</span>
      <span class="dim num">${run.wall_s > 0 ? duration(run.wall_s) : ""}</span></a></li>`;
  }

  function empty() {
    return html`<section class="card empty"><h2>Nothing has run yet</h2>
      <p>A pipeline is a YAML file. The quickstart needs no download and takes about ten minutes of two cores:</p>
      ${command(`trainer submit configs/quickstart.yaml --server ${location.origin}`, context)}
      <p>Stages run on workers. One joins from this machine or another:</p>
      ${command(joinCommand(1), context)}
      <p class="dim">Here, the file <code>.stride/token</code> has a token while the server runs: <code>--token-file .stride/token</code>.</p></section>`;
  }

  function render() {
    const running = runs.filter((run) => run.state === "running");
    const wants = [
      ...(storage === "trouble" || runs.some((run) => run.storage) ? [storageTrouble()] : []),
      ...unmended().map(failure),
      ...running.filter((run) => mainStages(run).some((stage) => stage.wants_workers)).map(waiting),
      ...runs.filter((run) => run.state === "paused").slice(0, 5).map(stopped),
    ];
    const over = rows.filter(isOver).slice(0, 10);
    const idle = workers.filter((worker) => worker.state === "idle").length;
    const here = workers.filter((worker) => worker.state === "idle" || worker.state === "working").length;
    if (rows.length === 0) return html`<h1 tabindex="-1" class="unseen">Now</h1>${empty()}`;
    return html`
      <div class="row head"><h1 tabindex="-1">Now</h1><span class="dim">${count(running.length, "run")} under way · <a href="/workers">${count(here, "worker")}, ${idle} idle</a></span></div>
      ${wants.length > 0 ? html`<section aria-labelledby="wants"><h2 id="wants">Wants you</h2><ul class="cards">${wants}</ul></section>` : nothing}
      ${running.length > 0
        ? html`<section aria-labelledby="under-way"><h2 id="under-way">Under way</h2><ul class="cards">${running.map(card)}</ul></section>`
        : html`<p class="calm">${icon("check")} ${wants.length > 0 ? "Nothing is under way." : "Nothing is under way, and nothing wants you."}${may("submit") ? html` <code>trainer submit PIPELINE</code> starts a run.` : nothing}</p>`}
      ${over.length > 0 ? html`<section aria-labelledby="ended"><h2 id="ended">Ended last</h2><ul class="list card">${over.map(ended)}</ul><p><a href="/runs">All runs</a></p></section>` : nothing}`;
  }

  /** @param {HistoryRow} row */
  function hears(row) {
    if (row.kind === "checkpoint") return false;
    beats = 0;
    return true;
  }

  return { title: "Now", every: 1000, load, render, hears };
}
