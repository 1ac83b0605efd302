"""The page of a certificate agrees with its report, follows it while it runs, and fits on a sheet
of paper."""

import base64
import re

import pytest
from selenium.webdriver.common.keys import Keys

from service import await_end, awaited, run, until
from test_pages import ACCESSIBILITY

AXES = ["step", "friction", "held_out"]
SHORT = {"n_steps": 40}


def bodies(service, n):
    made = service.post("/v1/bodies/random", {"count": n, "seed": 3})["items"]
    return [{"id": item["id"] + "@0"} for item in made]


@pytest.fixture(scope="module")
def certificate(service):
    """A certificate without fresh worlds: the ground of its world is even."""
    value = {"designs": bodies(service, 6), "axes": AXES, "levels": [0.5, 1.3], "physics": SHORT,
             "environments": [{"light_xy_m": [4.0, 3.0], "terrain_heights_m": [[0] * 8] * 8},
                              {"light_xy_m": [3.0, 4.0], "terrain_heights_m": [[0] * 8] * 8}],
             "label": "<i>six</i>", "experiment": "certified"}
    id = run(service, "certificates", value)["id"]
    return service.get(f"/v1/certificates/{id}/report")


def opened(browser, id, query="", theme=None):
    browser.open(f"certificates/{id}{query}", theme)
    browser.until("document.querySelector('.design')")


def rows(browser, selector):
    return browser.run("return [...document.querySelectorAll(arguments[0])].map((row) =>"
                       "[...row.cells].map((cell) => cell.innerText.trim()))", selector)


def number(text):
    return float(text.split()[0].replace("−", "-"))


@pytest.mark.parametrize("theme", ("dark", "light"))
def test_the_page_agrees_with_the_report(browser, certificate, theme):
    opened(browser, certificate["id"], theme=theme)
    assert browser.texts("h1") == ["<i>six</i>"]
    assert browser.texts(".sentence") == [certificate["verdict"]]
    shown = rows(browser, ".certified-grid .levels tbody tr")
    assert [row[0] for row in shown] == ["Base in 2 worlds", "Time step ÷ 2", "Time step ÷ 4",
                                         "Friction × 0.5", "Friction × 1.3"]
    assert shown[0][2:] == ["–", f"{certificate['levels'][0]['mean_score']:.4f}", "–"]
    for row, level in list(zip(shown, certificate["levels"]))[1:]:
        low, high = re.findall(r"[−\d.]+", row[2])[1:]
        ends = [number(low), number(high)]
        assert number(row[2]) == pytest.approx(level["tau"], abs=0.0051)
        assert ends == pytest.approx(level["tau_interval"], abs=0.0051)
        assert number(row[3]) == pytest.approx(level["mean_score"], abs=0.00006)
        assert number(row[4]) == pytest.approx(level["regret"], abs=0.00006)
    best_first = sorted(certificate["designs"], key=lambda one: one["rank"])
    shown = rows(browser, ".design")
    assert [int(row[0]) for row in shown] == [one["rank"] for one in best_first]
    for row, design in zip(shown, best_first):
        low, high = design["interval"]
        assert row[3] == f"{design['score']:.4f} ± {(high - low) / 2:.4f}"
        assert row[4].endswith(design["verdict"]) and "with finer time steps" in row[4].lower()
    links = browser.run("return [...document.querySelectorAll('.design a')].map((a) => a.hash)")
    assert links == [f"#/designs/{one['design']}" for one in best_first]
    asked = browser.texts("[aria-label='The request']")[0]
    assert f"Left out. {certificate['left_out'][0]['reason']}" in asked
    assert "2 listed environments" in asked and "steps 40" in asked
    assert browser.faults() == [] and browser.run(ACCESSIBILITY) == []


# Where the dots, the whiskers and the line of the base are: shares of the width.
DRAWN = """
return [...document.querySelectorAll('.detail tbody tr')].map((row) => {
  const at = (name) => row.querySelector(`.${name}`)?.getAttribute('d').match(/[\\d.]+/g)
    .map(Number);
  return [at('dot')[0], at('base')[0], at('whisker')[0], at('whisker')[2]];
});
"""


def test_a_design_opens_to_its_levels(browser, certificate):
    """By keyboard and by a click on its row; the link keeps it."""
    opened(browser, certificate["id"])
    best = min(range(6), key=lambda i: certificate["designs"][i]["rank"])
    design = certificate["designs"][best]
    button = browser.driver.find_element("css selector", f"[data-design='{best}']")
    button.send_keys(Keys.ENTER)
    browser.until("document.querySelector('.detail .levels')")
    assert browser.run("return document.activeElement.dataset.design") == str(best)
    assert browser.run("return document.activeElement.ariaExpanded") == "true"
    shown = rows(browser, ".detail tbody tr")
    for row, one in zip(shown, design["levels"], strict=True):
        assert number(row[2]) == pytest.approx(one["score"], abs=0.00006)
        assert int(row[4]) == one["rank"]
        if one["change"] is not None:
            assert number(row[3]) == pytest.approx(one["change"], abs=0.00006)
    drawn = browser.run(DRAWN)
    values = [[one["score"], design["score"], *one["interval"]] for one in design["levels"]]
    (x0, v0), (x1, v1) = (sorted((drawn[i][0], values[i][0]) for i in range(5))[k] for k in (0, -1))
    for places, own in zip(drawn, values):
        expected = [x0 + (x1 - x0) * (value - v0) / (v1 - v0) for value in own]
        clipped = [min(100, max(0, place)) for place in expected]
        assert places == pytest.approx(clipped, abs=0.1)
    browser.driver.find_element("css selector", ".design:not(:has(+ .detail)) .verdict").click()
    browser.until("document.querySelectorAll('.detail').length === 2")
    link = browser.driver.current_url.split("#/")[1]
    assert len(link.split("open=")[1].split("%2C")) == 2
    browser.open(link)
    browser.until("document.querySelectorAll('.detail').length === 2")
    browser.click("Hide")
    browser.until("document.querySelectorAll('.detail').length === 1")
    browser.driver.find_element("css selector", ".design a").click()
    browser.until("location.hash.startsWith('#/designs/')")


BADGES = """
const [report, done] = arguments;
const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
import(folder + 'views/certificate_words.js').then(({ badgesOf }) =>
  done(report.designs.map((one) => badgesOf(one, report).map(([text]) => text))));
"""


def test_what_a_design_depends_on(browser):
    """The report says it; the words are here."""
    def design(kept=True, worse=(), rank=1, diverged=0, score=0.1, axis="step"):
        return {"score": score, "rank": 1, "worse": list(worse), "numerics": axis and {
            "axis": axis, "kept": kept, "rank": rank, "diverged": diverged}}

    cases = [
        (design(rank=2), ["keeps its rank with finer time steps"]),
        (design(False, ["friction", "drop", "worlds"], rank=12),
         ["rank 1 → 12 with finer time steps", "depends on friction, the drop height"]),
        (design(worse=["worlds"], axis="precision"),
         ["keeps its rank in float64", "depends on all constants together"]),
        (design(False, ["drop"], 20, 3),
         ["in doubt: diverges with finer time steps", "depends on the drop height"]),
        (design(axis=None), []), (design(score=None, worse=["drop"]), ["has no score"])]
    report = {"n_designs": 20, "designs": [one for one, _ in cases]}
    browser.open("nowhere")
    assert browser.driver.execute_async_script(BADGES, report) == [words for _, words in cases]
    alone = {"n_designs": 1, "designs": [design(), design(False)]}
    assert browser.driver.execute_async_script(BADGES, alone) == [
        ["keeps its score with finer time steps"], ["its score changes with finer time steps"]]


def test_badges_in_lists(browser, service):
    """Champions show their mean in fresh worlds, and with the leaderboard and the stage a link to
    their certificate."""
    value = {"mode": "zero-shot", "population": 6, "generations": 1, "seed": 21,
             "exclude_pretraining": False, "physics": {"n_steps": 120},
             "re_evaluate": {"every": 1, "environments": 4}}
    id = service.post("/v1/campaigns", value)["id"]
    assert await_end(service, f"/v1/campaigns/{id}").json()["state"] == "succeeded"
    certificate = service.post("/v1/certificates", {
        "population": {"campaign": id, "best": 2}, "axes": ["friction"], "levels": [0.5]})["id"]
    assert await_end(service, f"/v1/certificates/{certificate}").json()["state"] == "succeeded"
    champions = service.get(f"/v1/campaigns/{id}/champions")["items"]
    browser.open(f"campaigns/{id}")
    browser.until("document.querySelectorAll('.pick .held-out').length === 6")
    browser.until("document.querySelectorAll('.pick .badge').length === 2")
    shown = browser.texts(".pick")
    for one in champions:
        card, = [text for text in shown if f"#{one['number']}," in text]
        assert f"fresh worlds: {one['held_out']['mean']:.4f}" in card, card
        assert (one["certificate"]["class"].replace("_", " ") in card if one["certificate"]
                else "holds" not in card)
    certified = next(one for one in champions if one["certificate"])
    browser.open(f"stage?designs={certified['robot']}")
    browser.until("document.querySelector('.known .badge')")
    assert certified["certificate"]["class"].replace("_", " ") in browser.texts(".known")[0]
    browser.driver.find_element("css selector", ".known .badge").click()
    browser.until(f"location.hash === '#/certificates/{certificate}'")


def test_why_a_champion_has_no_mean_in_fresh_worlds(browser, service):
    """Between two re-evaluations, new designs become champions."""
    value = {"mode": "zero-shot", "population": 6, "generations": 400, "seed": 22,
             "exclude_pretraining": False, "physics": {"n_steps": 120},
             "re_evaluate": {"every": 400, "environments": 4, "designs": 2}}
    path = f"/v1/campaigns/{service.post('/v1/campaigns', value)['id']}"
    awaited(service, path, lambda now: (now["progress"]["generation"] or 0) >= 5)
    service.act(path.rsplit("/", 1)[1], "pause")
    until(lambda: service.get(path)["phase"] == "idle")
    champions = service.get(f"{path}/champions")
    assert champions["re_evaluated"] == {"generation": 0, "designs": 2, "champions": 12}
    without = [one for one in champions["items"] if not one["held_out"]]
    assert without
    browser.open(path[4:])
    browser.until("document.querySelectorAll('.pick .held-out').length === 6")
    shown = browser.texts(".pick")
    for one in champions["items"]:
        card, = [text for text in shown if f"#{one['number']}," in text]
        why = "fresh worlds: not among the best 2 or the 12 champions of generation 0"
        assert (why in card) == (one in without), card
    service.act(path.rsplit("/", 1)[1], "cancel")


# Where things are that must not move, and which levels are shown.
PLACES = """
const top = (selector) => document.querySelector(selector).getBoundingClientRect().top + scrollY;
return [...document.querySelectorAll('.certified-grid, .certified, .design')]
  .map((e) => Math.round(e.getBoundingClientRect().top + scrollY));
"""
LEVELS = ("[...document.querySelectorAll('.certified-grid .levels tbody th')]"
          ".filter((e) => e.innerText !== '…').length")


def test_a_running_certificate(browser, service):
    """Its levels come one by one, and nothing moves; it is paused, resumed and cancelled."""
    value = {"designs": bodies(service, 8), "axes": ["friction", "mass", "gravity"],
             "physics": {"n_steps": 4000}, "experiment": "certified"}
    id = service.post("/v1/certificates", value)["id"]
    path = f"/v1/certificates/{id}"
    browser.open(f"certificates/{id}")
    assert browser.run(f"return {LEVELS}") <= 1
    browser.until(f"{LEVELS} >= 1", 300)
    browser.click("Pause")
    browser.until("document.querySelector('.state').innerText === 'paused'", 300)
    job = service.get(path)
    done, n = job["certificate"]["trials_done"], job["certificate"]["trials"]
    assert n == 13 and 1 <= done < n
    browser.until(f"{LEVELS} === {done}")
    assert len(rows(browser, ".certified-grid .levels tbody tr")) == n
    assert f"{done} of {n} levels" in browser.texts(".title")[0]
    assert "rollouts" in browser.texts("[aria-label=State]")[0]
    report = service.get(path + "/report")
    assert not report["complete"] and browser.texts(".sentence") == [report["verdict"]]
    places = browser.run(PLACES)
    browser.click("Resume")
    browser.until(f"{LEVELS} >= {done + 2}", 300)
    assert browser.run(PLACES) == places
    browser.open("runs?kind=certificate&experiment=certified")
    browser.until("document.querySelector('.runs tbody a')")
    first = browser.texts(".runs tbody tr")[0]
    assert f"Certificate {id}" in first and "rollouts" in first
    link = browser.run("return document.querySelector('.runs tbody a').getAttribute('href')")
    assert link == f"#/certificates/{id}"
    service.act(id, "cancel")
    await_end(service, path)


def test_links_and_lists(browser, certificate):
    browser.open(f"certificate/{certificate['id']}")
    browser.until("document.querySelector('.design')")
    assert browser.driver.current_url.endswith(f"#/certificates/{certificate['id']}")
    browser.open("certificates")
    browser.until("location.hash === '#/runs?kind=certificate' &&"
                  "document.querySelector('.runs tbody a')")
    assert "<i>six</i>" in browser.texts(".runs tbody a")
    browser.open("certificates/123456")
    assert browser.texts("h1") == ["Not found"]


def test_the_best_of_a_campaign_are_certified(browser, service):
    browser.open(f"campaigns/{service.campaign}")
    browser.click("Certify the best 20")
    browser.until("/^#.certificates.\\d+$/.test(location.hash)")
    id = browser.driver.current_url.rsplit("/", 1)[1]
    job = service.get(f"/v1/certificates/{id}")
    assert job["population"] == {"campaign": service.campaign}
    population = service.get(f"/v1/campaigns/{service.campaign}/population?limit=100")["items"]
    scored = [one for one in population if one["score"] is not None and not one["lower_bound"]]
    assert job["certificate"]["designs"] == min(20, len(scored)) > 2
    browser.until("document.querySelector('.design')", 300)
    asked = browser.texts("[aria-label='The request']")[0]
    assert f"the best of campaign {service.campaign}" in asked
    assert asked.count("of the campaign") == len(job["certificate"]["from_population"])
    service.act(id, "cancel")
    await_end(service, f"/v1/certificates/{id}")


@pytest.fixture(scope="module")
def long(service):
    """Twenty designs, and all axes."""
    value = {"designs": bodies(service, 20), "physics": {"n_steps": 200}, "held_out": 16,
             "worlds": 16, "chance": 2, "experiment": "certified"}
    return run(service, "certificates", value)["id"]


# As long as verdicts usually are, or longer.
VERDICT = ("It turns voxels inside out. With finer time steps, its rank hardly changes, from 11 to "
           "10, and its score stays at 0.75. Luck hardly changes its score of 0.75 (rank 11). Its "
           "score worsens from 0.75 to 0.87 when the drop height increases by 0.2 m, and to 0.82 "
           "when friction is multiplied by 0.7; 2 other changes make it worse, too. When all "
           "constants vary, its score is 0.81 (0.78 to 0.84). In fresh worlds, its score is 0.76 "
           "(0.75 to 0.76).")


def test_on_paper(browser, long):
    """Twenty designs are one sheet, black on white, in either theme; other pages stay as they
    are."""
    def pages():
        pdf = browser.driver.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
        data = base64.b64decode(pdf["data"])
        width, height = re.search(rb"/MediaBox\s*\[0 0 ([\d.]+) ([\d.]+)\]", data).groups()
        return len(re.findall(rb"/Type\s*/Page\b(?!s)", data)), float(width), float(height)

    opened(browser, long, theme="dark")
    browser.run("for (const e of document.querySelectorAll('.design .verdict'))"
                "e.lastChild.data = arguments[0]", VERDICT)
    n, width, height = pages()
    assert n == 1 and (width, height) == pytest.approx((595, 842), abs=1.5)
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        color = "return getComputedStyle(document.querySelector(arguments[0]))[arguments[1]]"
        assert browser.run(color, "body", "backgroundColor") == "rgb(255, 255, 255)"
        for selector in (".sentence", ".levels tbody th", ".design .verdict"):
            assert browser.run(color, selector, "color") == "rgb(0, 0, 0)"
        assert browser.run(color, ".levels .dot", "stroke") == "rgb(0, 0, 0)"
        assert browser.run(color, "header.bar", "display") == "none"
        browser.run("location.hash = '#/runs'")
        browser.until("document.querySelector('.runs')")
        assert browser.run(color, "header.bar", "display") == "flex"
    finally:
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


def test_on_a_phone(browser, long):
    metrics = {"width": 360, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        opened(browser, long, "?open=0,1")
        assert browser.run("return document.documentElement.scrollWidth") <= 360
        wide = browser.run("return [...document.querySelectorAll('.certificate .scroll')]"
                           ".filter((e) => e.scrollWidth > e.clientWidth + 1).length")
        assert wide == 0, "no table scrolls sideways"
    finally:
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_the_table_is_saved(browser, certificate, service, tmp_path):
    browser.driver.execute_cdp_cmd("Browser.setDownloadBehavior", {
        "behavior": "allow", "downloadPath": str(tmp_path)})
    opened(browser, certificate["id"])
    browser.click("CSV", "a")
    name = tmp_path / f"certificate-{certificate['id']}.csv"
    until(name.exists, 60)
    path = f"/v1/certificates/{certificate['id']}/report.csv"
    until(lambda: name.read_bytes() == service.request("GET", path).body, 60)
