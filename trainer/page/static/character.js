//! A person's own character: a skinned mesh of a GLB file, moved by the joints of a motion.
//!
//! Source: the glTF 2.0 specification. The file is read in the browser and sent nowhere. Joints are found by their names, in the
//! conventions of `CONVENTIONS`. A motion has positions alone, so each bone turns from its parent the shortest way to its direction;
//! hips and chest take their turn from three joints, and knees and elbows from the plane in which they bend. The character is scaled to
//! the motion's legs, so that feet stand where they stood.

import { size } from "./format.js";

/** @typedef {[number, number, number]} Vec */
/** Rows of a rotation. @typedef {[Vec, Vec, Vec]} Turn */
/** Where a picture is taken from: see `camera` in viewer.js. @typedef {{at: Vec, turn: [number, number, number, number], scale: number, distance: number}} Lens */
/** @typedef {{first: number, count: number, colour: Vec, image: ImageBitmap | null}} Part */

/** Limits of a file. */
const [BYTES, VERTICES, NODES] = [64 << 20, 400_000, 2000];
/** Parts of a body, parents first: name, parent, and the part that it points to. @type {[string, string | null, string | null][]} */
const ROLES = [
  ["pelvis", null, null], ["spine1", "pelvis", "spine2"], ["spine2", "spine1", "spine3"], ["spine3", "spine2", "neck"], ["neck", "spine3", "head"], ["head", "neck", null],
  ...["left", "right"].flatMap((side) => /** @type {[string, string, string | null][]} */ ([
    [`${side}_collar`, "spine3", `${side}_shoulder`], [`${side}_shoulder`, `${side}_collar`, `${side}_elbow`], [`${side}_elbow`, `${side}_shoulder`, `${side}_wrist`], [`${side}_wrist`, `${side}_elbow`, null],
    [`${side}_hip`, "pelvis", `${side}_knee`], [`${side}_knee`, `${side}_hip`, `${side}_ankle`], [`${side}_ankle`, `${side}_knee`, `${side}_foot`], [`${side}_foot`, `${side}_ankle`, null],
  ])),
];
const NAMES = ROLES.map(([name]) => name);
const SPINE = ["pelvis", "spine1", "spine2", "spine3", "neck", "head"];
const LIMB = ["collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot"];
const NEEDED = NAMES.filter((name) => /pelvis|hip|knee|ankle|shoulder|elbow/.test(name));
/** Names of the spine and of a limb's parts in programs, in the order of `SPINE` and `LIMB`; `*` is the side. @type {[string[], string[], [string, string]][]} */
const CONVENTIONS = [
  [["hips", "spine", "spine1", "spine2", "neck", "head"], ["*shoulder", "*arm", "*forearm", "*hand", "*upleg", "*leg", "*foot", "*toebase"], ["left", "right"]],
  [["pelvis", "spine1", "spine2", "spine3", "neck", "head"], ["*collar", "*shoulder", "*elbow", "*wrist", "*hip", "*knee", "*ankle", "*foot"], ["left", "right"]],
  [["pelvis", "spine1", "spine2", "spine3", "neck", "head"], ["*collar", "*shoulder", "*elbow", "*wrist", "*hip", "*knee", "*ankle", "*foot"], ["l", "r"]],
  [["hips", "spine", "chest", "upperchest", "neck", "head"], ["*shoulder", "*upperarm", "*lowerarm", "*hand", "*upperleg", "*lowerleg", "*foot", "*toes"], ["left", "right"]],
  [["pelvis", "spine01", "spine02", "spine03", "neck01", "head"], ["clavicle*", "upperarm*", "lowerarm*", "hand*", "thigh*", "calf*", "foot*", "ball*"], ["l", "r"]],
  [["spine", "spine001", "spine002", "spine003", "spine004", "spine006"], ["shoulder*", "upperarm*", "forearm*", "hand*", "thigh*", "shin*", "foot*", "toe*"], ["l", "r"]],
];
/** Joints of the bodies that motions have, by the joints' parents. @type {Record<string, string[]>} */
const BODIES = {
  "0,0,0,0,1,2,3,4,5,6,7,8,9,9,9,12,13,14,16,17,18,19": "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist".split(" "),
  "0,0,1,2,3,3,5,6,3,8,9,0,11,12,13,14,0,16,17,18,19": "pelvis spine1 spine3 neck head right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist right_hip right_knee right_ankle right_heel right_foot left_hip left_knee left_ankle left_heel left_foot".split(" "),
};

const minus = (/** @type {Vec} */ a, /** @type {Vec} */ b) => /** @type {Vec} */ ([a[0] - b[0], a[1] - b[1], a[2] - b[2]]);
const plus = (/** @type {Vec} */ a, /** @type {Vec} */ b, by = 1) => /** @type {Vec} */ ([a[0] + by * b[0], a[1] + by * b[1], a[2] + by * b[2]]);
const dot = (/** @type {Vec} */ a, /** @type {Vec} */ b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (/** @type {Vec} */ a, /** @type {Vec} */ b) => /** @type {Vec} */ ([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]);
/** @param {Vec} a @returns {Vec} */
const unit = (a) => {
  const long = Math.hypot(...a) || 1;
  return [a[0] / long, a[1] / long, a[2] / long];
};
const turned = (/** @type {Turn} */ turn, /** @type {Vec} */ a) => /** @type {Vec} */ ([dot(turn[0], a), dot(turn[1], a), dot(turn[2], a)]);
/** @param {Turn} a @param {Turn} b @returns {Turn} */
const after = (a, b) => {
  const column = (/** @type {0 | 1 | 2} */ k) => turned(a, [b[0][k], b[1][k], b[2][k]]);
  return back([column(0), column(1), column(2)]);
};
/** The inverse. @param {Turn} [turn] @returns {Turn} */
const back = ([a, b, c] = SAME) => [[a[0], b[0], c[0]], [a[1], b[1], c[1]], [a[2], b[2], c[2]]];
/** @type {Turn} */
const SAME = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];

/** Axes along `first`, and as near to `second` as that allows. @param {Vec} first @param {Vec} second @returns {Turn} */
function frame(first, second) {
  const a = unit(first);
  const c = unit(cross(a, second));
  return [a, cross(c, a), c];
}

/** From the axes of one pair of directions to those of another. @param {[Vec, Vec]} from @param {[Vec, Vec]} to */
const between = (from, to) => after(back(frame(...to)), frame(...from));

/** The shortest turn of a direction to another. @param {Vec} from @param {Vec} to @returns {Turn} */
function shortest(from, to) {
  const [a, b] = [unit(from), unit(to)];
  const axis = cross(a, b);
  const cos = dot(a, b);
  if (cos < -0.9999) return between([a, [a[1], a[2], -a[0]]], [b, [a[1], a[2], -a[0]]]);
  const [x, y, z] = axis;
  const k = 1 / (1 + cos);
  return [[cos + k * x * x, k * x * y - z, k * x * z + y], [k * x * y + z, cos + k * y * y, k * y * z - x], [k * x * z - y, k * y * z + x, cos + k * z * z]];
}

/** Column-major, as files have them. @typedef {Float64Array} Matrix */
/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b @returns {Matrix} */
function product(a, b) {
  const out = new Float64Array(16);
  for (let c = 0; c < 4; c += 1) for (let r = 0; r < 4; r += 1) for (let k = 0; k < 4; k += 1) out[4 * c + r] = (out[4 * c + r] ?? 0) + (a[4 * k + r] ?? 0) * (b[4 * c + k] ?? 0);
  return out;
}

/** @param {any} node @returns {ArrayLike<number>} */
function local(node) {
  if (Array.isArray(node.matrix)) return node.matrix;
  const [[x, y, z, w], [sx, sy, sz], [tx, ty, tz]] = [node.rotation ?? [0, 0, 0, 1], node.scale ?? [1, 1, 1], node.translation ?? [0, 0, 0]];
  return [
    sx * (1 - 2 * (y * y + z * z)), sx * 2 * (x * y + z * w), sx * 2 * (x * z - y * w), 0,
    sy * 2 * (x * y - z * w), sy * (1 - 2 * (x * x + z * z)), sy * 2 * (y * z + x * w), 0,
    sz * 2 * (x * z + y * w), sz * 2 * (y * z - x * w), sz * (1 - 2 * (x * x + y * y)), 0, tx, ty, tz, 1,
  ];
}

/** A file's tree and its bytes. */
class File {
  /** @param {ArrayBuffer} buffer */
  constructor(buffer) {
    const view = new DataView(buffer);
    if (buffer.byteLength > BYTES) throw new Error(`the file has ${size(buffer.byteLength)}; expected at most ${size(BYTES)}`);
    if (buffer.byteLength < 28 || view.getUint32(0, true) !== 0x46546c67 || view.getUint32(4, true) !== 2) throw new Error("this is no GLB file of glTF 2.0");
    const length = view.getUint32(12, true);
    /** @type {any} */
    this.tree = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, length)));
    this.start = 20 + length + 8;
    this.view = view;
    const needs = (this.tree.extensionsRequired ?? []).filter((/** @type {string} */ name) => !/^(VRM|KHR_materials_|KHR_texture_transform)/.test(name));
    if (needs.length > 0) throw new Error(`the file needs ${needs.join(", ")}; export it without compression`);
  }

  /** The bytes of a view of the buffer. @param {number} at */
  bytes(at) {
    const { byteOffset = 0, byteLength, buffer } = this.tree.bufferViews[at];
    if (buffer !== 0) throw new Error("its data is in another file; export it as one GLB file");
    return new Uint8Array(this.view.buffer, this.start + byteOffset, byteLength);
  }

  /** The numbers of an accessor, one after another. @param {number} at @returns {Float32Array} */
  numbers(at) {
    const { bufferView, byteOffset = 0, componentType, count, type, normalized, sparse } = this.tree.accessors[at];
    if (sparse) throw new Error("the file has sparse data; export it without morph targets");
    const wide = /** @type {Record<string, number>} */ ({ SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4, MAT4: 16 })[type] ?? 0;
    const [size, most] = /** @type {Record<number, [number, number]>} */ ({ 5120: [1, 127], 5121: [1, 255], 5122: [2, 32767], 5123: [2, 65535], 5125: [4, 1], 5126: [4, 1] })[componentType] ?? [0, 0];
    if (wide === 0 || size === 0 || !(count <= 16 * VERTICES)) throw new Error("the file has data of an unknown kind, or too much");
    const out = new Float32Array(count * wide);
    if (bufferView === undefined) return out;
    const bytes = this.bytes(bufferView);
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    const stride = this.tree.bufferViews[bufferView].byteStride ?? size * wide;
    const read = (/** @type {number} */ from) => {
      if (componentType === 5126) return view.getFloat32(from, true);
      if (componentType === 5125) return view.getUint32(from, true);
      if (size === 2) return componentType === 5122 ? view.getInt16(from, true) : view.getUint16(from, true);
      return componentType === 5120 ? view.getInt8(from) : view.getUint8(from);
    };
    for (let i = 0; i < count; i += 1) for (let k = 0; k < wide; k += 1) out[i * wide + k] = read(byteOffset + i * stride + k * size) / (normalized ? most : 1);
    return out;
  }
}

/** The nodes of the body's parts, by the convention that names most of them. @param {any[]} nodes @returns {Map<string, number>} */
function rolesOf(nodes) {
  const known = new Map(nodes.map((node, at) => [String(node.name ?? "").replace(/^.*:/, "").replace(/^(mixamorig\d*|def|bip01|j_bip_[clr])/i, "").replace(/[^a-z0-9]/gi, "").toLowerCase(), at]));
  let best = new Map();
  for (const [spine, limb, sides] of CONVENTIONS) {
    /** @type {[string, string][]} */
    const wanted = SPINE.map((role, at) => [role, spine[at] ?? ""]);
    for (const [side, word] of /** @type {[string, string][]} */ ([["left", sides[0]], ["right", sides[1]]])) LIMB.forEach((part, at) => wanted.push([`${side}_${part}`, (limb[at] ?? "").replace("*", word)]));
    const found = new Map(wanted.flatMap(([role, name]) => (known.has(name) ? [[role, known.get(name) ?? 0]] : [])));
    if (found.size > best.size) best = found;
  }
  const missing = NEEDED.filter((role) => !best.has(role));
  if (missing.length > 0) throw new Error(`its skeleton has no joint for ${missing.slice(0, 3).join(", ")}; expected names as Mixamo, VRM, SMPL, Unreal or Rigify have them`);
  return best;
}

/** Reads a character. @param {ArrayBuffer} buffer @returns {Promise<Character>} */
export async function read(buffer) {
  try {
    return await Character.of(new File(buffer));
  } catch (error) {
    if (error instanceof RangeError || error instanceof TypeError || error instanceof SyntaxError) throw new Error("the file is damaged");
    throw error;
  }
}

export class Character {
  /** @param {File} file */
  static async of(file) {
    const { nodes = [], meshes = [], skins = [] } = file.tree;
    if (nodes.length > NODES) throw new Error(`the file has ${nodes.length} nodes; expected at most ${NODES}`);
    const it = new Character();
    const parents = new Int32Array(nodes.length).fill(-1);
    nodes.forEach((/** @type {any} */ node, /** @type {number} */ at) => (node.children ?? []).forEach((/** @type {number} */ child) => { parents[child] = at; }));
    /** @type {Map<number, Matrix>} */
    const places = new Map();
    /** @param {number} at @param {number} [deep] @returns {Matrix} */
    const place = (at, deep = 0) => {
      if (deep > NODES) throw new Error("the file is damaged");
      let known = places.get(at);
      if (!known) places.set(at, (known = (parents[at] ?? -1) < 0 ? Float64Array.from(local(nodes[at])) : product(place(parents[at] ?? 0, deep + 1), local(nodes[at]))));
      return known;
    };
    const nodeOf = rolesOf(nodes);
    const roleOf = new Map([...nodeOf].map(([role, node]) => [node, role]));
    for (const [role, node] of nodeOf) it.rest.set(role, /** @type {Vec} */ ([...place(node).slice(12, 15)]));
    /** The part that a node moves with. @param {number} node @returns {number} */
    const anchor = (node) => {
      for (let at = node, deep = 0; at >= 0 && deep < NODES; at = parents[at] ?? -1, deep += 1) if (roleOf.has(at)) return NAMES.indexOf(roleOf.get(at) ?? "");
      return 0;
    };
    for (const node of nodes) {
      if (node.mesh === undefined || node.skin === undefined) continue;
      const { joints, inverseBindMatrices } = skins[node.skin];
      const binds = inverseBindMatrices === undefined ? null : file.numbers(inverseBindMatrices);
      const skin = joints.map((/** @type {number} */ joint, /** @type {number} */ at) => ({ anchor: anchor(joint), matrix: binds ? product(place(joint), binds.subarray(16 * at, 16 * at + 16)) : place(joint) }));
      for (const primitive of meshes[node.mesh].primitives) if ((primitive.mode ?? 4) === 4) await it.add(file, primitive, skin);
    }
    if (it.count === 0) throw new Error("the file has no mesh with a skin");
    it.finish();
    return it;
  }

  constructor() {
    this.count = 0;
    /** Places of the body's parts at rest. @type {Map<string, Vec>} */
    this.rest = new Map();
    /** @type {Part[]} */
    this.parts = [];
    /** For each vertex and each of its four joints: the part that it moves with, its share, and its place and normal at rest. @type {Float32Array[]} */
    this.chunks = [];
    /** @type {number[][]} */
    this.indices = [];
    /** @type {Float32Array[]} */
    this.corners = [];
    this.painter = /** @type {Painter | null} */ (null);
  }

  /** @param {File} file @param {any} primitive @param {{anchor: number, matrix: Matrix}[]} skin */
  async add(file, primitive, skin) {
    const { POSITION, NORMAL, JOINTS_0, WEIGHTS_0, TEXCOORD_0 } = primitive.attributes;
    if (POSITION === undefined || JOINTS_0 === undefined || WEIGHTS_0 === undefined) return;
    const [points, joints, weights] = [file.numbers(POSITION), file.numbers(JOINTS_0), file.numbers(WEIGHTS_0)];
    const many = points.length / 3;
    const first = this.count;
    this.count += many;
    if (this.count > VERTICES || joints.length !== 4 * many || weights.length !== 4 * many) throw new Error(`the character has ${this.count} corners or no four joints for each; expected at most ${VERTICES}`);
    const index = primitive.indices === undefined ? Array.from({ length: many }, (_, i) => i) : [...file.numbers(primitive.indices)];
    if (index.some((i) => i >= many)) throw new Error("the file is damaged");
    const normals = NORMAL === undefined ? normalsOf(points, index) : file.numbers(NORMAL);
    // Eight numbers for each of four joints: part, share, place, normal.
    const chunk = new Float32Array(32 * many);
    for (let i = 0; i < many; i += 1) {
      for (let k = 0; k < 4; k += 1) {
        const share = weights[4 * i + k] ?? 0;
        const bone = skin[joints[4 * i + k] ?? 0];
        if (share === 0 || !bone) continue;
        const to = 32 * i + 8 * k;
        const m = bone.matrix;
        const [x, y, z, nx, ny, nz] = [...points.subarray(3 * i, 3 * i + 3), ...normals.subarray(3 * i, 3 * i + 3)];
        const along = (/** @type {number} */ r, a = 0, b = 0, c = 0, w = 0) => (m[r] ?? 0) * a + (m[4 + r] ?? 0) * b + (m[8 + r] ?? 0) * c + (m[12 + r] ?? 0) * w;
        chunk.set([bone.anchor, share, along(0, x, y, z, 1), along(1, x, y, z, 1), along(2, x, y, z, 1), ...unit([along(0, nx, ny, nz), along(1, nx, ny, nz), along(2, nx, ny, nz)])], to);
      }
    }
    const { pbrMetallicRoughness: look = {} } = file.tree.materials?.[primitive.material] ?? {};
    const colour = /** @type {Vec} */ ((look.baseColorFactor ?? [1, 1, 1]).slice(0, 3).map((/** @type {number} */ value) => value ** (1 / 2.2)));
    this.parts.push({ first: this.indices.reduce((sum, one) => sum + one.length, 0), count: index.length, colour, image: await picture(file, look.baseColorTexture?.index) });
    this.indices.push(index.map((i) => first + i));
    this.corners.push(TEXCOORD_0 === undefined ? new Float32Array(2 * many) : file.numbers(TEXCOORD_0));
    this.chunks.push(chunk);
  }

  finish() {
    this.bound = new Float32Array(32 * this.count);
    let at = 0;
    for (const chunk of this.chunks) {
      this.bound.set(chunk, at);
      at += chunk.length;
    }
    this.chunks = [];
    /** Place and normal of each vertex. */
    this.moved = new Float32Array(6 * this.count);
  }

  /** True if it can do what such a body does. @param {{parents: number[]}} body */
  fits(body) {
    return body.parents.join() in BODIES;
  }

  /** Turns and places of the body's parts. @param {Map<string, Vec>} joints */
  pose(joints) {
    const { rest } = this;
    const has = (/** @type {string | null} */ role) => role !== null && rest.has(role) && joints.has(role);
    const way = (/** @type {Map<string, Vec>} */ of, /** @type {string} */ from, /** @type {string} */ to) => minus(of.get(to) ?? [0, 0, 0], of.get(from) ?? [0, 0, 0]);
    /** The next part up or down that both have. @param {string | null} role @param {1 | 2} by @returns {string | null} */
    const next = (role, by) => {
      let at = role;
      while (at !== null && !has(at)) at = ROLES[NAMES.indexOf(at)]?.[by] ?? null;
      return at;
    };
    const leg = (/** @type {Map<string, Vec>} */ of) => Math.hypot(...way(of, "left_hip", "left_knee")) + Math.hypot(...way(of, "left_knee", "left_ankle"));
    const scale = leg(joints) / (leg(rest) || 1);
    const upper = next("spine1", 2) ?? "neck";
    const forward = cross(way(rest, "right_hip", "left_hip"), way(rest, "pelvis", upper));
    const chest = ["spine3", "spine2", "spine1"].find(has);
    /** @type {Map<string, Turn>} */
    const turns = new Map();
    /** @type {Map<string, Vec>} */
    const places = new Map();
    for (const [role, above, below] of ROLES) {
      const parent = next(above, 1);
      const before = turns.get(above ?? "") ?? SAME;
      const to = next(below, 2);
      let turn = before;
      if (role === "pelvis") turn = between([way(rest, "right_hip", "left_hip"), way(rest, "pelvis", upper)], [way(joints, "right_hip", "left_hip"), way(joints, "pelvis", upper)]);
      else if (role === chest && to) turn = between([way(rest, "right_shoulder", "left_shoulder"), way(rest, role, to)], [way(joints, "right_shoulder", "left_shoulder"), way(joints, role, to)]);
      else if (has(role) && to) {
        const [was, is] = [way(rest, role, to), way(joints, role, to)];
        turn = after(shortest(turned(before, was), is), before);
        const end = /_(hip|shoulder)$/.test(role) ? next(ROLES[NAMES.indexOf(to)]?.[2] ?? null, 2) : null;
        if (end) {
          // The plane of a bent knee or elbow; a straight one has none, and keeps the shortest turn.
          const hinge = cross(was, role.endsWith("hip") ? plus([0, 0, 0], forward, -1) : forward);
          const bend = cross(unit(is), unit(way(joints, to, end)));
          turn = between([was, hinge], [is, plus(bend, unit(turned(turn, hinge)), 0.15)]);
        }
      }
      turns.set(role, turn);
      const [from, at] = [rest.get(parent ?? ""), rest.get(role)];
      const base = places.get(parent ?? "");
      if (role === "pelvis" || !from || !at || !base) places.set(role, joints.get(role) ?? places.get(above ?? "") ?? [0, 0, 0]);
      else places.set(role, plus(base, turned(turns.get(parent ?? "") ?? SAME, minus(at, from)), scale));
    }
    return { turns, places, scale };
  }

  /** Moves the mesh to a pose. @param {{parents: number[]}} body @param {Vec[]} points */
  move(body, points) {
    const names = BODIES[body.parents.join()] ?? [];
    const { turns, places, scale } = this.pose(new Map(names.map((name, at) => [name, points[at] ?? [0, 0, 0]])));
    const table = new Float64Array(15 * NAMES.length);
    NAMES.forEach((role, at) => table.set([...(turns.get(role) ?? SAME).flat(), ...(places.get(role) ?? [0, 0, 0]), ...(this.rest.get(role) ?? [0, 0, 0])], 15 * at));
    const [bound, moved] = [this.bound ?? new Float32Array(0), this.moved ?? new Float32Array(0)];
    const number = (/** @type {Float32Array | Float64Array} */ of, /** @type {number} */ at) => /** @type {number} */ (of[at]);
    moved.fill(0);
    for (let i = 0; i < this.count; i += 1) {
      for (let k = 32 * i; k < 32 * i + 32; k += 8) {
        const share = number(bound, k + 1);
        if (share === 0) continue;
        const m = 15 * number(bound, k);
        const [x, y, z] = [number(bound, k + 2) - number(table, m + 12), number(bound, k + 3) - number(table, m + 13), number(bound, k + 4) - number(table, m + 14)];
        for (let axis = 0; axis < 3; axis += 1) {
          const [a, b, c] = [number(table, m + 3 * axis), number(table, m + 3 * axis + 1), number(table, m + 3 * axis + 2)];
          moved[6 * i + axis] = number(moved, 6 * i + axis) + share * (number(table, m + 9 + axis) + scale * (a * x + b * y + c * z));
          moved[6 * i + 3 + axis] = number(moved, 6 * i + 3 + axis) + share * (a * number(bound, k + 5) + b * number(bound, k + 6) + c * number(bound, k + 7));
        }
      }
    }
    return moved;
  }

  /** Prepares the graphics, or says why that cannot be. */
  ready() {
    this.painter ??= new Painter(this);
    return this.painter;
  }

  /** Draws it over what a canvas shows. @param {CanvasRenderingContext2D} context @param {[number, number]} size @param {Lens} lens @param {{parents: number[]}} body @param {Vec[]} points */
  paint(context, size, lens, body, points) {
    const painter = this.ready();
    const { canvas } = painter;
    const { width, height } = context.canvas;
    if (canvas.width < width || canvas.height < height) [canvas.width, canvas.height] = [Math.max(canvas.width, width), Math.max(canvas.height, height)];
    painter.paint([width, height], size, lens, this.move(body, points));
    context.drawImage(canvas, 0, canvas.height - height, width, height, 0, 0, size[0], size[1]);
  }
}

/** Means of the normals of the triangles around each corner. @param {Float32Array} points @param {number[]} index */
function normalsOf(points, index) {
  const normals = new Float32Array(points.length);
  const point = (/** @type {number} */ i) => /** @type {Vec} */ ([...points.subarray(3 * i, 3 * i + 3)]);
  for (let t = 0; t + 2 < index.length; t += 3) {
    const [a, b, c] = [index[t] ?? 0, index[t + 1] ?? 0, index[t + 2] ?? 0];
    const normal = cross(minus(point(b), point(a)), minus(point(c), point(a)));
    for (const i of [a, b, c]) normal.forEach((value, axis) => { normals[3 * i + axis] = (normals[3 * i + axis] ?? 0) + value; });
  }
  return normals;
}

/** @param {File} file @param {number | undefined} texture @returns {Promise<ImageBitmap | null>} */
async function picture(file, texture) {
  const image = file.tree.images?.[file.tree.textures?.[texture ?? -1]?.source ?? -1];
  if (image?.bufferView === undefined) return null;
  const type = image.mimeType === "image/jpeg" ? "image/jpeg" : "image/png";
  return createImageBitmap(new Blob([file.bytes(image.bufferView).slice()], { type }), { resizeWidth: 1024, resizeHeight: 1024 });
}

const VERTEX = `#version 300 es
in vec3 place; in vec3 normal; in vec2 corner; uniform vec3 at; uniform vec4 turn; uniform vec4 lens; out vec2 spot; out float lit;
vec3 seen(vec3 d) { float near = d.x * turn.x + d.z * turn.y; return vec3(d.x * turn.y - d.z * turn.x, d.y * turn.z - near * turn.w, near * turn.z + d.y * turn.w); }
void main() {
  vec3 d = seen(place - at); float far = lens.z - d.z; vec2 range = vec2(0.05, 8.0) * lens.z;
  gl_Position = vec4(lens.xy * d.xy, (far * (range.x + range.y) - 2.0 * range.x * range.y) / (range.y - range.x), far);
  lit = 0.5 + 0.5 * max(0.0, dot(normalize(seen(normal)), normalize(vec3(-0.4, 0.7, 0.6)))); spot = corner;
}`;
const FRAGMENT = `#version 300 es
precision mediump float; in vec2 spot; in float lit; uniform sampler2D image; uniform vec3 colour; out vec4 shown;
void main() { vec4 texel = texture(image, spot); if (texel.a < 0.5) discard; shown = vec4(texel.rgb * colour * lit, 1.0); }`;

/** The mesh on a canvas of its own, whose lower left is copied. */
class Painter {
  /** @param {Character} character */
  constructor(character) {
    this.canvas = document.createElement("canvas");
    const gl = this.canvas.getContext("webgl2", { antialias: true });
    if (!gl) throw new Error("this browser has no WebGL, which draws characters");
    this.gl = gl;
    this.parts = character.parts;
    const program = gl.createProgram();
    for (const [kind, text] of /** @type {[number, string][]} */ ([[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]])) {
      const shader = gl.createShader(kind);
      if (!shader) throw new Error("the graphics of this browser have stopped");
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    this.uniform = (/** @type {string} */ name) => gl.getUniformLocation(program, name);
    this.moved = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.moved);
    gl.bufferData(gl.ARRAY_BUFFER, 24 * character.count, gl.DYNAMIC_DRAW);
    const attribute = (/** @type {string} */ name, /** @type {number} */ size, /** @type {number} */ stride, /** @type {number} */ from) => {
      const at = gl.getAttribLocation(program, name);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, size, gl.FLOAT, false, stride, from);
    };
    attribute("place", 3, 24, 0);
    attribute("normal", 3, 24, 12);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    const corners = new Float32Array(2 * character.count);
    let at = 0;
    for (const part of character.corners) {
      corners.set(part, at);
      at += part.length;
    }
    gl.bufferData(gl.ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    attribute("corner", 2, 8, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint32Array.from(character.indices.flat()), gl.STATIC_DRAW);
    gl.enable(gl.DEPTH_TEST);
    this.textures = character.parts.map(({ image }) => {
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      if (image) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
      else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array([255, 255, 255, 255]));
      gl.generateMipmap(gl.TEXTURE_2D);
      return texture;
    });
  }

  /** @param {[number, number]} pixels @param {[number, number]} size @param {Lens} lens @param {Float32Array} moved */
  paint(pixels, size, { at, turn, scale, distance }, moved) {
    const { gl } = this;
    gl.viewport(0, 0, ...pixels);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.moved);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, moved);
    gl.uniform3f(this.uniform("at"), ...at);
    gl.uniform4f(this.uniform("turn"), ...turn);
    gl.uniform4f(this.uniform("lens"), (2 * scale * distance) / size[0], (2 * scale * distance) / size[1], distance, 0);
    this.parts.forEach(({ first, count, colour }, part) => {
      gl.bindTexture(gl.TEXTURE_2D, this.textures[part] ?? null);
      gl.uniform3f(this.uniform("colour"), ...colour);
      gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 4 * first);
    });
  }
}
