"""Atlases: the reader of files against the library, the static site, and the page of a service."""

import contextlib
import functools
import http.server
import json
import os
import pathlib
import subprocess
import threading

import pytest
from selenium.webdriver.common.keys import Keys

import atlases
from browser import Browser
from contract import SOURCE
from service import DESIGN, await_end
from test_pages import ACCESSIBILITY

ANSWERS = pathlib.Path(os.environ.get("MORPHOD", SOURCE / "build" / "src" / "daemon" / "morphod"))
ANSWERS = ANSWERS.parents[2] / "tests" / "unit" / "atlas" / "atlas-answers"
TOOL = SOURCE / "tools" / "atlas-site"
VOXELS = 8
SITE_BYTES = 3_000_000


def write_atlas(path, voxels, levels=1000, *hashes):
    """Returns what the library answers about each body of an atlas with invented losses. Hashes:
    of its controller and of its physics."""
    words = [ANSWERS, path, "6", "6", "4", str(voxels), str(levels), "0", *hashes]
    lines = subprocess.run(words, check=True, capture_output=True).stdout.splitlines()
    return [json.loads(line) for line in lines[1:]]


def make_site(*words):
    return subprocess.run([TOOL, *words], capture_output=True, text=True)


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@contextlib.contextmanager
def served(folder):
    """Serves a folder as any web server does."""
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    server.host, server.port = server.server_address
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    folder = tmp_path_factory.mktemp("atlas")
    return {"items": write_atlas(folder / "all.atlas", VOXELS), "path": folder / "all.atlas"}


@pytest.fixture(scope="module")
def site(answers):
    """A browser that is at a static site without recordings."""
    folder = answers["path"].parent / "site"
    made = make_site("--name", "invented", answers["path"], folder)
    assert made.returncode == 0, made.stderr
    with served(folder) as server:
        page = Browser(server)
        yield page
        page.quit()


@contextlib.contextmanager
def deleted(service, *names):
    """Deletes atlases at the end, so that other tests do not see them."""
    try:
        yield
    finally:
        for name in names:
            service.request("DELETE", f"/v1/atlases/{name}")


@contextlib.contextmanager
def stored(service, name, data):
    """Stores an atlas until the end, and returns its path."""
    with deleted(service, name):
        reply = service.request("PUT", f"/v1/atlases/{name}/file", body=data,
                                headers={"Content-Type": "application/octet-stream"})
        assert reply.status == 201, reply.body
        yield f"/v1/atlases/{name}"


def visit(page, link="", shown=".better-than"):
    page.driver.get("about:blank")
    page.driver.get(page.base + link)
    page.until(f"document.querySelector({shown!r})")


# Asks the reader of files for what the library was asked.
ASK = """
const [items, done] = arguments;
(async () => {
  const { AtlasFile } = await import(new URL('lib/atlas_file.js', location.href));
  const bytes = await (await fetch('bodies.atlas')).arrayBuffer();
  const atlas = new AtlasFile(bytes, 'invented');
  const { optima, items: all } = await atlas.optima({ limit: Infinity });
  const basins = new Map(all.map((one) => [one.position, one.basin]));
  const found = [];
  for (const { position } of items) {
    const { genotype } = await atlas.at(position);
    const body = await atlas.body(genotype, { changes: 1000 });
    const { optimum } = await atlas.ascent(genotype);
    const [best] = body.best_changes;
    found.push({ position: body.position, voxels: body.voxels, genotype, score: body.score,
      loss: body.losses[1], rank: body.rank, rank_of_size: body.of_size.rank,
      percentile: body.percentile, neighbors: body.best_changes.length, best: best.position,
      step: best.step, optimum: optimum.position, basin: basins.get(optimum.position) });
  }
  const [reach, travel, varied] = atlas.environments.map((one) => one.task);
  const refused = [bytes.slice(0, -8), bytes.slice(0, 100), new ArrayBuffer(400)].map((wrong) => {
    try { new AtlasFile(wrong, 'wrong'); } catch (error) { return error.message; }
  });
  const { counts } = await atlas.histogram({ bins: 1000 });
  const counted = counts.flat().reduce((sum, n) => sum + n);
  const finite = atlas.scores.filter(Number.isFinite).length;
  done({ bodies: atlas.n, optima, items: found, reach, travel, varied, refused, counted, finite });
})().catch((error) => done(String(error)));
"""


def answer(bodies, body):
    """Returns what the library says about a body, as ASK does."""
    neighbors = body["neighbors"][3]  # by all steps
    best, _, step = neighbors[0]
    return {"position": body["position"], "voxels": body["voxels"], "genotype": body["genotype"],
            "score": body["score"], "loss": body["losses"][1], "rank": body["rank"][0] + 1,
            "rank_of_size": body["rank_of_size"][0] + 1, "percentile": body["rank"][3],
            "neighbors": len(neighbors), "best": best,
            "step": {1: "add", 2: "remove", 4: "move"}[step], "optimum": body["optimum"],
            "basin": bodies[body["optimum"]]["basin"]}


def test_the_page_and_the_library_agree(answers, site):
    visit(site)
    site.driver.set_script_timeout(300)
    bodies = answers["items"]
    some = [answer(bodies, body) for body in bodies if "neighbors" in body]
    assert len(some) > 300
    found = site.driver.execute_async_script(ASK, [{"position": one["position"]} for one in some])
    assert isinstance(found, dict), found
    assert (found["bodies"], found["optima"]) == (
        len(bodies), sum(body["basin"] > 0 for body in bodies))
    for got, expected in zip(found["items"], some):
        assert got == pytest.approx(expected, rel=1e-7), expected["position"]
    assert found["reach"] == {"objective": "reach", "guide": {"kind": "fixed"}}
    assert found["travel"] == {"objective": "travel", "guide": {"kind": "ahead"}}
    assert found["varied"] == found["travel"], "an environment with factors is packed otherwise"
    assert found["counted"] == found["finite"]
    assert [text.split()[1] for text in found["refused"]] == ["is"] * 3, found["refused"]


def test_a_stranger_finds_the_best_body_of_six_voxels(answers, site):
    """In at most three clicks, on a page that says what it is about."""
    visit(site)
    assert "All 24,135 robots of at most 8 voxels" in site.texts(".sentence")[0]
    best = min(one["score"] for one in answers["items"] if one["voxels"] == 6 and
               one["score"] is not None)
    site.run("[...document.querySelectorAll('button.card')]"
             ".find((e) => e.innerText.includes('6 voxels')).click()")
    site.until("document.querySelector('.atlas-numbers').innerText.includes('1: the best')")
    score = float(site.texts(".atlas-numbers dd")[0])
    assert score == pytest.approx(best, abs=5e-5)
    assert site.run("return location.hash.split('=')[1].replaceAll('0', '').length") == 6
    assert "no recordings" in site.texts(".walk-words")[0]
    assert site.faults() == []


def test_everything_by_keyboard(site):
    """A voxel is added in the layers, a change and the map are used, and all can be undone."""
    visit(site, "#voxels=" + "1" + "0" * 143)
    before = site.texts(".atlas-numbers")[0]
    site.run("document.querySelector('[data-cell=\"0,0,1\"]').focus()")
    site.driver.switch_to.active_element.send_keys(Keys.SPACE)
    site.until("document.querySelector('.atlas-numbers').innerText.includes('of 2 voxels')")
    site.run("document.querySelector('[aria-label=\"One voxel from here\"] .card').focus()")
    site.driver.switch_to.active_element.send_keys(Keys.ENTER)
    site.until("!document.querySelector('.atlas-numbers').innerText.includes('of 2 voxels')")
    assert site.run("return document.activeElement.matches('.card')"), "the focus stays"
    site.run("document.querySelector('canvas[role=application]').focus()")
    canvas = site.driver.switch_to.active_element
    canvas.send_keys(Keys.ARROW_UP)
    site.until("/ of \\d voxels? with scores/.test(document.querySelector('[aria-label=Map]')"
               ".innerText)")
    first = site.texts("[aria-label=Map] p")
    canvas.send_keys(Keys.ARROW_RIGHT)
    site.until(f"document.querySelector('[aria-label=Map] p').innerText !== {first[0]!r}")
    assert site.run("return document.querySelectorAll('[aria-label=Map] .card').length") > 0
    for _ in range(2):
        canvas.send_keys(Keys.CONTROL, "z")
    site.until(f"document.querySelector('.atlas-numbers').innerText === {before!r}")
    assert site.faults() == []


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_all_can_use_it(site, theme):
    visit(site)
    if site.run("return document.documentElement.dataset.theme") != theme:
        site.run("[...document.querySelectorAll('button')]"
                 ".find((e) => e.innerText.endsWith('theme')).click()")
    site.click("Find them")
    site.until("document.querySelectorAll('[aria-label=\"Local optima\"] .card').length === 18",
               300)
    assert site.run(ACCESSIBILITY) == []
    text = site.run("return document.body.innerText")
    assert not any(word in text for word in ("null", "undefined", "NaN"))


def test_it_fits_a_phone(site):
    metrics = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    site.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        visit(site)
        assert site.run("return document.documentElement.scrollWidth") <= 390
    finally:
        site.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_bodies_outside_say_so(site):
    """Too many voxels, or not in one piece: the page says what to do."""
    visit(site, "#voxels=" + "1" * 12 + "0" * 132, ".atlas-numbers .error")
    assert "ends at 8 voxels" in site.texts(".atlas-numbers")[0]
    visit(site, "#voxels=" + "1001" + "0" * 140, ".warning")
    site.until("document.querySelector('.warning').innerText.includes('1 loose voxel')")


# Makes a map of invented scores; returns the bars, and how many bodies a click on each lists.
MAP = """
const [scores, done] = arguments;
(async () => {
  const { AtlasMap } = await import(new URL('views/atlas_map.js', location.href));
  const within = (lo, hi) => scores.filter((one) => one >= lo && one < hi).length;
  const [low, high] = [Math.min(...scores), Math.max(...scores) * (1 + 1e-9)];
  const atlas = {
    async histogram({ bins, lo = low, hi = high }) {
      const edges = Array.from({ length: bins + 1 }, (_, i) => lo + (hi - lo) * i / bins);
      return { edges, counts: [edges.slice(1).map((edge, i) => within(edges[i], edge))] };
    },
    async best({ lo, hi }) {
      return { items: [], bodies: within(lo, hi) };
    },
  };
  const map = new AtlasMap({ atlas, about: { sizes: [{}] }, app: { themeListeners: new Set() } });
  while (!map.counts) await new Promise((next) => setTimeout(next, 1));
  const listed = [];
  for (let i = 0; i < map.counts[0].length; i++) {
    await map.select(0, i, i);
    listed.push(Number(map.words.textContent.split(' ')[0]));
  }
  map.destroy();
  done([map.isLog, map.counts[0], listed]);
})().catch((error) => done(String(error)));
"""


@pytest.mark.parametrize("highest, is_log", [(50, True), (1, True), (0.2, False)])
def test_bars_are_what_a_click_lists(site, highest, is_log):
    """Also with outliers, and with an axis that is logarithmic."""
    visit(site)
    scores = [0.06 + 0.1 * (i / 500)**2 for i in range(500)] + [highest]
    found = site.driver.execute_async_script(MAP, scores)
    assert isinstance(found, list), found
    assert found[0] == is_log
    assert found[1] == found[2] and sum(found[1]) == 501
    assert sum(n > 0 for n in found[1]) > 10


# Returns a body that is not among these.
OTHER = """
const [ids, done] = arguments;
(async () => {
  const { AtlasFile } = await import(new URL('lib/atlas_file.js', location.href));
  const atlas = new AtlasFile(await (await fetch('bodies.atlas')).arrayBuffer(), 'five');
  for (let at = atlas.n - 1; ; at--) {
    const body = await atlas.at(at);
    if (!ids.includes(body.id)) return done(body.genotype);
  }
})().catch((error) => done(String(error)));
"""
# Returns the ids of the best body of each size, and of the largest basins.
MUST_WALK = """
const [done] = arguments;
(async () => {
  const { AtlasFile } = await import(new URL('lib/atlas_file.js', location.href));
  const atlas = new AtlasFile(await (await fetch('bodies.atlas')).arrayBuffer(), 'five');
  const { sizes } = await atlas.about();
  const { items } = await atlas.optima({ limit: 12 });
  done([...sizes.map(({ best }) => best.id), ...items.map(({ id }) => id)]);
})().catch((error) => done(String(error)));
"""


def inputs(service, physics=None):
    """Returns the hashes of a controller and of physics, as walks have them."""
    header = service.post("/v1/rollouts", {
        "designs": [DESIGN], "record": [], "physics": physics or {}})
    return header["controller"], header["physics_sha256"]


def test_a_site_is_small_and_records_motion(service, answers, site, tmp_path):
    """The best of each size and footprint walk; other bodies stand, and the page says so."""
    write_atlas(tmp_path / "five.atlas", 5, 1000, *inputs(service))
    url = f"http://{service.host}:{service.port}"
    made = make_site("--service", url, tmp_path / "five.atlas", tmp_path / "site")
    assert made.returncode == 0, made.stderr
    shown = json.loads((tmp_path / "site" / "site.json").read_text())["recordings"]
    files = [path for path in (tmp_path / "site").rglob("*") if path.is_file()]
    walks = max(path.stat().st_size for path in files if path.suffix == ".scene")
    everything = sum(path.stat().st_size for path in answers["path"].parent.rglob("site/**/*")
                     if path.is_file())
    assert everything + 30 * walks <= SITE_BYTES, "as many walks as a site of 8 voxels has"
    with served(tmp_path / "site") as server:
        page = Browser(server)
        try:
            visit(page)
            expected = page.driver.execute_async_script(MUST_WALK)
            assert len(expected) == 17 and set(expected) <= {one["id"] for one in shown}
            page.until("/^Recorded/.test(document.querySelector('.walk-words').innerText)")
            assert "of the atlas, " + inputs(service)[1][:8] in page.texts(".walk-words")[0]
            page.until("document.querySelector('.stage').player.stage.durationS() > 1")
            other = page.driver.execute_async_script(OTHER, [one["id"] for one in shown])
            page.driver.get(page.base + "#voxels=" + other)
            page.until("/stands still/.test(document.querySelector('.stage .note').innerText)")
            page.until("/^This page has no/.test(document.querySelector('.walk-words').innerText)")
            assert page.faults() == []
        finally:
            page.quit()


def test_the_page_of_a_service(service, browser, tmp_path):
    """The same numbers over the routes; the body walks under the controller of the atlas, and
    another atlas can be compared."""
    controller = service.get("/v1/controllers")["items"][0]["sha256"]
    with deleted(service, "page-five", "page-other"):
        for name, levels, by in (("page-five", 1000, controller), ("page-other", 900, "ab" * 32)):
            write_atlas(tmp_path / name, 5, levels, by)
            reply = service.request("PUT", f"/v1/atlases/{name}/file",
                                    body=(tmp_path / name).read_bytes(),
                                    headers={"Content-Type": "application/octet-stream"})
            assert reply.status == 201, reply.body
        see_the_page(service, browser)


# The service refuses what is asked of single bodies.
REFUSES = """
const ask = window.fetch;
window.fetch = (what, how) => (String(what.url ?? what).includes('/body') ? Promise.resolve(
  new Response('{"detail": "Out of order"}', { status: 422 })) : ask(what, how));
"""


def see_the_page(service, browser):
    browser.open("atlas")
    browser.until("document.querySelector('main table')")
    assert {"page-five", "page-other"} <= set(browser.texts("main td a"))
    best = service.get("/v1/atlases/page-five/best?voxels=4&limit=1")["items"][0]
    browser.open("atlas/page-five")
    browser.until("document.querySelectorAll('.sizes .card').length === 5")
    browser.run("document.querySelectorAll('.sizes .card')[3].click()")
    browser.until("document.querySelector('.atlas-numbers').innerText.includes('1: the best')")
    assert browser.texts(".atlas-numbers dd")[:2] == [f"{best['score']:.4f}", str(best["rank"])]
    browser.until("/^As drawn/.test(document.querySelector('.walk-words').innerText)", 300)
    assert "default physics, because this service does not" in browser.texts(".walk-words")[0]
    changes = service.get("/v1/atlases/page-five/neighbors?steps=add,remove,move&design=" +
                          best["genotype"])["items"]
    assert browser.texts("[aria-label='One voxel from here'] strong") == \
        [f"{one['score']:.4f}" for one in changes[:8]]
    browser.click("Find them")
    browser.until("document.querySelectorAll('[aria-label=\"Local optima\"] .card').length > 5")
    browser.run("const e = document.querySelector('[aria-label=\"Compare with\"]');"
                "e.value = 'page-other'; e.dispatchEvent(new Event('change'))")
    browser.until("document.querySelector('[aria-label=Compare] p').innerText.includes('Kendall')")
    assert "124 bodies are in both" in browser.texts("[aria-label=Compare] p")[0]
    assert browser.run(ACCESSIBILITY) == []
    assert [one for one in browser.faults() if "v1/physics/" not in one] == []
    browser.run(REFUSES)
    browser.click("Random")
    browser.until("document.querySelector('#toast').innerText.includes('Out of order')")
    browser.open("atlas/page-other")
    browser.until("/^It does not walk: /.test(document.querySelector('.walk-words').innerText)")


SPEED = "mean_speed_m_per_s"
# Asks the reader of files about measures.
ASK_MEASURES = """
const [name, done] = arguments;
(async () => {
  const { AtlasFile } = await import(new URL('lib/atlas_file.js', location.href));
  const atlas = new AtlasFile(await (await fetch('bodies.atlas')).arrayBuffer(), 'measured');
  const tied = new AtlasFile(await (await fetch('tied.atlas')).arrayBuffer(), 'tied');
  const bodies = [];
  for (let i = 0; i < atlas.n; i++) {
    const { genotype, measures } = await atlas.at(i);
    const { of_size: own } = await atlas.body(genotype);
    bodies.push([measures, own.measures]);
  }
  const positions = ({ items }) => items.map((one) => one.position);
  done({ bodies, measures: (await atlas.about()).measures,
    all: positions(await atlas.best({ measure: name, limit: 1000 })),
    some: positions(await atlas.best({ measure: name, voxels: 5, lo: -1, hi: 2 })),
    part: positions(await atlas.best({ measure: name, hi: 2, score_lo: 0.4, score_hi: 0.5 })),
    low: positions(await atlas.best({ measure: name, score_hi: 0.5 })),
    maps: await Promise.all([atlas, tied].map((one) => one.map(name, { bins: 5 }))),
    histogram: await atlas.histogram({ measure: name, bins: 7 }) });
})().catch((error) => done(String(error)));
"""


@pytest.fixture(scope="module")
def measured():
    return atlases.file_of(levels=300, measures=("displacement_m", SPEED))


def choose_the_axis(page, plain):
    """The map goes by a measure after one choice, and lists the bodies of a place."""
    assert page.texts("[aria-label=Map] h2") == ["All bodies by score and size"]
    page.run("const e = document.querySelector('[aria-label=Axis]');"
             f"e.value = '{SPEED}'; e.dispatchEvent(new Event('change'))")
    page.until(f"document.querySelector('[aria-label=Map] h2').innerText.includes('{SPEED}')")
    without = sum(value != value for value in plain.measures[SPEED])
    assert f"{without} bodies have no value" in page.texts("[aria-label=Map] p")[0]
    page.run("const e = document.querySelector('[aria-label=Map] canvas'); e.focus();"
             "for (const key of ['ArrowUp', 'ArrowUp', 'ArrowUp', 'ArrowUp', 'ArrowLeft'])"
             "  e.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true }));")
    page.until(f"document.querySelector('[aria-label=Map] p').innerText.includes('with {SPEED}')")
    words = page.texts("[aria-label=Map] p")[0]
    lo, hi = (float(text) for text in words.split(": ")[0].split(" from ")[1].split(" to "))
    ids = page.run("return [...document.querySelectorAll('[aria-label=Map] .card')]"
                   ".map((e) => e.dataset.id)")
    found = {plain.body(i)["id"]: plain.measures[SPEED][i] for i in range(124)}
    assert ids and all(lo - 0.01 <= found[id] <= hi + 0.01 for id in ids), (words, ids)
    shown = page.texts(".atlas-numbers dl:nth-of-type(2) dt")
    assert shown == ["displacement_m", SPEED]
    assert "of its size" in page.texts(".atlas-numbers dl:nth-of-type(2) dd")[0]
    assert page.run(ACCESSIBILITY) == []


PAIRS = "[aria-label='Score and measure']"


def brush_the_map(page, plain):
    """A drag over scores and values lists the bodies there, and arrow keys do the same."""
    page.run(f"const e = document.querySelector(`{PAIRS} select`);"
             f"e.value = '{SPEED}'; e.dispatchEvent(new Event('change'))")
    page.until(f"document.querySelector(`{PAIRS} p`).innerText.includes('Kendall')")
    without = sum(value != value for value in plain.measures[SPEED])
    assert f"{without} bodies have no value" in page.texts(f"{PAIRS} p")[0]
    page.run(f"const e = document.querySelector(`{PAIRS} canvas`);"
             "const { left, top, width, height } = e.getBoundingClientRect();"
             "e.setPointerCapture = () => {};"
             "for (const [type, x, y] of [['pointerdown', 0.2, 0.2], ['pointermove', 0.8, 0.8],"
             " ['pointerup', 0.8, 0.8]]) e.dispatchEvent(new PointerEvent(type, { button: 0,"
             " clientX: left + x * width, clientY: top + y * height, bubbles: true }));")
    words = check_the_brush(page, plain)
    page.run(f"const e = document.querySelector(`{PAIRS} canvas`);"
             "for (const key of ['ArrowRight', 'ArrowUp', 'ArrowUp', 'ArrowUp']) e.dispatchEvent("
             "new KeyboardEvent('keydown', { key, shiftKey: true, bubbles: true }));")
    page.until(f"document.querySelector(`{PAIRS} p`).innerText !== {words!r}")
    check_the_brush(page, plain)
    assert page.run(ACCESSIBILITY) == []


def check_the_brush(page, plain):
    """Compares the list with what the words above it say. Returns the words."""
    page.until(f"document.querySelector(`{PAIRS} p`).innerText.includes('with scores from')")
    page.until(f"document.querySelectorAll(`{PAIRS} .card`).length > 1")
    words = page.texts(f"{PAIRS} p")[0]
    ranges = words.split(": ")[0].split(" with scores from ")[1]
    scores, values = ranges.split(f" and {SPEED} from ")
    (a, b), (lo, hi) = ([float(text) for text in part.split(" to ")] for part in (scores, values))
    assert a < b and lo < hi
    listed = {item["id"] for item in (plain.body(i) for i in range(124)
                                      if a - 1e-3 <= plain.scores[i] <= b + 1e-3 and
                                      lo - 1e-2 <= plain.measures[SPEED][i] <= hi + 1e-2)}
    ids = page.run(f"return [...document.querySelectorAll(`{PAIRS} .card`)].map((e) => "
                   "e.dataset.id)")
    assert set(ids) <= listed and len(set(ids)) == len(ids)
    n = int(words.split()[0])
    assert len(ids) == min(n, 24)
    return words


def test_measures_in_a_site(service, measured, tmp_path):
    """Every number of the reader is that of a plain reading, and its maps are those of a service;
    the axis of the map can be chosen, and the map of score and measure be brushed."""
    plain = atlases.Plain(measured)
    (tmp_path / "a.atlas").write_bytes(measured)
    made = make_site("--name", "measured", tmp_path / "a.atlas", tmp_path / "site")
    assert made.returncode == 0, made.stderr
    tied = atlases.file_of(levels=2, measures=(SPEED, ))
    (tmp_path / "site" / "tied.atlas").write_bytes(tied)
    with served(tmp_path / "site") as server, contextlib.ExitStack() as at_the_end:
        page = Browser(server)
        at_the_end.callback(page.quit)
        visit(page)
        page.driver.set_script_timeout(120)
        found = page.driver.execute_async_script(ASK_MEASURES, SPEED)
        assert isinstance(found, dict), found
        assert found["measures"] == list(plain.measures)
        for i, (values, percentiles) in enumerate(found["bodies"]):
            assert values == pytest.approx(plain.body(i)["measures"], rel=1e-6)
            assert percentiles == pytest.approx(
                {name: plain.percentile(name, i) for name in plain.measures})
        values = plain.measures[SPEED]
        known = [i for i in plain.by(SPEED, True, range(124)) if values[i] == values[i]]
        assert found["all"] == known
        assert found["some"] == [i for i in known if -1 <= values[i] < 2 and i >= 29]
        assert found["part"] == [i for i in known
                                 if values[i] < 2 and 0.4 <= plain.scores[i] < 0.5]
        assert found["low"] == [i for i in known if plain.scores[i] < 0.5]
        for one, data in zip(found["maps"], (measured, tied)):
            with stored(service, "site-measured", data) as path:
                expected = service.get(f"{path}/map?measure={SPEED}&bins=5")
                assert expected.pop("name") == "site-measured"
                for edges in ("edges_score", "edges_measure"):
                    assert one.pop(edges) == pytest.approx(expected.pop(edges), rel=1e-6)
                assert one == expected
        histogram = found["histogram"]
        assert sum(map(sum, histogram["counts"])) == len(known)
        assert sum(histogram["outside"]) == 124 - len(known)
        choose_the_axis(page, plain)
        brush_the_map(page, plain)
        assert page.faults() == []


def test_measures_of_a_service(service, browser, measured):
    with stored(service, "page-measured", measured):
        browser.open("atlas/page-measured")
        browser.until("document.querySelector('.better-than')")
        choose_the_axis(browser, atlases.Plain(measured))
        brush_the_map(browser, atlases.Plain(measured))


def test_builds_are_shown(service, browser):
    """In the list, and at the address of the atlas, which is its page once it is built."""
    request = {"voxels": 6, "name": "slow", "physics": {"n_steps": 5000}}
    id = service.post("/v1/atlases", request)["id"]
    service.act(id, "pause")
    for view in ("atlas", "atlas/slow"):
        browser.open(view)
        browser.until("document.querySelector('article h2')?.innerText === 'Building slow'")
        assert "bodies" in browser.texts("article")[0]
    assert browser.run(ACCESSIBILITY) == []
    service.act(id, "cancel")
    browser.until("!document.querySelector('article')")
    quick = {"voxels": 2, "name": "quick", "orientations": "canonical", "physics": {"n_steps": 50}}
    with deleted(service, "quick"):
        service.post("/v1/atlases", quick)
        browser.open("runs?kind=atlas")
        browser.until("[...document.querySelectorAll('.runs a')]"
                      ".some((e) => e.hash === '#/atlas/quick')")
        browser.open("atlas/quick")
        browser.until("document.querySelector('.better-than')", 300)
        browser.until("document.title === 'Atlas quick · morphod'")
        browser.until("/with the controller and physics of the atlas/"
                      ".test(document.querySelector('.walk-words').innerText)", 300)
    assert browser.faults() == []


# Holds back what a list says about builds until window.go.
HOLD = """
const { fetch } = window;
window.fetch = async (resource, ...how) => {
  const isBuilds = String(resource.url ?? resource).includes('kind=atlas');
  while (isBuilds && !window.go) await new Promise((later) => setTimeout(later, 20));
  return fetch(resource, ...how);
};
"""


def test_a_build_that_ends_is_in_the_list(service, browser):
    """Also if it ends between the requests for atlases and for builds."""
    listed = "[...document.querySelectorAll('main table a')].some((e) => e.innerText === 'late')"
    request = {"voxels": 6, "name": "late", "physics": {"n_steps": 100},
               "orientations": "canonical"}
    with deleted(service, "late"):
        id = service.post("/v1/atlases", request)["id"]
        service.act(id, "pause")
        browser.open("atlas")
        browser.until("document.querySelector('article h2')?.innerText === 'Building late'")
        browser.run(HOLD)
        service.act(id, "resume")
        assert await_end(service, f"/v1/jobs/{id}").json()["state"] == "succeeded"
        browser.run("window.go = true")
        browser.until(listed, 30)
        browser.until("!document.querySelector('article')")
    assert browser.faults() == []


@pytest.mark.parametrize("bytes, words", [(b"", "not an atlas"), (None, "truncated")])
def test_the_tool_refuses(answers, tmp_path, bytes, words):
    whole = answers["path"].read_bytes()
    (tmp_path / "a.atlas").write_bytes(whole[:-100] if bytes is None else bytes)
    made = make_site(tmp_path / "a.atlas", tmp_path / "site")
    assert made.returncode != 0 and words in made.stderr
    assert not (tmp_path / "site").exists()
    made = make_site(answers["path"], tmp_path)
    assert made.returncode != 0 and "not empty" in made.stderr


@pytest.mark.parametrize("at", [60, 310, 3000, -5000, -9])
def test_the_tool_refuses_damage(answers, tmp_path, at):
    """In the header, the environments, and blocks."""
    damaged = bytearray(answers["path"].read_bytes())
    damaged[at] ^= 1
    (tmp_path / "a.atlas").write_bytes(damaged)
    made = make_site(tmp_path / "a.atlas", tmp_path / "site")
    assert made.returncode != 0 and "damaged: remove FILE" in made.stderr
    assert list(tmp_path.iterdir()) == [tmp_path / "a.atlas"]


def test_walks_have_the_inputs_of_the_atlas(service, tmp_path):
    """Other physics, another set of environments and a service without a token are refused."""
    short = {"n_steps": 310, "stiffness_n_per_m": 1410}
    write_atlas(tmp_path / "a.atlas", 3, 1000, *inputs(service, short))
    url = f"http://{service.host}:{service.port}"
    made = make_site("--service", url, tmp_path / "a.atlas", tmp_path / "site")
    assert made.returncode != 0 and "with --physics" in made.stderr
    made = make_site("--service", url, "--environments", "morpho-12-walk", tmp_path / "a.atlas",
                     tmp_path / "site")
    assert made.returncode != 0 and "not those of morpho-12-walk" in made.stderr
    assert list(tmp_path.iterdir()) == [tmp_path / "a.atlas"]
    made = make_site("--service", url, "--physics", json.dumps(short), "--environments",
                     "paper-test", tmp_path / "a.atlas", tmp_path / "site")
    assert made.returncode == 0, made.stderr
    assert json.loads((tmp_path / "site" / "site.json").read_text())["recordings"]
    assert (tmp_path / "site").stat().st_mode & 0o777 == 0o755
    # Once a score is stored, the service knows the physics.
    service.evaluate({"designs": [DESIGN], "physics": short})
    (tmp_path / "token").write_text("not needed\n")
    (tmp_path / "empty").mkdir()
    made = make_site("--service", url, "--token-file", tmp_path / "token", tmp_path / "a.atlas",
                     tmp_path / "empty")
    assert made.returncode == 0, made.stderr
