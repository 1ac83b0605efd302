/**
 * Starts to load the modules of the view in the address (index.html lists them), and the replies of
 * the service that it shows first, while the modules of the frame are still loading.
 */

(() => {
  /** @type {any} */
  const page = window;
  const [path, query] = location.hash.replace(/^#\/?/, '').split('?');
  const view = path.split('/')[0] || 'home';

  /** Returns what the view requests first, if it is one of the usual addresses. */
  function firstOf() {
    const campaign = /^campaigns\/\d+$/.exec(path)?.[0];
    if (campaign) return [`v1/${campaign}`, `v1/${campaign}/environments`];
    const parameters = new URLSearchParams(query);
    const isUsual = ['world', 'set', 'evaluation', 'task'].every((name) => !parameters.has(name));
    const isOfTask = view === 'home' && /^(photo)?$/.test(sessionStorage['morphod-task'] ?? '');
    if (!isUsual || !(isOfTask || view === 'stage')) return [];
    return ['v1/environment-sets/paper-test',
      ...(parameters.has('designs') ? [] : ['v1/designs?sort=score&limit=4'])];
  }

  /** Sends the first requests; lib/api.js uses each reply once. */
  async function request() {
    /** @type {Object<string, string>} */
    const headers = {};
    const token = sessionStorage.getItem('morphod-token'); // throws if the browser forbids storage
    if (token) headers.Authorization = `Bearer ${token}`;
    const early = page.morphodEarly = new Map();
    const send = (url) => {
      const reply = fetch(url, { headers, credentials: 'omit', redirect: 'error' });
      reply.catch(() => {}); // reported where it is used
      early.set(url, reply);
      return reply;
    };
    const newest = send('v1/events?format=json&after=0&limit=1');
    send('v1/whoami');
    // An older reply could lack a change that no event will announce.
    if ((await newest).ok) firstOf().forEach(send);
  }

  // Not if the address has a token, or if the frame was faster.
  if (!/[#&]token=/.test(location.hash) && !page.morphodEarly) request().catch(() => {});
  /** @type {HTMLMetaElement} */
  const names = document.querySelector(`meta[data-view="${CSS.escape(view)}"]`);
  const folder = new URL('.', /** @type {HTMLScriptElement} */ (document.currentScript).src);
  for (const name of names?.content.split(' ') ?? []) {
    const link = document.createElement('link');
    const { href } = new URL(`${name}.js`, folder);
    document.head.append(Object.assign(link, { rel: 'modulepreload', href }));
  }
})();
