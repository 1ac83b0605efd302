/** Time-lapse of evolution: the champion of each generation walks, one after another. */

import { announce, button, h, say } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import { countOf, percent } from '../lib/format.js';
import { nameOf } from '../lib/names.js';
import { rollOfCampaign } from '../lib/rollouts.js';
import { save } from './share.js';

const LAPSE_S = 10;
/** More bodies would be shown too briefly. */
const BODIES_MAX = 64;
/** Maximum playback speed: if there are many champions, only their first steps are shown. */
const SPEED_MAX = 4;
const AT_ONCE = 8;

/**
 * A champion, and the consecutive generations in which it leads.
 * @typedef {{design: any, from: number, to: number}} Step
 */

export class TimeLapse {
  /**
   * @param {import('./run_page.js').Shared} shared
   * @param {import('./champions.js').CampaignStage} stage
   */
  constructor({ id, get, job, own, measure, shown, signal }, stage) {
    this.id = id;
    this.get = get;
    this.job = job;
    this.signal = signal;
    this.scored = (score) => `${own ? `${own.name} ` : measure ? '' : 'score '}${shown(score)}`;
    this.player = stage.player;
    this.rows = [];
    /** @type {Map<number, any>} the champions of generations */
    this.found = new Map();
    /** @type {Map<number, any>} robots by the numbers of their designs */
    this.robots = new Map();
    // Learning, or the client of a study, can change the scores of living designs.
    this.isFixed = job().settings.learning === null && !job().study;
    /** Number of the current operation; changing it cancels that operation. */
    this.turn = 0;
    this.slider = h('input', { type: 'range', min: 0, max: 0, value: 0, 'aria-label': 'Generation',
      oninput: () => {
        this.stop();
        this.isUsed = true;
        stage.take();
        this.later();
      } });
    this.later = coalesced(() => this.#trying(() => this.#showOne()), signal, 0);
    this.play = button('Play', () => (this.ends ? this.stop() : this.#trying(() => this.#run())));
    this.film = 'VideoEncoder' in window ? button('Film', () => this.#trying(() => this.#save()),
      { title: 'Save the time-lapse as a WebM file' }) : null;
    this.said = h('p.muted', { 'aria-live': 'polite' });
    this.element = h('section.panel.stack', { 'aria-label': 'Time-lapse', hidden: true },
      h('h2', {}, 'Time-lapse'), h('div.row.lapse', {}, this.play, this.slider, this.film),
      this.said);
    stage.taken = () => {
      this.stop();
      this.isUsed = false;
    };
    this.stage = stage;
    say(this.said, 'Play shows the champion of each generation, all in ten seconds.' +
      (job().settings.learning ? ' All of them walk with the newest controller.' : ''));
  }

  /** Sets the generations, even while the time-lapse plays. */
  set(rows) {
    const { slider } = this;
    const isNewest = slider.value === slider.max;
    this.rows = rows;
    this.element.hidden = !rows.length;
    slider.max = String(Math.max(0, rows.length - 1));
    slider.disabled = rows.length < 2;
    if (!isNewest || this.ends) return;
    slider.value = slider.max;
    if (this.isUsed) this.later();
  }

  async #trying(work) {
    try {
      await work();
    } catch (error) {
      this.stop();
      if (this.signal.aborted) return;
      if (this.element.isConnected) say(this.said, error.message);
      else announce(error.message); // another tab of the run is now shown
    }
  }

  #best(generation) {
    return this.rows[generation].score.quantiles.p0;
  }

  /** Returns the champion of a generation; null if all diverged. */
  async #find(generation) {
    if (this.found.has(generation) || this.#best(generation) === null) {
      return this.found.get(generation) ?? null;
    }
    const known = this.rows.length;
    const { items: [design] } =
      await this.get(`v1/campaigns/${this.id}/population?generation=${generation}&limit=1`);
    this.found.set(generation, design);
    // Among equal designs, the oldest comes first, so it leads as long as it lives and no design
    // scores better.
    for (let next = generation + 1; this.isFixed && next < Math.min(known, design.died ?? known) &&
      this.#best(next) === design.score; next++) this.found.set(next, design);
    return design;
  }

  /** Returns all champions, the newest last, and how many there are. */
  async #steps(turn) {
    const all = this.rows.map((row, generation) => generation)
      .filter((generation) => this.#best(generation) !== null);
    for (;;) {
      const missing = all.filter((generation) => !this.found.has(generation));
      if (!missing.length || turn !== this.turn) break;
      say(this.said, `Reading generations: ${all.length - missing.length} of ${all.length}`);
      await Promise.all(missing.filter((generation, i) => i === 0 || !this.isFixed ||
        this.#best(generation) !== this.#best(generation - 1)).slice(0, AT_ONCE)
        .map((generation) => this.#find(generation)));
    }
    /** @type {Step[]} */
    const steps = [];
    for (const generation of turn === this.turn ? all : []) {
      const design = this.found.get(generation);
      const last = steps.at(-1);
      if (last?.design.number === design.number && last.to === generation - 1) {
        Object.assign(last, { to: generation, design });
      } else {
        steps.push({ design, from: generation, to: generation });
      }
    }
    const n = Math.min(steps.length, BODIES_MAX);
    return { n: steps.length, steps: Array.from({ length: n }, (_, i) =>
      steps[n > 1 ? Math.round((i * (steps.length - 1)) / (n - 1)) : 0]) };
  }

  /** Simulates champions that have not walked yet. */
  async #roll(designs) {
    const sha = this.job().result?.controller?.sha256;
    if (this.robots.size > 2 * BODIES_MAX || sha !== this.sha) this.robots.clear();
    this.sha = sha; // hash of the controller with which they walk
    const fresh = [...new Map(designs.map((one) => [one.number, one])).values()]
      .filter(({ number }) => !this.robots.has(number));
    const robots = fresh.length ? await rollOfCampaign(this.job(), fresh, this.signal) : [];
    robots.forEach((robot, i) => this.robots.set(fresh[i].number, robot));
  }

  /** @param {Step} step */
  #words({ design, from, to }) {
    const same = to > from ? `s ${from} to ${to} (same champion for ${to - from + 1} ` +
      'generations)' : ` ${from}`;
    return `Generation${same}: #${design.number} ${nameOf(design.robot)}, ` +
      `${this.scored(design.score)}`;
  }

  /** Shows the champion of the chosen generation. */
  async #showOne() {
    const { turn } = this;
    const generation = Number(this.slider.value);
    this.slider.setAttribute('aria-valuetext', `generation ${generation}`);
    const design = await this.#find(generation);
    if (turn !== this.turn) return;
    say(this.said, design ? this.#words({ design, from: generation, to: generation })
      : `Generation ${generation}: every robot diverged, so there is no champion.`);
    if (design) await this.#roll([design]);
    if (turn === this.turn) this.player.setRobots(design ? [this.robots.get(design.number)] : []);
  }

  /** Gets everything ready to show; null if it was stopped. */
  async #prepare() {
    this.stop();
    this.stage.take();
    const { turn, player } = this;
    const { speed, playing } = player;
    /** Restores what the user had chosen. */
    this.ends = () => {
      player.speed = speed;
      player.setPlaying(playing);
    };
    say(this.play, 'Stop');
    this.said.setAttribute('aria-live', 'off');
    const { n, steps } = await this.#steps(turn);
    if (turn !== this.turn) return null;
    if (!steps.length) throw new Error('Every robot diverged, so there is no champion.');
    say(this.said, `Computing ${countOf(steps.length, 'champion')}…`);
    await this.#roll(steps.map(({ design }) => design));
    if (turn !== this.turn) return null;
    const eachS = LAPSE_S / steps.length;
    const [{ frames, frameS }] = this.robots.values(); // all walk for the same time
    const walkS = (frames - 1) * frameS;
    const place = (i) => player.setRobots([this.robots.get(steps[i].design.number)]);
    return { turn, n, steps, eachS, place,
      speed: Math.min(SPEED_MAX, Math.max(speed, walkS / eachS)) };
  }

  async #run() {
    const all = await this.#prepare();
    if (!all) return;
    const { turn, n, steps, eachS, speed, place } = all;
    const { player } = this;
    const started = performance.now();
    for (let i = 0; i < steps.length; i++) {
      const left = started + 1000 * eachS * (i + 1) - performance.now();
      if (left <= 0 && i < steps.length - 1) continue; // drawing took too long: skip this one
      this.slider.value = String(steps[i].to);
      say(this.said, this.#words(steps[i]));
      place(i);
      player.speed = speed;
      player.setPlaying(true);
      await new Promise((resolve) => setTimeout(resolve, left));
      if (turn !== this.turn || this.signal.aborted) return;
    }
    this.stop();
    this.isUsed = true;
    say(this.said, `${this.#words(steps.at(-1))}. That was ${countOf(n, 'champion')} of ` +
      `${countOf(this.rows.length, 'generation')}${
        n > steps.length ? `, of which ${steps.length} walked` : ''}.`);
  }

  async #save() {
    const all = await this.#prepare();
    if (!all) return;
    const { turn, steps, eachS, speed, place } = all;
    const { player, player: { stage, canvas } } = this;
    const { record } = await import('../export/webm.js');
    const picture = h('canvas');
    let shown = -1;
    const blob = await player.inFull(() => record(picture, (time) => {
      if (turn !== this.turn) throw new Error('The film was stopped.');
      const i = Math.min(steps.length - 1, Math.floor(time / eachS));
      if (i !== shown) {
        player.setPlaying(false);
        place(shown = i);
      }
      stage.timeS = Math.min(stage.durationS(), (time - i * eachS) * speed);
      stage.draw();
      const { width, height } = canvas;
      if (picture.width !== width) Object.assign(picture, { width, height });
      const context = picture.getContext('2d');
      context.drawImage(canvas, 0, 0);
      Object.assign(context, { font: `${height / 24}px sans-serif`, fillStyle: '#fff',
        shadowBlur: 4, shadowColor: '#000' });
      context.fillText(this.#words(steps[i]), height / 30, height - height / 20);
    }, { durationS: LAPSE_S,
      onprogress: (share) => say(this.said, `Film: ${percent(share)}`) }));
    save(blob, `campaign-${this.id}-evolution.webm`);
    say(this.said, 'The film is saved.');
    this.stop();
  }

  /** Cancels the current operation. */
  stop() {
    this.turn++;
    this.ends?.();
    this.ends = null;
    say(this.play, 'Play');
    this.said.setAttribute('aria-live', 'polite');
  }
}
