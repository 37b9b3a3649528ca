//! What happened to runs and workers, as the store has it, and in words.

import { get } from "./api.js";
import { grouped } from "./format.js";

/** Rows of one question. */
const PAGE = 1000;
/** Rows that are kept in the page. */
const MOST = 20000;

export class History {
  /** @param {Record<string, string>} asked such as `{run}` or `{since}` */
  constructor(asked) {
    this.asked = asked;
    /** @type {HistoryRow[]} Oldest first. */
    this.rows = [];
  }

  /** Fetches what is new. @param {AbortSignal} [signal] @returns {Promise<boolean>} whether there is something */
  async load(signal) {
    for (let before = this.rows.length; ; ) {
      const query = new URLSearchParams({ ...this.asked, after: String(this.rows[this.rows.length - 1]?.id ?? 0), limit: String(PAGE) });
      const fresh = /** @type {HistoryRow[]} */ (await get(`/v1/history?${query}`, signal));
      this.rows.push(...fresh);
      if (fresh.length < PAGE || this.rows.length >= MOST) return this.rows.length > before;
    }
  }

  /** Steps at which a stage was saved. @param {string} stage @returns {number[]} */
  checkpoints(stage) {
    return this.rows.filter((row) => row.kind === "checkpoint" && row.stage === stage && row.step !== undefined).map((row) => row.step ?? 0);
  }
}

/** Attempts at a stage's tasks, oldest first: who had it, from when until when, and how it ended. @param {HistoryRow[]} rows Oldest first. @param {string} stage */
export function attemptsOf(rows, stage) {
  /** @type {{number: number | undefined, task: string, worker: string, from: number, to: number | null, end: string}[]} */
  const attempts = [];
  for (const row of rows) {
    if (row.stage !== stage) continue;
    const open = attempts.filter((attempt) => attempt.to === null && (!row.task || attempt.task === row.task) && (!row.worker || attempt.worker === row.worker));
    if (row.kind === "granted" || row.kind === "adopted") attempts.push({ number: row.attempt, task: row.task ?? "", worker: row.worker ?? "", from: row.at_ms, to: null, end: "" });
    else if (["released", "retried", "finished", "failed"].includes(row.kind)) for (const attempt of open) Object.assign(attempt, { to: row.at_ms, end: inWords(row) });
  }
  return attempts;
}

/** @type {Record<string, string>} */
const WORDS = {
  submitted: "submitted", paused: "paused", resumed: "resumed", joined: "joined", returned: "came back", lost: "was lost", left: "left",
  granted: "got it", regrouped: "the gang goes on", adopted: "was taken in", released: "was given back", retried: "tries again",
  stalled: "stands still", finished: "finished", failed: "failed", promoted: "promoted", "rolled-back": "rolled back",
};

/** @param {HistoryRow} row */
export function inWords(row) {
  const { kind, why, step, actor } = row;
  if (kind === "ended") return why ?? "ended";
  if (kind === "checkpoint") return `saved at step ${grouped(step ?? 0)}`;
  if (kind === "granted") return step ? `got it, from step ${grouped(step)}` : "got it";
  if (kind === "regrouped") return `the gang goes on ${why ?? ""}`;
  const said = `${WORDS[kind] ?? kind}${kind === "submitted" && actor ? ` by ${actor}` : ""}`;
  return why ? `${said}: ${why.split("\n", 1)[0]}` : said;
}
