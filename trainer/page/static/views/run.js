//! One run: if it failed why, then its stages, curves, time line, settings, products and log.

import { blob, CallError, get, post, runPath } from "../api.js";
import { CAUSES, OTHERWISE, whatToDo } from "../advice.js";
import { Chart, curves, inOrder, inWords, mainKey, series } from "../chart.js";
import { ago, count, date, duration, grouped, number, plain, short, time } from "../format.js";
import { graph, MOST } from "../graph.js";
import { History, inWords as eventInWords } from "../history.js";
import { timeLine } from "../lanes.js";
import { Log, logLine } from "../log.js";
import { badge, bar, command, fact, failed, firstLine, headline, isDone, isOver, joinCommand, left, mainStages, pace, prose, reached, reason, runState, share, sure } from "../parts.js";
import { Rates } from "../rates.js";
import { address } from "../router.js";
import { controls, serverNow } from "../session.js";
import { inText, settingsOf } from "../settings.js";
import { sweepView } from "../sweep.js";
import { html, nothing } from "../vendor/lit-html.js";

/** Lines of the log around a failure. */
const AROUND = 14;
/** Charts of a run: one for each training, which the stage's own view has more of. */
const MOST_CHARTS = 8;
/** Every how many beats curves are asked for. */
const CURVES_EVERY = 5;

/** @param {Context} context @param {string} name @returns {View} */
export function run(context, name) {
  /** @type {Run | null} */
  let it = null;
  let beats = 0;
  const rates = new Rates();
  const log = new Log(name, null, context.draw);
  const history = new History({ run: name });
  /** @type {RunSettings | null} */
  let settings = null;
  /** @type {Map<string, SettingsOfStage>} Settings by stage. */
  let byStage = new Map();
  /** Keys and states of the stages when the settings were asked for: why a stage ran hangs on them. */
  let asOf = "";
  /** @type {Map<string, {chart: Chart, key: string, curve: Curve}>} By stage. */
  const charts = new Map();
  /** @type {LogLine[]} */
  let around = [];
  let aroundOf = "";
  /** @type {Map<string, string>} Addresses of pictures by stage and name. */
  const pictures = new Map();
  /** @type {Set<string>} */
  const asked = new Set();
  let [logScale, smooth, busy] = [false, true, false];

  /** @param {AbortSignal} signal */
  async function load(signal) {
    const before = it;
    it = /** @type {Run} */ (await get(runPath(name), signal));
    rates.see(it);
    const changed = before?.state !== it.state;
    const broken = it.state === "failed" ? failed(it) : undefined;
    if (broken && aroundOf !== `${broken.name}/${broken.key}`) {
      around = await get(`${runPath(name)}/logs?stage=${encodeURIComponent(broken.name)}&last=${AROUND}`, signal);
      aroundOf = `${broken.name}/${broken.key}`;
    }
    if (beats % CURVES_EVERY === 0 && (changed || !isOver(it) || charts.size === 0)) await look(signal);
    if (!isOver(it) || changed) await Promise.all([log.load(signal), beats % 2 === 0 ? history.load(signal) : undefined]);
    void compare(it, signal);
    void draw(it, signal);
    beats += 1;
  }

  /** Fetches the settings, and again once stages have gone on. @param {Run} run @param {AbortSignal} signal */
  async function compare(run, signal) {
    const now = mainStages(run).map((stage) => `${stage.key ?? ""} ${stage.state}`).join();
    if (now === asOf) return;
    asOf = now;
    try {
      settings = await settingsOf(name, signal);
    } catch (error) {
      // The rest of the view does not wait for it.
      asOf = "";
      if (!signal.aborted && !(error instanceof CallError)) throw error;
      return;
    }
    byStage = new Map(settings.stages.map((stage) => [stage.stage, stage]));
    queueMicrotask(context.draw);
  }

  /** @param {AbortSignal} signal */
  async function look(signal) {
    const trained = (it?.stages ?? []).filter((stage) => !stage.of && /^(train|distill)\./.test(stage.kind));
    const wanted = trained.filter((stage) => stage.state !== "waiting" && stage.state !== "skipped").slice(0, MOST_CHARTS);
    for (const stage of wanted) {
      const known = charts.get(stage.name);
      if (known && isDone(stage) && known.curve.total > 0 && beats > 0 && known.chart.lines[0]?.curve.total === known.curve.total && beats % (CURVES_EVERY * 12) !== 0) continue;
      const keys = (await curves(name, stage.name, signal)).get(stage.name);
      const key = mainKey(keys);
      const curve = key ? keys?.get(key) : undefined;
      const finer = (/** @type {number} */ from, /** @type {number} */ to) => series({ runs: [name], stage: stage.name, keys: [key ?? ""], from, to }).then((all) => all.map((curve) => ({ label: curve.key, curve })));
      if (key && curve) charts.set(stage.name, { chart: known?.chart ?? new Chart(190, finer), key, curve });
    }
  }

  /** Fetches the pictures that stages drew. @param {Run} run @param {AbortSignal} signal */
  async function draw(run, signal) {
    for (const stage of mainStages(run)) {
      if (!isDone(stage) || !stage.kind.startsWith("evaluate")) continue;
      for (const output of Object.values(stage.outputs)) {
        if (asked.has(output)) continue;
        asked.add(output);
        try {
          const manifest = JSON.parse(new TextDecoder().decode(await blob(output, signal)));
          for (const [file, { digest, bytes }] of Object.entries(manifest.files ?? {})) {
            if (!file.endsWith(".png") || file.includes("/") || bytes > 8e6) continue;
            const data = await blob(digest, signal);
            pictures.set(`${stage.name} ${file}`, URL.createObjectURL(new Blob([data], { type: "image/png" })));
          }
          context.draw();
        } catch (error) {
          if (!(error instanceof CallError) && !(error instanceof SyntaxError)) return;
        }
      }
    }
  }

  /** @param {string} action @param {string} done */
  async function act(action, done) {
    if (busy) return;
    busy = true;
    context.draw();
    try {
      await post(`${runPath(name)}/${action}`);
      context.say(done);
    } catch (error) {
      if (!(error instanceof CallError)) throw error;
      context.say(error.hint ? `${error.message}; ${error.hint}` : error.message);
    }
    busy = false;
    aroundOf = "";
    await context.refresh();
  }

  const resume = (main = true) => html`<button type="button" class=${main ? "main" : ""} ?disabled=${busy} @click=${() => act("resume", "It goes on.")}>Resume</button>`;

  /** @param {Run} run */
  function buttons(run) {
    if (!controls(run.owner)) return nothing;
    const cancel = () => {
      if (sure(`Cancel ${run.run}? What it has finished stays, and it can be resumed.`)) void act("cancel", "Cancelled.");
    };
    return html`<p class="actions">
      ${run.state === "running" ? html`<button type="button" ?disabled=${busy} @click=${() => act("pause", "Pausing: workers save first.")}>Pause</button>` : nothing}
      ${run.state === "paused" || run.state === "cancelled" ? resume() : nothing}
      ${run.state === "running" || run.state === "paused" ? html`<button type="button" class="danger" ?disabled=${busy} @click=${cancel}>Cancel</button>` : nothing}
    </p>`;
  }

  /** @param {Run} run */
  function cause(run) {
    const stage = failed(run);
    if (run.state !== "failed" || !stage) return nothing;
    const last = around[around.length - 1];
    const worker = last?.worker ?? stage.workers[0];
    const message = stage.message ?? "";
    const words = firstLine(message).slice(0, 60);
    const marked = around.findLast((line) => words !== "" && line.text.includes(words)) ?? around.findLast((line) => /error|panick|failed|not finite/i.test(line.text));
    const rest = message.slice(firstLine(message).length).trim();
    return html`<section class="card cause" aria-labelledby="cause">
      <h2 id="cause"><span aria-hidden="true">✕</span> <a href=${address("runs", run.run, stage.name)}>${stage.name}</a> failed</h2>
      <p class="why clamp" dir="auto">${prose(firstLine(message) || "No reason was given.")}</p>
      <p class="actions">${controls(run.owner) ? resume() : nothing}<a class="button" href="#log-title" @click=${toLog}>Log</a></p>
      ${rest ? html`<pre class="rest" tabindex="0">${plain(rest)}</pre>` : nothing}
      <p>${prose(whatToDo(message) ?? OTHERWISE)} <a href=${CAUSES}>Causes of failed stages</a></p>
      <p class="dim small">${stage.kind}${(last?.attempt ?? stage.attempt) > 0 ? ` · attempt ${last?.attempt ?? stage.attempt}` : ""}${worker ? html` · worker ${worker}` : nothing}${stage.wall_s > 0 ? ` · after ${duration(stage.wall_s)}` : ""}</p>
      ${around.length > 0 ? html`<div class="lines few" tabindex="0" role="group" aria-label="The last lines of its log"><div>${around.map((line) => logLine(line, false, line === marked))}</div></div>` : nothing}
      ${controls(run.owner) ? nothing : command(`trainer resume ${run.run}`, context)}
    </section>`;
  }

  /** @param {Event} event */
  function toLog(event) {
    event.preventDefault();
    const title = document.getElementById("log-title");
    title?.setAttribute("tabindex", "-1");
    title?.focus();
    title?.scrollIntoView({ block: "start" });
  }

  /** @param {Run} run */
  function waits(run) {
    const stage = run.state === "running" ? mainStages(run).find((stage) => stage.wants_workers) : undefined;
    return html`${run.storage ? html`<section class="card want bad"><p class="what"><b>The store is in trouble</b></p><p class="why">${prose(run.storage.what)}</p><p class="dim">Training goes on meanwhile; checkpoints are made later.</p></section>` : nothing}
      ${stage ? html`<section class="card want warn"><p class="what"><b>${stage.name}</b> ${prose(firstLine(stage.message))}</p>${command(joinCommand(stage.wants_workers ?? 1, stage.message), context)}</section>` : nothing}`;
  }

  /** @param {Run} run @param {Stage} stage */
  function row(run, stage) {
    const perSecond = rates.of(run, stage);
    const at = stage.state === "running";
    const result = headline(stage);
    const { total, unit } = stage.progress;
    return html`<tr>
      <td>${badge(stage.state)}</td>
      <th scope="row"><a href=${address("runs", run.run, stage.name)}>${stage.name}</a><span class="dim kind">${stage.kind}</span>${because(stage)}</th>
      <td class="work">${at ? html`${bar(share(stage.progress), stage.name)}<span class="num small">${pace(stage, perSecond)}</span>` : stage.state === "waiting" ? html`<span class="dim small">reads ${(stage.needs ?? []).join(", ") || "files"}</span>` : stage.message ? html`<span class="small clamp" dir="auto">${prose(firstLine(stage.message))}</span>` : isDone(stage) && total > 1 ? html`<span class="dim small">${grouped(total)} ${unit}</span>` : nothing}</td>
      <td class=${at ? "num" : "num wide"}>${at ? left(stage, perSecond) : ""}</td>
      <td class=${at ? "num wide" : "num"}>${stage.wall_s > 0 ? duration(stage.wall_s) : ""}</td>
      <td class="num wide">${result ? html`<span class="dim">${result[0]}</span> ${number(result[1])}` : nothing}</td>
    </tr>`;
  }

  /** Why a stage was computed, beside the run before. @param {Stage} stage */
  function because(stage) {
    const known = byStage.get(stage.name);
    const words = plain(known?.why?.text ?? "");
    // In the first run of a pipeline all is new.
    return words === "" || !(settings?.previous || known?.from) ? nothing : html`<span class="because" dir="auto">${words}</span>`;
  }

  function curvesOf() {
    if (charts.size === 0) return nothing;
    for (const [stage, { chart, key, curve }] of charts) chart.show([{ label: key, curve }], { log: logScale, smooth, ticks: history.checkpoints(stage) });
    const flip = (/** @type {() => void} */ change) => () => {
      change();
      context.draw();
    };
    return html`<section aria-labelledby="curves"><div class="row"><h2 id="curves">Curves</h2>
        <span class="grow"></span><label class="check"><input type="checkbox" .checked=${smooth} @change=${flip(() => (smooth = !smooth))}> smooth</label>
        <label class="check"><input type="checkbox" .checked=${logScale} @change=${flip(() => (logScale = !logScale))}> log scale</label></div>
      <div class="charts">${inOrder(charts.keys()).sort((a, b) => order(a) - order(b)).map((stage) => {
        const shown = charts.get(stage);
        return shown ? html`<figure class="card chart"><figcaption><a href=${address("runs", name, stage)}>${stage}</a> <span class="dim">${shown.key}</span></figcaption><div role="img" aria-label=${inWords(shown.key, shown.curve)}>${shown.chart.element}</div></figure>` : nothing;
      })}</div></section>`;
  }

  /** @param {string} stage */
  const order = (stage) => it?.stages.findIndex((other) => other.name === stage) ?? 0;

  /** @param {Run} run */
  function timeOf(run) {
    const begun = mainStages(run).filter((stage) => stage.times?.started_ms);
    if (begun.length === 0) return nothing;
    const now = serverNow();
    const lanes = begun.map((stage) => {
      const from = stage.times?.started_ms ?? now;
      const to = stage.times?.ended_ms ?? (stage.state === "running" ? now : from);
      const tone = { running: "run", failed: "bad", ready: "warn" }[stage.state] ?? "good";
      const marks = history.rows.filter((row) => row.stage === stage.name && ["lost", "regrouped", "retried", "released"].includes(row.kind)).map((row) => ({ at: row.at_ms, sign: "↻", text: eventInWords(row), tone: "warn" }));
      return { name: stage.name, bars: [{ from, to, text: stage.name, tone, href: address("runs", run.run, stage.name) }], marks };
    });
    const from = Math.min(...lanes.map((lane) => lane.bars[0]?.from ?? now));
    const to = Math.max(...lanes.map((lane) => lane.bars[0]?.to ?? from));
    const events = [...history.rows].filter((row) => row.kind !== "granted" && row.kind !== "checkpoint").reverse().slice(0, 40);
    return html`<section aria-labelledby="times"><h2 id="times">Time line</h2><div class="card">${timeLine(lanes, [from, Math.max(to, from + 1)], `${count(lanes.length, "stage")} over ${duration((to - from) / 1000)}`)}
      ${events.length > 0 ? html`<details class="values"><summary>What happened</summary><ol class="events">${events.map((row) => html`<li><time title=${date(row.at_ms)}>${time(row.at_ms)}</time> ${row.stage ? html`<b>${row.stage}</b> ` : nothing}${row.worker ? html`${row.worker} ` : nothing}<span dir="auto">${plain(eventInWords(row))}</span></li>`)}</ol></details>` : nothing}</div></section>`;
  }

  /** Settings as a difference to the run before. @param {Run} run */
  function settingsSection(run) {
    if (!settings) return nothing;
    const { previous, seed, missing = [] } = settings;
    const rows = settings.stages.flatMap((stage) => (stage.why?.changes ?? []).map((change) => ({ stage: stage.stage, ...change })));
    const fresh = settings.stages.filter((stage) => stage.why?.kind === "new").map((stage) => stage.stage);
    const isOtherSeed = settings.stages.some((stage) => stage.why?.kind === "seed");
    return html`<section aria-labelledby="settings"><div class="row"><h2 id="settings">Settings</h2><span class="grow"></span>${previous ? html`<a class="button" href=${`/compare?run=${encodeURIComponent(run.run)}&run=${encodeURIComponent(previous)}`}>Compare with ${previous}</a>` : nothing}</div>
      ${!previous
        ? html`<p class="card dim">This is the first run of ${run.pipeline} here.</p>`
        : rows.length === 0 && fresh.length === 0 && missing.length === 0
          ? html`<p class="card dim">The same settings as <a href=${address("runs", previous)}>${previous}</a>${isOtherSeed ? `, with another seed: ${seed}` : ""}.</p>`
          : html`${rows.length > 0 ? html`<div class="card table" tabindex="0" role="group" aria-label="Settings that differ"><table><caption>Since <a href=${address("runs", previous)}>${previous}</a></caption><thead><tr><th scope="col">Stage</th><th scope="col">Setting</th><th scope="col">Before</th><th scope="col">Now</th></tr></thead>
              <tbody>${rows.map((row) => html`<tr><th scope="row">${row.stage}</th><td><code>${plain(row.path)}</code></td><td class="old">${plain(inText(row.from))}</td><td class="fresh">${plain(inText(row.to))}</td></tr>`)}</tbody></table></div>` : nothing}
            ${fresh.length > 0 ? html`<p class="dim">New since ${previous}: ${fresh.join(", ")}.</p>` : nothing}${missing.length > 0 ? html`<p class="dim">No more here: ${missing.join(", ")}.</p>` : nothing}`}
      ${settings.source ? html`<details class="values"><summary>The pipeline as it was written</summary><pre class="source" tabindex="0">${plain(settings.source)}</pre></details>` : nothing}</section>`;
  }

  /** @param {Run} run */
  function sweeps(run) {
    return run.sweeps?.length
      ? html`<section aria-labelledby="sweeps"><h2 id="sweeps">Sweeps</h2>${run.sweeps.map((sweep) => sweepView(run, sweep, context))}</section>`
      : nothing;
  }

  /** @param {Run} run */
  function products(run) {
    const made = mainStages(run).filter((stage) => isDone(stage) && Object.keys(stage.outputs).length > 0);
    if (made.length === 0) return nothing;
    return html`<section aria-labelledby="products"><h2 id="products">Products</h2>
      ${pictures.size > 0 ? html`<div class="pictures">${[...pictures].map(([title, url]) => html`<figure class="card"><a href=${url} target="_blank" rel="noopener"><img src=${url} alt=${`Drawn by ${title}`} loading="lazy"></a><figcaption class="dim">${title}</figcaption></figure>`)}</div>` : nothing}
      <div class="card table"><table><caption class="unseen">What the stages gave</caption><thead><tr><th scope="col">Stage</th><th scope="col">Output</th><th scope="col">Digest</th></tr></thead>
        <tbody>${made.flatMap((stage) => Object.entries(stage.outputs).map(([output, digest]) => html`<tr><th scope="row"><a href=${address("runs", run.run, stage.name)}>${stage.name}</a></th><td>${output}</td><td><code title=${digest}>${short(digest)}</code></td></tr>`))}</tbody></table></div></section>`;
  }

  /** Links to the models that its stages made versions of. @param {Run} run */
  function registered(run) {
    const made = (settings?.stages ?? []).filter(({ stage }) => run.stages.some((other) => other.name === stage && other.kind === "register" && isDone(other)));
    const models = [...new Set(made.map(({ settings }) => settings).flatMap((values) => (typeof values?.model === "string" ? [values.model] : [])))];
    return models.length === 0 ? "" : models.map((model, at) => html`${at > 0 ? ", " : ""}<a href=${address("models", model)}>${model}</a>`);
  }

  /** Time on the clock, which is more than the work if it waited, and less if stages ran side by side. @param {Run} run */
  function took(run) {
    const { started_ms: from, ended_ms: to } = run.times ?? {};
    return from ? duration(((to ?? serverNow()) - from) / 1000) : "";
  }

  function render() {
    const run = it;
    if (!run) return nothing;
    const stages = mainStages(run);
    const [done, all, part] = reached(run);
    const seconds = stages.reduce((sum, stage) => sum + stage.wall_s, 0);
    const state = runState(run);
    return html`
      <p class="path"><a href="/runs">Runs</a></p>
      <div class="row head"><h1 tabindex="-1">${run.run}</h1>${badge(state)}<span class="grow"></span>${buttons(run)}</div>
      ${cause(run)}${waits(run)}
      <div class="card summary">${isOver(run) ? nothing : bar(part, "All stages")}
        <dl class="facts">${fact("Stages", `${done} of ${all}`)}${fact("Submitted", run.times?.created_ms ? html`<span title=${date(run.times.created_ms)}>${ago(run.times.created_ms, serverNow())}</span>` : "")}${fact("Took", took(run))}${fact("Work", seconds > 0 ? duration(seconds) : "")}${fact("Pipeline", run.pipeline)}${fact("Owner", run.owner?.project ? `${run.owner.name} (${run.owner.project})` : (run.owner?.name ?? ""))}${fact("Made", registered(run))}${fact("Now", isOver(run) || !reason(run) ? "" : prose(reason(run)))}</dl></div>
      ${sweeps(run)}
      <section aria-labelledby="stages"><h2 id="stages">Stages</h2>
        ${stages.length > 1 && stages.length <= MOST && stages.some((stage) => stage.needs?.length) ? graph(run, stages, byStage) : nothing}
        <div class="card table"><table class="stages"><caption class="unseen">${count(stages.length, "stage")} of ${run.run}</caption>
          <thead><tr><th scope="col">State</th><th scope="col">Stage</th><th scope="col">Work</th><th scope="col" class="num wide">Left</th><th scope="col" class="num">Time</th><th scope="col" class="num wide">Result</th></tr></thead>
          <tbody>${stages.map((stage) => row(run, stage))}</tbody></table></div></section>
      ${curvesOf()}${settingsSection(run)}${timeOf(run)}${products(run)}${log.render()}`;
  }

  /** @param {HistoryRow} row */
  function hears(row) {
    // What happened is asked for in even beats.
    if (row.run === name) beats += beats % 2;
    return row.run === name;
  }

  function close() {
    for (const { chart } of charts.values()) chart.close();
    for (const url of pictures.values()) URL.revokeObjectURL(url);
  }

  return { title: name, every: 1000, load, render, hears, close };
}
