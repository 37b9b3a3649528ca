//! Who is signed in, and what they may do. Buttons that they may not press are not drawn.

/** @type {Who | null} */
let who = null;
/** Milliseconds by which the server's clock is ahead of ours. */
let ahead = 0;

/** @param {Who | null} now */
export function setWho(now) {
  who = now;
  if (now) ahead = now.now_ms - Date.now();
}

export const currentWho = () => who;

/** The server's time, in milliseconds since 1970. */
export const serverNow = () => Date.now() + ahead;

/** @param {string} scope */
export const may = (scope) => who !== null && who.scopes.includes(scope);

/** Whether the signed-in token controls a run of this owner. @param {Owner | undefined} owner */
export function controls(owner) {
  if (!who || !may("submit")) return false;
  if (may("admin") || !owner || !owner.name) return true;
  if (who.project || owner.project) return who.project === owner.project;
  return who.name === owner.name;
}
