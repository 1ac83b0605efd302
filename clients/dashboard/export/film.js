/** Films of the stage. Films of a race include the standings and the slow motion. */

import { project } from '../stage/math.js';
import { filmTimes, orderAt } from '../stage/race.js';
import { record } from './webm.js';

/** A film of a race ends with a still picture. */
const STILL_S = 1.2;
/** Height of the picture, in lines of the standings. */
const LINES = 34;

/**
 * @param {import('../stage/player.js').Player} player
 * @param {function(number): void} onprogress is called with the fraction done
 * @param {?import('../stage/race.js').Race} race what was on the stage when the film was requested
 * @returns {Promise<Blob>}
 */
export async function filmOf(player, onprogress, race = player.standings.race) {
  const { stage, canvas, standings: { isSlow, slowPart } } = player;
  player.setPlaying(false);
  const { timeS, robots } = stage;
  const drawAt = (time) => {
    if (stage.robots !== robots || player.standings.race !== race) {
      throw new Error('The stage has changed, so the film was stopped.');
    }
    Object.assign(stage, { timeS: time, hovered: null });
    if (race) stage.leader = orderAt(race, time)[0].robot;
    stage.draw();
  };
  try {
    return await player.inFull(() => {
      if (!race) return record(canvas, drawAt, { durationS: stage.durationS(), onprogress });
      const { durationS, timeAt } = filmTimes(isSlow ? slowPart : [0, 0], race.durationS);
      const picture = document.createElement('canvas');
      const context = picture.getContext('2d');
      return record(picture, (filmS) => {
        drawAt(timeAt(filmS));
        const { width, height } = canvas;
        if (picture.width !== width || picture.height !== height) {
          Object.assign(picture, { width, height });
        }
        context.drawImage(canvas, 0, 0);
        paint(context, stage, race);
      }, { durationS: durationS + STILL_S, onprogress });
    });
  } finally {
    stage.timeS = timeS;
    player.redraw();
  }
}

/** Paints the order of a race at the right, and the places above the robots. */
function paint(context, stage, race) {
  const { width, height } = context.canvas;
  const isDark = stage.theme === 'dark';
  const [ground, text, muted] = isDark ? ['#171b21e6', '#f0f3f6', '#a9b4c0']
    : ['#fffffff0', '#14181d', '#55606c'];
  const order = orderAt(race, stage.timeS);
  const line = height / LINES;
  context.textBaseline = 'middle';
  const font = (weight) => { context.font = `${weight} ${0.62 * line}px system-ui, sans-serif`; };
  font('400');
  const names = order.map(({ robot }) => robot.label ?? '');
  const wide = Math.max(...names.map((name) => context.measureText(name).width)) + 8.2 * line;
  const [left, top] = [width - wide - 0.6 * line, 0.6 * line];
  context.fillStyle = ground;
  context.fillRect(left, top, wide, (order.length + 1.6) * line);
  const write = (value, x, y, color, align = 'left') => {
    context.fillStyle = color;
    context.textAlign = /** @type {CanvasTextAlign} */ (align);
    context.fillText(value, x, y);
  };
  write(race.title, left + 0.6 * line, top + 0.8 * line, muted);
  write(`${Math.min(stage.timeS, race.durationS).toFixed(2)} s`, left + wide - 0.6 * line,
    top + 0.8 * line, muted, 'right');
  const [{ matrix }] = stage.drawn;
  const placed = [];
  order.forEach(({ robot, text: value, isArrived }, i) => {
    const y = top + (i + 1.9) * line;
    font(isArrived ? '700' : '400');
    write(String(i + 1), left + 1.5 * line, y, text, 'right');
    context.fillStyle = robot.color;
    context.fillRect(left + 1.9 * line, y - 0.3 * line, 0.6 * line, 0.6 * line);
    write(names[i], left + 2.8 * line, y, text);
    write(value, left + wide - 0.6 * line, y, text, 'right');
    const [px, py] = project(matrix, stage.placeOf(robot));
    const x = ((px + 1) / 2) * width;
    let above = ((1 - py) / 2) * height - 2 * line;
    const overlaps = ([left, top]) => Math.abs(left - x) < 1.2 * line &&
      Math.abs(top - above) < line;
    while (stage.ghosts && placed.some(overlaps)) above -= line;
    placed.push([x, above]);
    context.fillStyle = ground;
    context.fillRect(x - 0.6 * line, above - 0.5 * line, 1.2 * line, line);
    font('700');
    write(String(i + 1), x, above, text, 'center');
  });
}
