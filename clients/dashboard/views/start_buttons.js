/** Buttons that open the forms that start jobs. The forms are loaded when one is pressed, because a
 * page draws sooner with fewer files. */

import { button } from '../lib/dom.js';
import { may } from '../lib/rights.js';
import { announced } from './share.js';

/** Returns the button that starts a kind of job, or null if the caller may not start jobs. */
export function startButton(app, kind, attributes = {}) {
  return may('submit') ? button(`New ${kind}`, () => announced(async () =>
    (await import('./forms.js')).startDialog(app, kind)), attributes) : null;
}

/**
 * Returns the button that starts a campaign from the given designs; hidden if the caller may not
 * start jobs.
 * @param {() => object[]} designsOf {id} or {voxels} each
 */
export function breedButton(app, text, designsOf, attributes = {}) {
  return button(text, () => announced(async () =>
    (await import('./forms.js')).breed(app, designsOf())),
  { ...attributes, hidden: !may('submit') });
}
