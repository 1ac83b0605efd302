"""Cards of tasks: a picture and a sentence wherever a task is chosen, and a path of one's own."""

import json
import re

import pytest

from service import DESIGN, run
from test_pages import ACCESSIBILITY
from test_tray import module

OPEN = "document.querySelector('[popovertarget=tasks]').click()"
PICK = "document.querySelector(`#tasks input[value=${arguments[0]}]`).click()"
SCORED = "document.querySelector('.result strong')"
MAP = ".ground-map"


def open_form(browser, kind):
    browser.open("overview")
    browser.click(f"New {kind}")
    browser.until("document.querySelector('dialog[open] .tasks')")


def cards(browser, where):
    return browser.run("return [...document.querySelectorAll(`${arguments[0]} .task`)].map((e) =>"
                       "[e.querySelector('input').value, e.innerText])", where)


@pytest.mark.parametrize("kind", ["campaign", "evaluation", "training"])
def test_cards_say_what_a_score_means(service, browser, kind):
    """Each card says which scores are better, and agrees with the unit of the service's values.
    Training runs show losses, so lower is better for all tasks."""
    open_form(browser, kind)
    shown = cards(browser, "dialog")
    assert len(shown) >= 9
    units = {}
    for task in ("walk", "circle", "path", "pursue", "climb"):
        job = service.evaluate({"designs": [DESIGN], "environments": [{"task": task}],
                                "physics": {"n_steps": 20}}).json()
        units[task] = job["results"][0]["losses"][0]["unit"]
    for name, text in shown:
        assert text.count("is better") == (0 if name == "morpho-12" else 1), text
        if name in units:
            is_higher = units[name] == "m" and kind != "training"
            assert ("↑ higher" if is_higher else "↓ lower") in text
            assert ("meters" in text) == is_higher
    assert len(browser.texts("dialog .task svg")) == len(shown)
    browser.run("document.querySelector('dialog').close()")
    assert browser.faults() == []


def test_a_training_learns_the_chosen_task(service, browser):
    """As with lights, each robot has a random terrain of its own; only to climb, it needs slopes.
    The cards say so, and the service accepts what they ask for."""
    open_form(browser, "training")
    for name, text in cards(browser, "dialog"):
        assert ("Ground: random terrains." in text) == (name != "climb"), text
        if name == "pursue":
            assert "Loss: more than 1 if it stands still" in text
    for name in ("random", "walk", "climb", "jump"):
        browser.run("document.querySelector(`dialog .tasks input[value=${arguments[0]}]`).click();"
                    "const { elements } = document.querySelector('dialog form');"
                    "elements.kind.value = 'pretrain'; elements.name.value = 'other';"
                    "elements.kind.dispatchEvent(new Event('change', { bubbles: true }))", name)
        browser.click("Copy as a command", "dialog button")
        browser.until("document.querySelectorAll('dialog[open] pre').length > 0")
        texts = browser.texts("dialog pre")
        request = json.loads(re.search(r"-d '(.*)'", texts[0])[1])
        member = {"random": None, "climb": "environments"}.get(name, "tasks")
        assert set(request) & {"environments", "tasks"} == ({member} if member else set())
        if name == "walk":
            assert request["tasks"] == ["walk"]
            assert any("--tasks walk" in text for text in texts)
        if name == "climb":
            assert [one["task"] for one in request["environments"]] == ["climb", "climb"]
        if name == "jump":
            assert request["tasks"][0]["objective"] == "jump"
            small = {"steps": 1, "batch": 1, "physics": {"n_steps": 20},
                     "validation": {"every_steps": 1, "designs": 1, "environments": 1}}
            job = run(service, "trainings", {**request, **small, "name": "jumper"})
            assert job["state"] == "succeeded" and len(job["settings"]["tasks"]) == 1
        browser.run("[...document.querySelectorAll('dialog')].at(-1).close()")
        browser.until("document.querySelectorAll('dialog').length === 1")
    browser.run("document.querySelector('dialog').close()")
    assert browser.faults() == []


def test_pictures_are_drawn_from_the_task(browser):
    """Waypoints, the direction of the light and the ground are where the request has them."""
    browser.open("nowhere")
    seen = module(browser, "lib/task_picture.js", """
        const flat = { task: { guide: { kind: 'ahead', heading_rad: Math.PI / 2 } } };
        const path = { task: { guide: { kind: 'path', points_m: [[3, 3], [3.5, 2], [4, 3]] } },
          terrain: { kind: 'profile', heights_m: [0, 0, 0.1, 0.1], spacing_m: 0.5 } };
        done([flat, path].map((one) => {
          const picture = of.taskPicture([one]);
          const at = (name) => [...picture.querySelectorAll(name)].map((e) =>
            ['cx', 'cy'].map((side) => Number(e.getAttribute(side))));
          return { start: at('.start'), lamp: at('.lamp'), points: at('.point'),
            ground: picture.querySelector('.ground').getAttribute('d') };
        }));""")
    up, path = seen
    assert up["lamp"][0][0] == pytest.approx(up["start"][0][0])
    assert up["lamp"][0][1] < up["start"][0][1] - 10
    assert len(path["points"]) == 2
    xs = [x for x, _ in path["start"] + path["points"] + path["lamp"]]
    assert xs == sorted(xs) and xs[3] - xs[0] == pytest.approx(3 * (xs[1] - xs[0]))
    heights = [float(point.split(",")[1]) for point in path["ground"][1:].split("L")]
    assert heights[0] == heights[1] > heights[2] == heights[3]
    for one in seen:
        for x, y in one["start"] + one["lamp"] + one["points"]:
            assert 0 < x < 64 and 0 < y < 32


def mouse(browser):
    """Returns what sends an event of the mouse to the ground, at a point in meters."""
    browser.run("document.querySelector(arguments[0]).scrollIntoView({ block: 'center' })", MAP)
    left, bottom, width = browser.run("const { left, bottom, width } = document.querySelector("
                                      "arguments[0]).getBoundingClientRect();"
                                      "return [left, bottom, width]", MAP)

    def send(kind, point, button="left"):
        x, y = left + point[0] / 5 * width, bottom - point[1] / 5 * width
        browser.driver.execute_cdp_cmd("Input.dispatchMouseEvent", {
            "type": kind, "x": x, "y": y, "button": button,
            "buttons": {"left": 1, "right": 2, "none": 0}[button],
            "clickCount": int(kind != "mouseMoved")})

    return send


def drag(browser, points):
    """Draws on the ground with the mouse, in meters."""
    send = mouse(browser)
    send("mousePressed", points[0])
    for point in points:
        send("mouseMoved", point)
    send("mouseReleased", points[-1])


def open_pad(browser, task):
    """Opens the menu with a task, and the ground if it is a drawn one."""
    browser.open(f"lab?task={task}")
    browser.until(SCORED)
    browser.run(OPEN)
    browser.until("document.querySelector('#tasks input[value=draw]')")
    if task.startswith("drawn"):
        browser.until(f"document.querySelector('{MAP}')")


def status(browser):
    return browser.texts(".draw [role=status]")[0]


def in_link(browser, name):
    return browser.run("return new URLSearchParams(location.hash.split('?')[1])"
                       ".get(arguments[0])", name)


def drawn(browser):
    """Returns the waypoints in the link."""
    found = in_link(browser, "task")
    assert found.startswith("drawn:")
    return [[float(value) for value in point.split("_")] for point in found[6:].split(",")]


def test_a_drawn_path_is_a_task(service, browser):
    """The robot of the Lab follows it at once; it is in the link; a campaign can select for it.
    The bounds are those of the contract."""
    most = service.get("/openapi.json")["components"]["schemas"]["GuidePath"]["properties"][
        "points_m"]["maxItems"]
    browser.open("lab")
    browser.until(SCORED)
    browser.run(OPEN)
    browser.until("document.querySelector('#tasks input[value=draw]')")
    browser.run(PICK, "draw")
    browser.until(f"document.querySelector('{MAP}')")
    assert status(browser) == f"No waypoint yet: a path has at most {most}."
    drag(browser, [[2.5 + 0.05 * i, 2.5 + 0.02 * abs(10 - i)] for i in range(21)])
    browser.until("location.hash.includes('task=drawn')")
    points = drawn(browser)
    assert len(points) == 3, points  # to where the stroke begins, its corner and its end
    assert points[1] == pytest.approx([3.0, 2.5], abs=0.06)
    assert points[2] == pytest.approx([3.5, 2.7], abs=0.03)
    stage = "document.querySelector('.stage').player.stage.robots[0]"
    browser.until(f"{stage}.world.points?.length === 3")
    assert browser.run(f"return {stage}.world.points") == points
    browser.until("document.querySelector('.result')?.innerText.includes('Your path')")
    assert browser.run(ACCESSIBILITY) == []
    # With keys: the cross begins at the last waypoint.
    browser.run("document.querySelector(arguments[0]).focus()", MAP)
    field = browser.driver.switch_to.active_element
    field.send_keys("\ue014", "\ue014", "\ue015", "\ue007")  # right, right, down, Enter
    browser.until("(location.hash.match(/%2C/g) ?? []).length === 3")
    assert drawn(browser)[3] == pytest.approx([points[2][0] + 0.2, points[2][1] - 0.1])
    field.send_keys("\ue012" + "\ue007", *(["\ue012\ue007"] * 14))  # left, Enter
    browser.until(f"(location.hash.match(/%2C/g) ?? []).length === {most - 1}")
    assert status(browser) == f"No waypoint was added: a path has at most {most}."
    browser.click("Remove last", ".draw button")
    browser.until(f"(location.hash.match(/%2C/g) ?? []).length === {most - 2}")
    points = drawn(browser)
    link = browser.driver.current_url
    browser.click("Evolve for this task", ".draw button")
    browser.until("document.querySelector('dialog[open] .tasks')")
    assert browser.run("return document.querySelector('dialog .tasks :checked')"
                       ".closest('label').innerText").startswith("Your path")
    browser.click("Copy as a command", "dialog button")
    browser.until("document.querySelectorAll('dialog[open] pre').length === 3")
    request = json.loads(re.search(r"-d '(.*)'", browser.texts("dialog pre")[0])[1])
    assert request["environments"][0] == {"task": {
        "guide": {"kind": "path", "points_m": points}, "objective": "follow"}}
    reply = service.evaluate({"designs": [DESIGN], "environments": request["environments"],
                              "physics": {"n_steps": 20}}).json()
    assert reply["results"][0]["unit"] == "m"
    browser.open(link.split("#/")[1])  # without what the tab has kept
    browser.until(SCORED)
    assert browser.run(f"return {stage}.world.points") == points
    assert browser.faults() == []


def test_a_stroke_has_at_most_sixteen_way_points(browser):
    browser.open("lab?task=drawn:3_3")
    browser.until(SCORED)
    browser.run(OPEN)
    browser.until(f"document.querySelector('{MAP}')")
    drag(browser, [[2.5 + 0.05 * i, 2.5 + (0.4 if i % 2 else 0)] for i in range(40)])
    browser.until("!location.hash.includes('3_3')")
    assert 1 <= len(drawn(browser)) <= 16
    assert status(browser).startswith("Simplified: a path has at most 16 waypoints. This path ")


def test_wrong_way_points_are_refused(browser):
    """Nothing stands for a number: neither "" nor another notation."""
    for wrong in ("drawn:", "drawn:3", "drawn:3_x", "drawn:3_3_3", "drawn:2000_1", "drawn:3_",
                  "drawn:_", "drawn:0x3_1e0", "drawn:3_ 3", "drawn:3_3,",
                  "drawn:" + ",".join(["3_3"] * 17)):
        browser.open(f"lab?task={wrong}")
        browser.until("document.querySelector('main .error')?.innerText"
                      ".includes('drawn:x_y,x_y with 1 to 16 waypoints')")


    for wrong in ("3_", "0x3_1e0"):
        browser.open(f"stage?path={wrong}")
        browser.until("document.querySelector('main .error')?.innerText"
                      ".includes('expected 1 to 16 waypoints')")
    browser.open("lab?task=drawn:-1_2.50")
    browser.until(SCORED)
    assert drawn(browser) == [[-1, 2.5]]


def test_an_unsteady_click_adds_a_way_point(browser):
    """However far the pointer moves back and forth: what counts is how far it gets."""
    points = [[3, 3], [3.5, 3], [4, 3]]
    open_pad(browser, "drawn:" + ",".join(f"{x}_{y}" for x, y in points))
    drag(browser, [[4, 2], [4.03, 2]] * 5)
    browser.until("(location.hash.match(/%2C/g) ?? []).length !== 2")
    *before, last = drawn(browser)
    assert before == points and last == pytest.approx([4, 2], abs=0.03)
    assert status(browser).startswith("This path has 4 waypoints and is ")


def test_a_drawn_path_outlasts_another_choice(browser):
    """In the menu, keys choose each card that they pass."""
    link = "location.hash.includes('task={}')"
    open_pad(browser, "drawn:3_3,4_3")
    browser.run("document.querySelector('#tasks input[value=draw]').focus()")
    left, right = "\ue012", "\ue014"
    browser.driver.switch_to.active_element.send_keys(left)
    browser.until(link.format("jump"))
    assert not browser.run("return document.querySelector(arguments[0])", MAP)
    browser.driver.switch_to.active_element.send_keys(right)
    browser.until(link.format("drawn"))
    assert drawn(browser) == [[3, 3], [4, 3]]
    browser.until(f"document.querySelector('{MAP}')")
    assert status(browser).startswith("This path has 2 waypoints")
    # Also when the menu was closed in between.
    browser.run(PICK, "walk")
    browser.until(link.format("walk"))
    browser.run("document.getElementById('tasks').hidePopover()")
    browser.run(OPEN)
    browser.until("document.querySelector('#tasks input:checked').value === 'walk'")
    browser.run(PICK, "draw")
    browser.until(link.format("drawn"))
    assert drawn(browser) == [[3, 3], [4, 3]]
    assert browser.faults() == []


def test_only_a_stroke_of_the_main_button_draws(browser):
    open_pad(browser, "drawn:3_3")
    route = f"return document.querySelector('{MAP} .route').getAttribute('d')"
    before = browser.run(route)
    send = mouse(browser)
    for kind in ("mousePressed", "mouseMoved", "mouseReleased"):
        send(kind, [4, 4], "right")
    # A move or a release without a press changes nothing; the picture stays.
    browser.run(f"window.shown = document.querySelector('{MAP}').firstChild")
    send("mouseMoved", [2, 2], "none")
    event = "document.querySelector(arguments[0]).dispatchEvent(new PointerEvent(arguments[1]," \
        "{ isPrimary: true }))"
    browser.run(event, MAP, "pointerup")
    assert browser.run(f"return window.shown === document.querySelector('{MAP}').firstChild")
    # The browser ends a stroke: it is gone from the picture, too.
    send("mousePressed", [3, 1])
    send("mouseMoved", [4, 1])
    assert browser.run(route) != before
    browser.run(event, MAP, "pointercancel")
    assert browser.run(route) == before
    send("mouseReleased", [4, 1])
    assert drawn(browser) == [[3, 3]] and browser.run(route) == before
    assert browser.faults() == []


def test_a_key_adds_no_way_point_twice(browser):
    """The page says why, and how far the cross is, without the rest."""
    open_pad(browser, "photo")
    browser.run(PICK, "draw")
    browser.until(f"document.querySelector('{MAP}')")
    browser.run("document.querySelector(arguments[0]).focus()", MAP)
    field = browser.driver.switch_to.active_element
    enter, right = "\ue007", "\ue014"
    field.send_keys(enter)
    refused = "No waypoint was added: the path already ends there."
    assert status(browser) == refused
    field.send_keys(right, right)
    assert status(browser) == "x 2.7 m, y 2.5 m"
    field.send_keys(enter)
    browser.until("location.hash.includes('task=drawn')")
    field.send_keys(enter)
    assert status(browser) == refused and drawn(browser) == [[2.7, 2.5]]
    # A path may come back to the start.
    field.send_keys("\ue012", "\ue012", enter)
    browser.until("location.hash.includes('%2C')")
    assert drawn(browser) == [[2.7, 2.5], [2.5, 2.5]]


def test_a_path_on_the_stage(service, browser):
    """It replaces the light of the world, also in the link, until it is removed. If the service
    is away, the page says so, and the link stays as it is."""
    robot = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["robot"]
    browser.open(f"stage?designs={robot}&world=campaign-{service.campaign}")
    browser.until_walking()
    world = "document.querySelector('.stage').player.stage.robots[0].world"
    seen = f"return [{world}.heights, [...{world}.light]]"
    before = browser.run(seen)
    browser.click("Draw a path")
    browser.until(f"document.querySelector('{MAP}')")
    browser.run("window.send = window.fetch; window.fetch = () => Promise.reject(new TypeError())")
    drag(browser, [[3.4, 2.6]])
    browser.until("document.getElementById('toast').innerText.includes('cannot be reached')")
    browser.run("window.fetch = send")
    browser.click("Springs")  # the link changes with the view
    browser.until("location.hash.includes('springs')")
    assert in_link(browser, "path") is None
    assert browser.run(f"return {world}.points") is None
    browser.click("Remove the path", ".draw button")
    assert status(browser).startswith("No waypoint yet")
    drag(browser, [[3.4, 2.6]])
    browser.until("location.hash.includes('path=')")
    point = [float(value) for value in in_link(browser, "path").split("_")]
    assert point == pytest.approx([3.4, 2.6], abs=0.03)
    browser.until(f"{world}.points")
    assert browser.run(f"return {world}.points") == [point]
    assert browser.run(seen)[0] == before[0]
    assert "with a custom path" in browser.texts(".world")[0]
    browser.click("Remove the path", ".draw button")
    browser.until("!location.hash.includes('path=')")
    browser.until(f"!{world}.points")
    assert browser.run(seen) == before
    assert "custom path" not in browser.texts(".world")[0]
    assert browser.faults() == []


def test_home_shows_a_drawn_path_on_the_stage(browser):
    browser.open("?task=drawn:3_3,4_3")
    browser.until("document.querySelector('a.door[href*=path]')")
    link = browser.run("return document.querySelector('a.door[href*=path]').hash")
    assert "path=3_3,4_3" in link
    assert "reach for a light" not in browser.texts(".doors")[0]
