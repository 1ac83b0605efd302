/** What is known about designs in lists and on the stage in addition to their scores: the mean in
 * fresh worlds, and the newest certificate. It is loaded where designs are shown. */

import { getJson } from '../lib/api.js';
import { fill, h } from '../lib/dom.js';
import { score } from '../lib/format.js';
import { nameOf } from '../lib/names.js';
import { loadSheet } from '../lib/sheet.js';

/** The classes of verdicts, with the color of the badge and an explanation. */
const CLASSES = {
  holds: ['good', 'no level of the certificate makes its score clearly worse'],
  depends: ['but', 'its score is worse in fresh worlds or with other constants'],
  in_doubt: ['bad', 'its rank or score is not kept with finer time steps'],
  no_score: ['bad', 'it diverges at the base of the certificate'],
};
/** Robots of a stage that are looked up. */
const ROBOTS_MAX = 16;

/** Returns a link to a certificate that states its verdict. */
function badgeOf({ id, class: verdict }, of = '') {
  const [kind, about] = CLASSES[verdict] ?? ['', 'an earlier version computed the certificate'];
  loadSheet('certificate.css');
  return h(`a.badge${kind && `.${kind}`}`, { href: `#/certificates/${id}`, title:
    `Certificate ${id}: ${about}` }, of,
  verdict ? `certificate: ${verdict.replace('_', ' ')}` : 'certificate');
}

/** Returns the mean in fresh worlds, with its interval. */
function heldOut({ mean, low, high, worlds, diverged, generation }, shown) {
  return h('span.muted.held-out', { title: `Mean in ${worlds} fresh worlds, not used for ` +
    `selection, with its 95 % interval; generation ${generation}` },
  mean === null ? `fresh worlds: ${diverged} of ${worlds} diverged`
    : `fresh worlds: ${shown(mean)} (${shown(low)} to ${shown(high)})`);
}

/** Returns why a design has no mean in fresh worlds. */
function notHeldOut(design, { generation, designs, champions }) {
  return h('span.muted.held-out', { title: `Generation ${generation} was re-evaluated in fresh ` +
    `worlds: its best ${designs}, and its ${champions} champions. Designs that diverge are left ` +
    'out' }, design.score === null ? 'fresh worlds: left out, because it diverges'
    : `fresh worlds: not among the best ${designs} or the ${champions} champions of generation ` +
      `${generation}`);
}

/**
 * Completes the last cards of a list.
 * @param {Element} list @param {any[]} designs
 * @param {any} again the newest re-evaluation, or null
 */
export function markCards(list, designs, shown = score, again = null) {
  const cards = [...list.children].slice(-designs.length);
  designs.forEach((design, i) => {
    const { held_out: fresh, certificate } = design;
    cards[i]?.querySelector('.known')?.remove();
    if (!fresh && !certificate && !again) return;
    cards[i]?.append(h('div.known', {}, fresh ? heldOut(fresh, shown)
      : again ? notHeldOut(design, again) : null, ' ', certificate ? badgeOf(certificate) : null));
  });
}

/** Shows the certificates of the robots below their stage. */
export async function markStage(player, robots, signal) {
  const names = [...new Set(robots.map(({ robot }) => robot).filter(Boolean))];
  const designs = await Promise.all(names.slice(0, ROBOTS_MAX).map((robot) =>
    getJson(`v1/designs/${robot}`, { signal }).catch(() => null)));
  if (signal?.aborted) return;
  const badges = designs.map((design, i) => {
    const certificate = design?.orientations.find(({ robot }) => robot === names[i])?.certificate;
    return certificate ? badgeOf(certificate, `${nameOf(names[i])}, `) : null;
  }).filter(Boolean);
  player.badges ??= h('div.row.known');
  fill(player.badges, badges);
  if (badges.length) player.element.after(player.badges);
}
