//! A draw: asks for it, follows its run, and fetches its motions.

import { blob, get, post, runPath } from "./api.js";
import { isOver } from "./parts.js";

/** Milliseconds between two looks at the run. */
const ASK_MS = 350;

/** The motions of one model, and the files of its report. @typedef {{files: Record<string, {digest: string}>, motions: import("./viewer.js").Motions}} Report */

/** @param {string} digest @returns {Promise<any>} */
const json = async (digest) => JSON.parse(new TextDecoder().decode(await blob(digest)));

/** Draws, and calls `follow` with the run as it goes until that returns false. Reports are in the order of the models; a run that did not finish has none. Draws with the same key are one run. @param {Record<string, unknown>} asked @param {(run: Run) => boolean} follow @param {string} [key] @returns {Promise<Report[]>} */
export async function drawing(asked, follow, key) {
  const { run, stages } = /** @type {{run: string, stages: string[]}} */ (await post("/v1/draws", asked, key ? { "idempotency-key": key } : {}));
  for (;;) {
    const now = /** @type {Run} */ (await get(runPath(run)));
    if (!follow(now)) return [];
    if (isOver(now) || now.state === "paused") {
      if (now.state !== "finished") return [];
      return Promise.all(stages.map(async (name) => {
        const { files } = /** @type {Pick<Report, "files">} */ (await json(now.stages.find((stage) => stage.name === name)?.outputs.report ?? ""));
        return { files, motions: await json(files["motions.json"]?.digest ?? "") };
      }));
    }
    await new Promise((done) => setTimeout(done, ASK_MS));
  }
}
