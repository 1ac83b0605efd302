"""Cards of tasks: a picture and a sentence wherever a task is chosen, and a path of one's own."""

import json
import re

import pytest

from service import DESIGN
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
    """The environments of the card are part of the request; the first card has none."""
    open_form(browser, "training")
    for name, expected in (("random", None), ("walk", "walk")):
        browser.run("document.querySelector(`dialog .tasks input[value=${arguments[0]}]`).click();"
                    "const { elements } = document.querySelector('dialog form');"
                    "elements.kind.value = 'pretrain'; elements.name.value = 'other';"
                    "elements.kind.dispatchEvent(new Event('change', { bubbles: true }))", name)
        browser.click("Copy as a command", "dialog button")
        browser.until("document.querySelectorAll('dialog[open] pre').length === 3")
        curl = browser.texts("dialog pre")[0]
        request = json.loads(re.search(r"-d '(.*)'", curl)[1])
        found = request.get("environments")
        assert (found and found[0]["task"]) == expected
        browser.run("[...document.querySelectorAll('dialog')].at(-1).close()")
        browser.until("document.querySelectorAll('dialog').length === 1")
    browser.run("document.querySelector('dialog').close()")
    assert browser.faults() == []


def test_pictures_are_drawn_from_the_task(browser):
    """Way-points, the direction of the light and the ground are where the request has them."""
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


def drag(browser, points):
    """Draws on the ground with the mouse, in meters."""
    browser.run("document.querySelector(arguments[0]).scrollIntoView({ block: 'center' })", MAP)
    left, bottom, width = browser.run("const { left, bottom, width } = document.querySelector("
                                      "arguments[0]).getBoundingClientRect();"
                                      "return [left, bottom, width]", MAP)

    def send(kind, point):
        x, y = left + point[0] / 5 * width, bottom - point[1] / 5 * width
        browser.driver.execute_cdp_cmd("Input.dispatchMouseEvent", {
            "type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1})

    send("mousePressed", points[0])
    for point in points:
        send("mouseMoved", point)
    send("mouseReleased", points[-1])


def drawn(browser):
    """Returns the way-points in the link."""
    found = browser.run("return new URLSearchParams(location.hash.split('?')[1]).get('task')")
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
    assert f"a path has 1 to {most} way-points" in browser.texts(".draw [role=status]")[0]
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
    # With keys: the cross begins at the last way-point.
    browser.run("document.querySelector(arguments[0]).focus()", MAP)
    field = browser.driver.switch_to.active_element
    field.send_keys("\ue014", "\ue014", "\ue015", "\ue007")  # right, right, down, Enter
    browser.until("(location.hash.match(/%2C/g) ?? []).length === 3")
    assert drawn(browser)[3] == pytest.approx([points[2][0] + 0.2, points[2][1] - 0.1])
    field.send_keys("\ue012" + "\ue007", *(["\ue012\ue007"] * 14))  # left, Enter
    browser.until(f"(location.hash.match(/%2C/g) ?? []).length === {most - 1}")
    words = browser.texts(".draw [role=status]")[0]
    assert f"No way-point was added: a path has 1 to {most} way-points" in words
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
    assert "Simplified" in browser.texts(".draw [role=status]")[0]
    for wrong in ("drawn:", "drawn:3", "drawn:3_x", "drawn:3_3_3", "drawn:2000_1",
                  "drawn:" + ",".join(["3_3"] * 17)):
        browser.open(f"lab?task={wrong}")
        browser.until("document.querySelector('main .error')?.innerText"
                      ".includes('drawn:x_y,x_y with 1 to 16 way-points')")


def test_a_path_on_the_stage(service, browser):
    """It replaces the light of the world, also in the link."""
    robot = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["robot"]
    browser.open(f"stage?designs={robot}&environment=2")
    browser.until_walking()
    heights = "return document.querySelector('.stage').player.stage.robots[0].world.heights"
    ground = browser.run(heights)
    browser.click("Draw a path")
    browser.until(f"document.querySelector('{MAP}')")
    drag(browser, [[3.4, 2.6]])
    browser.until("new URLSearchParams(location.hash.split('?')[1]).get('path')")
    path = browser.run("return new URLSearchParams(location.hash.split('?')[1]).get('path')")
    point = [float(value) for value in path.split("_")]
    assert point == pytest.approx([3.4, 2.6], abs=0.03)
    browser.until("document.querySelector('.stage').player.stage.robots[0].world.points")
    assert browser.run("return document.querySelector('.stage').player.stage.robots[0]"
                       ".world.points") == [point]
    assert browser.run(heights) == ground
    assert "with a path of your own" in browser.texts(".world")[0]
    assert browser.faults() == []
