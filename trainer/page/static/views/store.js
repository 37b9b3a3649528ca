//! The store: whether it is well, what collecting would free, and who did what.

import { CallError, get, registry } from "../api.js";
import { ago, count, date, grouped, size } from "../format.js";
import { bar, command, fact, prose } from "../parts.js";
import { currentWho, may, serverNow } from "../session.js";
import { html, nothing } from "../vendor/lit-html.js";

/** @param {Context} context @returns {View} */
export function store(context) {
  let storage = "ok";
  /** @type {AuditEntry[]} */
  let audit = [];
  /** @type {{bytes: number, remove: string[], kept: number, fresh: number} | null} */
  let plan = null;
  /** @type {{text: string, wrong: boolean} | null} */
  let checked = null;
  /** @type {{kinds: {kind: string, count: number, bytes: number}[], database_bytes: number, findings: {state: "ok" | "warn" | "fail", what: string, found: string, hint?: string}[]} | null} */
  let sizes = null;
  let busy = "";

  /** @param {AbortSignal} signal */
  async function load(signal) {
    storage = (await get("/v1/health", signal)).storage;
    if (may("admin")) [sizes, { entries: audit }] = await Promise.all([get("/v1/storage", signal), registry({ command: "audit", limit: 60 }, signal)]);
  }

  /** @param {string} name @param {() => Promise<void>} work */
  const during = (name, work) => async () => {
    if (busy) return;
    busy = name;
    context.draw();
    try {
      await work();
    } catch (error) {
      if (!(error instanceof CallError)) throw error;
      if (name === "check") checked = { text: error.hint ? `${error.message}; ${error.hint}` : error.message, wrong: true };
      else context.say(error.message);
    }
    busy = "";
    context.draw();
  };

  const measure = during("plan", async () => {
    plan = (await registry({ command: "gc", dry_run: true, grace_minutes: null })).plan;
  });
  const check = during("check", async () => {
    await registry({ command: "fsck" });
    checked = { text: "Everything that rows name is there and whole.", wrong: false };
  });

  /** @param {AuditEntry} entry */
  const row = (entry) => html`<tr class=${entry.status >= 400 ? "refused" : ""}>
    <td class="dim" title=${date(entry.at_ms)}>${ago(entry.at_ms, serverNow())}</td><th scope="row">${entry.who}</th>
    <td dir="auto">${entry.object || entry.call}</td><td class="wide dim">${entry.object ? entry.call : ""}</td>
    <td class="num">${entry.status}${(entry.count ?? 1) > 1 ? html` <span class="dim">× ${grouped(entry.count ?? 1)}</span>` : nothing}</td><td class="wide dim">${entry.from}</td></tr>`;

  function kinds() {
    const all = [...(sizes?.kinds ?? []), { kind: "database", count: 1, bytes: sizes?.database_bytes ?? 0 }].sort((a, b) => b.bytes - a.bytes);
    const most = Math.max(1, ...all.map(({ bytes }) => bytes));
    return html`<section aria-labelledby="kinds"><h2 id="kinds">Bytes by kind</h2><div class="card table" tabindex="0" role="group" aria-label="Bytes by kind"><table><caption class="unseen">Artifacts of stages by kind, and the database</caption><thead><tr><th scope="col">Kind</th><th scope="col" class="num">Number</th><th scope="col" class="num">Bytes</th><th scope="col" class="wide"><span class="unseen">Part of the largest</span></th></tr></thead>
      <tbody>${all.map(({ kind, count: many, bytes }) => html`<tr><th scope="row">${kind}</th><td class="num">${grouped(many)}</td><td class="num">${size(bytes)}</td><td class="wide reach">${bar(bytes / most, `${kind}, part of the largest`)}</td></tr>`)}</tbody></table></div></section>`;
  }

  /** What the doctor finds. */
  const findings = () => html`<ul class="gates">${(sizes?.findings ?? []).map(({ state, what, found, hint }) => html`<li class=${{ ok: "good", warn: "", fail: "bad" }[state]}><span aria-hidden="true">${{ ok: "●", warn: "◌", fail: "○" }[state]}</span> <b>${what}</b> <span dir="auto">${prose(found)}</span>${hint ? html`<span class="dim">; ${prose(hint)}</span>` : nothing}</li>`)}</ul>`;

  function render() {
    const who = currentWho();
    const changes = [...audit].sort((a, b) => b.at_ms - a.at_ms);
    return html`<div class="row head"><h1 tabindex="-1">Store</h1></div>
      ${storage === "ok" ? nothing : html`<section class="card want bad"><p class="what"><b>The store is in trouble</b></p><p class="why">What is to be stored cannot be, or what is stored cannot be read.</p><p class="dim">Free some space on its disk, or look whether its bucket answers. Training goes on meanwhile.</p></section>`}
      <div class="card summary"><dl class="facts">${fact("Store", who?.store ?? "")}${fact("Storage", storage === "ok" ? "takes and gives" : "in trouble")}${fact("Server", `version ${who?.version ?? ""}`)}${fact("Signed in", `${who?.name ?? ""}${who?.project ? ` (${who.project})` : ""}, may ${who?.scopes.join(", ") ?? ""}`)}</dl></div>
      ${may("admin")
        ? html`<div class="cards two">
            <section class="card" aria-labelledby="space"><h2 id="space">Space</h2>
              ${plan ? html`<p>Collecting would free <b>${size(plan.bytes)}</b> in ${count(plan.remove.length, "blob")}; ${grouped(plan.kept)} stay, ${grouped(plan.fresh)} are too fresh to go.</p>${plan.remove.length > 0 ? command("registry gc", context) : nothing}` : html`<p class="dim">What nothing needs any more can be removed.</p>`}
              <p class="actions"><button type="button" ?disabled=${busy !== ""} @click=${measure}>${busy === "plan" ? "Looking…" : "What can go?"}</button></p></section>
            <section class="card" aria-labelledby="whole"><h2 id="whole">Soundness</h2>${findings()}
              ${checked ? html`<p class=${checked.wrong ? "wrong" : ""}>${checked.text}</p>` : html`<p class="dim">Reads every byte of the store and compares it with its name.</p>`}
              <p class="actions"><button type="button" ?disabled=${busy !== ""} @click=${check}>${busy === "check" ? "Reading…" : "Check everything"}</button></p></section>
            <section class="card" aria-labelledby="copy"><h2 id="copy">Backup</h2><p class="dim">A copy of the store while it is in use:</p>${command("registry backup DIR", context)}</section>
          </div>
          ${kinds()}
          <section aria-labelledby="audit"><h2 id="audit">Who did what</h2>
            ${changes.length === 0 ? html`<p class="card dim">Nothing is written down yet.</p>` : html`<div class="card table" tabindex="0" role="group" aria-label="The audit log"><table><caption class="unseen">The audit log, newest first</caption><thead><tr><th scope="col">When</th><th scope="col">Who</th><th scope="col">What</th><th scope="col" class="wide">Call</th><th scope="col" class="num">Answer</th><th scope="col" class="wide">From</th></tr></thead><tbody>${changes.map(row)}</tbody></table></div>`}</section>`
        : html`<p class="card dim">Space, soundness and the audit log are for tokens with the scope <code>admin</code>.</p>`}`;
  }
  return { title: "Store", every: 5000, load, render };
}
