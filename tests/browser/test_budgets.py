"""Budgets of the dashboard that do not depend on the speed of a machine. `tools/bench dashboard`
measures the others."""

import re

import pytest

from browser import SITE
from contract import SOURCE

FOLDER = SOURCE / "clients" / "dashboard"


def test_all_files_together_are_small(service):
    """The pages of atlases and of certificates, which are loaded when they are opened, have budgets
    of their own."""
    page = service.request("GET", "/", headers={"Accept-Encoding": "gzip"})
    text = service.request("GET", "/").body.decode()
    root = "/" + text.split('type="module" src="')[1].split("app.js")[0]
    sizes = {"index.html": len(page.body)}
    for file in [file for kind in ("js", "css", "svg") for file in FOLDER.rglob("*." + kind)]:
        name = file.relative_to(FOLDER).as_posix()
        if name in SITE:
            continue
        reply = service.request("GET", root + name, headers={"Accept-Encoding": "gzip"})
        assert (reply.status, reply.headers["Content-Encoding"]) == (200, "gzip"), name
        sizes[name] = len(reply.body)
    for names, budget in (("atlas", ), 24e3), (("certificate", "lib/sheet.js"), 10e3):
        own = {name for name in sizes if any(part in name for part in names)}
        assert sum(sizes.pop(name) for name in own) <= budget, own
    assert sum(sizes.values()) <= 170e3, sizes


def test_the_page_lists_the_modules_of_every_view(service):
    """By the name in the address: early.js finds them there."""
    text = service.request("GET", "/").body.decode()
    listed = dict(re.findall(r'data-view="(\w+)" content="([^"]+)"', text))
    app = (FOLDER / "app.js").read_text()
    views = dict(re.findall(r"^  (\w+): \{.* module: '\./(views/\w+)\.js'", app, re.MULTILINE))
    assert len(views) == app.count("module: './views/") and listed.keys() == views.keys()
    for name, module in views.items():
        assert module in listed[name].split()


PICTURE = "performance.getEntriesByName('morphod-first-picture').length"


@pytest.mark.parametrize("view, shown, length", [
    # The page, its frame, the modules of the view along with the number of the newest event, and
    # the data. The newest events may come between these.
    ("overview", "document.querySelector('.tile')", 5),
    # The page, its frame, the number of the newest event along with the modules of the view, the
    # data, and the robots.
    ("", PICTURE, 5),
    ("stage", PICTURE, 5),
    # The same, with the champions after the campaign.
    ("campaigns/{}", PICTURE, 6)
])
def test_a_page_waits_for_few_requests_in_a_row(service, browser, view, shown, length):
    assert browser.chain(view.format(service.campaign), shown) <= length


# Notes which replies early.js requested, and which of them no view used.
EARLY = """
window.early = [];
window.unused = null;
const { set, clear } = Map.prototype;
Map.prototype.set = function (key, value) {
  if (this === window.morphodEarly) window.early.push(key);
  return set.call(this, key, value);
};
Map.prototype.clear = function () {
  if (this === window.morphodEarly) window.unused ??= [...this.keys()];
  clear.call(this);
};
"""
BEST, SET = "v1/designs?sort=score&limit=4", "v1/environment-sets/paper-test"


@pytest.mark.parametrize("view, urls", [
    ("", [SET, BEST]), ("stage", [SET, BEST]), ("stage?designs={robot}", [SET]),
    ("campaigns/{campaign}", ["v1/campaigns/{campaign}", "v1/campaigns/{campaign}/environments"]),
    ("overview", []), ("stage?world=campaign-{campaign}", []), ("campaigns/{campaign}/settings", [])
])
def test_early_replies_are_used_once(service, browser, view, urls):
    """All of them, instead of the same requests of the views, which send no request twice."""
    robot = service.get("/v1/designs?limit=1")["items"][0]["id"]
    names = {"campaign": service.campaign, "robot": robot}
    with browser.adding(EARLY):
        browser.open(view.format(**names))
        browser.until("window.unused")
    first = ["v1/events?format=json&after=0&limit=1", "v1/whoami"]
    assert browser.run("return window.early") == first + [url.format(**names) for url in urls]
    assert browser.run("return window.unused") == []
    sent = browser.run("return performance.getEntriesByType('resource').map((one) => one.name)")
    for url in browser.run("return window.early"):
        assert sent.count(browser.base + url) == 1, url
    assert browser.faults() == []


# Draws 100,000 values between 0 and 0.1, one of 1, and a gap. Returns the cost, and how many rows
# have the color of the curve at the peak, in the gap and elsewhere.
DENSE = """
const done = arguments[arguments.length - 1];
const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
import(folder + 'lib/chart.js').then(({ Chart }) => {
  const chart = new Chart({ title: 'Many', xName: 'step' });
  document.body.append(chart.element);
  chart.element.style.cssText = 'position:fixed;top:0;left:0;width:900px;height:300px';
  const x = Float64Array.from({ length: 100000 }, (_, i) => i);
  const isMissing = (i) => i > 60000 && i < 70000;
  const y = x.map((i) => (i === 40000 ? 1 : isMissing(i) ? NaN : (i % 2) / 10));
  let n = 0;
  const { lineTo } = CanvasRenderingContext2D.prototype;
  CanvasRenderingContext2D.prototype.lineTo = function (...at) { n++; lineTo.apply(this, at); };
  chart.set([{ name: 'band', kind: 'band', x, y, low: y, high: y, color: '#00ff00' },
    { name: 'line', x, y, color: '#ff0000' }]);
  CanvasRenderingContext2D.prototype.lineTo = lineTo;
  const { canvas, scale } = chart;
  const rows = (at) => {
    const column = Math.round(scale.x(at) * devicePixelRatio);
    const { data } = canvas.getContext('2d').getImageData(column - 1, 0, 3, canvas.height);
    const isRed = (pixel) => data[4 * pixel] > 200 && data[4 * pixel + 1] < 100;
    return Array.from({ length: canvas.height }, (_, row) =>
      [0, 1, 2].some((i) => isRed(3 * row + i))).filter(Boolean).length / devicePixelRatio;
  };
  const seen = [40000, 65000, 50000].map(rows);
  chart.destroy();
  chart.element.remove();
  done([n / canvas.width, scale.y(0) - scale.y(1), ...seen]);
});
"""


def test_many_points_are_drawn_as_few(browser):
    """The drawing depends on the columns of pixels; a single peak and a gap are still visible."""
    browser.open("nowhere")
    points, height, peak, gap, flat = browser.driver.execute_async_script(DENSE)
    assert points < 5, "for each column of pixels"
    assert peak == pytest.approx(height, abs=4) and gap == 0, (height, peak, gap)
    assert flat == pytest.approx(0.1 * height, abs=4)
