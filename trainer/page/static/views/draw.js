//! The playground: one to four models draw the same sentences with the same seed, side by side.

import { blob, CallError, get, post, registry, runPath } from "../api.js";
import { count, number, plain } from "../format.js";
import { Figures, together } from "../motions.js";
import { badge, command, failed, firstLine, isDone, isOver, joinCommand, prose } from "../parts.js";
import { address, remember } from "../router.js";
import { may } from "../session.js";
import { html, nothing } from "../vendor/lit-html.js";

/** Limits of a draw, and the milliseconds between two questions how far it is. */
const [MODELS, SENTENCES, ASK_MS] = [4, 8, 350];
const EXAMPLES = ["a person walks in a circle", "a person jumps forward twice", "someone waves with the right hand and sits down"];

/** @param {Context} context @returns {View} */
export function draw(context) {
  const query = new URLSearchParams(location.search);
  let sentences = query.getAll("s").join("\n") || EXAMPLES[0];
  let chosen = query.getAll("model").slice(0, MODELS);
  let [seconds, seed, guidance, steps] = ["seconds", "seed", "guidance", "steps"].map((name) => query.get(name) ?? "");
  seed ||= "1";
  /** @type {{name: string, note: string}[]} Versions to choose from, those with an alias first. */
  let choices = [];
  const figures = new Figures();
  /** What is shown: which models and how far their run is. @type {{models: string[], sentences: string[], run: Run | null, notes: string[]} | null} */
  let shown = null;
  let [busy, wrong, hint, begun, drawn] = [false, "", "", false, false];
  let left = false;

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
    // A link to a draw shows it: what was drawn already is answered from the store.
    if (!begun && query.has("s") && may("submit")) void start();
    begun = true;
  }

  const lines = () => (sentences ?? "").split("\n").map((line) => line.trim()).filter((line) => line !== "");

  function keep() {
    const query = new URLSearchParams();
    for (const line of lines()) query.append("s", line);
    for (const name of chosen) query.append("model", name);
    for (const [name, value] of [["seed", seed], ["seconds", seconds], ["guidance", guidance], ["steps", steps]]) if (name && value) query.set(name, value);
    remember(query);
  }

  async function start() {
    if (busy || lines().length === 0 || chosen.length === 0) return;
    [busy, wrong, hint] = [true, "", ""];
    keep();
    context.draw();
    const number = (/** @type {string | undefined} */ text) => (text ? Number(text) : undefined);
    const asked = { models: chosen, sentences: lines().slice(0, SENTENCES), seed: Math.abs(Math.trunc(Number(seed) || 0)), seconds: number(seconds), guidance: number(guidance), steps: number(steps) };
    try {
      const { run, stages } = await post("/v1/draws", asked);
      shown = { models: asked.models, sentences: asked.sentences, run: null, notes: asked.models.map((name) => choices.find((choice) => choice.name === name)?.note ?? "") };
      for (;;) {
        const now = /** @type {Run} */ (await get(runPath(run)));
        if (left) return;
        shown.run = now;
        context.draw();
        if (isOver(now) || now.state === "paused") break;
        await new Promise((done) => setTimeout(done, ASK_MS));
      }
      if (shown.run?.state === "finished") await fetchMotions(shown.run, stages, shown);
    } catch (error) {
      if (!(error instanceof CallError)) throw error;
      [wrong, hint] = [error.message, error.hint ?? ""];
    }
    busy = false;
    context.draw();
  }

  /** @param {Run} run @param {string[]} stages @param {NonNullable<typeof shown>} asked */
  async function fetchMotions(run, stages, asked) {
    const all = await Promise.all(stages.map(async (name) => {
      const report = run.stages.find((stage) => stage.name === name)?.outputs.report ?? "";
      const manifest = JSON.parse(new TextDecoder().decode(await blob(report)));
      return JSON.parse(new TextDecoder().decode(await blob(manifest.files["motions.json"].digest)));
    }));
    if (left) return;
    const captions = asked.models.flatMap((model, at) => asked.sentences.map((sentence) => ({ title: asked.models.length > 1 ? model : sentence, note: asked.models.length > 1 ? sentence : [model, asked.notes[at]].filter(Boolean).join(" · ") })));
    figures.show(together(all), captions);
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
    </form>`;
  }

  function progress() {
    if (wrong) return html`<p class="wrong" role="alert">${prose(wrong)}${hint ? html` <span class="dim">${prose(hint)}</span>` : nothing}</p>`;
    const run = shown?.run;
    if (!run) return nothing;
    if (run.state === "failed") return html`<p class="wrong" role="alert">${prose(firstLine(failed(run)?.message) || "It could not be drawn.")} <a href=${address("runs", run.run)}>${run.run}</a></p>`;
    if (run.state === "finished") {
      const cached = run.stages.every((stage) => stage.state === "cached");
      const took = run.stages.reduce((sum, stage) => sum + stage.wall_s, 0);
      return html`<p class="dim" role="status">${cached ? "Drawn before: the same models, sentences and seed." : `Drawn in ${number(took)} s of work.`} ${run.stages.map((stage, at) => (stage.metrics.skating === undefined ? nothing : html`${at > 0 ? ", " : ""}${shown?.models[at]} slides in ${number(100 * stage.metrics.skating)} % of the steps`))}</p>`;
    }
    const waits = run.stages.find((stage) => stage.wants_workers);
    if (waits) return html`<section class="card want warn"><p class="what"><b>It waits for an idle worker</b></p><p class="why">${prose(firstLine(waits.message))}</p>${command(joinCommand(1), context)}</section>`;
    return html`<p class="dim" role="status">${badge("running", "drawing")} ${count(run.stages.filter(isDone).length, "model")} of ${run.stages.length}</p>`;
  }

  function render() {
    const again = drawn && shown && shown.models[0] ? `trainer generate ${JSON.stringify(shown.sentences[0] ?? "")} --model ${shown.models[0]} --seed ${seed}${seconds ? ` --seconds ${seconds}s` : ""} -o motion.bvh` : "";
    return html`<div class="row head"><h1 tabindex="-1">Draw</h1></div>
      ${choices.length === 0
        ? html`<p class="card dim">No model is registered yet. A stage of kind <code>register</code> makes a version of what a pipeline trained.</p>`
        : may("submit")
          ? form()
          : html`<p class="card dim">Drawing needs a token with the scope <code>submit</code>. Here a command draws: <code>trainer generate</code>.</p>`}
      ${progress()}${drawn ? figures.element : nothing}
      ${again ? html`<section aria-labelledby="take"><h2 id="take">Take it along</h2><p class="dim">As BVH for other programs; <code>.glb</code>, <code>.npy</code> and <code>.html</code> work as well. This page's address draws the same again.</p>${command(plain(again), context)}</section>` : nothing}`;
  }

  const close = () => {
    left = true;
    figures.close();
  };
  return { title: "Draw", every: 0, load, render, close };
}
