/**
 * Reads a scene: application/vnd.morphod.scene (docs/scenes.md). Four bytes hold the length of a
 * JSON header; the arrays that it describes follow, each at an offset that is a multiple of 8.
 */

import { bodyOf } from './body.js';

const TYPES = {
  float64: Float64Array, float32: Float32Array, uint32: Uint32Array, uint16: Uint16Array,
  uint8: Uint8Array,
  int8: Int8Array, int16: Int16Array,
};

/**
 * @param {ArrayBuffer} buffer
 * @returns {{header: Object, array: function(Object): any}}
 */
export function decodeScene(buffer) {
  if (buffer.byteLength < 4) throw new Error('The scene ends before its header.');
  const length = new DataView(buffer).getUint32(0, true);
  if (4 + length > buffer.byteLength) throw new Error('The scene ends within its header.');
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const start = Math.ceil((4 + length) / 4) * 4;
  const array = ({ offset, type, shape }) => {
    const Type = TYPES[type];
    const n = shape.reduce((a, b) => a * b, 1);
    if (!Type || start + offset + n * Type.BYTES_PER_ELEMENT > buffer.byteLength) {
      throw new Error('An array lies outside the scene.');
    }
    return new Type(buffer, start + offset, n);
  };
  return { header, array };
}

/** Returns the 16-bit positions of a rollout in meters. */
function metersOf(rollout, array) {
  const { masses_int16: numbers, masses_origin_m: origin, masses_unit_m: unit } = rollout;
  return Float32Array.from(array(numbers), (value, i) => origin[i % 3] + value * unit);
}

/** Returns the robots of a scene, in the format of the stage. */
export function robotsOf({ header, array }) {
  const bodies = new Map();
  return header.rollouts.map((rollout) => {
    const { genotype, id, robot } = header.designs[rollout.design];
    const environment = header.environments[rollout.environment];
    const lights = rollout.lights_m ? array(rollout.lights_m) : undefined;
    if (!bodies.has(genotype)) bodies.set(genotype, bodyOf(genotype));
    return {
      id,
      robot,
      genotype,
      body: bodies.get(genotype),
      track: rollout.masses_m ? array(rollout.masses_m) : metersOf(rollout, array),
      actuation: rollout.actuation ? array(rollout.actuation) : undefined,
      contacts: rollout.contacts ? array(rollout.contacts) : undefined,
      frames: (rollout.masses_m ?? rollout.masses_int16).shape[0],
      frameS: header.frame_s,
      lights,
      loss: rollout.loss,
      value: rollout.value,
      unit: rollout.unit,
      world: {
        light: environment.light_xy_m ?? [...lights.subarray(0, 2)],
        points: environment.task?.guide.points_m,
        task: environment.task,
        heights: environment.terrain?.heights_m.flat() ?? array(environment.terrain_heights_m),
        spacing: environment.terrain?.spacing_m,
        columns: environment.terrain?.heights_m[0].length,
        key: environment.sha256,
      },
    };
  });
}
