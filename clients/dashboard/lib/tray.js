/**
 * The tray: robots that were chosen on any page, to be watched, compared or bred together. It is
 * kept until the tab is closed.
 */

import { storing } from './api.js';

const TRAY_KEY = 'morphod-tray';
export const TRAY_MAX = 64;

/**
 * A robot in the tray. A design is in the tray only once, in the orientation in which it was first
 * added.
 * @typedef {{robot: string, genotype: string, note: string}} Kept
 *   robot: ID@K; genotype: as it was added, anywhere in the workspace; note: its score, or its size
 */

/** @returns {Kept[]} */
function stored() {
  const text = storing(() => sessionStorage.getItem(TRAY_KEY));
  try {
    return (JSON.parse(text ?? '[]') ?? []).filter(({ robot, genotype }) =>
      /^[0-9a-f]{36}@[0-7]$/.test(robot) && /^[01]{144}$/.test(genotype));
  } catch {
    return [];
  }
}

const idOf = ({ robot }) => robot.slice(0, 36);

export const tray = {
  kept: stored(),
  /** @type {Set<function(): void>} called after each change */
  listeners: new Set(),

  /** @param {{robot: string}} one */
  has(one) {
    return this.kept.some((kept) => idOf(kept) === idOf(one));
  },

  /**
   * Adds robots at the end. Those whose design is already in the tray, and those beyond its size,
   * are left out. @param {Kept[]} robots @returns {Kept[]} those that were added
   */
  add(robots) {
    const added = [];
    for (const one of robots) {
      if (this.kept.length >= TRAY_MAX || this.has(one)) continue;
      this.kept.push(one);
      added.push(one);
    }
    if (added.length) changed();
    return added;
  },

  remove(robot) {
    this.kept = this.kept.filter((one) => one.robot !== robot);
    changed();
  },

  clear() {
    this.kept = [];
    changed();
  },
};

function changed() {
  storing(() => sessionStorage.setItem(TRAY_KEY, JSON.stringify(tray.kept)));
  for (const listener of tray.listeners) listener();
}
