//! Runs beside each other: curves in one chart with one cursor, the settings that differ, and what came of them.

import { CallError, get, registry, runPath } from "../api.js";
import { Chart, inOrder, inWords, series } from "../chart.js";
import { count, number, plain } from "../format.js";
import { lineClass, swatch } from "../marks.js";
import { badge, isDone, isOver, mainStages, runState } from "../parts.js";
import { address, remember } from "../router.js";
import { may } from "../session.js";
import { flat, inText, settingsOf } from "../settings.js";
import { html, nothing } from "../vendor/lit-html.js";

/** Runs at once, charts at first, and beats between two questions for curves. */
const [MOST, FIRST, CURVES_EVERY] = [20, 6, 4];

/** @param {Context} context @returns {View} */
export function compare(context) {
  const query = new URLSearchParams(location.search);
  let names = [...new Set(query.getAll("run"))].slice(0, MOST);
  let axis = /** @type {import("../chart.js").Axis} */ (["step", "time", "hours"].find((name) => name === query.get("x")) ?? "step");
  let [logScale, smooth, all, words, onlyDiffering] = [query.has("log"), !query.has("rough"), false, query.get("q") ?? "", true];
  /** @type {Run[]} */
  let runs = [];
  /** @type {Map<string, RunSettings>} */
  const settings = new Map();
  /** @type {import("../chart.js").Series[]} */
  let curves = [];
  /** @type {Map<string, Chart>} */
  const charts = new Map();
  /** The newest version that each run made. @type {Map<string, string>} */
  const made = new Map();
  let beats = 0;
  let asked = "";

  /** @param {AbortSignal} signal */
  async function load(signal) {
    if (names.length === 0) return;
    if (beats === 0 || runs.some((run) => !isOver(run))) runs = await Promise.all(names.map((name) => get(runPath(name), signal)));
    for (const name of names) if (!settings.has(name)) settings.set(name, await settingsOf(name, signal));
    const question = `${names.join()} ${axis}`;
    if (question !== asked || (beats % CURVES_EVERY === 0 && runs.some((run) => !isOver(run)))) {
      curves = await series({ runs: names, axis, points: names.length > 8 ? 300 : 600, keys: await keysOf(signal) }, signal);
      asked = question;
    }
    if (beats === 0) await versions(signal);
    beats += 1;
  }

  /** Finds the versions of models that the runs made. @param {AbortSignal} signal */
  async function versions(signal) {
    const models = new Set([...settings.values()].flatMap((known) => known.stages).flatMap(({ settings: values }) => (typeof values?.model === "string" && values.from !== undefined ? [values.model] : [])));
    for (const model of [...models].slice(0, 8)) {
      try {
        const shown = /** @type {{versions: Version[]}} */ (await registry({ command: "show", reference: model }, signal));
        for (const { version, source } of shown.versions) if (typeof source?.run === "string" && names.includes(source.run)) made.set(source.run, `${model}:${version}`);
      } catch (error) {
        // A model that was not registered yet.
        if (!(error instanceof CallError) || error.isAway) throw error;
      }
    }
  }

  /** Motions of each with one seed are drawn in the playground. */
  function motions() {
    const models = names.flatMap((name) => made.get(name) ?? []).slice(0, 4);
    if (models.length === 0 || !may("submit")) return nothing;
    return html`<section aria-labelledby="motions"><h2 id="motions">Motions</h2><p class="card row"><span class="dim grow">${models.join(", ")}, side by side with one sentence and one seed</span><a class="button main" href=${`/draw?${models.map((model) => `model=${encodeURIComponent(model)}`).join("&")}`}>Draw with each</a></p></section>`;
  }

  /** Keys of the charts in sight: those of many runs in full would be more than a server gives at once. @param {AbortSignal} signal */
  async function keysOf(signal) {
    if (names.length <= 3) return [];
    const known = await series({ runs: names.slice(0, 2), points: 2 }, signal);
    const keys = inOrder(new Set(known.map((curve) => curve.key)));
    return keys.filter((key) => key.toLowerCase().includes(words.toLowerCase())).slice(0, all ? 40 : 8);
  }

  function keep() {
    const query = new URLSearchParams();
    for (const name of names) query.append("run", name);
    if (axis !== "step") query.set("x", axis);
    if (logScale) query.set("log", "");
    if (!smooth) query.set("rough", "");
    if (words) query.set("q", words);
    remember(query);
    context.draw();
  }

  /** @param {string} name */
  function drop(name) {
    names = names.filter((other) => other !== name);
    runs = runs.filter((run) => run.run !== name);
    curves = curves.filter((curve) => curve.run !== name);
    keep();
  }

  const heads = () => names.map((name, at) => html`<th scope="col" class="num"><span class="run-name">${swatch(at)} ${name}</span></th>`);

  /** @param {string} stage @param {string} key @param {import("../chart.js").Series[]} of */
  function chart(stage, key, of) {
    const id = `${stage}/${key}`;
    const lines = (/** @type {import("../chart.js").Series[]} */ all) => all.map((curve) => ({ label: curve.run, curve, line: names.indexOf(curve.run) }));
    const finer = (/** @type {number} */ from, /** @type {number} */ to) => series({ runs: names, stage, keys: [key], axis, from, to }).then(lines);
    let shown = charts.get(id);
    if (!shown) charts.set(id, (shown = new Chart(230, finer)));
    shown.show(lines(of), { log: logScale, smooth, axis });
    return html`<figure class="card chart"><figcaption dir="auto">${stage} <span class="dim">${plain(key)}</span></figcaption>
      <div role="img" aria-label=${of.map((curve) => `${curve.run}, ${inWords(key, curve)}`).join("; ")}>${shown.element}</div>
      <details class="values"><summary>As a table</summary><div class="table" tabindex="0" role="group" aria-label=${`${plain(key)} of ${stage}`}><table><caption class="unseen">${plain(key)} of ${stage}</caption><thead><tr><th scope="col">Run</th><th scope="col" class="num">Least</th><th scope="col" class="num">Most</th><th scope="col" class="num">Last</th></tr></thead>
        <tbody>${of.map((curve) => {
          const finite = (/** @type {(number | null)[]} */ values) => values.filter((value) => value !== null && Number.isFinite(value)).map(Number);
          return html`<tr><th scope="row">${curve.run}</th><td class="num">${number(Math.min(...finite(curve.min ?? curve.mean)))}</td><td class="num">${number(Math.max(...finite(curve.max ?? curve.mean)))}</td><td class="num">${number(finite(curve.mean).at(-1))}</td></tr>`;
        })}</tbody></table></div></details></figure>`;
  }

  function curveSection() {
    /** @type {Map<string, {stage: string, key: string, of: import("../chart.js").Series[]}>} */
    const groups = new Map();
    for (const curve of curves) {
      const id = `${curve.stage}/${curve.key}`;
      const group = groups.get(id) ?? { stage: curve.stage, key: curve.key, of: [] };
      group.of.push(curve);
      groups.set(id, group);
    }
    const keys = inOrder(new Set([...groups.values()].map((group) => group.key)));
    const ordered = keys.flatMap((key) => [...groups.values()].filter((group) => group.key === key));
    const wanted = ordered.filter((group) => `${group.stage} ${group.key}`.toLowerCase().includes(words.toLowerCase()));
    const shown = all ? wanted : wanted.slice(0, FIRST);
    for (const [id, chart] of charts) {
      if (groups.has(id)) continue;
      chart.close();
      charts.delete(id);
    }
    const flip = (/** @type {() => void} */ change) => () => {
      change();
      keep();
    };
    /** @param {Event} event */
    const search = (event) => {
      words = /** @type {HTMLInputElement} */ (event.currentTarget).value;
      keep();
    };
    /** @param {import("../chart.js").Axis} name */
    const choose = (name) => () => {
      axis = name;
      keep();
      void context.refresh();
    };
    return html`<section aria-labelledby="curves"><div class="row"><h2 id="curves">Curves</h2>
        <label class="field grow"><span class="unseen">Curves that contain</span><input type="search" placeholder="Find a curve" .value=${words} @input=${search}></label>
        <div class="chips" role="group" aria-label="Axis">${/** @type {import("../chart.js").Axis[]} */ (["step", "hours", "time"]).map((name) => html`<button type="button" aria-pressed=${name === axis ? "true" : "false"} @click=${choose(name)}>${name}</button>`)}</div>
        <label class="check"><input type="checkbox" .checked=${smooth} @change=${flip(() => (smooth = !smooth))}> smooth</label>
        <label class="check"><input type="checkbox" .checked=${logScale} @change=${flip(() => (logScale = !logScale))}> log scale</label></div>
      ${shown.length === 0 ? html`<p class="card dim">${curves.length === 0 ? "None of them has a curve yet." : "No curve is called so."}</p>` : html`<div class="charts">${shown.map(({ stage, key, of }) => chart(stage, key, of))}</div>`}
      ${wanted.length > shown.length ? html`<p class="center"><button type="button" @click=${() => { all = true; asked = ""; context.draw(); void context.refresh(); }}>${count(wanted.length - shown.length, "more curve")}</button></p>` : nothing}</section>`;
  }

  function settingSection() {
    const lists = names.map((name) => {
      /** @type {Map<string, unknown>} */
      const found = new Map();
      const known = settings.get(name);
      if (known) found.set("seed", known.seed);
      for (const stage of known?.stages ?? []) flat(stage.settings, stage.stage, found);
      return found;
    });
    const paths = [...new Set(lists.flatMap((list) => [...list.keys()]))];
    const rows = paths.filter((path) => !onlyDiffering || new Set(lists.map((list) => inText(list.get(path)))).size > 1);
    const total = paths.length;
    return html`<section aria-labelledby="settings"><div class="row"><h2 id="settings">Settings</h2><span class="grow"></span><label class="check"><input type="checkbox" .checked=${onlyDiffering} @change=${() => { onlyDiffering = !onlyDiffering; context.draw(); }}> only what differs</label></div>
      ${rows.length === 0 ? html`<p class="card dim">All ${total} settings are the same.</p>` : html`<div class="card table" tabindex="0" role="group" aria-label="Settings of the runs"><table class="beside"><caption class="unseen">Settings of the runs</caption><thead><tr><th scope="col">Setting</th>${heads()}</tr></thead>
        <tbody>${rows.map((path) => html`<tr><th scope="row"><code>${plain(path)}</code></th>${lists.map((list) => html`<td class="num">${plain(inText(list.get(path)))}</td>`)}</tr>`)}</tbody></table></div>`}</section>`;
  }

  /** What the stages measured last, with the interval where one was measured. */
  function results() {
    const found = runs.map((run) => {
      /** @type {Map<string, number>} */
      const values = new Map();
      for (const stage of mainStages(run)) if (isDone(stage)) for (const [key, value] of Object.entries(stage.metrics)) values.set(`${stage.name}: ${key}`, value);
      return values;
    });
    // `fid.lower`, `fid.upper` and `fid_sd` belong to `fid`.
    const isPart = (/** @type {string} */ key) => [".lower", ".upper", "_sd"].some((end) => key.endsWith(end) && found.some((values) => values.has(key.slice(0, -end.length))));
    const rank = (/** @type {string} */ key) => (/fid/.test(key) ? 0 : /recognised|precision|mpjpe/.test(key) ? 1 : 2);
    const keys = [...new Set(found.flatMap((values) => [...values.keys()]))].filter((key) => !isPart(key)).sort((a, b) => rank(a) - rank(b));
    if (keys.length === 0) return nothing;
    const cell = (/** @type {Map<string, number>} */ values, /** @type {string} */ key) => {
      const part = (/** @type {string} */ end) => values.get(key + end);
      const [lower, upper, deviation] = [part(".lower"), part(".upper"), part("_sd")];
      const spread = lower !== undefined && upper !== undefined ? (upper - lower) / 2 : deviation === undefined ? undefined : 1.96 * deviation;
      return values.has(key) ? html`${number(values.get(key))}${spread === undefined ? nothing : html` <span class="dim">± ${number(spread)}</span>`}` : html`<span class="dim">–</span>`;
    };
    return html`<section aria-labelledby="results"><h2 id="results">Results</h2><div class="card table" tabindex="0" role="group" aria-label="Results of the runs"><table class="beside"><caption class="unseen">Results of the runs</caption><thead><tr><th scope="col">Metric</th>${heads()}</tr></thead>
      <tbody>${keys.map((key) => html`<tr><th scope="row">${plain(key)}</th>${names.map((name) => html`<td class="num">${cell(found[runs.findIndex((run) => run.run === name)] ?? new Map(), key)}</td>`)}</tr>`)}</tbody></table></div></section>`;
  }

  function render() {
    if (names.length === 0) return html`<p class="path"><a href="/runs">Runs</a></p><h1 tabindex="-1">Compare</h1><p class="card dim">No run is chosen. Tick some of <a href="/runs">all runs</a>, up to ${MOST}.</p>`;
    return html`<p class="path"><a href="/runs">Runs</a></p>
      <div class="row head"><h1 tabindex="-1">${count(names.length, "run")} beside each other</h1></div>
      <ul class="beside-runs">${names.map((name, at) => {
        const run = runs.find((run) => run.run === name);
        return html`<li class=${lineClass(at)}>${swatch(at)}<a href=${address("runs", name)}>${name}</a>${run ? badge(runState(run)) : nothing}<button type="button" class="quiet" aria-label=${`Leave out ${name}`} @click=${() => drop(name)}>✕</button></li>`;
      })}</ul>
      ${curveSection()}${results()}${motions()}${settingSection()}`;
  }

  const close = () => {
    for (const shown of charts.values()) shown.close();
  };
  return { title: "Compare", every: 2000, load, render, close };
}
