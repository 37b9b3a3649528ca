//! Thumbnails of a training's checkpoints: poses of the motion that each draws for one sentence.

import { CallError, get, runPath } from "./api.js";
import { drawing } from "./drawing.js";
import { grouped } from "./format.js";
import { failed, firstLine, prose } from "./parts.js";
import { may } from "./session.js";
import { html, nothing, svg } from "./vendor/lit-html.js";
import { decode } from "./viewer.js";

/** Every checkpoint draws this sentence with this seed. */
const [SENTENCE, SEED] = ["a person walks in a circle", 1];
/** Checkpoints of one draw. */
const MOST = 4;
/** Checkpoints that are drawn without being asked for: the newest. */
const UNASKED = 6;
/** Milliseconds between two looks for an idle worker, and pixels below the screen at which the thumbnails are wanted. */
const [LOOK_MS, NEAR] = [3000, 400];
/** Poses of a thumbnail, and metres between them and above them. */
const [POSES, WIDE, HIGH] = [4, 1.2, 2];
/** Direction of the view: the figure is seen from its left front. */
const YAW = -0.65;

/** Poses of a motion at equal distances in time, side by side. @param {import("./viewer.js").Motions} motions @param {string} says */
export function still(motions, says) {
  const [motion] = motions.motions;
  const body = motion && motions.bodies[motion.body];
  if (!motion || !body) return nothing;
  const joints = decode(motion);
  const count = body.parents.length;
  const [sin, cos] = [Math.sin(YAW), Math.cos(YAW)];
  const poses = Array.from({ length: POSES }, (_, pose) => {
    const frame = Math.round((pose / (POSES - 1)) * (motion.frames - 1));
    const value = (/** @type {number} */ joint, /** @type {number} */ axis) => joints[3 * (frame * count + joint) + axis] ?? 0;
    /** @param {number} joint @returns {[string, string]} */
    const place = (joint) => {
      const right = (value(joint, 0) - value(0, 0)) * cos - (value(joint, 2) - value(0, 2)) * sin;
      return [(WIDE * (pose + 0.5) + right).toFixed(2), (HIGH - value(joint, 1)).toFixed(2)];
    };
    return body.parents.map((parent, joint) => {
      if (parent === joint) return nothing;
      const [[x1, y1], [x2, y2]] = [place(parent), place(joint)];
      const head = joint === body.head ? svg`<circle cx=${x2} cy=${y2} r="0.11"></circle>` : nothing;
      return svg`<line class=${body.sides[joint] ?? "m"} x1=${x1} y1=${y1} x2=${x2} y2=${y2}></line>${head}`;
    });
  });
  return html`<svg class="still" viewBox=${`0 0 ${POSES * WIDE} ${HIGH + 0.1}`} role="img" aria-label=${says}>${svg`<line class="ground" x1="0" x2=${POSES * WIDE} y1=${HIGH} y2=${HIGH}></line>${poses}`}</svg>`;
}

export class Thumbnails {
  /** @param {string} run @param {string} stage @param {() => void} draw */
  constructor(run, stage, draw) {
    this.run = run;
    this.stage = stage;
    this.draw = draw;
    /** @type {Checkpoint[]} */
    this.kept = [];
    /** Motions by the checkpoint's digest. @type {Map<string, import("./viewer.js").Motions>} */
    this.drawn = new Map();
    this.busy = false;
    this.wrong = "";
    this.closed = false;
    this.looked = 0;
  }

  /** @param {AbortSignal} signal */
  async load(signal) {
    const all = /** @type {Checkpoint[]} */ (await get(`${runPath(this.run)}/checkpoints`, signal));
    this.kept = all.filter((kept) => kept.stage === this.stage && kept.draws);
  }

  /** Draws with the newest checkpoints once their thumbnails are near the screen and a worker is idle. */
  async appear() {
    const now = Date.now();
    if (this.busy || this.wrong || this.closed || !may("submit") || now - this.looked < LOOK_MS || this.undrawn(UNASKED).length === 0) return;
    const top = document.querySelector("section[aria-labelledby=kept]")?.getBoundingClientRect().top ?? Infinity;
    if (top > innerHeight + NEAR) return;
    this.looked = now;
    const workers = /** @type {WorkerRow[]} */ (await get("/v1/workers"));
    if (!this.busy && workers.some((worker) => worker.state === "idle")) await this.drawAll(UNASKED);
  }

  /** Draws with the newest `most` checkpoints, as far as they have no thumbnail yet. Everyone who opens the view asks for the same draws, which are one run. @param {number} [most] */
  async drawAll(most) {
    const retries = this.wrong !== "";
    [this.busy, this.wrong] = [true, ""];
    this.draw();
    try {
      for (let left = this.undrawn(most); left.length > 0 && !this.closed; left = this.undrawn(most)) {
        const some = left.slice(0, MOST);
        const checkpoints = some.map(({ step }) => ({ run: this.run, stage: this.stage, step }));
        const key = `thumbnails ${some.map(({ digest }) => digest.slice(-12)).join(" ")}`;
        const reports = await drawing({ checkpoints, sentences: [SENTENCE], seed: SEED }, (run) => {
          if (run.state === "failed") this.wrong = firstLine(failed(run)?.message) || "It could not be drawn.";
          return !this.closed;
        }, retries ? undefined : key);
        if (reports.length === 0) {
          this.wrong ||= "The draw was ended.";
          break;
        }
        some.forEach(({ digest }, at) => {
          const report = reports[at];
          if (report) this.drawn.set(digest, report.motions);
        });
        this.draw();
      }
    } catch (error) {
      if (!(error instanceof CallError)) throw error;
      this.wrong = error.message;
    }
    this.busy = false;
    this.draw();
  }

  /** @param {number} [most] */
  undrawn(most) {
    return this.kept.slice(most ? -most : 0).filter(({ digest }) => !this.drawn.has(digest));
  }

  close() {
    this.closed = true;
  }

  render() {
    if (this.kept.length === 0) return nothing;
    return html`<section aria-labelledby="kept"><div class="row"><h2 id="kept">Checkpoints</h2><span class="dim grow">“${SENTENCE}”, seed ${SEED}</span>
        ${may("submit") && (this.busy || this.undrawn().length > 0) ? html`<button type="button" ?disabled=${this.busy} @click=${() => void this.drawAll()}>${this.busy ? "Drawing…" : "Draw them"}</button>` : nothing}</div>
      ${this.wrong ? html`<p class="wrong" role="alert">${prose(this.wrong)}</p>` : nothing}
      <ul class="stills viewer">${this.kept.map(({ step, digest }) => {
        const motions = this.drawn.get(digest);
        return html`<li class="card"><b>step ${grouped(step)}</b>${motions ? still(motions, `Four poses of the motion after step ${grouped(step)}`) : html`<p class="dim">not drawn</p>`}</li>`;
      })}</ul></section>`;
  }
}
