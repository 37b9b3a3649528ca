//! Workers: who is here, what they hold, and what waits for them.

import { get, runPath } from "../api.js";
import { count, plain } from "../format.js";
import { badge, command, firstLine, joinCommand, mainStages, prose } from "../parts.js";
import { address } from "../router.js";
import { html, nothing } from "../vendor/lit-html.js";

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

  /** @param {AbortSignal} signal */
  async function load(signal) {
    list = await get("/v1/workers", signal);
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

  function render() {
    const order = ["working", "idle", "silent", "unreachable", "gone"];
    const here = list.filter((worker) => worker.state !== "gone");
    const gone = list.length - here.length;
    const shown = [...(withGone ? list : here)].sort((a, b) => order.indexOf(a.state) - order.indexOf(b.state) || a.worker.localeCompare(b.worker, "en", { numeric: true }));
    const working = here.filter((worker) => worker.state === "working").length;
    return html`<div class="row head"><h1 tabindex="-1">Workers</h1><span class="dim">${count(here.length, "worker")}, ${working} at work</span></div>
      ${queue.length > 0 ? html`<section aria-labelledby="queue"><h2 id="queue">What waits</h2><ul class="cards">${queue.slice(0, 20).map(({ run, stage }) => html`<li class="card want warn"><p class="what"><a href=${address("runs", run.run, stage.name)}><b>${run.run} / ${stage.name}</b></a></p><p class="why">${prose(firstLine(stage.message))}</p>${command(joinCommand(stage.wants_workers ?? 1), context)}</li>`)}</ul>
        ${queue.length > 20 ? html`<p class="dim">and ${count(queue.length - 20, "more stage")}</p>` : nothing}</section>` : nothing}
      ${shown.length === 0
        ? html`<section class="card empty"><p>No worker is here. One joins from this machine or another:</p>${command(joinCommand(1), context)}</section>`
        : html`<div class="card table"><table><caption class="unseen">Workers</caption><thead><tr><th scope="col">State</th><th scope="col">Worker</th><th scope="col">Works on</th><th scope="col" class="wide">Backend</th><th scope="col" class="wide">Instructions</th><th scope="col" class="wide num">Process</th></tr></thead><tbody>${shown.map(row)}</tbody></table></div>`}
      ${gone > 0 ? html`<p><label class="check"><input type="checkbox" .checked=${withGone} @change=${() => { withGone = !withGone; context.draw(); }}> ${count(gone, "worker")} that left</label></p>` : nothing}`;
  }

  return { title: "Workers", every: 1000, load, render };
}
