"""morphoctl with long jobs: training runs and campaigns."""

import fcntl
import hashlib
import json
import os
import pty
import re
import select
import signal
import statistics
import struct
import subprocess
import termios
import time

import pytest
from ctl import CELLS, MORPHOCTL, SHORT, ctl  # noqa: F401
from service import PATIENCE_S


TINY = ("--steps 6 --batch 4 --physics n_steps=30 --validate-every 3 --validation-designs 3 "
        "--validation-environments 2")


def test_training_from_start_to_export(service, ctl, tmp_path):
    status, out, err = ctl("train start pretrain --name ctl-walker --label 'by hand' "
                           f"--checkpoint-steps 2 {TINY} --watch")
    assert status == 0, (out, err)
    assert re.match(r"training \d+ \(pretrain ctl-walker\) is (queued|running), step \d of 6",
                    out), out
    assert re.search(r"^controller ctl-walker: sha256:[0-9a-f]{64}$", out, re.M), out
    job = re.match(r"training (\d+)", out)[1]
    assert ctl(f"train watch {job}")[0] == 0
    events = [json.loads(line) for line in ctl(f"train watch {job} --json")[1].splitlines()]
    assert events[-1]["type"] == "job.finished" and "training.checkpoint" in {
        event["type"]
        for event in events
    }
    shown = ctl(f"train show {job}")[1]
    assert re.search(r"^progress +step 6 of 6$", shown, re.M) and re.search(
        r"^label +by hand$", shown, re.M) and "step 6" in shown.splitlines()[-1]
    assert re.search(r"^code +cpu \S+ float32 gradient-\d+$", shown, re.M), shown
    assert json.loads(ctl(f"train show {job} --json")[1]) == service.request(
        "GET", f"/v1/trainings/{job}").json()
    assert any(line.split()[:4] == [job, "pretrain", "ctl-walker", "succeeded"]
               for line in ctl("train list")[1].splitlines())
    assert any(line.split()[:3] == [job, "pretrain", "succeeded"]
               for line in ctl("job list")[1].splitlines())
    files = [str(tmp_path / name) for name in ("end", "middle", "curve.csv", "validations.csv")]
    status, _, err = ctl(f"train export {job} --output {files[0]} --curve {files[2]} "
                         f"--validations {files[3]}")
    assert status == 0, err
    assert ctl(f"train export {job} --step 4 --output {files[1]}")[0] == 0
    assert ctl(f"train export {job} --step 5")[0] == 3
    end, middle = [open(path, "rb").read() for path in files[:2]]
    assert hashlib.sha256(end).hexdigest() in out and middle != end
    lines = (tmp_path / "curve.csv").read_text().splitlines()
    assert lines[0].startswith("step,mean_loss,rate") and [
        line.split(",")[0] for line in lines[1:]
    ] == list("123456")
    assert [
        line.split(",")[0] for line in (tmp_path / "validations.csv").read_text().splitlines()[1:]
    ] == ["0", "3", "6"]
    assert ctl(f"train prune {job} --step 4") == (
        0, f"training {job}: 1 checkpoint deleted, 12.4 MB\n", "")
    assert ctl(f"train prune {job} --step 4")[0] == 3 and ctl("train prune x")[0] == 2
    status, out, _ = ctl(f"train prune {job} --json")
    assert status == 0 and json.loads(out)["items"] == [{"step": 6}, {"step": 2}], out
    assert ctl(f"train prune {job}")[1] == f"training {job}: 0 checkpoints deleted, 0.0 MB\n"
    status, out, err = ctl("train compare default ctl-walker --designs 6 --environments 2 "
                           "--physics n_steps=50")
    assert status == 0 and "for other designs and environments (Student t" in out, (out, err)


def test_presets_of_trainings(ctl):
    for more, schedule in ("", 61), ("--schedule restarts --cycle-growth 3", 10):
        status, out, err = ctl(f"train start pretrain --preset phototaxis --beta2 0.99 {more} "
                               f"{TINY} --json")
        assert status == 0, err
        settings = json.loads(out)["settings"]
        assert settings["steps"] == 6 and settings["adam"] == {
            "beta1": 0.8, "beta2": 0.99, "epsilon": 1e-8
        } and settings["adjoint_rule"] == "restart"
        assert settings["schedule"]["cycle_steps"] == schedule and settings["schedule"][
            "cycle_growth"] == (3 if more else 22)
        assert ctl(f"train cancel {json.loads(out)['id']}")[0] == 0
    status, _, err = ctl(f"train start pretrain --preset demo {TINY}")
    assert status == 6 and \
        '/preset: must be "workstation", "phototaxis", "paper" or "robust"' in err, err
    status, _, err = ctl(f"train start finetune --random 1 --preset phototaxis {TINY}")
    assert status == 6 and "/preset: " in err, err
    status, out, _ = ctl("train start --help")
    assert status == 0 and "--preset workstation|phototaxis|paper|robust" in out, out


def test_what_varies(ctl):
    """Only that is listed."""
    for more, expected in (
        ("", None),
        ("--vary friction=0.5:1 --vary slope_degrees=0:10", "friction 0.5 to 1, "
         "slope_degrees 0 to 10"),
        ("--vary mass=1:1.5 --vary drop_m=0.1:0.2", "mass 1 to 1.5, drop_m 0.1 to 0.2"),
        ("--preset robust", "friction 0.4 to 1")):
        status, out, err = ctl(f"train start pretrain {more} {TINY} --json")
        assert status == 0, err
        job = json.loads(out)["id"]
        shown = " ".join(ctl(f"train show {job}")[1].split())
        assert f"varies in each step, {expected} schedule" in shown if expected \
            else "varies" not in shown, shown
        assert ctl(f"train cancel {job}")[0] == 0
    status, _, err = ctl(f"train start pretrain --vary slope_degrees=5 {TINY}")
    assert status == 2 and "is not NAME=LOW:HIGH" in err, err


def test_finetuning(ctl):
    status, out, err = ctl(f"train start finetune --random 3 --name ctl-tuned {TINY} --json")
    assert status == 0, err
    value = json.loads(out)
    assert value["settings"]["n_designs"] == 3 and value["parent"]["name"] == "default"
    assert ctl(f"train watch {value['id']}")[0] == 0
    evaluation = json.loads(ctl(f"eval {SHORT} --random 5 --json")[1])
    status, out, err = ctl(f"train start finetune --population {evaluation['id']} --best 2 {TINY}")
    assert status == 0 and json.loads(
        ctl(f"train show {out.strip()} --json")[1])["settings"]["n_designs"] == 2, err
    status, _, err = ctl("train start finetune --random 3 --controller nobody --batch 0")
    assert status == 6 and "/controller: " in err and "/batch: " in err, err


def test_finetuning_each_design(ctl):
    tiny = TINY.replace("--validate-every 3 --validation-designs 3 ", "")
    status, out, err = ctl(f"train start finetune --random 3 --each --keep-best 2 {tiny}")
    assert status == 0, (out, err)
    job = out.split()[0]
    assert ctl(f"train watch {job}")[0] == 0
    shown = ctl(f"train show {job}")[1]
    assert "controllers kept: the best 2; 3 of 3 done" in shown, shown
    status, out, err = ctl(f"train each {job}")
    assert status == 0 and "3 of 3, 3 with both scores" in out, (out, err)
    assert out.count(f"training-{job}-") == 2, out
    value = json.loads(ctl(f"train each {job} --json")[1])
    assert len(value["items"]) == 3 and value["summary"]["compared"] == 3
    lines = ctl(f"train each {job} --csv")[1].splitlines()
    assert len(lines) == 4 and lines[0].startswith("position,id,robot,"), lines
    assert ctl("train start pretrain --each --keep all")[0] == 6


def test_training_pause_resume_cancel(ctl):
    job = ctl("train start pretrain --steps 100000 --batch 2 --physics n_steps=20 "
              "--validate-every 0")[1].strip()
    assert ctl(f"train pause {job}") == (0, f"job {job} is paused\n", "")
    assert re.search(r"^state +paused$", ctl(f"train show {job}")[1], re.M)
    assert any(line.split()[0] == job for line in ctl("train list --state paused")[1].splitlines())
    assert ctl(f"train resume {job}")[0] == 0
    assert ctl(f"train cancel {job}")[0] == 0
    assert ctl(f"train watch {job}")[0] == 3
    assert ctl(f"train resume {job}")[0] == 3 and ctl("train show 999999")[0] == 3


def watch_on_a_terminal(service, command, job, until_seen, farewell):
    """Runs a command on a terminal of 24 lines and 80 columns, and presses Ctrl-C once all of
    `until_seen` has appeared. Returns the text without escapes."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    watch = subprocess.Popen([MORPHOCTL, "--server", service.addresses[0], command, "watch", job],
                             stdin=slave,
                             stdout=slave,
                             stderr=slave,
                             env={**os.environ, "TERM": "xterm", "LC_ALL": "C.UTF-8"})
    os.close(slave)
    seen, until = b"", time.monotonic() + PATIENCE_S
    while not all(text in re.sub(r"\x1b\[[0-9;]*[A-Za-z]", "", seen.decode(errors="replace"))
                  for text in until_seen):
        assert time.monotonic() < until and watch.poll() is None, seen
        if select.select([master], [], [], 0.1)[0]:
            seen += os.read(master, 65536)
    watch.send_signal(signal.SIGINT)
    while watch.poll() is None:
        assert time.monotonic() < until
        if select.select([master], [], [], 0.1)[0]:
            try:
                seen += os.read(master, 65536)
            except OSError:
                break
    os.close(master)
    assert watch.wait(PATIENCE_S) == 130
    view = re.sub(r"\x1b\[[0-9;]*[A-Za-z]", "", seen.decode(errors="replace").split(farewell)[0])
    assert all(len(line) <= 80 for line in re.split(r"[\r\n]+", view)), view
    return view


def test_watching_a_training_on_a_terminal(service, ctl):
    """The live view fits 80 columns with all its numbers. Ctrl-C does not affect the training."""
    job = ctl("train start pretrain --steps 100000 --batch 2 --physics n_steps=20 "
              "--checkpoint-steps 50 --validation-designs 2")[1].strip()
    view = watch_on_a_terminal(service, "train", job, ("checkpoint of step", " left"),
                               "The training continues.")
    assert re.search(
        r"step [\d,]+ of 100,000  [\d.e+]+ bodies/s  (\d+ d )?\d+:\d\d(:\d\d)? left  checkpoint of "
        r"step \d+", view), view
    assert service.request("GET", f"/v1/trainings/{job}").json()["state"] == "running"
    assert ctl(f"train cancel {job}")[0] == 0


SMALL = "--preset demo --population 6 --physics n_steps=20"


def test_campaign_from_start_to_export(service, ctl, tmp_path):
    status, out, err = ctl(
        f"campaign start zero-shot {SMALL} -n 3 --label 'by hand' --selection "
        "tournament --tournament-size 2 --workspace 5,5,3 --watch -",
        input_text=CELLS)
    assert status == 0, err
    assert re.findall(r"generation (\d) of 3  mean \d\.\d{4}  best ", out) == ["0", "1", "2",
                                                                               "3"], out
    campaign = re.match(r"campaign (\d+) accepted: zero-shot, 6 designs, 3 generations", err)[1]
    reported = service.request("GET", f"/v1/campaigns/{campaign}").json()
    assert reported["label"] == "by hand" and reported["settings"]["workspace"] == [5, 5, 3]
    assert reported["settings"]["selection"] == {"kind": "tournament", "size": 2
                                             } and reported["settings"]["initial"] != "random"
    assert json.loads(ctl(f"campaign show {campaign} --json")[1]) == reported
    shown = ctl(f"campaign show {campaign}")[1]
    assert re.search(r"^progress +generation 3 of 3, 24 designs born$", shown, re.M), shown
    assert re.search(r"^mean score +\d\.\d{4}  \S{4}$", shown, re.M) and re.search(
        r"^ +3 +\d\.\d{4}", shown, re.M), shown
    assert any(line.split()[:4] == [campaign, "zero-shot", "succeeded", "6"]
               for line in ctl("campaign list")[1].splitlines())
    assert any(
        line.split()[:7] == [campaign, "zero-shot", "succeeded", "batch", "6", "3", "generations"]
        for line in ctl("job list")[1].splitlines())
    events = [json.loads(line) for line in ctl(f"campaign watch {campaign} --json")[1].splitlines()]
    assert [e["data"]["generation"] for e in events
            if e["type"] == "campaign.generation"] == [0, 1, 2, 3]
    champions = ctl(f"campaign champions {campaign} -n 3 -o {str(tmp_path / 'paths')}")
    assert champions[0] == 0 and len(champions[1].splitlines()) == 4, champions
    assert len(list((tmp_path / "paths").glob("design-*-com.npy"))) == 30
    files = {
        what: str(tmp_path / what)
        for what in ("curve", "population", "phylogeny", "newick", "learning", "replicates")
    }
    status, _, err = ctl(f"campaign export {campaign}",
                         *(part for what, path in files.items() for part in (f"--{what}", path)))
    assert status == 0, err
    rows = {what: open(path, encoding="utf-8").read().splitlines() for what, path in files.items()}
    assert len(rows["curve"]) == 5 and len(rows["population"]) == 6 and len(
        rows["phylogeny"]) == 25 and len(rows["learning"]) == 1
    assert rows["phylogeny"][0].startswith(
        "id,ancestor_list,origin_time,destruction_time") and rows["newick"][0].endswith(";")
    scores = ctl(f"eval {SHORT} --json {files['population']}")
    assert [r["score"] for r in json.loads(scores[1])["results"]] == sorted(
        r["score"] for r in json.loads(scores[1])["results"])
    assert ctl(f"campaign extend {campaign} 2") == (
        0, f"campaign {campaign} is queued, to generation 5\n", "")
    assert ctl(f"campaign watch {campaign}")[0] == 0
    lines = ctl(f"campaign watch {campaign}")[1].splitlines()
    assert len(lines) == 6 and all(
        re.match(rf" {{25}}generation {i} of 5  mean ", line)
        for i, line in enumerate(lines)), "long ago: without a time"
    assert ctl(f"campaign export {campaign} --curve -")[1].splitlines()[:5] == rows["curve"]
    status, out, err = ctl(f"train start finetune --population {campaign} --best 3 {TINY}")
    assert status == 0, err
    shown = ctl(f"train show {out.strip()}")[1]
    assert re.search(rf"^designs +3 of campaign {campaign}$", shown, re.M), shown


def test_campaigns_that_learn_and_replicates(service, ctl):
    learn = "--child-steps 1 --parent-steps 1 --batch 3"
    status, out, err = ctl(f"campaign start simultaneous {SMALL} -n 1 {learn} --schedule "
                           "constant --peak 0.001 --sensor inverse_square --replicates 2 --seed "
                           "7 --name ctl-evolved")
    assert status == 0, err
    ids = out.split()
    assert len(ids) == 2 and int(ids[1]) == int(ids[0]) + 1
    assert all(ctl(f"campaign watch {i}")[0] == 0 for i in ids)
    listed = json.loads(ctl(f"campaign list --group {ids[0]} --state succeeded --json")[1])["items"]
    assert [item["id"] for item in listed] == ids[::-1] and ctl("campaign list --group x")[0] == 2
    shown = ctl(f"campaign show {ids[1]}")[1]
    assert re.search(rf"^replicate +2 of 2 of campaign {ids[0]}$", shown, re.M) and re.search(
        r"^population +6 designs, seed 8$", shown, re.M), shown
    assert re.search(
        r"^controller +random weights, sensor inverse_square$", shown, re.M) and re.search(
            r"^learning +1 \+ 1 steps a generation, constant", shown, re.M), shown
    assert len(ctl(f"campaign export {ids[0]} --learning -")[1].splitlines()) == 1 + 1 + 2
    assert ctl(f"campaign export {ids[0]} --replicates -")[1].count("\n") == 3
    assert ctl(f"campaign prune {ids[1]} {ids[1]}")[1] == (
        f"campaign {ids[1]}: 1 checkpoint deleted, 12.4 MB\n"
        f"campaign {ids[1]}: 0 checkpoints deleted, 0.0 MB\n")
    assert json.loads(ctl(f"campaign prune {ids[1]} --json")[1]) == {"items": [], "bytes": 0
                                                                     } and ctl("campaign prune "
                                                                               "999999")[0] == 3
    assert "was deleted" in ctl(f"campaign extend {ids[1]} 1")[2]
    job = ctl(f"campaign start few-shot {SMALL} -n 1 {learn} --from {ids[0]} --quiet")[1].strip()
    assert ctl(f"campaign watch {job}")[0] == 0
    assert service.request("GET", f"/v1/campaigns/{job}").json()["settings"]["initial"] == {
        "campaign": ids[0]
    }


def test_campaigns_are_compared(service, ctl):
    """The numbers follow the definition. Campaigns that ended early are left out and listed."""
    a, b = (ctl(f"campaign start zero-shot {SMALL} -n 2 --replicates 3 --seed {seed} -q")[1].split()
            for seed in (1, 11))
    assert ctl("wait", *a, *b)[0] == 0
    assert ctl(f"campaign extend {b[2]} 1000")[0] == 0 and ctl(f"job cancel {b[2]}")[0] == 0
    reported = json.loads(ctl(f"campaign compare {a[1]} {b[0]} --json")[1])
    assert reported["generation"] == 2
    assert [side["campaign"] for side in reported["sides"]] == [a[1], b[0]]
    best = [[service.get(f"/v1/campaigns/{id}/generations")["items"][2]["score"]["quantiles"]["p0"]
             for id in group] for group in (a, b[:2])]
    means, other = [statistics.mean(values) for values in best], reported["sides"][1]
    assert [side["best"] for side in reported["sides"]] == pytest.approx(means, rel=1e-12)
    assert other["difference"] == pytest.approx(means[1] - means[0], rel=1e-12)
    assert other["low"] + other["high"] == pytest.approx(2 * other["difference"], rel=1e-9)
    assert other["replicates"] == b[1::-1] and other["left_out"] == [{"id": b[2],
                                                                      "state": "cancelled"}]
    for job in a:  # hidden in lists, but no less a replicate
        assert ctl(f"job archive {job}")[0] == 0
        assert json.loads(ctl(f"campaign compare {a[1]} {b[0]} --json")[1]) == reported
    status, out, _ = ctl(f"campaign compare {a[0]} {b[0]}")
    assert status == 0 and f"campaign {b[2]}, a replicate of {b[0]}: it was cancelled" in out
    assert "left out" in ctl(f"campaign export {b[0]} --replicates -")[2]
    out = ctl(f"campaign compare {a[0]} {a[1]}")[1]  # of one group: one campaign each
    assert "at least two replicates" in out
    assert ctl(f"campaign compare {a[0]} 999999")[0] == 3


def test_campaigns_that_do_not_compare(service, ctl):
    """Different physics or environments are refused; other differences are listed."""
    def start(more):
        job = ctl(f"campaign start zero-shot {SMALL} -n 1 {more} -q")[1].strip()
        assert ctl("wait", job)[0] == 0
        return job

    first, larger = start(""), start("--population 7 --mutation-rate 0.1 --seed 3")
    status, out, err = ctl(f"campaign compare {first} {larger}")
    assert status == 0, err
    for words in ("settings.population: 7, not 6", "settings.mutation.rate: 0.1"):
        assert f"campaign {larger} in {words}" in out, out
    assert out.count("differs") == 2, out
    reported = json.loads(ctl(f"campaign compare {first} {larger} --json")[1])["sides"]
    assert reported[1]["differences"][0]["setting"].startswith("settings.")
    assert "differences" not in reported[0]
    physics = service.get(f"/v1/campaigns/{first}")["settings"]["physics"]
    slippery = {"mode": "zero-shot", "preset": "demo", "physics": {**physics, "friction": 0.1},
                "population": 6, "generations": 1, "exclude_pretraining": False}
    elsewhere = {**slippery, "physics": physics,
                 "environments": [{"light_xy_m": [1, 1], "terrain_sigma_m": 0, "seed": 1}]}
    for settings, words in ((slippery, "differ in physics.friction (0.9, 0.1)"),
                            (elsewhere, "are in different environments")):
        job = service.request("POST", "/v1/campaigns", settings).json()["id"]
        assert ctl("wait", job)[0] == 0
        status, out, err = ctl(f"campaign compare {first} {job}")
        assert status == 3 and words in err and "are not comparable" in err, err


def test_wrong_campaigns(ctl):
    for arguments, words in ((["start", "sideways"], "zero-shot"), ([
            "start", "zero-shot", "--population", "1"
    ], "population"), (["start", "zero-shot", "--child-steps", "3"], "learning"), ([
            "start", "zero-shot", "--layers", "3"
    ], "selection"), (["start", "zero-shot", "--controller", "random"], "controller")):
        status, _, err = ctl("campaign", *arguments)
        assert status == 6 and words in err, (arguments, err)
    for arguments, words in ((["start", "zero-shot", "--workspace", "6,6"], "X,Y,Z"), ([
                                 "start", "zero-shot", "--from", "0"
                             ], "a job id"), (["extend", "1", "none"], "additional"), ([
                                 "export", "1"
                             ], "nothing to export"), ([
                                 "champions", "1", "-o", "x", "--generation", "0"
                             ], "newest")):
        status, _, err = ctl("campaign", *arguments)
        assert status == 2 and words in err, (arguments, err)
    assert ctl("campaign show 999999")[0] == 3 and ctl("campaign extend 999999 1")[0] == 3


def test_watching_a_campaign_on_a_terminal(service, ctl):
    """The live view fits 80 columns and 24 lines. Ctrl-C does not affect the campaign."""
    job = ctl(f"campaign start zero-shot {SMALL} -n 100000 -q")[1].strip()
    view = watch_on_a_terminal(service, "campaign", job,
                               ("voxels", "Ctrl-C leaves", " left", "running  generation "),
                               "The campaign continues.")
    assert re.search(r"zero-shot  running  generation [\d,]+ of 100,000   campaign",
                     view) and re.search(r"diversity +0\.\d{4}  ", view), view
    assert service.request("GET", f"/v1/campaigns/{job}").json()["state"] == "running"
    assert ctl(f"campaign pause {job}")[0] == 0 and re.search(r"^state +paused$",
                                                              ctl(f"campaign show {job}")[1], re.M)
    assert ctl(f"campaign resume {job}")[0] == 0 and ctl(f"campaign cancel {job}")[0] == 0 and ctl(
        "campaign "
        "watch "
        f"{job}")[0] == 3
