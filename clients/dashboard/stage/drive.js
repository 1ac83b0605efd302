/**
 * Driving: robots that follow a light that moves while they walk.
 *
 * The service computes short windows, each from the state at the end of the previous window, ahead
 * of the time that is shown. If the light moves, the windows that have not started to play are
 * computed again. While replies are slow, a request covers several windows, and returns a state
 * only at its end. Nothing is extrapolated: if the service is late, the last frame stays.
 */

/** How far ahead windows are computed while the light rests. */
const AHEAD_S = 0.8;
/** How much must be ahead at the start. */
const BEGIN_S = 0.5;
/** A light that moved within this time may still be moving, so computing more than a window ahead
 * would be wasted. */
const MOVING_MS = 120;
/** While the light moves, the same window is computed again at most this often. */
const AGAIN_MS = 60;
/** A request covers at most this long. */
const REQUEST_MAX_S = 0.8;
/** The windows of a request cover this many times the duration of its reply. */
const SPARE = 1.5;
/** Longer replies count as this long. */
const REPLY_MAX_MS = 1000;
/** A reply may take this much longer than usual. */
const MARGIN_MS = 15;
/** Pauses before another attempt, if the service cannot be reached or is busy. */
const RETRY_MS = 500;

/**
 * @typedef {Object} Part frames of one robot in one window, without the frame that it starts from
 * @property {Float32Array} track
 * @property {Int8Array} [actuation]
 * @property {Uint8Array} [contacts]
 *
 * @typedef {Object} Window
 * @property {number[]} light
 * @property {number} movedMs when the light moved there
 * @property {(Part|null)[]} parts one per robot; null after a divergence: it stays where it is
 * @property {(Object|null)[]|null} states at the end of the window; null after a divergence; null
 *   for all within a request, and once a later window plays
 */

export class Drive {
  /**
   * @param {{ roll: function({light: number[], states: ?(Object|null)[], n: number, signal:
   *   AbortSignal}): Promise<{windows: (Part|null)[][], states: (Object|null)[]}>, sink: {append:
   *   function(Window): void, cutAt: function(number): void}, light: number[], windowS: number,
   *   keepS: number, onfault: function(Error): void, now?: function(): number }} options roll
   *   computes n windows; sink.append gets the windows in order, and sink.cutAt removes those with
   *   at least a given number; keepS: how much of what was driven is kept
   */
  constructor({ roll, sink, light, windowS, keepS, onfault, now = () => performance.now() }) {
    this.roll = roll;
    this.sink = sink;
    this.windowS = windowS;
    this.keepS = keepS;
    this.onfault = onfault;
    this.now = now;
    this.light = light;
    this.movedMs = now();
    /** Time that is shown, in seconds from the start. */
    this.timeS = 0;
    this.speed = 1;
    this.playing = true;
    /** @type {Window[]} windows, starting with number `first` */
    this.windows = [];
    this.first = 0;
    /** Number of the first window whose states are kept. */
    this.stated = 0;
    /** Total time for which the motion was held because a window was missing. */
    this.heldS = 0;
    this.hasBegun = false;
    this.isLate = false;
    this.replyMs = 30;
    this.requests = 0;
    this.pending = null;
    this.isClosed = false;
    this.#pump();
  }

  /** Number of the window after the last one that is computed. */
  get end() {
    return this.first + this.windows.length;
  }

  /** Number of the window that is playing. */
  get current() {
    return Math.max(this.first, Math.min(Math.floor(this.timeS / this.windowS + 1e-9),
      this.end - 1));
  }

  /** Number of windows per request. */
  get perRequest() {
    const needed = Math.ceil(SPARE * this.replyMs * this.speed / (1000 * this.windowS));
    return Math.max(1, Math.min(Math.round(REQUEST_MAX_S / this.windowS), needed));
  }

  /** Moves the light: robots turn at the next window that can still be computed in time. */
  setLight(light) {
    if (this.light[0] === light[0] && this.light[1] === light[1]) return;
    this.light = light;
    this.movedMs = this.now();
    this.#pump();
  }

  /** Advances the time; called for each picture, and by a timer if pictures take long. */
  tick() {
    const now = this.now();
    const elapsedS = this.beforeMs === undefined ? 0 : (now - this.beforeMs) / 1000;
    this.beforeMs = now;
    // It starts with a few windows ahead: the first replies may be slow.
    this.hasBegun ||= this.end * this.windowS >= BEGIN_S;
    if (this.playing && this.hasBegun) {
      const to = this.timeS + elapsedS * this.speed;
      const limit = this.end * this.windowS;
      this.isLate = to > limit;
      if (this.isLate) this.heldS += (to - limit) / this.speed;
      this.timeS = Math.min(to, limit);
      this.#noteTurn(now);
      this.#forget();
    }
    this.#pump();
  }

  /** Skips time in which the page is not watched, as in a hidden tab: the drive does not
   * advance. */
  skip() {
    this.beforeMs = undefined;
  }

  setPlaying(on) {
    this.playing = on;
    this.beforeMs = undefined;
  }

  close() {
    this.isClosed = true;
    this.pending?.stop.abort();
    clearTimeout(this.timer);
  }

  /** Measures how long robots take to respond to a move of the light. */
  #noteTurn(now) {
    const { movedMs } = this.windows[this.current - this.first];
    if (movedMs === this.turnedMs || this.timeS <= this.current * this.windowS) return;
    this.turnedMs = movedMs;
    if (this.current > 0) {
      performance.measure('morphod-light-to-turn', { start: movedMs, end: now });
    }
  }

  #forget() {
    // No window will start from one that has been played.
    while (this.stated < this.current) this.windows[this.stated++ - this.first].states = null;
    const most = Math.ceil(this.keepS / this.windowS);
    while (this.current - this.first > most) {
      this.windows.shift();
      this.first++;
    }
  }

  /** Requests the window that is needed next, if any. */
  #pump() {
    clearTimeout(this.timer);
    if (this.isClosed || this.now() < (this.restUntilMs ?? 0)) return;
    const now = this.now();
    const isNew = this.windows.at(-1)?.movedMs === this.movedMs;
    const at = isNew || !this.end ? this.end : this.#branch();
    if (this.pending) {
      // A window that only continues with the old light is now worthless. One that already turns is
      // worth keeping: otherwise, during a long drag, no window would ever be completed.
      const { movedMs, at: pendingAt, stop } = this.pending;
      if (movedMs === this.movedMs || pendingAt <= at || this.pending.isTurn) return;
      stop.abort();
      this.pending = null;
    }
    if (!isNew && this.end) {
      const waitMs = this.lastTurn?.at === at ? this.lastTurn.sentMs + AGAIN_MS - now : 0;
      if (waitMs > 0) {
        this.timer = setTimeout(() => this.#pump(), waitMs);
        return;
      }
    } else {
      const isMoving = this.hasBegun && now - this.movedMs < MOVING_MS;
      const enoughS = isMoving ? this.windowS + this.replyMs / 1000 : AHEAD_S * this.speed;
      if (this.end * this.windowS - this.timeS > enoughS) {
        if (isMoving) this.timer = setTimeout(() => this.#pump(), MOVING_MS);
        return;
      }
    }
    this.#request(at, at < this.end || !isNew);
  }

  /** Returns the first window that can still be replaced before it plays, from a state that is
   * known. */
  #branch() {
    const passedMs = this.now() - (this.beforeMs ?? this.now());
    const readyS = this.timeS + (passedMs + this.replyMs + MARGIN_MS) / 1000 * this.speed;
    let at = this.current + 1;
    if (this.playing) at = Math.max(at, Math.ceil(readyS / this.windowS));
    while (at < this.end && !this.windows[at - 1 - this.first].states) at++;
    return Math.min(at, this.end);
  }

  async #request(at, isTurn) {
    const stop = new AbortController();
    const { light, movedMs } = this;
    const sentMs = this.now();
    this.pending = { at, isTurn, movedMs, stop };
    if (isTurn) this.lastTurn = { at, sentMs };
    const states = at > 0 ? this.windows[at - 1 - this.first].states : null;
    this.requests++;
    try {
      const { windows, states: after } = await this.roll({ light, states, n: this.perRequest,
        signal: stop.signal });
      if (stop.signal.aborted || this.isClosed) return;
      const tookMs = this.now() - sentMs;
      const share = tookMs > this.replyMs ? 0.5 : 0.2; // adapts faster to slow replies, because
                                                       // gaps are worse than a slow turn
      this.replyMs += share * (Math.min(tookMs, REPLY_MAX_MS) - this.replyMs);
      this.pending = null;
      this.#take(at, windows.map((parts, i) =>
        ({ light, movedMs, parts, states: i === windows.length - 1 ? after : null })));
    } catch (error) {
      if (stop.signal.aborted || this.isClosed) return;
      this.pending = null;
      this.restUntilMs = this.now() + 1000 * (error.retryAfterS ?? RETRY_MS / 1000);
      this.onfault(error);
    }
    this.#pump();
  }

  /** Accepts windows, unless the one that the first replaces is already playing. */
  #take(at, windows) {
    if (at < this.end) {
      const playsS = this.timeS + (this.playing
        ? ((this.now() - (this.beforeMs ?? this.now())) / 1000) * this.speed : 0);
      if (at * this.windowS < playsS) return;
      this.windows.length = at - this.first;
      this.sink.cutAt(at);
    }
    this.windows.push(...windows);
    windows.forEach((window) => this.sink.append(window));
  }
}
