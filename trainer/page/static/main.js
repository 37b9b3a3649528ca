//! The frame around all views: who is signed in, where one is, and whether the server answers.

import { CallError, get, signIn, signOut } from "./api.js";
import { listen } from "./live.js";
import { icon } from "./parts.js";
import { start as startRouter, go, words } from "./router.js";
import { currentWho, setWho } from "./session.js";
import { html, nothing, render } from "./vendor/lit-html.js";
import { compare } from "./views/compare.js";
import { dataset, datasets } from "./views/data.js";
import { draw as playground } from "./views/draw.js";
import { login } from "./views/login.js";
import { model, models } from "./views/models.js";
import { now } from "./views/now.js";
import { run } from "./views/run.js";
import { runs } from "./views/runs.js";
import { stage } from "./views/stage.js";
import { store } from "./views/store.js";
import { workers } from "./views/workers.js";

const app = /** @type {HTMLElement} */ (document.getElementById("app"));

/** @type {View | null} */
let view = null;
/** Ends what the view before has under way. */
let leaving = new AbortController();
/** @type {CallError | null} What keeps the view from showing something new. */
let trouble = null;
/** @type {CallError | null} Why the view shows nothing. */
let absent = null;
let tries = 0;
let loaded = false;
/** @type {ReturnType<typeof setTimeout> | undefined} */
let timer;
/** Milliseconds between two questions that events cause. */
const APART = 250;
let asked = 0;
/** Ends listening to events. */
let deaf = () => {};
/** The load that is under way. @type {{view: View, again: boolean, done: Promise<void>} | null} */
let under = null;

/** What was last done, for screen readers and eyes. */
let said = "";
/** @type {ReturnType<typeof setTimeout> | undefined} */
let forget;

/** @param {string[]} at @param {Context} context @returns {View} */
function viewAt(at, context) {
  const [first, second, third] = at;
  if (first === undefined) return now(context);
  if (first === "runs" && second === undefined) return runs(context);
  if (first === "runs" && second !== undefined && third !== undefined) return stage(context, second, third);
  if (first === "runs" && second !== undefined) return run(context, second);
  if (first === "data" && second !== undefined) return dataset(context, second);
  if (first === "data") return datasets(context);
  if (first === "draw") return playground(context);
  if (first === "compare") return compare(context);
  if (first === "models" && second === undefined) return models(context);
  if (first === "models" && second !== undefined) return model(context, second);
  if (first === "workers") return workers(context);
  if (first === "store") return store(context);
  return { title: "Not found", every: 0, load: async () => {}, render: () => html`<h1 tabindex="-1">There is no such view</h1><p><a href="/">Now</a> is where everything starts.</p>` };
}

/** @type {[string, string, string][]} */
const PLACES = [
  ["/", "Now", "now"],
  ["/runs", "Runs", "runs"],
  ["/models", "Models", "models"],
  ["/draw", "Draw", "draw"],
  ["/data", "Data", "data"],
  ["/workers", "Workers", "workers"],
  ["/store", "Store", "store"],
];

function draw() {
  const who = currentWho();
  if (!who || !view) return;
  const at = words()[0] === "compare" ? "/runs" : `/${words()[0] ?? ""}`;
  document.title = `${view.title} · Stride`;
  /** @param {[string, string, string]} place */
  const link = ([href, text, name]) =>
    html`<a href=${href} aria-current=${href === at ? "page" : nothing}>${icon(name)}<span>${text}</span></a>`;
  const away = trouble?.isAway;
  render(
    html`
      <a class="skip" href="#main" @click=${skip}>Skip to the content</a>
      <header class="top">
        <a class="brand" href="/" aria-label="Stride, start">${icon("stride")}<span>Stride</span></a>
        <nav class="places" aria-label="Views">${PLACES.map(link)}</nav>
        <div class="who">
          <span class="live ${away ? "off" : ""}" title=${away ? "The server does not answer" : "Shows the present state"}
            ><span class="dot" aria-hidden="true"></span><span class="text">${away ? "waiting" : "live"}</span></span>
          <details class="menu">
            <summary aria-label="Signed in as ${who.name}">${icon("person")}<span class="text">${who.name}</span></summary>
            <div class="sheet">
              <p><b>${who.name}</b>${who.project ? html` of project <b>${who.project}</b>` : nothing}</p>
              <p class="dim">may ${who.scopes.join(", ")}</p>
              <p class="dim">store ${who.store} · version ${who.version}</p>
              <p><a href="/book/">The book</a> · <a href="/book/troubleshooting.html">Troubleshooting</a></p>
              ${who.until_ms ? html`<button type="button" @click=${leave}>Sign out</button>` : nothing}
            </div>
          </details>
        </div>
      </header>
      ${away ? html`<p class="banner" role="alert">The server does not answer. What you see is what it said last; the page goes on when it is back.</p>` : nothing}
      <main id="main">${content()}</main>
      <p class="said" role="status" aria-live="polite">${said}</p>
    `,
    app,
  );
}

function content() {
  if (absent) {
    return html`<h1 tabindex="-1">${absent.status === 404 ? "Not here" : "This cannot be shown"}</h1>
      <p>${absent.message}</p>${absent.hint ? html`<p class="dim">${absent.hint}</p>` : nothing}
      <p><a href="/runs">All runs</a> · <a href=${`/book/troubleshooting.html#${encodeURIComponent(absent.code)}`}>What this error means</a></p>`;
  }
  if (!loaded) return html`<div class="skeleton" aria-busy="true"><p class="dim">Loading…</p></div>`;
  return view?.render();
}

/** @param {Event} event */
function skip(event) {
  event.preventDefault();
  app.querySelector("h1")?.focus();
}

async function leave() {
  try {
    await signOut();
  } catch (error) {
    if (!(error instanceof CallError) || error.isAway) return context.say("You are still signed in: the server does not answer.");
  }
  showLogin(null);
}

/** @type {Context} */
const context = {
  draw,
  refresh,
  say(text) {
    said = text;
    draw();
    clearTimeout(forget);
    forget = setTimeout(() => {
      said = "";
      draw();
    }, 8000);
  },
};

/** @param {string | null} why */
function showLogin(why) {
  clearTimeout(timer);
  leaving.abort();
  deaf();
  view = null;
  setWho(null);
  login(app, why, (who) => {
    setWho(who);
    begin();
  });
}

/** Loads what the view shows, again and again while somebody looks. One load follows another: a question that comes meanwhile waits. */
async function beat() {
  clearTimeout(timer);
  const showing = view;
  if (!showing || (document.hidden && loaded)) return;
  if (under?.view === showing) {
    under.again = true;
    return under.done;
  }
  const mine = { view: showing, again: true, done: Promise.resolve() };
  under = mine;
  mine.done = (async () => {
    try {
      while (mine.again && under === mine) {
        mine.again = false;
        await load(showing);
      }
    } finally {
      if (under === mine) under = null;
    }
  })();
  await mine.done;
  if (view !== showing || under) return;
  // The delay after a failure grows to five seconds.
  const wait = tries > 0 ? Math.min(5000, 500 * 2 ** tries) : showing.every;
  clearTimeout(timer);
  if (wait > 0) timer = setTimeout(beat, wait);
}

/** @param {View} showing */
async function load(showing) {
  const signal = leaving.signal;
  asked = Date.now();
  try {
    await showing.load(signal);
    if (signal.aborted) return;
    const first = !loaded;
    trouble = null;
    absent = null;
    tries = 0;
    loaded = true;
    draw();
    if (first) app.querySelector("h1")?.focus({ preventScroll: true });
  } catch (error) {
    if (signal.aborted) return;
    if (!(error instanceof CallError)) {
      draw();
      throw error;
    }
    if (error.status === 401) return showLogin("Your session has ended. Sign in again.");
    tries += 1;
    trouble = error;
    if (!loaded && !error.isAway) absent = error;
    draw();
  }
}

/** Asks at once, such as after a change. */
function refresh() {
  tries = 0;
  return beat();
}

/** Shows views, and hears of events. */
function begin() {
  deaf();
  deaf = listen(hear);
  enter();
}

/** Asks at once if an event concerns what is shown. @param {HistoryRow | null} row */
function hear(row) {
  if (!view || !loaded || document.hidden || tries > 0 || (row && !view.hears?.(row))) return;
  const wait = asked + APART - Date.now();
  clearTimeout(timer);
  if (wait > 0) timer = setTimeout(beat, wait);
  else void beat();
}

/** Shows the view of the present address. */
function enter() {
  leaving.abort();
  leaving = new AbortController();
  view?.close?.();
  for (const open of app.querySelectorAll("details.menu[open]")) open.removeAttribute("open");
  [trouble, absent, tries, loaded, said] = [null, null, 0, false, ""];
  view = viewAt(words(), context);
  scrollTo(0, 0);
  draw();
  void beat();
}

document.addEventListener("visibilitychange", () => {
  if (!document.hidden) void beat();
});
addEventListener("online", () => void refresh());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  dispatchEvent(new Event("stride-colours"));
  draw();
});
document.addEventListener("keydown", (event) => {
  const typing = event.target instanceof Element && event.target.closest("input, textarea, select, dialog");
  if (event.key === "/" && !typing && !event.ctrlKey && !event.metaKey) {
    const field = /** @type {HTMLElement | null} */ (app.querySelector("input[type=search]"));
    event.preventDefault();
    if (field) field.focus();
    else go("/runs");
  }
  if (event.key === "Escape") for (const open of app.querySelectorAll("details.menu[open]")) open.removeAttribute("open");
});
document.addEventListener("click", (event) => {
  for (const open of app.querySelectorAll("details.menu[open]"))
    if (!(event.target instanceof Node && open.contains(event.target))) open.removeAttribute("open");
});

async function start() {
  startRouter(enter);
  const key = new URLSearchParams(location.hash.slice(1)).get("key");
  let why = null;
  if (key) {
    // The key is good once; nothing of it stays in the address or the history.
    history.replaceState(null, "", location.pathname + location.search);
    try {
      setWho(await signIn("Key", key));
      return begin();
    } catch (error) {
      why = "This link was used already, or is too old.";
    }
  }
  for (let wait = 500; ; wait = Math.min(5000, wait * 2)) {
    try {
      setWho(await get("/v1/session"));
      return begin();
    } catch (error) {
      if (!(error instanceof CallError)) throw error;
      if (!error.isAway) return showLogin(error.status === 403 ? error.message : why);
      render(html`<p class="banner" role="alert">The server does not answer. The page goes on when it is back.</p>`, app);
      await new Promise((done) => setTimeout(done, wait));
    }
  }
}

void start();
