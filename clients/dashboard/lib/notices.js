/** Notices at the end of runs, if the user requested them, even while the tab is hidden. */

import { getJson, storing } from './api.js';
import { announce, toggle } from './dom.js';

const KEY = `morphod-notices ${location.pathname}`;
const RETRY_MS = 5000;
const HIDDEN_MS = 1500;
let kept = [];
/** The last message, to which further runs are added while it is shown. */
let notice = '';

/** Returns the ids of the runs. @returns {string[]} */
const wanted = () => storing(() => JSON.parse(localStorage.getItem(KEY))) ?? kept;

/** Adds or removes a run; returns whether it was there. */
function want(id, on) {
  const before = wanted();
  kept = before.filter((one) => one !== id).concat(on ? id : []);
  storing(() => localStorage.setItem(KEY, JSON.stringify(kept)));
  return before.includes(id);
}

/** Shows a notification of the system, if the user has allowed it. */
function notify(text, { id }, link) {
  try {
    if (Notification.permission !== 'granted') return false;
    const shown = new Notification(text, { tag: `${KEY} ${id}` });
    shown.onclick = () => {
      focus();
      location.hash = link;
      shown.close();
    };
    return true;
  } catch { // not available here: phones, pages without TLS
    return false;
  }
}

/** Follows the events of all pages. @param {import('../app.js').app} app */
export function followNotices(app) {
  app.events.isKept = () => wanted().length > 0;
  app.events.wake(); // this tab may be hidden from the start
  addEventListener('storage', ({ key }) => { if (key === KEY) app.events.wake(); });
  app.events.listen(({ type, job }) => {
    if (type === 'reset' || (type === 'job.finished' && wanted().includes(job))) check();
  });

  /** Reports the runs that have ended. */
  function check() {
    return Promise.all(wanted().map(async (id) => {
      const job = await getJson(`v1/jobs/${id}`).catch(({ status }) =>
        ({ state: status === 404 ? 'deleted' : 'unknown' }));
      const { isOver, linkOf, stateOf, titleOf } = await import('./kinds.js');
      if (job.state === 'deleted') want(id, false);
      if (job.state === 'unknown') setTimeout(check, RETRY_MS);
      // A visible tab goes first: without notifications, hidden ones can only change their title.
      if (document.hidden) await new Promise((resolve) => setTimeout(resolve, HIDDEN_MS));
      if (!isOver(job) || !want(id, false)) return;
      const text = `${titleOf(job)}: ${stateOf(job)}`;
      if (notify(text, job, linkOf(job))) return;
      // Keep the title until the user returns, and show the message only then, because it
      // disappears on its own.
      const isHidden = document.hidden;
      notice = notice ? `${notice}; ${text}` : text;
      if (!isHidden) announce(notice);
      app.setNotice(notice);
      const back = new AbortController();
      const seen = () => {
        if (document.hidden) return;
        back.abort();
        if (isHidden && notice) announce(notice);
        notice = '';
        app.setNotice('');
      };
      for (const sign of ['visibilitychange', 'pointermove', 'keydown']) {
        document.addEventListener(sign, seen, { signal: back.signal });
      }
    }));
  }
  return check();
}

/** Returns a button that asks for a notice at the end of a run. */
export function noticeButton(id) {
  return toggle('Notify me', wanted().includes(id), async (on) => {
    want(id, on);
    if (!on) return;
    const answer = await storing(() => (Notification.permission === 'default'
      ? Notification.requestPermission() : Notification.permission));
    announce(answer === 'granted'
      ? 'You will get a notification when this run ends, as long as a dashboard tab is open.'
      : 'Notifications are not available in this browser. When this run ends, the tab\'s title ' +
        'and a message like this one will say so.');
  }, { title: 'Notify me when this run ends, as long as any dashboard tab is open' });
}
