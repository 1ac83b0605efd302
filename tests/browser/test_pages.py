"""Every page, with real data: it agrees with the API, breaks no rule, and is accessible."""

import json
import os
import re
import statistics
import subprocess

import pytest

from browser import Browser
from contract import SOURCE
from service import DESIGN, await_end, run, until
from test_racing import CAMPAIGN as RACED
from workers import Workers

VIEWS = {
    "": "morphod evolves robots made of soft voxels, trains the neural network that moves them, "
        "and scores how close each one gets to a light.", "overview": "Service",
    "runs": "Runs", "campaigns": "Runs",
    "campaigns/{campaign}": "<b>walkers</b> & others",
    "campaigns/{campaign}/population": "<b>walkers</b> & others",
    "campaigns/{campaign}/settings": "<b>walkers</b> & others",
    "campaigns/{campaign}/phylogeny": "Phylogeny", "campaigns/{study}": "a study",
    "campaigns/{campaign}/replicates": "<b>walkers</b> & others",
    "campaigns/{study}/phylogeny": "Phylogeny", "campaigns/{study}/settings": "a study",
    "trainings/{training}": "Training run {training}",
    "trainings/{training}/settings": "Training run {training}",
    "evaluations/{evaluation}": "Evaluation {evaluation}",
    "evaluations/{evaluation}/settings": "Evaluation {evaluation}",
    "designs": "Designs", "controllers": "Controllers", "atlas": "Atlases", "lab": "Lab",
    "stage": "Stage", "machines": "Machines",
    "compare?designs={robots}": "Compare robots"
}
ROBOTS = "00e4402ef444a4aeacaacc60ecaee0000000@7," + "f" * 36 + "@0"


def address(service, view):
    return view.format(campaign=service.campaign, study=service.study, training=service.training,
                       evaluation=service.evaluation, robots=ROBOTS)


@pytest.mark.parametrize("theme", ("dark", "light"))
@pytest.mark.parametrize("view", VIEWS)
def test_page(service, browser, view, theme):
    browser.open(address(service, view), theme)
    title = address(service, VIEWS[view])
    browser.until(f"document.querySelector('h1')?.textContent === {title!r}")
    if view in ("", "lab", "stage"):
        browser.until_walking()
    assert browser.faults() == []
    assert browser.run(ACCESSIBILITY) == []
    text = browser.run("return document.body.innerText")
    assert not re.search(r"\b(null|undefined|NaN)\b", text), text


# Requirements of users who cannot see the page or use a mouse: names for all controls, a label for
# each picture, one main heading, and text with enough contrast.
ACCESSIBILITY = """
const faults = [];
const shown = (e) => e.offsetParent !== null || getComputedStyle(e).position === 'fixed';
const nameOf = (e) => (e.getAttribute('aria-label') || e.innerText || e.textContent ||
  e.labels?.[0]?.innerText || e.title || e.placeholder || '').trim();
const used = 'a[href], button, input, select, textarea, canvas, [role=img]';
for (const e of document.querySelectorAll(used)) {
  if (!shown(e) || e.closest('[aria-hidden=true]')) continue;
  if (!nameOf(e)) faults.push('no name: ' + e.outerHTML.slice(0, 90));
}
if (document.querySelectorAll('h1').length !== 1) faults.push('not one main heading');
if (!document.documentElement.lang) faults.push('no language');
for (const grid of document.querySelectorAll('[role=grid]')) {
  if (!grid.querySelector('[role=row] [role=gridcell]')) faults.push('a grid without rows');
}
const ids = [...document.querySelectorAll('[id]')].map((e) => e.id);
if (new Set(ids).size !== ids.length) faults.push('an id stands twice');
const channel = (v) => (v /= 255) <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
const numbers = (color) => color.match(/[\\d.]+/g).map(Number);
const light = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
const groundOf = (e) => {
  for (let at = e; at; at = at.parentElement) {
    const color = getComputedStyle(at).backgroundColor;
    if (/^rgb\\(/.test(color)) return numbers(color);
  }
  return [255, 255, 255];
};
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
const seen = new Set();
while (walker.nextNode()) {
  const e = walker.currentNode.parentElement;
  if (!walker.currentNode.data.trim() || seen.has(e) || !shown(e)) continue;
  if (e.closest('.visually-hidden, noscript, svg, :disabled')) continue;
  seen.add(e);
  const style = getComputedStyle(e);
  const [a, b] = [light(numbers(style.color)), light(groundOf(e))];
  const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  if (contrast < 4.5) faults.push(`contrast ${contrast.toFixed(2)}: ${e.innerText.slice(0, 40)}`);
}
return faults;
"""


def test_labels_are_text(service, browser):
    browser.open("campaigns/" + service.campaign)
    assert browser.run("return document.querySelectorAll('main b').length") == 0
    browser.open("runs?search=walkers")
    browser.until("[...document.links].some((a) => a.innerText.includes('<b>walkers</b>'))")
    assert browser.run("return document.querySelectorAll('main b').length") == 0


def test_curves_agree_with_the_api(service, browser):
    rows = service.pages(f"/v1/campaigns/{service.campaign}/generations")
    browser.open("campaigns/" + service.campaign)
    reported = "document.querySelector('figure canvas').getAttribute('aria-label')"
    browser.until(reported + ".includes('generation 4')")
    label = browser.run("return " + reported)
    best = [row["score"]["quantiles"]["p0"] for row in rows]
    assert f"best from {best[0]:.3g}" in label and f"to {best[-1]:.3g} at generation 4" in label


def test_the_score_of_the_lab_is_that_of_an_evaluation(service, browser):
    voxels = service.evaluate({"designs": [DESIGN]}).json()["results"][0]
    browser.open("lab?voxels=" + voxels["genotype"])
    browser.until("/^score/.test(document.querySelector('main p.result').textContent)")
    text = browser.texts("main p.result")[0]
    assert text.startswith(f"score {voxels['score']:.4f} ↓ lower is better\nReach the light, mean "
                           "over the ten worlds of paper-test\n4 voxels")


def test_editing_by_keyboard(service, browser):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys
    browser.open("lab?voxels=" + "1" + "0" * 143)
    browser.until_walking()
    browser.run("document.querySelector('[data-cell=\"0,0,0\"]').focus()")
    ActionChains(browser.driver).send_keys(Keys.ARROW_RIGHT, Keys.SPACE).perform()
    browser.until("document.querySelectorAll('[aria-selected=true]').length === 2")
    assert browser.run("return document.activeElement.dataset.cell") == "1,0,0"
    assert "voxels=1" in browser.driver.current_url


def test_what_the_lab_reads(browser):
    """Arrays of EvoGym become two voxels deep; cells, digits and ids are read unchanged."""
    browser.open("designs")
    read = browser.driver.execute_async_script("""
        const [texts, done] = arguments;
        const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
        Promise.all(['variation', 'body'].map((name) => import(`${folder}lib/${name}.js`)))
          .then(([{ readBody }, { cellsOf, genotypeOfId }]) => done(texts.map((text) => {
            try {
              const { id, genotype } = readBody(text);
              return cellsOf(genotype ?? genotypeOfId(id));
            } catch (error) {
              return error.message;
            }
          })));
    """, [
        "array([[0, 3, 3], [1, 1, 0], [4, 0, 0]])", "array([[0., 3., 3.],\n       [1., 1., 0.]])",
        "[[0 3 3]\n [1 1 0]]", "[[2,2,0],[3,2,0],[2,3,0]]", "1" + "0" * 142 + "1", "88" + "0" * 34,
        "88" + "0" * 34 + "@4", "[[1, 1], [1, 1], [1, 1], [1, 1], [1, 1]]", "nothing",
        "[[7, 0, 0]]", "[[0, 3, 3], [1, 1, 0], [4, 0, 0]]", "array([[0.3, 1.0, 0.0]])"
    ])
    two = [[x, y, z] for x, z in ((0, 0), (1, 0), (1, 1), (2, 1)) for y in (2, 3)]
    three = [[x, y, z] for x, z in ((0, 0), (0, 1), (1, 1), (1, 2), (2, 2)) for y in (2, 3)]
    assert sorted(read[0]) == sorted(three) and sorted(read[1]) == sorted(read[2]) == sorted(two)
    assert sorted(read[3]) == [[2, 2, 0], [2, 3, 0], [3, 2, 0]]
    assert read[4] == [[0, 0, 0], [5, 5, 3]] and read[5] == [[0, 0, 0], [0, 1, 0]]
    assert read[6] == [[0, 0, 0], [1, 0, 0]]
    assert "outside the workspace of 6 × 6 × 4" in read[7] and "not an id" in read[8]
    assert "outside" in read[9]
    assert "for EvoGym rows, write array" in read[10] and "0.3 is not a coordinate" in read[11]


def test_what_the_lab_does(service, browser):
    browser.open("lab?voxels=" + "1" + "0" * 143)
    browser.until_walking()
    voxels = "new URLSearchParams(location.hash.split('?')[1]).get('voxels')"
    browser.click("Import")
    browser.run("document.querySelector('dialog textarea').value = '[[0, 0, 0], [1, 0, 0]]';"
                "document.querySelector('dialog form').requestSubmit()")
    bar = "1" + "0" * 23 + "1" + "0" * 119
    browser.until(f"{voxels} === '{bar}'")
    browser.until("/^score/.test(document.querySelector('main p.result').textContent)")
    browser.click("Keep")
    browser.click("→")
    moved = "0" * 24 + "1" + "0" * 23 + "1" + "0" * 95
    assert browser.run(f"return {voxels}") == moved
    browser.until("/^score/.test(document.querySelector('main p.result').textContent)")
    browser.click("Keep")  # the same form, and so the same founder
    browser.until("document.querySelectorAll('#tray li').length === 1")
    browser.click("Cross")  # campaigns place the parents first, which makes these two equal
    browser.until("document.getElementById('toast').innerText.includes('identical, so crossing')")
    assert browser.run(f"return {voxels}") == moved
    browser.click("Undo")
    assert browser.run(f"return {voxels}") == bar
    browser.click("→")
    browser.click("Mirror x")
    mirrored = "".join("1" if at in (24, 48, 72, 96) else "0" for at in range(144))
    assert browser.run(f"return {voxels}") == mirrored
    browser.click("Cross")
    browser.until(f"{voxels} !== '{mirrored}'")
    parents = [{"voxels": mirrored}, {"voxels": bar}]
    children = service.post("/v1/bodies/cross", {"designs": parents, "pairs": [[0, 1]]})["items"]
    assert browser.run(f"return {voxels}") == children[0]["genotype"]
    for name in ("Random", "Mutate"):
        before = browser.run(f"return {voxels}")
        browser.click(name)
        browser.until(f"{voxels} !== '{before}'")
        assert name != "Random" or browser.run(f"return {voxels}").count("1") >= 6
    browser.run("document.querySelector('[data-cell]').dispatchEvent(new KeyboardEvent('keydown',"
                "{ key: 'z', ctrlKey: true, bubbles: true }))")
    assert browser.run(f"return {voxels}") == before
    assert browser.faults() == []


def test_a_campaign_from_start_to_end_by_keyboard(service, browser):
    """Starts a campaign from the form, and watches, pauses, resumes and extends it without a
    mouse."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    def keys(*all_keys):
        ActionChains(browser.driver).send_keys(*all_keys).perform()

    def press(name):
        """Tabs to a control by its name, as a user would, and presses it."""
        for _ in range(80):
            keys(Keys.TAB)
            at = browser.run("const e = document.activeElement;"
                             "return e.getAttribute('aria-label') || e.innerText")
            if (at or "").strip() == name:
                keys(Keys.ENTER)
                return
        raise AssertionError(f"the tab key never came to {name!r}")

    browser.open("overview")
    press("New campaign")
    browser.until("document.querySelector('dialog[open] form')")
    fields = {"population": "8", "generations": "2000", "label": "by keyboard"}
    for _ in range(40):
        name = browser.run("return document.activeElement.name ?? ''")
        if name in fields:
            keys(fields.pop(name))
        if not fields:
            break
        keys(Keys.TAB)
    assert not fields
    keys(Keys.ENTER)
    browser.until("location.hash.startsWith('#/campaigns/')")
    number = browser.run("return location.hash.split('/')[2]")
    browser.until("document.querySelector('h1')?.textContent === 'by keyboard'")
    press("Pause by keyboard")
    browser.until("document.querySelector('.state')?.textContent === 'paused'")
    assert service.get(f"/v1/jobs/{number}")["state"] == "paused"
    browser.open("campaigns/" + number)
    press("Extend")
    browser.until("document.querySelector('dialog[open]')")
    press("Extend")
    browser.until("!document.querySelector('dialog[open]')")
    assert service.get(f"/v1/campaigns/{number}")["settings"]["generations"] == 2010
    press("Resume by keyboard")
    browser.until("document.querySelector('.state')?.textContent === 'running'")
    browser.run("const { createObjectURL } = URL; URL.createObjectURL = (blob) => {"
                "  blob.text().then((text) => { window.saved = text; });"
                "  return createObjectURL(blob); }")
    press("Export")
    browser.until("document.querySelector('dialog[open]')")
    press("Generations as CSV")
    browser.until("/^generation,/.test(window.saved)")
    service.act(number, "cancel")
    assert browser.faults() == []


def test_the_leaderboard_from_both_ends(service, browser):
    scores = [row["score"] for row in service.pages("/v1/designs?sort=score")]
    reported = [f"{score:.4f}" for score in scores]
    assert len(reported) > 1
    browser.open("designs")
    cards = "[...document.querySelectorAll('.card strong')].map((e) => e.innerText).join(' ')"
    for order, expected in (("best", reported), ("worst", reported[::-1])):
        browser.run("const order = document.querySelector('main select');"
                    "order.value = arguments[0]; order.dispatchEvent(new Event('change'))", order)
        browser.until(f"{cards} === {' '.join(expected[:48])!r}")  # a page
        assert f"order={order}" in browser.driver.current_url


def test_links_carry_the_orientation(service, browser):
    """A page shows and links to the robot that has the score."""
    cells = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 2, 0], [1, 2, 1], [2, 2, 1]]
    robot = service.evaluate({"designs": [{"cells": cells}]}).json()["results"][0]["robot"]
    assert not robot.endswith("@0")
    best = service.get("/v1/designs?sort=score&limit=1")["items"][0]["robot"]
    browser.open("designs")
    browser.until("document.querySelector('.pick a')")
    assert browser.run("return document.querySelector('.pick a').hash") == f"#/designs/{best}"
    browser.open("designs/" + robot)
    browser.until_walking()
    assert browser.texts("main h1 + code") == [robot]
    links = browser.run("return [...document.querySelectorAll('main a')].map((a) => a.hash)")
    assert {f"#/lab?design={robot}", f"#/stage?designs={robot}",
            f"#/designs/{robot}"} <= set(links)
    browser.open("lab?design=" + robot)
    genotype = service.get(f"/v1/designs/{robot}/body")["genotype"]
    cells = [f"{v // 24},{v // 4 % 6},{v % 4}" for v in range(144) if genotype[v] == "1"]
    selected = "[...document.querySelectorAll('[aria-selected=true]')]"
    browser.until(f"{selected}.map((e) => e.dataset.cell).sort().join(' ') === "
                  f"{' '.join(sorted(cells))!r}")
    # An id without an orientation becomes the robot that walks, and stays that robot.
    browser.open("stage?designs=" + robot[:-2])
    browser.until(f"decodeURIComponent(location.hash).includes('designs={robot}')")
    assert browser.faults() == []


def bred(service, browser, label, button="Breed these"):
    """Starts a campaign by a button, and returns the ids of its founders once it has ended."""
    browser.click(button)
    browser.until("document.querySelector('dialog[open] form')")
    browser.run("""
        const form = document.querySelector('dialog[open] form');
        const given = { population: 8, generations: 1, label: arguments[0] };
        for (const [name, value] of Object.entries(given)) form.elements[name].value = value;
        form.requestSubmit();
    """, label)
    browser.until(f"document.querySelector('h1')?.textContent === {label!r}")
    path = "/v1/campaigns/" + browser.run("return location.hash.split('/')[2]")
    assert await_end(service, path).json()["state"] == "succeeded"
    browser.until("document.querySelector('.state').innerText === 'succeeded'")
    assert browser.faults() == []
    return sorted(row["id"] for row in service.pages(path + "/population?generation=0")
                  if row["operator"] == "listed")


def test_chosen_champions_found_a_campaign(service, browser):
    browser.open("campaigns/" + service.campaign)
    browser.until("document.querySelectorAll('.card + label input').length > 1")
    browser.run("[...document.querySelectorAll('.card + label input')].slice(0, 2)"
                ".forEach((e) => e.click())")
    champions = service.get(f"/v1/campaigns/{service.campaign}/champions")["items"]
    best = min(champions, key=lambda row: row["score"])
    other = next(row for row in champions if row is not best)
    assert bred(service, browser, "of champions") == sorted((best["id"], other["id"]))


def test_bodies_of_the_lab_and_robots_of_the_stage_found_campaigns(service, browser):
    results = service.evaluate({"designs": [DESIGN, {"cells": [[0, 0, 0], [1, 0, 0]]}]}).json()
    ids = sorted(result["id"] for result in results["results"])
    scored = "/^score/.test(document.querySelector('main p.result').textContent)"
    browser.open("lab?voxels=" + results["results"][0]["genotype"])
    browser.until(scored)
    browser.click("Keep")
    browser.click("Import")
    browser.run("document.querySelector('dialog textarea').value = arguments[0];"
                "document.querySelector('dialog form').requestSubmit()", "[[3, 3, 1], [3, 4, 1]]")
    browser.until(scored)  # the same form as the second, elsewhere and turned
    browser.click("Keep")
    assert bred(service, browser, "of the Lab", "Breed") == ids
    browser.open("stage?designs=" + ",".join(ids))
    browser.until_walking()
    assert bred(service, browser, "of the stage") == ids


def test_what_happens_while_a_page_loads_is_not_lost(service, browser):
    from conftest import CAMPAIGN
    id = service.post("/v1/campaigns", CAMPAIGN | {"generations": 90000})["id"]
    service.act(id, "pause")
    browser.open("overview")
    browser.run("""
        const { fetch } = window;
        const gate = new Promise((resolve) => { window.release = resolve; });
        window.fetch = async (path, ...rest) => {
          const reply = await fetch(path, ...rest);
          if (/generations/.test(path)) await gate;
          return reply;
        };
        const script = document.querySelector('script[type=module]').src;
        import(script).then(({ app }) => { window.app = app; });
        location.hash = '#/campaigns/' + arguments[0];
    """, id)
    browser.until("document.querySelector('h1 ~ .state')?.innerText === 'paused'")
    service.act(id, "cancel")
    browser.until(f"app.recent.some(({{ job, data }}) => job === '{id}' && "
                  "data.state === 'cancelled')")
    browser.run("release()")
    browser.until("document.querySelector('h1 ~ .state')?.innerText === 'cancelled'")


def test_a_study_shows_its_measures_and_operators(service, browser):
    browser.open(f"campaigns/{service.study}/population")
    browser.until("[...document.querySelectorAll('option')].some((e) => e.innerText === 'reach')")
    text = browser.run("return document.querySelector('main').innerText")
    assert "2 batches received" in text and "Extend" not in browser.texts("main button")
    assert browser.texts("section.chart .legend") == ["dice"]
    browser.open(f"campaigns/{service.study}/phylogeny")
    browser.until("document.querySelector('.flush > .legend').innerText")
    browser.run("const e = document.querySelector('select'); e.value = 'operator';"
                "e.dispatchEvent(new Event('change'))")
    assert browser.texts(".flush > .legend span")[0] == "dice"
    for by, least in (("measures.reach", "reach "), ("voxels", "voxels ")):
        browser.run(f"const e = document.querySelector('select'); e.value = '{by}';"
                    "e.dispatchEvent(new Event('change'))")
        assert browser.texts(".flush > .legend span")[0].startswith(least)
    assert browser.faults() == []


def test_lower_bounds_are_no_scores(service, browser):
    """Lower bounds are faint, outside the color scale, and marked."""
    id = run(service, "campaigns", RACED | {"generations": 3})["id"]
    rows = service.pages(f"/v1/campaigns/{id}/phylogeny")
    bound = next(row for row in rows if row["lower_bound"])
    browser.open(f"campaigns/{id}/phylogeny?design={bound['number']}")
    browser.until("document.querySelector('main h2')?.innerText.startsWith('#')")
    text = browser.run("return document.querySelector('main').innerText")
    assert f"score ≥ {bound['score']:.4f}" in text and "A lower bound" in text
    legend = browser.texts(".flush > .legend span")
    worst = max(row["score"] for row in rows if not row["lower_bound"])
    assert legend[0] == f"score {float(f'{worst:.3g}')}" and "faint: lower bounds" in legend[2]
    browser.open(f"designs/{bound['id']}")
    browser.until(f"document.querySelector('main').innerText.includes('≥ {bound['score']:.4f}')")
    browser.open(f"campaigns/{id}")
    browser.until("document.querySelector('main').innerText.includes('Share of children cut')")
    assert browser.faults() == []


def test_the_best_of_many_come_first(service, browser):
    """Lower bounds follow them, and are marked."""
    bodies = service.post("/v1/bodies/random", {"count": 30, "seed": 12})["items"]
    value = run(service, "evaluations", {
        "designs": [{"voxels": body["genotype"]} for body in bodies], "best": 2})
    rows = sorted(value["results"], key=lambda row: (row["lower_bound"], row["score"]))
    bounds = sum(row["lower_bound"] for row in rows)
    browser.open(f"designs?evaluation={value['id']}")
    browser.until("document.querySelectorAll('.pick').length === 30")
    shown = browser.texts(".pick .number")
    assert shown[0] == f"{rows[0]['score']:.4f}" and shown[-1] == f"≥ {rows[-1]['score']:.4f}"
    assert 0 < bounds == sum(text.startswith("≥") for text in shown)
    assert "The best 2 were requested" in browser.run(
        "return document.querySelector('main').innerText")
    assert browser.faults() == []


COPIED = [
    "overview", "runs?kind=campaign&search=walkers&state=succeeded", "campaigns/{campaign}",
    "campaigns/{campaign}/phylogeny", "campaigns/{campaign}/replicates", "trainings",
    "trainings/{training}", "designs", "designs?evaluation={evaluation}", "designs/{design}",
    "controllers", "lab", "lab?task=walk", "lab?task=jump",
    "lab?task=drawn:3.5_2.5,4_3", "designs?task=circle", "compare?designs={robots}"
]


def test_an_evaluation_too_large_for_a_list(service, browser):
    """The best designs of a large evaluation are read from pages of results."""
    value = run(service, "evaluations", {
        "random": {"count": 10_200, "seed": 3}, "best": 4, "physics": {"n_steps": 5},
        "environments": [{"light_xy_m": [4, 3], "terrain_sigma_m": 0, "seed": 1}]})
    assert "results" not in value
    browser.open(f"designs?evaluation={value['id']}")
    browser.until("document.querySelector('main').innerText.includes('All results: morphoctl')")
    whole = service.pages(f"/v1/evaluations/{value['id']}/results?whole=true")
    best = sorted(item["score"] for item in whole)[:4]
    assert browser.texts(".pick .number")[:4] == [f"{score:.4f}" for score in best]
    assert browser.faults() == []


@pytest.mark.parametrize("view", COPIED)
def test_every_view_can_be_copied(service, browser, tmp_path, view):
    """The commands to copy work unchanged."""
    design = service.get("/v1/designs?limit=1")["items"][0]["id"]
    evaluation = service.get("/v1/jobs?kind=evaluation&limit=1")["items"][0]["id"]
    browser.open(address(service, view.replace("{evaluation}", evaluation).replace(
        "{design}", design)))
    check_commands(browser, tmp_path)


def check_commands(browser, folder, button="Commands"):
    browser.click(button)
    browser.until("document.querySelector('dialog[open] pre')")
    assert browser.texts("dialog[open] h3") == ["curl", "morphoctl", "Python"]
    curl, morphoctl, python = browser.texts("dialog[open] pre")
    path = f"{SOURCE / 'build' / 'clients' / 'morphoctl'}:{os.environ['PATH']}"
    for line in [curl, *(line for line in morphoctl.split("\n") if " watch " not in line)]:
        done = subprocess.run(line, shell=True, cwd=folder, capture_output=True, text=True,
                              timeout=300, env=os.environ | {"PATH": path})
        assert done.returncode == 0 and '"status":4' not in done.stdout, (line, done)
    compile(python, "copied", "exec")


def test_a_form_can_be_copied(service, browser, tmp_path):
    browser.open("designs")
    browser.until("document.querySelectorAll('.card').length > 1")
    browser.run("[...document.querySelectorAll('.card')].slice(0, 2).forEach((e) => e.click())")
    browser.click("Breed these")
    browser.until("document.querySelector('dialog[open] form')")
    browser.run("""
        const form = document.querySelector('dialog[open] form');
        const given = { population: 4, generations: 0, label: "it's" };
        for (const [name, value] of Object.entries(given)) form.elements[name].value = value;
    """)
    check_commands(browser, tmp_path, "Copy as a command")
    made = service.get("/v1/campaigns?limit=2")["items"]
    assert [one["label"] for one in made] == ["it's"] * 2
    assert made[0]["settings"] == made[1]["settings"]
    assert made[0]["settings"]["exclude_pretraining"] is False, "proposed for founders"


def test_campaigns_are_compared_with_an_interval(service, browser):
    """Replicates form a side; the interval of the difference is Welch's."""
    base = {"mode": "zero-shot", "population": 4, "generations": 2, "physics": {"n_steps": 30},
            "exclude_pretraining": False, "replicates": 3, "controller": "default"}
    firsts = [run(service, "campaigns", base | {"seed": seed})["id"] for seed in (5, 50)]
    sides = []
    for first in firsts:
        members = [one["id"] for one in service.get(f"/v1/campaigns?group={first}")["items"]]
        assert len(members) == 3
        for id in members:
            await_end(service, f"/v1/campaigns/{id}")
        sides.append([service.pages(f"/v1/campaigns/{id}/generations")[-1]
                      ["score"]["quantiles"]["p0"] for id in members])
    browser.open(f"campaigns/{firsts[0]}?compare={firsts[1]}")
    browser.until("document.querySelectorAll('[aria-label=Comparison] tbody tr').length === 2")
    row = browser.texts("[aria-label=Comparison] tbody tr:last-child td")
    means = [statistics.mean(side) for side in sides]
    assert float(row[2]) == pytest.approx(means[1], abs=6e-5)
    assert float(row[3].replace("\u2212", "-")) == pytest.approx(means[1] - means[0], abs=6e-5)
    parts = [statistics.variance(side) / 3 for side in sides]
    freedom = sum(parts)**2 / sum(part**2 / 2 for part in parts)
    low, high = (float(one.replace("\u2212", "-")) for one in row[4].split(" to "))
    reported = (high - low) / 2 / sum(parts)**0.5  # the quantile of the page
    table = {2: 4.3027, 3: 3.1824, 4: 2.7764}
    assert table[int(freedom) + (freedom < 4)] - 2e-2 <= reported <= table[int(freedom)] + 2e-2
    shorter = run(service, "campaigns", base | {"replicates": 1, "physics": {"n_steps": 20}})["id"]
    browser.open(f"campaigns/{firsts[0]}?compare={shorter}")
    browser.until("/cannot be compared/.test(document.body.innerText)")
    assert "physics.n_steps (30, 20)" in browser.texts("[aria-label=Comparison]")[0]
    assert browser.texts("[aria-label=Comparison] tbody tr:last-child td")[3:] == ["–", "–"]
    assert browser.faults() == []


def test_trainings_of_other_seeds_are_a_band(service, browser):
    from conftest import TRAINING
    other = run(service, "trainings", TRAINING | {"name": "second", "seed": 9})["id"]
    rows = [service.pages(f"/v1/trainings/{id}/steps") for id in (service.training, other)]
    browser.open(f"trainings/{service.training}?compare={other}")
    reported = "document.querySelector('figure canvas').getAttribute('aria-label')"
    browser.until(reported + ".includes('mean of 2 replicates')")
    mean = statistics.mean(one[-1]["mean_loss"] for one in rows)
    assert f"to {mean:.3g} at step {rows[0][-1]['step']}" in browser.run("return " + reported)
    legend = browser.texts("figure")[0]
    assert "min to max" in legend


def test_two_controllers_are_compared(service, browser):
    browser.open("controllers")
    browser.run("""
        const [first, second, bodies] = [...document.querySelectorAll('select')];
        for (const [e, value] of [[first, 'default'], [second, 'tuned'], [bodies, '16']]) {
          e.value = value;
          e.dispatchEvent(new Event('change'));
        }
    """)
    browser.click("Compare")
    browser.until("/95 % interval/.test(document.body.innerText)")
    browser.until_walking()
    command = "train compare default tuned --designs 16 --json"
    done = subprocess.run([SOURCE / "build/clients/morphoctl/morphoctl", *command.split(),
                           "--server", browser.base.rstrip("/")], capture_output=True, check=True)
    same = json.loads(done.stdout)
    text = browser.run("return document.body.innerText").replace("\u2212", "-")
    for number in ("difference", "low", "high"):
        assert f"{same[number]:+.4f}" in text, (number, same)
    assert f"{same['pairs']} held-out bodies" in text and f"{same['improved']} of them" in text
    assert browser.run("return document.querySelector('.stage').player.stage.robots.length") == 2
    assert browser.faults() == []


STATES = {  # what a page shows if there is no data, or the address has another name
    "campaigns": "No jobs match", "runs": "No jobs yet", "controllers": "Made by",
    "campaigns/99/settings": 'There is no campaign "99"', "runs/99": 'There is no job "99"',
    "designs": "No design has a score with this controller yet", "stage": "No design is stored yet",
    "": "No design in this store has a score yet", "overview": "No jobs yet",
    "campaigns/99": 'There is no campaign "99"',
    "campaigns/99/phylogeny": 'There is no campaign "99"',
    "trainings/99": 'There is no training "99"',
    "designs?evaluation=99": 'There is no evaluation "99"', "designs/xyz": "36 hexadecimal digits",
    "stage?set=moon": 'There is no set of environments "moon"',
    "stage?controller=nobody&designs=88" + "0" * 34: 'controller "nobody" does not exist',
    "nowhere": "Page not found"
}


def test_machines_are_shown_and_changed(start):
    """Which machines compute, which ones were lost, and an operator's actions on a worker."""
    workers = Workers(start("--fleet-listen=127.0.0.1:0"))
    service = workers.service
    page = Browser(service)  # before the workers join: long silence loses them
    try:
        names = ["<b>one</b>", "two", "gone"]
        sessions = [workers.join(name=name, version="0.0.1") for name in names]
        workers.request("DELETE", sessions[2])
        page.open("machines")
        rows = """return [...document.querySelectorAll('[aria-label="%s"] tbody tr')]
                  .map((row) => row.innerText.replace(/\\s+/g, ' '))"""
        page.until("""document.querySelectorAll('[aria-label="At work"] tbody tr').length >= 3""")
        at_work = page.run(rows % "At work")
        assert [name in row for name, row in zip(["this machine", *names], at_work)] == 3 * [True]
        assert all("0.0.1 (older)" in row for row in at_work[1:])
        assert "gone node.test" in page.run(rows % "Past workers")[0]
        assert page.faults() == [] and page.run(ACCESSIBILITY) == []
        page.run("""document.querySelector('[aria-label="Drain two"]').click()""")
        page.until("document.querySelector('.state.paused')")
        assert workers.orders(sessions[1])["state"] == "draining"
    finally:
        page.quit()


def test_empty_and_wrong_places(start, browser):
    running = start()
    browser.base, before = f"http://{running.host}:{running.port}/", browser.base
    try:
        browser.open("lab")
        for view, text in STATES.items():
            browser.run("location.hash = '#/' + arguments[0]", view)
            browser.until(f"document.querySelector('main').innerText.includes({text!r})")
            assert [fault for fault in browser.faults() if "status of 4" not in fault] == []
        running.stop(9)
        for view in ("campaigns", "lab", "stage", "controllers", "designs", ""):
            browser.run("location.hash = '#/' + arguments[0]", view)
            browser.until("['main', '.banner'].every((selector) => /cannot be reached/"
                          ".test(document.querySelector(selector).innerText))")
    finally:
        browser.base = before


def test_the_page_says_that_the_service_is_down_and_comes_back(start, browser):
    running = start()
    running.evaluate({"designs": [DESIGN]})
    browser.base, before = f"http://{running.host}:{running.port}/", browser.base
    try:
        browser.open("overview")
        running.stop(9)
        browser.until("!document.querySelector('.banner').hidden")
        assert "cannot be reached" in browser.texts(".banner")[0]
        again = start(listen=(f"{running.host}:{running.port}", ), state=running.state)
        browser.until("document.querySelector('.banner').hidden")
        job = again.evaluate({"designs": [{"cells": [[0, 0, 0]]}]}).json()["id"]
        browser.until(f"document.body.innerText.includes('evaluation {job}')")
    finally:
        browser.base = before


def test_jobs_in_order(service, browser):
    """A job gets a note, is archived, is found again, and is deleted after a confirmation that says
    what will be lost."""
    job = run(service, "evaluations", {"designs": [DESIGN], "physics": {"n_steps": 20},
                                       "label": "in order"})["id"]
    found = "document.querySelector('table.jobs td.main')?.innerText"
    browser.open(f"evaluations/{job}")
    browser.click("Edit")
    browser.until("document.querySelector('dialog textarea')")
    browser.run("document.querySelector('dialog textarea').value = '<b>falls</b> over'")
    browser.run("document.querySelector('dialog [type=checkbox]').click()")
    browser.click("Save")
    browser.until("document.querySelector('.remark').innerText.includes('<b>falls</b> over')")
    browser.open("overview?label=in%20ord")  # as in links of earlier versions
    browser.until("document.querySelector('main').innerText.includes('No jobs match.')")
    browser.open("overview?label=in%20ord&archived=true")
    browser.until(f"{found}?.includes('<b>falls</b> over')")
    browser.open(f"evaluations/{job}")
    browser.click("Edit")
    browser.until("document.querySelector('dialog textarea')")
    browser.click("Delete")
    assert f"Evaluation {job} and its results" in browser.texts("[role=alertdialog] p")[0]
    browser.click("Delete the job")
    until(lambda: service.request("GET", f"/v1/jobs/{job}").status == 404)
    browser.open("overview")
    browser.until("document.querySelector('[aria-label=Usage] tbody td')")
    assert browser.texts("[aria-label=Usage] tbody td") != [] and browser.faults() == []
