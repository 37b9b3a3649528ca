//! The playground: one to four models draw the same sentences with the same seed, side by side.
//!
//! Its address has all of a draw. A link only fills the form, because a page of another host must not start work here.

import { CallError, registry } from "../api.js";
import { drawing } from "../drawing.js";
import { floor, fromText, lengthOf, positions, toText } from "../floor.js";
import { count, number, plain } from "../format.js";
import { Figures, together } from "../motions.js";
import { badge, command, failed, firstLine, isDone, joinCommand, prose } from "../parts.js";
import { address, remember } from "../router.js";
import { currentWho, may } from "../session.js";
import { Stream } from "../stream.js";
import { html, nothing } from "../vendor/lit-html.js";

/** Limits of a draw. */
const [MODELS, SENTENCES] = [4, 8];
/** Forms of the files of one motion. */
const FORMS = ["bvh", "glb", "npy"];
const EXAMPLES = ["a person walks in a circle", "a person jumps forward twice", "someone waves with the right hand and sits down"];

/** A name for files on any system. @param {string} model @param {string} sentence @param {number} seed */
const fileName = (model, sentence, seed) => [model, sentence, String(seed)].map((word) => word.toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "").slice(0, 40)).filter(Boolean).join("-");

/** A word of a shell's command. Between single quotes nothing has a meaning of its own. @param {string} text */
const quoted = (text) => `'${text.replaceAll("'", "'\\''")}'`;

/** @typedef {{models: string[], sentences: string[], seed: number, seconds?: number, guidance?: number, steps?: number, path: [number, number, number, number][]}} Asked */

/** @param {Context} context @returns {View} */
export function draw(context) {
  const query = new URLSearchParams(location.search);
  let sentences = query.getAll("s").join("\n") || EXAMPLES[0];
  let chosen = query.getAll("model").slice(0, MODELS);
  let [seconds, seed, guidance, steps] = ["seconds", "seed", "guidance", "steps"].map((name) => query.get(name) ?? "");
  seed ||= "1";
  let path = fromText(query.get("path") ?? "");
  const startsWithPath = path.length > 0;
  /** @type {{name: string, note: string}[]} Versions to choose from, those with an alias first. */
  let choices = [];
  const figures = new Figures();
  /** The draw on the page, and its run. @type {(Asked & {run: Run | null, notes: string[]}) | null} */
  let shown = null;
  /** Pages with all motions of a model. @type {import("../motions.js").Download[]} */
  let pages = [];
  let [busy, wrong, hint, drawn] = [false, "", "", false];
  let left = false;
  const stream = new Stream(context.draw);
  let words = "";

  /** @param {AbortSignal} signal */
  async function load(signal) {
    const models = /** @type {Model[]} */ ((await registry({ command: "list" }, signal)).models);
    choices = models.flatMap((model) => [
      ...Object.entries(model.aliases).map(([alias, version]) => ({ name: `${model.model}:${version}`, note: alias })),
      ...(model.best ? [{ name: `${model.model}:${model.best}`, note: "best" }] : []),
    ]);
    choices = [...new Map(choices.map((choice) => [choice.name, { ...choice, note: choices.filter((other) => other.name === choice.name).map((other) => other.note).join(", ") }])).values()];
    for (const name of chosen) if (!choices.some((choice) => choice.name === name)) choices.push({ name, note: "" });
    if (chosen.length === 0 && choices[0]) chosen = [choices[0].name];
  }

  const lines = () => (sentences ?? "").split("\n").map((line) => line.trim()).filter((line) => line !== "");

  function keep() {
    const query = new URLSearchParams();
    for (const line of lines()) query.append("s", line);
    for (const name of chosen) query.append("model", name);
    for (const [name, value] of [["seed", seed], ["seconds", seconds], ["guidance", guidance], ["steps", steps], ["path", toText(path)]]) if (name && value) query.set(name, value);
    remember(query);
  }

  async function start() {
    if (busy || lines().length === 0 || chosen.length === 0) return;
    [busy, wrong, hint, drawn] = [true, "", "", false];
    keep();
    context.draw();
    const number = (/** @type {string | undefined} */ text) => (text ? Number(text) : undefined);
    /** @type {Asked} */
    const asked = { models: chosen, sentences: lines().slice(0, SENTENCES), seed: Math.abs(Math.trunc(Number(seed) || 0)), seconds: number(seconds), guidance: number(guidance), steps: number(steps), path: positions(path, number(seconds)) };
    try {
      const asks = { ...asked, run: null, notes: asked.models.map((name) => choices.find((choice) => choice.name === name)?.note ?? "") };
      shown = asks;
      const reports = await drawing(asked, (run) => {
        shown = { ...asks, run };
        context.draw();
        return !left;
      });
      if (reports.length > 0 && !left) showMotions(reports, asks);
    } catch (error) {
      if (!(error instanceof CallError)) throw error;
      [wrong, hint] = [error.message, error.hint ?? ""];
    }
    busy = false;
    context.draw();
    if (drawn && !left) bringIntoSight(document.querySelector("main canvas.figure"));
  }

  /** On a phone the motion is below the form that asked for it. @param {Element | null} figure */
  function bringIntoSight(figure) {
    const { top, bottom } = figure?.getBoundingClientRect() ?? { top: 0, bottom: 0 };
    if (top < 0 || bottom > innerHeight) figure?.scrollIntoView({ block: "center" });
  }

  /** @param {import("../drawing.js").Report[]} all @param {NonNullable<typeof shown>} asked */
  function showMotions(all, asked) {
    const several = asked.models.length > 1;
    const captions = asked.models.flatMap((model, of) => asked.sentences.map((sentence, at) => ({
      title: several ? model : sentence,
      note: `${several ? sentence : [model, asked.notes[of]].filter(Boolean).join(" · ")} ·`,
      files: FORMS.flatMap((form) => {
        const digest = all[of]?.files[`motion-${String(at).padStart(2, "0")}.${form}`]?.digest;
        return digest ? [{ text: form, digest, name: `${fileName(model, sentence, asked.seed)}.${form}` }] : [];
      }),
    })));
    pages = asked.models.flatMap((model, of) => {
      const digest = all[of]?.files["motions.html"]?.digest;
      return digest ? [{ text: model, digest, name: `${fileName(model, "motions", asked.seed)}.html` }] : [];
    });
    figures.show(together(all.map(({ motions }) => motions)), captions);
    drawn = true;
  }

  function form() {
    /** @param {SubmitEvent} event */
    const submit = (event) => {
      event.preventDefault();
      void start();
    };
    /** @param {string} name */
    const flip = (name) => (/** @type {Event} */ event) => {
      const on = /** @type {HTMLInputElement} */ (event.currentTarget).checked;
      chosen = on ? [...chosen, name].slice(0, MODELS) : chosen.filter((other) => other !== name);
      context.draw();
    };
    /** @param {import("../floor.js").Change} change */
    const walk = (change) => {
      path = change(path);
      context.draw();
    };
    /** @param {(value: string) => void} set */
    const typed = (set) => (/** @type {Event} */ event) => set(/** @type {HTMLInputElement} */ (event.currentTarget).value);
    return html`<form class="card playground" @submit=${submit}>
      <div class="ask"><label for="sentence">Sentence <span class="dim">one a line, up to ${SENTENCES}</span></label>
        <textarea id="sentence" rows="2" maxlength="4000" .value=${sentences ?? ""} @input=${typed((value) => (sentences = value))}></textarea>
        <p class="chips">${EXAMPLES.map((example) => html`<button type="button" @click=${() => { sentences = example; context.draw(); }}>${example}</button>`)}</p></div>
      <fieldset><legend>Models <span class="dim">up to ${MODELS}, side by side</span></legend>
        ${choices.map((choice) => html`<label class="check"><input type="checkbox" .checked=${chosen.includes(choice.name)} ?disabled=${!chosen.includes(choice.name) && chosen.length >= MODELS} @change=${flip(choice.name)}> ${choice.name} ${choice.note ? html`<span class="alias">${choice.note}</span>` : nothing}</label>`)}</fieldset>
      <div class="row numbers-row">
        <label>Seed <input inputmode="numeric" pattern="[0-9]*" .value=${seed} @input=${typed((value) => (seed = value))}></label>
        <button type="button" @click=${() => { seed = String(Math.floor(Math.random() * 1e6)); context.draw(); }}>Another seed</button>
        <label>Seconds <input inputmode="decimal" placeholder="its own" pattern="[0-9.]*" .value=${seconds ?? ""} @input=${typed((value) => (seconds = value))}></label>
        <label>Guidance <input inputmode="decimal" placeholder="its own" pattern="[0-9.]*" .value=${guidance ?? ""} @input=${typed((value) => (guidance = value))}></label>
        <label>Steps <input inputmode="numeric" placeholder="its own" pattern="[0-9]*" .value=${steps ?? ""} @input=${typed((value) => (steps = value))}></label>
        <span class="grow"></span><button class="main" type="submit" ?disabled=${busy || chosen.length === 0}>${busy ? "Drawing…" : "Draw"}</button></div>
      <details class="way" ?open=${startsWithPath}><summary>Path on the floor <span class="dim">${path.length > 0 ? `${lengthOf(path).toFixed(1)} m` : "for models with a control part"}</span></summary>
        ${floor(path, walk)}
        <p class="row"><span class="dim grow">Draw it with mouse, finger or arrow keys. The figure starts at the dot and faces up; a cell is one metre.</span>
          <button type="button" ?disabled=${path.length === 0} @click=${() => walk(() => [])}>Clear path</button></p></details>
    </form>`;
  }

  /** Says a sentence to the stream, which is opened for the first one. */
  async function speak() {
    const sentence = words.trim() || lines()[0];
    if (!sentence) return;
    try {
      if (stream.socket) stream.say(sentence);
      else await stream.open(sentence);
    } catch (error) {
      if (!(error instanceof CallError)) throw error;
      stream.wrong = error.message;
    }
    context.draw();
  }

  function live() {
    if (!currentWho()?.streams || !may("submit")) return nothing;
    const on = stream.socket !== null;
    /** @param {SubmitEvent} event */
    const submit = (event) => {
      event.preventDefault();
      void speak();
    };
    const stop = () => {
      stream.close();
      context.draw();
    };
    return html`<section aria-labelledby="live"><h2 id="live">Live</h2>
      <form class="card row" @submit=${submit}><label class="field grow"><span class="unseen">Next sentence</span><input maxlength="1000" autocomplete="off" placeholder=${lines()[0] ?? "a person walks"} .value=${words} @input=${(/** @type {Event} */ event) => (words = /** @type {HTMLInputElement} */ (event.currentTarget).value)}></label>
        <button type="submit" class="main">${on ? "Say it" : "Start"}</button>${on ? html`<button type="button" @click=${stop}>Stop</button>` : nothing}</form>
      ${stream.wrong ? html`<p class="wrong" role="alert">${prose(stream.wrong)}</p>` : nothing}
      <p class="dim" role="status" dir="auto">${!on ? "Motion without end: each sentence takes over from the one before." : stream.sentence ? `${plain(stream.sentence)} · took over after ${number(stream.delay)} s` : "Opening…"}</p>
      ${stream.shown ? stream.element : nothing}</section>`;
  }

  function progress() {
    if (wrong) return html`<p class="wrong" role="alert">${prose(wrong)}${hint ? html` <span class="dim">${prose(hint)}</span>` : nothing}</p>`;
    const run = shown?.run;
    if (!run) return nothing;
    if (run.state === "failed") return html`<p class="wrong" role="alert">${prose(firstLine(failed(run)?.message) || "It could not be drawn.")} <a href=${address("runs", run.run)}>${run.run}</a></p>`;
    if (run.state === "finished") {
      const cached = run.stages.every((stage) => stage.state === "cached");
      const took = run.stages.reduce((sum, stage) => sum + stage.wall_s, 0);
      return html`<p class="dim" role="status">${cached ? "Drawn before: the same models, sentences and seed." : `Drawn in ${number(took)} s of work.`}</p>`;
    }
    if (run.state !== "running") return html`<p class="wrong" role="alert">The draw is ${run.state}. <a href=${address("runs", run.run)}>${run.run}</a></p>`;
    const waits = run.stages.find((stage) => stage.wants_workers);
    if (waits) return html`<section class="card want warn"><p class="what"><b>It waits for an idle worker</b></p><p class="why">${prose(firstLine(waits.message))}</p>${command(joinCommand(1), context)}</section>`;
    return html`<p class="dim" role="status">${badge("running", "drawing")} ${count(run.stages.filter(isDone).length, "model")} of ${run.stages.length}</p>`;
  }

  /** @param {Asked} asked */
  function asCommand(asked) {
    const options = [["seconds", asked.seconds], ["guidance", asked.guidance], ["steps", asked.steps]].flatMap(([name, value]) => (value === undefined ? [] : [`--${name} ${value}`]));
    return plain([`trainer generate ${quoted(asked.sentences[0] ?? "")} --model ${quoted(asked.models[0] ?? "")} --seed ${asked.seed}`, ...options, "-o motion.bvh"].join(" "));
  }

  function render() {
    // A command reads a path from a file.
    const byCommand = shown?.path.length === 0;
    return html`<div class="row head"><h1 tabindex="-1">Draw</h1></div>
      ${choices.length === 0
        ? html`<p class="card dim">No model is registered yet. A stage of kind <code>register</code> makes a version of what a pipeline trained.</p>`
        : may("submit")
          ? form()
          : html`<p class="card dim">Drawing needs a token with the scope <code>submit</code>. Here a command draws: <code>trainer generate</code>.</p>`}
      ${progress()}${drawn ? figures.element : nothing}${live()}
      ${drawn ? html`<section aria-labelledby="take"><h2 id="take">Take it along</h2>
        <p>Under each motion are its files. A page with all of them: ${pages.map(({ text, digest, name }, at) => html`${at > 0 ? ", " : ""}<a href=${`/v1/blobs/${encodeURIComponent(digest)}`} download=${name}>${text}</a>`)}.</p>
        <p class="dim">A link to this page draws the same again${byCommand ? ", as does the command:" : "."}</p>${byCommand && shown ? command(asCommand(shown), context) : nothing}</section>` : nothing}`;
  }

  const close = () => {
    left = true;
    stream.close();
    figures.close();
  };
  return { title: "Draw", every: 0, load, render, close };
}
