"""A race on the stage: lanes, order of arrival, robots as they come, and its film."""

import math
import struct

import pytest

from service import DESIGN
from test_tray import module

LINE = {"cells": [[x, 2, 0] for x in range(1, 5)]}
PAIR = {"cells": [[0, 0, 0], [1, 0, 0]]}
# Requests for rollouts after the first wait until `release` is called.
HOLD = """
const fetched = window.fetch;
let n = 0;
const released = new Promise((resolve) => { window.release = resolve; });
window.fetch = async (address, ...rest) => {
  if (String(address).includes('v1/rollouts') && n++ > 0) await released;
  return fetched(address, ...rest);
};
"""
PLAYER = "const { player, player: { stage } } = document.querySelector('.stage');"


def robots_of(service, designs):
    results = service.evaluate({"designs": designs, "physics": {"n_steps": 20}}).json()["results"]
    return ",".join(row["robot"] for row in results)


def pause_at(browser, time_s):
    browser.run(PLAYER + """
        player.slider.value = String(arguments[0]);
        player.slider.dispatchEvent(new Event('input'));
    """, time_s)


def test_each_robot_has_a_lane(service, browser):
    """Lanes are next to each other, across the way to the light, and all of them are visible. The
    recordings are those of the daemon."""
    designs = [DESIGN, PAIR, LINE]
    ids = robots_of(service, designs)
    browser.open(f"stage?designs={ids}&environment=2")
    browser.until("document.querySelector('.stage')?.player?.stage.robots.length === 3")
    tracks = "return document.querySelector('.stage').player.stage.robots.map((r) => [...r.track])"
    apart = browser.run(tracks)
    browser.click("Race")
    pause_at(browser, 3.9)
    assert browser.run(tracks) == apart
    lanes = browser.run(PLAYER + """
        const { lane, course, goal, shifts, robots } = stage.lanes();
        const seen = (point) => stage.placesOf(point)[0];
        return { lane, course, goal, light: robots[0].world.light,
          shifts: robots.map((robot) => shifts.get(robot)),
          places: robots.map((robot) => seen(stage.placeOf(robot))),
          lights: robots.map((robot) => seen(robot.world.light.map((value, axis) =>
            value + shifts.get(robot)[axis]).concat(0.1))) };
    """)
    x, y, along_x, along_y = lanes["course"]
    light = [value - start for value, start in zip(lanes["light"], (x, y))]
    assert lanes["goal"] == pytest.approx(math.hypot(*light))
    assert (along_x * light[0] + along_y * light[1]) == pytest.approx(lanes["goal"])
    width = lanes["lane"][3] - lanes["lane"][2]
    for left, right in zip(lanes["shifts"], lanes["shifts"][1:]):
        across = [b - a for a, b in zip(left, right)]
        assert across[0] * along_x + across[1] * along_y == pytest.approx(0, abs=1e-6)
        assert math.hypot(*across[:2]) > width and across[2] == 0
    assert not any(place["isOut"] for place in lanes["places"] + lanes["lights"])
    # Each robot is drawn in its lane, in its color.
    for i, place in enumerate(lanes["places"]):
        browser.run(PLAYER + "player.held = true; stage.scale = 1; stage.show.trails = false;"
                    "stage.show.skin = true; stage.draw()")
        pictures = [browser.pixels(".stage canvas")]
        browser.run(PLAYER + "stage.show.skin = false; stage.draw(); stage.show.skin = true;")
        pictures.append(browser.pixels(".stage canvas"))
        scale = pictures[0].shape[1] / browser.run(PLAYER + "return stage.canvas.clientWidth")
        row, column = round(place["y"] * scale), round(place["x"] * scale)
        near = [picture[row - 8:row + 8, column - 8:column + 8, :3].astype(int)
                for picture in pictures]
        assert abs(near[0] - near[1]).max() > 30, f"robot {i} is not in its lane"
    assert browser.faults() == []


def test_the_order_of_a_race(service, browser):
    """The list has the order of the distances in the recordings, and follows them."""
    browser.open(f"stage?designs={robots_of(service, [DESIGN, PAIR, LINE])}&environment=2")
    browser.until("document.querySelector('.stage')?.player?.stage.robots.length === 3")
    browser.click("Race")
    assert "distance to the light" in browser.texts(".stage .names")[0]
    for time in (1.0, 2.4, 4.0):
        pause_at(browser, time)
        robots = browser.run(PLAYER + """
            return stage.robots.map(({ label, track, body, frameS, world }) => {
              const n = body.nMasses;
              const at = Math.round(arguments[0] / frameS) * n * 3;
              return [label, [...track.subarray(at, at + 3 * n)], world.light];
            });""", time)
        far = {}
        for label, masses, light in robots:
            center = [sum(masses[axis::3]) / (len(masses) // 3) for axis in range(2)]
            far[label] = math.dist(center, light)
        expected = [[str(place + 1), label, far[label]]
                    for place, label in enumerate(sorted(far, key=far.get))]
        rows = [text.split("\n") for text in browser.texts(".stage .names .rows button")]
        assert [row[:2] for row in rows] == [row[:2] for row in expected]
        for (_, _, text), (_, _, value) in zip(rows, expected):
            if text.endswith("m"):
                assert float(text[:-2]) == pytest.approx(value, abs=0.006)
            else:
                assert text.endswith(" s") and value < 0.5
        places = browser.run("return [...document.querySelectorAll('.tag')].map((e) =>"
                             "[e.children[1].textContent, e.children[0].textContent])")
        assert dict(places) == {row[1]: row[0] for row in rows}


# Robots of one mass that walk straight to a light 1 m away at these speeds in m/s.
STRAIGHT = """
const robots = arguments[1].map((speed, i) => {
  const track = new Float32Array(101 * 3);
  for (let f = 0; f <= 100; f++) track.set([2 + Math.min(speed * f * 0.04, 1.2), 2, 0.1], 3 * f);
  return { label: String(i), body: { nMasses: 1 }, track, frames: 101, frameS: 0.04, loss: 0.5,
    world: { light: [3, 2], heights: new Float32Array(64) } };
});
const race = of.raceOf(robots);
const order = (time) => of.orderAt(race, time).map(({ robot, text }) => [robot.label, text]);
const part = of.slowPart(race);
const film = of.filmTimes(part, race.durationS);
done([[0.5, 2, 4].map(order), part, film.durationS,
  [0, part[0], part[0] + 0.4, film.durationS].map(film.timeAt)]);
"""


def test_arrivals_and_slow_motion(service, browser):
    """Who comes within 0.1 m of the light has arrived, and stays ahead of who comes later, even if
    it walks on. The film is slower around the first arrival."""
    browser.open("nowhere")
    orders, part, film_s, times = module(browser, "stage/race.js", STRAIGHT, [0.3, 0.9, 0.5, 0.1])
    assert orders == [
        [["1", "0.55 m"], ["2", "0.75 m"], ["0", "0.85 m"], ["3", "0.95 m"]],
        [["1", "1.00 s"], ["2", "1.80 s"], ["0", "0.40 m"], ["3", "0.80 m"]],
        [["1", "1.00 s"], ["2", "1.80 s"], ["0", "3.00 s"], ["3", "0.60 m"]]
    ]
    assert part == pytest.approx([0.65, 1.2], abs=1e-3)
    assert film_s == pytest.approx(4 + 3 * 0.55, abs=1e-2)
    assert times == pytest.approx([0, part[0], part[0] + 0.1, 4], abs=1e-3)


def test_diverged_robots_arrive_nowhere(service, browser):
    """They have no score, wherever their last finite state was."""
    browser.open(f"stage?designs={robots_of(service, [DESIGN, LINE])}&environment=2")
    browser.until("document.querySelector('.stage')?.player?.stage.robots.length === 2")
    order = module(browser, "stage/race.js", PLAYER + """
        const [first, second] = stage.robots;
        const world = { ...first.world, light: stage.placeOf(first).slice(0, 2) };
        const race = of.raceOf([{ ...first, world, loss: null }, { ...second, world }]);
        done(of.orderAt(race, race.durationS).map(({ robot, text, isArrived }) =>
          [robot.loss === null, text, isArrived]));
    """)
    assert [lost for lost, _, _ in order] == [False, True] and order[1][1:] == ["–", False]


@pytest.mark.parametrize("task, tolerance", [
    ("walk", 0.002), ("circle", 0.01), ("shuttle", 0.03), ("path", 0.03), ("climb", 0.001),
    ("pursue", 0.01), ({"objective": "approach"}, 0.01), ({"guide": {"kind": "ahead"},
                                                           "objective": "jump"}, 0.005)])
def test_what_a_race_measures_is_the_value_of_its_task(service, browser, task, tolerance):
    """At the end, the number in the list is the service's, and the one just before is close."""
    environment = {"task": task, **({"light_xy_m": [4, 2.5]} if "guide" not in task and
                                    isinstance(task, dict) else {})}
    world = service.evaluate({"designs": [DESIGN, LINE], "environments": [environment]}).json()
    ids = ",".join(row["robot"] for row in world["results"])
    browser.open(f"stage?world=evaluation-{world['id']}&designs={ids}")
    browser.until("document.querySelector('.stage')?.player?.stage.robots.length === 2")
    browser.click("Race")
    pause_at(browser, 4.0)
    rows = browser.run(PLAYER + """
        const { rows } = player.standings.race;
        return stage.robots.map((robot) => [rows.get(robot).values.at(-1), robot.value]);""")
    for measured, value in rows:
        assert measured == pytest.approx(value, abs=tolerance)
    best = max(value for _, value in rows)
    first = browser.texts(".stage .names .rows .number")[0]
    assert float(first.split()[0]) == pytest.approx(best, abs=0.006)
    # A light that leads is drawn close to its robot, so that it stays in the lane.
    if task in ("walk", "circle"):
        apart = browser.run(PLAYER + """
            return import(document.querySelector('script[type=module]').src
              .replace(/app.js$/, 'stage/lanes.js')).then(({ lampOf }) => stage.robots.map((r) => {
                const at = lampOf(r, stage.frameOf(r), true);
                const shift = stage.lanes().shifts.get(r);
                const place = stage.placeOf(r).map((value, axis) => value - shift[axis]);
                return Math.hypot(at[0] - place[0], at[1] - place[1]);
              }));""")
        assert apart == pytest.approx([0.45, 0.45], abs=1e-3)


def test_robots_appear_as_they_come(service, browser):
    """A race waits for all robots, or for a click; with more than 16, the best have lanes."""
    ids = ",".join(row["robot"] for row in service.evaluate(
        {"random": {"seed": 5, "count": 20}, "physics": {"n_steps": 20}}).json()["results"])
    with browser.adding(HOLD):
        browser.open(f"stage?designs={ids}&show=skin,trails")
    state = PLAYER + """return [stage.robots.length, player.coming.innerText,
        player.playButton.innerText, stage.timeS > 0];"""
    browser.until("document.querySelector('.stage')?.player?.coming.innerText")
    assert browser.run(state) == [8, "8 of 20 robots", "Start now", False]
    browser.click("Start now")
    browser.until("document.querySelector('.stage').player.stage.timeS > 0")
    first = browser.run(PLAYER + "window.first = stage.robots[0].gpu; return stage.robots[0].id")
    browser.run("release()")
    browser.until("document.querySelector('.stage').player.stage.robots.length === 20")
    assert browser.run(PLAYER + "return [stage.robots[0].id, stage.robots[0].gpu === first,"
                       "player.coming.hidden, stage.robots.map((r) => r.robot).join()]") == [
                           first, True, True, ids]
    lanes, losses = browser.run(PLAYER + "return [stage.lanes().robots.map((r) => r.loss),"
                                "stage.robots.map((r) => r.loss)]")
    assert sorted(lanes) == sorted(losses)[:16]
    assert "the best 16 of 20" in browser.texts(".stage .names")[0]
    browser.click("Side by side")
    assert browser.run(PLAYER + "return stage.views().length") == 20
    assert browser.faults() == []


def test_very_many_views_are_drawn_in_turn(service, browser):
    """While robots move, a picture redraws some of the views; in the end, all of them."""
    browser.open(f"stage?designs={robots_of(service, [DESIGN, PAIR])}")
    browser.until("document.querySelector('.stage')?.player?.stage.robots.length === 2")
    most = browser.run(PLAYER + """
        player.setPlaying(false);
        player.held = true;
        player.setRobots(Array.from({ length: 70 }, (_, i) => stage.robots[i % 2]));
        player.held = true;
        stage.sideBySide = true;
        stage.timeS = 0;
        stage.draw();
        window.views = [];
        stage.timeS = 2;
        stage.draw({ isPart: true });
        return stage.turn;
    """)
    assert 0 < most < 70
    part = browser.pixels(".stage canvas")
    for _ in range(math.ceil(70 / most)):
        browser.run(PLAYER + "stage.draw({ isPart: true })")
    turns = browser.pixels(".stage canvas")
    browser.run(PLAYER + "stage.draw()")
    assert (turns == browser.pixels(".stage canvas")).all()
    assert (part != turns).any()


def test_a_film_of_a_race(service, browser):
    """One button; the film is longer than the race by its slow motion and its end."""
    ids = robots_of(service, [DESIGN, LINE])
    browser.open(f"stage?designs={ids}&world=campaign-{service.campaign}&show=skin,trails")
    browser.until("document.querySelector('.stage')?.player?.stage.robots.length === 2")
    browser.run("window.saved = []; const made = URL.createObjectURL;"
                "URL.createObjectURL = (blob) => { saved.push(blob); return made(blob); };")
    browser.click("Film")
    browser.until("saved.length")
    data = bytes(browser.driver.execute_async_script(
        "saved[0].arrayBuffer().then((all) => arguments[0]([...new Uint8Array(all)]))"))
    assert data[:4] == bytes.fromhex("1a45dfa3") and b"webm" in data[:200]
    at = data.index(bytes.fromhex("4489")) + 2  # milliseconds, after their size in 8 bytes
    duration_s = struct.unpack_from(">d", data, at + 8)[0] / 1000
    race_s, part = browser.run(PLAYER + "return [player.standings.race.durationS,"
                               "player.standings.slowPart]")
    assert duration_s == pytest.approx(race_s + 3 * (part[1] - part[0]) + 1.2, abs=0.05)
    assert browser.faults() == []


def test_a_film_ends_when_the_stage_changes(service, browser):
    """Its pictures would show something else than the race."""
    ids = robots_of(service, [DESIGN, LINE])
    browser.open(f"stage?designs={ids}&environment=2&show=skin")
    browser.until("document.querySelector('.stage')?.player?.stage.robots.length === 2")
    browser.click("Film")
    browser.click("Side by side")
    browser.until("document.querySelector('#toast')?.innerText.includes('The stage has changed')")
    browser.click("Race")
    button = "[...document.querySelectorAll('button')].find((one) => one.innerText === 'Film')"
    assert browser.run(f"return {button}.disabled") is False
    assert browser.faults() == []
