/** One robot on the graphics processor: its recording as textures, its skin, springs and trail. */

import { dataTexture, vertexArray } from './gl.js';

/** Returns the mean position of the masses at a time, in frames. */
export function centerOfMass(robot, frame) {
  const centers = centersOf(robot);
  const earlier = Math.min(Math.floor(frame), robot.frames - 1);
  const later = Math.min(earlier + 1, robot.frames - 1);
  const share = frame - Math.floor(frame);
  return [0, 1, 2].map((axis) => {
    const at = centers[3 * earlier + axis];
    return at + (centers[3 * later + axis] - at) * share;
  });
}

/** Returns the centers of mass, measured once: every picture needs them several times. */
function centersOf(robot) {
  if (!robot.centers) {
    robot.centers = new Float32Array(rowsOf(robot) * 3);
    measureCenters(robot, 0, robot.frames);
  }
  return robot.centers;
}

function measureCenters({ track, body: { nMasses: n }, centers }, from, to) {
  for (let frame = from; frame < to; frame++) {
    for (let axis = 0; axis < 3; axis++) {
      let sum = 0;
      for (let mass = 0; mass < n; mass++) sum += track[(frame * n + mass) * 3 + axis];
      centers[3 * frame + axis] = sum / n;
    }
  }
}

/** Returns the number of frames that there is room for; while a robot is driven, there is more room
 * than frames. */
const rowsOf = ({ track, body }) => track.length / (3 * body.nMasses);

/** Uploads what the graphics processor needs for one robot. */
export function upload(gl, robot) {
  const { body, track, actuation, contacts } = robot;
  const rows = rowsOf(robot);
  // Each of the six vertices of a face carries all of the face's data.
  const faces = new Uint16Array(body.nFaces * 6 * 9);
  for (let vertex = 0; vertex < 6 * body.nFaces; vertex++) {
    const face = Math.floor(vertex / 6);
    const voxel = body.faces[2 * face];
    faces.set(body.voxels.subarray(8 * voxel, 8 * voxel + 8), 9 * vertex);
    faces[9 * vertex + 8] = body.faces[2 * face + 1];
  }
  const springs = new Uint16Array(body.nSprings * 3);
  for (let spring = 0; spring < body.nSprings; spring++) {
    springs[3 * spring] = body.springs[2 * spring];
    springs[3 * spring + 1] = body.springs[2 * spring + 1];
    springs[3 * spring + 2] = body.diagonal[spring];
  }
  const short = gl.UNSIGNED_SHORT;
  return {
    track: dataTexture(gl, gl.RGB32F, body.nMasses, rows, gl.RGB, gl.FLOAT, track),
    actuation: actuation
      ? dataTexture(gl, gl.R8I, body.nSprings, rows, gl.RED_INTEGER, gl.BYTE, actuation)
      : null,
    contacts: contacts
      ? dataTexture(gl, gl.R8UI, body.nMasses, rows, gl.RED_INTEGER, gl.UNSIGNED_BYTE, contacts)
      : null,
    skin: vertexArray(gl, faces, [
      { at: 0, size: 4, type: short, integer: true, stride: 18, offset: 0 },
      { at: 1, size: 4, type: short, integer: true, stride: 18, offset: 8 },
      { at: 2, size: 1, type: short, integer: true, stride: 18, offset: 16 },
    ]),
    springs: vertexArray(gl, springs, [
      { at: 0, size: 2, type: short, integer: true, stride: 6, offset: 0, divisor: 1 },
      { at: 1, size: 1, type: short, integer: true, stride: 6, offset: 4, divisor: 1 },
    ]),
    trail: trailOf(gl, robot),
  };
}

/** Frees a robot's data on the graphics processor. */
export function release(gl, gpu) {
  for (const texture of [gpu.track, gpu.actuation, gpu.contacts]) gl.deleteTexture(texture);
  for (const part of [gpu.skin, gpu.springs, gpu.trail]) part.free();
}

/** Sends frames [from, to) of a robot that has changed since it was uploaded. */
export function uploadFrames(gl, robot, from, to) {
  const { gpu, body, track, actuation, contacts } = robot;
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  const send = (texture, width, format, type, data, perFrame) => {
    if (!texture) return;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, from, width, to - from, format, type, data,
      from * perFrame);
  };
  const { nMasses, nSprings } = body;
  send(gpu.track, nMasses, gl.RGB, gl.FLOAT, track, 3 * nMasses);
  send(gpu.actuation, nSprings, gl.RED_INTEGER, gl.BYTE, actuation, nSprings);
  send(gpu.contacts, nMasses, gl.RED_INTEGER, gl.UNSIGNED_BYTE, contacts, nMasses);
  if (robot.centers) measureCenters(robot, from, to);
  gpu.trail.free();
  gpu.trail = trailOf(gl, robot);
}

/** Creates a ribbon along the path of the center of mass: two vertices per frame. */
function trailOf(gl, robot) {
  const every = Math.max(1, Math.floor(robot.frames / 250));
  const points = [];
  for (let frame = 0; frame < robot.frames; frame += every) {
    const [x, y] = centerOfMass(robot, frame);
    points.push([x, y, frame]);
  }
  const data = new Float32Array(points.length * 8);
  points.forEach(([x, y, frame], i) => {
    const before = points[Math.max(0, i - 3)];
    const after = points[Math.min(points.length - 1, i + 3)];
    const along = Math.atan2(after[1] - before[1], after[0] - before[0]);
    const angle = (along + Math.PI / 2 + 2 * Math.PI) % (2 * Math.PI);
    data.set([x, y, frame, 1 + angle, x, y, frame, -(1 + angle)], 8 * i);
  });
  const ribbon = vertexArray(gl, data, [{ at: 0, size: 4, type: gl.FLOAT, stride: 16 }]);
  return { ...ribbon, n: points.length * 2 };
}

