"""morphoctl certify and certificate: what is sent, and the report in all its forms."""

import json
import re
import subprocess

import pytest
from ctl import ctl  # noqa: F401
from service import DESIGN, await_end, until

SMALL = ("--axes step,chance,friction --chance 3 --levels 0.7,1.3 --physics n_steps=40 "
         "--label certified")
BODIES = [DESIGN, {"cells": [[2, 2, 0], [3, 2, 0]]}, {"cells": [[2, 2, 0], [2, 2, 1], [2, 3, 0]]},
          {"cells": [[2, 2, 0], [3, 2, 0], [4, 2, 0], [4, 2, 1]]}]
AXES = [("base", None), ("step", 2), ("step", 4), ("chance", None), ("friction", 0.7),
        ("friction", 1.3)]


@pytest.fixture(scope="module")
def certified(service, ctl, tmp_path_factory):  # noqa: F811
    """The file of the designs, and the id, the output and the report of a certificate."""
    path = tmp_path_factory.mktemp("designs") / "bodies.json"
    path.write_text(json.dumps(BODIES))
    status, out, err = ctl(f"certify {path} {SMALL} --wait")
    assert status == 0 and err == "", (out, err)
    job = re.match(r"certificate +(\d+)\n", out)[1]
    return path, job, out, service.get(f"/v1/certificates/{job}/report")


def number(value, digits):
    return "–" if value is None else f"{value:.{digits}f}"


def table_below(out, head):
    """Returns the rows of a table, each as its words."""
    rows = out[re.search(rf"^ *{head} ", out, re.M).start():].split("\n\n")[0].splitlines()[1:]
    return [row.split() for row in rows]


def test_the_report_as_text(certified):
    _, job, out, report = certified
    words = " ".join(out.split())
    assert report["verdict"] in words
    assert all(design["verdict"] in words for design in report["designs"])
    assert "environments paper-test physics 40 steps of 0.002 s" in words
    classes = [level["fingerprint"] for level in report["levels"]]
    assert classes[0] != classes[1] and f"class {classes[0]}, {classes[1]} seed 1" in words
    assert "designs 4; regret of choosing the best one" in words
    assert [(level["axis"], level["level"]) for level in report["levels"]] == AXES
    for row, level in zip(table_below(out, "axis"), report["levels"], strict=True):
        expected = [level["axis"], *([f"{level['level']:g}"] if level["level"] else []),
                    str(level["environments"]), level["precision"], number(level["tau"], 2)]
        if level["tau_interval"]:
            low, high = level["tau_interval"]
            expected += [number(low, 2), "to", number(high, 2)]
        expected += [number(level["regret"], 4), number(level["mean_score"], 4)]
        assert row == expected
    best = sorted(report["designs"], key=lambda design: design["rank"])
    for row, design in zip(table_below(out, "rank"), best, strict=True):
        low, high = design["interval"]
        assert row == [str(design["rank"]), design["design"], number(design["score"], 4),
                       number(low, 4), "to", number(high, 4)] + design["flags"]
    assert re.findall(r"^(\d+)  (\S+@\d)$", out, re.M) == [
        (str(design["rank"]), design["design"]) for design in best]


def test_other_forms(service, ctl, certified):
    path, job, out, report = certified
    assert ctl(f"certificate {job}") == (0, out, "")
    status, text, _ = ctl(f"certificate {job} --json")
    assert status == 0 and json.loads(text) == report
    csv = service.request("GET", f"/v1/certificates/{job}/report.csv").body.decode()
    assert ctl(f"certificate {job} --csv") == (0, csv, "")
    assert len(csv.splitlines()) == 1 + len(BODIES) * len(AXES)
    again = ctl(f"certify {path} {SMALL} --wait --csv")
    assert again == (0, csv, "")
    status, text, err = ctl(f"certify {path} {SMALL} --wait --json")
    assert status == 0 and json.loads(text)["designs"] == report["designs"], err


def test_without_waiting(service, ctl, certified):
    path = certified[0]
    status, out, err = ctl(f"certify {path} {SMALL}")
    assert status == 0 and re.fullmatch(r"\d+\n", out)
    job = out.strip()
    assert err == (f"certificate {job} accepted: 4 designs, 6 trials, 320 rollouts; morphoctl "
                   f"watch {job}\n")
    assert ctl(f"watch {job}")[0] == 0
    row = next(line for line in ctl("certificate list --label certified")[1].splitlines()
               if line.split()[0] == job)
    assert row.split()[:7] == [job, "succeeded", "4", "paper-test", "6", "6", "320"]
    row = next(line for line in ctl("job list")[1].splitlines() if line.split()[0] == job)
    assert row.split()[1:8] == ["certificate", "succeeded", "batch", "4", "320", "rollouts", "100"]
    shown = ctl(f"job show {job}")[1]
    assert re.search(rf"^progress +320 of 320 rollouts; see morphoctl certificate {job}$", shown,
                     re.M), shown
    assert re.search(r"^scope +4 designs in 6 trials$", shown, re.M), shown
    status, out, err = ctl(f"certify {path} {SMALL} --json --idempotency-key certificate-key")
    assert status == 0 and err == "" and json.loads(out)["kind"] == "certificate"
    again = ctl(f"certify {path} {SMALL} --json --idempotency-key certificate-key")[1]
    assert json.loads(again)["id"] == json.loads(out)["id"]


def test_what_is_sent(service, ctl, certified):
    status, out, err = ctl(
        f"certify {certified[0]} --json --axes held_out,worlds --held-out 3 --worlds 4 --chance 5 "
        "--levels 0.5,2 --ranges friction=0.5:1.5 --ranges mass=0.9:1.1 --top 2 --seed 7 "
        "--task walk --physics n_steps=20 --weight 2 --experiment certificates")
    assert status == 0, err
    job = json.loads(out)
    settings = job["certificate"]
    assert (settings["held_out"], settings["worlds"], settings["chance"], settings["top"],
            settings["seed"]) == (3, 4, 5, 2, 7)
    assert settings["axes"] == ["base", "held_out", "worlds"] and settings["levels"] == [0.5, 2]
    assert settings["ranges"]["friction"] == [0.5, 1.5]
    assert settings["ranges"]["mass"] == [0.9, 1.1]
    assert settings["environments"] == "morpho-12-walk" and settings["physics"]["n_steps"] == 20
    assert (job["weight"], job["experiment"]) == (2, "certificates")


def test_populations(service, ctl, certified):
    status, out, err = ctl("eval --random 5 --physics n_steps=20 --json")
    assert status == 0, err
    evaluation = json.loads(out)
    status, out, err = ctl(f"certify --evaluation {evaluation['id']} --best 2 --axes drop "
                           "--physics n_steps=20 --wait --json")
    assert status == 0, err
    ranked = sorted(evaluation["results"], key=lambda result: result["score"])
    assert [design["design"] for design in json.loads(out)["designs"]] == [
        result["robot"] for result in ranked[:2]]
    campaign = service.post("/v1/campaigns", {"mode": "zero-shot", "preset": "demo",
                                              "population": 8, "generations": 1,
                                              "physics": {"n_steps": 30}})["id"]
    await_end(service, f"/v1/campaigns/{campaign}")
    status, out, err = ctl(f"certify --campaign {campaign} --axes friction --wait")
    assert status == 0 and "physics        30 steps" in out, out
    assert err == f"taken from campaign {campaign}: controller, environments, physics\n"
    assert len(table_below(out, "rank")) == 8


def test_remarks(ctl, tmp_path):
    """Axes that do not apply, notes of axes, and designs that are skipped or given by an id."""
    worlds = tmp_path / "worlds.json"
    worlds.write_text('[{"task": "walk"}]')
    designs = tmp_path / "designs.json"
    designs.write_text(json.dumps([{"cells": [[0, 0, 0], [2, 0, 0]]}, {"id": "8" + "0" * 35}]))
    status, out, err = ctl(f"certify {designs} --on-fault skip --environments {worlds} --axes "
                           "held_out,drop --physics n_steps=20 --wait")
    assert status == 0 and "left out: held_out: " in out, (out, err)
    assert "design 0 is left out: /designs/0/cells/1: " in err
    assert f"using 8{'0' * 35}@0" in err
    assert "environments   1 from the request" in out
    status, out, err = ctl(f"certify {designs} --on-fault skip --axes held_out --held-out 2 "
                           "--physics n_steps=20 --wait --quiet")
    assert status == 0 and err == "" and re.search(r"^held_out: .*lights", out, re.M), (out, err)


def test_usage(ctl, certified):
    path, job = certified[:2]
    for command, why in (
        (f"certify {path} --campaign 1", "give designs or --campaign, not both"),
        ("certify --campaign 1 --evaluation 2", "give --campaign or --evaluation, not both"),
        (f"certify {path} --best 3", "--best needs --campaign or --evaluation"),
        ("certify --campaign 1 --best 257", "--best"),
        ("certify --campaign x", "not a job id"),
        (f"certify {path} --csv", "--csv needs the report: give --wait"),
        (f"certify {path} --csv --json --wait", "give --json or --csv, not both"),
        (f"certificate {job} --csv --json", "give --json or --csv, not both"),
        (f"certify {path} --levels 0.5,", '--levels: "0.5," is not a list of numbers'),
        (f"certify {path} --ranges friction=1", "is not FACTOR=LOW:HIGH"),
        ("certificate x", "not a job id"),
    ):
        status, out, err = ctl(command)
        assert status == 2 and out == "" and why in err, (command, status, out, err)
    for command, pointer in (("--axes luck", "/axes/0"), ("--levels 2,1", "/levels"),
                             ("--held-out 1", "/held_out")):
        status, _, err = ctl(f"certify {path} {command}")
        assert status == 6 and pointer in err, (command, status, err)
    assert ctl("certificate 999999")[0] == 3


def test_completion(ctl):
    """Commands that are also a group complete to both."""
    script = ctl("completion")[1]
    for line, expected in (("certif", "certify certificate"), ("certificate li", "list"),
                           ("certificate --cs", "--csv"), ("certify --ra", "--ranges"),
                           ("fleet dr", "drain"), ("job la", "label")):
        words = line.split()
        done = subprocess.run(
            ["bash", "-c", f"{script}\nCOMP_WORDS=(morphoctl \"$@\")\nCOMP_CWORD={len(words)}\n"
             "_morphoctl\necho ${COMPREPLY[*]}", "bash", *words],
            capture_output=True, text=True, check=True)
        assert done.stdout == f"{expected}\n", (line, done.stdout)


def test_one_that_is_not_complete(service, ctl, certified):
    """Its report covers the complete trials, and says so. Before the first, it has none."""
    status, out, err = ctl("certify --axes step,worlds --worlds 256 -", input_text=json.dumps(
        [DESIGN] * 2))
    assert status == 0, err
    job = out.strip()
    until(lambda: service.get(f"/v1/certificates/{job}")["certificate"]["trials_done"] >= 1)
    assert ctl(f"job cancel {job}")[0] == 0
    done = await_end(service, f"/v1/jobs/{job}").json()["certificate"]["trials_done"]
    status, out, _ = ctl(f"certificate {job}")
    assert status == 0 and f"certificate    {job}, incomplete: " in out
    assert len(table_below(out, "axis")) == done < 4
    other = service.post("/v1/certificates", {"designs": [DESIGN] * 200})["id"]
    assert ctl(f"job cancel {other}")[0] == 0
    await_end(service, f"/v1/jobs/{other}")
    status, out, err = ctl(f"certificate {other}")
    assert status == 3 and out == "" and "no complete trial" in err, (out, err)
