//! Signing in with a token.

import { CallError, signIn } from "../api.js";
import { icon } from "../parts.js";
import { html, nothing, render } from "../vendor/lit-html.js";

/** @param {HTMLElement} place @param {string | null} why @param {(who: Who) => void} done */
export function login(place, why, done) {
  document.title = "Sign in · Stride";
  let busy = false;

  /** @param {SubmitEvent} event */
  async function submit(event) {
    event.preventDefault();
    const field = /** @type {HTMLInputElement} */ (place.querySelector("#token"));
    const token = field.value.trim();
    if (busy || token === "") return field.focus();
    busy = true;
    why = null;
    draw();
    try {
      const who = await signIn("Bearer", token);
      field.value = "";
      done(who);
    } catch (error) {
      busy = false;
      if (!(error instanceof CallError)) throw error;
      why = error.status === 401 ? "The server does not know this token." : error.message;
      draw();
      field.focus();
      field.select();
    }
  }

  function draw() {
    render(
      html`<main id="main" class="login">
        <form @submit=${submit}>
          <p class="brand">${icon("stride")}<span>Stride</span></p>
          <h1 tabindex="-1">Sign in</h1>
          <label for="token">Token</label>
          <input id="token" type="password" autocomplete="current-password" spellcheck="false" autocapitalize="off" aria-describedby="token-help" required ?aria-invalid=${why !== null}>
          ${why ? html`<p class="wrong" role="alert">${why}</p>` : nothing}
          <button class="main" type="submit" ?disabled=${busy}>${busy ? "Signing in…" : "Sign in"}</button>
          <p id="token-help" class="dim">A token is what a line of the server's token file has. On the server's own machine <code>trainer serve</code> and
            <code>trainer run --ui</code> print a link that signs you in, and the file <code>.stride/token</code> has one while they run. <a href="/book/server.html#who-may-do-what">Tokens and scopes</a></p>
        </form>
      </main>`,
      place,
    );
  }
  draw();
  /** @type {HTMLElement | null} */ (place.querySelector("#token"))?.focus();
}
