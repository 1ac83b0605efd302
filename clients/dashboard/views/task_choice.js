/** The choice of a task, in a form and in the bar. */

import { fill, h } from '../lib/dom.js';
import { taskPicture } from '../lib/task_picture.js';
import { TASKS, drawnTask, scoreWords } from '../lib/tasks.js';

/** Cards of tasks: a picture, what the robot is to do, and what the score means. */
export class TaskChoice {
  /**
   * @param {any[]} tasks
   * @param {function(): void} onChange
   * @param {any} chosen
   * @param {string} kind of the job
   */
  constructor(tasks, onChange, chosen = tasks[0], kind = '') {
    this.chosen = chosen;
    this.kind = kind;
    this.element = h('fieldset.tasks.wide', {}, h('legend', {}, 'Task'), tasks.map((task) => {
      const shown = task.shown ?? task.environments;
      return h('label.task', {}, h('input', {
        type: 'radio', name: 'task', value: task.name, checked: task === this.chosen,
        onchange: () => {
          this.chosen = task;
          onChange();
        },
      }), taskPicture(shown), h('strong', {}, task.title),
      h('span.muted', {}, `${task.about}. ` +
        `${this.#isRandom(task) ? 'Ground: random terrains. ' : ''}${scoreWords(shown, kind)}.`));
    }));
  }

  /** Returns whether the terrain is random: training runs learn on random terrains, except for
   * tasks that need their own ground. */
  #isRandom({ name }) {
    return this.kind === 'training' && name !== 'climb';
  }

  /** The member of a request that selects the task. */
  get request() {
    const { environments } = this.chosen;
    return this.#isRandom(this.chosen) && environments ? { tasks: [environments[0].task] }
      : { environments };
  }

  /** The number of these environments; undefined: the default set. */
  get count() {
    return this.chosen.count ?? this.chosen.environments?.length;
  }
}

/** The path that was drawn last: it stays when another task is chosen. */
let points = [];

/**
 * Fills the menu of the bar: cards, and a path to draw.
 * @param {any} element a popover
 * @param {import('../app.js').app} app
 * @param {function(any): void} choose gets the task
 */
export function fillTasks(element, app, choose) {
  const { task } = app;
  points = task.points ?? points;
  const own = { ...drawnTask(points.length ? points : [[3.1, 2.9], [3.6, 2.4], [4.2, 3]]),
    name: 'draw', title: 'Draw one', about: 'Draw a path on the ground' };
  const ground = h('div');
  const draw = async () => {
    const { pathPad } = await import('./draw_path.js');
    if (choice.chosen !== own) return;
    fill(ground, pathPad(app, points, (all) => {
      points = all;
      choose(drawnTask(points));
    }));
  };
  const choice = new TaskChoice([...TASKS, own], () => {
    fill(ground);
    if (choice.chosen !== own) {
      choose(choice.chosen);
      return;
    }
    if (points.length) choose(drawnTask(points));
    draw();
  }, task.points ? own : task);
  // A click chooses and closes the menu; keys move from card to card.
  choice.element.addEventListener('click', ({ detail, target }) => {
    if (detail && target.closest('label:not(:last-child)')) element.hidePopover();
  });
  fill(element, ground, choice.element);
  if (task.points) draw();
}
