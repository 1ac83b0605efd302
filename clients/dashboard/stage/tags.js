/**
 * Names of the robots on the stage: above each robot in a race, otherwise in the corner of its
 * view.
 */

import { fill, h } from '../lib/dom.js';
import { resultOf } from '../lib/tasks.js';
import { project } from './math.js';
import { centerOfMass } from './robot.js';

/** More names than these would hide the robots. */
const TAGS_MAX = 16;
const [HEIGHT_PX, WIDTH_PX] = [22, 90];

export class Tags {
  constructor() {
    // Screen readers read the list of robots instead.
    this.element = h('div.tags', { 'aria-hidden': 'true' });
  }

  /** Puts the names where the robots are. @param {import('./stage.js').Stage} stage */
  place(stage) {
    const { clientWidth, clientHeight, width, offsetTop } = stage.canvas;
    const perPixel = clientWidth / width;
    const views = stage.views();
    const placed = [];
    [...this.element.children].forEach((tag, i) => {
      let [x, y] = [0, 0];
      const isApart = stage.sideBySide && stage.robots.length > 1;
      tag.lastElementChild.hidden = !isApart;
      if (isApart) {
        const view = views[i];
        [x, y] = [view.x * perPixel + 8, clientHeight - (view.y + view.height) * perPixel + 8];
      } else {
        const robot = stage.robots[i];
        const [mx, my, mz] = centerOfMass(robot, stage.frameOf(robot));
        const [px, py, depth] = project(stage.camera.matrix(views[0].width, views[0].height),
          [mx, my, mz + 0.28]);
        x = ((px + 1) / 2) * clientWidth - WIDTH_PX / 2;
        y = ((1 - py) / 2) * clientHeight - HEIGHT_PX;
        tag.hidden = depth > 1 || Math.abs(px) > 1 || Math.abs(py) > 1;
        // All start at the same position: names that would cover each other are stacked.
        const overlaps = (at) =>
          Math.abs(at[0] - x) < WIDTH_PX && Math.abs(at[1] - y) < HEIGHT_PX;
        while (placed.some(overlaps)) y -= HEIGHT_PX;
        placed.push([x, y]);
      }
      tag.style.transform = `translate(${x.toFixed(1)}px, ${(y + offsetTop).toFixed(1)}px)`;
    });
  }

  /** Names other robots, at once: their picture may take a while. */
  name(robots) {
    const shown = robots.length > 1 && robots.length <= TAGS_MAX ? robots : [];
    fill(this.element, shown.map((robot) => {
      const tag = h('span.tag', {}, robot.label ?? '', h('span.number', {}, resultOf(robot)));
      tag.style.borderColor = robot.color;
      return tag;
    }));
  }
}
