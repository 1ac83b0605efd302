"""Ghosts: a race on one ground, where all robots but one are translucent."""

import numpy
import pytest

from service import DESIGN
from test_race import LINE, PAIR, PLAYER, pause_at, robots_of


@pytest.fixture
def ghosts(service, browser):
    """A race of three robots, shown as ghosts by the keyboard, that stands still."""
    browser.open(f"stage?designs={robots_of(service, [DESIGN, PAIR, LINE])}&environment=2")
    browser.until_walking()
    browser.run("[...document.querySelectorAll('.stage .pair button')].at(-1).focus()")
    browser.driver.switch_to.active_element.send_keys(" ")
    browser.until(PLAYER.replace("const", "(() => { const") + "return stage.ghosts; })()")
    return browser


def pictures(browser, script):
    """Returns the picture with all robots, after a script, and those that each lack one robot."""
    browser.run(PLAYER + "player.held = true; Object.assign(stage, { scale: 1, shadows: false });"
                "stage.show.trails = false; stage.follow = false;" + script)
    taken = []
    for lacking in (-1, 0, 1, 2):
        browser.run(PLAYER + """
            const body = stage.robots[arguments[0]]?.body ?? {};
            const { nFaces } = body;
            body.nFaces = 0;
            stage.draw();
            body.nFaces = nFaces;""", lacking)
        taken.append(browser.pixels(".stage canvas")[:, :, :3].astype(int))
    return taken


def test_no_ghost_hides_another(ghosts):
    """All start at the same place, and each of them changes the picture there. The opaque robot
    is the one that is pointed at, and it changes the picture most."""
    pause_at(ghosts, 0.0)
    assert ghosts.run(PLAYER + "return stage.views().length") == 1
    shifts = ghosts.run(PLAYER + "return stage.robots.map((r) => stage.lanes().shifts.get(r))")
    assert not numpy.any(shifts)
    change = []
    for pointed in range(3):
        whole, *lacking = pictures(ghosts, f"stage.hovered = stage.robots[{pointed}];")
        apart = [abs(whole - one) for one in lacking]
        change.append([one.sum() for one in apart])
        for one in apart:
            assert (one.max(axis=2) > 8).sum() > 30, "a robot is hidden"
    for robot in range(3):
        others = [change[pointed][robot] for pointed in range(3) if pointed != robot]
        assert change[robot][robot] > 1.5 * max(others)
    assert ghosts.faults() == []


def test_which_robot_is_opaque(ghosts):
    """The leader; the one under the pointer, in the list or on the stage; or the followed one."""
    solid = PLAYER + "return stage.robots.indexOf(stage.solid())"
    pause_at(ghosts, 3.9)
    order = ghosts.run(PLAYER + "return player.standings.order.map(({ robot }) => "
                       "stage.robots.indexOf(robot))")
    assert ghosts.run(solid) == order[0]
    row = "document.querySelectorAll('.names .rows button')[1]"
    ghosts.run(f"{row}.dispatchEvent(new PointerEvent('pointerenter'))")
    assert ghosts.run(solid) == order[1]
    ghosts.run(f"{row}.dispatchEvent(new PointerEvent('pointerleave'))")
    assert ghosts.run(solid) == order[0]
    ghosts.run("document.querySelectorAll('.names .rows button')[2].focus()")
    assert ghosts.run(solid) == order[2]
    ghosts.run("document.activeElement.blur()")
    x, y = ghosts.run(PLAYER + """
        stage.draw();
        const [{ x, y }] = stage.placesOf(stage.placeOf(stage.robots[arguments[0]]));
        const { left, top } = stage.canvas.getBoundingClientRect();
        return [left + x, top + y];""", order[2])

    def move_pointer(x, y):
        ghosts.driver.execute_cdp_cmd("Input.dispatchMouseEvent",
                                      {"type": "mouseMoved", "x": x, "y": y})

    move_pointer(x, y)
    ghosts.until(f"(() => {{ {solid} }})() === {order[2]}", 10)
    move_pointer(3, 3)
    ghosts.until(f"(() => {{ {solid} }})() === {order[0]}", 10)
    ghosts.run(f"{row}.click()")
    assert ghosts.run(solid) == order[1]
    # Before the first picture, nothing is under the pointer.
    ghosts.run(PLAYER + "stage.drawn = null; stage.canvas.dispatchEvent("
               "new PointerEvent('pointermove'))")
    assert ghosts.run(solid) == order[1]
    assert ghosts.faults() == []


def test_ghosts_are_part_of_the_link(ghosts):
    pause_at(ghosts, 1.5)
    ghosts.until("/ghosts/.test(location.hash) && /time=1.50/.test(location.hash)")
    link = ghosts.driver.current_url
    ghosts.open(link.split("#/")[1])
    ghosts.until_walking()
    pressed = "return [...document.querySelectorAll('.pair [aria-pressed=true]')]" \
        ".map((e) => e.innerText)"
    assert ghosts.run(pressed) == ["Ghosts"]
    # Stacked names do not cover each other.
    boxes = ghosts.run("return [...document.querySelectorAll('.tag')].map((e) => {"
                       "const { x, y } = e.getBoundingClientRect(); return [x, y] })")
    assert len(boxes) == 3
    for i, (x, y) in enumerate(boxes):
        for left, top in boxes[:i]:
            assert abs(x - left) > 60 or abs(y - top) > 20
    ghosts.click("Race")
    ghosts.until("!/ghosts/.test(location.hash)")
    assert ghosts.run(pressed) == ["Race"]
    assert ghosts.run(PLAYER + "return Boolean(stage.lanes().lane)")
    assert ghosts.faults() == []


def test_a_film_of_ghosts(service, browser):
    """The button films what is shown: in each picture, the leader at that time is opaque."""
    ids = robots_of(service, [DESIGN, LINE])
    browser.open(f"stage?designs={ids}&world=campaign-{service.campaign}&show=skin,ghosts")
    browser.until_walking()
    browser.run(PLAYER + """
        window.drawn = [];
        window.saved = 0;
        URL.createObjectURL = () => { saved++; return '#'; };
        window.race = player.standings.race;
        const { drawImage } = CanvasRenderingContext2D.prototype;
        CanvasRenderingContext2D.prototype.drawImage = function (...how) {
          drawn.push([stage.timeS, stage.robots.indexOf(stage.solid())]);
          stage.hovered = stage.robots[drawn.length % 2]; // the film must not show where it points
          drawImage.apply(this, how);
        };""")
    browser.click("Film")
    browser.until("window.saved", 300)
    expected = browser.driver.execute_async_script("""
        const done = arguments[0];
        const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
        import(folder + 'stage/race.js').then(({ orderAt }) => {
          const { stage } = document.querySelector('.stage').player;
          done(drawn.map(([time]) => stage.robots.indexOf(orderAt(race, time)[0].robot)));
        });""")
    drawn = browser.run("return drawn")
    assert len(drawn) > 10 and [robot for _, robot in drawn] == expected
    assert browser.faults() == []


def test_a_leading_light_is_where_it_is(service, browser):
    """Only a lane is too short for it: on one ground, it is drawn where the controller sees it."""
    ids = robots_of(service, [DESIGN, LINE])
    browser.open(f"stage?designs={ids}&set=morpho-12-walk&show=skin,ghosts")
    browser.until_walking()
    away = browser.run(PLAYER + """
        const { terrain } = stage.programs;
        const { set } = terrain;
        let light;
        terrain.set = (values) => { light = values.lightAt; return set.call(terrain, values); };
        stage.draw();
        delete terrain.set;
        const [x, y] = stage.placeOf(stage.solid());
        return Math.hypot(light[0] - x, light[1] - y);""")
    assert away == pytest.approx(1.5, abs=0.1)
