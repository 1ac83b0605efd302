/**
 * The statistics of morphoctl (clients/morphoctl/stats.c): intervals of Student's t distribution.
 */

export const CONFIDENCE = 0.95;

/** Returns the natural logarithm of the gamma function, for x > 0: Lanczos approximation. */
function logGamma(x) {
  const terms = [76.18009172947146, -86.50532032941677, 24.01409824083091, -1.231739572450155,
    0.1208650973866179e-2, -0.5395239384953e-5];
  const base = x + 5.5;
  const sum = terms.reduce((all, term, i) => all + term / (x + 1 + i), 1.000000000190015);
  return (x + 0.5) * Math.log(base) - base + Math.log((2.5066282746310005 * sum) / x);
}

/**
 * Returns the continued fraction of the incomplete beta function I_x(a, b), for x below (a + 1)/(a
 * + b + 2).
 */
function betaFraction(a, b, x) {
  const away = (value) => (Math.abs(value) < 1e-300 ? 1e-300 : value);
  let c = 1;
  let d = 1 / away(1 - ((a + b) * x) / (a + 1));
  let value = d;
  for (let m = 1; m <= 10000; m++) {
    const even = (m * (b - m) * x) / ((a + 2 * m - 1) * (a + 2 * m));
    const odd = (-(a + m) * (a + b + m) * x) / ((a + 2 * m) * (a + 2 * m + 1));
    let change = 1;
    for (const term of [even, odd]) {
      d = 1 / away(1 + term * d);
      c = away(1 + term / c);
      change = c * d;
      value *= change;
    }
    if (Math.abs(change - 1) < Number.EPSILON) break;
  }
  return value;
}

function incompleteBeta(a, b, x, y) {
  if (x <= 0 || y <= 0) return x <= 0 ? 0 : 1;
  const front =
    Math.exp(logGamma(a + b) - logGamma(a) - logGamma(b) + a * Math.log(x) + b * Math.log(y));
  if (x < (a + 1) / (a + b + 2)) return (front * betaFraction(a, b, x)) / a;
  return 1 - (front * betaFraction(b, a, y)) / b;
}

/** Returns P(T ≤ t) with `n` degrees of freedom. */
function studentProbability(t, freedom) {
  const square = t * t;
  const tails = incompleteBeta(freedom / 2, 0.5, freedom / (freedom + square),
    square / (freedom + square));
  return t > 0 ? 1 - tails / 2 : tails / 2;
}

/** Returns t with P(T ≤ t) = p, for p above one half. */
function studentQuantile(p, freedom) {
  let [low, high] = [0, 1];
  while (studentProbability(high, freedom) < p && high < 1e300) high *= 2;
  for (let i = 0; i < 200; i++) {
    const middle = low + (high - low) / 2;
    if (middle <= low || middle >= high) break;
    if (studentProbability(middle, freedom) < p) low = middle;
    else high = middle;
  }
  return low + (high - low) / 2;
}

const mean = (values) => values.reduce((sum, one) => sum + one, 0) / values.length;
const squares = (values, middle) => values.reduce((sum, one) => sum + (one - middle) ** 2, 0);

/**
 * Returns the mean of b − a over designs with a finite loss in every environment, and its
 * interval, which holds for other designs in other environments (compare_crossed in stats.h). NaN
 * with fewer than two designs.
 * @param {number[][]} a losses by design and environment @param {number[][]} b
 */
export function compareCrossed(a, b) {
  const off = a.map((row, i) => row.map((one, w) => b[i][w] - one))
    .filter((row) => row.every((one) => Number.isFinite(one)));
  const [n, worlds] = [off.length, off[0]?.length ?? 0];
  const designs = off.map(mean);
  const difference = n ? mean(designs) : NaN;
  const improved = designs.filter((one) => one < 0).length;
  if (n < 2) return { n, difference, low: NaN, high: NaN, improved };
  const ofDesigns = (worlds * squares(designs, difference)) / (n - 1);
  let [total, freedom] = [ofDesigns, n - 1];
  if (worlds > 1) {
    const means = off[0].map((_, w) => mean(off.map((row) => row[w])));
    const ofWorlds = (n * squares(means, difference)) / (worlds - 1);
    const left = off.flatMap((row, i) => row.map((one, w) => one - means[w] - designs[i]));
    const rest = squares(left, -difference) / ((n - 1) * (worlds - 1));
    total = ofDesigns + ofWorlds - Math.min(rest, ofDesigns, ofWorlds);
    const all = ofDesigns ** 2 / (n - 1) + ofWorlds ** 2 / (worlds - 1)
      + rest ** 2 / ((n - 1) * (worlds - 1));
    if (all > 0) freedom = Math.max(1, total ** 2 / all);
  }
  const half = Math.sqrt(total / (n * worlds)) * studentQuantile(0.5 + CONFIDENCE / 2, freedom);
  return { n, difference, low: difference - half, high: difference + half, improved };
}

/** Returns the mean of b minus the mean of a, with Welch's interval: two sets that are not
 * paired. */
export function compareMeans(a, b) {
  const [ma, mb] = [mean(a), mean(b)];
  const difference = mb - ma;
  if (a.length < 2 || b.length < 2) return { difference, low: NaN, high: NaN };
  const va = squares(a, ma) / (a.length - 1) / a.length;
  const vb = squares(b, mb) / (b.length - 1) / b.length;
  if (va + vb === 0) return { difference, low: difference, high: difference };
  const freedom = (va + vb) ** 2 / (va ** 2 / (a.length - 1) + vb ** 2 / (b.length - 1));
  const half = studentQuantile(0.5 + CONFIDENCE / 2, freedom) * Math.sqrt(va + vb);
  return { difference, low: difference - half, high: difference + half };
}
