//! Figures of motions as one element, which a view may keep while it is drawn again.

import { number, plain } from "./format.js";
import { mount } from "./viewer.js";

/** A blob under a name of its own. @typedef {{text: string, digest: string, name: string}} Download */
/** @typedef {{title: string, note: string, files?: Download[]}} Caption */

export class Figures {
  constructor() {
    this.element = document.createElement("div");
    this.element.className = "viewer card";
    /** @type {ReturnType<typeof mount> | null} */
    this.shown = null;
  }

  close() {
    this.shown?.close();
    this.shown = null;
  }

  /** @param {import("./viewer.js").Motions} motions @param {Caption[]} captions one for each motion */
  show(motions, captions) {
    this.close();
    const row = document.createElement("div");
    row.className = "figures";
    motions.motions.forEach((motion, at) => {
      const figure = document.createElement("figure");
      const text = document.createElement("figcaption");
      const [title, note] = [document.createElement("b"), document.createElement("span")];
      title.dir = "auto";
      title.textContent = plain(captions[at]?.title ?? "");
      note.className = "dim small";
      note.textContent = `${plain(captions[at]?.note ?? "")} ${number((motion.frames - 1) / motion.fps)} s`;
      text.append(title, note);
      const canvas = document.createElement("canvas");
      canvas.className = "figure";
      canvas.tabIndex = 0;
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `${title.textContent}: ${note.textContent}. Arrow keys turn the view.`);
      figure.append(text, canvas);
      const files = captions[at]?.files ?? [];
      if (files.length > 0) figure.append(downloads(files, title.textContent));
      row.append(figure);
    });
    const bar = document.createElement("div");
    bar.className = "viewer-bar";
    bar.setAttribute("role", "group");
    bar.setAttribute("aria-label", "Playback");
    this.element.replaceChildren(row, bar);
    this.shown = mount(this.element, motions, { characters: () => import("./character.js") });
    this.shown.play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  }
}

/** Links that save blobs. @param {Download[]} files @param {string} of */
function downloads(files, of) {
  const list = document.createElement("p");
  list.className = "files";
  for (const { text, digest, name } of files) {
    const link = document.createElement("a");
    link.href = `/v1/blobs/${encodeURIComponent(digest)}`;
    link.download = name;
    link.textContent = text;
    link.setAttribute("aria-label", `Save ${of} as ${text}`);
    list.append(link);
  }
  return list;
}

/** Several answers as one, so that they share a time line. @param {import("./viewer.js").Motions[]} all @returns {import("./viewer.js").Motions} */
export function together(all) {
  /** @type {import("./viewer.js").Motions} */
  const joined = { bodies: [], motions: [] };
  for (const { bodies, motions } of all) {
    const first = joined.bodies.length;
    joined.bodies.push(...bodies);
    joined.motions.push(...motions.map((motion) => ({ ...motion, body: first + motion.body })));
  }
  return joined;
}
