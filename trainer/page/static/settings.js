//! Settings of runs: as flat lists, beside each other.

import { get, runPath } from "./api.js";

/** @param {string} run @param {AbortSignal} [signal] @returns {Promise<RunSettings>} */
export const settingsOf = (run, signal) => get(`${runPath(run)}/settings`, signal);

/** A setting as text. @param {unknown} value @returns {string} */
export function inText(value) {
  if (value === undefined || value === null) return "–";
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
