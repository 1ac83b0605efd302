"""The light is the user's: robots that follow a light which is dragged, on the stage and in the
Lab."""

import json
import shlex
import struct
import subprocess

import numpy
import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

from contract import SOURCE
from service import DESIGN

SECOND = {"cells": [[0, 0, 0], [1, 0, 0], [1, 1, 0]]}
LIVE = "const { player } = document.querySelector('.stage'); const { live } = player;"

# A drive with a clock and a service of the test's own. The service takes `replyMs`; each window has
# as its frames its number and its light; `sizes` has the windows of each request.
FAKE = """
const done = arguments[arguments.length - 1];
const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
import(folder + 'stage/drive.js').then(async ({ Drive }) => {
  let ms = 0;
  const waiting = [];
  const asked = [];
  const shown = [];
  const sizes = [];
  let replyMs = 20;
  const roll = ({ light, states, n, signal }) => new Promise((resolve, reject) => {
    asked.push([light[0], states ? states[0].window : -1]);
    const window = states ? states[0].window + 1 : 0;
    sizes.push(n);
    waiting.push({ atMs: ms + replyMs, act: () => {
      if (signal.aborted) reject(new Error('aborted'));
      else resolve({ windows: Array.from({ length: n }, (_, k) =>
        [{ track: [window + k, light[0]] }]), states: [{ window: window + n - 1 }] });
    } });
  });
  const sink = {
    append: ({ parts }) => shown.push(parts[0].track),
    cutAt: (window) => { shown.length = window; },
  };
  const drive = new Drive({ roll, sink, light: [1, 1], windowS: 0.2, keepS: 2, now: () => ms,
    onfault: (error) => { throw error; } });
  const run = async (untilMs, stepMs = 10) => {
    while (ms < untilMs) {
      ms += stepMs;
      for (const one of waiting.splice(0)) {
        if (one.atMs <= ms) one.act();
        else waiting.push(one);
      }
      await null; await null; await null; await null;
      drive.tick();
    }
  };
  %s
});
"""

# Keeps what the page saves as files.
KEEP_FILES = """
    window.saved = [];
    const make = URL.createObjectURL;
    URL.createObjectURL = (blob) => { saved.push(blob); return make(blob); };
"""


def fake(browser, script):
    browser.open("nowhere")
    return browser.driver.execute_async_script(FAKE % script)


def start(browser, view):
    """Opens a stage and presses Drive."""
    browser.open(view)
    browser.until_walking()
    browser.run("document.querySelector('.stage').player.setPlaying(true)")
    browser.click("Drive")
    browser.until("document.querySelector('.stage').player.live?.drive.timeS > 0.3")


def light(browser):
    return browser.run(LIVE + "return live.live.world.light")


def ring(browser):
    """Returns where the ring around the light is, from the middle of the canvas."""
    return browser.run("""
        const ring = document.querySelector('.rings i').getBoundingClientRect();
        const canvas = document.querySelector('.stage canvas').getBoundingClientRect();
        return [ring, canvas].map(({ left, width, top, height }) =>
          [left + width / 2, top + height / 2])
          .reduce((a, b) => [Math.round(a[0] - b[0]), Math.round(a[1] - b[1])]);
    """)


def test_a_resting_light_needs_no_second_thought(browser):
    """Windows are computed ahead, once each, and there is no gap."""
    asked, shown, held, ahead = fake(browser, """
      await run(3000);
      done([asked, shown, drive.heldS, drive.end * drive.windowS - drive.timeS]);
    """)
    assert asked == [[1, window - 1] for window in range(len(asked))]
    assert shown == [[window, 1] for window in range(len(shown))]
    assert held == 0 and 0.6 < ahead < 1.1


def test_a_moved_light_replaces_what_does_not_play_yet(browser):
    asked, shown, first, turn = fake(browser, """
      await run(1090);
      const before = asked.length;
      drive.setLight([2, 1]);
      const current = drive.current;
      await run(1160);
      const turn = shown.findIndex(([, x]) => x === 2);
      await run(2000);
      done([asked.slice(before), shown, current, turn]);
    """)
    assert asked[0] == [2, first], "from the end of the window that plays"
    assert turn == first + 1
    assert [x for _, x in shown] == [1] * turn + [2] * (len(shown) - turn)
    assert [window for window, _ in shown] == list(range(len(shown)))


def test_too_late_for_the_next_window_it_is_the_one_after(browser):
    """The light moves 10 ms before a window ends, and a reply takes 20 ms: the motion goes on."""
    shown, held, played, turn = fake(browser, """
      await run(1200);
      while ((drive.timeS + 0.0101) % 0.2 > 0.0103) await run(ms + 10);
      drive.setLight([2, 1]);
      const current = drive.current;
      await run(ms + 600);
      done([shown, drive.heldS, current, shown.findIndex(([, x]) => x === 2)]);
    """)
    assert turn == played + 2 and held == 0
    assert [window for window, _ in shown] == list(range(len(shown)))


def test_a_long_drag_asks_a_bounded_number_of_times(browser):
    asked, shown, held = fake(browser, """
      await run(1000);
      const before = asked.length;
      for (let i = 0; i < 200; i++) {
        drive.setLight([2 + i / 100, 1]);
        await run(ms + 10);
      }
      done([asked.length - before, shown, drive.heldS]);
    """)
    assert held == 0
    assert 10 <= asked <= 45, "at most every 60 ms for the same window"
    lights = [x for _, x in shown]
    assert lights == sorted(lights) and len(set(lights)) >= 10


def test_a_late_service_holds_the_frame_and_says_so(browser):
    held, late, time, end, after, shown = fake(browser, """
      await run(1000);
      replyMs = 1500;
      await run(3000);
      const held = [drive.heldS, drive.isLate, drive.timeS, drive.end * drive.windowS];
      replyMs = 20;
      await run(6000);
      done([...held, drive.isLate, shown]);
    """)
    assert held > 0.1 and late and time == pytest.approx(end, abs=1e-9) and not after
    assert [window for window, _ in shown] == list(range(len(shown)))


def test_slow_replies_are_for_more_windows(browser):
    """On a slow machine the motion has no gaps once requests are long enough, also while the light
    moves; when replies are quick again, so is the turn."""
    sizes, shown, gaps, quick, turn = fake(browser, """
      await run(1000);
      replyMs = 350;
      await run(4000);
      const before = drive.heldS;
      for (let i = 0; i < 100; i++) {
        if (i % 10 === 0) drive.setLight([2 + i / 100, 1]);
        await run(ms + 30);
      }
      const gaps = drive.heldS - before;
      const slow = sizes.at(-1);
      replyMs = 20;
      await run(ms + 4000);
      const quick = drive.perRequest;
      drive.setLight([4, 1]);
      const fromS = drive.timeS;
      await run(ms + 1500);
      const turn = shown.findIndex(([, x]) => x === 4) * drive.windowS - fromS;
      done([[slow, Math.max(...sizes)], shown, gaps, quick, turn]);
    """)
    assert 2 < sizes[0] <= 4 and sizes[1] <= 4 and quick == 1
    assert gaps == 0
    assert 0 < turn <= 0.26
    assert [window for window, _ in shown] == list(range(len(shown)))


def test_memory_is_bounded(browser):
    kept, first, held = fake(browser, """
      await run(20000);
      done([drive.windows.length, drive.first, drive.heldS]);
    """)
    assert kept <= 10 + 1 + 8 and first > 80 and held == 0


# The positions of rollouts are requested in 32 bits, as those of windows are.
EXACT = """
const fetched = window.fetch;
window.fetch = (address, { body, ...rest } = {}) => fetched(address,
  { ...rest, body: body && String(body).replace('"masses_int16":true', '"masses_int16":false') });
"""


def test_joined_windows_are_one_rollout(service, browser):
    """If the light does not move, the frames are those of one rollout, bit for bit."""
    robot = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["robot"]
    with browser.adding(EXACT):
        browser.open(f"stage?designs={robot}&environment=3")
    browser.until_walking()
    browser.run("document.querySelector('.stage').player.setPlaying(true)")
    browser.run("""
        const { robots } = document.querySelector('.stage').player.stage;
        window.whole = robots.map(({ track, actuation, contacts }) =>
          [track, actuation, contacts].map((all) => Array.from(all)));
    """)
    browser.click("Drive")
    browser.until("document.querySelector('.stage').player.live?.drive.timeS > 2.2")
    equal, moving = browser.driver.execute_async_script(f"""
        const done = arguments[0];
        {LIVE}
        const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
        import(folder + 'stage/driven.js').then(({{ drivenRobots }}) => {{
          const [robot] = drivenRobots(live.drive, live.live);
          const {{ track, actuation, contacts, frames }} = robot;
          const n = [3 * robot.body.nMasses, robot.body.nSprings, robot.body.nMasses];
          const same = [track, actuation, contacts].map((all, k) =>
            all.length === frames * n[k] && all.every((value, i) => value === whole[0][k][i]));
          done([[frames > 50, ...same], track.slice(-3).some((x, i) => x !== track[i])]);
        }});
    """)
    assert equal == [True] * 4 and moving
    assert browser.faults() == []


def test_the_light_is_dragged(service, browser):
    """A drag with the mouse moves the light under the pointer, and the robots follow it."""
    ids = [row["robot"] for row in service.evaluate(
        {"designs": [DESIGN, SECOND]}).json()["results"]]
    start(browser, f"stage?designs={','.join(ids)}&environment=2")
    scores = browser.texts(".stage .tag .number") + browser.texts(".stage .names .number")
    assert scores and set(scores) == {"driven"}
    assert browser.run("return document.activeElement.tagName") == "CANVAS"
    # Before the first picture of the drive, the ring is elsewhere.
    browser.until("document.querySelectorAll('.rings i').length === 2")
    before, requests = light(browser), browser.run(LIVE + "return live.drive.requests")
    canvas = browser.driver.find_element("css selector", ".stage canvas")
    browser.click("Follow")  # so that the ring stays until the pointer is there
    browser.run(LIVE + "player.redraw()")
    x, y = ring(browser)
    drag = ActionChains(browser.driver, duration=40)
    drag.move_to_element_with_offset(canvas, x, y).click_and_hold()
    for _ in range(6):
        drag.move_by_offset(10, 8)
    drag.perform()
    browser.until("document.querySelector('.stage').player.live.steering.held")
    ActionChains(browser.driver).release().perform()
    after = light(browser)
    assert sum((a - b) ** 2 for a, b in zip(before, after)) > 0.01
    assert browser.run(LIVE + "return live.drive.requests") > requests
    assert browser.run(LIVE + "player.redraw(); return live.steering.held") is None
    browser.until("performance.getEntriesByName('morphod-light-to-turn').length")
    browser.until("/Light at x/.test(document.querySelector('.driving').innerText)")
    browser.click("End")
    assert browser.run(LIVE + "return live") is None
    assert browser.texts(".rings i") == []
    browser.until("!/driven/.test(document.querySelector('.stage').innerText)")
    assert browser.run(LIVE + "return player.stage.robots.every((r) => !r.driven)")
    assert browser.faults() == []


def test_keys_and_a_click_move_the_light(service, browser):
    robot = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["robot"]
    start(browser, f"stage?designs={robot}")
    canvas = browser.driver.find_element("css selector", ".stage canvas")
    yaw = browser.run(LIVE + "player.stage.camera.yaw = 0; return player.stage.show.springs")
    places = [light(browser)]
    for keys in ("w", "d", Keys.SHIFT + Keys.ARROW_DOWN + Keys.NULL, "a"):
        canvas.send_keys(keys)
        places.append(light(browser))
    moves = [[b - a for a, b in zip(one, two)] for one, two in zip(places, places[1:])]
    away, right, back, left = moves
    assert away[1] > 0.05 or places[0][1] == 5
    assert left[0] < -0.05 and back[1] < -0.05 and abs(left[1]) < 0.01 and abs(back[0]) < 0.01
    assert right[0] > 0.05 or places[1][0] == 5
    assert browser.run(LIVE + "return player.stage.show.springs") == yaw, "s is a key of the drive"
    before = light(browser)
    ActionChains(browser.driver).move_to_element_with_offset(canvas, 90, 60).click().perform()
    assert light(browser) != before
    canvas.send_keys(Keys.ESCAPE)
    assert browser.run(LIVE + "return live") is None
    canvas.send_keys("s")
    assert browser.run(LIVE + "return player.stage.show.springs") != yaw
    assert browser.faults() == []


def test_the_light_stays_where_the_service_accepts_it(browser):
    browser.open("nowhere")
    places = browser.driver.execute_async_script("""
        const done = arguments[0];
        const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
        import(folder + 'stage/steer.js').then(({ placeFor }) => done(
          [[-3, 9], [2.5, 2.5], [2.51, 2.5], [2.4, 2.45], [1, 1.00049]].map(placeFor)));
    """)
    assert places[0] == [0, 5] and places[4] == [1, 1]
    for x, y in places:
        assert ((x - 2.5) ** 2 + (y - 2.5) ** 2) ** 0.5 >= 0.1


def test_a_drive_is_saved(service, browser, tmp_path):
    """As a scene, which the Python client reads, and its way as a task, which the stage shows."""
    robot = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["robot"]
    start(browser, f"stage?designs={robot}&environment=1")
    canvas = browser.driver.find_element("css selector", ".stage canvas")
    canvas.send_keys("a")
    browser.until("document.querySelector('.stage').player.live.drive.timeS > 1.2")
    browser.run(KEEP_FILES)
    browser.click("Save")
    browser.until("document.querySelector('dialog[open]')")
    text = browser.texts("dialog")[0]
    assert "Driven robots have no score: you moved the light." in text and "Film (WebM)" in text
    browser.click("Recording (scene)")
    browser.until("saved.length")
    data = bytes(browser.driver.execute_async_script(
        "saved[0].arrayBuffer().then((all) => arguments[0]([...new Uint8Array(all)]))"))
    length, = struct.unpack_from("<I", data)
    header = json.loads(data[4:4 + length])
    [rollout] = header["rollouts"]
    assert rollout["loss"] is None and header["driven"] and header["designs"][0]["robot"] == robot
    frames = rollout["masses_m"]["shape"][0]
    assert frames >= 31 and rollout["lights_m"]["shape"] == [frames, 3]
    lights = struct.unpack_from(f"<{3 * frames}f", data, 4 + length + rollout["lights_m"]["offset"])
    assert lights[:2] != lights[-3:-1]
    browser.run("document.querySelector('dialog details').open = true")
    task = json.loads(browser.texts("dialog pre")[0])
    points = task["guide"]["points_m"]
    assert task["guide"]["kind"] == "path" and 1 <= len(points) <= 16
    reply = service.post("/v1/evaluations", {"designs": [{"id": robot}], "environments":
                                             [{"task": task}]}, headers={"Prefer": "wait=30"})
    assert reply["state"] == "succeeded"
    link = browser.run("return document.querySelector('dialog a').getAttribute('href')")
    browser.click("Close")
    browser.until("document.querySelector('.stage').player.live")
    assert not browser.run(LIVE + "return player.playing"), "it goes on when the user wants it to"
    browser.open(link.split("#/")[1])
    browser.until_walking()
    shown = browser.run("return document.querySelector('.stage').player.stage.robots[0].world")
    assert shown["points"] == points
    assert browser.faults() == []


def test_a_saved_drive_of_two_controllers_has_both(service, browser):
    """In the recording, the commands and the link."""
    robot = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["robot"]
    start(browser, f"stage?designs={robot}&controller=default,tuned")
    browser.click("Save")
    browser.until("document.querySelector('dialog[open]')")
    browser.run(KEEP_FILES + "document.querySelector('dialog details').open = true;")
    browser.click("Recording (scene)")
    browser.until("saved.length")
    data = bytes(browser.driver.execute_async_script(
        "saved[0].arrayBuffer().then((all) => arguments[0]([...new Uint8Array(all)]))"))
    length, = struct.unpack_from("<I", data)
    header = json.loads(data[4:4 + length])
    files = [service.get(f"/v1/controllers/{name}")["sha256"] for name in ("default", "tuned")]
    assert header["controller"] is None and header["precision"] == "float32"
    assert [rollout["controller"] for rollout in header["rollouts"]] == files
    titles = browser.texts("dialog section h3")
    assert titles == ["JSON"] + [f"{tool}, {name}" for name in ("default", "tuned")
                                 for tool in ("curl", "morphoctl", "Python")]
    bodies = [json.loads(words[words.index("-d") + 1]) for words in
              (shlex.split(text) for text in browser.texts("dialog pre") if "curl -s" in text)]
    assert [body.get("controller") for body in bodies] == [None, "tuned"]
    assert [body["designs"] for body in bodies] == [[{"id": robot}]] * 2
    link = browser.run("return document.querySelector('dialog a').getAttribute('href')")
    browser.open(link.split("#/")[1])
    browser.until_walking()
    assert browser.run("return document.querySelector('.stage').player.stage.robots"
                       ".map(({ controller }) => controller)") == ["default", "tuned"]
    assert browser.faults() == []


def test_a_saved_drive_has_the_world_of_a_job(service, browser):
    """The link and the commands have its terrain, physics and precision, not those of a set."""
    job = service.evaluate({
        "designs": [DESIGN], "physics": {"n_steps": 400}, "precision": "float64",
        "environments": [{"light_xy_m": [4.0, y], "terrain_sigma_m": 0.05, "seed": seed}
                         for seed, y in enumerate((1.0, 3.0))]
    }).json()
    id, robot = job["id"], job["results"][0]["robot"]
    terrain = ("const [{ world }] = document.querySelector('.stage').player.stage.robots;"
               "return [...world.heights]")
    start(browser, f"stage?designs={robot}&world=evaluation-{id}&environment=1")
    heights = browser.run(terrain)
    browser.click("Save")
    browser.until("document.querySelector('dialog[open]')")
    browser.run("document.querySelector('dialog details').open = true")
    link = browser.run("return document.querySelector('dialog a').getAttribute('href')")
    _, curl, morphoctl, python = browser.texts("dialog pre")
    words = shlex.split(curl)
    body = json.loads(words[words.index("-d") + 1])
    assert body["physics"]["n_steps"] == 400 and body["precision"] == "float64"
    assert '"n_steps": 400' in python and 'precision="float64"' in python
    tool = str(SOURCE / "build/clients/morphoctl/morphoctl")
    done = subprocess.run(morphoctl.replace("| morphoctl", f"| {tool}") + " --json", shell=True,
                          capture_output=True, check=True)
    scored = json.loads(done.stdout)
    assert scored["physics"]["n_steps"] == 400 and scored["precision"] == "float64"
    assert scored["results"][0]["robot"] == robot
    browser.open(link.split("#/")[1])
    browser.until_walking()
    assert browser.run(terrain) == heights
    seconds, loss = browser.run("const { stage } = document.querySelector('.stage').player;"
                                "return [stage.durationS(), stage.robots[0].loss]")
    assert seconds == pytest.approx(0.8)
    assert loss == pytest.approx(scored["results"][0]["losses"][0]["loss"], abs=1e-9)
    assert browser.faults() == []


def test_windows_that_arrive_late_leave_a_recording_alone(service, browser):
    """The service replies while the dialog shows what was driven; then the drive goes on."""
    robot = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["robot"]
    start(browser, f"stage?designs={robot}")
    browser.run(LIVE + """
        const { drive } = live;
        window.drive = drive;
        const { roll } = drive;
        window.held = new Promise((resolve) => { window.release = resolve; });
        drive.roll = async (asked) => {
          const reply = await roll(asked);
          await held;
          return reply;
        };
    """)
    browser.until("drive.isLate && drive.pending")
    browser.click("Save")
    browser.until("document.querySelector('dialog[open]')")
    browser.run("""
        const { player: { stage } } = document.querySelector('.stage');
        const { gl } = stage;
        window.written = 0;
        gl.texSubImage2D = (...all) => {
          written++;
          Object.getPrototypeOf(gl).texSubImage2D.apply(gl, all);
        };
        gl.getError();
        window.before = [drive.end, stage.timeS];
        release();
    """)
    browser.until("drive.end > before[0]")
    assert browser.run("""
        const { stage } = document.querySelector('.stage').player;
        return [written, stage.gl.getError(), stage.timeS === before[1]];
    """) == [0, 0, True]
    browser.click("Close")
    browser.until("document.querySelector('.stage').player.live")
    browser.run("document.querySelector('.stage').player.setPlaying(true)")
    browser.until("drive.timeS > before[0] * drive.windowS &&"
                  "document.querySelector('.stage').player.stage.robots[0].centers")
    centers = browser.run(LIVE + """
        const [{ track, centers, frames, body: { nMasses } }] = player.stage.robots;
        return Array.from({ length: frames }, (_, frame) => {
          let sum = 0;
          for (let i = 0; i < nMasses; i++) sum += track[3 * (nMasses * frame + i)];
          return sum / nMasses - centers[3 * frame];
        });
    """)
    assert max(map(abs, centers)) < 1e-4
    browser.until("written")
    assert browser.faults() == []


def test_a_drive_survives_a_lost_context(service, browser):
    """The graphics processor was reset: the robots that move are those that are drawn."""
    robot = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["robot"]
    start(browser, f"stage?designs={robot}")
    browser.run(LIVE + """
        window.stage = player.stage;
        window.driving = live;
        window.extension = stage.gl.getExtension('WEBGL_lose_context');
        window.restored = false;
        player.canvas.addEventListener('webglcontextrestored', () => { restored = true; });
        player.canvas.addEventListener('webglcontextlost',
          () => setTimeout(() => extension.restoreContext(), 100));
        extension.loseContext();
    """)
    browser.until("restored")
    browser.run("window.beforeS = driving.drive.timeS")
    browser.until("driving.drive.timeS > beforeS + 1")
    same, shown, time = browser.run("""
        const { live, drive } = driving;
        return [live.robots.every((robot, i) => robot === stage.robots[i]),
          live.first * live.frameS + stage.durationS(), drive.timeS];
    """)
    assert same and shown >= time
    browser.run("document.querySelector('.stage').player.setPlaying(false)")
    browser.run("document.querySelector('.stage').player.redraw()")
    browser.until("!stage.isBusy()")
    assert browser.run("return stage.gl.getError()") == 0
    picture = browser.pixels(".stage canvas")[..., :3]
    assert len(numpy.unique(picture.reshape(-1, 3), axis=0)) > 100
    assert browser.faults() == []


def test_the_lab_drives_the_body(browser):
    """A changed body follows the same light."""
    browser.open("lab")
    browser.until_walking()
    browser.run("document.querySelector('.stage').player.setPlaying(true)")
    browser.click("Drive")
    browser.until("document.querySelector('.stage').player.live?.drive.timeS > 0.3")
    browser.driver.find_element("css selector", ".stage canvas").send_keys("a")
    place, before = light(browser), browser.run(
        LIVE + "return player.stage.robots[0].body.nVoxels")
    browser.run("document.querySelector('[data-cell=\"2,2,2\"]').click()")
    browser.until("document.querySelector('.stage').player.stage.robots[0].body.nVoxels !== "
                  f"{before}")
    browser.until("document.querySelector('.stage').player.live.drive.timeS > 0.3")
    assert light(browser) == place
    assert browser.faults() == []
