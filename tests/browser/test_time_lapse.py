"""The time-lapse of a campaign: the champion of each generation, as the service has it."""

import json

import pytest

from conftest import CAMPAIGN, make_study
from service import await_end, run, until
from test_lab import HELD
from test_tray import module

pytestmark = pytest.mark.usefixtures("still")
LAPSE = "document.querySelector('[aria-label=Time-lapse]')"
SAID = LAPSE + ".querySelector('p').innerText"
WALKS = "document.querySelector('.stage').player.stage.robots.map((robot) => robot.label).join()"


def shown(browser, id):
    browser.open(f"campaigns/{id}")
    browser.until(f"{LAPSE} && !{LAPSE}.hidden")


def slide(browser, generation):
    """Moves the slider, as a drag does."""
    browser.run(f"""
        const slider = {LAPSE}.querySelector('input');
        slider.value = arguments[0];
        slider.dispatchEvent(new Event('input'));""", generation)
    browser.until(f"{SAID}.startsWith('Generation {generation}: ')")


def champions(service, id):
    """Returns the best design of each generation."""
    path = f"/v1/campaigns/{id}"
    n = service.get(path)["progress"]["generation"] + 1
    return [service.get(f"{path}/population?generation={at}&limit=1")["items"][0]
            for at in range(n)]


def steps_of(best):
    """Returns the champions without repetitions."""
    numbers = [one["number"] for one in best]
    return [number for at, number in enumerate(numbers) if at == 0 or number != numbers[at - 1]]


def test_champions_are_those_of_the_service(service, browser):
    id = run(service, "campaigns", CAMPAIGN | {"generations": 9, "label": "lapse"})["id"]
    best = champions(service, id)
    shown(browser, id)
    browser.until(LAPSE + ".querySelector('input').value === '9'")  # the newest is chosen at first
    for generation in (0, 9, 4):
        slide(browser, generation)
        design = best[generation]
        assert f": #{design['number']} " in browser.run("return " + SAID)
        assert browser.run("return " + SAID).endswith(f", score {design['score']:.4f}")
        browser.until(f"{WALKS}.startsWith('#{design['number']} ')")
    browser.run("""window.seen = [];
        const { player } = document.querySelector('.stage');
        const { setRobots } = player;
        player.setRobots = function (robots) {
          seen.push(Number(robots[0].label.slice(1).split(' ')[0]));
          setRobots.call(this, robots);
        };
        window.started = performance.now();""")
    browser.click("Play", "[aria-label=Time-lapse] button")
    browser.until(f"{SAID}.includes('That was')")
    expected = steps_of(best)
    seen = browser.run("return seen")
    assert seen[-1] == expected[-1]
    # Without a GPU, some are skipped when a frame takes long.
    rest = iter(expected)
    assert all(number in rest for number in seen), (seen, expected)
    assert 9.5 < browser.run("return (performance.now() - started) / 1000") < 60
    assert f"That was {len(expected)} champion" in browser.run("return " + SAID)
    assert browser.texts("[aria-label=Time-lapse] button")[0] == "Play"
    assert browser.faults() == []


def test_the_user_stops_it(service, browser):
    shown(browser, service.campaign)
    browser.until("document.querySelector('.pick')")
    click = ("Play", "[aria-label=Time-lapse] button"), ("Stop", "[aria-label=Time-lapse] button")
    for text, selector in click:
        browser.click(text, selector)
    browser.click("Play", "[aria-label=Time-lapse] button")
    browser.run("document.querySelector('.pick .card').click()")  # another robot takes the stage
    assert browser.texts("[aria-label=Time-lapse] button")[0] == "Play"
    assert browser.run("return document.querySelector('.stage').player.speed") == 1


def test_a_late_walk_does_not_take_the_stage(service, browser):
    """The reply for a champion that was chosen first arrives after that for the second."""
    shown(browser, service.campaign)
    browser.until("document.querySelectorAll('.pick').length > 1")
    browser.until("document.querySelector('.stage').player.stage?.robots.length > 1")
    browser.run(HELD % "v1/rollouts")
    numbers = browser.run("""
        const cards = [...document.querySelectorAll('.pick .card')].slice(0, 2);
        cards[0].click();
        return cards.map((card) => card.innerText.match(/#\\d+/)[0]);""")
    browser.until("waiting")
    browser.run("document.querySelectorAll('.pick .card')[1].click()")
    browser.until(f"{WALKS}.startsWith('{numbers[1]} ')")
    browser.run("release()")
    browser.until("!waiting")
    assert browser.run(f"return {WALKS}").startswith(numbers[1] + " ")
    assert browser.texts(".stage .note") == [""]


def test_it_grows_while_the_campaign_runs(service, browser):
    id = service.post("/v1/campaigns", CAMPAIGN | {"generations": 90000, "label": "grows"})["id"]
    until(lambda: service.get(f"/v1/campaigns/{id}")["progress"]["generation"])
    shown(browser, id)
    last = f"Number({LAPSE}.querySelector('input').max)"
    browser.run(f"window.before = {last}")
    browser.until(f"{last} > before")
    slide(browser, 1)
    browser.run(f"window.before = {last}")
    browser.until(f"{last} > before")
    assert browser.run("return " + SAID).startswith("Generation 1: ")
    service.act(id, "cancel")


def test_one_generation(service, browser):
    id = run(service, "campaigns", CAMPAIGN | {"generations": 0, "label": "single"})["id"]
    shown(browser, id)
    browser.click("Play", "[aria-label=Time-lapse] button")
    browser.until(f"{SAID}.startsWith('Generation 0: ')")
    browser.until(f"{SAID}.endsWith('That was 1 champion of 1 generation.')")


def test_all_diverged(service, browser):
    id = run(service, "campaigns", CAMPAIGN | {
        "label": "gone", "generations": 1,
        "physics": {"n_steps": 20, "stiffness_n_per_m": 1e6}})["id"]
    rows = service.pages(f"/v1/campaigns/{id}/generations")
    assert [row["score"]["mean"] for row in rows] == [None, None]
    shown(browser, id)
    browser.click("Play", "[aria-label=Time-lapse] button")
    browser.until(f"{SAID} === 'Every robot diverged, so there is no champion.'")
    slide(browser, 0)
    assert "every robot diverged" in browser.run("return " + SAID)
    browser.open(f"campaigns/{service.campaign}?compare={id}")
    browser.until(f"document.querySelector('main').innerText.includes('campaign {id}')")
    assert "NaN" not in browser.texts("main")[0]
    assert browser.faults() == []


def test_scores_that_change_and_units(service, browser):
    """A campaign that learns, one that walks meters, and a study."""
    walk = {"environments": [{"task": "walk"}], "generations": 2, "label": "walks"}
    for id, words in ((run(service, "campaigns", CAMPAIGN | walk)["id"], " m"),
                      (make_study(service), "")):
        best = champions(service, id)
        shown(browser, id)
        slide(browser, 0)
        said = browser.run("return " + SAID)
        assert f": #{best[0]['number']} " in said and said.endswith(words), said
    learning = {"mode": "few-shot", "name": "learner", "generations": 2, "population": 6,
                "label": "learns", "learning": {"parent_steps": 1, "child_steps": 1, "batch": 2}}
    id = service.post("/v1/campaigns", CAMPAIGN | learning)["id"]
    await_end(service, f"/v1/campaigns/{id}")
    best = champions(service, id)
    shown(browser, id)
    assert "newest controller" in browser.run("return " + SAID)
    for generation in range(3):
        slide(browser, generation)
        assert f", score {best[generation]['score']:.4f}" in browser.run("return " + SAID)


def test_a_film(service, browser):
    shown(browser, service.campaign)
    browser.run("window.saved = null; URL.createObjectURL = (blob) => { saved = blob;"
                " return 'blob:'; }; HTMLAnchorElement.prototype.click = () => {};")
    browser.run("document.querySelector('.stage canvas').style.cssText ="
                " 'width: 64px; height: 48px; min-height: 0; flex: none'")  # drawn by the processor
    browser.click("Film", "[aria-label=Time-lapse] button")
    browser.until(f"{SAID} === 'The film is saved.'")
    assert browser.run("return saved.type") == "video/webm"
    assert browser.run("return saved.size") > 20000


def test_another_choice_keeps_the_stage(service, browser):
    """The slider was used before: later generations leave what the user chose since then."""
    id = service.post("/v1/campaigns", CAMPAIGN | {"generations": 90000, "label": "chosen"})["id"]
    until(lambda: service.get(f"/v1/campaigns/{id}")["progress"]["generation"])
    shown(browser, id)
    last = f"Number({LAPSE}.querySelector('input').max)"
    slide(browser, browser.run(f"return {last}"))
    card = browser.run("""const card = document.querySelector('.pick .card');
        card.click();
        return card.innerText;""")  # in a moment, another design may come first
    browser.until(f"{json.dumps(card)}.includes({WALKS}.split(' ')[0])")
    walks = browser.run("return " + WALKS)
    browser.run(f"window.before = {last}")
    browser.until(f"{last} > before + 1")
    assert browser.run("return " + WALKS) == walks
    service.act(id, "cancel")


def test_bodies_that_make_room_are_not_those_that_are_shown(service, browser):
    """Beyond 128 bodies all are dropped, and the one that is to be shown is simulated again."""
    browser.open("nowhere")
    shown = module(browser, "views/time_lapse.js", """
        return (async (id) => {
        const api = await import(folder + 'lib/api.js');
        const job = await api.getJson(`v1/campaigns/${id}`);
        const { items } = await api.getJson(`v1/campaigns/${id}/generations?limit=100`);
        let arrived;
        const next = () => new Promise((resolve) => { arrived = resolve; });
        const stage = { take() {}, player: { setRobots: (robots) => arrived(robots) } };
        const lapse = new of.TimeLapse({ id, get: api.getJson, job: () => job, shown: String,
          signal: new AbortController().signal }, stage);
        lapse.set(items);
        const slide = (generation) => {
          lapse.slider.value = generation;
          lapse.slider.dispatchEvent(new Event('input'));
          return next();
        };
        const [first] = await slide(0);
        for (let i = 0; i < 130; i++) lapse.robots.set(1e6 + i, {});
        const [again] = await slide(0);
        done([first, again].map((robot) => robot?.label ?? null).concat(lapse.robots.size));
        })(arguments[1]);
    """, service.campaign)
    assert shown[0] and shown[1] == shown[0] and shown[2] == 1
