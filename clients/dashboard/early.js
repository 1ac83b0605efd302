/**
 * Starts to load the modules of the view in the address (index.html lists them), and the replies of
 * the service that it shows first, while the modules of the frame are still loading.
 */

(() => {
  /** @type {any} */
  const page = window;
  const [path, query] = location.hash.replace(/^#\/?/, '').split('?');
  const [view = 'home', id, ...rest] = path.split('/').filter(Boolean);

  /** Returns what the view requests first. */
  function firstOf() {
    const parameters = new URLSearchParams(query);
    const set = encodeURIComponent(parameters.get('set') ?? 'paper-test');
    const environments = `v1/environment-sets/${set}`;
    const best = 'v1/designs?sort=score&limit=4';
    if (view === 'campaigns' && /^\d+$/.test(id) && !rest.length) {
      return ['', '/champions', '/environments'].map((part) => `v1/campaigns/${id}${part}`);
    }
    if (view === 'stage' && !parameters.has('world') && !parameters.has('evaluation')) {
      return parameters.get('designs') ? [environments] : [environments, best];
    }
    if (parameters.has('task') || sessionStorage.getItem('morphod-task')) return [];
    return view === 'home' ? [environments, best] : view === 'lab' ? [environments] : [];
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
    await newest;
    firstOf().forEach(send);
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
