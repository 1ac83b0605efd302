"""The Lab: what a person does there with a mouse, a finger and keys."""

import json

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.actions.action_builder import ActionBuilder
from selenium.webdriver.common.actions.mouse_button import MouseButton
from selenium.webdriver.common.actions.pointer_input import PointerInput
from selenium.webdriver.common.keys import Keys

ONE = "1" + "0" * 143
SCORED = "/^score/.test(document.querySelector('main p.result').textContent)"
TOAST = "document.querySelector('#toast[data-open]')?.innerText ?? ''"


def genotype(*cells):
    voxels = ["0"] * 144
    for x, y, z in cells:
        voxels[(x * 6 + y) * 4 + z] = "1"
    return "".join(voxels)


def body(browser):
    return browser.run("return new URLSearchParams(location.hash.split('?')[1]).get('voxels')")


def cells(browser):
    """Returns the voxels that the layers show."""
    shown = browser.run("return [...document.querySelectorAll('[aria-selected=true]')]"
                        ".map((e) => e.dataset.cell)")
    return sorted(tuple(map(int, cell.split(","))) for cell in shown)


def middle(browser, selector):
    return browser.run("const e = document.querySelector(arguments[0]);"
                       "e.scrollIntoView({ block: 'nearest' });"
                       "const { left, top, width, height } = e.getBoundingClientRect();"
                       "return [Math.round(left + width / 2), Math.round(top + height / 2)]",
                       selector)


def stroke(browser, *places, kind="mouse", button=MouseButton.LEFT):
    """Presses at the first place, moves to the others, and lets go."""
    pointer = PointerInput(kind, kind)
    builder = ActionBuilder(browser.driver, mouse=pointer, duration=20)
    pointer.create_pointer_move(0, *places[0])
    pointer.create_pointer_down(button=button)
    for place in places[1:]:
        pointer.create_pointer_move(20, *place)
    pointer.create_pointer_up(button=button)
    builder.perform()


def cell(x, y, z):
    return f'[data-cell="{x},{y},{z}"]'


def press(browser, text, *modifiers):
    """Presses a key while others are held."""
    chain = ActionChains(browser.driver)
    for one in modifiers:
        chain.key_down(one)
    chain.send_keys(text)
    for one in modifiers:
        chain.key_up(one)
    chain.perform()


@pytest.mark.parametrize("kind", ("mouse", "pen", "touch"))
def test_a_stroke_paints(browser, kind):
    """The first cell decides whether it sets or clears; a stroke is one step to undo, also when the
    pointer jumps."""
    browser.open("lab?voxels=" + ONE)
    browser.until(SCORED)
    row = [(x, 0, 0) for x in range(6)]
    first, last = (middle(browser, cell(*row[i])) for i in (1, 5))
    stroke(browser, first, last, kind=kind)
    assert cells(browser) == row and body(browser) == genotype(*row)
    up = middle(browser, cell(5, 3, 0))
    stroke(browser, last, middle(browser, cell(4, 0, 0)), kind=kind)  # begins on a voxel: clears
    assert cells(browser) == row[:4]
    stroke(browser, last, up, kind=kind)  # is loose
    assert cells(browser) == row[:4] + [(5, y, 0) for y in range(4)]
    for expected in (row[:4], row, [(0, 0, 0)]):
        browser.click("Undo")
        assert cells(browser) == expected
    browser.click("Undo")
    browser.until(f"({TOAST}).includes('nothing to undo')")
    assert browser.faults() == []


def test_the_last_voxel_stays(browser):
    browser.open("lab?voxels=" + genotype((0, 0, 0), (1, 0, 0)))
    stroke(browser, *(middle(browser, cell(x, 0, 0)) for x in (0, 1)))
    assert cells(browser) == [(1, 0, 0)]
    browser.until(f"({TOAST}).includes('A body needs at least one voxel')")
    right = middle(browser, cell(3, 0, 0))
    stroke(browser, middle(browser, cell(1, 0, 0)), right, button=MouseButton.RIGHT)
    assert cells(browser) == [(1, 0, 0)]  # the right button only clears


def test_undo_and_redo_last(browser):
    """Also after a visit to another page, and with a link to another body."""
    browser.open("lab?voxels=" + ONE)
    browser.until(SCORED)
    bodies = [ONE]
    for x in (1, 2):
        stroke(browser, middle(browser, cell(x, 0, 0)))
        bodies.append(body(browser))
    press(browser, "z", Keys.CONTROL)
    assert body(browser) == bodies[1]
    browser.run("location.hash = '#/machines'")
    browser.until("document.querySelector('h1')?.innerText === 'Machines'")
    browser.run("location.hash = '#/lab'")
    browser.until("document.querySelector('h1')?.innerText === 'Lab'")
    assert body(browser) is None and len(cells(browser)) == 2
    press(browser, "y", Keys.CONTROL)
    assert body(browser) == bodies[2]
    press(browser, "z", Keys.CONTROL)
    press(browser, "z", Keys.CONTROL, Keys.SHIFT)
    assert body(browser) == bodies[2]
    browser.run("location.hash = arguments[0]", "#/lab?voxels=" + "0" * 143 + "1")
    browser.until("document.querySelectorAll('[aria-selected=true]').length === 1")
    browser.click("Redo")
    browser.until(f"({TOAST}).includes('nothing to redo')")  # a new body ends what was undone
    browser.click("Undo")
    assert body(browser) == bodies[2]
    # In a field, the keys undo text.
    browser.click("Import")
    browser.driver.find_element("css selector", "dialog textarea").send_keys("text")
    press(browser, "z", Keys.CONTROL)
    assert body(browser) == bodies[2]
    assert browser.faults() == []


# Replies to a path wait for `release`, also those of requests that were given up.
HELD = """
    const fetched = window.fetch;
    window.waiting = 0;
    window.release = null;
    const held = new Promise((resolve) => { window.release = resolve; });
    window.fetch = async (address, { signal, ...rest } = {}) => {
      if (!String(address).includes(%r)) return fetched(address, { signal, ...rest });
      window.fetch = fetched; // only the first
      waiting++;
      const reply = await fetched(address, rest);
      await held;
      setTimeout(() => { waiting--; }, 300);
      return reply;
    };
"""


def test_what_is_painted_during_a_request_stays(browser):
    """A random body that arrives late does not replace what was painted in the meantime."""
    browser.open("lab?voxels=" + genotype((0, 0, 0), (1, 0, 0)))
    browser.until(SCORED)
    for changes in True, False:
        browser.run(HELD % "v1/bodies/random")
        before = cells(browser)
        browser.click("Random")
        browser.until("waiting")
        if changes:
            stroke(browser, middle(browser, cell(len(before), 0, 0)))
            painted = cells(browser)
            assert len(painted) == len(before) + 1
        browser.run("release()")
        browser.until("!waiting")
        if changes:
            assert cells(browser) == painted and body(browser) == genotype(*painted)
    browser.until("document.querySelectorAll('[aria-selected=true]').length >= 6")
    assert browser.faults() == []


def test_a_late_walk_of_an_older_body_is_not_shown(browser):
    browser.open("lab?voxels=" + genotype((0, 0, 0), (1, 0, 0)))
    browser.until(SCORED)
    browser.run(HELD % "v1/rollouts")
    stroke(browser, middle(browser, cell(2, 0, 0)))
    browser.until("waiting")
    stroke(browser, middle(browser, cell(3, 0, 0)))
    voxels = "document.querySelector('.stage').player.stage.robots[0]?.body.nVoxels"
    browser.until(f"{voxels} === 4")
    browser.run("release()")
    browser.until("!waiting")
    assert browser.run(f"return {voxels}") == 4
    assert "4 voxels" in browser.texts(".result")[0]
    assert browser.faults() == []


def test_loose_voxels_are_marked(browser):
    """The message counts them, and the stage says that another body walks."""
    browser.open("lab?voxels=" + genotype((0, 0, 0), (1, 0, 0), (2, 0, 0)))
    browser.until(SCORED)
    assert not browser.run("return document.querySelector('.warning').offsetParent")
    stroke(browser, *(middle(browser, cell(x, 4, 0)) for x in (2, 3)))
    assert browser.texts(".warning span") == ["2 loose voxels: connect or remove them"]
    loose = browser.run("return [...document.querySelectorAll('.cells .loose')]"
                        ".map((e) => e.getAttribute('aria-label'))")
    assert loose == ["x 2, y 4, layer 0: loose voxel", "x 3, y 4, layer 0: loose voxel"]
    assert browser.run("return document.querySelectorAll('.shape .loose').length") > 3
    assert browser.texts(".stage .note")[0].startswith("Still walking: ")
    opacity = "Number(getComputedStyle(document.querySelector('.stage canvas')).opacity)"
    assert browser.run(f"return {opacity}") < 0.5
    assert "no score: 2 voxels are loose" in browser.texts(".result")[0]
    styles = "const { borderTopStyle, backgroundImage } = getComputedStyle(" \
        "document.querySelector(arguments[0])); return [borderTopStyle, backgroundImage]"
    assert browser.run(styles, cell(2, 4, 0)) != browser.run(styles, cell(2, 0, 0))
    browser.click("Remove loose voxels")
    assert cells(browser) == [(x, 0, 0) for x in range(3)]
    browser.until(SCORED)
    assert browser.run(f"return {opacity}") == 1 and browser.texts(".stage .note") == [""]
    assert browser.faults() == []


def test_loose_voxels_differ_in_forced_colors(browser):
    browser.open("lab?voxels=" + genotype((0, 0, 0), (1, 0, 0), (3, 0, 0)))
    browser.until("document.querySelector('.cells .loose')")
    media = {"features": [{"name": "forced-colors", "value": "active"}]}
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        looks = [browser.run("const { backgroundColor, borderTopStyle } = getComputedStyle("
                             "document.querySelector(arguments[0]));"
                             "return [backgroundColor, borderTopStyle]", cell(x, 0, 0))
                 for x in (0, 3, 5)]  # a voxel, a loose one, an empty cell
        assert looks[0][0] != looks[1][0] and looks[1][1] == "dashed" != looks[2][1]
    finally:
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def face(browser, x, y, z, side):
    """Returns a place on a side of a voxel, or of the floor."""
    return middle(browser, f'[data-face="{x},{y},{z},{side}"]')


TOP, FRONT = 5, 2


def test_faces_are_clicked(browser):
    """A click adds, Shift, the right button or the switch removes; the pointer shows the place."""
    browser.open("lab?voxels=" + genotype((2, 2, 0)))
    browser.until(SCORED)
    at = face(browser, 2, 2, 0, TOP)
    chain = ActionBuilder(browser.driver)
    chain.pointer_action.move_to_location(*at)
    chain.perform()
    assert browser.texts(".place") == ["add x 2, y 2, layer 1"]
    assert browser.run("return document.querySelectorAll('.ghost .adds').length") == 3
    stroke(browser, at)
    assert cells(browser) == [(2, 2, 0), (2, 2, 1)]
    stroke(browser, face(browser, 2, 2, 0, FRONT))
    assert cells(browser) == [(2, 1, 0), (2, 2, 0), (2, 2, 1)]
    stroke(browser, face(browser, 4, 4, -1, TOP))  # the floor
    assert (4, 4, 0) in cells(browser)
    stroke(browser, face(browser, 4, 4, 0, TOP), button=MouseButton.RIGHT)
    assert (4, 4, 0) not in cells(browser)
    at = face(browser, 2, 2, 1, TOP)
    chain = ActionChains(browser.driver).key_down(Keys.SHIFT)
    chain.w3c_actions.pointer_action.move_to_location(*at).click()
    for _ in range(3):  # a move, a press, a release
        chain.w3c_actions.key_action.pause()
    chain.key_up(Keys.SHIFT).perform()
    assert cells(browser) == [(2, 1, 0), (2, 2, 0)]
    browser.click("Remove")
    stroke(browser, face(browser, 2, 1, 0, FRONT), kind="touch")
    assert cells(browser) == [(2, 2, 0)]
    browser.click("Add")
    stroke(browser, face(browser, 2, 2, 0, TOP), kind="touch")
    assert cells(browser) == [(2, 2, 0), (2, 2, 1)]
    browser.click("Undo")
    assert cells(browser) == [(2, 2, 0)]
    assert browser.faults() == []


def test_the_workspace_ends(browser):
    browser.open("lab?voxels=" + genotype(*((0, 0, z) for z in range(4))))
    before = cells(browser)
    for side in (TOP, FRONT):
        browser.run("document.querySelector('#toast button').click()")
        stroke(browser, face(browser, 0, 0, 3, side))
        browser.until(f"({TOAST}).includes('The workspace ends here: it has 6 × 6 × 4 voxels')")
    assert cells(browser) == before


def test_the_drawing_turns(browser):
    """A drag turns it and changes no voxel; every side can be seen."""
    browser.open("lab?voxels=" + genotype((2, 2, 0)))
    sides = "return [...document.querySelectorAll('.shape [data-face^=\"2,2,0,\"]')]" \
        ".map((e) => Number(e.dataset.face.slice(-1)))"
    seen = set(browser.run(sides))
    assert seen == {0, FRONT, TOP}
    x, y = face(browser, 2, 2, 0, TOP)
    stroke(browser, (x, y), (x + 90, y), (x + 180, y))
    seen |= set(browser.run(sides))
    browser.run("for (let i = 0; i < 3; i++)"
                "document.querySelector('[aria-label=\"Turn to the right\"]').click()")
    seen |= set(browser.run(sides))
    browser.run("for (let i = 0; i < 3; i++)"
                "document.querySelector('[aria-label=\"Look from lower down\"]').click()")
    seen |= set(browser.run(sides))
    assert seen == set(range(6)) and cells(browser) == [(2, 2, 0)]
    stroke(browser, face(browser, 2, 2, 0, 4))  # from below, the ground is the end
    browser.until(f"({TOAST}).includes('The workspace ends here')")


def test_the_task_of_the_bar(service, browser):
    """It is the task of the Lab's score, of Home and of Designs, is kept, and is in the link."""
    def choose(name):
        if not browser.run("return document.querySelector('#tasks:popover-open')"):
            browser.run("document.querySelector('[popovertarget=tasks]').click()")
        browser.until("document.querySelector('#tasks input')")
        browser.run("document.querySelector(`#tasks input[value=${arguments[0]}]`).click()", name)

    bar = genotype((1, 1, 0), (2, 1, 0), (3, 1, 0))
    browser.open("lab?voxels=" + bar)
    browser.until(SCORED)
    assert "lower is better\nReach the light" in browser.texts(".result")[0]
    choose("walk")
    browser.until("document.querySelector('.result .better')?.innerText.includes('higher')")
    rows = service.post("/v1/rollouts", {"designs": [{"voxels": bar}], "record": [],
                                         "environments": "morpho-12-walk"},
                        headers={"Accept": "application/json"})["rollouts"]
    value = sum(row["value"] for row in rows) / len(rows)
    digits = 3 if abs(value) < 0.995 else 2
    text = browser.texts(".result")[0]
    assert text.startswith(f"score {value:.{digits}f} m ↑ higher is better\nWalk, mean over the")
    assert "task=walk" in browser.driver.current_url
    browser.click("Keep")
    kept = json.loads(browser.run("return sessionStorage.getItem('morphod-tray')"))
    assert kept[0]["note"] == f"score {value:.{digits}f} m"
    browser.run("location.hash = '#/designs'")
    browser.until("document.querySelector('main')?.innerText.includes('morpho-12-walk')")
    assert "#/designs?task=walk" in browser.driver.current_url
    for name, words in (("climb", "morpho-12-up"), ("walk", "morpho-12-walk")):
        choose(name)  # by keyboard, one after the other
        browser.until(f"document.querySelector('main')?.innerText.includes('{words}')")
        assert browser.run("return document.querySelector('#tasks:popover-open') !== null")
    service.evaluate({"designs": [{"voxels": bar}], "environments": "morpho-12-walk"})
    browser.run("location.hash = '#/'")
    browser.until("/^[\\d.]+ m: Walk$/.test(document.querySelector('.way')?.innerText)")
    assert "The best score in this store in this task" in browser.texts(".home")[0]
    stage = browser.run("return [...document.querySelectorAll('.door')].at(-1).hash")
    assert stage.endswith("&environment=3&set=morpho-12-walk")
    choose("pursue")
    browser.until("document.querySelector('.way')?.innerText.includes('Pursue')")
    door = browser.texts(".door")[-1]
    assert "There they reach for a light" in door, door
    assert "This store has no scores to rank for this task" in browser.texts(".home")[0]
    browser.run("location.hash = '#/machines'")
    browser.until("document.querySelector('h1')?.innerText === 'Machines'")
    assert browser.run("return document.querySelector('#tasks')") is None
    browser.open("lab?task=efficient&voxels=" + bar)
    browser.until(SCORED)
    assert "m/kJ ↑ higher is better" in browser.texts(".result")[0]
    assert [fault for fault in browser.faults() if "404" not in fault] == []


def test_links_to_the_editor_lead_to_the_lab(browser):
    browser.open("editor?voxels=" + ONE)
    browser.until("document.querySelector('h1')?.innerText === 'Lab'")
    assert "#/lab?voxels=" + ONE in browser.driver.current_url and cells(browser) == [(0, 0, 0)]
    browser.open("lab?task=swim")
    browser.until("document.querySelector('main .error')?.innerText"
                  ".includes('task=swim is invalid; use one of')")


def test_on_a_phone_the_stage_stays_in_sight(browser):
    metrics = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        browser.open("lab?voxels=" + ONE)
        browser.until(SCORED)
        for selector in (cell(0, 0, 0), cell(5, 5, 3), ".shape"):
            _, y = middle(browser, selector)
            top, bottom, right = browser.run(
                "const { top, bottom } = document.querySelector('.stage canvas')"
                ".getBoundingClientRect();"
                "return [top, bottom, document.documentElement.scrollWidth]")
            assert -1 <= top and bottom < y < 844 and right == 390, selector
    finally:
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
