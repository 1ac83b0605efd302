"""The cost of ten open pages for the daemon: requests of real pages are recorded, then sent by ten
clients while a campaign commits about one generation per second."""

import http.client
import json
import os
import pathlib
import re
import threading
import time

from dashboard_data import ONE_ENVIRONMENT

CLIENTS = 10
RECORD = """
window.recorded = [];
const send = window.fetch;
window.fetch = (path, options = {}) => {
  window.recorded.push({ at: performance.now() / 1000, path, method: options.method ?? 'GET',
    headers: options.headers ?? {}, body: options.body });
  return send(path, options);
};
"""


def paced_campaign(service, generations):
    """Starts a campaign that commits about one generation per second on this machine."""
    body = {"mode": "zero-shot", "population": 32, "generations": 4, "exclude_pretraining": False,
            "environments": ONE_ENVIRONMENT, "label": "pace"}
    trial = service.post("/v1/campaigns", body)["id"]
    while service.get(f"/v1/campaigns/{trial}")["state"] != "succeeded":
        time.sleep(0.1)
    rows = service.get(f"/v1/campaigns/{trial}/generations")["items"][1:]
    seconds = sum(row["seconds"] for row in rows) / len(rows)
    population = max(8, min(4096, int(32 / seconds) // 4 * 4))
    body |= {"population": population, "generations": generations, "label": "watched"}
    return service.post("/v1/campaigns", body)["id"]


def newest_generation(service, campaign):
    return service.get(f"/v1/campaigns/{campaign}")["progress"]["generation"] or 0


def cpu_s(pid, rollouts=False):
    """Returns seconds of processor time of the threads that do not compute rollouts, or of all."""
    total = 0
    for task in pathlib.Path(f"/proc/{pid}/task").iterdir():
        try:
            name, rest = (task / "stat").read_text().rsplit(")", 1)
        except FileNotFoundError:
            continue
        if rollouts or "(mo-worker" not in name:
            fields = rest.split()
            total += int(fields[11]) + int(fields[12])
    return total / os.sysconf("SC_CLK_TCK")


def record(page, view, seconds):
    """Returns the requests of a page from its start, with their times."""
    added = page.send("Page.addScriptToEvaluateOnNewDocument", {"source": RECORD})
    page.open(view)
    time.sleep(seconds)
    requests = page.run("return recorded")
    page.send("Page.removeScriptToEvaluateOnNewDocument", added)
    page.driver.get("about:blank")
    assert len(requests) > seconds / 2, requests
    return requests


class Stream:
    """A client that sends recorded requests at their times, with the cursors that a page would have
    by then, and with the tags of the replies that it has."""
    def __init__(self, service, requests, span_s, until):
        self.service, self.requests, self.span_s, self.until = service, requests, span_s, until
        self.tags, self.cursors, self.sent, self.read = {}, {}, 0, 0
        self.listens = next((one for one in requests
                             if "event-stream" in str(one["headers"])), None)
        self.threads = [threading.Thread(target=self.replay)]
        if self.listens:
            self.threads.append(threading.Thread(target=self.listen))
        for thread in self.threads:
            thread.start()

    def listen(self):
        newest = self.service.get("/v1/events?format=json&after=0&limit=1")["newest"]
        connection = http.client.HTTPConnection(self.service.host, self.service.port, timeout=20)
        connection.request("GET", f"/v1/events?after={newest}", headers=self.listens["headers"])
        response = connection.getresponse()
        while time.monotonic() < self.until and (line := response.readline()):
            self.read += line.startswith(b"data:")
        connection.close()

    def replay(self):
        connection = self.service.connection()
        rounds, start = 0, time.monotonic()
        while True:
            for request in self.requests:
                due = start + rounds * self.span_s + request["at"]
                if due >= self.until:
                    connection.close()
                    return
                time.sleep(max(0, due - time.monotonic()))
                # A page is loaded once; after that it only follows.
                if request is not self.listens and (rounds == 0 or request["at"] > 2):
                    self.send(connection, request)
            rounds += 1

    def send(self, connection, request):
        path = "/" + request["path"]
        name = path.split("?")[0]
        if name.endswith("/generations") and name in self.cursors:
            path = re.sub(r"cursor=\d+", f"cursor={self.cursors[name]}", path)
        headers = {**request["headers"], "Accept-Encoding": "gzip"}
        if name.endswith("/generations"):
            del headers["Accept-Encoding"]  # this client reads its rows
        if path in self.tags:
            headers["If-None-Match"] = self.tags[path]
        connection.request(request["method"], path, body=request["body"], headers=headers)
        response = connection.getresponse()
        body = response.read()
        assert response.status in (200, 304), (path, response.status, body[:200])
        self.sent += 1
        if response.headers["ETag"]:
            self.tags[path] = response.headers["ETag"]
        if name.endswith("/generations") and body and (rows := json.loads(body)["items"]):
            self.cursors[name] = rows[-1]["generation"]

    def join(self):
        for thread in self.threads:
            thread.join()


def daemon_share(service, page, seconds):
    """Returns (share of a core that ten open pages cost, generations per second during that,
    requests per second). The time of the daemon's serving threads without pages is subtracted."""
    span_s = max(10, seconds / 2)
    campaign = paced_campaign(service, int(8 * seconds) + 60)
    while newest_generation(service, campaign) < 2:
        time.sleep(0.1)
    views = ("", f"campaigns/{campaign}")
    recordings = [record(page, view, span_s) for view in views]
    pid = service.process.pid

    before = cpu_s(pid)
    time.sleep(span_s)
    alone = (cpu_s(pid) - before) / span_s

    first, before, start = newest_generation(service, campaign), cpu_s(pid), time.monotonic()
    streams = [Stream(service, recordings[i % len(views)], span_s, start + seconds)
               for i in range(CLIENTS)]
    time.sleep(max(0, start + seconds - time.monotonic()))
    spent, took = cpu_s(pid) - before, time.monotonic() - start
    pace = (newest_generation(service, campaign) - first) / took
    for stream in streams:
        stream.join()
    service.act(campaign, "cancel")
    assert all(stream.read for stream in streams if stream.listens), "no event arrived"
    assert sum(stream.sent for stream in streams) > CLIENTS * seconds / 4
    rate = sum(stream.sent for stream in streams) / took
    return max(0, spent / took - alone), pace, rate
