/** Drawing a path: the ground from above, where a stroke, clicks or keys make way-points. */

import { button, h, say, svg } from '../lib/dom.js';
import { countOf } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { POINTS_MAX, drawnTask } from '../lib/tasks.js';
import { simplified } from '../stage/driven.js';
import { startDialog } from './forms.js';
import { announced } from './share.js';

/** The ground that is shown, in meters, and where robots start on it. */
const SIDE_M = 5;
const START_M = [2.5, 2.5];
/** A stroke that is shorter is a click. */
const CLICK_M = 0.12;
/** Way-points are left out where the path changes by less than this. */
const CLOSE_M = 0.05;
const STEP_M = 0.1;
const BOUNDS = `a path has 1 to ${POINTS_MAX} way-points.`;
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const HELP = 'Ground of 5 × 5 m from above. Drag to draw a path from the robot, or click to add ' +
  'a way-point. Keys: the arrows move the cross, Enter adds a way-point there.';

const lengthOf = (points) => points.slice(1).reduce((sum, [x, y], i) =>
  sum + Math.hypot(x - points[i][0], y - points[i][1]), 0);
const onGround = (value) => Math.round(100 * Math.min(SIDE_M, Math.max(0, value))) / 100;

/**
 * Returns the ground to draw on.
 * @param {import('../app.js').app} app
 * @param {number[][]} points the way-points at first
 * @param {function(number[][]): void} onchange gets them after each change: 1 to 16
 */
export function pathPad(app, points, onchange) {
  let cursor = points.at(-1) ?? START_M;
  let stroke = null;
  const placeOf = ({ clientX, clientY }) => {
    const { left, bottom, width } = ground.getBoundingClientRect();
    return [clientX - left, bottom - clientY].map((value) => onGround((value / width) * SIDE_M));
  };
  const ground = svg('svg', {
    viewBox: '0 -5 5 5', class: 'ground-map', tabindex: 0, role: 'application', 'aria-label': HELP,
    onpointerdown: (event) => {
      ground.setPointerCapture(event.pointerId);
      stroke = [START_M, placeOf(event)];
    },
    onpointermove: (event) => {
      stroke?.push(placeOf(event));
      draw();
    },
    onpointerup: end,
    onpointercancel: () => { stroke = null; },
    onkeydown: (event) => {
      const direction = KEYS[event.key];
      if (!direction && event.key !== 'Enter') return;
      event.preventDefault();
      if (!direction) {
        set([...points, cursor]);
        return;
      }
      cursor = cursor.map((value, axis) => onGround(value + STEP_M * direction[axis]));
      show(`Cross at x ${cursor[0]} m, y ${cursor[1]} m.`);
    },
  });
  const status = h('p', { role: 'status' });
  const undo = button('Remove last', () => set(points.slice(0, -1)));
  const evolve = button('Evolve for this task', () => announced(() =>
    startDialog(app, 'campaign', {}, {}, { world: drawnTask(points) })),
  { hidden: !may('submit') });

  /** A click adds a way-point; a longer stroke is a new path. */
  function end() {
    const drawn = stroke;
    stroke = null;
    if (lengthOf(drawn.slice(1)) < CLICK_M) {
      set([...points, drawn[1]]);
      return;
    }
    const pathAt = (close) => simplified(drawn, close).slice(1);
    let [close, path] = [CLOSE_M, pathAt(CLOSE_M)];
    while (path.length > POINTS_MAX) path = pathAt(close *= 1.25);
    set(path, close > CLOSE_M ? `Simplified: ${BOUNDS}` : '');
  }

  function set(all, words = '') {
    if (all.length > POINTS_MAX) {
      show(`No way-point was added: ${BOUNDS}`);
      return;
    }
    points = all;
    cursor = points.at(-1);
    show(words);
    onchange(points);
  }

  /** Shows the path, what it is, and what has happened. */
  function show(words) {
    const n = points.length;
    undo.disabled = n < 2;
    evolve.disabled = !n;
    say(status, n ? `${words} This path has ${countOf(n, 'way-point')} and is ` +
      `${lengthOf([START_M, ...points]).toFixed(1)} m long; most robots walk 1 to 2 m in 4 s.`
      : words || `No way-point yet: ${BOUNDS}`);
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

  show('');
  return h('div.draw', {}, ground,
    h('div.stack', {}, h('p.muted', {}, HELP), status, h('div.row', {}, undo, evolve)));
}
