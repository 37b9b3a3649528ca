//! Numbers, times and names as text.

const grouping = new Intl.NumberFormat("en-US");

/** `12,345`. @param {number} value */
export const grouped = (value) => grouping.format(value);

/** Four digits that matter. @param {number | null | undefined} value */
export function number(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "NaN";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "-∞";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (Number.isInteger(value) && size < 1e7) return grouped(value);
  if (size >= 1e6 || size < 1e-3) return value.toExponential(2).replace("e+", "e");
  return String(Number(value.toPrecision(4)));
}

/** `2 h 3 min`, `45 s`. @param {number} seconds */
export function duration(seconds) {
  if (!Number.isFinite(seconds) || seconds < 0) return "";
  if (seconds < 1) return "< 1 s";
  if (seconds < 100) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  if (minutes < 100) return `${minutes} min`;
  const [days, hours] = [Math.floor(minutes / 1440), Math.floor((minutes % 1440) / 60)];
  return days > 0 ? `${days} d ${hours} h` : `${hours} h ${minutes % 60} min`;
}

/** `3.2/s`, or `40 s each` for what is slow. @param {number} perSecond @param {string} unit */
export function rate(perSecond, unit) {
  if (!(perSecond > 0)) return "";
  if (perSecond < 0.1) return `${duration(1 / perSecond)} each`;
  return `${Number(perSecond.toPrecision(perSecond < 100 ? 2 : 3))} ${unit || "steps"}/s`;
}

/** `412.0 MiB`, as the commands write it. @param {number} bytes */
export function size(bytes) {
  const units = ["B", "KiB", "MiB", "GiB", "TiB"];
  let at = 0;
  while (bytes >= 1024 && at < units.length - 1) {
    bytes /= 1024;
    at += 1;
  }
  return `${at ? bytes.toFixed(1) : bytes} ${units[at]}`;
}

/** `5 min ago`. @param {number} ms @param {number} nowMs */
export function ago(ms, nowMs) {
  const seconds = (nowMs - ms) / 1000;
  return seconds < 5 ? "just now" : `${duration(seconds)} ago`;
}

const clock = new Intl.DateTimeFormat("en-GB", { hour: "2-digit", minute: "2-digit", second: "2-digit" });
const full = new Intl.DateTimeFormat("en-GB", { dateStyle: "medium", timeStyle: "short" });

/** `14:03:22`. @param {number} ms */
export const time = (ms) => clock.format(ms);

/** `24 Nov 2026, 14:03`. @param {number} ms */
export const date = (ms) => full.format(ms);

/** The first letters of a digest. @param {string} digest */
export const short = (digest) => digest.replace(/^sha256:/, "").slice(0, 10);

/** @param {number} count @param {string} one @param {string} [many] */
export const count = (count, one, many) => `${grouped(count)} ${count === 1 ? one : (many ?? `${one}s`)}`;

/** Text without a terminal's colours, and with every other character that shows nothing as its number. @param {string} text */
export const plain = (text) =>
  text
    .replace(/\u001b\[[0-9;]*m/g, "")
    .replace(/[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u200e\u200f\u202a-\u202e\u2066-\u2069]/g, (letter) => `\\u${letter.charCodeAt(0).toString(16).padStart(4, "0")}`);
