/** Long tables: rows are drawn when they come near the visible area, so a thousand rows scroll as
 * fast as ten. */

import { patch } from './dom.js';

export class LazyRows {
  /**
   * @param {HTMLTableSectionElement} body
   * @param {function(any): string} key of an item
   * @param {function(HTMLTableRowElement, any): void} draw fills or updates a row
   */
  constructor(body, key, draw) {
    this.body = body;
    this.key = key;
    this.draw = draw;
    this.items = new Map();
    // An observer of intersections would report a row after the frame in which it appears.
    this.onScroll = () => this.#drawSeen();
    addEventListener('scroll', this.onScroll, { passive: true });
    addEventListener('resize', this.onScroll);
  }

  /** Sets the items; rows that were already drawn stay, and are updated. */
  set(items) {
    this.items = new Map(items.map((item) => [this.key(item), item]));
    patch(this.body, items, this.key, (item) =>
      Object.assign(document.createElement('tr'), { rowKey: this.key(item) }), (row, item) => {
      if (row.isDrawn) this.draw(row, item);
    });
    this.#drawSeen();
  }

  /** @returns {any[]} each has the key of its item, and whether it was drawn */
  #rows() {
    return [...this.body.children];
  }

  /** Draws a row again, if it was drawn. */
  redraw(key) {
    for (const row of this.#rows()) {
      if (row.rowKey === key && row.isDrawn) this.draw(row, this.items.get(key));
    }
  }

  /** Draws the visible rows, and those within a few screens above and below. */
  #drawSeen() {
    const rows = this.#rows();
    const at = (y) => {
      let [low, high] = [0, rows.length];
      while (low < high) {
        const middle = (low + high) >> 1;
        if (rows[middle].getBoundingClientRect().bottom < y) low = middle + 1;
        else high = middle;
      }
      return low;
    };
    for (const row of rows.slice(at(-2 * innerHeight), at(3 * innerHeight) + 1)) {
      if (row.isDrawn) continue;
      row.isDrawn = true;
      this.draw(row, this.items.get(row.rowKey));
    }
  }

  destroy() {
    removeEventListener('scroll', this.onScroll);
    removeEventListener('resize', this.onScroll);
  }
}
