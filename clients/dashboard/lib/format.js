/** Numbers and times in a readable form. */

/** Formats a number with `n` significant digits, without trailing noise: 0.0136, 1.5e-5, 12,400. */
export function number(value, digits = 3) {
  if (value === null || value === undefined || Number.isNaN(value)) return '–';
  if (value === 0) return '0';
  const size = Math.abs(value);
  if (size >= 10000) return Math.round(value).toLocaleString('en-US');
  if (size < 1e-4) return value.toExponential(digits - 1);
  return String(Number(value.toPrecision(digits)));
}

/** Formats a score: four decimals, because differences of 1e-4 matter. */
export function score(value) {
  return value === null || value === undefined ? 'diverged' : value.toFixed(4);
}

/** Formats the score of a campaign's design, which may be a lower bound. */
export function scoreOf(design) {
  return `${design.lower_bound ? '≥ ' : ''}${score(design.score)}`;
}

/** Formats a study's own score, in its unit. @param {{name: string, unit: string}} own */
export const inOwnUnit = (own, value) => `${number(value, 5)}${own.unit ? ` ${own.unit}` : ''}`;

/**
 * Formats a score of a campaign: a study's own score, or a score of the service.
 * @param {{name: string, unit: string}|null|undefined} own
 */
export const scoreBy = (own, design) => (own ? `${own.name} ${inOwnUnit(own, design.score)}`
  : `score ${scoreOf(design)}`);

/** Formats a difference of scores, with its sign. */
export function signed(value) {
  return `${value < 0 ? '−' : '+'}${Math.abs(value).toFixed(4)}`;
}

export function count(value) {
  return value === null || value === undefined ? '–' : value.toLocaleString('en-US');
}

/** Counts things: "1 environment", "64 environments". */
export function countOf(n, thing, things = `${thing}s`) {
  return `${count(n)} ${n === 1 ? thing : things}`;
}

export const voxels = (n) => countOf(n, 'voxel');

export function percent(share) {
  return `${(100 * share).toFixed(share > 0 && share < 0.1 ? 1 : 0)} %`;
}

/** Formats a span of time in its two largest units: "3 h 12 min". */
export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return '–';
  if (seconds < 1) return `${Math.round(seconds * 1000)} ms`;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 60) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  if (minutes < 60) return `${minutes} min`;
  const hours = Math.floor(minutes / 60);
  if (hours < 48) return `${hours} h ${minutes % 60} min`;
  return `${Math.floor(hours / 24)} d ${hours % 24} h`;
}

/** Formats how long ago a time was. */
export function ago(time) {
  if (!time) return '–';
  const seconds = (Date.now() - Date.parse(time)) / 1000;
  return seconds < 5 ? 'just now' : `${duration(seconds)} ago`;
}

/** Quotes any text as one word of a shell. */
export function shellWord(text) {
  return /^[\w@%+=:,./-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`;
}

export function bytes(n) {
  const units = ['B', 'kB', 'MB', 'GB', 'TB'];
  let unit = 0;
  let value = n;
  while (value >= 1000 && unit < units.length - 1) {
    value /= 1000;
    unit++;
  }
  return `${unit === 0 ? value : number(value)} ${units[unit]}`;
}
