/** Drawing a path: the ground from above, where a stroke, clicks or keys make waypoints. */

import { button, h, say, svg } from '../lib/dom.js';
import { countOf } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { POINTS_MAX, drawnTask } from '../lib/tasks.js';
import { inFew } from '../stage/driven.js';
import { startDialog } from './forms.js';
import { announced } from './share.js';

/** The ground that is shown, in meters, and where robots start on it. */
const SIDE_M = 5;
const START_M = [2.5, 2.5];
/** A stroke that stays this close to where it began is a click. */
const CLICK_M = 0.12;
const STEP_M = 0.1;
const BOUND = `a path has at most ${POINTS_MAX}`;
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const HELP = 'Ground of 5 × 5 m from above. Drag to draw a path from the robot, or click to add ' +
  'a waypoint. Keys: the arrows move the cross, Enter adds a waypoint there.';

const lengthOf = (points) => points.slice(1).reduce((sum, [x, y], i) =>
  sum + Math.hypot(x - points[i][0], y - points[i][1]), 0);
const onGround = (value) => Math.round(100 * Math.min(SIDE_M, Math.max(0, value))) / 100;

/**
 * Returns the ground to draw on.
 * @param {import('../app.js').app} app
 * @param {number[][]} points the waypoints at first
 * @param {function(number[][]): any} onchange gets them after each change: 1 to 16
 * @param {boolean} [canRemove] whether the path can be removed; then onchange gets [], too
 */
export function pathPad(app, points, onchange, canRemove = false) {
  let cursor = points.at(-1) ?? START_M;
  let stroke = null;
  const placeOf = ({ clientX, clientY }) => {
    const { left, bottom, width } = ground.getBoundingClientRect();
    return [clientX - left, bottom - clientY].map((value) => onGround((value / width) * SIDE_M));
  };
  /** Returns a handler for the pointer that draws the stroke, if any. */
  const drawing = (work) => (event) => {
    if (!stroke || !event.isPrimary) return;
    work(event);
    draw();
  };
  const ground = svg('svg', {
    viewBox: '0 -5 5 5', class: 'ground-map', tabindex: 0, role: 'application', 'aria-label': HELP,
    onpointerdown: (event) => {
      if (event.button || !event.isPrimary) return;
      ground.setPointerCapture(event.pointerId);
      stroke = [START_M, placeOf(event)];
    },
    onpointermove: drawing((event) => stroke.push(placeOf(event))),
    onpointerup: drawing(end),
    onpointercancel: drawing(() => { stroke = null; }),
    onkeydown: (event) => {
      const direction = KEYS[event.key];
      if (!direction && event.key !== 'Enter') return;
      event.preventDefault();
      if (!direction) {
        add(cursor);
        return;
      }
      cursor = cursor.map((value, axis) => onGround(value + STEP_M * direction[axis]));
      show(`x ${cursor[0]} m, y ${cursor[1]} m`);
    },
  });
  const status = h('p', { role: 'status' });
  const undo = button('Remove last', () => set(points.slice(0, -1)));
  const remove = button('Remove the path', () => set([]), { hidden: !canRemove });
  const evolve = button('Evolve for this task', () => announced(() =>
    startDialog(app, 'campaign', {}, {}, { world: drawnTask(points) })),
  { hidden: !may('submit') });

  /** Ends a stroke: a click adds a waypoint; a longer stroke is a new path. */
  function end() {
    const [, [x, y]] = stroke;
    const isClick = stroke.slice(1).every((at) => Math.hypot(at[0] - x, at[1] - y) < CLICK_M);
    const { path, isCoarse } = inFew(stroke, POINTS_MAX + 1);
    stroke = null;
    if (isClick) add([x, y]);
    else set(path.slice(1), isCoarse ? `Simplified: ${BOUND} waypoints. ` : '');
  }

  function add(point) {
    const why = points.length === POINTS_MAX ? BOUND
      : `${point}` === `${points.at(-1) ?? START_M}` ? 'the path already ends there' : '';
    if (why) show(`No waypoint was added: ${why}.`);
    else set([...points, point]);
  }

  function set(all, words = '') {
    points = all;
    cursor = points.at(-1) ?? START_M;
    show(words + about());
    onchange(points);
  }

  const about = () => (points.length
    ? `This path has ${countOf(points.length, 'waypoint')} and is ` +
      `${lengthOf([START_M, ...points]).toFixed(1)} m long; most robots walk 1 to 2 m in 4 s.`
    : `No waypoint yet: ${BOUND}.`);

  /** Shows the path, and what has happened. */
  function show(words) {
    undo.disabled = points.length < 2;
    remove.disabled = evolve.disabled = !points.length;
    say(status, words);
    draw();
  }

  function draw() {
    const path = (name, d) => svg('path', { class: name, d });
    const dot = (name, at) => svg('circle', { class: name, cx: at[0], cy: -at[1], r: 0.1 });
    ground.replaceChildren(path('grid', 'M0-1h5M0-2h5M0-3h5M0-4h5M1 0v-5M2 0v-5M3 0v-5M4 0v-5'),
      path('route', `M${(stroke ?? [START_M, ...points]).map(([x, y]) => [x, -y]).join('L')}`),
      ...points.map((point, i) => dot(i < points.length - 1 ? 'point' : 'lamp', point)),
      dot('start', START_M), path('cross', `M${cursor[0] - 0.15} ${-cursor[1]}h.3m-.15-.15v.3`));
  }

  show(about());
  return h('div.draw', {}, ground,
    h('div.stack', {}, h('p.muted', {}, HELP), status, h('div.row', {}, undo, remove, evolve)));
}
