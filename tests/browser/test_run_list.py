"""The table of runs with a service that has many jobs, is slow, or refuses: a page's requests are
counted, and some get replies of the test instead of the service's."""

import time

import pytest

from conftest import CAMPAIGN
from service import run
from test_live import go
from test_runs import SHORT, names, sort

STATUS = "document.querySelector('.runs').closest('section').querySelector('[role=status]')"

# Counts the requests, by path, and passes them to `reply` first, which may return a reply.
COUNTED = """
window.asked = [];
const send = window.sent ??= window.fetch;
const reply = %s;
window.fetch = async (url, options) => {
  asked.push(String(url));
  return await reply(String(url)) ?? send(url, options);
};
"""
# Lists 7000 copies of a job in pages of a thousand; the facts of each take a while.
MANY = """
async (url) => {
  const json = (value) => new Response(JSON.stringify(value));
  if (/results|v1.evaluations/.test(url)) {
    await new Promise((resolve) => setTimeout(resolve, 20));
    return json({ items: [] });
  }
  if (!/v1.jobs/.test(url) || /state=running/.test(url)) return null;
  if (/search=none/.test(url)) return json({ items: [], next_cursor: null });
  const query = new URL(url, location).searchParams;
  const first = Number(query.get('cursor') ?? 0);
  const end = Math.min(7000, first + Number(query.get('limit')));
  const items = [];
  for (let n = first; n < end; n++) {
    items.push({ ...window.job, id: String(9e6 - n - 1e5 * window.place), label: `job ${n}` });
  }
  return json({ items, next_cursor: end < 7000 ? String(end) : null });
}
"""
FACTS = "asked.filter((url) => /results/.test(url)).length"


@pytest.fixture(scope="module")
def job(service):
    id = run(service, "evaluations", SHORT | {"label": "copied", "experiment": "copied"})["id"]
    return next(one for one in service.get("/v1/jobs?experiment=copied")["items"]
                if one["id"] == id)


def open_many(browser, job, place):
    """Opens the table, which then has 7000 jobs."""
    browser.open("runs?experiment=copied")
    names(browser, ["copied"])
    browser.run("[window.job, window.place] = arguments", job, place)
    browser.run(COUNTED % MANY)


def test_more_of_a_sorted_list_is_shown(browser, job):
    open_many(browser, job, 0)
    sort(browser, "Run")
    browser.until(f"/newest 5,?000 matching/.test({STATUS}.innerText)")
    browser.click("Show more")
    browser.until(f"/newest 6,?000 matching/.test({STATUS}.innerText)", 30)


def search(browser, text):
    browser.run("const e = document.querySelector('input[type=search]'); e.value = arguments[0];"
                "e.dispatchEvent(new Event('input'))", text)


@pytest.mark.parametrize("place, leave", [
    (1, lambda browser: go(browser, "machines")),
    (2, lambda browser: (search(browser, "none"), browser.until(
        "document.querySelector('.empty:not([hidden])')?.innerText === 'No jobs match.'")))])
def test_facts_are_not_read_for_a_list_that_is_gone(browser, job, place, leave):
    """Sorting by the score reads the scores of thousands of jobs, only while they are needed."""
    open_many(browser, job, place)
    sort(browser, "Best score")
    browser.until(f"{FACTS} > 20")
    leave(browser)
    n = browser.run(f"return {FACTS}")
    time.sleep(1)
    assert browser.run(f"return {FACTS}") <= n + 4  # those that are running
    assert browser.faults() == []


def test_a_sorted_page_can_be_left_while_it_loads(browser, job):
    open_many(browser, job, 3)
    go(browser, "machines")
    go(browser, "runs?experiment=copied&sort=best&order=ascending")
    browser.until(f"{FACTS} > 20")
    assert "Reading 5000 runs" in browser.texts("[aria-label=Runs]")[0]
    go(browser, "machines")
    n = browser.run(f"return {FACTS}")
    time.sleep(1)
    assert browser.run(f"return {FACTS}") <= n + 4


def test_a_refused_list_says_so(service, browser, job):
    """Rows that are older than the filters are not shown without a word."""
    browser.open("runs?experiment=copied")
    names(browser, ["copied"])
    browser.run(COUNTED % """(url) => (/search=refused/.test(url)
      ? new Response('{"detail": "Too many requests."}', { status: 503 }) : null)""")
    search(browser, "refused")
    browser.until(f"/out of date: Too many requests/.test({STATUS}.innerText)", 30)
    search(browser, "copied")
    browser.until(f"{STATUS}.innerText === '1 run'")
    assert browser.faults() == []


EVENT = """
const [type, done] = arguments;
const page = document.querySelector('script[type=module]').src;
import(page).then(({ app }) => app.events.listeners.forEach((one) => one({ type }))).then(done);
"""


def test_progress_does_not_reload_the_list(service, browser):
    """The timer shows the progress of running jobs; only news of a job reloads the list."""
    id = service.post("/v1/campaigns", CAMPAIGN | {
        "generations": 90000, "label": "endless", "experiment": "endless"})["id"]
    browser.open("runs?experiment=endless")
    names(browser, ["endless"])
    browser.until("/generation \\d/.test(document.querySelector('.runs').innerText)")
    time.sleep(2)  # the news of its start
    browser.run(COUNTED % "() => null")
    of_list = "asked.filter((url) => url.includes('experiment=endless')).length"
    before = browser.texts(".runs tbody")[0]
    browser.driver.execute_async_script(EVENT, "job.progress")
    browser.until("asked.some((url) => url.includes('state=running'))")
    browser.until(f"document.querySelector('.runs tbody').innerText !== {before!r}")
    assert browser.run(f"return {of_list}") == 0
    browser.driver.execute_async_script(EVENT, "job.paused")
    browser.until(f"{of_list} === 1", 30)
    service.act(id, "cancel")
    browser.until("/cancelled/.test(document.querySelector('.runs tbody').innerText)")


def commands(browser, view):
    browser.open(view)
    browser.click("Commands")
    browser.until("document.querySelector('dialog[open] pre')")
    return dict(zip(browser.texts("dialog[open] h3"), browser.texts("dialog[open] pre")))


def test_commands_list_the_jobs_of_the_page(service, browser):
    assert commands(browser, "runs?kind=campaign")["morphoctl"].startswith(
        "morphoctl campaign list")
    assert "morphoctl" not in commands(browser, "runs?kind=evaluation")
    found = commands(browser, "runs?kind=study&experiment=table")
    assert set(found) == {"curl", "Python"} and '["campaign_mode"] == "study"' in found["Python"]
    assert "the service lists all campaigns" in browser.texts("dialog[open]")[0]
    # The client's jobs() has no search.
    assert 'm.request("GET", "/v1/jobs", search="x")' in commands(
        browser, "runs?search=x")["Python"]
