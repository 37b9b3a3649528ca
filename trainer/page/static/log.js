//! The log of a run or a stage: its newest lines, growing while somebody looks.

import { get, runPath } from "./api.js";
import { date, plain, time } from "./format.js";
import { html, nothing } from "./vendor/lit-html.js";

/** Lines that are kept in the page. */
const MOST = 2000;
/** Lines that are fetched at first. */
const FIRST = 300;

export class Log {
  /** @param {string} run @param {string | null} stage @param {() => void} draw */
  constructor(run, stage, draw) {
    this.run = run;
    this.stage = stage;
    this.draw = draw;
    /** @type {LogLine[]} */
    this.lines = [];
    this.begun = false;
    this.follow = true;
    this.filter = "";
    this.cutOff = false;
  }

  /** @param {AbortSignal} signal */
  async load(signal) {
    const query = new URLSearchParams();
    if (this.stage) query.set("stage", this.stage);
    if (!this.begun) query.set("last", String(FIRST));
    else {
      query.set("after", String(this.lines[this.lines.length - 1]?.id ?? 0));
      query.set("limit", "1000");
    }
    const fresh = /** @type {LogLine[]} */ (await get(`${runPath(this.run)}/logs?${query}`, signal));
    this.cutOff ||= !this.begun && fresh.length >= FIRST;
    this.begun = true;
    this.lines.push(...fresh);
    if (this.lines.length > MOST) {
      this.lines.splice(0, this.lines.length - MOST);
      this.cutOff = true;
    }
    return fresh.length > 0;
  }

  /** Has the newest line in sight, if that is wanted. */
  scroll() {
    if (!this.follow) return;
    for (const box of document.querySelectorAll(".log .lines")) box.scrollTop = box.scrollHeight;
  }

  render() {
    const words = this.filter.toLowerCase();
    const shown = words === "" ? this.lines : this.lines.filter((line) => line.text.toLowerCase().includes(words) || line.worker.toLowerCase().includes(words));
    queueMicrotask(() => this.scroll());
    /** @param {Event} event */
    const search = (event) => {
      this.filter = /** @type {HTMLInputElement} */ (event.currentTarget).value;
      this.draw();
    };
    /** @param {Event} event */
    const follow = (event) => {
      this.follow = /** @type {HTMLInputElement} */ (event.currentTarget).checked;
      this.draw();
    };
    return html`<section class="log card" aria-labelledby="log-title">
      <div class="row"><h2 id="log-title">Log</h2>
        <label class="field grow"><span class="unseen">Lines that contain</span><input type="search" placeholder="Find in the log" .value=${this.filter} @input=${search}></label>
        <label class="check"><input type="checkbox" .checked=${this.follow} @change=${follow}> newest</label></div>
      ${this.lines.length === 0
        ? html`<p class="dim">No line yet.</p>`
        : html`<div class="lines" tabindex="0" role="log" aria-live="off" aria-label="Log lines">${this.cutOff ? html`<p class="dim">Older lines: <code>trainer logs ${this.run}</code></p>` : nothing}${shown.map((line) => logLine(line, this.stage === null))}</div>`}
    </section>`;
  }
}

/** @param {LogLine} line @param {boolean} withStage @param {boolean} [marked] */
export const logLine = (line, withStage, marked = false) =>
  html`<p class=${marked ? "line marked" : "line"}><time title=${date(line.at_ms)}>${time(line.at_ms)}</time> <span class="from">${withStage ? `${line.task.split("/")[1] ?? ""} ` : ""}${line.worker}</span> <span class="text" dir="auto">${plain(line.text)}</span></p>`;
