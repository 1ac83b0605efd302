"""Pages refresh automatically: typed text and pressed buttons stay, and each action gets a
response."""

import pytest

from browser import Browser
from conftest import CAMPAIGN, TRAINING
from service import DESIGN, await_end, run

MODULE = """
const done = arguments[arguments.length - 1];
const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
import(folder + 'lib/%s.js').then(%s).then(done, (error) => done('failed: ' + error));
"""
TOAST = "document.querySelector('#toast[data-open]:popover-open')"


def module(browser, name, script):
    """Returns the result of a function that gets a module of the page."""
    return browser.driver.execute_async_script(MODULE % (name, script))


def go(browser, view):
    """Navigates to a view, as a link does."""
    browser.run("location.hash = '#/' + arguments[0]", view)
    browser.until("!/Loading/.test(document.querySelector('main').innerText)")


@pytest.fixture(scope="module")
def busy(service):
    """A campaign that runs during all tests."""
    id = service.post("/v1/campaigns", CAMPAIGN | {"generations": 90000, "label": "busy"})["id"]
    yield id
    service.act(id, "cancel")


def test_a_refresh_leaves_what_is_typed_and_has_the_focus(browser, busy):
    browser.open("overview")
    browser.until("document.querySelector('article input')")
    browser.run("""
        window.typed = document.querySelector('article input');
        window.pressed = document.querySelector('article button');
        typed.focus();
        typed.value = '3.5';
        performance.clearResourceTimings();
    """)
    polls = "performance.getEntriesByType('resource').filter((e) => /threads/.test(e.name)).length"
    browser.until(polls + " > 1")
    browser.until("document.activeElement === typed && typed.value === '3.5'")
    assert browser.run("return pressed.isConnected")
    go(browser, "campaigns/" + busy)
    browser.until("document.querySelector('.pick input')")
    browser.run("""
        window.chosen = document.querySelector('.pick input');
        chosen.click();
        chosen.focus();
        window.said = document.querySelector('progress + div');
        window.before = said.textContent.split(';')[0];
    """)
    browser.until("said.isConnected && said.textContent.split(';')[0] !== before")
    browser.until("document.activeElement === chosen && chosen.checked && chosen.isConnected")
    assert browser.faults() == []


def test_lists_are_patched_around_what_is_in_use(browser):
    """Elements are kept by key. The one with the focus stays in the document, whatever the new
    order."""
    browser.open("nowhere")
    orders = module(browser, "dom", """({ patch, h }) => {
        const list = h('div');
        document.body.append(list);
        const show = (text) => patch(list, [...text], (one) => one,
          (one) => h('button', {}, one), (element, one) => { element.title = one; });
        show('abcd');
        const [, b] = list.children;
        b.focus();
        let lost = 0;
        b.addEventListener('blur', () => { lost++; });
        const texts = ['dcba', 'xbya', 'b', 'qrstb', 'abcd'].map((text) => {
          show(text);
          return [list.textContent, list.children[[...text].indexOf('b')] === b];
        });
        list.remove();
        return [texts, lost - 1]; // it goes with the list
    }""")
    assert orders == [[[text, True] for text in ("dcba", "xbya", "b", "qrstb", "abcd")], 0]


def test_styles_are_classes(service, browser):
    """The policy forbids the attribute; a note keeps its lines without it."""
    browser.open("campaigns/" + service.campaign)
    browser.until("document.querySelector('.remark').innerText")
    assert browser.texts(".remark") == ["in first steps – It falls.\nIt gets up."]
    assert browser.faults() == []
    assert module(browser, "dom", "({ h }) => h('p', { style: 'color: red' })").startswith("failed")


def test_refusals_and_news_are_seen(browser, busy):
    browser.open("lab?voxels=" + "1" + "0" * 143)
    browser.click("←")
    browser.until(TOAST)
    assert browser.texts("#toast span") == ["The body is at the edge of the workspace."]
    go(browser, "campaigns/" + busy)
    browser.until("!" + TOAST)
    browser.run("""
        const weight = document.querySelector('main .field.inline input');
        weight.value = '0';
        weight.dispatchEvent(new Event('change'));
    """)
    browser.until(TOAST + "?.matches('.refusal')")
    assert browser.texts("#toast span")[0].startswith("Weight: must be at least 0.001")
    assert browser.run("return document.querySelector('.field.inline input').value") == "1"
    browser.run("document.querySelector('#toast button').click()")
    assert browser.run(f"return {TOAST}") is None


def test_the_phase_before_the_first_generation_is_named(browser, service, busy):
    """There are no events during this phase, so the page polls."""
    browser.open("campaigns")
    browser.run("""
        const { fetch } = window;
        let done = 0;
        window.fetch = async (path, ...rest) => {
          const reply = await fetch(path, ...rest);
          if (!path.endsWith('/' + arguments[0])) return reply;
          const job = await reply.json();
          Object.assign(job, { state: 'running', phase: 'preparing', reason: null });
          Object.assign(job.progress, {
            generation: null, under_way: 0, done: done += 1000, total: 11468800, seconds_left: 240,
          });
          return new Response(JSON.stringify(job));
        };
    """, busy)
    go(browser, "campaigns/" + busy)
    said = "document.querySelector('progress + div').innerText"
    text = "Leaving out pretraining bodies: {} of 11,468,800 redrawn, 4 min left"
    for done in ("1,000", "2,000"):
        browser.until(f"{said} === {text.format(done)!r}")
    assert browser.run("return document.querySelector('progress').value") < 0.001
    assert browser.run("return document.title") == (
        "busy, Leaving out pretraining bodies · morphod")


def test_a_study_waits_for_its_client(service, browser):
    browser.open("campaigns/" + service.study)
    assert browser.texts(".title .state") == ["waiting for its client"]
    assert browser.run("return document.querySelector('main progress').hidden") is True


def test_axes_and_single_values_of_charts(browser):
    """An axis with a fixed range keeps it. A single value is drawn completely, even at the edge."""
    browser.open("nowhere")
    scale, n, whole = module(browser, "chart", """({ Chart }) => {
        const made = (xRange) => {
          const chart = new Chart({ title: 'One', isWhole: false, minimum: 0, xRange });
          document.body.append(chart.element);
          chart.element.style.cssText = 'position:fixed;top:0;left:0;width:600px;height:300px';
          chart.set([{ name: 'one', x: [0], y: [1], color: '#ff0000' }]);
          const { width, height } = chart.canvas;
          const { data } = chart.canvas.getContext('2d').getImageData(0, 0, width, height);
          let n = 0;
          for (let i = 0; i < data.length; i += 4) n += data[i] > 200 && data[i + 1] < 60;
          chart.destroy();
          chart.element.remove();
          return [chart.scale, n / devicePixelRatio ** 2];
        };
        const [{ x0, x1 }, n] = made([-60, 0]);
        return [[x0, x1], n, made()[1]];
    }""")
    assert scale == [-60, 0]
    assert n == pytest.approx(whole, abs=3) and whole > 18  # of 28, minus the antialiased rim


def test_champions_begin_with_the_best(service, browser):
    champions = service.get(f"/v1/campaigns/{service.campaign}/champions")["items"]
    best = min(row["score"] for row in champions)
    browser.open("campaigns/" + service.campaign)
    browser.until("document.querySelectorAll('.pick').length > 1")
    crowns = browser.run(
        "return [...document.querySelectorAll('.crown')].map((e) => !e.hidden)")
    assert crowns == [True] + [False] * (len(champions) - 1)
    assert browser.texts(".pick .number")[0] == f"{best:.4f}"


def test_a_phylogeny_offers_new_generations(service, browser, busy):
    browser.open(f"campaigns/{busy}/phylogeny")
    count = "parseInt(document.querySelector('.title .muted').innerText.replaceAll(',', ''))"
    browser.until(count + " > 0 && /of them/.test(document.querySelector('.title').innerText)")
    before = browser.run(f"return {count}")
    browser.until("document.querySelector('.title button').checkVisibility()")
    assert "new generation" in browser.texts(".title button")[0]
    browser.run("document.querySelector('.title button').click()")
    browser.until(f"{count} > {before}")


def test_replicates_are_one_row(service, browser):
    request = CAMPAIGN | {"replicates": 3, "label": "thrice", "generations": 1}
    first = run(service, "campaigns", request)["id"]
    browser.open("campaigns")
    rows = "[...document.querySelectorAll('.runs tbody tr')].map((row) => row.innerText.trim())"
    thrice = f"{rows}.filter((text) => /thrice|^\\s*replicate \\d of 3/.test(text))"
    browser.until(f"{thrice}.length === 1")
    assert "3 replicates" in browser.run(f"return {thrice}")[0]
    browser.run("document.querySelector('[aria-label=\"Show the replicates of thrice\"]').click()")
    browser.until(f"{thrice}.length === 4")
    items = service.get(f"/v1/campaigns?group={first}")["items"]
    go(browser, "overview")
    browser.until("document.querySelectorAll('.jobs tbody tr').length > 2")
    assert [text.split(", ")[1] for text in browser.texts(".jobs tbody tr .main .muted")[:3]] == [
        f"replicate {n} of 3" for n in (3, 2, 1)]
    others = [row["id"] for row in items if row["id"] != first]
    go(browser, f"campaigns/{first}?compare={','.join(others)}")
    browser.until("document.querySelectorAll('[aria-label=Comparison] tbody tr').length === 3")
    text = browser.texts("[aria-label=Comparison] tbody")[0]
    assert "replicate 2 of 3" in text and text.count("1 run: no interval") == 2
    links = browser.texts(".title a")
    assert "replicate 2" in links and "replicate 3" in links


def test_a_group_has_a_page(service, browser):
    """All replicates of a request, and their mean and range, follow a group's row and replicates.
    """
    request = CAMPAIGN | {"replicates": 3, "label": "a group", "generations": 2}
    first = run(service, "campaigns", request)["id"]
    ids = [str(int(first) + n) for n in range(3)]
    for id in ids:
        await_end(service, f"/v1/campaigns/{id}")
    browser.open("campaigns")
    browser.until("[...document.querySelectorAll('tbody a')].some((a) => a.text === 'a group')")
    browser.run("[...document.querySelectorAll('tbody a')].find((a) => a.text === 'a group')"
                ".click()")
    browser.until("document.querySelectorAll('[aria-label=Replicates] tbody tr').length === 3")
    assert browser.run("return location.hash") == f"#/campaigns/{first}/replicates"
    rows = browser.texts("[aria-label=Replicates] tbody tr")
    bests = [service.get(f"/v1/campaigns/{id}")["newest"]["score"]["quantiles"]["p0"]
             for id in ids]
    for n, (row, id, best) in enumerate(zip(rows, ids, bests)):
        assert f"replicate {n + 1} of 3" in row and f"campaign {id}" in row, row
        assert f"{best:.4f}" in row and ("\u265b" in row) == (best == min(bests)), row
    mean = service.pages(f"/v1/campaigns/{first}/replicates")[-1]["best_score"]["mean"]
    reported = "document.querySelector('figure canvas').getAttribute('aria-label')"
    browser.until(f"{reported}.includes('to {mean:.3g} at generation 2')")
    go(browser, f"campaigns/{ids[1]}")
    browser.until("[...document.querySelectorAll('.title a')].some((a) => "
                  f"a.hash === '#/campaigns/{ids[1]}/replicates')")
    go(browser, f"campaigns/{ids[1]}/replicates")
    browser.until("document.querySelectorAll('[aria-label=Replicates] tbody tr').length === 3")
    assert browser.faults() == []


# ---- questionable results ----


def test_warnings_appear_next_to_the_state(start):
    """Warnings about robots that all diverged, about the time step that explains it, and about a
    campaign that found no new bodies."""
    other = start()
    stiff = {"n_steps": 20, "stiffness_n_per_m": 1e6}
    diverged = run(other, "campaigns", CAMPAIGN | {"physics": stiff, "generations": 1})["id"]
    ended = run(other, "campaigns", CAMPAIGN | {"workspace": [2, 1, 1], "label": "tiny"})["id"]
    training = other.post("/v1/trainings", TRAINING | {"physics": stiff})["id"]
    await_end(other, f"/v1/trainings/{training}")
    other.evaluate({"designs": [DESIGN], "physics": stiff})
    page = Browser(other)
    why = "every robot diverged, the time step is too large"
    try:
        for path, state, detail in (
            (f"campaigns/{diverged}", f"succeeded, but {why}", "generation 1"),
            (f"campaigns/{ended}", "succeeded, but no unseen bodies are left", "it ended at"),
            (f"trainings/{training}", f"failed, but {why}", "nothing was learned")):
            page.open(path)
            page.until(f"document.querySelector('.title .state')?.textContent === {state!r}")
            assert detail in page.run("return document.querySelector('p.error').textContent")
            assert page.faults() == []
        page.open(f"campaigns/{diverged}")
        page.until("document.querySelector('figure canvas')?.getAttribute('aria-label') === "
                   "'Score: No value: all 12 robots diverged.'")
        page.open(f"trainings/{training}")
        page.until("document.querySelector('canvas')?.getAttribute('aria-label') === "
                   "'Mean loss of the batch: No value: all 4 robots diverged.'")
        page.open("overview")
        page.until("document.body.innerText.includes('but every robot diverged')")
        assert "but no unseen bodies are left" in page.run("return document.body.innerText")
    finally:
        page.quit()


# Collects the contexts of the stages that a page makes from now on.
CONTEXTS = """
window.contexts = new Set();
const { getContext } = HTMLCanvasElement.prototype;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  const context = getContext.call(this, kind, ...more);
  if (kind === 'webgl2' && context) contexts.add(context);
  return context;
};
"""
FREED = "contexts.size && [...contexts].every((gl) => gl.isContextLost())"


def test_pages_free_their_stage(browser):
    """A page has a WebGL context for its stage; browsers allow about sixteen in all."""
    browser.open("overview")
    browser.run(CONTEXTS)
    for _ in range(2):
        go(browser, "controllers")
        browser.until("document.querySelector('.stage')?.player.stage")
        assert not browser.run("return " + FREED)
        go(browser, "overview")
        browser.until(FREED)
    assert browser.faults() == []


def test_a_comparison_ends_with_its_page(browser):
    """It would go on to wait for its evaluations otherwise."""
    browser.open("controllers")
    browser.run("""
        window.aborted = 0;
        const send = window.fetch;
        window.fetch = (path, options) => (!/held-out/.test(path) ? send(path, options)
          : new Promise((resolve, reject) => options.signal?.addEventListener('abort', () => {
            aborted++;
            reject(options.signal.reason);
          })));
    """)
    browser.run("""
        const [first, second] = document.querySelectorAll('select');
        for (const [e, value] of [[first, 'default'], [second, 'tuned']]) {
          e.value = value;
          e.dispatchEvent(new Event('change'));
        }
    """)
    browser.click("Compare")
    go(browser, "overview")
    browser.until("aborted === 1")
    assert browser.faults() == []


@pytest.mark.parametrize("view", [
    "lab?design=" + "f" * 36, "lab?voxels=01", "campaigns/{campaign}/population",
])
def test_a_page_that_cannot_be_shown_frees_its_stage(service, browser, view):
    browser.open("overview")
    browser.run(CONTEXTS + """
        const send = window.fetch;
        window.fetch = (path, options) => (/population/.test(path)
          ? Promise.resolve(new Response('{"detail": "It is on fire."}', { status: 500 }))
          : send(path, options));
    """)
    go(browser, view.format(campaign=service.campaign))
    browser.until("document.querySelector('main .error')")
    browser.until(FREED)
