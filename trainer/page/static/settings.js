//! Settings of runs: as flat lists, beside each other, and why a stage ran.

import { get, runPath } from "./api.js";

/** @param {string} run @param {AbortSignal} [signal] @returns {Promise<RunSettings>} */
export const settingsOf = (run, signal) => get(`${runPath(run)}/settings`, signal);

/** A setting as text. @param {unknown} value @returns {string} */
export function inText(value) {
  if (value === undefined) return "–";
  if (typeof value === "number") return value !== 0 && Math.abs(value) < 0.01 ? value.toExponential() : String(value);
  return typeof value === "string" ? value : JSON.stringify(value);
}

/** Settings by path, such as `network.width`; lists of plain values are one setting. @param {unknown} value @param {string} at @param {Map<string, unknown>} found @returns {Map<string, unknown>} */
export function flat(value, at = "", found = new Map()) {
  if (value === null || value === undefined) return found;
  const isPlain = Array.isArray(value) ? !value.some((item) => typeof item === "object" && item !== null) : typeof value !== "object";
  if (isPlain) {
    found.set(at, Array.isArray(value) ? JSON.stringify(value).replaceAll(",", ", ") : value);
    return found;
  }
  for (const [key, item] of Object.entries(value)) flat(item, at === "" ? key : `${at}.${key}`, found);
  return found;
}

/** Paths whose values differ. @param {unknown} before @param {unknown} after @returns {Change[]} */
export function changes(before, after) {
  const [old, now] = [flat(before), flat(after)];
  return [...new Set([...old.keys(), ...now.keys()])]
    .filter((path) => inText(old.get(path)) !== inText(now.get(path)))
    .map((path) => ({ path, from: old.get(path), to: now.get(path) }));
}

/** @typedef {{kind: "new" | "changed" | "input" | "same" | "code" | "seed" | "unknown", changes: Change[], inputs: string[], from?: string}} Why */

/** Why each stage of a run was computed, or was not, beside the run before it. @param {Run} run @param {RunSettings} now @param {RunSettings | null} before @returns {Map<string, Why>} */
export function reasons(run, now, before) {
  const earlier = new Map((before?.stages ?? []).map((stage) => [stage.stage, stage]));
  /** @type {Map<string, Why>} */
  const found = new Map();
  for (const stage of now.stages) {
    const old = earlier.get(stage.stage);
    const needs = run.stages.find((other) => other.name === stage.stage)?.needs ?? [];
    const inputs = needs.filter((name) => !["same", "unknown"].includes(found.get(name)?.kind ?? "unknown"));
    const differ = old ? changes(old.settings, stage.settings) : [];
    /** @type {Why["kind"]} */
    let kind = "unknown";
    if (!old) kind = "new";
    else if (differ.length > 0) kind = "changed";
    else if (old.code !== stage.code) kind = "code";
    else if (before?.seed !== now.seed) kind = "seed";
    else if (inputs.length > 0) kind = "input";
    else if (stage.key && stage.key === old.key) kind = "same";
    else if (stage.key && old.key) kind = "input";
    found.set(stage.stage, { kind, changes: differ, inputs, from: stage.from });
  }
  return found;
}

/** A reason in a few words. @param {Why | undefined} why @param {Stage} stage @returns {string} */
export function inWords(why, stage) {
  if (!why) return "";
  if (stage.state === "cached") return why.from ? `from ${why.from}` : "known result";
  if (why.kind === "new") return "new";
  if (why.kind === "changed") return why.changes.slice(0, 2).map(({ path, from, to }) => `${path} ${inText(from)} → ${inText(to)}`).join(", ") + (why.changes.length > 2 ? `, ${why.changes.length - 2} more` : "");
  if (why.kind === "input" && (stage.state === "waiting" || stage.state === "skipped")) return "";
  if (why.kind === "input") return why.inputs.length > 0 ? `${why.inputs.join(", ")} changed` : "an input changed";
  if (why.kind === "code") return "its code changed";
  if (why.kind === "seed") return "another seed";
  return why.kind === "same" && stage.state !== "waiting" && stage.state !== "skipped" ? "no result was kept" : "";
}
