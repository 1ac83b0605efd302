"""The first page: the best robot walks there, its score is true, and three doors lead on."""

import re

import pytest

from browser import Browser
from contract import SOURCE
from service import run

SHIPPED = "00e4402ef444a4aeacaacc60ecaee0000000@7"
SCORED = "/^Score 0/.test([...document.querySelectorAll('.about p')].at(-1)?.innerText)"
SHOWN = """
const { player } = document.querySelector('.stage');
const [robot] = player.stage.robots;
return [robot.robot, robot.loss, player.playing];
"""


def score_shown(browser):
    browser.until(SCORED)
    return re.search(r"Score ([\d.]+)", browser.texts(".about")[0])[1]


def share_of(loss):
    return f"{int(1000 * (1 - loss)) / 10:.1f} %"


@pytest.fixture
def empty(start):
    """A daemon without any data that has the shipped controller, and a page of it."""
    shipped = SOURCE / "data" / "controllers" / "phototaxis-16ms.safetensors"
    running = start(f"--default-controller={shipped}")
    page = Browser(running)
    yield running, page
    page.quit()


def test_the_best_of_the_store_walks(service, browser):
    browser.open("")
    browser.until_walking()
    best = service.get("/v1/designs?sort=score&limit=4")["items"]
    robot, loss, playing = browser.run(SHOWN)
    assert robot == best[0]["robot"] and playing
    assert score_shown(browser) == f"{best[0]['score']:.4f}"
    environment = service.get("/v1/environment-sets/paper-test")["items"][3]
    environment.pop("sha256")
    reply = service.post("/v1/rollouts", {"designs": [{"id": robot}], "record": [],
                                          "environments": [environment]},
                         headers={"Accept": "application/json"})
    assert loss == pytest.approx(reply["rollouts"][0]["loss"], abs=1e-12)
    assert browser.run("return document.querySelector('.about h2 a').hash") == f"#/designs/{robot}"
    doors = browser.run("return [...document.querySelectorAll('.door')].map((e) => e.hash ?? '')")
    robots = ",".join(item["robot"] for item in best)
    assert doors == ["#/lab", "", f"#/stage?designs={robots}&environment=3"]
    browser.run("document.querySelectorAll('.door')[1].click()")
    browser.until("document.querySelector('dialog[open] select[name=preset]')?.value === 'demo'")
    assert browser.faults() == []


def test_an_empty_store_is_no_empty_page(empty):
    """A shipped robot walks. Its score is computed, and is what an evaluation gives. A better robot
    of the store is offered, and does not replace it by itself."""
    running, page = empty
    page.open("")
    page.until_walking()
    assert page.run(SHOWN)[0] == SHIPPED
    assert "reproduction of the paper" in page.texts(".home")[0]
    shown = score_shown(page)
    assert float(shown) < 0.02
    assert page.texts(".way strong") == [share_of(float(shown))]
    page.until("/no jobs are running/.test(document.querySelector('.health').innerText)")
    result = running.evaluate({"designs": [{"id": SHIPPED}]}).json()["results"][0]
    assert f"{result['score']:.4f}" == shown
    run(running, "evaluations", {"designs": [{"cells": [[0, 0, 0], [1, 0, 0]]}]})
    page.open("")
    page.until_walking()
    assert page.run(SHOWN)[0] == SHIPPED and "best score in this store" in page.texts(".home")[0]


def test_a_better_robot_is_offered(start):
    """The service's best may change while the page is open."""
    running = start()
    page = Browser(running)
    try:
        page.open("")
        page.until_walking()
        running.evaluate({"designs": [{"cells": [[0, 0, 0], [1, 0, 0], [1, 1, 0]]}],
                          "label": "later"})
        page.until("/^A new best/.test([...document.querySelectorAll('main button')]"
                   ".find((e) => e.innerText.includes('Show it'))?.innerText)")
        page.run("[...document.querySelectorAll('main button')]"
                 ".find((e) => e.innerText.includes('Show it')).click()")
        best = running.get("/v1/designs?sort=score&limit=1")["items"][0]["robot"]
        page.until("document.querySelector('.stage').player.stage.robots[0].robot === "
                   f"'{best}'")
        assert page.faults() == []
    finally:
        page.quit()


def test_reduced_motion_starts_paused(service, browser):
    media = {"features": [{"name": "prefers-reduced-motion", "value": "reduce"}]}
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        browser.open("")
        browser.until_walking()
        assert browser.run(SHOWN)[2] is False
    finally:
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_who_may_only_look_has_three_doors(start):
    running = start("--dashboard=read-only")
    page = Browser(running)
    try:
        page.open("")
        page.until_walking()
        doors = page.run("return [...document.querySelectorAll('.door')].map((e) => e.hash)")
        assert doors[:2] == ["#/lab", "#/campaigns"]
        assert doors[2].startswith("#/stage?designs=")
    finally:
        page.quit()


def test_the_way_in_words(browser):
    """The share is rounded down: no robot comes farther than it does."""
    words = browser.driver.execute_async_script("""
        const done = arguments[arguments.length - 1];
        const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
        import(folder + 'lib/tasks.js').then(({ wayOf }) =>
          done([0.01128, 0.00001, 0.5, 1, 1.2, null].map((loss) => wayOf(loss).join(''))));
    """)
    assert words == [
        "98.8 % of the way to the light in 4 s", "99.9 % of the way to the light in 4 s",
        "50.0 % of the way to the light in 4 s", "It got no closer to the light in 4 s.",
        "It got no closer to the light in 4 s.", "It diverged, so it has no score."
    ]


def test_jumping_by_keyboard(service, browser):
    """Ctrl and K finds pages, runs and robots by their names; a question mark lists the keys."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    def keys(*all_keys):
        ActionChains(browser.driver).send_keys(*all_keys).perform()

    def jump(text):
        ActionChains(browser.driver).key_down(Keys.CONTROL).send_keys("k") \
            .key_up(Keys.CONTROL).perform()
        browser.until("document.querySelector('dialog.jump[open]')")
        keys(text)
        browser.until("document.querySelector('.jump li')?.innerText.toLowerCase()"
                      f".includes({text.lower()!r})")
        keys(Keys.ENTER)
        browser.until("!document.querySelector('dialog')")

    browser.open("")
    jump("machines")
    browser.until("document.querySelector('h1')?.innerText === 'Machines'")
    jump("<b>walkers</b>")
    browser.until("document.querySelector('h1')?.innerText === '<b>walkers</b> & others'")
    best = service.get("/v1/designs?sort=score&limit=1")["items"][0]["robot"]
    jump(best)
    browser.until(f"document.querySelector('h1 + code')?.innerText === '{best}'")
    name = browser.texts("h1")[0]
    browser.run("location.hash = '#/machines'")
    browser.until("document.querySelector('h1')?.innerText === 'Machines'")
    jump(name)
    browser.until(f"document.querySelector('h1')?.innerText === '{name}'")
    keys("?")
    browser.until("document.querySelector('dialog h2')?.innerText === 'Keyboard shortcuts'")
    keys(Keys.ESCAPE)
    browser.until("!document.querySelector('dialog')")
    browser.run("location.hash = '#/runs'")
    browser.until("document.querySelector('h1')?.innerText === 'Runs'")
    browser.run("document.querySelector('input[type=search]').focus()")
    keys("?")
    browser.until("document.querySelector('input[type=search]').value === '?'")
    assert browser.run("return document.querySelectorAll('dialog').length") == 0
    assert browser.faults() == []


def test_progress_of_jobs_is_polled_by_the_home_page(browser):
    """It comes several times per second, so it is no reason to ask the service again."""
    browser.open("")
    browser.until("/threads? busy/.test(document.querySelector('.health')?.innerText)")
    browser.run("""
        window.asked = 0;
        const send = window.fetch;
        window.fetch = (path, options) => {
          asked += /readyz/.test(path);
          return send(path, options);
        };
        const channel = new BroadcastChannel('morphod-events' + location.pathname);
        let id = 1e12;
        window.report = (type) => channel.postMessage({ type, id: ++id, job: '1' });
        window.sent = 0;
        const timer = setInterval(() => {
          report('job.progress');
          if (++sent === 16) clearInterval(timer);
        }, 250);
    """)
    browser.until("sent === 16")
    assert browser.run("return asked") <= 1, "only the timer of 5 s"
    before = browser.run("return asked")
    browser.run("for (const type of ['job.started', 'job.finished']) report(type)")
    browser.until(f"asked > {before}", 4)
    assert browser.faults() == []
