/**
 * Names of the robots on the stage: above each robot in a race, otherwise in the corner of its
 * view.
 */

import { fill, h, say } from '../lib/dom.js';
import { resultOf } from '../lib/tasks.js';
import { NARROW_PX } from './lanes.js';
import { project } from './math.js';

/** More names than these would hide the robots. */
const TAGS_MAX = 16;
const [HEIGHT_PX, WIDTH_PX, CROWDED_PX] = [22, 90, 24];
/** Long names are wider than the minimum width of a tag. */
const WIDER = 1.4;

export class Tags {
  constructor() {
    // Screen readers read the list of robots instead.
    this.element = h('div.tags', { 'aria-hidden': 'true' });
  }

  /**
   * Places the names at the robots.
   * @param {import('./stage.js').Stage} stage
   * @param {{robot: Object}[]} order of a race
   */
  place(stage, order) {
    const { clientWidth, clientHeight, width, offsetTop } = stage.canvas;
    const perPixel = clientWidth / width;
    const views = stage.views();
    const placed = [];
    const lanes = stage.lanes();
    const solid = stage.solid();
    const places = new Map(order.map(({ robot }, i) => [robot, i + 1]));
    const isCrowded = Boolean(lanes) &&
      (lanes.lane ? isNarrow(stage, lanes) : clientWidth < NARROW_PX);
    const tagPx = isCrowded ? CROWDED_PX : WIDTH_PX;
    [...this.element.children].forEach((tag, i) => {
      let [x, y] = [0, 0];
      const isApart = stage.sideBySide && stage.robots.length > 1;
      const [number, name, score] = tag.children;
      number.hidden = !lanes;
      name.hidden = isCrowded;
      tag.classList.toggle('bare', isCrowded);
      score.hidden = !isApart;
      if (isApart) {
        const view = views[i];
        [x, y] = [view.x * perPixel + 8, clientHeight - (view.y + view.height) * perPixel + 8];
      } else {
        const robot = this.robots[i];
        tag.classList.toggle('solid', robot === solid);
        say(number, String(places.get(robot) ?? ''));
        const place = stage.placeOf(robot);
        tag.hidden = !place;
        if (!place) return;
        const [mx, my, mz] = place;
        const matrix = stage.camera.matrix(views[0].width, views[0].height);
        const [px, py, depth] = project(matrix, [mx, my, mz + 0.28]);
        x = ((px + 1) / 2) * clientWidth - tagPx / 2;
        y = ((1 - py) / 2) * clientHeight - HEIGHT_PX;
        tag.hidden = depth > 1 || Math.abs(px) > 1 || Math.abs(py) > 1;
        // All start at the same position: names that would cover each other are stacked.
        const overlaps = (at) =>
          Math.abs(at[0] - x) < WIDER * tagPx && Math.abs(at[1] - y) < HEIGHT_PX;
        let step = -HEIGHT_PX;
        while (!lanes?.lane && placed.some(overlaps)) {
          if (y < HEIGHT_PX) step = HEIGHT_PX; // not above the picture
          y += step;
        }
        placed.push([x, y]);
      }
      tag.style.transform = `translate(${x.toFixed(1)}px, ${(y + offsetTop).toFixed(1)}px)`;
    });
  }

  /** Shows the names of other robots at once, because their picture may take a while. */
  name(stage) {
    const robots = stage.lanes()?.robots ?? stage.robots;
    this.robots = robots.length > 1 && robots.length <= TAGS_MAX ? robots : [];
    fill(this.element, this.robots.map((robot) => {
      const tag = h('span.tag', {}, h('strong'), h('span', {}, robot.label ?? ''),
        h('span.number', {}, resultOf(robot)));
      tag.style.borderColor = robot.color;
      return tag;
    }));
  }
}

/** Returns whether names would cover other lanes. */
function isNarrow({ canvas: { clientWidth: width, clientHeight: height }, camera }, { shifts }) {
  const matrix = camera.matrix(width, height);
  const [from, to] = [...shifts.values()].map((shift) =>
    project(matrix, camera.target.map((value, axis) => value + shift[axis])));
  return Math.abs(from[0] - to[0]) * width < 2 * (WIDTH_PX + 30);
}
