/**
 * Reads an atlas file (docs/atlas.md) and answers queries about it: it has the interface of
 * lib/atlas_http.js, but needs no service. The functions are those of include/morpho/atlas.h, with
 * the same definitions and orders.
 *
 * A body is a list of places on the lattice of the workspace. Of its eight images, the canonical
 * one has the smallest sides and, of these, the largest key: the rank of its sorted voxels among
 * all sets with the same number of voxels. Keys of ten voxels have 50 bits, so a Number holds them.
 */

const MAGIC = 'morphod atlas\r\n\0';
/** Without and with measures. */
const VERSIONS = [1, 2];
const HEADER = 304;
/** All measures, in the order of their bits in a file (include/morpho/measure.h). */
const MEASURES = ['displacement_m', 'path_length_m', 'mean_speed_m_per_s', 'straightness',
  'heading_error_rad', 'sideways_m', 'peak_height_m', 'mean_height_m', 'tilt_rad',
  'yaw_rate_rad_per_s', 'air_share', 'contact_front_share', 'contact_back_share',
  'contact_left_share', 'contact_right_share', 'hops_per_s', 'work_j', 'cost_of_transport',
  'peak_strain', 'inverted_voxels'];
const BLOCK_HEADER = 16;
const VOXELS_MAX = 10;
const GUIDES = ['fixed', 'ahead', 'turning', 'path', 'moving'];
const OBJECTIVES = ['reach', 'approach', 'travel', 'follow', 'climb', 'pursue', 'efficient',
  'jump'];
const STEPS = [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]];
/** Work that takes longer pauses to let the page draw. */
const BUSY_MS = 12;
const GROW_SHRINK = ['add', 'remove'];

const align = (bytes) => Math.ceil(bytes / 8) * 8;

/** Thrown for something that the atlas does not contain. */
export class AtlasError extends Error {}

/** Returns the parts of a packed environment's task that descriptions need
 * (src/world/environment.h). */
function taskOfPacked(view, at, version) {
  if (version < 2) return { objective: 'reach', guide: { kind: 'fixed' } };
  const numbers = 105 + (version > 2 ? 1 : 0) + (version > 3 ? 1 : 0) + (version > 4 ? 8 : 0) +
    (version > 6 ? 6 : 0);
  const words = at + 8 * numbers;
  return { objective: OBJECTIVES[view.getUint32(words + 8, true)] ?? 'weighted sum',
    guide: { kind: GUIDES[view.getUint32(words, true)] } };
}

/** Returns a number of 16 bits (IEEE 754 binary16). */
function unpackLoss(packed) {
  const exponent = (packed >> 10) & 31;
  const fraction = packed & 1023;
  const size = exponent === 31 ? Infinity : exponent === 0 ? fraction * 2 ** -24
    : (fraction + 1024) * 2 ** (exponent - 25);
  return packed & 0x8000 ? -size : size;
}

/** Returns the next larger number of 32 bits. */
function after(number) {
  const next = new Float32Array([number + 0]); // −0 + 0 is 0
  new Int32Array(next.buffer)[0] += number < 0 ? -1 : 1;
  return next[0];
}

/** Returns how many of sorted numbers are lower. */
function countBelow(sorted, number) {
  let [low, high] = [0, sorted.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] < number) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** Returns the edges of bins of equal width, as numbers of 32 bits. */
const edgesOf = (lo, hi, bins) => Array.from({ length: bins + 1 }, (_, i) =>
  Math.fround(i < bins ? lo + (hi - lo) * i / bins : hi));

/** Returns the bin of a number that is within the edges. */
function binOf(edges, number) {
  const bins = edges.length - 1;
  let bin = Math.min(bins - 1, Math.floor((number - edges[0]) / (edges[bins] - edges[0]) * bins));
  while (number < edges[bin]) bin--;
  while (number >= edges[bin + 1]) bin++;
  return bin;
}

/** Sorts numbers by merging. Returns how many pairs were in the wrong order. */
function sortCounting(numbers) {
  const n = numbers.length;
  const merged = numbers.slice();
  let wrong = 0;
  for (let width = 1; width < n; width *= 2) {
    for (let begin = 0; begin < n; begin += 2 * width) {
      const [middle, end] = [Math.min(begin + width, n), Math.min(begin + 2 * width, n)];
      let [left, right] = [begin, middle];
      for (let i = begin; i < end; i++) {
        const isRight = left === middle || (right < end && numbers[right] < numbers[left]);
        if (isRight) wrong += middle - left;
        merged[i] = numbers[isRight ? right++ : left++];
      }
    }
    numbers.set(merged);
  }
  return wrong;
}

/** Returns Kendall's τ-b of pairs of numbers, which are sorted; null: one of the two never
 * differs. */
function kendallTau(pairs) {
  const n = pairs.length;
  // Each pair of indices is counted at the larger one.
  const tied = (isSame) => {
    let [sum, run] = [0, 0];
    for (let i = 1; i < n; i++) sum += run = isSame(i) ? run + 1 : 0;
    return sum;
  };
  const isTied = (i) => pairs[i][0] === pairs[i - 1][0];
  const first = tied(isTied);
  const both = tied((i) => isTied(i) && pairs[i][1] === pairs[i - 1][1]);
  const seconds = Float32Array.from({ length: n }, (_, i) => pairs[i][1]);
  const discordant = sortCounting(seconds);
  const second = tied((i) => seconds[i] === seconds[i - 1]);
  const all = n * (n - 1) / 2;
  const untied = (all - first) * (all - second);
  return untied > 0 ? (all - first - second + both - 2 * discordant) / Math.sqrt(untied) : null;
}

/** Whether a body comes before another one: the better score first, ties by lower position. */
const isBefore = (score, position, otherScore, other) =>
  score < otherScore || (score === otherScore && position < other);

export class AtlasFile {
  /**
   * @param {ArrayBuffer} buffer
   * @param {string} name shown, and part of links
   */
  constructor(buffer, name) {
    this.name = name;
    /** @type {Promise<any>|undefined} */
    this.basinsLoad = undefined;
    const view = new DataView(buffer);
    const refuse = (why) => { throw new AtlasError(`${name} ${why}`); };
    const magic = buffer.byteLength >= HEADER
      ? String.fromCharCode(...new Uint8Array(buffer, 0, MAGIC.length)) : '';
    if (magic !== MAGIC) refuse('is not an atlas file.');
    const version = view.getUint32(20, true);
    if (view.getUint32(16, true) !== 0x01020304 || !VERSIONS.includes(version)) {
      refuse(`has format version ${version}; this page reads ${VERSIONS.join(' and ')}.`);
    }
    const bits = version > 1 ? Number(view.getBigUint64(HEADER - 8, true)) : 0;
    if (bits >= 2 ** MEASURES.length) refuse('has unknown measures.');
    this.measures = MEASURES.filter((_, m) => bits >> m & 1);
    const header = version > 1 ? HEADER + 8 : HEADER;
    this.sides = [24, 28, 32].map((at) => view.getUint32(at, true));
    this.voxelsMax = view.getUint32(36, true);
    this.orientations = ['canonical', 'images'][view.getUint32(40, true)];
    this.nEnvironments = view.getUint32(44, true);
    const blockBodies = view.getUint32(48, true);
    const environmentBytes = view.getUint32(52, true);
    this.counts = Array.from({ length: VOXELS_MAX + 1 }, (_, n) =>
      (n ? Number(view.getBigUint64(48 + 8 * n, true)) : 0));
    /** Position of the first body of a size; of the end. */
    this.firsts = [0, 0];
    for (let n = 1; n <= VOXELS_MAX; n++) this.firsts.push(this.firsts[n] + this.counts[n]);
    this.n = this.firsts[VOXELS_MAX + 1];
    const hex = (at) => [...new Uint8Array(buffer, at, 32)]
      .map((byte) => byte.toString(16).padStart(2, '0')).join('');
    this.controller = hex(136);
    this.physics = hex(168);
    this.environments = [];
    for (let i = 0, at = header; i < this.nEnvironments; i++) {
      this.environments.push({ task: taskOfPacked(view, at + 8, view.getUint32(at, true)) });
      at += 8 + align(view.getUint32(at + 4, true));
    }
    this.keys = new Float64Array(this.n);
    this.scores = new Float32Array(this.n);
    /** Offset of the losses of each body. */
    this.lossesAt = new Float64Array(this.n);
    /** By measure; NaN: the body has no value. */
    this.values = Object.fromEntries(this.measures.map((name) => [name, new Float32Array(this.n)]));
    let at = header + environmentBytes;
    for (let n = 1; n <= VOXELS_MAX; n++) {
      for (let done = 0; done < this.counts[n]; done += blockBodies) {
        at = this.#readBlock(view, at, this.firsts[n] + done,
          Math.min(blockBodies, this.counts[n] - done), refuse);
      }
    }
    if (at !== buffer.byteLength) refuse('is truncated, or too long for its bodies.');
    this.view = view;
    this.#fillSets();
    this.#sort();
  }

  #readBlock(view, at, first, n, refuse) {
    const scores = at + BLOCK_HEADER + 8 * n;
    const losses = scores + align(4 * n);
    const measures = losses + align(2 * n * this.nEnvironments);
    const end = measures + align(4 * n * this.measures.length) + 8; // a checksum
    if (end > view.byteLength) refuse('is truncated.');
    for (let i = 0; i < n; i++) {
      const key = at + BLOCK_HEADER + 8 * i;
      this.keys[first + i] = view.getUint32(key, true) + 2 ** 32 * view.getUint32(key + 4, true);
      this.scores[first + i] = view.getFloat32(scores + 4 * i, true);
      this.lossesAt[first + i] = losses + 2 * i * this.nEnvironments;
      this.measures.forEach((name, m) => {
        this.values[name][first + i] = view.getFloat32(measures + 4 * (m * n + i), true);
      });
    }
    return end;
  }

  /** sets[v * (VOXELS_MAX + 1) + n]: the number of sets of n voxels among v. */
  #fillSets() {
    this.voxels = this.sides.reduce((a, b) => a * b, 1);
    const row = VOXELS_MAX + 1;
    this.sets = new Float64Array((this.voxels + 1) * row);
    for (let v = 0; v <= this.voxels; v++) {
      this.sets[v * row] = 1;
      for (let n = 1; v && n < row; n++) {
        this.sets[v * row + n] = this.sets[(v - 1) * row + n] + this.sets[(v - 1) * row + n - 1];
      }
    }
  }

  /** Sorts all positions by score, over all sizes and for each. */
  #sort() {
    const { scores } = this;
    this.sorted = [Uint32Array.from({ length: this.n }, (_, i) => i)
      .sort((a, b) => scores[a] - scores[b] || a - b)];
    const all = this.sorted[0];
    for (let n = 1; n <= VOXELS_MAX; n++) this.sorted.push(new Uint32Array(this.counts[n]));
    const filled = new Array(VOXELS_MAX + 1).fill(0);
    for (let i = 0; i < this.n; i++) {
      const size = this.sizeOf(all[i]);
      this.sorted[size][filled[size]++] = all[i];
    }
  }

  /** Returns the number of voxels of a body. */
  sizeOf(position) {
    let n = 1;
    while (position >= this.firsts[n + 1]) n++;
    return n;
  }

  // ---- forms and keys ----

  #keyOf(voxels) {
    const row = VOXELS_MAX + 1;
    const n = voxels.length;
    let later = 0;
    for (let i = 0; i < n; i++) later += this.sets[(this.voxels - 1 - voxels[i]) * row + n - i];
    return this.sets[this.voxels * row + n] - 1 - later;
  }

  /** Returns the cells [x, y, z] of the canonical form at a position. */
  cellsAt(position) {
    const row = VOXELS_MAX + 1;
    const n = this.sizeOf(position);
    const [, ny, nz] = this.sides;
    let later = this.sets[this.voxels * row + n] - 1 - this.keys[position];
    let left = this.voxels;
    const cells = [];
    for (let i = 0; i < n; i++) {
      do left--; while (this.sets[left * row + n - i] > later);
      const voxel = this.voxels - 1 - left;
      cells.push([Math.floor(voxel / nz / ny), Math.floor(voxel / nz) % ny, voxel % nz]);
      later -= this.sets[left * row + n - i];
    }
    return cells;
  }

  /** Returns the key of the canonical form of cells; -1: no image fits the workspace. */
  #canonicalKey(cells) {
    const n = cells.length;
    const [nx, ny, nz] = this.sides;
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (const cell of cells) {
      for (let axis = 0; axis < 3; axis++) {
        if (cell[axis] < low[axis]) low[axis] = cell[axis];
        if (cell[axis] > high[axis]) high[axis] = cell[axis];
      }
    }
    const [a, b, c] = low.map((v, axis) => high[axis] - v + 1);
    const [fits, fitsTurned] = [a <= nx && b <= ny && c <= nz, b <= nx && a <= ny && c <= nz];
    if (!fits && !fitsTurned) return -1;
    let best = -1;
    const voxels = new Array(n);
    for (let k = 0; k < 8; k++) {
      const turned = k > 3;
      // Of the images that fit, those with the smallest sides.
      if (turned ? !fitsTurned || (fits && a < b) : !fits || (fitsTurned && b < a)) continue;
      for (let i = 0; i < n; i++) {
        let x = turned ? cells[i][1] - low[1] : cells[i][0] - low[0];
        let y = turned ? cells[i][0] - low[0] : cells[i][1] - low[1];
        if (k & 1) x = (turned ? b : a) - 1 - x;
        if (k & 2) y = (turned ? a : b) - 1 - y;
        const voxel = (x * ny + y) * nz + cells[i][2] - low[2];
        let at = i;
        for (; at > 0 && voxels[at - 1] > voxel; at--) voxels[at] = voxels[at - 1];
        voxels[at] = voxel;
      }
      best = Math.max(best, this.#keyOf(voxels));
    }
    return best;
  }

  /** Returns the position of the body with these cells; -1: it is not in the atlas. */
  findCells(cells) {
    const n = cells.length;
    if (n < 1 || n > this.voxelsMax) return -1;
    const key = this.#canonicalKey(cells);
    let [low, high] = [this.firsts[n], this.firsts[n + 1]];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.keys[middle] < key) low = middle + 1;
      else high = middle;
    }
    return low < this.firsts[n + 1] && this.keys[low] === key ? low : -1;
  }

  // ---- neighbors ----

  /** Calls `use(cells, step)` for each changed body; some occur several times. */
  #eachChange(cells, steps, use) {
    const name = (cell) => cell[0] * 10000 + cell[1] * 100 + cell[2];
    const withEach = (rest, never, step) => {
      const taken = new Set([...rest, ...never].map(name));
      for (const cell of rest) {
        for (const [dx, dy, dz] of STEPS) {
          const next = [cell[0] + dx, cell[1] + dy, cell[2] + dz];
          if (taken.has(name(next))) continue;
          taken.add(name(next));
          use([...rest, next], step);
        }
      }
    };
    const isWhole = (rest) => {
      const left = new Map(rest.map((cell) => [name(cell), cell]));
      const reached = [rest[0]];
      left.delete(name(rest[0]));
      for (const [x, y, z] of reached) {
        for (const [dx, dy, dz] of STEPS) {
          const next = left.get(name([x + dx, y + dy, z + dz]));
          if (next && left.delete(name(next))) reached.push(next);
        }
      }
      return !left.size;
    };
    if (steps.includes('add')) withEach(cells, [], 'add');
    const [removes, moves] = ['remove', 'move'].map((step) => steps.includes(step));
    if (cells.length === 1 || !(removes || moves)) return;
    for (const gone of cells) {
      const rest = cells.filter((cell) => cell !== gone);
      if (!isWhole(rest)) continue;
      if (removes) use(rest, 'remove');
      if (moves) withEach(rest, [gone], 'move');
    }
  }

  /** Returns the distinct neighbors of a body, best first: [{position, score, step}]. */
  neighborsOf(position, steps) {
    const found = new Map();
    this.#eachChange(this.cellsAt(position), steps, (cells, step) => {
      const neighbor = this.findCells(cells);
      if (neighbor >= 0 && neighbor !== position && !found.has(neighbor)) {
        found.set(neighbor, { position: neighbor, score: this.scores[neighbor], step });
      }
    });
    return [...found.values()]
      .sort((a, b) => (isBefore(a.score, a.position, b.score, b.position) ? -1 : 1));
  }

  /** Returns the positions on the path of steepest ascent, to a local optimum. */
  ascentOf(position, steps = GROW_SHRINK) {
    const path = [position];
    for (;;) {
      const [next] = this.neighborsOf(path.at(-1), steps);
      if (!next || next.score >= this.scores[path.at(-1)]) return path;
      path.push(next.position);
    }
  }

  /** Finds where the ascent of each body ends, once: {optima, bodies}, (n) each. */
  #basins() {
    this.basinsLoad ??= (async () => {
      const { n, scores } = this;
      const best = new Int32Array(n).fill(-1);
      const learn = (body, other) => {
        if (scores[other] < scores[body] && (best[body] < 0 ||
          isBefore(scores[other], other, scores[best[body]], best[body]))) best[body] = other;
      };
      let since = performance.now();
      for (let i = 0; i < n; i++) {
        this.#eachChange(this.cellsAt(i), ['remove'], (cells) => {
          const smaller = this.findCells(cells);
          if (smaller < 0) return;
          learn(i, smaller);
          learn(smaller, i);
        });
        if (performance.now() > since + BUSY_MS) {
          await new Promise((resolve) => setTimeout(resolve));
          since = performance.now();
        }
      }
      const bodies = new Uint32Array(n);
      for (const body of this.sorted[0]) { // the optima of better bodies are known
        best[body] = best[body] < 0 ? body : best[best[body]];
        bodies[best[body]]++;
      }
      return { optima: best, bodies };
    })();
    return this.basinsLoad;
  }

  // ---- ranks ----

  /** Counts the bodies of a size (0: all) with a lower score or, with orEqual, one that is not
   * higher. */
  #count(size, score, orEqual) {
    const sorted = this.sorted[size];
    let [low, high] = [0, sorted.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      const there = this.scores[sorted[middle]];
      if (there < score || (orEqual && there === score)) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  #rankOf(position, size) {
    const n = this.sorted[size].length;
    const better = this.#count(size, this.scores[position], false);
    const worse = n - this.#count(size, this.scores[position], true);
    return { rank: better + 1, bodies: n,
      percentile: n > 1 ? 100 * (worse + (n - better - worse - 1) / 2) / (n - 1) : 100 };
  }

  /** Returns the measures of a body, as replies have them: {name: number or null}. */
  #measuresOf(use) {
    return this.measures.length ? { measures: Object.fromEntries(this.measures.map((name) => {
      const value = use(name);
      return [name, Number.isNaN(value) ? null : value];
    })) } : {};
  }

  /** Returns the percentile of a measure among the bodies of the size; NaN: it has no value. */
  #percentileOf(name, position) {
    const size = this.sizeOf(position);
    const value = this.values[name][position];
    let [lower, equal, others] = [0, -1, -1]; // does not count the body itself
    for (let i = this.firsts[size]; i < this.firsts[size + 1]; i++) {
      const other = this.values[name][i];
      lower += Number(other < value);
      equal += Number(other === value);
      others += Number(!Number.isNaN(other));
    }
    return Number.isNaN(value) ? NaN : others ? 100 * (lower + equal / 2) / others : 100;
  }

  #bodyAt(position) {
    const voxels = new Array(this.voxels).fill('0');
    const [, ny, nz] = this.sides;
    for (const [x, y, z] of this.cellsAt(position)) voxels[(x * ny + y) * nz + z] = '1';
    const genotype = voxels.join('');
    const score = this.scores[position];
    const { rank, percentile } = this.#rankOf(position, 0);
    return {
      id: genotype.match(/.{4}/g).map((four) => parseInt(four, 2).toString(16)).join(''),
      voxels: this.sizeOf(position), genotype, position,
      score: Number.isFinite(score) ? score : null, diverged: !Number.isFinite(score), rank,
      percentile, ...this.#measuresOf((name) => this.values[name][position]),
    };
  }

  #find(genotype) {
    const [, ny, nz] = this.sides;
    const cells = [...genotype].flatMap((digit, v) => (digit === '1'
      ? [[Math.floor(v / nz / ny), Math.floor(v / nz) % ny, v % nz]] : []));
    const position = this.findCells(cells);
    if (position >= 0) return position;
    throw new AtlasError(cells.length > this.voxelsMax
      ? `The atlas has bodies of at most ${this.voxelsMax} voxels; this one has ${cells.length}.`
      : 'The atlas has only bodies in one piece.');
  }

  // ---- the interface of lib/atlas_http.js ----

  /** Describes the atlas. */
  async about() {
    return {
      name: this.name, voxels_max: this.voxelsMax, orientations: this.orientations,
      controller: this.controller, physics: this.physics, environments: this.environments,
      measures: this.measures, bodies: this.n,
      best: this.#bodyAt(this.sorted[0][0]),
      sizes: this.sorted.slice(1, this.voxelsMax + 1).map((sorted, i) => ({
        voxels: i + 1, bodies: sorted.length, best: this.#bodyAt(sorted[0]),
      })),
    };
  }

  /** Describes a body in any place and orientation. */
  async body(genotype, { changes = 8 } = {}) {
    const position = this.#find(genotype);
    const size = this.sizeOf(position);
    const neighbors = this.neighborsOf(position, ['add', 'remove', 'move']);
    return {
      ...this.#bodyAt(position), of_size: { ...this.#rankOf(position, size),
        ...this.#measuresOf((name) => this.#percentileOf(name, position)) },
      losses: Array.from({ length: this.nEnvironments }, (_, e) => {
        const loss = unpackLoss(this.view.getUint16(this.lossesAt[position] + 2 * e, true));
        return Number.isFinite(loss) ? loss : null;
      }),
      best_of_size: this.#bodyAt(this.sorted[size][0]),
      best_changes: neighbors.slice(0, changes)
        .map((one) => ({ ...this.#bodyAt(one.position), step: one.step })),
    };
  }

  /** Returns the body at a position. */
  async at(position) {
    return this.#bodyAt(position);
  }

  /** Returns the path of steepest ascent by adding and removing voxels. */
  async ascent(genotype) {
    const items = this.ascentOf(this.#find(genotype)).map((position) => this.#bodyAt(position));
    return { items, bodies_on_path: items.length, optimum: items.at(-1) };
  }

  /** Returns the best bodies of a size, or of all, and counts them: those with lo ≤ score < hi.
   * With a measure, those with lo ≤ value < hi and score_lo ≤ score < score_hi, the highest
   * value first. */
  async best({ voxels = 0, lo = -Infinity, hi = NaN, limit = 100, measure = undefined,
    score_lo: scoreLo = undefined, score_hi: scoreHi = undefined } = {}) {
    if (measure) {
      const { scores } = this;
      const values = this.values[measure];
      const isAnyScore = scoreLo === undefined && scoreHi === undefined; // also a diverged one
      const found = [...this.sorted[voxels]].filter((i) => values[i] >= lo && !(values[i] >= hi) &&
        (isAnyScore || (scores[i] >= (scoreLo ?? -Infinity) && scores[i] < (scoreHi ?? Infinity))))
        .sort((a, b) => values[b] - values[a] || a - b);
      return { bodies: found.length,
        items: found.slice(0, limit).map((position) => this.#bodyAt(position)) };
    }
    const from = this.#count(voxels, lo, false);
    const end = Number.isNaN(hi) ? this.sorted[voxels].length : this.#count(voxels, hi, false);
    return { bodies: Math.max(0, end - from),
      items: [...this.sorted[voxels].subarray(from, Math.min(end, from + limit))]
        .map((position) => this.#bodyAt(position)) };
  }

  /** Counts the bodies of each size by score, or by a measure: counts[size − 1][i] have edge i ≤
   * score < edge i + 1, `outside` are in no bin. Without `hi`, the highest finite score is in the
   * last bin. */
  async histogram({ bins = 64, lo = NaN, hi = NaN, measure = undefined } = {}) {
    const numbers = measure ? this.values[measure] : this.scores;
    const sorted = Array.from({ length: this.voxelsMax + 1 }, (_, size) =>
      Float32Array.from(this.sorted[size], (i) => numbers[i]).filter(Number.isFinite).sort());
    const [all] = sorted;
    const from = !Number.isNaN(lo) ? lo : all[0] ?? 0;
    const to = !Number.isNaN(hi) ? hi : all.length ? after(all.at(-1)) : 1;
    const edges = edgesOf(from, to, bins);
    const sizes = Array.from({ length: this.voxelsMax }, (_, i) => i + 1);
    const counts = sizes.map((size) => {
      const below = edges.map((edge) => countBelow(sorted[size], edge));
      return below.slice(1).map((n, i) => n - below[i]);
    });
    return { edges, sizes, counts, outside: sizes.map((size, i) =>
      this.counts[size] - counts[i].reduce((sum, n) => sum + n, 0)) };
  }

  /** Counts the bodies that have a value of a measure: counts[i][k] are in bin i of the scores and
   * bin k of the values, `outside` diverged. */
  async map(measure, { bins = 64 } = {}) {
    const pairs = Array.from(this.sorted[0], (i) => [this.scores[i], this.values[measure][i]])
      .filter(([, value]) => !Number.isNaN(value))
      .sort(([a, b], [c, d]) => (a === c ? b - d : a - c));
    const finite = pairs.filter(([score]) => Number.isFinite(score));
    const [scores, values] = [0, 1].map((which) => {
      const [lo, hi] = finite.reduce(([low, high], pair) =>
        [Math.min(low, pair[which]), Math.max(high, pair[which])], [Infinity, -Infinity]);
      return finite.length ? edgesOf(lo, after(hi), bins) : edgesOf(0, 1, bins);
    });
    const counts = Array.from({ length: bins }, () => new Array(bins).fill(0));
    for (const [score, value] of finite) counts[binOf(scores, score)][binOf(values, value)]++;
    return { measure, bodies: pairs.length, edges_score: scores, edges_measure: values, counts,
      outside: pairs.length - finite.length, without_value: this.n - pairs.length,
      kendall_tau: kendallTau(pairs) };
  }

  /** Returns the local optima with the largest basins, and how many there are. */
  async optima({ limit = 24 } = {}) {
    const { bodies } = await this.#basins();
    const found = [];
    for (let i = 0; i < this.n; i++) if (bodies[i]) found.push(i);
    found.sort((a, b) => bodies[b] - bodies[a] || this.scores[a] - this.scores[b] || a - b);
    return { optima: found.length, items: found.slice(0, limit)
      .map((position) => ({ ...this.#bodyAt(position), basin: bodies[position] })) };
  }
}
