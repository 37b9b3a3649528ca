//! Calls of the server, and what they say when they fail.

/** A call that was refused, or that no server answered (`status` 0). */
export class CallError extends Error {
  /** @param {number} status @param {string} code @param {string} message @param {string | null} hint */
  constructor(status, code, message, hint) {
    super(message);
    this.status = status;
    this.code = code;
    this.hint = hint;
  }

  /** Whether the server may answer if it is asked again. */
  get isAway() {
    return this.status === 0 || this.status === 502 || this.status === 503 || this.status === 504;
  }
}

/**
 * @param {string} method @param {string} path @param {{body?: unknown, headers?: Record<string, string>, signal?: AbortSignal}} [more]
 * @returns {Promise<Response>}
 */
async function send(method, path, more = {}) {
  /** @type {Record<string, string>} */
  const headers = { "x-stride-page": "1", ...more.headers };
  if (more.body !== undefined) headers["content-type"] = "application/json";
  const timeout = AbortSignal.timeout(20000);
  const signal = more.signal ? AbortSignal.any([more.signal, timeout]) : timeout;
  let answer;
  try {
    const body = more.body === undefined ? undefined : JSON.stringify(more.body);
    answer = await fetch(path, { method, headers, body, signal, credentials: "same-origin", redirect: "error" });
  } catch (error) {
    if (more.signal?.aborted) throw error;
    throw new CallError(0, "away", "The server does not answer.", null);
  }
  if (answer.ok) return answer;
  let said = /** @type {{code?: string, detail?: string, hint?: string | null}} */ ({});
  try {
    said = await answer.json();
  } catch {
    // An answer of something in between, such as a proxy.
  }
  throw new CallError(answer.status, said.code ?? "unknown", said.detail ?? `The server answered ${answer.status}.`, said.hint ?? null);
}

/** @param {string} path @param {AbortSignal} [signal] @returns {Promise<any>} */
export async function get(path, signal) {
  return (await send("GET", path, { signal })).json();
}

/** @param {string} path @param {unknown} [body] @param {Record<string, string>} [headers] @returns {Promise<any>} */
export async function post(path, body, headers) {
  return (await send("POST", path, { body, headers })).json();
}

/** A command of the registry; its own refusals are thrown like those of calls. @param {Record<string, unknown>} command @param {AbortSignal} [signal] @returns {Promise<any>} */
export async function registry(command, signal) {
  const answer = await (await send("POST", "/v1/registry", { body: command, signal })).json();
  if (answer.error) {
    const { code, message, hint } = answer.error;
    const status = code === "not-found" ? 404 : 409;
    throw new CallError(status, code, message, hint);
  }
  return answer.data;
}

/** The bytes of a blob. @param {string} digest @param {AbortSignal} [signal] */
export async function blob(digest, signal) {
  return (await send("GET", `/v1/blobs/${digest}`, { signal })).arrayBuffer();
}

/** A part of a blob. @param {string} digest @param {number} from @param {number} bytes @param {AbortSignal} [signal] @returns {Promise<ArrayBuffer>} */
export async function part(digest, from, bytes, signal) {
  const answer = await send("GET", `/v1/blobs/${digest}`, { signal, headers: { range: `bytes=${from}-` } });
  const reader = answer.body?.getReader();
  const found = new Uint8Array(bytes);
  let have = 0;
  while (reader && have < bytes) {
    const { done, value } = await reader.read();
    if (done || !value) break;
    found.set(value.subarray(0, bytes - have), have);
    have += value.length;
  }
  // The rest of the blob is not wanted.
  await reader?.cancel();
  if (have < bytes) throw new CallError(0, "away", "The server does not answer.", null);
  return found.buffer;
}

/** Buys a session for a token, or for a link's key. @param {"Bearer" | "Key"} scheme @param {string} word @returns {Promise<Who>} */
export async function signIn(scheme, word) {
  return (await send("POST", "/v1/session", { headers: { authorization: `${scheme} ${word}` } })).json();
}

export async function signOut() {
  await send("DELETE", "/v1/session");
}

/** @param {string} run */
export const runPath = (run) => `/v1/runs/${encodeURIComponent(run)}`;
