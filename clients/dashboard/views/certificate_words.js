/** The names of the axes and levels of a certificate, and what it says about a design in a few
 * words. */

import { countOf } from '../lib/format.js';

/** Titles of the axes, and what a design that is worse there depends on. */
const AXES = {
  base: ['Base'], precision: ['Precision'], step: ['Time step'],
  held_out: ['Fresh worlds', 'its worlds'], chance: ['Luck'], stiffness: ['Stiffness', 'stiffness'],
  mass: ['Mass', 'mass'], drag: ['Drag', 'drag'], gravity: ['Gravity', 'gravity'],
  actuation: ['Actuation', 'actuation'], friction: ['Friction', 'friction'],
  drop: ['Drop height', 'the drop height'], worlds: ['All constants', 'all constants together'],
};
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

/**
 * Returns what holds for a design and what its score depends on, as texts with a class. Both come
 * from the report, so the rules are those of the library.
 * @param {any} design of the report
 * @param {{n_designs: number}} report
 * @returns {[string, string][]}
 */
export function badgesOf({ score, rank, numerics, worse }, { n_designs: n }) {
  if (score === null) return [['has no score', 'bad']];
  /** @type {[string, string][]} */
  const badges = [];
  if (numerics) {
    const where = numerics.axis === 'step' ? 'with finer time steps'
      : 'in float64';
    badges.push(numerics.diverged ? [`in doubt: diverges ${where}`, 'bad']
      : numerics.kept ? [`keeps its ${n > 1 ? 'rank' : 'score'} ${where}`, 'good']
      : [n > 1 ? `rank ${rank} → ${numerics.rank} ${where}` : `its score changes ${where}`, 'bad']);
  }
  const axes = worse.length > 1 ? worse.filter((axis) => axis !== 'worlds') : worse;
  if (axes.length) {
    badges.push([`depends on ${axes.map((axis) => AXES[axis]?.[1] ?? axis).join(', ')}`, 'but']);
  }
  return badges;
}
