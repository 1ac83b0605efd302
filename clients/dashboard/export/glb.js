/**
 * A robot that walks, as GLB (glTF 2.0 in one file): its skin, and one morph target per frame whose
 * weight is 1 at the frame's time. Blender, three.js and assimp can read it.
 */

import { FACE_CORNERS } from '../lib/body.js';

const [FLOAT, UNSIGNED_SHORT] = [5126, 5123];
const GLB_MAGIC = 0x46546c67;
const [JSON_CHUNK, BINARY_CHUNK] = [0x4e4f534a, 0x004e4942];

/** Collects arrays into one buffer, and describes each by a view and an accessor. */
class Arrays {
  constructor() {
    this.parts = [];
    this.size = 0;
    this.views = [];
    this.accessors = [];
  }

  /**
   * @param {{bounds?: boolean, target?: number}} [options] bounds: add the minimum and the maximum
   */
  add(data, componentType, type, count, options = {}) {
    const { bounds = false, target } = options;
    const accessor = { bufferView: this.views.length, componentType, count, type };
    if (bounds) {
      const width = type === 'VEC3' ? 3 : 1;
      accessor.min = new Array(width).fill(Infinity);
      accessor.max = new Array(width).fill(-Infinity);
      data.forEach((value, i) => {
        accessor.min[i % width] = Math.min(accessor.min[i % width], value);
        accessor.max[i % width] = Math.max(accessor.max[i % width], value);
      });
    }
    this.views.push({ buffer: 0, byteOffset: this.size, byteLength: data.byteLength,
      ...(target ? { target } : {}) });
    this.accessors.push(accessor);
    this.parts.push(new Uint8Array(data.buffer, data.byteOffset, data.byteLength));
    this.size += Math.ceil(data.byteLength / 4) * 4;
    this.parts.push(new Uint8Array(this.size - this.views.at(-1).byteOffset - data.byteLength));
    return this.accessors.length - 1;
  }
}

/** Chooses the frames of a film: at least `rate` per second, and no more than needed. */
function chooseFrames(robot, rate) {
  const every = Math.max(1, Math.floor(1 / (rate * robot.frameS) + 1e-6));
  const frames = [];
  for (let frame = 0; frame < robot.frames; frame += every) frames.push(frame);
  return frames;
}

/**
 * @param {import('../stage/stage.js').Robot} robot
 * @param {{rate?: number, name?: string}} [options] rate: minimum frames per second
 * @returns {Uint8Array}
 */
export function toGlb(robot, options = {}) {
  const { rate = 25, name = 'robot' } = options;
  const { body, track } = robot;
  const n = body.nMasses;
  const frames = chooseFrames(robot, rate);
  const at = (frame) => track.slice(frame * n * 3, (frame + 1) * n * 3);
  const first = at(0);
  const indices = new Uint16Array(body.nFaces * 6);
  for (let face = 0; face < body.nFaces; face++) {
    const [voxel, side] = [body.faces[2 * face], body.faces[2 * face + 1]];
    const corners = FACE_CORNERS[side].map((corner) => body.voxels[8 * voxel + corner]);
    indices.set([0, 1, 2, 0, 2, 3].map((i) => corners[i]), 6 * face);
  }

  const arrays = new Arrays();
  const position = arrays.add(first, FLOAT, 'VEC3', n, { bounds: true, target: 34962 });
  const index = arrays.add(indices, UNSIGNED_SHORT, 'SCALAR', indices.length, { target: 34963 });
  const targets = frames.slice(1).map((frame) => {
    const moved = at(frame).map((value, i) => value - first[i]);
    return { POSITION: arrays.add(moved, FLOAT, 'VEC3', n, { bounds: true, target: 34962 }) };
  });
  const times = Float32Array.from(frames, (frame) => frame * robot.frameS);
  const weights = new Float32Array(frames.length * targets.length);
  targets.forEach((_, i) => { weights[(i + 1) * targets.length + i] = 1; });
  const input = arrays.add(times, FLOAT, 'SCALAR', times.length, { bounds: true });
  const output = arrays.add(weights, FLOAT, 'SCALAR', weights.length);

  const json = {
    asset: { version: '2.0', generator: 'morphod' },
    scene: 0,
    scenes: [{ nodes: [0] }],
    // In the robots' world, z points up; in glTF, y does.
    nodes: [{ name, mesh: 0, rotation: [-Math.SQRT1_2, 0, 0, Math.SQRT1_2] }],
    materials: [{ name: 'skin', doubleSided: true,
      pbrMetallicRoughness: { baseColorFactor: [0.42, 0.6, 0.9, 1], metallicFactor: 0,
        roughnessFactor: 0.7 } }],
    meshes: [{ name, weights: new Array(targets.length).fill(0),
      primitives: [{ attributes: { POSITION: position }, indices: index, material: 0, targets }] }],
    animations: [{ name: 'walk', samplers: [{ input, output, interpolation: 'LINEAR' }],
      channels: [{ sampler: 0, target: { node: 0, path: 'weights' } }] }],
    accessors: arrays.accessors,
    bufferViews: arrays.views,
    buffers: [{ byteLength: arrays.size }],
  };
  return pack(json, arrays);
}

function pack(json, arrays) {
  const text = new TextEncoder().encode(JSON.stringify(json));
  const textSize = Math.ceil(text.length / 4) * 4;
  const file = new Uint8Array(12 + 8 + textSize + 8 + arrays.size);
  const view = new DataView(file.buffer);
  [GLB_MAGIC, 2, file.length, textSize, JSON_CHUNK]
    .forEach((value, i) => view.setUint32(4 * i, value, true));
  file.fill(0x20, 20, 20 + textSize);
  file.set(text, 20);
  view.setUint32(20 + textSize, arrays.size, true);
  view.setUint32(24 + textSize, BINARY_CHUNK, true);
  let at = 28 + textSize;
  for (const part of arrays.parts) {
    file.set(part, at);
    at += part.length;
  }
  return file;
}
