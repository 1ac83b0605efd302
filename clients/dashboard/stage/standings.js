/** The list of robots beside the stage: their scores or, in a race, their order at the moment. */

import { button, fill, h, patch, say, swatch, toggle } from '../lib/dom.js';
import { resultOf } from '../lib/tasks.js';
import { orderAt, paceAt, raceOf, slowPart } from './race.js';

/** More names would hide the robots. */
const NAMES_MAX = 40;
/** While robots race, their order is shown this often. */
const EVERY_MS = 200;
const MOVE_MS = 250;

const isStill = () => matchMedia('(prefers-reduced-motion: reduce)').matches;

export class Standings {
  /** @param {{follow: function(number): void, film: function(): Promise<any>,
   *   point: function(any): void}} actions point: at a robot, or at none */
  constructor({ follow, film, point }) {
    this.follow = follow;
    this.point = point;
    /** @type {?import('./race.js').Race} */
    this.race = null;
    /** @type {{robot: import('./stage.js').Robot, text: string, isArrived: boolean}[]} */
    this.order = [];
    this.isSlow = !isStill();
    this.title = h('div.muted');
    this.rows = h('div.rows');
    this.left = h('div.muted');
    this.slow = toggle('Slow finish', this.isSlow, (on) => { this.isSlow = on; },
      { title: 'A quarter of the speed around the first arrival, or at the end' });
    this.film = 'VideoEncoder' in window ? button('Film', async () => {
      this.film.disabled = true;
      try {
        await film();
      } finally {
        this.film.disabled = false;
      }
    }, { title: 'Save a film of this race (WebM), with its order' }) : null;
    this.acts = h('div.acts', {}, this.slow, this.film);
    this.element = h('div.names', { hidden: true, role: 'group', 'aria-label': 'Robots' },
      this.title, this.rows, this.left, this.acts);
  }

  /** Makes the list of a stage. @param {import('./stage.js').Stage} stage */
  set(stage) {
    this.stage = stage;
    const { robots, sideBySide } = stage;
    const lanes = stage.lanes();
    if (this.lanes !== lanes) this.race = lanes && raceOf(lanes.robots);
    this.lanes = lanes;
    this.slowPart = this.race ? slowPart(this.race) : [0, 0];
    fill(this.rows);
    this.rows.replaceWith(this.rows = h('div.rows'));
    this.element.hidden = robots.length === 0 || (robots.length > NAMES_MAX && !lanes) ||
      (sideBySide && robots.length > 1);
    const { race } = this;
    this.acts.hidden = !race;
    say(this.title, race ? race.title : robots.some((robot) => robot.driven)
      ? 'following your light' : 'score in this environment');
    this.title.title = race?.about ?? '';
    const others = lanes ? robots.length - lanes.robots.length : 0;
    this.left.hidden = !others;
    say(this.left, `the best ${lanes?.robots.length} of ${robots.length}`);
    this.left.title = 'Only the best robots race. Side by side shows all robots.';
    this.shownMs = 0;
    this.update(false);
  }

  /** Shows the order at the current time. @param {boolean} isMoving time runs: update only
   * periodically */
  update(isMoving) {
    const { stage, race } = this;
    if (this.element.hidden) return;
    const now = performance.now();
    if (isMoving && now < this.shownMs + EVERY_MS) return;
    this.shownMs = now;
    this.order = race ? orderAt(race, stage.timeS) : stage.robots.map((robot) =>
      ({ robot, text: resultOf(robot), isArrived: false }));
    stage.leader = race ? this.order[0].robot : null;
    const before = new Map([...this.rows.children].map((row) => [row, placeOf(row)]));
    patch(this.rows, this.order, ({ robot }) => stage.robots.indexOf(robot),
      ({ robot }) => this.#row(robot), (row, { robot, text, isArrived }) => {
        const [place, , number] = row.children;
        if (race) say(place, String(this.order.findIndex((one) => one.robot === robot) + 1));
        say(number, text);
        row.classList.toggle('arrived', isArrived);
        row.setAttribute('aria-pressed',
          String(stage.robots[stage.followed] === robot && (!race || stage.follow)));
      });
    if (!race || isStill()) return;
    for (const [row, [x, y]] of before) {
      const [left, top] = placeOf(row);
      if (left === x && top === y) continue;
      row.animate({ transform: [`translate(${x - left}px, ${y - top}px)`, 'none'] },
        { duration: MOVE_MS, easing: 'ease-out' });
    }
  }

  #row(robot) {
    const i = this.stage.robots.indexOf(robot);
    return h('button', {
      type: 'button', 'aria-pressed': 'false',
      title: `${robot.robot}: follow this robot`, onclick: () => this.follow(i),
      onpointerenter: () => this.point(robot), onpointerleave: () => this.point(null),
      onfocus: () => this.point(robot), onblur: () => this.point(null),
    }, h('strong', { hidden: !this.race }), h('span.row', {}, swatch(robot.color),
      h('span.name', {}, robot.label ?? '')), h('span.number'));
  }

  /** Returns the time after some seconds at this speed: slower around the finish. */
  after(timeS, seconds) {
    const [from] = this.slowPart;
    if (!this.isSlow || !this.race) return timeS + seconds;
    const next = timeS + seconds * paceAt(this.slowPart, timeS);
    return timeS < from && next > from ? from : next; // a slow frame must not skip the slow part
  }
}

/** @returns {[number, number]} */
const placeOf = (row) => [row.offsetLeft, row.offsetTop];
