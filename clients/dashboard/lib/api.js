/**
 * Requests to the daemon that served this page. All addresses are relative, so that the page works
 * below any path; the token is only sent in a header.
 */

const TOKEN_KEY = 'morphod-token';

/** The daemon rejected a request, or the connection failed (status 0). */
export class ApiError extends Error {
  constructor(status, problem, retryAfterS) {
    super(problem.detail ?? problem.title ?? `The service replied with status ${status}.`);
    this.status = status;
    /**
     * Faults of the request, each with a JSON pointer.
     * @type {{pointer: string, detail: string}[]}
     */
    this.faults = problem.errors ?? [];
    this.retryAfterS = retryAfterS;
  }
}

/** A link with a missing or invalid target. The page shows only this error. */
export class LinkError extends Error {}

let memoryToken = null;

/**
 * Accesses the browser's storage. If that is forbidden, returns undefined, and values last as long
 * as the page.
 */
export function storing(use) {
  try {
    return use();
  } catch {
    return undefined;
  }
}

/** Decodes a part of an address; returns a malformed part unchanged. */
export function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

/**
 * Removes a token from the address (#token=…), so that it does not stay in the address bar, the
 * history or copied links. Returns the token, or null.
 */
export function tokenOfAddress() {
  const match = /[#&]token=([^&]*)/.exec(location.hash);
  if (!match) return null;
  const rest = location.hash.replace(match[0], '').replace(/^&/, '#');
  history.replaceState(null, '', location.pathname + location.search + (rest || '#/'));
  return decoded(match[1]);
}

export function setToken(token) {
  memoryToken = token;
  storing(() => sessionStorage.setItem(TOKEN_KEY, token));
}

export function getToken() {
  memoryToken ??= storing(() => sessionStorage.getItem(TOKEN_KEY));
  return memoryToken;
}

/** The connection's state, for the banner: true, false, or null before the first reply. */
export const connection = { up: null, listeners: new Set() };

function setConnection(up) {
  if (connection.up === up) return;
  connection.up = up;
  for (const listener of connection.listeners) listener(up);
}

/** Replies that early.js has requested, by path. @type {Map<string, Promise<Response>>} */
const early = (/** @type {any} */ (window).morphodEarly ??= new Map());

/** Drops those that were not used: they become old. */
export const dropEarly = () => early.clear();

/**
 * Sends one request.
 * @param {string} path relative, like "v1/jobs"
 * @param {{method?: string, body?: any, headers?: Object<string, string>, signal?: AbortSignal}}
 *   [options]
 * @returns {Promise<Response>} a reply below 400; throws ApiError
 */
export async function request(path, options = {}) {
  const { method = 'GET', body, headers = {}, signal } = options;
  const all = { ...headers };
  const token = getToken();
  if (token) all.Authorization = `Bearer ${token}`;
  if (body !== undefined) all['Content-Type'] = 'application/json';
  const ready = method === 'GET' ? early.get(path) : undefined;
  early.delete(path);
  let response;
  try {
    response = await (ready ?? fetch(path, {
      method, headers: all, signal, credentials: 'omit', redirect: 'error',
      body: body === undefined ? undefined : JSON.stringify(body),
    }));
  } catch (error) {
    if (signal?.aborted) throw error;
    setConnection(false);
    throw new ApiError(0, { detail: 'The service cannot be reached.' });
  }
  // A proxy's replies for a daemon that is down.
  setConnection(![502, 504].includes(response.status));
  if (response.ok) return response;
  const problem = await response.json().catch(() => ({}));
  throw new ApiError(response.status, problem,
    Number(response.headers.get('Retry-After')) || undefined);
}

export async function getJson(path, options) {
  return (await request(path, options)).json();
}

export async function post(path, body, options = {}) {
  const response = await request(path, { method: 'POST', body, ...options });
  return response.status === 204 ? null : response.json();
}

/** Waits as long as Retry-After says and retries, at most `limit` times. */
export async function patient(send, limit = 5) {
  for (let i = 0; ; i++) {
    try {
      return await send();
    } catch (error) {
      const again = error instanceof ApiError && [429, 503].includes(error.status);
      if (!again || i >= limit) throw error;
      const waitMs = 1000 * Math.min(error.retryAfterS ?? 1, 10);
      await new Promise((resolve) => setTimeout(resolve, waitMs));
    }
  }
}

/** Returns a path with a query, without parameters that are undefined, null or ''. */
export function withQuery(path, parameters) {
  const query = new URLSearchParams(
    Object.entries(parameters)
      .filter(([, value]) => value !== undefined && value !== null && value !== ''),
  ).toString();
  return query ? `${path}?${query}` : path;
}

/**
 * Reads a list that comes in pages.
 * @param {function(string): Promise<any>} get
 * @param {string} path
 * @param {Object<string, any>} [parameters]
 * @param {number} [most] ends after the page with this item
 */
export async function listOf(get, path, parameters, most = Infinity) {
  const items = [];
  let cursor;
  do {
    const page = await get(withQuery(path, { ...parameters, limit: 1000, cursor }));
    items.push(...page.items);
    cursor = page.next_cursor;
  } while (cursor !== null && items.length < most);
  return items;
}

/** Wraps an async function so that concurrent calls share one run. */
export function shared(work) {
  let busy = null;
  return (...given) => (busy ??= work(...given).finally(() => { busy = null; }));
}

/**
 * A growing curve that keeps its rows and fetches new ones. The number of the newest row is the
 * cursor of the next page.
 */
export class Curve {
  constructor(path) {
    this.path = path;
    this.rows = [];
    this.cursor = undefined;
    /** Fetches new rows; returns true if there were any. */
    this.refresh = shared((signal) => this.#refresh(signal));
  }

  async #refresh(signal) {
    const before = this.rows.length;
    for (;;) {
      const page = await getJson(withQuery(this.path, { cursor: this.cursor, limit: 1000 }),
        { signal });
      this.rows.push(...page.items);
      const last = page.items.at(-1);
      if (last) this.cursor = last.step ?? last.generation;
      if (page.next_cursor === null || !page.items.length) return this.rows.length > before;
    }
  }
}
