"""morphoctl with a server that misbehaves on demand: retries, exit statuses, tables, streams.
Prints TAP.

Usage: against_fake_server.py MORPHOCTL. The real daemon's replies are tested in tests/api."""
import fcntl
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import threading
import time

from fake_server import (
    ID, JOB, MORPHOCTL, RESULT, VOXELS, Server, ask, broken, event, reply, run, stream)


def test_table_and_request():
    out, err, seen = ask([{**JOB, "results": [RESULT]}],
                         "eval --label x --physics n_steps=20 --record com",
                         input_text='{"name": "walker", "cells": [[0,0,0]]}')
    lines = out.splitlines()
    assert re.match(r"#\s+name\s+design\s+voxels\s+score\s+best\s+worst", lines[0]), out
    assert re.match(rf"0\s+walker\s+{ID}@0\s+1\s+0\.7500\s+0\.5000\s+1\.0000", lines[1]), out
    assert "\033" not in out + err, "colors without a terminal"
    method, path, headers, body = seen[0]
    assert (method, path) == ("POST", "/v1/evaluations")
    assert headers["Content-Type"] == "application/json" and headers["Prefer"].startswith("wait=")
    assert re.fullmatch("[0-9a-f]{32}", headers["Idempotency-Key"])
    assert json.loads(body) == {
        "designs": [{"cells": [[0, 0, 0]]}], "label": "x", "physics": {"n_steps": 20},
        "record": ["com"]
    }


def test_pace_of_an_evaluation():
    busy = {"rollouts_per_s": 211.6, "seconds_left": 192, "busy_s": 3}
    idle = dict.fromkeys(busy)
    for progress, words in ((busy, "1 of 2  212 rollouts/s  0:03:12 left"), (idle, "1 of 2")):
        job = {**JOB, "state": "running", "rollouts_done": 1, "progress": progress}
        assert re.search(rf"rollouts +{words}\n", ask([job], "job show 7")[0])


def test_text_from_elsewhere_is_not_interpreted():
    """Any submitter can choose a label, and a terminal must not interpret its control
    characters."""
    evil = "x\033]0;owned\007\033[2J\u009b31m\x7f\ry"
    hidden = "a\u202egpj\u2066b\u200fc\u061cd\U000e0041e\u200b é😀ü"
    for label, shown in ((evil, "x?]0;owned??[2J?31m??y"),
                         (hidden, r"a\u202egpj\u2066b\u200fc\u061cd\U000e0041e\u200b é😀ü")):
        page = {"items": [{**JOB, "label": label}], "next_cursor": None}
        assert shown in ask([page], "job list")[0]
        assert shown in ask([{**JOB, "label": label}], "job show 7")[0]
    problem = {"title": evil, "detail": "no" + evil,
               "errors": [{"detail": evil, "pointer": "/" + evil}]}
    failed = {**JOB, "label": evil, "state": "failed", "error": {"code": "io", "detail": evil}}
    metadata = {"name": "a", "sha256": "a" * 64, "metadata": {"k" + evil: evil}}
    events = stream(event(1, "job." + evil.replace("\r", ""), state="a" + evil))
    for reply_, command, status in ((failed, "job show 7", 0), (metadata, "controller info a", 0),
                                    (reply(422, problem), "job show 8", 6),
                                    (events, "watch --retry 0", 4)):
        out, err, _ = ask([reply_] + [reply(500, problem)] * 3, command, status=status)
        assert "31m" in out + err, (out, err)
        assert not re.search("[\0-\x09\x0b-\x1f\x7f-\x9f]", out + err), (out, err)


def test_no_proxy_between_loopback_addresses():
    proxies = {"http_proxy": "http://127.0.0.1:1", "all_proxy": "http://127.0.0.1:1"}
    assert ask([JOB], "job show 7 --retry 0", **proxies)[2][0][1] == "/v1/jobs/7"


def test_json_is_the_apis():
    evaluation = {**JOB, "results": [RESULT]}
    assert json.loads(ask([evaluation], "eval --json", input_text=VOXELS)[0]) == evaluation
    text = ('{"items":[0.9,1.5e-07,1e+22,-0.1,0.30000000000000004,2.5e-308,17,-3,9007199254740993,'
            '{"1.50":"1.50 \\" 0.90000000000000002"},true,null],"next_cursor":null}')
    for command in "job show 7 --json", "job list --json":
        assert ask([reply(200, text.encode())], command)[0] == text + "\n"
    hidden = {"label": "a\u202e\x7f\u009b\U000e0041é"}
    escaped = r'{"label":"a\u202e\u007f\u009b\udb40\udc41é"}' + "\n"
    assert ask([hidden], "job show 7 --json")[0] == escaped


def test_changes_many_jobs():
    """Each job has a separate request, no matter how many jobs there are."""
    for command, sent in (("job cancel", "/v1/jobs/{}/cancel"),
                          ("train prune --step 5", "/v1/trainings/{}/checkpoints/5")):
        replies = [{**JOB, "items": [], "bytes": 0}] * 9
        seen = ask(replies, f"{command} 1 2 3 4 5 6 7 8 9")[2]
        assert [s[1] for s in seen] == [sent.format(i) for i in range(1, 10)]


def test_mistakes():
    for words in ("", "evil", "--limit 3 job list", "--server", "--json=1 job list", "job",
                  "job lost", "eval --verify", "eval --label", "eval --no-wait=1", "eval -qj",
                  "design show", "status x", "job list -n 0", "job show ''", "job show 012",
                  "job show 1x", "job show 1234567890123456789", "eval --precision float16",
                  "eval -p dt=0.002", "eval -p dt_s", "eval -p =1", "eval -p dt_s=fast",
                  "eval -p dt_s=inf", "eval -p n_steps=1.5", "eval /nonexistent/designs.json",
                  "eval /dev/null"):
        out, err, seen = ask([], words, status=2, input_text=VOXELS)
        assert out == "" and err != "" and seen == [], (words, err)
    for text in ("zebra", '{"cells": [[0,0,0]]', '{"cell": [[0,0,0]]}', "{}", "0" * 59 + "1",
                 '{"cells": [[0,0,0]], "id": "x"}', '{"id": 1, "id": 2}', "[[[[0,0,0]]]] 3", "[3]",
                 '["01"]', '{"designs": {"cells": [[0,0,0]], "what": 1}}'):
        err = ask([], "eval", status=2, input_text=text)[1]
        assert "standard input:1: " in err, (text[:80], err)
    many = ask([{**JOB, "results": [RESULT]}], "eval", input_text="[[0,0,0]]" * 10001)[2]
    sent = json.loads(many[0][3])["designs"]
    assert len(sent) == 10001 and sent[7] == {"voxels": "8" + "0" * 35}  # packed if long


def test_waits_for_the_end():
    replies = [reply(202, {**JOB, "state": "queued"}),
               {**JOB, "state": "running", "rollouts_done": 1}, JOB, {**JOB, "results": [RESULT]}]
    out, _, seen = ask(replies, "eval", input_text=ID)
    assert "0.7500" in out
    assert [s[1] for s in seen] == ["/v1/evaluations", "/v1/jobs/7", "/v1/jobs/7",
                                    "/v1/evaluations/7"]


def test_failures():
    failed = {**JOB, "state": "failed", "error": {"code": "crashed", "detail": "three times"}}
    assert "three times" in ask([failed], "eval", status=3, input_text=ID)[1]
    diverged = {**RESULT, "score": None, "losses": [None, 1.0],
                "diverged": [{"environment": 0, "step": 17}]}
    out = ask([{**JOB, "results": [diverged]}], "eval", input_text=ID)[0]
    assert "diverged in 1 of 2 (environment 0, step 17)" in out, out


def test_repeats_with_the_same_key():
    replies = [broken, reply(503, {"title": "busy"}, Retry_After="0"),
               reply(429, {"title": "busy"}, Retry_After="1"), {**JOB, "results": [RESULT]}]
    seen = ask(replies, "eval", input_text=ID)[2]
    assert len(seen) == 4 and len({s[2]["Idempotency-Key"] for s in seen}) == 1
    assert len({s[3] for s in seen}) == 1


def test_gives_up():
    draining = reply(503, {"title": "Draining", "detail": "the service stops"}, Retry_After="30")
    err = ask([draining], "eval --retry 1", status=7, input_text=ID)[1]
    assert "Draining: the service stops (503)" in err, err
    for command, words in (("job list", ("127.0.0.1:1: ", "that of MORPHOD_SERVER", "--server")),
                           ("job list --server unix:/nowhere",
                            ("unix:/nowhere", "that of --server")), ("watch", ("MORPHOD_SERVER",))):
        status, _, err = run("127.0.0.1:1", command + " --retry 0")
        assert status == 4 and all(word in err for word in words), err
    status, _, err = run("", "job list --retry 0", http_proxy="http://127.0.0.1:1")
    assert "127.0.0.1:8765" not in err or "the default" in err, err


def test_faults_are_printed():
    problem = {"title": "Unprocessable Content", "detail": "2 faults",
               "errors": [{"detail": "not contiguous", "pointer": "/designs/0/cells/1"},
                          {"detail": "unknown", "header": "Prefer"}]}
    out, err, _ = ask([reply(422, problem)], "eval", status=6, input_text="[[0,0,0],[5,5,3]]")
    assert out == "" and "/designs/0/cells/1: not contiguous" in err, err
    assert "Prefer: unknown" in err, err
    one = {"title": "Unprocessable Content", "detail": "/device: no such device",
           "errors": [{"detail": "no such device", "pointer": "/device"}]}
    err = ask([reply(422, one)], "eval", status=6, input_text="[[0,0,0]]")[1]
    assert err.count("no such device") == 1, err


def test_closed_standard_output():
    """The reply must not be written to the connection that got the descriptor's number."""
    with Server([JOB]) as server:
        run = subprocess.run(["sh", "-c", 'exec "$0" job show 7 >&-', MORPHOCTL],
                             env={**os.environ, "MORPHOD_SERVER": server.address},
                             capture_output=True, text=True, check=False)
    assert run.returncode == 1 and "standard output" in run.stderr, run


def test_exit_statuses():
    for code, status in ((401, 5), (403, 5), (404, 3), (409, 3), (400, 6), (413, 6), (500, 1),
                         (507, 7)):
        problem = reply(code, {"title": "T", "detail": "D"})
        ask([problem], "job show 7 --retry 0", status=status)
    ask([reply(200, b"<html>", "text/html")], "job show 7", status=1)


def test_token():
    with tempfile.NamedTemporaryFile("w") as file:
        file.write("# the token\n\nfrom-a-file\n")
        file.flush()
        for more, variables, sent in (
            ("", {"MORPHOD_TOKEN": "from-a-variable"}, "Bearer from-a-variable"),
            (f"--token-file {file.name}", {"MORPHOD_TOKEN": "other"}, "Bearer from-a-file"),
            ("", {}, None)):
            seen = ask([JOB], f"job show 7 {more}", **variables)[2]
            assert seen[0][2].get("Authorization") == sent


def test_watch_continues_after_a_break():
    running = {**JOB, "state": "running"}
    out, _, seen = ask([
        running,
        stream(event(3, "job.created", state="queued") + "id: 4\nevent: job.pro"),
        stream(event(4, "job.progress", state="running", rollouts_done=1, rollouts_total=2) +
               event(5, "job.finished", state="succeeded"))], "watch 7")
    assert [l.split()[3] for l in out.splitlines()
            ] == ["job.created", "job.progress", "job.finished"], out
    assert seen[1][1] == "/v1/events?job=7&after=0" and seen[2][2]["Last-Event-ID"] == "3"
    failed = stream(event(5, "job.finished", state="failed"))
    out = ask([running, failed], "watch 7 --json", status=3)[0]
    assert json.loads(out)["data"] == {"state": "failed"}


def test_pages():
    pages = [{"items": [JOB] * 2, "next_cursor": "a/b"}, {"items": [JOB], "next_cursor": None}]
    out, _, seen = ask(pages, "job list --all")
    assert len(out.splitlines()) == 4
    assert [s[1] for s in seen] == ["/v1/jobs?limit=1000", "/v1/jobs?limit=1000&cursor=a%2Fb"]


def test_verify():
    def verified(agrees):
        return {**JOB, "results": [{**RESULT, "stored_losses": [0.5, 1.0], "agrees": agrees}]}

    for agrees, status in ((True, 0), (False, 3), (None, 3)):
        seen = ask([verified(agrees)], f"verify {VOXELS}", status=status)[2]
        assert json.loads(seen[0][3])["verify"] is True
    # The orientation of an id is requested from the server.
    design = {"id": ID, "orientations": [{"genotype": VOXELS, "scores": []}]}
    seen = ask([design, verified(True)], f"verify {ID}")[2]
    assert json.loads(seen[1][3])["designs"] == [{"voxels": VOXELS}]


TRAINING = {
    "id": "7", "kind": "pretrain", "name": "walker", "state": "running", "priority": "batch",
    "label": None, "attempts": 0, "error": None, "created_at": "2026-11-21T10:00:00.000Z",
    "started_at": "2026-11-21T10:00:00.000Z", "finished_at": None, "reason": None,
    "phase": "learning", "parent": None, "validation": None, "checkpoint_step": None,
    "controller": None,
    "settings": {
        "steps": 1400, "batch": 256, "seed": 1, "sensor": "inverse_sqrt", "n_designs": None,
        "population": None, "schedule": {"kind": "cosine", "peak": 0.002, "floor": 1e-05},
        "adam": {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-08}, "gradient_norm_limit": 1.0,
        "adjoint_bound": 2.0, "adjoint_rule": "clip", "restart_weight": 3.0,
        "physics": {"dt_s": 0.004, "n_steps": 20, "impact": "exact"},
        "validation": {"every_steps": 50, "designs": 64, "environments": 8},
        "checkpoint": {"every_steps": 0, "every_s": 60, "keep": 3}
    },
    "progress": {
        "step": 2, "steps": 1400, "mean_loss": 0.75, "gradient_norm": 0.5, "rate": 0.001,
        "clipped_share": 0.03, "diverged": 0, "zeroed": 0, "bodies_per_s": 100.0,
        "seconds_left": 3600.0, "replayed": 0, "replay_total": 0
    }
}
NEWEST = {"items": [], "next_cursor": None, "newest": "41", "reset": True}
NO_ROWS = {"items": [], "next_cursor": None}
DONE = {**TRAINING, "state": "succeeded", "phase": "idle",
        "controller": {"name": "walker", "sha256": "c" * 64},
        "progress": {**TRAINING["progress"], "step": 1400}}


def step_rows(first, last):
    rows = [{"step": n, "mean_loss": 1 / n} for n in range(first, last + 1)]
    return {"items": rows, "next_cursor": None}


def test_train_start_sends_the_options():
    out, err, seen = ask(
        [reply(202, TRAINING)],
        "train start pretrain --name walker --steps 1400 -b 256 --seed 3 --sensor inverse_square "
        "--schedule restarts --peak 2e-3 --floor 1e-5 --decay 0.7 --cycle-steps 10 "
        "--cycle-growth 2 --warmup-steps 5 --beta1 0.8 --beta2 0.99 --epsilon 1e-7 "
        "--gradient-norm-limit 0 --adjoint-bound 8 --adjoint-rule restart --restart-weight 0.5 "
        "-p n_steps=20 --validate-every 5 --validation-designs 4 --validation-environments 2 "
        "--checkpoint-steps 7 --checkpoint-seconds 0 --checkpoint-keep 2 --priority batch "
        "--label x")
    assert out == "7\n" and "morphoctl train watch 7" in err, (out, err)
    method, path, headers, body = seen[0]
    assert (method, path) == ("POST", "/v1/trainings") and "Prefer" not in headers
    assert re.fullmatch("[0-9a-f]{32}", headers["Idempotency-Key"])
    assert json.loads(body) == {
        "kind": "pretrain", "name": "walker", "steps": 1400, "batch": 256, "seed": 3,
        "sensor": "inverse_square",
        "schedule": {"kind": "restarts", "peak": 0.002, "floor": 1e-05, "decay": 0.7,
                     "cycle_steps": 10, "cycle_growth": 2, "warmup_steps": 5},
        "adam": {"beta1": 0.8, "beta2": 0.99, "epsilon": 1e-07}, "gradient_norm_limit": 0.0,
        "adjoint_bound": 8.0, "adjoint_rule": "restart", "restart_weight": 0.5,
        "physics": {"n_steps": 20},
        "validation": {"every_steps": 5, "designs": 4, "environments": 2},
        "checkpoint": {"every_steps": 7, "every_s": 0, "keep": 2}, "priority": "batch", "label": "x"
    }


def test_train_start_finetune():
    for words, job, sent in (
        (f"{VOXELS} -c walker --schedule one-cosine", None,
         {"controller": "walker", "designs": [{"voxels": VOXELS}], "schedule": "one-cosine"}),
        ("--population 12 --best 64", JOB, {"population": {"evaluation": "12", "best": 64}}),
        ("--population 13", {**JOB, "kind": "campaign"}, {"population": {"campaign": "13"}})):
        replies = ([job] if job is not None else []) + [reply(202, TRAINING)]
        seen = ask(replies, "train start finetune " + words)[2]
        assert json.loads(seen[-1][3]) == {"kind": "finetune", **sent}
        assert job is None or seen[0][1] == f"/v1/jobs/{words.split()[1]}"  # the source
    bodies = {"items": [{"id": ID, "genotype": VOXELS}] * 5}
    seen = ask([bodies, reply(202, TRAINING)], "train start finetune --random 5 --random-seed 9")[2]
    assert seen[0][1] == "/v1/bodies/random" and len(json.loads(seen[1][3])["designs"]) == 5


def test_random_bodies_from_an_offset():
    bodies = {"items": [{"id": ID, "genotype": VOXELS}] * 2}
    seen = ask([bodies, reply(202, JOB)], "eval --no-wait --random 2 --seed 7 --first 40")[2]
    assert json.loads(seen[0][3]) == {"count": 2, "seed": 7, "first": 40}
    seen = ask([bodies], "design random --count 2 --first 9")[2]
    assert json.loads(seen[0][3]) == {"count": 2, "first": 9}
    for words in ("eval --first 3 " + VOXELS, "eval --random 3 --first -1",
                  "eval --random 3 --first 1000000"):
        out, err, seen = ask([], words, status=2)
        assert out == "" and "--first" in err and seen == [], (words, err)


def test_more_random_bodies_than_a_list():
    """Random designs are identified, not listed; with --best all scores come in pages."""
    large = {**JOB, "kind": "evaluation", "n_designs": 20000}
    seen = ask([reply(202, large)], "eval --no-wait --random 20000 --first 40 --seed 7")[2]
    sent = json.loads(seen[0][3])
    assert len(seen) == 1 and sent["random"] == {"count": 20000, "seed": 7, "first": 40}
    assert "designs" not in sent
    for words in ("eval --random 1000001", "eval --random 20000 " + VOXELS):
        out, err, seen = ask([], words, status=2)
        assert out == "" and "--random" in err and seen == [], (words, err)


def test_train_start_that_makes_no_sense():
    for words in ("x", "finetune", f"pretrain {VOXELS}", "pretrain --random 3",
                  "pretrain --population 1", f"finetune {VOXELS} --population 1",
                  f"finetune {VOXELS} --best 2", "pretrain --peak 1e-3",
                  "pretrain --schedule one-cosine --peak 1e-3", "pretrain --steps 1e3",
                  "pretrain --steps " + "9" * 30, "pretrain --adjoint-bound inf",
                  "pretrain --beta1 ''", "pretrain -p gravity=1", "finetune --population x",
                  "pretrain --stepps 3"):
        out, err, seen = ask([], "train start " + words, status=2)
        assert out == "" and err.startswith("morphoctl: ") and seen == [], (words, err)


def test_train_watch_continues_after_a_break():
    progress = {"id": "7", "step": 4, "steps": 1400, "mean_loss": 0.5, "gradient_norm": 0.25,
                "rate": 0.002, "clipped_share": 0.125, "bodies_per_s": 123.4,
                "seconds_left": 90061.0}
    validation = {"step": 50, "mean_score": 0.25, "standard_error": 0.01, "rollouts": 512,
                  "diverged": 3}
    paused = {**TRAINING, "state": "paused", "phase": "idle"}
    out, _, seen = ask([
        NEWEST, TRAINING, step_rows(1, 2), NO_ROWS,
        stream(event(42, "training.progress", **progress) + "id: 43\nevent: trai"),
        TRAINING, NO_ROWS, NO_ROWS,
        stream(event(43, "training.validation", id="7", **validation) +
               event(44, "training.checkpoint", id="7", step=50) +
               event(45, "job.paused", state="paused")),
        paused, NO_ROWS, NO_ROWS, paused, NO_ROWS, NO_ROWS,
        stream(event(46, "job.finished", state="succeeded")), DONE, NO_ROWS, NO_ROWS
    ], "train watch 7")
    assert [line.removeprefix("2026-11-21 10:00:00 UTC  ") for line in out.splitlines()] == [
        "training 7 (pretrain walker) is running, step 2 of 1,400",
        "step 4 of 1,400  loss 0.5000  gradient 0.25  rate 0.002  clipped 12.5 %  123.4 bodies/s  "
        "25:01:01 left",
        "validation 0.2500 ± 0.0100 at step 50, 3 of 512 rollouts diverged",
        "checkpoint of step 50", "job.paused  paused", "job.finished  succeeded",
        "controller walker: sha256:" + "c" * 64
    ], out
    streams = [(path, headers.get("Last-Event-ID")) for _, path, headers, _ in seen
               if path.startswith("/v1/events?job")]
    assert streams == [("/v1/events?job=7&after=41", None), ("/v1/events?job=7", "42"),
                       ("/v1/events?job=7", "45")]


def test_wait_if_the_server_does_not_wait():
    """A server or proxy that drops Prefer and replies at once must not be polled without a
    pause."""
    running = JOB | {"state": "running"}
    begun = time.monotonic()
    assert len(ask([running, running, running, running, JOB], "wait 7")[2]) == 5
    assert time.monotonic() - begun >= 4 * 0.25


def test_a_list_that_does_not_end():
    page = {"items": [JOB], "next_cursor": "7"}
    _, err, seen = ask([page] * 9, "job list --limit 5000", 1)
    assert "does not end" in err and len(seen) == 2, (err, len(seen))


def test_a_reply_that_does_not_end():
    """Its memory is bounded."""
    def endless(handler):
        handler.send_response(200)
        handler.send_header("Content-Type", "application/json")
        handler.send_header("Transfer-Encoding", "chunked")
        handler.end_headers()
        piece = b" " * (1 << 20)
        try:
            for _ in range(3000):
                handler.wfile.write(b"%x\r\n%s\r\n" % (len(piece), piece))
        except OSError:
            handler.close_connection = True

    assert "does not end" in ask([endless], "job show 7", 1)[1]


def test_train_watch_one_that_has_ended():
    error = {"code": "io", "detail": "the disk broke"}
    for changes, status, words in (({}, 0, ""), ({"state": "cancelled"}, 3, "is cancelled"),
                                   ({"state": "failed", "error": error}, 3, "the disk broke")):
        replies = [NEWEST, {**DONE, **changes}, step_rows(1, 5), NO_ROWS]
        assert words in ask(replies, "train watch 7", status=status)[1]


def test_train_watch_is_left_with_an_interrupt():
    arrived = threading.Event()

    def silent(handler):
        stream(event(42, "training.progress", step=3, mean_loss=0.5))(handler)
        handler.wfile.flush()
        arrived.set()
        time.sleep(20)

    with Server([NEWEST, TRAINING, step_rows(1, 2), NO_ROWS, silent]) as server:
        environment = {**os.environ, "MORPHOD_SERVER": server.address, "LC_ALL": "C.UTF-8"}
        process = subprocess.Popen([MORPHOCTL, "train", "watch", "7"], stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE, text=True, env=environment)
        assert arrived.wait(300)
        assert process.stdout.readline().startswith("training 7")
        assert "step 3" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=300)
        assert process.returncode == 130, err
        assert all(f"morphoctl train {verb} 7" in err for verb in ("watch", "pause", "cancel")), err


def shown_on_a_terminal(server, *command):
    """Returns what the command writes to a pseudo-terminal of 80 × 24."""
    child, terminal = pty.fork()
    if child == 0:
        os.environ.update(MORPHOD_SERVER=server.address, LC_ALL="C.UTF-8", TERM="xterm")
        os.execv(MORPHOCTL, [MORPHOCTL, *command])
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    data, piece = b"", b" "
    while piece:
        data += piece
        try:
            piece = os.read(terminal, 65536)
        except OSError:  # end of file on a pseudo-terminal
            break
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0, data
    return data.decode()


def test_train_watch_draws_on_a_terminal():
    """The same lines are redrawn, and never more than the view has."""
    rows = "".join(
        event(42 + n, "training.progress", step=n + 3, mean_loss=0.5 / (n + 1)) for n in range(5))
    evil = {**TRAINING, "name": "w\033]0;x\007", "label": "\033[2J"}
    with Server([
            NEWEST, evil, step_rows(1, 2), NO_ROWS,
            stream(rows + event(60, "job.finished", state="succeeded")), {**DONE, "name": "w"},
            step_rows(3, 500), {"items": [{"step": 0, "mean_score": 0.9}], "next_cursor": None}
    ]) as server:
        text = shown_on_a_terminal(server, "train", "watch", "7")
    assert "\033]0" not in text and "\033[2J" not in text and "w?]0;x?" in text
    frames = text.split("\033[J")
    assert len(frames) >= 3 and "Ctrl-C leaves" in frames[0]
    assert "◆" in frames[-2] and "step 500" in frames[-2]
    for frame in frames[:-1]:
        assert frame.count("\n") <= 23, frame
        for line in re.sub(r"\033\[[0-9]*[A-Za-z]", "", frame).replace("\r", "").split("\n"):
            assert len(line) <= 80, line
    up = re.findall(r"\033\[(\d+)A", text)
    assert [int(n) for n in up] == [frame.count("\n") for frame in frames[:len(up)]]


def test_train_show_and_list():
    job = {**TRAINING, "parent": {"name": "default", "sha256": "d" * 64}, "reason": "no space"}
    out = ask([job, step_rows(1, 2), NO_ROWS], "train show 7")[0]
    for line in ("reason +no space", "from +default, sha256:d+", "progress +step 2 of 1,400",
                 r"limits +gradient 1, adjoint 2 \(clip\)"):
        assert re.search(f"^{line}$", out, re.M), (line, out)
    assert "⠁" <= max(out) <= "⣿", out
    settings = {**TRAINING["settings"], "adjoint_bound": 8.0, "adjoint_rule": "restart"}
    out = ask([{**TRAINING, "settings": settings}, NO_ROWS, NO_ROWS], "train show 7")[0]
    assert "gradient 1, adjoint 8 (restart, weight 3)\n" in out, out
    page = {"items": [TRAINING, DONE], "next_cursor": None}
    out, _, seen = ask([page], "train list --state running")
    assert len(out.splitlines()) == 3 and seen[0][1] == "/v1/trainings?state=running&limit=50"
    ask([], "train list --state ended", status=2)


def scored(identity, scores):
    results = [{**RESULT, "score": score, "losses": [score, score],
                "diverged": [] if score is not None else [{"environment": 0, "step": 3}]}
               for score in scores]
    return {**JOB, "id": identity, "controller": {"name": "x", "sha256": "e" * 64},
            "results": results}


def test_train_compare():
    held_out = {"designs": [{"voxels": VOXELS}] * 5,
                "environments": [{"light_xy_m": [1, 2], "terrain_sigma_m": 0, "seed": 1}] * 2}
    known = [held_out, {"name": "old"}, {"name": "new"}]
    replies = known + [scored("8", [2.0, 4.0, 6.0, 1.0, None]),
                       scored("9", [1.0, 2.0, 3.0, 1.0, 0.5])]
    out, _, seen = ask(replies,
                       "train compare old new --seed 3 --designs 5 --environments 2")
    assert seen[0][1] == "/v1/held-out?seed=3&designs=5&environments=2"
    assert [s[1] for s in seen[1:3]] == ["/v1/controllers/old", "/v1/controllers/new"]
    assert [json.loads(s[3]) for s in seen[3:5]] == [{**held_out, "controller": name}
                                                     for name in ("old", "new")]
    # Differences -1, -2, -3, 0: mean -1.5, deviation sqrt(5/3), t(0.975, 3) = 3.182446; both
    # environments are alike.
    half = 3.182446305284263 * (5 / 3 / 4)**0.5
    for words in (f"-1.5000, 95 % confidence {-1.5 - half:+.4f} to {-1.5 + half:+.4f} "
                  "for other designs and environments (Student t, 3.0 degrees of freedom)",
                  "3 of 4 designs (75.0 %), 1 equal; sign test p = 0.25",
                  "1 design that diverged", "No significant difference"):
        assert words in out, (words, out)
    assert re.search(r"^A +old +3\.2500 +1 of 5 +1 of 10 ", out, re.M), out
    assert re.search(r"^B +new +1\.7500 +0 of 5 +0 of 10 ", out, re.M), out
    value = json.loads(ask(replies, "train compare old new --json")[0])
    assert value["pairs"] == 4 and value["difference"] == -1.5 and value["improved"] == 3
    assert abs(value["high"] - (half - 1.5)) < 1e-12 and value["verdict"] == "undecided"
    assert value["a"]["designs_diverged"] == 1
    assert value["held_out"] == {"seed": 1, "designs": 5, "environments": 16}
    assert value["interval_for"] == "designs and environments"
    # Most designs are better with B, but one is much worse: the text says both.
    replies = [{**held_out, "designs": held_out["designs"] * 2}] + known[1:] + [
        scored("8", [1.0] * 10), scored("9", [0.9] * 9 + [3.0])]
    out = ask(replies, "train compare old new")[0]
    assert "No significant difference" in out
    assert "most designs are better with new (sign test, p = 0.021)" in out
    # -e is a set of environments in other commands.
    _, err, _ = ask([], "train compare old new -e 16", status=2)
    assert "-e is not an option of train compare; write --environments N" in err, err
    # An unknown name is reported before anything is computed.
    _, _, seen = ask(known[:2] + [reply(404, {"title": "T", "detail": "D"})],
                         "train compare old no-such", status=3)
    assert [s[0] for s in seen] == ["GET"] * 3, seen
    # One controller under two names is refused before anything is computed, too.
    same = [{"name": name, "sha256": "e" * 64} for name in ("old", "new")]
    _, err, seen = ask([held_out, *same], "train compare old new", status=3)
    assert "old and new are the same controller (sha256:eee" in err and len(seen) == 3, err
    # Anything is refused that is given twice, before a request.
    for command, noun in (("train", "controller old"), ("campaign", "campaign 7"),
                          ("atlas", "atlas walk")):
        name = noun.split()[1]
        _, err, seen = ask([], f"{command} compare {name} {name}", status=2)
        assert f"{noun} is given twice: there is nothing to compare" in err and not seen, err
    for scores, verdict, words in (
        ([0.5, 0.6, 0.5, 0.6, 0.5], "better", "b is better than a"),
        ([1.5, 1.6, 1.5, 1.6, 1.5], "worse", "b is worse than a"),
        ([None] * 5, "undecided", "Too few designs")):
        replies = known + [scored("8", [1.0] * 5), scored("9", scores)]
        assert json.loads(ask(replies, "train compare a b --json")[0])["verdict"] == verdict
        assert words in ask(replies, "train compare a b")[0]


def test_train_compare_names_settings_that_differ():
    """From the metadata of both controllers; the seed is left out."""
    def controller(name, settings, **more):
        metadata = {"morphod.kind": "pretrain", "morphod.seed": name, "morphod.code": name,
                    "morphod.settings": json.dumps(settings), "note": name, **more}
        return {"name": name, "sha256": name * 64, "sensor": "inverse_sqrt",
                "control_period_s": settings["physics"].get("control_period_s"),
                "metadata": metadata}

    held_out = {"designs": [{"voxels": VOXELS}] * 5,
                "environments": [{"light_xy_m": [1, 2], "terrain_sigma_m": 0, "seed": 1}] * 2}
    scores = [scored("8", [1.0] * 5), scored("9", [0.5] * 5)]
    physics = {"n_steps": 20, "dt_s": 0.004}
    a = controller("a", {"batch": 8, "schedule": {"peak": 0.002}, "physics": physics})
    b = controller("b", {"batch": 16, "schedule": {"peak": 0.001}, "tasks": 2, "physics": {
        **physics, "control_period_s": 0.016, "integrator": "split"}},
                   **{"morphod.environments_crc64": "12"})
    replies = [held_out, a, b, *scores]
    out = ask(replies, "train compare a b")[0]
    lines = re.findall(r"^differs +b in (.*)$", out, re.M)
    assert sorted(lines) == [
        'environments_crc64: "12", not -', "settings.batch: 16, not 8",
        "settings.physics.control_period_s: 0.016, not -",
        'settings.physics.integrator: "split", not -',
        "settings.schedule.peak: 0.001, not 0.002", "settings.tasks: 2, not -"
    ], out
    assert re.search("^note +b learned in 2 tasks of its own", out, re.M), out
    assert "b is better than a" in out and "not known" not in out
    found = json.loads(ask(replies, "train compare a b --json")[0])
    assert {"setting": "settings.batch", "values": [8, 16]} in found["differences"]
    assert len(found["differences"]) == 6 and found["a"]["training_known"] is True
    # Without settings in one of the files, only what the service itself knows is compared.
    for metadata in ({}, {"morphod.settings": "[1]"}, {"morphod.settings": "{"}):
        untrained = {**a, "metadata": metadata}
        out = ask([held_out, untrained, b, *scores], "train compare a b")[0]
        assert re.findall(r"^differs +b in (.*)$", out, re.M) == ["control_period_s: 0.016, not -"]
        assert re.search("^not known +how a was trained", out, re.M), out
    found = json.loads(ask([held_out, untrained, b, *scores], "train compare a b --json")[0])
    assert [found[side]["training_known"] for side in "ab"] == [False, True]
    out = ask([held_out, a, {**a, "sha256": "f" * 64}, *scores], "train compare a b")[0]
    assert "differs" not in out, out


def test_watch_reports_what_happened():
    received = [
        ("training.progress", {"step": 2, "steps": 9, "mean_loss": 0.5, "gradient_norm": 1,
                               "rate": 0.1, "clipped_share": 0},
         "  step 2 of 9  loss 0.5000  gradient 1  rate 0.1  clipped 0.0 %"),
        ("training.validation", {"step": 2, "mean_score": 0.25, "standard_error": 0.5,
                                 "rollouts": 8, "diverged": 0}, "  0.2500 ± 0.5000 at step 2"),
        ("training.checkpoint", {"step": 2}, "  of step 2"),
        ("training.code_changed", {"from_step": 2, "fingerprint": "new", "before": None},
         "  after step 2: new, before unknown"),
        ("campaign.generation", {"generation": 7, "generations": 30, "mean": 0.5, "best": None,
                                 "diversity": 0.25},
         "  generation 7 of 30  mean 0.5000  best –  diversity 0.2500"),
        ("campaign.progress", {"generation": 7, "phase": "scoring", "done": 3, "total": 1234},
         "  generation 7  scoring 3 of 1,234"),
        ("campaign.imported", {"campaign": "7", "store": "a4eb17c601a62c16"},
         "  campaign 7 of store a4eb17c601a62c16"),
        ("scores.imported", {"new": 1234, "store": "a4eb17c601a62c16", "host": "x"},
         "  1,234 rollouts of store a4eb17c601a62c16 on x"),
        ("scores.differ", {"different": 2, "store": "a4eb17c601a62c16", "host": "x"},
         "  2 rollouts of store a4eb17c601a62c16 on x"),
        ("campaign.extended", {"generations": 1234}, "  to 1,234 generations"),
        ("campaign.diversity_collapse", {"generation": 7, "diversity": 0.1, "maximum": 0.5},
         "  generation 7: diversity 0.1000, it was 0.5000"),
        ("campaign.lineage_unreadable", {"controller": "0123456789abcdef", "field": "morphod.seed",
                                         "detail": "no number"},
         "  morphod.seed of controller 0123456789ab: no number"),
        ("job.progress", {"state": "running", "rollouts_done": 3, "rollouts_total": 1234},
         "  running  3 of 1,234 rollouts"), ("training.other", {"x": 1}, "")]
    events = "".join(event(n, kind, **data) for n, (kind, data, _) in enumerate(received, 1))
    out = ask([stream(events)], "watch --retry 0", status=4)[0]
    assert [line[25:] for line in out.splitlines()
            ] == [f"{kind:<15} job 7{words}" for kind, _, words in received], out


def test_campaign_whose_generation_is_committed_between_two_requests():
    campaign = {"id": "7", "mode": "zero-shot", "state": "running", "phase": "scoring",
                "progress": {"generation": None, "generations": 3}}
    rows = {"items": [{"generation": 0, "score": {"mean": 0.5}}], "next_cursor": None}
    out, _, seen = ask([campaign, rows], "campaign show 7")
    assert "generation 0 of 3" in out and "before generation" not in out, out
    assert [path for _, path, _, _ in seen] == ["/v1/campaigns/7",
                                                "/v1/campaigns/7/generations?limit=1000"]


def test_job_lists_name_trainings():
    short = {key: TRAINING[key] for key in ("id", "state", "priority", "label", "created_at",
                                            "started_at", "finished_at", "attempts", "error")}
    short.update(kind="training",
                 training={"kind": "finetune", "name": "walker", "step": 350, "steps": 1400})
    out = ask([{"items": [short, JOB], "next_cursor": None}], "job list")[0]
    assert re.search(r"7 +finetune +running +batch +1,400 steps +25 %", out), out
    assert re.search(r"7 +evaluation +succeeded .* 2 rollouts +100 %", out), out
    assert "step 350 of 1,400; see morphoctl train show 7" in ask([short], "job show 7")[0]


tests = [(name, value) for name, value in sorted(globals().items()) if name.startswith("test_")]
print(f"1..{len(tests)}")
failed = 0
for number, (name, test) in enumerate(tests, 1):
    try:
        test()
        print(f"ok {number} - {name[5:].replace('_', ' ')}")
    except Exception as error:  # a failed test must not hide the others
        failed += 1
        print(f"# {type(error).__name__}: {str(error)[:2000]!r}")
        print(f"not ok {number} - {name[5:].replace('_', ' ')}")
    sys.stdout.flush()
sys.exit(1 if failed else 0)
