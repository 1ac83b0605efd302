/**
 * A race as one HTML file that needs no service and no network: the stage's own modules and the
 * recordings, in one page.
 */

import { resultOf } from '../lib/tasks.js';
import { orderAt, raceOf } from '../stage/race.js';

/** Modules of the stage, each after the modules that it imports. */
const MODULES = ['stage/math.js', 'stage/camera.js', 'stage/gl.js', 'stage/shaders.js',
  'stage/robot.js', 'stage/lanes.js', 'stage/stage.js', 'lib/body.js'];

const STYLE = `
html,body{margin:0;height:100%;background:#14171b;color:#e9edf2;font:15px system-ui,sans-serif}
body{display:flex;flex-direction:column}
canvas{flex:1;width:100%;min-height:0;touch-action:none;display:block}
footer{display:flex;gap:12px;padding:10px 14px;background:#1b2027;align-items:center;flex-wrap:wrap}
footer input[type=range]{flex:1;min-width:120px;accent-color:#f3a536}
button{font:inherit;background:#232a32;color:inherit;border:1px solid #313a44;border-radius:7px;
padding:6px 12px}
button[aria-pressed=true]{border-color:#f3a536;color:#f3a536}
i{display:inline-block;width:11px;height:11px;border-radius:3px;margin-right:5px}
#names{display:flex;flex-wrap:wrap;gap:4px 12px}`;

const SCRIPT = `
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const robots = DATA.robots.map((robot) => ({ ...robot, body: bodyOf(robot.genotype),
  track: new Float32Array(bytes(robot.track).buffer), world: DATA.worlds[robot.world] }));
const canvas = document.querySelector('canvas');
const stage = new Stage(canvas);
stage.setRobots(robots);
stage.sideBySide = robots.length > 1 && !DATA.isRace;
stage.ghosts = DATA.areGhosts;
stage.aim();
let apart = { ...stage.camera };
const arrange = () => {
  stage.isFramed = Boolean(stage.lanes());
  stage.follow = !stage.isFramed;
  if (stage.isFramed) apart = { ...stage.camera };
  Object.assign(stage.camera, stage.isFramed ? { lens: stage.lanes().lens } : apart);
};
arrange();
const [slider, play, side, springs] = ['time', 'play', 'side', 'springs']
  .map((id) => document.getElementById(id));
slider.max = stage.durationS();
let playing = !matchMedia('(prefers-reduced-motion: reduce)').matches;
let before;
driveCamera(canvas, stage.camera, () => { stage.isFramed = false; });
play.onclick = () => { playing = !playing; };
side.onclick = () => {
  stage.sideBySide = !stage.sideBySide;
  arrange();
};
springs.onclick = () => {
  stage.show.springs = !stage.show.springs;
  stage.show.skin = !stage.show.springs;
};
slider.oninput = () => { playing = false; stage.timeS = Number(slider.value); };
const names = document.getElementById('names');
for (const robot of stage.robots) {
  const name = document.createElement('span');
  const swatch = document.createElement('i');
  swatch.style.background = robot.color;
  name.append(swatch, robot.label + ' ' + robot.result);
  names.append(name);
}
(function tick(now) {
  if (playing && before !== undefined) stage.timeS += Math.min((now - before) / 1000, 0.25);
  if (stage.timeS > stage.durationS() + 1) stage.timeS = 0;
  before = now;
  const { leaders, everyS } = DATA;
  const frame = Math.min(Math.floor(stage.timeS / everyS), leaders.length - 1);
  stage.leader = stage.robots[leaders[frame]];
  stage.draw();
  slider.value = Math.min(stage.timeS, stage.durationS());
  play.textContent = playing ? 'Pause' : 'Play';
  side.setAttribute('aria-pressed', stage.sideBySide);
  springs.setAttribute('aria-pressed', stage.show.springs);
  requestAnimationFrame(tick);
})();`;

function base64(bytes) {
  let text = '';
  for (let i = 0; i < bytes.length; i += 0x8000) {
    text += String.fromCharCode(...bytes.subarray(i, i + 0x8000));
  }
  return btoa(text);
}

/** Returns a module's source as part of one script, which already has its imports. */
export function inline(source) {
  return source.replace(/^import [^;]*;$/gm, '')
    .replace(/^export (?=(const|function|class|async))/gm, '');
}

/** Text inside a script element must not end it. */
const safe = (text) => text.replace(/<\//g, '<\\/').replace(/<!--/g, '<\\!--');

/**
 * @param {import('../stage/stage.js').Robot[]} robots as the stage has them, with genotype and
 *   label
 * @param {string} title
 * @param {boolean} isRace whether it begins as a race, not side by side
 * @param {boolean} areGhosts whether the race is on one ground, not in lanes
 */
export async function toPage(robots, title, isRace = false, areGhosts = false) {
  const base = new URL('..', import.meta.url);
  const load = async (name) => (await fetch(new URL(name, base))).text();
  const sources = await Promise.all(MODULES.map(load));
  const worlds = [...new Set(robots.map((robot) => robot.world))];
  const [{ driven, frameS: everyS }] = robots;
  // The leader looks different only among ghosts, and driven robots have no order.
  const race = areGhosts && !driven && raceOf(robots);
  const n = Math.max(...robots.map(({ frames }) => frames));
  const leaders = Array.from({ length: race ? n : 0 }, (_, frame) =>
    robots.indexOf(orderAt(race, frame * everyS)[0].robot));
  const data = {
    isRace, areGhosts, leaders, everyS,
    worlds: worlds.map(({ light, points, heights, spacing, columns, task }) => ({
      light: [...light], points, heights: [...heights], spacing, columns, task,
    })),
    robots: robots.map(({
      genotype, label, loss, value, unit, driven, frames, frameS, color, track, lights, world,
    }) => ({
      genotype, label, loss, frames, frameS, color, world: worlds.indexOf(world),
      lights: lights && [...lights], result: resultOf({ loss, value, unit, driven }),
      track: base64(new Uint8Array(track.buffer, track.byteOffset, track.byteLength)),
    })),
  };
  const modules = sources.map(inline).join('\n');
  const escaped = title.replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
  const html = '<!doctype html><html lang="en"><meta charset="utf-8">' +
    '<meta name="viewport" content="width=device-width">' +
    `<title>${escaped}</title><style>${STYLE}</style>` +
    `<canvas tabindex="0" aria-label="${escaped}"></canvas>` +
    '<footer><button id="play"></button>' +
    '<input id="time" type="range" min="0" step="any" aria-label="Time">' +
    '<button id="side">Side by side</button><button id="springs">Springs</button>' +
    '<span id="names"></span></footer>' +
    `<script type="module">const DATA=${safe(JSON.stringify(data))};\n${safe(modules)}\n` +
    `${SCRIPT}</script></html>`;
  return new Blob([html], { type: 'text/html' });
}
