"""A headless Chromium with a running morphod, and requirements of every page."""

import base64
import contextlib
import pathlib
import sys
import time

import numpy
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service as Driver

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "api"))

FLAGS = ("--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--ignore-gpu-blocklist", "--hide-scrollbars", "--disable-dev-shm-usage")
# Modules of static sites, which the service does not have.
SITE = {"site/site.js", "lib/atlas_file.js"}
# Faults that a page must not have: console messages, and violations of its policy.
WATCH = """
window.faults = [];
addEventListener('securitypolicyviolation',
  (event) => faults.push('policy: ' + event.violatedDirective));
addEventListener('error', (event) => faults.push('error: ' + event.message));
addEventListener('unhandledrejection', (event) => faults.push('rejection: ' + event.reason));
"""

# Once the page shows the expected content: the longest chain of requests, starting with the page's,
# in which each began after the previous one had ended; for a page with robots, the longest that
# ends with the first rollouts, because others may be sent while the first picture is drawn.
CHAIN = """
if (!(%s)) return null;
const ends = [];
for (const kind of ['navigation', 'resource']) ends.push(...performance.getEntriesByType(kind));
ends.sort((a, b) => a.startTime - b.startTime);
const depths = [];
ends.forEach((one, i) => {
  depths.push(1 + Math.max(0, ...depths.filter((_, j) => ends[j].responseEnd <= one.startTime)));
});
const rollouts = ends.findIndex(({ name }) => name.endsWith('v1/rollouts'));
return rollouts < 0 ? Math.max(...depths) : depths[rollouts];
"""

PIXELS = """
const canvas = document.querySelector(arguments[0]);
const { width, height } = canvas;
const plain = Object.assign(document.createElement('canvas'), { width, height }).getContext('2d');
plain.drawImage(canvas, 0, 0);
const bytes = plain.getImageData(0, 0, width, height).data;
let text = '';
for (let i = 0; i < bytes.length; i += 32768) {
  text += String.fromCharCode(...bytes.subarray(i, i + 32768));
}
return [width, height, btoa(text)];
"""


class Browser:
    # Pixels of the screen per pixel of a page: a quarter of the drawing in software.
    ratio = 0.5

    def __init__(self, service, width=1280, height=900):
        options = Options()
        options.binary_location = "/usr/bin/chromium"
        for flag in (*FLAGS, f"--window-size={width},{height}",
                     f"--force-device-scale-factor={self.ratio}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        self.driver = webdriver.Chrome(options=options, service=Driver("/usr/bin/chromedriver"))
        self.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": WATCH})
        self.base = f"http://{service.host}:{service.port}/"
        self.run = self.driver.execute_script

    @contextlib.contextmanager
    def adding(self, script):
        """Runs a script in each page that is opened meanwhile, before the page's own."""
        added = self.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument",
                                            {"source": script})
        try:
            yield
        finally:
            self.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)

    def open(self, view="", theme=None):
        """Shows a view in a new page with an empty Lab and an empty tray."""
        self.driver.get("about:blank")
        self.driver.get_log("browser")  # of pages before this one
        script = ("for (const name of ['lab', 'task', 'tray', 'tray-open'])"
                  " sessionStorage.removeItem(`morphod-${name}`);")
        if theme:
            script += f"localStorage.setItem('morphod-theme', '{theme}');"
        with self.adding(script):
            self.driver.get(self.base + "#/" + view)
        self.until("document.querySelector('main h1')")

    def until(self, condition, seconds=60):
        """Waits until a script returns true."""
        deadline = time.monotonic() + seconds
        while not self.run(f"return Boolean({condition})"):
            assert time.monotonic() < deadline, f"never true: {condition}; {self.faults()}"
            time.sleep(0.05)

    def until_walking(self, seconds=300):
        """Waits for all robots on the stage."""
        self.until("document.querySelector('.stage')?.player?.stage.robots.length &&"
                   "!document.querySelector('.stage').player.isComing", seconds)

    def chain(self, view, shown, latency_ms=300):
        """Returns the length of the longest chain of requests until a script reports that a view is
        shown, over a slow connection and with an empty cache, where concurrent requests overlap."""
        def slow(latency):
            self.driver.execute_cdp_cmd("Network.emulateNetworkConditions",
                                        {"offline": False, "latency": latency,
                                         "downloadThroughput": -1, "uploadThroughput": -1})

        self.driver.get("about:blank")
        self.driver.execute_cdp_cmd("Network.enable", {})
        self.driver.execute_cdp_cmd("Network.clearBrowserCache", {})
        slow(latency_ms)
        try:
            self.driver.get(self.base + "#/" + view)
            deadline = time.monotonic() + 300
            while (length := self.run(CHAIN % shown)) is None:
                assert time.monotonic() < deadline, self.faults()
                time.sleep(0.02)
            return length
        finally:
            slow(0)

    def faults(self):
        """Returns all faults: errors, violations of the page's policy, requests to other hosts."""
        entries = self.run(
            "return performance.getEntriesByType('resource').map((entry) => entry.name)")
        found = self.run("return window.faults ?? []")
        found += [f"request: {name}" for name in entries if not name.startswith(self.base)]
        found += [f"console: {entry['message']}" for entry in self.driver.get_log("browser")
                  if entry["level"] == "SEVERE"]
        return found

    def texts(self, selector):
        return self.run(
            "return [...document.querySelectorAll(arguments[0])].map((e) => e.innerText)", selector)

    def click(self, text, selector="button"):
        """Clicks the first button that shows a text."""
        done = self.run(
            "const e = [...document.querySelectorAll(arguments[0])]"
            ".find((e) => e.innerText.trim() === arguments[1] && e.offsetParent !== null);"
            "e?.click(); return Boolean(e)", selector, text)
        assert done, f"there is no {selector} {text!r}: {self.texts(selector)}"

    def pixels(self, selector="canvas"):
        """Returns the picture of a canvas: (height, width, 4) bytes."""
        width, height, data = self.run(PIXELS, selector)
        return numpy.frombuffer(base64.b64decode(data), "u1").reshape(height, width, 4)

    def quit(self):
        self.driver.quit()
