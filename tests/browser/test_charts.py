"""Charts zoom, switch their scale and hide series by pointer, finger and keys, and their link keeps
it."""

import itertools

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

from conftest import CAMPAIGN
from service import run, until

FIGURE = "[...document.querySelectorAll('figure')].find((e) => e.innerText.startsWith('{}'))"
pytestmark = pytest.mark.usefixtures("still")  # frames would delay what the pointer does
READOUTS = "[...document.querySelectorAll('.readout')].map((e) => e.innerText)"


@pytest.fixture(scope="module")
def evolved(service):
    """A campaign with a dozen generations."""
    return run(service, "campaigns", CAMPAIGN | {"generations": 12, "label": "evolved"})["id"]


def figure(browser, title="Score"):
    return browser.run("return " + FIGURE.format(title))


def canvas(browser, title="Score"):
    return figure(browser, title).find_element("css selector", "canvas")


def described(browser, title="Score"):
    return canvas(browser, title).get_attribute("aria-label")


def press(browser, *keys):
    ActionChains(browser.driver).send_keys(*keys).perform()


def drag(browser, element, start, end):
    """Drags along x, between shares of the width."""
    browser.run("arguments[0].scrollIntoView({block: 'center'})", element)
    width = element.size["width"]
    at = [round((share - 0.5) * width) for share in (start, end)]
    ActionChains(browser.driver, duration=50).move_to_element_with_offset(
        element, at[0], 0).click_and_hold().move_by_offset(at[1] - at[0], 0).release().perform()


def shown(browser, id, query=""):
    browser.open(f"campaigns/{id}{query}")
    browser.until(FIGURE.format("Score"))
    browser.until(f"{FIGURE.format('Score')}.querySelector('canvas').ariaLabel"
                  ".includes('best from')")
    browser.until("document.querySelector('.pick')")  # the page no longer grows


def query(browser):
    return browser.run("return Object.fromEntries(new URLSearchParams("
                       "location.hash.split('?')[1]))")


def test_a_drag_zooms_all_charts_of_a_page(browser, evolved):
    shown(browser, evolved)
    drag(browser, canvas(browser), 0.4, 0.7)
    first, last = map(int, query(browser)["zoom"].split(".."))
    assert 3 <= first < last <= 10
    for title in ("Score", "Diversity and turnover", "Voxels and footprint"):
        assert f", generation {first} to {last}:" in described(browser, title)
    browser.driver.refresh()  # the link has it
    browser.until("document.querySelector('.pick')")
    browser.until(FIGURE.format("Score") + "?.querySelector('canvas')"
                  f".ariaLabel.includes(', generation {first} to {last}:')")
    figure(browser).find_element("xpath", ".//button[text()='Reset zoom']").click()
    assert "zoom" not in query(browser) and "Score: " in described(browser)
    drag(browser, canvas(browser), 0.4, 0.7)
    assert "zoom" in query(browser)
    ActionChains(browser.driver).double_click(canvas(browser)).perform()
    assert query(browser) == {} and browser.faults() == []


def test_a_finger_zooms(browser, evolved):
    shown(browser, evolved)
    element = canvas(browser)
    browser.run("arguments[0].scrollIntoView({block: 'center'})", element)
    box = browser.run("const { left, top, width } = arguments[0].getBoundingClientRect();"
                      "return [left, top, width]", element)

    def touch(kind, *points):
        browser.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {
            "type": kind, "touchPoints": [{"x": box[0] + share * box[2], "y": box[1] + 60}
                                          for share in points]})

    touch("touchStart", 0.4)
    for share in (0.5, 0.6, 0.7):
        touch("touchMove", share)
    touch("touchEnd")
    browser.until("/zoom=/.test(location.hash)")
    assert browser.run(f"return {READOUTS}[0]") != ""  # the cursor stays where the finger was


def test_charts_by_keyboard(service, browser, evolved):
    """One cursor for all charts, and all values of that generation."""
    rows = service.pages(f"/v1/campaigns/{evolved}/generations")
    shown(browser, evolved)
    browser.run("arguments[0].focus()", browser.driver.find_element("css selector", "summary, a"))
    browser.run("arguments[0].focus()", canvas(browser))
    press(browser, Keys.HOME, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    readouts = browser.run(f"return {READOUTS}")
    assert len(readouts) >= 4
    assert all(one.startswith("generation 2: ") for one in readouts), readouts
    assert f"best {rows[2]['score']['quantiles']['p0']:.3g}" in readouts[0]
    assert f"diversity {rows[2]['diversity']:.3g}" in readouts[1]
    press(browser, "+", "+")
    first, last = map(int, query(browser)["zoom"].split(".."))
    assert first <= 2 <= last < 12
    press(browser, Keys.END)  # the view goes with the cursor
    assert query(browser)["zoom"] == f"{12 - (last - first)}..12"
    press(browser, "0")
    assert "zoom" not in query(browser)
    press(browser, "+", "-", "-", Keys.ESCAPE)
    assert query(browser) == {}
    assert {one.split(":")[0] for one in browser.run(f"return {READOUTS}")} <= {"", "generation"}


def test_series_and_scales_are_chosen(browser, evolved):
    shown(browser, evolved)
    by = "[...document.querySelectorAll('.legend button')].find((e) => e.innerText === '{}')"
    for text in ("median", "5 to 95 %"):
        browser.run("arguments[0].focus()", browser.run("return " + by.format(text)))
        press(browser, Keys.SPACE)
    assert "median" not in described(browser) and "best from" in described(browser)
    log = "arguments[0].querySelector('[aria-label^=Logarithmic]')"
    score, turnover = figure(browser), figure(browser, "Diversity")
    assert browser.run(f"return {log}.ariaPressed", score) == "true"
    score.find_element("css selector", "[aria-label^=Logarithmic]").click()
    # A turnover of 0 has no place on a logarithmic axis.
    browser.run(f"const all = {by.format('turnover')}; window.isOff = {log}.disabled;", turnover)
    why = browser.run(f"return isOff ? {log}.title : ''", turnover)
    assert why in ("", "A logarithmic axis needs values above 0")
    assert query(browser) == {"hide": "scores.median|scores.5 to 95 %", "linear": "scores"}
    browser.driver.refresh()
    browser.until(f"{by.format('median')}?.ariaPressed === 'false'")
    browser.until(FIGURE.format("Score") + "?.querySelector('canvas').ariaLabel.includes('best')")
    assert "median" not in described(browser)
    score = figure(browser)
    assert browser.run(f"return {log}.ariaPressed", score) == "false"
    browser.run(by.format("median") + ".click()")
    assert "median from" in described(browser) and browser.faults() == []


def test_values_that_have_no_logarithm(browser):
    """The switch is off, and says why; it is on again when the value is gone."""
    from test_live import module
    browser.open("nowhere")
    assert module(browser, "chart", """({ Chart }) => {
        const chart = new Chart({ title: 'One', log: true });
        document.body.append(chart.element);
        const states = [[1, 2], [0, 2], [-1, 2], [1, 3], []].map((y) => {
          chart.set([{ name: 'one', x: y.map((_, i) => i), y, color: '#ff0000' }]);
          return [chart.isLog, chart.logToggle.disabled, chart.logToggle.title];
        });
        chart.destroy();
        chart.element.remove();
        return states;
    }""") == [[True, False, "Logarithmic axis"],
              *[[False, True, "A logarithmic axis needs values above 0"]] * 2,
              *[[True, False, "Logarithmic axis"]] * 2]


def choose_axis(browser, name):
    browser.run("""
        const e = [...document.querySelectorAll('label')]
          .find((e) => e.innerText.startsWith('Horizontal axis')).querySelector('select');
        e.value = arguments[0];
        e.dispatchEvent(new Event('change'));""", name)


def test_rollouts_and_time_of_a_campaign(service, browser, evolved):
    rows = service.pages(f"/v1/campaigns/{evolved}/generations")
    shown(browser, evolved, "?zoom=3..5")
    choose_axis(browser, "rollouts")
    total = sum(row["rollouts"] for row in rows)
    assert query(browser) == {"x": "rollouts"}  # a range of generations does not apply to rollouts
    assert f"at rollouts {total}" in described(browser)
    choose_axis(browser, "time")
    seconds = list(itertools.accumulate(row["seconds"] for row in rows))
    assert float(described(browser).rsplit("at seconds ", 1)[1]) == pytest.approx(
        seconds[-1], rel=6e-3)
    choose_axis(browser, "generation")
    assert query(browser) == {} and "at generation 12" in described(browser)
    assert browser.faults() == []


def test_robots_and_time_of_a_training(service, browser):
    rows = service.pages(f"/v1/trainings/{service.training}/steps")
    title = "Mean loss of the batch"
    browser.open(f"trainings/{service.training}?x=robots")
    browser.until(f"{FIGURE.format(title)}?.querySelector('canvas').ariaLabel"
                  ".includes('at robots 16')")  # 4 steps of 4
    assert "at robots 0" in described(browser, "Held-out score")
    choose_axis(browser, "time")
    assert float(described(browser, title).rsplit("at seconds ", 1)[1]) == pytest.approx(
        sum(row["seconds"] for row in rows), rel=6e-3)
    assert browser.faults() == []


def test_choices_survive_new_values(service, browser):
    id = service.post("/v1/campaigns", CAMPAIGN | {"generations": 90000, "label": "grows"})["id"]
    until(lambda: service.get(f"/v1/campaigns/{id}")["progress"]["generation"])
    shown(browser, id, "?zoom=0..2&hide=scores.median")
    label = "document.querySelector('figure canvas').ariaLabel"
    browser.run(f"window.before = {label}")
    browser.until(f"{label} !== before")
    assert ", generation 0 to 2:" in described(browser) and "median" not in described(browser)
    service.act(id, "cancel")


def test_keys_reach_only_ranges_that_a_link_can_name(browser, evolved):
    """Numbers in a link have six digits; a narrower range would have two equal ends."""
    shown(browser, evolved, "?x=rollouts")
    browser.run("arguments[0].focus()", browser.driver.find_element("css selector", "summary, a"))
    browser.run("arguments[0].focus()", canvas(browser))
    press(browser, Keys.HOME, Keys.ARROW_RIGHT)
    browser.run("""
        for (let i = 0; i < 60; i++) {
          arguments[0].dispatchEvent(new KeyboardEvent('keydown', { key: '+' }));
        }""", canvas(browser))
    press(browser, Keys.END)  # the view goes with the cursor, to larger numbers
    zoom = query(browser)["zoom"]
    first, last = map(float, zoom.split(".."))
    assert first < last < first * (1 + 1e-4)
    browser.open(f"campaigns/{evolved}?x=rollouts&zoom={zoom}")
    browser.until("document.querySelector('figure canvas')")
    browser.until(f"{FIGURE.format('Score')}?.querySelector('canvas').ariaLabel"
                  ".startsWith('Score, ')")
    assert query(browser)["zoom"] == zoom and browser.texts("#main > [role=alert]") == []
    assert browser.faults() == []


def test_a_link_that_hides_an_unknown_series(browser, evolved):
    """Its chart says so, in a line; the others do not."""
    shown(browser, evolved, "?hide=scores.medain|scores.median|scores")
    [fault] = browser.texts("figure .error:not([hidden])")
    assert fault.startswith("hide=scores.medain|scores: no series has this name; the series are ")
    assert "median" in fault.split("are ")[1] and "median" not in described(browser)
    shown(browser, evolved, "?hide=scores.median")
    assert browser.texts("figure .error:not([hidden])") == []
    assert browser.faults() == []


@pytest.mark.parametrize("query, words", (
    ("zoom=5..2", "use a range such as 10..40"), ("zoom=..", "a range such as 10..40"),
    ("x=robots", "use one of generation, rollouts, time"),
    ("log=speed", "No chart is named speed"), ("hide=speed.best", "No chart is named speed")))
def test_wrong_choices_in_a_link(browser, evolved, query, words):
    browser.open(f"campaigns/{evolved}?{query}")
    browser.until("document.querySelector('[role=alert]')")
    assert words in browser.texts("[role=alert]")[0]
