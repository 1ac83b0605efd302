/** Style sheets of pages that are loaded on demand, so that other pages do not load them. */

import { h } from './dom.js';

/** Adds a sheet once, and waits until it applies. */
export function loadSheet(name) {
  const { href } = new URL(`../${name}`, import.meta.url);
  if (document.querySelector(`link[href="${href}"]`)) return Promise.resolve();
  return new Promise((resolve) => {
    document.head.append(h('link', { rel: 'stylesheet', href, onload: resolve,
      onerror: resolve }));
  });
}
