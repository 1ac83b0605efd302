/** Saves what was driven: as a film and other files, as a recording, and the light's path as a
 * task. */

import { withQuery } from '../lib/api.js';
import { button, h } from '../lib/dom.js';
import { commandsOf, pythonOf } from '../lib/commands.js';
import { countOf, shellWord } from '../lib/format.js';
import { requested } from '../lib/rollouts.js';
import { pointsText } from '../lib/tasks.js';
import { toScene } from '../export/scene.js';
import { drivenRobots, pathOf } from '../stage/driven.js';
import { commandSections, exportDialog, save } from './share.js';

/** Suspends the drive, plays it back as a recording, and opens the export dialog. The drive can
 * continue afterwards. */
export function saveDialog(driving) {
  const { player, drive, live, world } = driving;
  const { name } = world;
  const robots = drivenRobots(drive, live);
  driving.suspend(robots);
  const seconds = ((robots[0].frames - 1) * robots[0].frameS).toFixed(1);
  const dialog = exportDialog(player, {
    name: `${name}-driven`,
    more: [
      button('Recording (scene)', () => save(new Blob([toScene(robots, driving.inputs)],
        { type: 'application/vnd.morphod.scene' }), `${name}-driven.scene`)),
    ],
    sections: [h('p', {}, (drive.first ? `This is the last ${seconds} s of the drive. `
      : `You drove for ${seconds} s. `) + 'Driven robots have no score: you moved the light.'),
    taskSection(driving, world)],
  });
  dialog.addEventListener('close', () => driving.resume());
}

/** Returns the path of the light as a task that any robot can be scored on, with each
 * controller. */
function taskSection({ drive, player }, how) {
  const { environment, number, world, set, physics, precision } = how;
  const points = pathOf(drive);
  const task = { guide: { kind: 'path', points_m: points } };
  const request = { ...requested(environment), task };
  delete request.light_xy_m;
  const { robots } = player.stage;
  const nameOf = ({ robot, genotype }) => robot ?? genotype;
  /** @type {string[]} */
  const controllers = [...new Set(robots.map((robot) => robot.controller ?? how.controller))];
  // The world of a job has its physics and its precision; a set has neither.
  const link = withQuery('#/stage', {
    designs: [...new Set(robots.map(nameOf))].join(','), world, set: world ? null : set,
    environment: number, controller: controllers.join() === 'default' ? null : controllers.join(),
    path: pointsText(points),
  });
  const commandsWith = (controller) => {
    const own = robots.filter((robot) => (robot.controller ?? how.controller) === controller);
    const given = {
      ...(controller && controller !== 'default' ? { controller } : {}),
      ...(physics ? { physics } : {}), ...(precision ? { precision } : {}),
    };
    const python = Object.entries(given).map(([key, one]) => `, ${key}=${pythonOf(one)}`).join('');
    const words = ['eval', ...own.map(nameOf), '--environments', '-'];
    if (given.controller) words.push('--controller', given.controller);
    for (const [key, value] of Object.entries(physics ?? {})) {
      words.push('--physics', `${key}=${value}`);
    }
    if (precision) words.push('--precision', precision);
    return commandsOf({
      path: 'v1/evaluations', headers: ['Prefer: wait=30'],
      body: { designs: own.map(({ robot, genotype }) =>
        (robot ? { id: robot } : { voxels: genotype })), environments: [request], ...given },
      input: JSON.stringify([request]), morphoctl: words.map(shellWord).join(' '),
      python: `print(m.evaluate(${pythonOf(own.map(nameOf))}, ${pythonOf([request])}${python})` +
        '.frame())',
    }).map(([tool, text]) => [controllers.length > 1 ? `${tool}, ${controller}` : tool, text]);
  };
  return h('details', {}, h('summary', {}, 'The path of the light as a task'),
    h('div.stack', {},
      h('p', {}, `The path has ${countOf(points.length, 'waypoint')}, on the same terrain. ` +
        'You can score any robot on it, or evolve robots for it. ',
      h('a', { href: link }, 'Watch it on the stage')),
      commandSections([['JSON', JSON.stringify(request.task)],
        .../** @type {[string, string][]} */ (controllers.flatMap(commandsWith))])));
}
