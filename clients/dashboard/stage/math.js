/** 4 × 4 matrices, column-major as WebGL expects them, and 3-vectors as arrays. */

export function perspective(fovY, aspect, near, far) {
  const f = 1 / Math.tan(fovY / 2);
  return Float32Array.of(
    f / aspect, 0, 0, 0,
    0, f, 0, 0,
    0, 0, (far + near) / (near - far), -1,
    0, 0, (2 * far * near) / (near - far), 0,
  );
}

/** Returns the matrix of a view of a box: half the width and height in meters. */
export function orthographic(halfWidth, halfHeight, near, far) {
  return Float32Array.of(
    1 / halfWidth, 0, 0, 0,
    0, 1 / halfHeight, 0, 0,
    0, 0, 2 / (near - far), 0,
    0, 0, (far + near) / (near - far), 1,
  );
}

export function lookAt(eye, target, up) {
  const z = normalize(subtract(eye, target));
  const x = normalize(cross(up, z));
  const y = cross(z, x);
  return Float32Array.of(
    x[0], y[0], z[0], 0,
    x[1], y[1], z[1], 0,
    x[2], y[2], z[2], 0,
    -dot(x, eye), -dot(y, eye), -dot(z, eye), 1,
  );
}

export function multiply(a, b) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + row] * b[4 * column + k];
      product[4 * column + row] = sum;
    }
  }
  return product;
}

/** Returns a matrix for points that are moved by a shift first. */
export function translated(matrix, [x, y, z]) {
  const moved = Float32Array.from(matrix);
  for (let row = 0; row < 4; row++) {
    moved[12 + row] += matrix[row] * x + matrix[4 + row] * y + matrix[8 + row] * z;
  }
  return moved;
}

/**
 * Returns where a point of the world appears: [x, y, depth], each from -1 to 1.
 * @param {ArrayLike<number>} matrix
 * @param {Iterable<number>} point
 */
export function project(matrix, [x, y, z]) {
  const at = (row) => matrix[row] * x + matrix[4 + row] * y + matrix[8 + row] * z +
    matrix[12 + row];
  const w = at(3);
  return [at(0) / w, at(1) / w, at(2) / w];
}

/** Returns the point whose projection (`project`) is this one. */
export function unproject(matrix, [x, y, depth]) {
  // Rows of [p; 1] · w = inverse · [x; y; depth; 1], solved by elimination.
  const rows = [0, 1, 2, 3].map((row) => [0, 1, 2, 3].map((column) => matrix[4 * column + row])
    .concat([x, y, depth, 1][row]));
  for (let i = 0; i < 4; i++) {
    const pivot = rows.slice(i).reduce((best, row) =>
      (Math.abs(row[i]) > Math.abs(best[i]) ? row : best));
    rows.splice(rows.indexOf(pivot), 1);
    rows.splice(i, 0, pivot);
    rows.forEach((row, k) => {
      if (k === i) return;
      const factor = row[i] / pivot[i];
      for (let column = i; column < 5; column++) row[column] -= factor * pivot[column];
    });
  }
  const [px, py, pz, w] = rows.map((row, i) => row[4] / row[i]);
  return [px / w, py / w, pz / w];
}

const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
export function normalize(a) {
  const length = Math.hypot(...a) || 1;
  return [a[0] / length, a[1] / length, a[2] / length];
}

/**
 * Returns the layout of the heights of a world, as uniforms: 8 × 8 over 5 m × 5 m; with a
 * spacing, a profile along x that starts at x = 0; with columns as well, a grid around the start.
 * @param {{heights: ArrayLike<number>, spacing?: number, columns?: number}} world
 */
export function groundOf({ heights, spacing, columns }) {
  const isProfile = Boolean(spacing && !columns);
  const sides = columns ? [columns, heights.length / columns]
    : isProfile ? [heights.length, 1] : [8, 8];
  const step = spacing || 5 / 7;
  const sizes = sides.map((n) => (n - 1) * step);
  // The area that is drawn: at most 8 m, and at least the usual 5 m.
  const [width, depth] = sizes.map((size) => Math.min(8, Math.max(5, size)));
  return {
    columns: sides[0], rows: sides[1], spacing: step, isProfile, isGrid: Boolean(columns),
    origin: columns ? sizes.map((size) => 2.5 - size / 2) : [0, 0],
    middle: [isProfile ? width / 2 : 2.5, 2.5],
    reach: [width / 2, depth / 2],
  };
}

/**
 * Returns the height of a world's terrain at (x, y), as the daemon computes it: bilinear, clamped
 * at the edge.
 * @param {{heights: ArrayLike<number>, spacing?: number, columns?: number}} world
 */
export function heightAt(world, x, y) {
  const { columns, rows, spacing, origin } = groundOf(world);
  const last = [columns - 1, rows - 1];
  const [cx, cy] = [x, y].map((v, k) => (
    Math.min(last[k], Math.max(0, (v - origin[k]) / spacing))));
  const [i, j] = [cx, cy].map((v, k) => Math.max(0, Math.min(last[k] - 1, Math.floor(v))));
  const [fx, fy] = [cx - i, cy - j];
  const at = (a, b) => world.heights[Math.min(j + b, last[1]) * columns + i + a];
  return (1 - fy) * ((1 - fx) * at(0, 0) + fx * at(1, 0)) +
    fy * ((1 - fx) * at(0, 1) + fx * at(1, 1));
}
