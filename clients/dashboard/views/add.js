/** The button that adds robots to the tray. */

import { robotOf } from '../lib/body.js';
import { announce, button } from '../lib/dom.js';
import { countOf } from '../lib/format.js';
import { nameOf } from '../lib/names.js';
import { TRAY_MAX, tray } from '../lib/tray.js';

/**
 * Adds bodies to the tray, and reports what happened to them.
 * @param {{genotype: string, robot?: string, note?: string}[]} bodies
 */
export function addToTray(bodies) {
  const robots = bodies.map(({ genotype, robot = robotOf(genotype), note = '' }) =>
    ({ robot, genotype, note }));
  const added = tray.add(robots);
  const left = robots.filter((one) => !tray.has(one));
  const [one] = robots;
  if (left.length) {
    announce(`The tray is full: it holds ${TRAY_MAX} robots. ${countOf(left.length, 'robot')} ` +
      'did not fit.', { isRefusal: true });
  } else if (!added.length) {
    announce(robots.length === 1 ? `${nameOf(one.robot)} is already in the tray.`
      : 'These robots are already in the tray.');
  } else {
    announce(`${added.length === 1 ? nameOf(added[0].robot) : countOf(added.length, 'robot')} ` +
      `added to the tray, which now has ${countOf(tray.kept.length, 'robot')}`);
  }
}

/** @param {() => {genotype: string, robot?: string, note?: string}[]} bodiesOf */
export function trayButton(bodiesOf, attributes = {}) {
  return button('Add to tray', () => addToTray(bodiesOf()), attributes);
}
