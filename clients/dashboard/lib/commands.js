/** Equivalent commands for a shell or a program: what a page shows or a form sends, as text. */

import { getToken } from './api.js';
import { shellWord } from './format.js';

const DEFAULT_SERVER = 'http://127.0.0.1:8765';

const address = (path = '') => new URL(path, document.baseURI).href;
const server = () => address('.').replace(/\/$/, '');

/** Returns a value as Python writes it. */
export function pythonOf(value) {
  if (value === null || value === undefined) return 'None';
  if (typeof value === 'boolean') return value ? 'True' : 'False';
  if (Array.isArray(value)) return `[${value.map(pythonOf).join(', ')}]`;
  if (typeof value === 'object') {
    const items = Object.entries(value)
      .map(([key, one]) => `${JSON.stringify(key)}: ${pythonOf(one)}`);
    return `{${items.join(', ')}}`;
  }
  return JSON.stringify(value);
}

/**
 * Returns curl, morphoctl and Python commands for one request.
 * @param {{path: string, body?: any, headers?: string[], output?: string, morphoctl: string|null,
 *          python?: string, input?: string}} request
 *   path: relative, like "v1/jobs"; body: sent by POST; morphoctl: arguments, each line a command;
 *   null if there is no command for it;
 *   input: the standard input of each command of morphoctl;
 *   python: calls of the client m, instead of the request itself
 * @returns {[string, string][]}
 */
export function commandsOf({ path, body, headers = [], output, morphoctl, python, input }) {
  const curl = ['curl -s', shellWord(address(path))];
  // The token itself is never shown: commands are kept in histories and pasted into chats.
  if (getToken()) curl.push('-H "Authorization: Bearer $MORPHOD_TOKEN"');
  if (body !== undefined) curl.push("-H 'Content-Type: application/json'");
  curl.push(...headers.map((header) => `-H ${shellWord(header)}`));
  if (body !== undefined) curl.push(`-d ${shellWord(JSON.stringify(body))}`);
  if (output) curl.push(`-o ${shellWord(output)}`);
  const at = server() === DEFAULT_SERVER ? '' : ` --server ${shellWord(location.origin)}`;
  const given = input ? `echo ${shellWord(input)} | ` : '';
  const { pathname, searchParams } = new URL(path, 'http://any');
  const values = [...searchParams].map(([key, one]) => `${key}=${pythonOf(one)}`);
  const words = [body === undefined ? 'GET' : 'POST', pathname].map(pythonOf)
    .concat(body === undefined ? values : pythonOf(body));
  const lines = morphoctl?.split('\n').map((line) => `${given}morphoctl ${line}${at}`)
    .join('\n');
  return [
    ['curl', curl.join(' ')],
    .../** @type {[string, string][]} */ (lines ? [['morphoctl', lines]] : []),
    ['Python', `import morphod\nm = morphod.Client(${at ? pythonOf(server()) : ''})\n` +
      (python ?? `print(m.request(${words.join(', ')}))`)],
  ];
}
