//! Models: versions with aliases and gates, and moving an alias with a reason.

import { CallError, registry } from "../api.js";
import { ago, count, date, number, plain, short } from "../format.js";
import { badge, prose, spark } from "../parts.js";
import { address } from "../router.js";
import { may, serverNow } from "../session.js";
import { settingsOf } from "../settings.js";
import { html, nothing } from "../vendor/lit-html.js";

/** @param {Context} _ @returns {View} */
export function models(_) {
  /** @type {Model[]} */
  let list = [];

  /** @param {AbortSignal} signal */
  async function load(signal) {
    list = (await registry({ command: "list" }, signal)).models;
  }

  /** @param {Model} model */
  const row = (model) => html`<tr>
    <th scope="row"><a href=${address("models", model.model)}>${model.model}</a></th>
    <td>${aliases(model.aliases)}</td>
    <td class="num">${model.versions}</td>
    <td class="num wide">${model.best ? `version ${model.best}` : ""}</td>
    <td class="wide dim">${model.metric ? `${model.mode === "max" ? "most" : "least"} ${model.metric}` : ""}</td></tr>`;

  const render = () => html`<div class="row head"><h1 tabindex="-1">Models</h1></div>
    ${list.length === 0
      ? html`<p class="card dim">No model is registered yet. A stage of kind <code>register</code> makes a version of what a pipeline trained.</p>`
      : html`<div class="card table"><table><caption class="unseen">Registered models</caption><thead><tr><th scope="col">Model</th><th scope="col">Aliases</th><th scope="col" class="num">Versions</th><th scope="col" class="num wide">Best</th><th scope="col" class="wide">By</th></tr></thead><tbody>${list.map(row)}</tbody></table></div>`}`;
  return { title: "Models", every: 5000, load, render, hears: (row) => row.model !== undefined };
}

/** A gate as a light, with by how much it holds or does not. @param {string} gate @param {boolean | null} holds @param {number | null} value @param {number | null} bound */
const light = (gate, holds, value, bound) => html`<li class=${holds === null ? "" : holds ? "good" : "bad"}><span aria-hidden="true">${holds === null ? "◌" : holds ? "●" : "○"}</span> <code>${plain(gate)}</code>
  <span class="dim">${holds === null ? "is looked at when it moves" : `${holds ? "holds" : "does not hold"}: ${number(value)}${bound === null ? "" : ` against ${number(bound)}, ${number(Math.abs((value ?? NaN) - bound))} ${(value ?? 0) < bound ? "below" : "above"}`}`}</span></li>`;

/** How a gate would be for a version now; those with other bounds than numbers and aliases are the server's to decide. @param {string} gate @param {Version} version @param {Version[]} all */
function foresee(gate, version, all) {
  const [, metric, sign, right] = /^\s*(\S+?)\s*(<=|>=|<|>)\s*(\S+)\s*$/.exec(gate) ?? [];
  if (!metric || !sign || !right) return light(gate, null, null, null);
  const other = all.find((known) => known.aliases.includes(right));
  const bound = Number.isFinite(Number(right)) ? Number(right) : other?.metrics[metric];
  const value = version.metrics[metric];
  if (bound === undefined || value === undefined) return light(gate, null, null, null);
  const holds = { "<=": value <= bound, ">=": value >= bound, "<": value < bound, ">": value > bound }[sign] ?? null;
  return light(gate, holds, value, bound);
}

/** @param {Record<string, number>} all */
const aliases = (all) => Object.entries(all).map(([alias, version]) => html`<span class="alias">${alias} <span class="dim">→ ${version}</span></span>`);

/** @param {Context} context @param {string} name @returns {View} */
export function model(context, name) {
  /** @type {Model | null} */
  let it = null;
  /** @type {Version[]} Newest first. */
  let versions = [];
  /** @type {Promotion[]} Newest first. */
  let history = [];
  /** @type {{version: Version, alias: string, reason: string, gates: string, wrong: string | null, busy: boolean, back: boolean} | null} */
  let asked = null;
  /** @type {{version: number, nodes: LineageNode[], pipeline: string} | null} */
  let lineage = null;

  /** @param {AbortSignal} [signal] */
  async function load(signal) {
    const [shown, moves] = await Promise.all([registry({ command: "show", reference: name }, signal), registry({ command: "history", model: name, alias: null }, signal)]);
    it = shown.model;
    versions = [...shown.versions].sort((a, b) => b.version - a.version);
    history = [...moves.history].sort((a, b) => b.id - a.id);
  }

  /** @param {Version} version @param {string} alias @param {boolean} back */
  function ask(version, alias, back) {
    // The gates that the alias was moved with last are the ones to begin with.
    const gates = history.find((move) => move.alias === alias && move.gates.length > 0)?.gates.map((gate) => gate.gate).join(", ") ?? "";
    asked = { version, alias, reason: "", gates, wrong: null, busy: false, back };
    context.draw();
    const dialog = /** @type {HTMLDialogElement | null} */ (document.querySelector("dialog.promote"));
    if (dialog && !dialog.open) dialog.showModal();
  }

  function shut() {
    /** @type {HTMLDialogElement | null} */ (document.querySelector("dialog.promote"))?.close();
    asked = null;
    context.draw();
  }

  /** @param {string} text */
  const listed = (text) => text.split(/[,\n]/).map((gate) => gate.trim()).filter((gate) => gate !== "");

  /** @param {SubmitEvent} event */
  async function move(event) {
    event.preventDefault();
    const doing = asked;
    if (!doing || doing.busy || !it) return;
    const fields = new FormData(/** @type {HTMLFormElement} */ (event.currentTarget));
    const alias = String(fields.get("alias") ?? "").trim();
    const reason = String(fields.get("reason") ?? "").trim();
    const require = listed(String(fields.get("gates") ?? ""));
    const at = it.aliases[alias];
    // What was on the screen: whoever moved it meanwhile was faster, and is named.
    const expect = at === undefined ? "none" : String(at);
    Object.assign(doing, { alias, reason, busy: true, wrong: null });
    context.draw();
    try {
      const command = doing.back
        ? { command: "rollback", model: name, alias, to: doing.version.version, expect, reason }
        : { command: "promote", reference: `${name}:${doing.version.version}`, to: alias, expect, require, reason };
      await registry(command);
      shut();
      context.say(`${name}@${alias} is version ${doing.version.version} now.`);
      await context.refresh();
    } catch (error) {
      if (!(error instanceof CallError)) throw error;
      doing.busy = false;
      doing.wrong = error.hint ? `${error.message}; ${error.hint}` : error.message;
      await load().catch(() => {});
      const now = it.aliases[alias];
      const faster = now !== at ? history.find((move) => move.alias === alias) : undefined;
      if (faster) doing.wrong = `${faster.actor} was faster: ${alias} is version ${faster.to} now (“${faster.reason}”). Send again to move it all the same.`;
      context.draw();
    }
  }

  function dialog() {
    const doing = asked;
    if (!doing || !it) return html`<dialog class="promote"></dialog>`;
    const now = it.aliases[doing.alias];
    const from = versions.find((version) => version.version === now);
    const keys = [...new Set([it.metric ?? "", ...Object.keys(doing.version.metrics)])].filter((key) => key in doing.version.metrics).slice(0, 5);
    /** @param {Event} event */
    const alias = (event) => {
      doing.alias = /** @type {HTMLInputElement} */ (event.currentTarget).value.trim();
      context.draw();
    };
    /** @param {Event} event */
    const gated = (event) => {
      doing.gates = /** @type {HTMLInputElement} */ (event.currentTarget).value;
      context.draw();
    };
    return html`<dialog class="promote" aria-labelledby="promote-title" @close=${() => { asked = null; }}>
      <form @submit=${move}>
        <h2 id="promote-title">${doing.back ? "Roll back to" : "Promote"} version ${doing.version.version}</h2>
        <label for="alias">Alias</label>
        <input id="alias" name="alias" list="aliases" .value=${doing.alias} @input=${alias} required pattern="[a-zA-Z0-9][a-zA-Z0-9._\\-]*" maxlength="64" autocapitalize="off" spellcheck="false">
        <datalist id="aliases">${[...new Set(["staging", "prod", ...Object.keys(it.aliases)])].map((alias) => html`<option value=${alias}></option>`)}</datalist>
        <p class="dim">${now === undefined ? "This alias does not exist yet." : html`Now version <b>${now}</b>, then version <b>${doing.version.version}</b>.`}</p>
        ${keys.length > 0 ? html`<div class="table"><table><caption class="unseen">Metrics now and then</caption><thead><tr><th scope="col">Metric</th><th scope="col" class="num">${now === undefined ? "–" : `version ${now}`}</th><th scope="col" class="num">version ${doing.version.version}</th></tr></thead>
          <tbody>${keys.map((key) => html`<tr><th scope="row">${plain(key)}</th><td class="num">${from && key in from.metrics ? number(from.metrics[key]) : "–"}</td><td class="num">${number(doing.version.metrics[key])}</td></tr>`)}</tbody></table></div>` : nothing}
        ${doing.back ? nothing : html`<label for="gates">Gates, if you want some</label><input id="gates" name="gates" .value=${doing.gates} @input=${gated} placeholder="fid <= 0.5, r_precision_top1 >= prod" autocapitalize="off" spellcheck="false">
          <ul class="gates">${listed(doing.gates).map((gate) => foresee(gate, doing.version, versions))}</ul>`}
        <label for="reason">Reason</label>
        <input id="reason" name="reason" .value=${doing.reason} required autofocus maxlength="500" autocomplete="off" placeholder="Why does it move?">
        ${doing.wrong ? html`<p class="wrong" role="alert">${doing.wrong}</p>` : nothing}
        <p class="actions"><button type="submit" class="main" ?disabled=${doing.busy}>${doing.back ? "Roll back" : "Promote"}</button><button type="button" @click=${shut}>Leave it</button></p>
      </form></dialog>`;
  }

  /** The YAML of the run that made a version; empty if the run is not here or not to be seen. @param {Version} version */
  async function pipelineOf(version) {
    const run = version.source?.run;
    if (typeof run !== "string") return "";
    try {
      return (await settingsOf(run)).source;
    } catch (error) {
      if (!(error instanceof CallError)) throw error;
      return "";
    }
  }

  /** @param {Version} version */
  async function trace(version) {
    if (lineage?.version === version.version) lineage = null;
    else {
      try {
        const { nodes } = await registry({ command: "lineage", reference: `${name}:${version.version}` });
        lineage = { version: version.version, nodes, pipeline: "" };
        lineage.pipeline = await pipelineOf(version);
      } catch (error) {
        if (!(error instanceof CallError)) throw error;
        context.say(error.message);
      }
    }
    context.draw();
  }

  /** @param {LineageNode[]} nodes */
  const ancestry = (nodes) => html`<ol class="lineage">${[...nodes].sort((a, b) => a.depth - b.depth).map((node) => html`<li class=${`depth-${Math.min(6, node.depth)}`}><b>${node.kind ?? "file or folder"}</b>
    ${node.run && node.stage ? html`<a href=${address("runs", node.run, node.stage)}>${node.run} / ${node.stage}</a>` : nothing} <code title=${node.digest}>${short(node.digest)}</code></li>`)}</ol>`;

  /** @param {Model} model @param {string[]} keys @param {Version} version */
  function row(model, keys, version) {
    const source = version.source ?? {};
    const run = typeof source.run === "string" ? source.run : null;
    return html`<tr class=${version.version === model.best ? "best" : ""}>
      <th scope="row">${version.version}${version.version === model.best ? html` <span class="star" title="best by its metric">★ best</span>` : nothing}</th>
      <td>${version.aliases.map((alias) => html`<span class="alias">${alias}</span>`)}</td>
      ${keys.map((key, at) => html`<td class=${at > 0 ? "num wide" : "num"}>${key in version.metrics ? number(version.metrics[key]) : ""}</td>`)}
      <td class="wide">${run ? html`<a href=${address("runs", run)}>${run}</a>` : nothing}</td>
      <td class="wide dim" title=${date(version.created_ms)}>${ago(version.created_ms, serverNow())}</td>
      <td class="actions">${may("submit") ? html`<a class="button" href=${`/draw?model=${encodeURIComponent(`${name}:${version.version}`)}`}>Draw</a>` : nothing}<button type="button" aria-expanded=${lineage?.version === version.version ? "true" : "false"} @click=${() => trace(version)}>Lineage</button>
        ${may("promote") ? html`<button type="button" class=${version.version === model.best && !version.aliases.includes("prod") ? "main" : ""} @click=${() => ask(version, version.aliases.includes("staging") ? "prod" : "staging", false)}>Promote</button>` : nothing}</td>
    </tr>${lineage?.version === version.version ? html`<tr><td colspan=${keys.length + 5}>${ancestry(lineage.nodes)}${lineage.pipeline ? html`<details class="values"><summary>The pipeline that makes it again</summary><pre class="source" tabindex="0">${plain(lineage.pipeline)}</pre></details>` : nothing}</td></tr>` : nothing}`;
  }

  /** @param {Promotion} move @param {boolean} newest */
  const moved = (move, newest) => html`<li class="card">
    <p class="row"><b>${move.alias}</b> <span>${move.from ?? "new"} → ${move.to}</span> ${move.action === "rollback" ? badge("paused", "rolled back") : nothing}<span class="dim grow right" title=${date(move.at_ms)}>${ago(move.at_ms, serverNow())}</span></p>
    <p dir="auto">${prose(move.reason || "No reason was given.")} <span class="dim">— ${move.actor}</span></p>
    ${move.gates.length > 0 ? html`<ul class="gates">${move.gates.map((gate) => light(gate.gate, gate.holds, gate.value, gate.bound ?? null))}</ul>` : nothing}
    ${newest && move.from && may("promote") ? html`<p class="actions"><button type="button" @click=${() => { const back = versions.find((version) => version.version === move.from); if (back) ask(back, move.alias, true); }}>Roll back to ${move.from}</button></p>` : nothing}
  </li>`;

  function render() {
    if (!it) return nothing;
    const shown = it;
    const all = [...new Set(versions.flatMap((version) => Object.keys(version.metrics)))];
    const rank = (/** @type {string} */ key) => (key === shown.metric ? 0 : /fid/.test(key) ? 1 : /r_precision_top1/.test(key) ? 2 : 3);
    const keys = all.sort((a, b) => rank(a) - rank(b) || a.localeCompare(b)).slice(0, 3);
    const metric = it.metric ?? keys[0];
    const measured = [...versions].reverse().filter((version) => metric && metric in version.metrics);
    const seen = new Set();
    return html`<p class="path"><a href="/models">Models</a></p>
      <div class="row head"><h1 tabindex="-1">${it.model}</h1>${aliases(it.aliases)}</div>
      ${metric && measured.length > 2 ? html`<figure class="card over"><figcaption>${plain(metric)} <span class="dim">over ${count(measured.length, "version")}, ${it.mode === "max" ? "most" : "least"} is best</span></figcaption>${spark({ x: measured.map((version) => version.version), mean: measured.map((version) => version.metrics[metric] ?? null) }, metric)}</figure>` : nothing}
      <section aria-labelledby="versions"><h2 id="versions">Versions</h2><div class="card table" tabindex="0" role="group" aria-label="Versions"><table class="versions"><caption class="unseen">Versions of ${it.model}, newest first</caption>
        <thead><tr><th scope="col">Version</th><th scope="col">Aliases</th>${keys.map((key, at) => html`<th scope="col" class=${at > 0 ? "num wide" : "num"} title=${plain(key)}>${plain(key)}</th>`)}<th scope="col" class="wide">Run</th><th scope="col" class="wide">Made</th><th scope="col"><span class="unseen">Actions</span></th></tr></thead>
        <tbody>${versions.map((version) => row(shown, keys, version))}</tbody></table></div></section>
      <section aria-labelledby="moves"><h2 id="moves">Moves of its aliases</h2>${history.length === 0 ? html`<p class="card dim">No alias has moved yet.</p>` : html`<ol class="moves">${history.map((move) => {
        const newest = !seen.has(move.alias);
        seen.add(move.alias);
        return moved(move, newest);
      })}</ol>`}</section>
      ${dialog()}`;
  }

  return { title: name, every: 5000, load, render, hears: (row) => row.model === name };
}
