"""Driving on the stage: the light is dragged with the mouse, and every picture that the browser
finishes is recorded.

A robot has turned once a picture shows it closer to the new light's side than it would be if the
light had stayed, which the page has computed ahead. Gaits sway, so the path alone would not say
which turns are answers to a drag."""

import math
import time

from dashboard_streams import cpu_s

# A screen on which every pixel of the page is a pixel of the screen.
SCREEN = {"width": 1280, "height": 720, "deviceScaleFactor": 1, "mobile": False}
PAUSE_S = 3
# The path of the center of mass has veered by this much: about a pixel.
VEERED_M = 0.005
LIGHT_M = 1.1

# Records each picture once the graphics processor has finished it: when it was drawn and finished,
# which instant of the drive it shows, and for how long the drive has been held by then. The next
# picture begins only after that, so none is missed.
WATCH = """
const { player: { stage, live: { drive, live, steering } } } = document.querySelector('.stage');
window.seen = { pictures: [], turns: [] };
let drawn = null;
const finished = () => {
  if (!drawn || stage.isBusy()) return;
  seen.pictures.push({ atMs: performance.now(), ...drawn });
  look(seen.pictures.at(-1));
  drawn = null;
};
const draw = stage.draw.bind(stage);
stage.draw = (how) => {
  finished();
  draw(how);
  drawn = { drawnMs: performance.now(), timeS: drive.timeS, heldS: drive.heldS };
};
const poll = () => {
  finished();
  requestAnimationFrame(poll);
};
poll();

/** Returns the center of mass (x, y) of the first robot at a time, or null if that is not
 * computed. */
const placeAt = ({ first, windows }, timeS) => {
  const at = timeS / live.frameS - 1; // the first window begins after a frame
  const { nMasses: n } = live.robots[0].body;
  const center = (frame) => {
    const track = windows[Math.floor(frame / live.perWindow) - first]?.parts[0].track;
    const from = 3 * n * (frame % live.perWindow);
    return track && [0, 1].map((axis) => {
      let sum = 0;
      for (let i = 0; i < n; i++) sum += track[from + 3 * i + axis];
      return sum / n;
    });
  };
  const [a, b] = [center(Math.floor(at)), center(Math.ceil(at))];
  return a && b && a.map((value, axis) => value + (at % 1) * (b[axis] - value));
};

/** The drag that is being watched. */
let turn = null;
window.nextDrag = (side) => {
  if (turn) seen.turns.push(null);
  turn = { side };
};
stage.canvas.addEventListener('pointermove', ({ timeStamp }) => {
  if (turn && steering.held) turn.startMs ??= timeStamp;
}, { capture: true });
const { setLight } = drive;
drive.setLight = (light) => {
  if (turn) turn.without ??= { first: drive.first, windows: [...drive.windows] };
  setLight.call(drive, light);
};
const look = ({ atMs, timeS }) => {
  if (!turn?.without) return;
  const [stayed, is] = [turn.without, drive].map((computed) => placeAt(computed, timeS));
  if (stayed && is) {
    const veered = is.reduce((sum, value, i) => sum + turn.side[i] * (value - stayed[i]), 0);
    if (veered < arguments[0]) return;
  }
  seen.turns.push(stayed ? atMs - turn.startMs : null); // null: not in the time computed ahead
  turn = null;
};
"""

# Where the light is seen, and where it is to be dragged to: at a right angle to its direction from
# the first robot, on the side that is closer to the middle of the map.
AIM = """
const { player: { stage, live, canvas } } = document.querySelector('.stage');
const [x, y, z] = stage.placeOf(stage.robots[0]);
const { light } = live.live.world;
const angle = Math.atan2(light[1] - y, light[0] - x);
const [best] = [-1, 1].map((way) => {
  const to = angle + way * Math.PI / 2;
  const at = [x + arguments[0] * Math.cos(to), y + arguments[0] * Math.sin(to)];
  return { side: [Math.cos(to), Math.sin(to)], at, off: Math.hypot(at[0] - 2.5, at[1] - 2.5) };
}).sort((a, b) => a.off - b.off);
const { left, top } = canvas.getBoundingClientRect();
const [ring] = document.querySelectorAll('.rings i');
const from = ring.getBoundingClientRect();
const [to] = stage.placesOf([...best.at, live.steering.held?.height ?? z]);
return { side: best.side, from: [from.left + from.width / 2, from.top + from.height / 2],
  to: [left + to.x, top + to.y] };
"""


def drag(page):
    """Drags the light to another side of the first robot."""
    aim = page.run(AIM, LIGHT_M)
    page.run("nextDrag(arguments[0])", aim["side"])

    def mouse(kind, share):
        x, y = (a + share * (b - a) for a, b in zip(aim["from"], aim["to"]))
        page.send("Input.dispatchMouseEvent",
                  {"type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1})

    mouse("mouseMoved", 0)
    mouse("mousePressed", 0)
    mouse("mouseMoved", 1)  # at once, so that there is one instant to measure from
    mouse("mouseReleased", 1)


def drive_robots(service, page, robots, drags):
    """Drives robots with that many drags, PAUSE_S apart. Returns the pictures and the turns, and
    the daemon's share of a core per robot."""
    page.send("Emulation.setDeviceMetricsOverride", SCREEN)
    try:
        page.load("stage?designs=" + ",".join(robots), "firstPicture()")
        page.until(f"document.querySelector('.stage').player.stage.robots.length === {len(robots)}")
        page.run("[...document.querySelectorAll('button')]"
                 ".find((one) => one.innerText === 'Drive').click()")
        page.until("document.querySelector('.stage').player.live?.drive.timeS > 2")
        page.run(WATCH, VEERED_M)
        pid = service.process.pid
        before, start = cpu_s(pid, rollouts=True), time.monotonic()
        for i in range(drags):
            time.sleep(max(0, start + PAUSE_S * i + 1 - time.monotonic()))
            drag(page)
        time.sleep(max(0, start + PAUSE_S * drags - time.monotonic()))
        share = (cpu_s(pid, rollouts=True) - before) / (time.monotonic() - start) / len(robots)
        seen = page.run("return seen")
        assert len(seen["turns"]) >= drags - 1 and len(seen["pictures"]) > drags, seen
        turns = [math.inf if turn is None else turn for turn in seen["turns"]]
        return seen["pictures"], turns, share
    finally:
        page.send("Emulation.clearDeviceMetricsOverride")
