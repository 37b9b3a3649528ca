//! Motion without end from `trainer generate --stream --listen`: sentences go in, frames come out and are shown at once.
//!
//! The server of the page makes a ticket, with which a WebSocket to that process opens once. Nothing of it is kept.

import { post } from "./api.js";
import { FORMATS, packed } from "./features.js";
import { mount } from "./viewer.js";

/** A message of the stream. @typedef {{error?: string, end?: unknown, frame?: number, line?: number, sentence?: string, joints?: number[][]}} Message */

export class Stream {
  /** @param {() => void} changed called when something besides the figure is another */
  constructor(changed) {
    this.changed = changed;
    this.element = document.createElement("div");
    this.element.className = "viewer card";
    /** @type {WebSocket | null} */
    this.socket = null;
    /** @type {ReturnType<typeof mount> | null} */
    this.shown = null;
    /** What it draws now. */
    this.sentence = "";
    /** Seconds until a sentence took over. */
    this.delay = NaN;
    this.wrong = "";
    this.line = 0;
    this.asked = 0;
  }

  /** Opens it with a first sentence. @param {string} sentence */
  async open(sentence) {
    this.close();
    const { url, protocols } = /** @type {{url: string, protocols: string[]}} */ (await post("/v1/tickets"));
    const socket = new WebSocket(url, protocols);
    this.socket = socket;
    socket.onopen = () => this.say(sentence);
    socket.onmessage = ({ data }) => {
      if (this.socket === socket) this.hear(JSON.parse(data));
    };
    socket.onclose = ({ code, reason }) => {
      if (this.socket !== socket) return;
      this.socket = null;
      if (code !== 1000) this.wrong ||= reason || "the stream does not answer, or all its places are taken";
      this.changed();
    };
    this.changed();
  }

  /** @param {string} sentence */
  say(sentence) {
    this.wrong = "";
    this.asked = performance.now();
    this.socket?.send(JSON.stringify({ caption: sentence }));
    this.changed();
  }

  /** @param {Message} message */
  hear({ error, joints, line = 0, sentence = "" }) {
    if (error !== undefined) this.wrong = error;
    if (joints) this.draw(joints);
    if (joints && line === this.line) return;
    if (joints) [this.line, this.sentence, this.delay] = [line, sentence, (performance.now() - this.asked) / 1000];
    this.changed();
  }

  /** @param {number[][]} joints */
  draw(joints) {
    const format = Object.values(FORMATS).find(({ parents }) => parents.length === joints.length);
    if (!format) this.wrong = `its figures have ${joints.length} joints, which this page cannot draw`;
    if (!format) return this.close();
    if (this.shown) return this.shown.append(joints);
    const canvas = document.createElement("canvas");
    canvas.className = "figure";
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "The stream's figure. Arrow keys turn the view.");
    const [row, figure, bar] = ["div", "figure", "div"].map((tag) => document.createElement(tag));
    if (!row || !figure || !bar) return;
    [row.className, bar.className] = ["figures", "viewer-bar"];
    bar.setAttribute("role", "group");
    bar.setAttribute("aria-label", "Figure");
    figure.append(canvas);
    row.append(figure);
    this.element.replaceChildren(row, bar);
    const body = { parents: format.parents, sides: format.sides, head: format.head };
    const first = packed(Float32Array.from(joints.flat()), format);
    this.shown = mount(this.element, { bodies: [body], motions: [first] }, { live: true, characters: () => import("./character.js") });
  }

  close() {
    const { socket } = this;
    this.socket = null;
    socket?.close();
    this.shown?.close();
    this.shown = null;
    [this.line, this.sentence, this.wrong] = [0, "", ""];
  }
}
