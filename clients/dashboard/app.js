/** The dashboard: its frame, its routes, and what all views share. */

import {
  ApiError, LinkError, connection, decoded, dropEarly, getJson, getToken, setToken, storing,
  tokenOfAddress,
} from './lib/api.js';
import { announce, button, fill, h, svg } from './lib/dom.js';
import { Events, isNews } from './lib/events.js';
import { followNotices } from './lib/notices.js';
import { callerName, whoAmI, whyNot } from './lib/rights.js';
import { TASKS, taskOf } from './lib/tasks.js';
import { tray } from './lib/tray.js';

/** The views; under: the entry in the bar to mark for a view without its own entry; hasTask: its
 * scores are for the task in the bar. */
const VIEWS = {
  home: { name: 'Home', module: './views/home.js', title: 'Home', hasTask: true },
  overview: { name: 'Service', module: './views/overview.js' },
  runs: { name: 'Runs', module: './views/runs.js' },
  campaigns: { name: 'Campaign', module: './views/campaign.js', under: 'runs' },
  trainings: { name: 'Training run', module: './views/training.js', under: 'runs' },
  evaluations: { name: 'Evaluation', module: './views/evaluation.js', under: 'runs' },
  certificates: { name: 'Certificate', module: './views/certificate.js', under: 'runs' },
  designs: { name: 'Designs', module: './views/designs.js', hasTask: true },
  controllers: { name: 'Controllers', module: './views/controllers.js' },
  lab: { name: 'Lab', module: './views/lab.js', hasTask: true },
  atlas: { name: 'Atlas', module: './views/atlas.js' },
  stage: { name: 'Stage', module: './views/stage.js' },
  machines: { name: 'Machines', module: './views/machines.js' },
  compare: { name: 'Compare robots', module: './views/compare.js', under: 'designs' },
};

/**
 * Returns what an address names: a view, the rest of the path, and the parameters. Lists of one
 * kind of jobs are the runs of that kind. Links of earlier versions lead to the same pages.
 */
function placeOf() {
  const [path, query] = location.hash.replace(/^#\/?/, '').split('?');
  const [key, ...rest] = path.split('/').map(decoded).filter(Boolean);
  const parameters = new URLSearchParams(query);
  const name = key ?? 'home';
  let other = '';
  if (VIEWS[name]?.under === 'runs' && !rest.length) {
    if (!parameters.has('kind')) parameters.set('kind', name.slice(0, -1));
    other = `runs?${parameters}`;
  } else if (name === 'designs' && !rest.length && parameters.get('evaluation')) {
    other = `evaluations/${encodeURIComponent(parameters.get('evaluation'))}`;
  } else if (name === 'certificate') {
    other = `certificates/${rest}`;
  } else if (name === 'editor') {
    other = `lab${query ? `?${query}` : ''}`;
  } else if (name === 'overview' && query) { // earlier versions had a list with filters there
    const label = parameters.get('label');
    if (label) parameters.set('search', label);
    parameters.delete('label');
    other = `runs?${parameters}`;
  }
  if (!other) return { name, rest, parameters };
  history.replaceState(history.state, '', `#/${other}`);
  return placeOf();
}

/** Loads a view and all its imports at once; index.html has the list. */
function load(key, module) {
  /** @type {HTMLMetaElement} */
  const names = document.querySelector(`meta[data-view="${key}"]`);
  for (const name of names?.content.split(' ') ?? []) {
    const { href } = new URL(`${name}.js`, import.meta.url);
    document.head.append(h('link', { rel: 'modulepreload', href }));
  }
  return import(module).catch(async () => {
    await getJson('healthz'); // if the service is down, this fails with the reason
    throw new ApiError(404, {
      detail: 'The service has a newer version of this page: reload it.',
    });
  });
}

/** Storage key of the task, while the tab is open. */
const TASK_KEY = 'morphod-task';

/** Functions and state of the page that views use. */
export const app = {
  events: new Events(),
  /** @type {'dark'|'light'} */
  theme: 'dark',
  /** The task of the scores on the pages that have one. */
  task: taskOf(storing(() => sessionStorage.getItem(TASK_KEY))) ?? TASKS[0],
  /** The newest notable events, oldest first. */
  recent: [],
  /** Whether events from before this page have been loaded. */
  knowsRecent: false,
  /** Called with the theme after each change. */
  themeListeners: new Set(),
  /** Returns the contract: bounds and defaults of the forms. It is loaded once, when first
   * needed. */
  contract() {
    this.contractLoad ??= getJson('openapi.json');
    return this.contractLoad;
  },
  /** Goes to a view: go('stage', {designs: '…'}). */
  go(path, parameters = {}) {
    const query = new URLSearchParams(parameters).toString();
    location.hash = `#/${path}${query ? `?${query}` : ''}`;
  },
  /** Changes the parameters of the current view's link without leaving the view. */
  keep(parameters) {
    const [path, query] = location.hash.slice(2).split('?');
    const all = new URLSearchParams(query);
    for (const [key, value] of Object.entries(parameters)) {
      if (value === null || value === undefined || value === '') all.delete(key);
      else all.set(key, value);
    }
    const text = all.toString();
    history.replaceState(history.state, '', `#/${path}${text ? `?${text}` : ''}`);
  },
  /** Returns the state that the view saved with this history entry; {} for a new entry. */
  remembered() {
    return history.state ?? {};
  },
  /** Saves state for a return to this history entry. */
  remember(things) {
    history.replaceState({ ...history.state, ...things }, '');
  },
  /** Sets the title of the tab, which the history and bookmarks show. */
  setTitle(text) {
    this.title = text;
    document.title = `${this.notice ?? ''}${text} · morphod`;
  },
  /** Puts a notice before the title; '' removes it. */
  setNotice(text) {
    this.notice = text && `${text} – `;
    this.setTitle(this.title);
  },
};

/** Chooses the task: for the tab, and in the link. */
function setTask(task) {
  app.task = task;
  storing(() => sessionStorage.setItem(TASK_KEY, task.name));
  app.keep({ task: task === TASKS[0] ? null : task.name });
}

/** The scroll position is saved after this pause, because browsers limit how often it may be
 * saved. */
const SCROLL_MS = 150;
const THEME_KEY = 'morphod-theme';

function setTheme(theme) {
  app.theme = theme;
  document.documentElement.dataset.theme = theme;
  for (const listener of app.themeListeners) listener(theme);
}

function startTheme() {
  const system = matchMedia('(prefers-color-scheme: light)');
  let chosen = storing(() => localStorage.getItem(THEME_KEY));
  setTheme(chosen ?? (system.matches ? 'light' : 'dark'));
  system.addEventListener('change', () => {
    if (!chosen) setTheme(system.matches ? 'light' : 'dark');
  });
  return (theme) => {
    chosen = theme;
    storing(() => localStorage.setItem(THEME_KEY, theme));
    setTheme(theme);
  };
}

function brand() {
  const link = { href: '#/', 'aria-label': 'morphod: home' };
  return h('a.brand', link, svg('svg', { viewBox: '4 2 26 27', 'aria-hidden': 'true' },
    svg('path', { fill: '#ffd089', d: 'M16 4l9 5-9 5-9-5z' }),
    svg('path', { fill: '#f3a536', d: 'M7 9l9 5v11l-9-5z' }),
    svg('path', { fill: '#c97d14', d: 'M25 9l-9 5v11l9-5z' })), 'morphod');
}

/**
 * Asks for a token, in one dialog, until the service accepts one, then calls `retry`. If the dialog
 * is closed, a button on the page opens it again.
 */
function askForToken(retry) {
  const input = h('input', {
    type: 'password', autocomplete: 'off', required: true, 'aria-label': 'Token',
  });
  const fault = h('p.error.wide', { role: 'alert' },
    getToken() ? "The service does not accept this tab's token." : '');
  async function submit(event) {
    event.preventDefault();
    setToken(input.value.trim());
    try {
      await whoAmI();
      dialog.close();
      retry();
    } catch (error) {
      fault.textContent = error.status === 401
        ? 'The service does not accept this token. Check that all of it was copied.'
        : error.message;
      input.select();
    }
  }
  const dialog = h('dialog', { 'aria-label': 'Token', onclose: () => dialog.remove() },
    h('form', { onsubmit: submit }, h('h2.wide', {}, 'This service asks for a token'),
      h('p.wide', {}, 'The command ', h('code', {}, 'morphoctl dashboard'),
        ' opens the page with it. It is kept until this tab is closed.'),
      h('label.field.wide', {}, h('span', {}, 'Token'), input), fault,
      h('div.row.ends.wide', {}, button('Cancel', () => dialog.close()),
        h('button.primary', { type: 'submit' }, 'Continue'))));
  document.body.append(dialog);
  dialog.showModal();
}

/** Returns whether the page's token is still valid, as far as is known. */
async function works() {
  try {
    return Boolean((await whoAmI()).name);
  } catch (error) {
    return error.status !== 401;
  }
}

/** Uses the token of a link. Asks before it replaces a token that still works. */
async function takeToken() {
  const token = tokenOfAddress();
  const before = getToken();
  if (!token || token === before) return;
  if (before && await works()) {
    const { confirmDialog } = await import('./views/share.js');
    const sure = await confirmDialog('Use the token of this link?',
      `This page has a token${callerName() && `, ${callerName()}`}. The link has a different one.`,
      'Use the other token');
    if (!sure) return;
  }
  setToken(token);
}

const HOME = () => h('p', {}, h('a', { href: '#/' }, 'Go to the home page'));

class Frame {
  constructor(chooseTheme) {
    this.links = Object.entries(VIEWS).filter(([, { under }]) => !under).map(([key, view]) =>
      [key, key === 'home' ? brand() : h('a', { href: `#/${key}` }, view.name)]);
    const [[, home], ...others] = this.links;
    this.banner = h('div.banner', { role: 'status', hidden: true });
    this.main = h('main', { id: 'main', tabindex: -1 });
    const theme = button('', () => chooseTheme(app.theme === 'dark' ? 'light' : 'dark'));
    const nameTheme = () => {
      theme.textContent = app.theme === 'dark' ? 'Light theme' : 'Dark theme';
    };
    app.themeListeners.add(nameTheme);
    nameTheme();
    this.taskButton = h('button', { type: 'button', popovertarget: 'tasks' });
    const tasks = h('div.panel', { id: 'tasks', popover: true, role: 'group', 'aria-label': 'Task',
      onbeforetoggle: async ({ newState }) => {
        if (newState !== 'open') return;
        const { fillTasks } = await import('./views/task_choice.js');
        fillTasks(tasks, app, (task) => {
          this.#setTask(task);
          if (this.view?.turnTask) this.view.turnTask();
          else this.route();
        });
      } });
    this.taskField = h('span', {}, this.taskButton, tasks);
    this.caller = h('span.muted.caller');
    this.note = h('div.note', { role: 'note', hidden: true });
    fill(document.getElementById('frame'), h('header.bar', {}, home,
      h('nav', { 'aria-label': 'Views' }, others.map(([, link]) => link)),
      h('div.side', {}, this.caller, theme)), this.banner, this.note, this.main);
    connection.listeners.add((up) => this.#tell(up));
    document.getElementById('skip').addEventListener('click', (event) => {
      event.preventDefault();
      this.main.focus();
    });
    this.view = null;
    this.onTray = () => this.showTray();
    tray.listeners.add(this.onTray);
    history.scrollRestoration = 'manual'; // the page gets its content after the browser would have
                                          // scrolled
    addEventListener('scroll', () => {
      clearTimeout(this.scrolled);
      const { hash } = location;
      // When the user goes back, the entry changes before the event is sent.
      if (this.view) this.scrolled = setTimeout(() => {
        if (location.hash === hash) app.remember({ scrollY });
      }, SCROLL_MS);
    }, { passive: true });
    document.querySelector('#toast button').addEventListener('click', () => announce(''));
  }

  #tell(up) {
    this.banner.hidden = up;
    if (up) {
      if (this.wasDown && this.view) this.view.update?.({ type: 'reset' });
      else if (this.wasDown) this.start(); // it failed to load, or had only just started loading
      this.wasDown = false;
      clearInterval(this.probe);
      return;
    }
    this.wasDown = true;
    this.banner.textContent = 'The service cannot be reached. This page may be out of date; ' +
      'retrying automatically.';
    clearInterval(this.probe);
    this.probe = setInterval(() => getJson('healthz').catch(() => {}), 1500);
  }

  /** Shows the view that the address names. isMove: the user came from a different view. */
  async route({ isMove = false } = {}) {
    const { name, rest, parameters } = placeOf();
    const entry = Object.hasOwn(VIEWS, name) ? VIEWS[name] : null;
    if (isMove && name === this.shown && this.view?.turnTo?.(rest, parameters)) return;
    this.shown = name;
    this.view?.unmount?.();
    this.view = null;
    clearTimeout(this.scrolled);
    document.querySelectorAll('dialog').forEach((dialog) => dialog.close());
    if (isMove) announce('');
    this.main.classList.toggle('full', name === 'stage');
    for (const [other, link] of this.links) {
      if (other !== (entry?.under ?? name)) {
        link.removeAttribute('aria-current');
        continue;
      }
      link.setAttribute('aria-current', 'page');
      // Later, because scrolling now would lay out the page once more.
      requestAnimationFrame(() => link.scrollIntoView({ block: 'nearest', inline: 'nearest' }));
    }
    if (!entry) {
      this.#offerTasks(false);
      this.#say('Page not found', HOME());
      if (isMove) this.#arrive();
      return;
    }
    const turn = (this.turn = (this.turn ?? 0) + 1);
    fill(this.main, h('p.muted', { role: 'status' }, 'Loading…'));
    const hasTask = entry.hasTask && !rest.length;
    this.#offerTasks(hasTask);
    try {
      if (hasTask) this.#takeTask(parameters.get('task'));
      const [{ mount }] = await Promise.all([load(name, entry.module), this.#followEvents(),
        this.#identify()]);
      if (turn !== this.turn) return;
      const { last } = app.events;
      const { scrollY: place = 0 } = app.remembered();
      app.setTitle(entry.name);
      const view = await mount(this.main, rest, parameters, app);
      if (turn !== this.turn) {
        view?.unmount?.();
        return;
      }
      this.view = view ?? {};
      if (!entry.title && app.title === entry.name) {
        app.setTitle(this.main.querySelector('h1')?.textContent ?? entry.name);
      }
      scrollTo(0, place);
      if (!this.bar) this.showTray();
      if (isMove) this.#arrive();
      // The view may not show what happened while it loaded.
      if (app.events.last !== last) view?.update?.({ type: 'reset' });
    } catch (error) {
      if (turn !== this.turn) return;
      const again = button('Try again', () => this.route());
      const what = h('p.error', { role: 'alert' }, error.message);
      if (error.status === 401) {
        const ask = () => askForToken(() => this.start());
        this.#say('This service asks for a token', h('p', {}, button('Enter a token', ask)));
        ask();
      } else if (error instanceof LinkError) {
        this.#say('This link cannot be shown', what, HOME());
      } else {
        this.#say(error.status === 404 ? 'Not found' : 'This page could not be shown', what,
          h('p', {}, again), HOME());
      }
      if (isMove) this.#arrive();
      if (error.status === undefined && !(error instanceof LinkError)) {
        console.error(error);
      }
    } finally {
      dropEarly();
      this.#stream();
    }
  }

  /** Shows the task menu on pages whose scores depend on the task. */
  #offerTasks(on) {
    if (!on) this.taskField.remove();
    else if (!this.taskField.isConnected) this.caller.after(this.taskField); // otherwise it keeps
                                                                             // the focus
  }

  /** Uses the task of a link; a link without one has the task of this tab from now on. */
  #takeTask(name) {
    const task = name === null ? app.task : taskOf(name);
    if (!task) {
      throw new LinkError(`task=${name.slice(0, 60)} is invalid; use one of ` +
        `${TASKS.map((one) => one.name).join(', ')}, or drawn:x_y,x_y with 1 to 16 waypoints.`);
    }
    this.#setTask(task);
  }

  #setTask(task) {
    setTask(task);
    this.taskButton.textContent = `Task: ${task.title}`;
  }

  /** Shows a heading with a few words instead of a view. */
  #say(title, ...children) {
    app.setTitle(title);
    this.main.classList.remove('full');
    fill(this.main, h('h1', {}, title), children);
  }

  /** Focuses the heading of a new view, so that screen readers read it. */
  #arrive() {
    const heading = this.main.querySelector('h1');
    heading?.setAttribute('tabindex', '-1');
    // A field may have the focus already, if the view was shown before all of it had loaded.
    if (!this.main.contains(document.activeElement)) heading?.focus({ preventScroll: true });
  }

  /** Records the newest event, once. Views load after that, so that they miss no change. */
  #followEvents() {
    this.following ??= app.events.start().then((last) => { this.since = last; },
      () => { this.following = null; });
    return this.following;
  }

  /** Starts to stream the events after that one, once. The first view sends its requests before
   * that. */
  #stream() {
    const { since } = this;
    if (since === undefined || this.isStreaming) return;
    this.isStreaming = true;
    followNotices(app);
    app.events.upTo(since).then((events) => {
      app.recent.unshift(...events);
      app.knowsRecent = true;
      this.view?.update?.({ type: 'recent' });
    }, () => {});
  }

  /** Asks the service once who the caller is, and states what the page omits. */
  #identify() {
    this.identified ??= whoAmI().then(() => {
      this.caller.textContent = callerName();
      this.note.textContent = whyNot();
      this.note.hidden = !this.note.textContent;
      this.bar?.update();
    }, () => { this.identified = null; }); // the view reports the error
    return this.identified;
  }

  /** Adds the bar of the tray, once the tray has a robot. */
  async showTray() {
    if (!tray.kept.length || this.bar === null) return;
    tray.listeners.delete(this.onTray);
    this.bar = null; // it is loading
    try {
      const { trayBar } = await import('./views/tray.js');
      this.bar = trayBar(app, () => this.view);
      document.getElementById('frame').append(this.bar);
    } catch {
      this.bar = undefined;
      tray.listeners.add(this.onTray); // the next robot tries again
    }
  }

  /** Starts over with a new token, or when the service is back. */
  start() {
    this.identified = null;
    return this.route();
  }
}

const frame = new Frame(startTheme());
app.events.listen((event) => {
  if (isNews(event)) app.recent = [...app.recent, event].slice(-60);
  frame.view?.update?.(event);
});
/** Keys of all pages. A question mark that is typed into a field is only text. */
addEventListener('keydown', (event) => {
  const { key, ctrlKey, metaKey, altKey, target } = event;
  const isJump = key.toLowerCase() === 'k' && (ctrlKey || metaKey) && !altKey;
  const isTyped = /** @type {Element} */ (target).closest?.('input, textarea, select');
  if (!isJump && (key !== '?' || ctrlKey || metaKey || altKey || isTyped)) return;
  event.preventDefault();
  if (document.querySelector('dialog[open]')) return;
  import('./views/jump.js').then(({ jump, showKeys }) => {
    const pages = Object.entries(VIEWS).filter(([, { under }]) => !under)
      .map(([path, { name }]) => ({ name, href: `#/${path === 'home' ? '' : path}` }));
    if (isJump) jump(pages);
    else showKeys();
  }, () => {}); // the banner says that the service is down
});
const begin = () => takeToken().then(() => frame.start());
window.addEventListener('hashchange', () => {
  if (/[#&]token=/.test(location.hash)) begin();
  else frame.route({ isMove: true });
});
begin();
