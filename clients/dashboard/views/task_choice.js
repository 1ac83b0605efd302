/** The choice of a task in a form. */

import { h } from '../lib/dom.js';
import { taskPicture } from '../lib/tasks.js';

/** The choice of a task, by a picture and a sentence. */
export class TaskChoice {
  constructor(tasks, onChange) {
    this.chosen = tasks[0];
    this.element = h('fieldset.tasks.wide', {}, h('legend', {}, 'Task'), tasks.map((task) =>
      h('label.task', {}, h('input', {
        type: 'radio', name: 'task', value: task.name, checked: task === this.chosen,
        onchange: () => {
          this.chosen = task;
          onChange();
        },
      }), taskPicture(task), h('strong', {}, task.title), h('span.muted', {}, task.about))));
  }

  get environments() {
    return this.chosen.environments;
  }

  /** How many environments these are; undefined: the default set. */
  get count() {
    return this.chosen.count ?? this.chosen.environments?.length;
  }
}
