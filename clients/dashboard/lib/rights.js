/**
 * What the caller may do here. The service decides; the page leaves out what it would refuse, and
 * says why.
 */

import { getJson } from './api.js';

const RIGHTS = ['read', 'submit', 'admin'];

/** Who the caller is to the service; null: not known yet. */
let me = null;

/** Asks the service. Fails as requests do. */
export async function whoAmI() {
  me = await getJson('v1/whoami');
  return me;
}

/** Whether the caller has a right, so that the page offers what needs it. */
export function may(right) {
  return !me || (me.dashboard === 'on' && RIGHTS.indexOf(me.right) >= RIGHTS.indexOf(right));
}

/** Why jobs cannot be submitted here; '' where they can. */
export function whyNot() {
  if (may('submit')) return '';
  return me.dashboard === 'on'
    ? `The token “${me.name}” has the right ${me.right}: these pages are read-only.`
    : 'These pages only show: the service has the setting dashboard = read-only.';
}

/** The caller in a few words: '' where no token is needed. */
export function callerName() {
  return me?.name ? `${me.name} · ${me.right}` : '';
}
