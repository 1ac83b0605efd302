/** Recordings of the stage as one scene (docs/scenes.md), which the Python client reads. */

import { FACE_CORNERS } from '../lib/body.js';

const TYPES = {
  Float32Array: 'float32', Uint16Array: 'uint16', Uint8Array: 'uint8', Int8Array: 'int8',
};

/** Rest lengths of the springs: edges and face diagonals of a voxel. */
const [EDGE_M, DIAGONAL_M] = [0.1, 0.1 * Math.SQRT2];

/** Rounds up to a multiple of 8. */
const aligned = (n) => Math.ceil(n / 8) * 8;

/**
 * @param {import('../stage/stage.js').Robot[]} robots in one world
 * @param {any[]} inputs controller, physics and so on of each robot, as in the header of a scene
 */
export function toScene(robots, inputs) {
  const arrays = [];
  let end = 0;
  const put = (data, shape) => {
    const described = { offset: end, type: TYPES[data.constructor.name], shape };
    arrays.push([end, data]);
    end = aligned(end + data.byteLength);
    return described;
  };
  const [{ world, frameS }] = robots;
  const heights = Float32Array.from(world.heights);
  const { spacing, columns } = world;
  const rows = Array.from({ length: columns ? heights.length / columns : 0 },
    (_, row) => [...heights.subarray(row * columns, (row + 1) * columns)]);
  const ground = spacing
    ? { terrain: { kind: columns ? 'grid' : 'profile',
      heights_m: columns ? rows : [...heights], spacing_m: spacing } }
    : { terrain_heights_m: put(heights, [8, 8]) };
  // Inputs that differ between rollouts are stored with the rollouts, and are null in the header.
  const own = Object.keys(inputs[0]).filter((name) => inputs.some((one) =>
    JSON.stringify(one[name]) !== JSON.stringify(inputs[0][name])));
  const ownOf = (of) => Object.fromEntries(own.map((name) => [name, of?.[name] ?? null]));
  const header = {
    ...inputs[0], ...ownOf(), warnings: [], frame_s: frameS, driven: true, environments: [ground],
    designs: robots.map(({ id, robot, genotype, body }) => ({
      id, robot, orientation: null, genotype, repaired: 0, score: null,
      masses: put(body.masses, [body.nMasses, 3]),
      springs: put(body.springs, [body.nSprings, 2]),
      rest_lengths_m: put(Float32Array.from(body.diagonal, (is) => (is ? DIAGONAL_M : EDGE_M)),
        [body.nSprings]),
      voxels: put(body.voxels, [body.nVoxels, 8]),
      faces: put(facesOf(body), [body.nFaces, 5]),
    })),
    rollouts: robots.map(({ body, frames, track, lights, actuation, contacts }, design) => ({
      design, environment: 0, loss: null, diverged_step: 0, ...ownOf(inputs[design]),
      masses_m: put(track, [frames, body.nMasses, 3]), lights_m: put(lights, [frames, 3]),
      ...(actuation ? { actuation: put(actuation, [frames, body.nSprings]) } : {}),
      ...(contacts ? { contacts: put(contacts, [frames, body.nMasses]) } : {}),
    })),
  };
  const text = new TextEncoder().encode(JSON.stringify(header));
  const length = aligned(4 + text.length) - 4;
  const bytes = new Uint8Array(4 + length + end).fill(32, 4 + text.length, 4 + length);
  new DataView(bytes.buffer).setUint32(0, length, true);
  bytes.set(text, 4);
  for (const [at, data] of arrays) {
    bytes.set(new Uint8Array(data.buffer, data.byteOffset, data.byteLength), 4 + length + at);
  }
  return bytes;
}

function facesOf({ faces, voxels, nFaces }) {
  const all = new Uint16Array(5 * nFaces);
  for (let face = 0; face < nFaces; face++) {
    const [voxel, side] = faces.subarray(2 * face, 2 * face + 2);
    all.set([...FACE_CORNERS[side].map((corner) => voxels[8 * voxel + corner]), voxel], 5 * face);
  }
  return all;
}
