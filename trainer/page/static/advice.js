//! What to do about a failure, by what its message says.

/** @type {[RegExp, string][]} */
const ADVICE = [
  [/out of memory|memory (was|is) exhausted|stage-memory|beyond its memory/i, "Give the stage fewer examples at once (`batch.global`, or more `slices`), or its worker more memory (`--stage-memory`). Resume goes on from the newest checkpoint."],
  [/not finite|diverged|NaN/i, "Look at the loss and the gradient's norm before the step. A lower `lr`, a longer `warmup` or a stricter clip mostly helps; that is a changed stage, so run the pipeline again with `--set`."],
  [/no space|space left|disk is full|not writable|read-only|store is full/i, "Free some space on the store's disk, then resume: it goes on from the newest checkpoint. The Store view says what can go."],
  [/cannot be promoted to/i, "The version is not good enough for the alias by the gates of its pipeline. Look at it in Models: train longer, or move the alias by hand with other gates and a reason."],
  [/differ(s)? from what|another copy|digest of|changed since/i, "The files differ from those that the run was submitted with. Bring them back, or submit the pipeline again for the new ones."],
  [/data.root/i, "The worker reads below its data roots alone: start it with `--data-root DIR` for the folder that the pipeline names, then resume."],
  [/no such file|does not exist|cannot (open|read)|not found/i, "Look whether the path is there on the worker's machine, and readable for it. Then resume."],
  [/panicked|internal fault|bug in Stride/i, "This is a fault of Stride, not of your settings. Resume tries again; the lines below belong into a report."],
  [/stage-time|took longer|too long/i, "The stage ran beyond its time. Raise `--stage-time` of its workers, then resume."],
  [/connection|unreachable|timed out|lost/i, "A worker or the network was lost more often than the budget allows. Look at the Workers view, then resume."],
];

/** The book's list of causes. */
export const CAUSES = "/book/troubleshooting.html#causes-of-failed-stages";

/** What holds for every failure. */
export const OTHERWISE = "Resume tries again from the newest checkpoint, with the same settings. For others change the pipeline and run it again: stages that have finished are not computed anew.";

/** @param {string | null | undefined} message @returns {string | null} */
export function whatToDo(message) {
  return ADVICE.find(([pattern]) => pattern.test(message ?? ""))?.[1] ?? null;
}
