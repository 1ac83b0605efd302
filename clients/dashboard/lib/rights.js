/**
 * What the caller may do here. The service decides; the page omits what the service would refuse,
 * and explains why.
 */

import { getJson } from './api.js';

const RIGHTS = ['read', 'submit', 'admin'];

/** The caller, as the service identifies it; null if not known yet. */
let me = null;

/** Asks the service. Fails like any request. */
export async function whoAmI() {
  me = await getJson('v1/whoami');
  return me;
}

/** Returns whether the caller has a right, so that the page offers actions that need it. */
export function may(right) {
  return !me || (me.dashboard === 'on' && RIGHTS.indexOf(me.right) >= RIGHTS.indexOf(right));
}

/** Returns why jobs cannot be submitted here, or '' if they can. */
export function whyNot() {
  if (may('submit')) return '';
  return me.dashboard === 'on'
    ? `The token “${me.name}” has the right ${me.right}: these pages are read-only.`
    : 'These pages are read-only: the service has the setting dashboard = read-only.';
}

/** Describes the caller in a few words, or '' if no token is needed. */
export function callerName() {
  return me?.name ? `${me.name} · ${me.right}` : '';
}
