//! Clips of a dataset's artifact: its index, and the rows of one clip as joints for the viewer.
//!
//! Sources: `motion::dataset` for the files, and `motion::features::recover_joints` for the joints, which a test compares with these.

import { blob, part } from "./api.js";
import { size } from "./format.js";

/** @typedef {{parents: number[], sides: string, head: number, fps: number, metres: number}} Format */
/** @type {Record<string, Format>} */
export const FORMATS = {
  humanml3d: { parents: [0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19], sides: "mlrmlrmlrmlrmlrmlrlrlr", head: 15, fps: 20, metres: 1 },
  kit: { parents: [0, 0, 1, 2, 3, 3, 5, 6, 3, 8, 9, 0, 11, 12, 13, 14, 0, 16, 17, 18, 19], sides: "mmmmmrrrlllrrrrrlllll", head: 4, fps: 12.5, metres: 0.0015625 },
};

/** @typedef {{id: string, clip: number, start: number, len: number, captions: number[], split: string}} Entry */
/** @typedef {{version: number, format: string, clips: {id: string, frames: number, shard: number}[], captions: {text: string}[], entries: Entry[]}} Index */

/** Bytes up to which an index is fetched. */
const MOST = 64e6;

/** Joints `[frames, joints, 3]` in metres of rows in the data's own scale. The root of the first frame is above the origin. @param {Float32Array} rows @param {Format} format */
export function recover(rows, format) {
  const count = format.parents.length;
  const width = 12 * count - 1;
  const frames = Math.floor(rows.length / width);
  const joints = new Float32Array(frames * count * 3);
  const at = (/** @type {number} */ t, /** @type {number} */ i) => rows[t * width + i] ?? 0;
  let [angle, x, z] = [0, 0, 0];
  for (let t = 0; t < frames; t += 1) {
    if (t > 0) angle += at(t - 1, 0);
    // The turn is half the angle, as the quaternion has it; this turns back by the whole of it.
    const [cos, sin] = [Math.cos(2 * angle), Math.sin(2 * angle)];
    const turned = (/** @type {number} */ a, /** @type {number} */ b) => [cos * a - sin * b, sin * a + cos * b];
    if (t > 0) {
      const [dx, dz] = turned(at(t - 1, 1), at(t - 1, 2));
      x += dx ?? 0;
      z += dz ?? 0;
    }
    const out = t * count * 3;
    joints.set([x, at(t, 3), z].map((value) => value * format.metres), out);
    for (let j = 1; j < count; j += 1) {
      const from = 4 + 3 * (j - 1);
      const [px, pz] = turned(at(t, from), at(t, from + 2));
      joints.set([(px ?? 0) + x, at(t, from + 1), (pz ?? 0) + z].map((value) => value * format.metres), out + 3 * j);
    }
  }
  return joints;
}

/** A motion in the viewer's form. @param {Float32Array} joints @param {Format} format @returns {import("./viewer.js").Motion} */
export function packed(joints, format) {
  const axes = [0, 1, 2].map((axis) => joints.filter((_, i) => i % 3 === axis));
  const origin = axes.map((values) => (values.reduce((low, value) => Math.min(low, value), Infinity) + values.reduce((high, value) => Math.max(high, value), -Infinity)) / 2);
  const reach = joints.reduce((far, value, i) => Math.max(far, Math.abs(value - (origin[i % 3] ?? 0))), 0);
  const step = Math.max(1e-4, reach / 32767);
  const numbers = new DataView(new ArrayBuffer(joints.length * 2));
  joints.forEach((value, i) => numbers.setInt16(2 * i, Math.round((value - (origin[i % 3] ?? 0)) / step), true));
  let text = "";
  for (const byte of new Uint8Array(numbers.buffer)) text += String.fromCharCode(byte);
  return { body: 0, fps: format.fps, frames: joints.length / (3 * format.parents.length), step, origin, joints: btoa(text), waypoints: [] };
}

/** An artifact of kind `dataset`. */
export class Clips {
  /** @param {string} digest */
  constructor(digest) {
    this.digest = digest;
    /** @type {Index | null} */
    this.index = null;
    /** @type {Record<string, {digest: string, bytes: number}>} */
    this.files = {};
    /** Where tensors stand in a shard, by shard. @type {Map<number, Record<string, {data_offsets: [number, number]}> & {first: number}>} */
    this.shards = new Map();
  }

  /** @param {AbortSignal} [signal] */
  async open(signal) {
    const json = async (/** @type {string} */ digest) => JSON.parse(new TextDecoder().decode(await blob(digest, signal)));
    const manifest = await json(this.digest);
    this.files = manifest.files ?? {};
    const index = this.files["dataset.json"];
    if (!index) throw new Error("this artifact is no dataset");
    if (index.bytes > MOST) throw new Error(`its list of clips has ${size(index.bytes)}, which is too much for a page`);
    const read = /** @type {Index} */ (await json(index.digest));
    if (read.version !== 1 || !(read.format in FORMATS)) throw new Error("it was made by another version of Stride");
    this.index = read;
  }

  /** What was left out, and why; empty if nothing is known about it. @param {AbortSignal} [signal] */
  async report(signal) {
    const file = this.files["report.txt"];
    return file && file.bytes <= MOST ? new TextDecoder().decode(await blob(file.digest, signal)) : "";
  }

  /** The frames of an entry. @param {Entry} entry @returns {Promise<import("./viewer.js").Motions>} */
  async motions(entry) {
    const format = FORMATS[this.index?.format ?? ""];
    const clip = this.index?.clips[entry.clip];
    if (!format || !clip) throw new Error("there is no such clip");
    const digest = this.files[`clips-${String(clip.shard).padStart(4, "0")}.safetensors`]?.digest ?? "";
    let shard = this.shards.get(clip.shard);
    if (!shard) {
      const length = Number(new DataView(await part(digest, 0, 8)).getBigUint64(0, true));
      const head = JSON.parse(new TextDecoder().decode(await part(digest, 8, length)));
      this.shards.set(clip.shard, (shard = { ...head, first: 8 + length }));
    }
    const place = shard?.[`c${String(entry.clip).padStart(7, "0")}`];
    if (!shard || !place) throw new Error("there is no such clip");
    const width = 12 * format.parents.length - 1;
    const bytes = await part(digest, shard.first + place.data_offsets[0] + 4 * entry.start * width, 4 * entry.len * width);
    const joints = recover(new Float32Array(bytes), format);
    return { bodies: [{ parents: format.parents, sides: format.sides, head: format.head }], motions: [packed(joints, format)] };
  }
}
