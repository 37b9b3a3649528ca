//! Rates of stages at work, over the last half minute of what was seen.

const STRETCH_MS = 30000;

export class Rates {
  constructor() {
    /** @type {Map<string, {at: number, done: number, attempt: number}[]>} */
    this.seen = new Map();
  }

  /** @param {Run} run */
  see(run) {
    const at = performance.now();
    for (const stage of run.stages) {
      if (stage.state !== "running") continue;
      const name = `${run.run}/${stage.name}`;
      let list = this.seen.get(name) ?? [];
      const last = list[list.length - 1];
      const { done } = stage.progress;
      if (last && (last.attempt !== stage.attempt || done < last.done)) list = [];
      if (last?.done !== done || list.length === 0) list.push({ at, done, attempt: stage.attempt });
      // One older than the stretch stays, so that slow work has a rate as well.
      while (list.length > 2 && (list[1]?.at ?? at) < at - STRETCH_MS) list.shift();
      this.seen.set(name, list);
    }
  }

  /** @param {Run} run @param {Stage} stage @returns {number | undefined} */
  of(run, stage) {
    const list = this.seen.get(`${run.run}/${stage.name}`) ?? [];
    const [first, last] = [list[0], list[list.length - 1]];
    if (first && last && last.at - first.at > 1500) return ((last.done - first.done) * 1000) / (last.at - first.at);
    // Before that, the mean of all of its work.
    return stage.wall_s > 5 && stage.progress.done > 0 && stage.attempt <= 1 ? stage.progress.done / stage.wall_s : undefined;
  }
}
