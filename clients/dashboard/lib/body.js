/**
 * The body that a genotype expresses: its masses, springs and outer faces, in the orders of the
 * daemon's arrays (docs/scenes.md). The workspace of nx × ny × nz voxels has a lattice of
 * (nx+1) × (ny+1) × (nz+1) masses; voxel index (x·ny + y)·nz + z, mass index
 * (x·(ny+1) + y)·(nz+1) + z.
 */

/** Sides of the workspace, in voxels. @type {readonly number[]} */
export const WORKSPACE = Object.freeze([6, 6, 4]);
const [NX, NY, NZ] = WORKSPACE;

/**
 * The four corners of each side of a voxel, as indices into its eight masses (ascending, so that
 * corner c lies at x = c >> 2, y = (c >> 1) & 1, z = c & 1), counter-clockwise seen from outside.
 */
export const FACE_CORNERS = [
  [0, 1, 3, 2],
  [4, 6, 7, 5],
  [0, 4, 5, 1],
  [2, 3, 7, 6],
  [0, 2, 6, 4],
  [1, 5, 7, 3],
];

/** The steps to the neighbors behind these sides. */
export const FACE_STEPS = [
  [-1, 0, 0],
  [1, 0, 0],
  [0, -1, 0],
  [0, 1, 0],
  [0, 0, -1],
  [0, 0, 1],
];

/**
 * Pairs of a voxel's corners that a spring joins: 12 edges (true: a face diagonal) and 12
 * diagonals.
 */
const VOXEL_SPRINGS = [];
for (let a = 0; a < 8; a++) {
  for (let b = a + 1; b < 8; b++) {
    const differing = [1, 2, 4].filter((bit) => (a ^ b) & bit).length;
    if (differing < 3) VOXEL_SPRINGS.push([a, b, differing === 2]);
  }
}

/** Returns whether a genotype (a text of '0' and '1') has a voxel at (x, y, z). */
export function hasVoxel(genotype, x, y, z) {
  if (x < 0 || y < 0 || z < 0 || x >= NX || y >= NY || z >= NZ) return false;
  return genotype[(x * NY + y) * NZ + z] === '1';
}

/** Returns the cells [x, y, z] of a genotype, in voxel order. */
export function cellsOf(genotype) {
  const cells = [];
  for (let v = 0; v < NX * NY * NZ; v++) {
    if (genotype[v] !== '1') continue;
    cells.push([Math.floor(v / (NY * NZ)), Math.floor(v / NZ) % NY, v % NZ]);
  }
  return cells;
}

/** Returns the genotype with voxels at the given cells. */
export function genotypeOf(cells) {
  const voxels = new Array(NX * NY * NZ).fill('0');
  for (const [x, y, z] of cells) voxels[(x * NY + y) * NZ + z] = '1';
  return voxels.join('');
}

/**
 * Returns the genotype of a robot, ID@K: image K of the canonical form that the id (36 hexadecimal
 * digits) spells. For an id without K, returns the canonical form itself. The bits of K: 4, which
 * is applied first, swaps x and y; 1 mirrors in x, 2 in y.
 */
export function genotypeOfId(robot) {
  const [id, k] = robot.split('@');
  const form = [...id].map((digit) => parseInt(digit, 16).toString(2).padStart(4, '0')).join('');
  const cells = cellsOf(form).map(([x, y, z]) => (Number(k ?? 0) & 4 ? [y, x, z] : [x, y, z]));
  const last = [0, 1].map((axis) => Math.max(...cells.map((cell) => cell[axis])));
  return genotypeOf(cells.map(([x, y, z]) =>
    [Number(k ?? 0) & 1 ? last[0] - x : x, Number(k ?? 0) & 2 ? last[1] - y : y, z]));
}

/** Returns a genotype moved to the origin as [dimensions, digits], for comparison. */
function aligned(cells) {
  const [low, high] = [Math.min, Math.max].map((end) =>
    [0, 1, 2].map((axis) => end(...cells.map((cell) => cell[axis]))));
  return [high.map((v, axis) => v - low[axis] + 1).join(' '),
    genotypeOf(cells.map((cell) => cell.map((v, axis) => v - low[axis])))];
}

/**
 * Returns the robot, ID@K, that a genotype is. The id spells the canonical form: of the eight
 * images, the smallest by dimensions, then by digits. K is the lowest image of this form that is
 * the genotype.
 */
export function robotOf(genotype) {
  const cells = cellsOf(genotype);
  const images = Array.from({ length: 8 }, (_, k) => aligned(cells.map(([x, y, z]) => {
    const [u, v] = k & 4 ? [y, x] : [x, y];
    return [k & 1 ? -u : u, k & 2 ? -v : v, z];
  })).join(':'));
  const [, form] = images.reduce((a, b) => (b < a ? b : a)).split(':');
  const id = form.match(/.{4}/g).map((four) => parseInt(four, 2).toString(16)).join('');
  const [, own] = aligned(cells);
  const isOwn = (k) => aligned(cellsOf(genotypeOfId(`${id}@${k}`)))[1] === own;
  return `${id}@${[0, 1, 2, 3, 4, 5, 6, 7].find(isOwn)}`;
}

/**
 * Expresses a genotype.
 *
 * @param {string} genotype '0' and '1', one per voxel, in voxel order
 * @returns {{masses: Uint16Array, springs: Uint16Array, diagonal: Uint8Array, voxels: Uint16Array,
 *            faces: Uint16Array, nMasses: number, nSprings: number, nVoxels: number,
 *            nFaces: number}}
 *   masses (n, 3) lattice coordinates; springs (n, 2) positions in the array of masses; diagonal
 *   (n) 1 for a face diagonal; voxels (n, 8) positions of their masses; faces (n, 2) voxel and
 *   side, of the sides that no other voxel covers
 */
export function bodyOf(genotype) {
  const cells = cellsOf(genotype);
  const massOf = (x, y, z) => (x * (NY + 1) + y) * (NZ + 1) + z;
  const corners = cells.map(([x, y, z]) =>
    Array.from({ length: 8 }, (_, c) => massOf(x + (c >> 2), y + ((c >> 1) & 1), z + (c & 1))),
  );

  const lattice = [...new Set(corners.flat())].sort((a, b) => a - b);
  const place = new Map(lattice.map((mass, i) => [mass, i]));
  const masses = new Uint16Array(lattice.length * 3);
  lattice.forEach((mass, i) => {
    masses[3 * i] = Math.floor(mass / ((NY + 1) * (NZ + 1)));
    masses[3 * i + 1] = Math.floor(mass / (NZ + 1)) % (NY + 1);
    masses[3 * i + 2] = mass % (NZ + 1);
  });

  const voxels = Uint16Array.from(corners.flat(), (mass) => place.get(mass));
  const joined = new Map();
  for (let v = 0; v < cells.length; v++) {
    for (const [a, b, isDiagonal] of VOXEL_SPRINGS) {
      joined.set(voxels[8 * v + a] * lattice.length + voxels[8 * v + b], isDiagonal);
    }
  }
  const keys = [...joined.keys()].sort((a, b) => a - b);
  const springs = Uint16Array.from(
    keys.flatMap((key) => [Math.floor(key / lattice.length), key % lattice.length]),
  );

  const faces = [];
  cells.forEach(([x, y, z], v) => {
    FACE_STEPS.forEach(([dx, dy, dz], side) => {
      if (!hasVoxel(genotype, x + dx, y + dy, z + dz)) faces.push(v, side);
    });
  });
  return {
    masses,
    springs,
    diagonal: Uint8Array.from(keys, (key) => (joined.get(key) ? 1 : 0)),
    voxels,
    faces: Uint16Array.from(faces),
    nMasses: lattice.length,
    nSprings: keys.length,
    nVoxels: cells.length,
    nFaces: faces.length / 2,
  };
}
