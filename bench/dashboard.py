#!/usr/bin/python3
"""Checks the dashboard against its budgets: prints a line for each, with the measurement and its
bound.

Starts its own daemon on a free port with its state in a temporary folder, fills it with real
designs, a phylogeny of a million designs and a thousand jobs, and drives Debian's Chromium, which
renders without a GPU. Pages are loaded with an empty cache. Exit status 1 if a bound is missed."""
import argparse
import json
import pathlib
import statistics
import sys
import tempfile
import time

SOURCE = pathlib.Path(__file__).resolve().parents[1]
sys.path[:0] = [str(SOURCE / "tests" / "browser"), str(SOURCE / "tests" / "api")]

from browser import SITE, Browser  # noqa: E402
from dashboard_data import N_JOBS, Filled  # noqa: E402
from dashboard_drive import SCREEN, drive_robots  # noqa: E402
from dashboard_streams import daemon_share  # noqa: E402
from service import await_end  # noqa: E402

RUNS = 7
# Times from the start of the navigation to the first drawing of a page: robots on a stage, the
# curve of a chart. A chart without values strokes nothing. The first motion is the picture after
# the first one with robots, which begins when that is on the screen.
FIRST_DRAWS = """
window.firstStroke = window.firstTiles = window.firstMotion = undefined;
const { stroke } = CanvasRenderingContext2D.prototype;
CanvasRenderingContext2D.prototype.stroke = function (...all) {
  window.firstStroke ??= performance.now();
  return stroke.apply(this, all);
};
const { fenceSync } = WebGL2RenderingContext.prototype;
WebGL2RenderingContext.prototype.fenceSync = function (...all) {
  if (firstPicture()) window.firstMotion ??= performance.now();
  return fenceSync.apply(this, all);
};
new MutationObserver(() => {
  if (document.querySelector('.tile')) window.firstTiles ??= performance.now();
}).observe(document, { childList: true, subtree: true });
window.firstPicture = () =>
  performance.getEntriesByName('morphod-first-picture')[0]?.startTime;
window.modules = () =>
  document.querySelector('script[type=module]').src.replace(/app\\.js$/, '');
"""


class Page(Browser):
    def __init__(self, service):
        super().__init__(service)
        self.send("Page.addScriptToEvaluateOnNewDocument", {"source": FIRST_DRAWS})
        self.driver.set_script_timeout(120)

    def send(self, command, parameters=None):
        return self.driver.execute_cdp_cmd(command, parameters or {})

    def load(self, view, value):
        """Loads a page with an empty cache. Returns the value of a script once it is defined."""
        self.driver.get("about:blank")
        self.send("Network.clearBrowserCache")
        time.sleep(1.5)  # without a GPU, pending drawing of the previous page occupies the cores
        self.driver.get(self.base + "#/" + view)
        self.until(f"({value}) !== undefined")
        return self.run(f"return {value}")

    def script(self, text, *arguments):
        """Returns what an asynchronous script passes to `done`."""
        result = self.driver.execute_async_script(
            "const done = arguments[arguments.length - 1];"
            f"(async () => {{ {text} }})().then(done, (no) => done({{ error: String(no) }}));",
            *arguments)
        if isinstance(result, dict) and "error" in result:
            raise RuntimeError(result["error"])
        return result


class AtLeast(float):
    """A bound from below; others are from above."""


# ---- measurements: each yields (what, measured, unit, bound or None) ----

def assets(data, _):
    """The bytes that a visit to every page would transfer, and those of pages that have budgets of
    their own."""
    folder = SOURCE / "clients" / "dashboard"
    names = [file.relative_to(folder).as_posix() for kind in ("js", "css", "svg")
             for file in folder.rglob("*." + kind)]
    names = [name for name in names if name not in SITE]
    page = data.service.request("GET", "/", headers={"Accept-Encoding": "gzip"})
    text = data.service.request("GET", "/").body.decode()
    root = "/" + text.split('type="module" src="')[1].split("app.js")[0]
    sizes = {"index.html": len(page.body)}
    for name in names:
        reply = data.service.request("GET", root + name, headers={"Accept-Encoding": "gzip"})
        assert reply.status == 200, name
        sizes[name] = len(reply.body)
    for what, parts, bound in (("an atlas", ("atlas", ), 24),
                               ("a certificate", ("certificate", "lib/sheet.js"), 10)):
        own = [name for name in sizes if any(part in name for part in parts)]
        yield f"the page of {what}, gzipped", sum(map(sizes.pop, own)) / 1e3, "kB", bound
    yield "all other files, gzipped", sum(sizes.values()) / 1e3, "kB", 170


def overview(_, page):
    times = [page.load("overview", "firstStroke && firstTiles && Math.max(firstStroke, firstTiles)")
             for _ in range(RUNS)]
    yield "overview, first draw", statistics.median(times), "ms", 300


def home(_, page):
    """The best robot of the store, on its ground."""
    times = [page.load("", "firstMotion") for _ in range(RUNS)]
    yield "home, first motion", statistics.median(times), "ms", 600


def campaign(data, page):
    """The champions of a campaign."""
    times = [page.load(f"campaigns/{data.run}", "firstPicture()") for _ in range(RUNS)]
    yield "page of a run, its first robots", statistics.median(times), "ms", 500


def stage(_, page):
    times = [page.load("stage", "firstPicture()") for _ in range(RUNS)]
    assert page.run("return document.querySelector('.stage').player.stage.robots.length") == 4
    yield "stage with four champions, first draw", statistics.median(times), "ms", 500


CLICK = """
const { player } = document.querySelector('.stage');
const { stage } = player;
const text = document.querySelector('main p[aria-live]');
const before = stage.robots;
const draw = stage.draw.bind(stage);
return await new Promise((resolve) => {
  const started = performance.now();
  let moved;
  const finish = () => {
    if (moved === undefined || !/^score/.test(text.textContent)) return;
    observer.disconnect();
    delete stage.draw;
    resolve([moved, performance.now() - started]);
  };
  const observer = new MutationObserver(finish);
  observer.observe(text, { childList: true, characterData: true, subtree: true });
  stage.draw = () => {
    draw();
    if (stage.robots === before) return;
    moved ??= performance.now() - started;
    finish();
  };
  document.querySelector(`[data-cell="${arguments[0]}"]`).click();
});
"""


def lab(_, page):
    """Clicks that add and remove voxels of a body of 38 to 40 voxels. No body occurs twice."""
    body = [(x, y, 0) for x in range(6) for y in range(6)] + [(0, 0, 1), (1, 0, 1)]
    voxels = "".join("1" if (i // 24, i // 4 % 6, i % 4) in body else "0" for i in range(144))
    page.load("lab?voxels=" + voxels, "firstPicture()")
    page.until("/^score/.test(document.querySelector('main p[aria-live]').textContent)")
    cells = [(x, y, 1) for y in range(1, 3) for x in range(6)]
    clicks = [cells[0]]
    for previous, cell in zip(cells, cells[1:]):
        clicks += [cell, previous]
    times = [page.script(CLICK, ",".join(map(str, cell))) for cell in clicks]
    moved, scored = (statistics.median(column) for column in zip(*times))
    yield "Lab, click to motion", moved, "ms", 150
    yield "Lab, score over ten environments", scored, "ms", 400


STEP = """
return await new Promise((resolve) => {
  const seen = {};
  new PerformanceObserver((list, observer) => {
    for (const { name, duration } of list.getEntries()) seen[name.split('-').at(-1)] = duration;
    if (!seen.numbers || !seen.motion) return;
    observer.disconnect();
    resolve([seen.numbers, seen.motion]);
  }).observe({ type: 'measure' });
  document.querySelectorAll('.sizes .card, [aria-label="One voxel from here"] .card')
    [arguments[0]].click();
});
"""


def atlas(data, page):
    """Clicks on small robots, each of which becomes the body."""
    request = {"name": "five", "voxels": 5, "orientations": "canonical"}
    await_end(data.service, f"/v1/jobs/{data.service.post('/v1/atlases', request)['id']}", 600)
    page.load("atlas/five", "firstPicture()")
    page.until("document.querySelectorAll('.strip .card').length > 12")
    times = [page.script(STEP, card) for card in (4, 6, 2, 5, 1, 7, 0, 6, 3, 8)]
    numbers, moved = (statistics.median(column) for column in zip(*times))
    yield "atlas, click to numbers", numbers, "ms", 50
    yield "atlas, click to motion", moved, "ms", 150


MILLION = """
const { PhylogenyCanvas, loadColumns } = await import(modules() + 'views/phylogeny.js');
const canvas = document.createElement('canvas');
canvas.style.cssText = 'width:1200px;height:560px;display:block;position:fixed;top:0;left:0';
document.body.append(canvas);
const view = new PhylogenyCanvas(canvas, 1e6);
view.measure = true;
performance.clearResourceTimings();
const started = performance.now();
const columns = await loadColumns(arguments[0], 'all');
const deliveredMs = performance.now() - started;
const bytes = performance.getEntriesByType('resource').at(-1).decodedBodySize;
view.set(columns);
view.draw();
const first = view.times.drawMs;
view.zoom(0.9, 600, 280);
view.draw();
const { layoutMs, drawMs, readyMs } = view.times;
const painted = view.gl.getError() === 0;
canvas.remove();
view.destroy();
return { n: columns.born.length, deliveredMs, bytes, layoutMs, readyMs, first, drawMs, painted };
"""


def phylogeny(data, page):
    page.driver.get("about:blank")
    campaign = data.with_phylogeny()
    page.base = f"http://{data.service.host}:{data.service.port}/"
    page.load("overview", "firstTiles")
    seen = [page.script(MILLION, campaign) for _ in range(3)]
    assert all(one["n"] >= 1e6 and one["painted"] for one in seen), seen

    def median(name):
        return statistics.median(one[name] for one in seen)

    yield "a million designs, delivered", median("deliveredMs") / 1e3, "s", 1
    yield "a million designs, size", median("bytes") / 1e6, "MB", 20
    yield "a million designs, laid out", median("layoutMs") / 1e3, "s", 0.5
    yield "a million designs, drawn", median("first") / 1e3, "s", 3
    yield "a million designs, redrawn", median("drawMs") / 1e3, "s", 3
    # A link to a design on the real page: the page finds it, and the robot walks.
    page.load(f"campaigns/{campaign}/phylogeny?design=900001", "firstPicture()")
    assert page.texts("h2")[0].startswith("#900001 ")


CHART = """
const { Chart } = await import(modules() + 'lib/chart.js');
const chart = new Chart({ title: 'Points', xName: 'step' });
chart.element.style.cssText = 'position:fixed;top:0;left:0;width:1200px;height:400px';
document.body.append(chart.element);
const n = 100000;
const x = Float64Array.from({ length: n }, (_, i) => i);
const y = x.map((v) => Math.sin(v / 9000) + Math.random() / 4);
const band = { name: 'band', kind: 'band', x, y, low: y.map((v) => v - 0.3),
  high: y.map((v) => v + 0.3), color: '--blue', opacity: 0.2 };
const times = [];
for (let i = 0; i < 9; i++) {
  const started = performance.now();
  chart.set([band, { name: 'line', x, y, color: '--blue' }]);
  chart.canvas.getContext('2d').getImageData(0, 0, 1, 1);
  times.push(performance.now() - started);
  await new Promise((resolve) => requestAnimationFrame(resolve));
}
chart.destroy();
chart.element.remove();
return times;
"""


def chart(_, page):
    page.load("overview", "firstTiles")
    yield "100,000 points with a band, drawn", statistics.median(page.script(CHART)), "ms", 50


SCROLL = """
const seen = { frames: 0, blank: 0, rows: 0 };
const rows = [...document.querySelectorAll('tbody tr')].filter((row) => row.rowKey);
seen.rows = rows.length;
const end = document.documentElement.scrollHeight - innerHeight;
const frame = () => new Promise((resolve) => requestAnimationFrame(resolve));
for (const step of [400, -400]) {
  do {
    await frame();
    scrollBy(0, step);
    seen.frames++;
    for (const row of rows) {
      const { top, bottom } = row.getBoundingClientRect();
      if (bottom > 0 && top < innerHeight && !row.childElementCount) seen.blank++;
    }
  } while (step > 0 ? scrollY < end - 1 : scrollY > 0);
}
return seen;
"""


def jobs(data, page):
    """No script runs between the check of the rows and the painting of the frame."""
    data.with_jobs()
    page.load("runs", "document.querySelector('.runs tbody tr') ?? undefined")
    page.click("Show more")
    page.until(f"document.querySelectorAll('tbody tr').length >= {N_JOBS}")
    seen = page.script(SCROLL)
    assert seen["rows"] >= N_JOBS and seen["frames"] > 100, seen
    yield f"{N_JOBS} jobs, blank rows while scrolling", seen["blank"], "", 0


FRAMES = """
const { stage } = document.querySelector('.stage').player;
document.querySelector('.stage').player.setPlaying(false);
const times = [];
for (let i = 0; i < 20; i++) {
  stage.timeS = i / 10;
  const started = performance.now();
  stage.draw();
  times.push(performance.now() - started);
  stage.gl.readPixels(0, 0, 1, 1, stage.gl.RGBA, stage.gl.UNSIGNED_BYTE, new Uint8Array(4));
}
return times;
"""


# Plays for a while. Returns (pictures per second, ms of script per picture): a picture begins once
# the previous one has been drawn.
PLAY = """
const { player, player: { stage } } = document.querySelector('.stage');
player.setPlaying(true);
const wait = (seconds) => new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
await wait(2);  // the resolution has been adapted
let pictures = 0;
let scriptMs = 0;
const draw = stage.draw.bind(stage);
stage.draw = (how) => {
  pictures++;
  draw(how);
};
const ask = window.requestAnimationFrame;
window.requestAnimationFrame = (act) => ask((now) => {
  const before = pictures;
  const started = performance.now();
  act(now);
  if (pictures > before) scriptMs += performance.now() - started;
});
const started = performance.now();
await wait(arguments[0]);
window.requestAnimationFrame = ask;
delete stage.draw;
return [1000 * pictures / (performance.now() - started), scriptMs / pictures];
"""


def frames(data, page):
    """Pictures of robots that walk, as large as a screen."""
    page.send("Emulation.setDeviceMetricsOverride", SCREEN)

    def play(n):
        ids = [item["id"] for item in data.service.get(f"/v1/designs?limit={n}")["items"]]
        page.load("stage?designs=" + ",".join(ids), "firstPicture()")
        page.until_walking()
        page.run("document.querySelector('.stage canvas').style.cssText ="
                 "'position:fixed;top:0;left:0;width:1280px;height:720px'")
        return page.script(PLAY, 8)

    rate, _ = play(1)
    _, script_ms = play(48)
    page.send("Emulation.clearDeviceMetricsOverride")
    yield "a robot in 1280 × 720, pictures per second", rate, "", AtLeast(5)
    yield "48 robots in 1280 × 720, script of a picture", script_ms, "ms", 8


def drive(data, page):
    """A robot that walks for a minute while its light is dragged, then eight for 20 s."""
    pictures, turns, share = drive_robots(data.service, page, data.driven[:1], 20)
    yield "driving: drag until the robot has turned", statistics.median(turns), "ms", 250
    pairs = list(zip(pictures, pictures[1:]))
    moves = [b["atMs"] for a, b in pairs if b["timeS"] > a["timeS"]]
    yield ("driving: longest time without motion", max(b - a for a, b in zip(moves, moves[1:])),
           "ms", 200)
    stalls = sum(b["heldS"] > a["heldS"] for a, b in pairs)
    yield "driving: waits for the service in a minute", stalls, "", 0
    yield "driving: daemon per robot, share of a core", 100 * share, "%", 5
    pictures, _, share = drive_robots(data.service, page, data.driven[:8], 7)
    first, last = pictures[0], pictures[-1]
    pace = 1000 * (last["timeS"] - first["timeS"]) / (last["drawnMs"] - first["drawnMs"])
    yield "driving eight: simulated seconds per second", pace, "", AtLeast(0.98)
    yield "driving eight: daemon per robot, share of a core", 100 * share, "%", 5


def many_robots(data, page):
    ids = [item["id"] for item in data.service.get("/v1/designs?limit=256")["items"]]
    assert len(ids) == 256
    loaded = page.load("stage?designs=" + ",".join(ids), "firstPicture()")
    page.until("document.querySelector('.stage').player.stage.robots.length === 256")  # in groups
    yield "256 robots on the stage, first draw", loaded / 1e3, "s", None
    yield "256 robots, script of a frame", statistics.median(page.script(FRAMES)), "ms", None


def streams(data, page):
    share, pace, rate = daemon_share(data.service, page, ARGUMENTS.seconds)
    print(f"# {pace:.2f} generations and {rate:.0f} requests per second", flush=True)
    yield "ten open pages, share of a core", 100 * share, "%", 2


MEASURES = {function.__name__: function for function in
            (assets, overview, home, stage, campaign, lab, atlas, chart, frames, drive, many_robots,
             streams, jobs, phylogeny)}


def main():
    global ARGUMENTS
    parser = argparse.ArgumentParser(prog="tools/bench dashboard", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=MEASURES, metavar="NAME",
                        help="one of " + ", ".join(MEASURES) + "; can be repeated")
    parser.add_argument("--seconds", type=int, default=60, help="of the streams (default 60)")
    parser.add_argument("--json", type=pathlib.Path, help="also write the measurements here")
    ARGUMENTS = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory(prefix="morphod-bench-") as folder:
        shipped = SOURCE / "data" / "controllers" / "phototaxis-16ms.safetensors"
        data = Filled(pathlib.Path(folder), "--workers=0", f"--default-controller={shipped}")
        page = None
        try:
            page = Page(data.service)
            page.load("overview", "firstTiles")
            for name in MEASURES:
                if ARGUMENTS.only and name not in ARGUMENTS.only:
                    continue
                for what, measured, unit, bound in MEASURES[name](data, page):
                    is_low = isinstance(bound, AtLeast)
                    ok = bound is None or (measured >= bound if is_low else measured <= bound)
                    results.append({"name": name, "what": what, "measured": measured,
                                    "unit": unit, "bound": bound, "ok": ok})
                    verdict = "" if bound is None else (
                        f"{'>=' if is_low else '<='} {bound:5} {'ok' if ok else 'MISSED'}")
                    print(f"{what:48} {measured:8.4g} {unit:3} {verdict}".rstrip(), flush=True)
                faults = page.faults()
                assert not faults, faults
        finally:
            if page:
                page.quit()
            data.close()
    if ARGUMENTS.json:
        ARGUMENTS.json.write_text(json.dumps(results, indent=1) + "\n")
    return 0 if all(result["ok"] for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
