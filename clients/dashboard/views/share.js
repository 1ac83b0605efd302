/** Dialogs with commands to copy, and pictures and films to save. */

import { announce, button, h } from '../lib/dom.js';
import { ApiError, request } from '../lib/api.js';
import { commandsOf } from '../lib/commands.js';
import { requested } from '../lib/rollouts.js';
import { percent, shellWord } from '../lib/format.js';

/** Returns why something failed, with the page's name for a field of the request. */
const reasonOf = ({ message }) => message.replace(/^\/(\w)/, (_, first) => first.toUpperCase());

/** Performs an action, and announces success or the reason for a failure; returns true on
 * success. */
export async function announced(work, done = '') {
  try {
    await work();
    if (done) announce(done);
    return true;
  } catch (error) {
    announce(reasonOf(error), { isRefusal: true });
    if (!(error instanceof ApiError)) console.error(error);
    return false;
  }
}

/** Opens a dialog that is removed when it is closed. */
function open(title, attributes, ...children) {
  const dialog = h('dialog', { 'aria-label': title, ...attributes }, children);
  dialog.addEventListener('close', () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  return dialog;
}

/** Shows a dialog with a title. */
export function showDialog(title, ...children) {
  const dialog = open(title, {}, h('div.stack', {}, h('h2', {}, title), ...children,
    h('div.row.ends', {}, button('Close', () => dialog.close()))));
  return dialog;
}

/**
 * Opens a dialog with a form that performs an action and closes. Enter submits it, the browser
 * checks the bounds of its fields, and the dialog shows errors.
 * @param {string} title
 * @param {string} action text of the button
 * @param {() => any} work
 * @param {...any} children fields; those of class wide fill a row
 */
export function formDialog(title, action, work, ...children) {
  const fault = h('p.error.wide', { role: 'alert' });
  const submit = async (event) => {
    event.preventDefault();
    fault.textContent = '';
    try {
      await work();
      dialog.close();
    } catch (error) {
      fault.textContent = reasonOf(error);
    }
  };
  const dialog = open(title, {}, h('form', { onsubmit: submit }, h('h2.wide', {}, title),
    ...children, fault, h('div.row.ends.wide', {}, button('Cancel', () => dialog.close()),
      h('button.primary', { type: 'submit' }, action))));
  return dialog;
}

/** Asks for confirmation; returns true if confirmed. */
export function confirmDialog(title, text, action) {
  return new Promise((resolve) => {
    const keep = button('Keep', () => dialog.close('no'));
    const dialog = open(title, {
      role: 'alertdialog', onclose: () => resolve(dialog.returnValue === 'yes'),
    }, h('div.stack', {}, h('h2', {}, title), h('p', {}, text), h('div.row.ends', {}, keep,
      button(action, () => dialog.close('yes'), { class: 'danger' }))));
    keep.focus();
  });
}

/**
 * Returns a button that shows how to do the same from a shell or a program.
 * @param {function(): any} request as for commandsOf
 */
export function copyButton(request) {
  return button('Commands', () => copyDialog(commandsOf(request())),
    { title: 'The same with curl, morphoctl or Python' });
}

/** Shows commands that do the same from a shell. @param {[string, string][]} commands tool and
 * text */
export function copyDialog(commands) {
  showDialog('The same from a shell or a program', ...commandSections(commands));
}

/** Returns texts to copy. @param {[string, string][]} commands tool and text */
export const commandSections = (commands) => commands.map(([tool, text]) => h('section.stack', {},
  h('div.row', {}, h('h3', {}, tool), button('Copy', async (event) => {
    try {
      await navigator.clipboard.writeText(text);
      event.target.textContent = 'Copied';
    } catch {
      event.target.textContent = 'Not allowed: select the text';
    }
  })), h('pre', { tabindex: 0 }, text)));

/**
 * Returns the arguments of morphoctl that make a film of what the stage shows, and its standard
 * input: environments without a name.
 */
export function filmOf(ids, { world, environment, controller, output }) {
  const words = ['film', ...ids, '--environments', world.set ?? '-'];
  if (world.set) words.push('--environment', String(environment));
  for (const [key, value] of Object.entries(world.physics ?? {})) {
    words.push('--physics', `${key}=${value}`);
  }
  if (controller !== 'default') words.push('--controller', controller);
  return {
    words: [...words, '--output', output].map(shellWord).join(' '),
    input: world.set ? '' : JSON.stringify([requested(world.environments[environment])]),
  };
}

/** Returns the command that makes a film of what the stage shows. */
export function filmCommand(ids, how) {
  const { words, input } = filmOf(ids, how);
  return `${input && `echo ${shellWord(input)} | `}morphoctl ${words}`;
}

/**
 * Returns a link that saves a reply of the service. It sends the token, which a plain link would
 * not.
 */
export function saveLink(path, name, text, attributes = {}) {
  return h('a', { href: path, download: name, ...attributes, onclick: (event) => {
    event.preventDefault();
    announced(async () => save(await (await request(path)).blob(), name));
  } }, text);
}

/** Saves a file. */
export function save(blob, name) {
  const link = h('a', { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

/** Saves a text as a file. */
export const saveText = (text, name) => save(new Blob([text], { type: 'application/json' }), name);

/**
 * Saves what the stage shows: a picture, a film, a separate page, or a model for other programs.
 * @param {import('../stage/player.js').Player} player
 * @param {{name: string, film?: string, more?: any[], sections?: any[]}} what name of the files;
 *   film: the command that makes the film; more: further buttons; sections: what follows them
 */
export function exportDialog(player, { name, film: command, more = [], sections = [] }) {
  const { stage, canvas } = player;
  const message = h('p', { role: 'status' });
  const doing = (text, work) => button(text, async (event) => {
    event.target.disabled = true;
    message.textContent = '';
    try {
      await work();
    } catch (error) {
      message.textContent = error.message;
    }
    event.target.disabled = false;
  });

  async function film() {
    const { filmOf } = await import('../export/film.js');
    save(await filmOf(player, (share) => { message.textContent = `Film: ${percent(share)}`; }),
      `${name}.webm`);
    message.textContent = '';
  }

  async function model() {
    const { toGlb } = await import('../export/glb.js');
    for (const robot of stage.robots) {
      save(new Blob([toGlb(robot, { name: robot.label })], { type: 'model/gltf-binary' }),
        `${name}-${robot.label}.glb`);
    }
  }

  async function page() {
    const { toPage } = await import('../export/page.js');
    save(await toPage(stage.robots,
      `Robots: ${stage.robots.map((robot) => robot.label).join(', ')}`,
      Boolean(stage.lanes()), stage.ghosts), `${name}.html`);
  }

  return showDialog('Export', h('div.row', {},
    doing('Picture (PNG)', async () => {
      const blob = await player.inFull(() => {
        stage.draw();
        return new Promise((resolve) => { canvas.toBlob(resolve); });
      });
      save(blob, `${name}.png`);
    }),
    'VideoEncoder' in window ? doing('Film (WebM)', film) : null,
    doing('Page (HTML)', page), doing('Model (GLB)', model), ...more), message, ...sections,
  command ? [h('p', {}, `A film${stage.robots.length > 1 ? ', side by side' : ''}, on the ` +
    'machine that has morphoctl:'),
    h('pre', { tabindex: 0 }, command)] : null);
}
