"""The gauges of running jobs in /metrics, and what uses them in data/grafana."""

import json
import pathlib
import re
import shutil
import subprocess

import pytest

from service import BINARY, SHORT, SOURCE, Service, until

GRAFANA = SOURCE / "data" / "grafana"
DASHBOARD = json.loads((GRAFANA / "morphod.json").read_text())
MODULE = pathlib.Path(BINARY).parents[2] / "tests" / "device" / "fake-device.so"
PROMTOOL = shutil.which("promtool", path=f"/usr/bin:{SOURCE / 'build'}")
with_promtool = pytest.mark.skipif(
    PROMTOOL is None, reason="no promtool: tools/test fetches it, with a network and "
    "without --no-install")

PLATES = [{"cells": [[x, y, 0] for x in range(width) for y in range(depth)]}
          for width in range(1, 7) for depth in range(1, 7)]
LABEL = 'two "words", a \\ and\na line \x07 è'
LONG = {
    "campaign": {"mode": "zero-shot", "population": 8, "generations": 100000,
                 "physics": {"n_steps": 100}, "exclude_pretraining": False, "label": LABEL},
    "training": {"kind": "finetune", "designs": PLATES[:2], "steps": 100000, "batch": 2,
                 "physics": SHORT, "validation": {"every_steps": 0}},
    "evaluation": {"designs": PLATES, "physics": {"n_steps": 20000}, "priority": "batch"},
}


def gauges(service):
    """Returns the gauges of running jobs: {id: {name: value}}, and {id: (kind, label)}."""
    text = service.request("GET", "/metrics").body.decode()
    values, labels = {}, {}
    for name, id, kind, label, value in re.findall(
            r'^morphod_job_(\w+)\{id="(\d+)",kind="(\w+)",label="((?:[^"\\]|\\[\\n"])*)"\} (\S+)$',
            text, re.M):
        values.setdefault(id, {})[name] = float(value)
        labels[id] = kind, re.sub(r"\\(.)", lambda m: "\n" if m[1] == "n" else m[1], label)
    return values, labels


def test_running_jobs(start):
    service = start()
    ids = {kind: service.post(f"/v1/{kind}s", value)["id"] for kind, value in LONG.items()}
    whole = {"progress_ratio", "parts_done", "parts", "rollouts_per_second", "left_seconds"}

    def reported():
        values, labels = gauges(service)
        done = [whole <= set(values.get(id, {})) for id in ids.values()]
        return all(done) and "best_score" in values[ids["campaign"]] and (values, labels)

    values, labels = until(reported)
    assert labels == {id: (kind, LABEL if kind == "campaign" else "") for kind, id in ids.items()}
    for id, seen in values.items():
        assert ("best_score" in seen) == (id == ids["campaign"])
        assert 0 <= seen["parts_done"] < seen["parts"] and seen["left_seconds"] > 0
        share = seen["parts_done"] / seen["parts"]
        part = 1 / seen["parts"] if id == ids["campaign"] else 0
        assert share - 1e-9 <= seen["progress_ratio"] <= share + part + 1e-9
    campaign = service.get(f"/v1/campaigns/{ids['campaign']}")
    rows = service.pages(f"/v1/campaigns/{ids['campaign']}/generations")
    best = [row["score"]["quantiles"]["p0"] for row in rows]
    assert values[ids["campaign"]]["best_score"] in best
    assert values[ids["campaign"]]["parts"] == 100001
    assert values[ids["campaign"]]["parts_done"] <= campaign["progress"]["under_way"]
    training = service.get(f"/v1/trainings/{ids['training']}")["progress"]
    assert values[ids["training"]]["parts"] == 100000
    assert values[ids["training"]]["parts_done"] <= training["step"] + 1
    assert values[ids["evaluation"]]["parts"] == 10 * len(PLATES)
    for id in ids.values():
        assert service.act(id, "pause").status == 200
    until(lambda: gauges(service) == ({}, {}))


def test_only_so_many(start):
    """Shown are the jobs with the largest weight, and the newest of equal weight."""
    service = start("--max-campaigns=40")
    first = int(service.post("/v1/campaigns", LONG["campaign"] | {"replicates": 40})["id"])
    ids = [str(id) for id in range(first, first + 40)]
    until(lambda: len(service.pages("/v1/jobs?state=running")) == 40)
    until(lambda: set(gauges(service)[0]) == set(ids[8:]))
    service.post(f"/v1/jobs/{ids[0]}/weight", {"weight": 1.5})
    service.post(f"/v1/jobs/{ids[20]}/weight", {"weight": 0.5})
    assert set(gauges(service)[0]) == {ids[0], *ids[8:20], *ids[21:]}


# ---- Grafana and Prometheus ----

def queries():
    """Returns the queries of the panels, with values for Grafana's variables."""
    asked = [target["expr"] for panel in DASHBOARD["panels"] for target in panel.get("targets", [])]
    asked += [note["expr"] for note in DASHBOARD["annotations"]["list"]]
    return [query.replace("$instance", ".+").replace("$__rate_interval", "5m") for query in asked]


def promtool(tmp_path, *arguments, **files):
    """Runs promtool in a folder with these files."""
    for name, text in files.items():
        (tmp_path / f"{name}.yml").write_text(text)
    done = subprocess.run([PROMTOOL, *arguments], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def page():
    """/metrics of a service with a device and a running campaign."""
    service = Service(f"--compute-module={MODULE}", "--devices=auto")
    # Its generations take longer than the half second after which a rate is shown.
    service.post("/v1/campaigns", LONG["campaign"] | {"device": "cpu", "population": 256})
    text = until(lambda: all(
        f"\nmorphod_job_{name}{{" in (body := service.request("GET", "/metrics").body.decode())
        for name in ("best_score", "left_seconds", "rollouts_per_second")) and body)
    service.close()
    return text


def test_every_metric_that_is_read_exists(page):
    reported = set(re.findall(r"^(morphod_\w+)[{ ]", page, re.M))
    read = {name: re.findall(r"\bmorphod_\w+", (GRAFANA / name).read_text())
            for name in ("morphod.json", "alerts.yml")}
    for name, metrics in read.items():
        assert len(set(metrics)) > 10 and not set(metrics) - reported, name
    kept = set(re.findall(r"\bmorphod_job_\w+", " ".join(read["morphod.json"])))
    assert kept >= {name for name in reported if name.startswith("morphod_job_")
                    and "_seconds_total" not in name}


def test_dashboard():
    """Every panel has a separate position, queries the selected source for the selected services,
    and describes what it shows."""
    panels, places = DASHBOARD["panels"], set()
    assert len({panel["id"] for panel in panels}) == len(panels)
    for panel in panels:
        at = panel["gridPos"]
        covered = {(at["x"] + x, at["y"] + y) for x in range(at["w"]) for y in range(at["h"])}
        assert at["x"] + at["w"] <= 24 and not covered & places, panel["title"]
        places |= covered
        if panel["type"] != "row":
            assert panel["datasource"]["uid"] == "${datasource}" and panel["description"]
            assert panel["targets"], panel["title"]
    for target in (target for panel in panels for target in panel.get("targets", [])):
        metrics = re.findall(r"\bmorphod_\w+(.{0,23})", target["expr"])
        assert metrics and set(metrics) <= {'{instance=~"$instance"}', '{instance=~"$instance",'}
    assert [variable["name"] for variable in DASHBOARD["templating"]["list"]] == [
        "datasource", "instance"]


@with_promtool
def test_promtool_takes_the_page_and_the_rules(page, tmp_path):
    done = subprocess.run([PROMTOOL, "check", "metrics"], input=page, capture_output=True,
                          text=True)
    assert done.returncode == 0 and not done.stdout + done.stderr
    wrong = subprocess.run([PROMTOOL, "check", "metrics"], input=page.replace("_ratio", "_total"),
                           capture_output=True, text=True)
    assert wrong.returncode != 0 and "progress_total" in wrong.stderr
    promtool(tmp_path, "check", "rules", GRAFANA / "alerts.yml")
    rules = [{"record": f"query:{i}", "expr": query} for i, query in enumerate(queries())]
    promtool(tmp_path, "check", "rules", "queries.yml",
             queries=json.dumps({"groups": [{"name": "panels", "rules": rules}]}))


# When an alert fires: the values of each minute for an hour, and the message.
SEEN = {
    "MorphodDown": {'up{job="morphod"}': "0x60"},
    "MorphodNotReady": {"morphod_ready": "0x60"},
    "MorphodDiskFull": {"morphod_store_no_space": "1x60"},
    "MorphodRestartsOften": {"morphod_store_commits_total": "9 1 9 1 9 1 9 1x60"},
    "MorphodJobFailed": {'morphod_jobs_finished_total{state="failed"}': "0x50 1x10"},
    "MorphodQueueStalled": {'morphod_jobs{state="queued"}': "3x60",
                            'morphod_jobs{state="running"}': "0x60"},
    "MorphodNothingComputes": {'morphod_jobs{state="running"}': "3x60",
                               "morphod_worker_busy_seconds_total": "7x60",
                               "morphod_fleet_rollouts_total": "7x60",
                               'morphod_job_device_seconds_total{kind="campaign"}': "7x60"},
    "MorphodDeviceLost": {'morphod_device_lost{device="0"}': "1x60"},
    "MorphodFleetEmpty": {'morphod_fleet_sessions{class="cpu"}': "0x60",
                          "morphod_fleet_only": "1x60",
                          'morphod_blocks_queued{priority="batch"}': "5x60"},
    "MorphodFleetDiffers": {"morphod_fleet_audits_failed_total": "0x50 1x10"},
    "MorphodFleetLosesWorkers": {"morphod_fleet_lost_total": "0x45 8x15"},
    "MorphodTrainingUnsound": {"morphod_training_robots_zeroed_total": "0+6x60",
                               "morphod_training_robots_total": "0+100x60"},
    "MorphodLogLinesDropped": {"morphod_log_lines_dropped_total": "0x50 9x10"},
    "MorphodRequestsFail": {
        'morphod_http_requests_total{route="/v1/jobs",code="503"}': "0+6x60",
        'morphod_http_requests_total{route="/v1/jobs",code="200"}': "0+90x60"},
    "MorphodConnectionsUsedUp": {"morphod_http_connections": "91x60",
                                 "morphod_http_connections_max": "100x60"},
}
# The same for a healthy service: no alert fires.
WELL = {
    'up{job="morphod"}': "1x60", "morphod_ready": "1x60", "morphod_store_no_space": "0x60",
    "morphod_store_commits_total": "0+9x30 1+9x30", 'morphod_jobs{state="queued"}': "3x60",
    'morphod_jobs{state="running"}': "2x60", "morphod_worker_busy_seconds_total": "0+60x60",
    'morphod_job_device_seconds_total{kind="campaign"}': "0x60",
    'morphod_jobs_finished_total{state="failed"}': "2x60",
    'morphod_device_lost{device="0"}': "0x60", "morphod_training_robots_zeroed_total": "0+4x60",
    "morphod_training_robots_total": "0+100x60", "morphod_log_lines_dropped_total": "7x60",
    'morphod_http_requests_total{route="/v1/jobs",code="503"}': "0+4x60",
    'morphod_http_requests_total{route="/v1/jobs",code="200"}': "0+96x60",
    "morphod_http_connections": "9x60", "morphod_http_connections_max": "100x60",
}


@with_promtool
def test_alerts(tmp_path):
    alerts = re.findall(r"alert: (\w+)", (GRAFANA / "alerts.yml").read_text())
    assert sorted(alerts) == sorted(SEEN)

    def case(series, firing):
        return {
            "interval": "1m",
            "input_series": [{"series": name, "values": values} for name, values in series.items()],
            "promql_expr_test": [{
                "expr": 'count by (alertname) (ALERTS{alertstate="firing"})', "eval_time": "58m",
                "exp_samples": [{"labels": f'{{alertname="{name}"}}', "value": 1}
                                for name in firing]
            }]
        }

    tests = [case(series, [name]) for name, series in SEEN.items()] + [case(WELL, [])]
    promtool(tmp_path, "test", "rules", "tests.yml", tests=json.dumps(
        {"rule_files": [str(GRAFANA / "alerts.yml")], "evaluation_interval": "1m", "tests": tests}))
