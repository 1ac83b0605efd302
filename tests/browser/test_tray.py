"""Names of robots, and the tray: the same robots on every page, and what can be done with them."""

import json
import re

from service import DESIGN
from test_pages import ACCESSIBILITY

# Awaits a module of the page: arguments[0] is its path, `of` gets its exports.
MODULE = """
const done = arguments[arguments.length - 1];
const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
import(folder + arguments[0]).then((of) => { %s }).catch((no) => done(String(no)));
"""
CHIPS = "document.querySelectorAll('#tray li').length"
# Keeps the files that the page saves, instead of a download.
SAVES = """
window.saved = {};
const blobs = new Map();
const make = URL.createObjectURL;
URL.createObjectURL = (blob) => { const url = make(blob); blobs.set(url, blob); return url; };
HTMLAnchorElement.prototype.click = function () {
  blobs.get(this.href).text().then((text) => { window.saved[this.download] = text; });
};
"""


def module(browser, path, script, *arguments):
    return browser.driver.execute_async_script(MODULE % script, path, *arguments)


def test_words_of_names(browser):
    """256 of each kind, which nobody confuses: each pair differs by more than a letter."""
    browser.open("nowhere")
    words = module(browser, "lib/names.js", "done(of.WORDS)")
    for kind in ("adjectives", "nouns"):
        all_words = words[kind]
        assert len(set(all_words)) == len(all_words) == 256
        assert all(re.fullmatch("[a-z]{3,9}", word) for word in all_words)
        for i, one in enumerate(all_words):
            for other in all_words[:i]:
                differing = sum(a != b for a, b in zip(one, other))
                assert len(one) != len(other) or differing > 1, (one, other)
    assert not set(words["adjectives"]) & set(words["nouns"])


def test_a_name_belongs_to_a_design(service, browser):
    """All orientations have one name, which never changes; other designs mostly have others. The id
    that the page computes is the service's."""
    browser.open("nowhere")
    bodies = service.post("/v1/bodies/random", {"seed": 3, "count": 300})["items"]
    robots = module(browser, "lib/body.js", "done(arguments[1].map(of.robotOf))",
                    [body["genotype"] for body in bodies])
    assert robots == [body["robot"] for body in bodies]
    names = module(browser, "lib/names.js", "done(arguments[1].map(of.nameOf))",
                   [f"{robot[:36]}@{k}" for robot in robots for k in range(8)])
    assert len({tuple(names[8 * i:8 * i + 8]) for i in range(300)}) > 290
    assert all(len(set(names[8 * i:8 * i + 8])) == 1 for i in range(300))
    fixed = "00e4402ef444a4aeacaacc60ecaee0000000"
    assert module(browser, "lib/names.js", "done(of.nameOf(arguments[1]))", fixed) == \
        "woolly pinwheel"


def test_a_robot_has_one_name_everywhere(service, browser):
    champions = service.get(f"/v1/campaigns/{service.campaign}/champions")["items"]
    best = min(champions, key=lambda one: one["score"])
    browser.open("nowhere")
    name = module(browser, "lib/names.js", "done(of.nameOf(arguments[1]))", best["id"])
    browser.open(f"campaigns/{service.campaign}")
    browser.until("document.querySelectorAll('.pick').length > 1")
    assert name in browser.texts(".pick")[0] and f"#{best['number']}" in browser.texts(".pick")[0]
    browser.open(f"campaigns/{service.campaign}/phylogeny?design={best['number']}")
    browser.until(f"document.querySelector('main h2')?.innerText === '#{best['number']} {name}'")
    browser.open(f"designs/{best['robot']}")
    browser.until(f"document.querySelector('main h1')?.innerText === '{name}'")
    browser.open(f"stage?designs={best['robot']},{'f' * 36}@0")
    browser.until(f"document.querySelector('.tag')?.innerText.includes('{name}')")
    browser.open(f"lab?design={best['robot']}")
    browser.until(f"document.querySelector('p.result')?.innerText.includes('{name}')")
    assert browser.faults() == []


def select(browser, n):
    browser.open("designs")
    browser.until(f"document.querySelectorAll('.card').length >= {n}")
    browser.run("[...document.querySelectorAll('.card')].slice(0, arguments[0])"
                ".forEach((e) => e.click())", n)
    browser.click("Add to tray")
    browser.until(f"{CHIPS} === {n}")


def test_robots_stay_in_the_tray_on_every_page(service, browser):
    service.evaluate({"designs": [DESIGN, {"cells": [[0, 0, 0], [1, 0, 0]]},
                                  {"cells": [[0, 0, 0], [1, 0, 0], [2, 0, 0]]}]})
    best = [one["robot"] for one in service.get("/v1/designs?sort=score&limit=3")["items"]]
    select(browser, 3)
    browser.click("Watch", "#tray button")
    browser.until("document.querySelectorAll('.tag').length === 3")
    browser.until("document.querySelector('.stage').player.stage.sideBySide")
    address = "new URLSearchParams(location.hash.split('?')[1])"
    browser.until(f"{address}.get('designs') === {','.join(best)!r}")
    browser.click("Race", "#tray button")
    browser.until("document.querySelector('.stage')?.player.stage.robots.length === 3 && "
                  "!document.querySelector('.stage').player.stage.sideBySide")
    browser.run("history.back()")
    browser.click("Compare", "#tray button")
    browser.until("document.querySelectorAll('.compared tbody td.number').length === 33")
    scores = service.evaluate({"designs": [{"id": robot} for robot in best]}).json()["results"]
    assert browser.texts(".compared tbody td:nth-child(2)") == \
        [f"{one['score']:.4f}" for one in scores]
    assert browser.texts(".compared tbody td:nth-child(9)") == \
        [f"{one['losses'][3]:.4f}" for one in scores]
    assert browser.run(ACCESSIBILITY) == []
    browser.click("Breed", "#tray button")
    browser.until("document.querySelector('dialog[open]')?.innerText.includes('3 designs')")
    browser.click("Cancel")
    # It is still there after a reload, and shrinks robot by robot. The focus stays in the tray.
    browser.run("location.reload()")
    browser.until(f"{CHIPS} === 3")
    browser.run("document.querySelector('#tray .remove').focus();"
                "document.querySelector('#tray .remove').click()")
    browser.until(f"{CHIPS} === 2")
    assert browser.run("return document.activeElement.closest('#tray') !== null")
    browser.click("Clear", "#tray button")
    browser.click("Clear the tray", "dialog button")
    browser.until("document.getElementById('tray').hidden")
    assert browser.faults() == []


def test_the_tray_is_filled_on_other_pages(service, browser):
    browser.open(f"campaigns/{service.campaign}")
    browser.until("document.querySelectorAll('.pick input').length > 1")
    browser.run("document.querySelector('.pick input').click()")
    browser.click("Add to tray")
    browser.until(f"{CHIPS} === 1")
    browser.run("location.hash = arguments[0]",
                f"#/campaigns/{service.campaign}/phylogeny?design=3")
    browser.until("document.querySelector('main h2')?.innerText.startsWith('#3 ')")
    browser.click("Add to tray")
    browser.run("location.hash = arguments[0]", f"#/stage?designs={'f' * 36}@0")
    browser.until_walking()
    browser.click("Add to tray")
    browser.until(f"{CHIPS} === 3 || {CHIPS} === 2")  # design 3 may be the champion
    # In the Lab, a robot of the tray is edited, and that can be undone.
    browser.run("location.hash = '#/lab?voxels=' + arguments[0]", "1" + "0" * 143)
    browser.until("document.querySelectorAll('[aria-selected=true]').length === 1")
    browser.run("[...document.querySelectorAll('#tray .robot')].at(-1).click()")
    browser.until("document.querySelectorAll('[aria-selected=true]').length === 144")
    browser.click("Undo")
    browser.until("document.querySelectorAll('[aria-selected=true]').length === 1")
    # On any other page the Lab opens with it.
    browser.run("location.hash = '#/machines'")
    browser.until("document.querySelector('h1')?.innerText === 'Machines'")
    browser.run("[...document.querySelectorAll('#tray .robot')].at(-1).click()")
    browser.until("document.querySelectorAll('[aria-selected=true]').length === 144")
    assert browser.faults() == []


def test_files_of_the_tray(service, browser):
    browser.open("lab?voxels=" + "1" + "0" * 143)
    browser.click("Import")
    browser.run("document.querySelector('dialog textarea').value = arguments[0];"
                "document.querySelector('dialog form').requestSubmit()",
                "[[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 0, 1], [2, 1, 1]]")
    browser.until("document.querySelectorAll('[aria-selected=true]').length === 5")
    browser.click("Keep")
    browser.until(f"{CHIPS} === 1")
    browser.run(SAVES)
    browser.click("Export", "#tray button")
    browser.click("Genotypes (JSON)")
    browser.click("EvoGym (JSON)")
    browser.until("Object.keys(window.saved).length === 2")
    saved = browser.run("return window.saved")
    [one] = json.loads(saved["morphod-tray.json"])
    result = service.evaluate({"designs": [{"voxels": one["voxels"]}]}).json()["results"][0]
    assert one["description"].startswith(result["robot"]) and one["name"].count(" ") == 1
    [flat] = json.loads(saved["morphod-tray-evogym.json"])
    assert flat["body"] == [[0, 0, 3], [3, 3, 3]] and flat["robot"] == result["robot"]


def test_the_tray_has_an_end(browser):
    """64 robots fit; a refusal says so. A design is in it once, whatever its orientation."""
    browser.open("nowhere")
    grown = """
      const robots = Array.from({ length: 80 }, (_, i) => ({ note: '', genotype: '1'.repeat(144),
        robot: `${String(i).padStart(36, '0')}@0` }));
      const added = of.tray.add(robots);
      done([added.length, of.tray.kept.length,
        of.tray.add([{ ...robots[0], robot: robots[0].robot.replace('@0', '@3') }]).length]);
    """
    assert module(browser, "lib/tray.js", grown) == [64, 64, 0]
    browser.run("location.hash = '#/designs'")
    browser.until("document.querySelectorAll('.card').length > 0")
    browser.run("document.querySelector('.card').click()")
    browser.click("Add to tray")
    browser.until("/tray is full/.test(document.querySelector('#toast.refusal')?.innerText)")


def test_the_tray_covers_nothing_that_has_the_focus(service, browser):
    """On a phone it is one line. What gets the focus is scrolled to above it, and the end of the
    page is above it, too."""
    metrics = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        select(browser, 2)
        assert browser.run("return document.getElementById('tray').offsetHeight") < 60
        assert browser.run("return document.documentElement.scrollWidth") <= 390
        browser.until("document.documentElement.style.getPropertyValue('--tray') ==="
                      "`${document.getElementById('tray').offsetHeight}px`")  # after a frame
        covered = browser.run("""
            const tray = document.getElementById('tray');
            return [...document.querySelectorAll('main a, main button')].filter((e) => {
              if (e.disabled || !e.offsetParent) return false;
              e.focus();
              return e.getBoundingClientRect().bottom > tray.getBoundingClientRect().top + 1;
            }).map((e) => e.innerText);
        """)
        assert covered == []
        browser.run("scrollTo(0, 1e6)")
        assert browser.run("return document.querySelector('main').getBoundingClientRect().bottom <="
                           " document.getElementById('tray').getBoundingClientRect().top + 1")
        browser.click("▸Tray: 2 robots".lstrip("▸"), "#tray button")
        browser.until("document.querySelector('#tray ul').offsetParent !== null")
        assert browser.run("return document.getElementById('tray').offsetHeight") < 200
    finally:
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
