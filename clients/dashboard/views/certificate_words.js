/** What the axes and levels of a certificate are called, and what it says of a design in brief. */

import { countOf } from '../lib/format.js';

/** Titles of the axes, and what a design that is worse there depends on. */
const AXES = {
  base: ['Base'], precision: ['Precision'], step: ['Time step'],
  held_out: ['Fresh worlds', 'its worlds'], chance: ['Luck'], stiffness: ['Stiffness', 'stiffness'],
  mass: ['Mass', 'mass'], drag: ['Drag', 'drag'], gravity: ['Gravity', 'gravity'],
  actuation: ['Actuation', 'actuation'], friction: ['Friction', 'friction'],
  drop: ['Drop height', 'the drop height'], worlds: ['All constants', 'all constants together'],
};
/** The rules of verdicts: MO_VERDICT_CHANGE and MO_VERDICT_RANKS of the library. */
const [CHANGE, RANKS] = [0.05, 0.1];

export const axisTitle = (axis) => AXES[axis]?.[0] ?? axis;

/** Describes a level without its axis. */
export function levelWords({ axis, level, environments, precision }, base) {
  const copies = environments / base.environments;
  if (axis === 'base') return `in ${countOf(environments, 'world')}`;
  if (axis === 'held_out') return `(${environments})`;
  if (axis === 'worlds') return `drawn in ${countOf(environments, 'world')}`;
  if (axis === 'chance') return `(${countOf(copies, 'copy', 'copies')} ± 0.01 %)`;
  if (axis === 'precision') return precision;
  if (axis === 'step') return `÷ ${level}`;
  if (axis === 'drop') return `+ ${level} m`;
  return level === null ? '' : `× ${level}`;
}

/** Returns whether a design diverges at a level, or is clearly worse than at the base. */
const isWorse = ({ change, change_interval: interval, diverged }) =>
  diverged > 0 || (change >= CHANGE && !(interval?.[0] <= 0));

/**
 * Returns what holds of a design and what its score depends on, as texts with a class.
 * @param {any} design of the report
 * @param {any} report
 * @returns {[string, string][]}
 */
export function badgesOf(design, { levels, n_designs: n }) {
  if (design.score === null) return [['has no score', 'bad']];
  const axes = levels.map(({ axis }) => axis);
  const hasSteps = axes.includes('step');
  const fine = design.levels[axes.lastIndexOf(hasSteps ? 'step' : 'precision')];
  const where = hasSteps ? 'on finer steps' : 'in float64';
  /** @type {[string, string][]} */
  const badges = [];
  if (fine?.diverged) {
    badges.push([`in doubt: diverges ${where}`, 'bad']);
  } else if (fine && n > 1) {
    const isKept = Math.abs(fine.rank - design.rank) <= Math.max(1, RANKS * n);
    badges.push(isKept ? [`keeps its rank ${where}`, 'good']
      : [`rank ${design.rank} → ${fine.rank} ${where}`, 'bad']);
  }
  const worse = new Set(axes.filter((axis, i) => AXES[axis]?.[1] && isWorse(design.levels[i])));
  if (worse.size > 1) worse.delete('worlds');
  if (worse.size) {
    badges.push([`depends on ${[...worse].map((axis) => AXES[axis][1]).join(', ')}`, 'but']);
  }
  return badges;
}
