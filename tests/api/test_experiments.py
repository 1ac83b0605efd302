"""Experiments that run their own daemon (experiments/*.py), at tiny sizes and with a module that
computes on the processor: their output, which must be the same for an interrupted and an
uninterrupted run."""

import csv
import json
import os
import pathlib
import re
import signal
import sqlite3
import subprocess
import sys
import time
import urllib.request
import xml.etree.ElementTree as ElementTree

import pytest

from service import BINARY, BOOTSTRAP, PATIENCE_S, SOURCE, until

MODULE = pathlib.Path(BINARY).parents[2] / "tests" / "device" / "fake-device.so"
CUT_OFF = 3
ON_DEVICE = (f"--morphod={BINARY}", f"--module={MODULE}", "--device=cuda", "--workers=1")
NO_DAEMON = ("--morphod=/nowhere/morphod", )
PRETRAINING = ("--steps=6", "--batch=8", "--rollout-steps=30", "--validation-every=3",
               "--validation-designs=4", "--validation-environments=2")
REPRODUCTION = ("--population=16", "--generations-zero-shot=3", "--generations-few-shot=1",
                "--generations-simultaneous=3", "--few-shot-steps=2", "--rollout-steps=30",
                "--champions=5", "--seeds=1,2", f"--controller={BOOTSTRAP}"
                )  # a pretraining run without bodies to redraw


def command(name, *arguments):
    return [sys.executable, SOURCE / "experiments" / f"{name}.py", *map(str, arguments)]


def bench(name, *arguments, status=0, **environment):
    done = subprocess.run(command(name, *arguments), capture_output=True, text=True, timeout=300,
                          env={**os.environ, **environment}, check=False)
    assert done.returncode == status, done.stdout + done.stderr
    return done


def rows(path):
    if not path.exists():
        return []
    with open(path, encoding="utf-8", newline="") as file:
        return [{key: value
                 for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]


def is_svg(path):
    return ElementTree.parse(path).getroot().tag == "{http://www.w3.org/2000/svg}svg"


def pretraining_in(folder):
    return (f"--state={folder / 'state'}", f"--csv={folder / 'p.csv'}", f"--svg={folder / 'p.svg'}",
            f"--folder={folder / 'controllers'}")


def trainings(folder, statement="SELECT job FROM trainings"):
    with sqlite3.connect(folder / "state" / "state" / "morphod.db") as database:
        return database.execute(statement).fetchall()


def test_pretraining(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    seeds = "--seeds=1,20261122"
    bench("pretraining", *PRETRAINING, seeds, *ON_DEVICE, *pretraining_in(whole))
    cut = bench("pretraining", *PRETRAINING, seeds, *ON_DEVICE, *pretraining_in(parts),
                "--limit-s=2", status=CUT_OFF, MORPHO_FAKE_DELAY_MS="400")
    assert "time is up" in cut.stderr
    assert len(rows(parts / "p.csv")) < len(rows(whole / "p.csv"))
    begun = set(trainings(parts))
    trainings(parts, "DELETE FROM idempotency_keys")  # as if a day had passed
    printed = bench("pretraining", *PRETRAINING, seeds, *ON_DEVICE, *pretraining_in(parts)).stdout
    assert begun and begun < set(trainings(parts)) and len(trainings(parts)) == 2
    assert rows(parts / "p.csv") == rows(whole / "p.csv") and printed.count("one cosine") == 2
    steps = [row for row in rows(whole / "p.csv") if row["row"] == "step"]
    assert [int(row["step"])
            for row in steps] == 2 * [*range(1, 7)] and {(row["device"], row["machine"][:2])
                                                         for row in steps} == {("cuda", "1 ")}
    assert [row["step"] for row in rows(whole / "p.csv")
            if row["row"] == "validation"] == 2 * ["0", "3", "6"]
    files = sorted(file.name for file in (whole / "controllers").iterdir())
    assert len(files) == 2 and all(
        (whole / "controllers" / name).read_bytes() == (parts / "controllers" / name).read_bytes()
        for name in files)
    assert is_svg(parts / "p.svg")
    # A training run that is complete in the CSV file needs neither state nor daemon. Another recipe
    # is added to the file.
    assert bench("pretraining", *PRETRAINING, seeds, "--device=cuda", *NO_DAEMON,
                 *pretraining_in(parts)).stdout == printed
    bench("pretraining", *PRETRAINING, "--seeds=1", "--schedule=paper-pretrain", "--bound=0",
          *ON_DEVICE, *pretraining_in(parts))
    assert rows(parts / "p.csv")[:len(rows(whole / "p.csv"))] == rows(whole / "p.csv")
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- pretraining: begin -->\nold\n<!-- pretraining: end -->\nbehind\n")
    report = bench("pretraining", "--report", *pretraining_in(parts), f"--markdown={page}").stdout
    assert report.count("one cosine 0.002..1e-05 bound 2 ") == 2 and report.count(
        "restarts 0.001..1e-05 bound 0 ") == 1
    assert page.read_text().startswith("before\n") and page.read_text().endswith(
        "behind\n") and report.strip() in page.read_text()
    assert "old" not in page.read_text()
    # The rule and its weight are part of the recipe, and of the request.
    bench("pretraining", *PRETRAINING, "--seeds=1", "--bound=0.1", "--rule=restart", *ON_DEVICE,
          *pretraining_in(tmp_path / "again"))
    recipes = {row["recipe"] for row in rows(tmp_path / "again" / "p.csv")}
    assert recipes == {"one cosine 0.002..1e-05 bound 0.1 restart 3 lives of 30 / 8 x 6"}
    assert trainings(tmp_path / "again", "SELECT settings->>'adjoint_rule',"
                     " settings->>'restart_weight' FROM runs") == [("restart", 3)]
    # Worlds that vary, and a start with the weights of another controller, too.
    bench("pretraining", *PRETRAINING, "--seeds=1", "--vary=friction=0.5:1", "--from-default",
          *ON_DEVICE, *pretraining_in(tmp_path / "from"))
    assert {row["recipe"] for row in rows(tmp_path / "from" / "p.csv")} == {
        "one cosine 0.002..1e-05 bound 2 lives of 30 friction 0.5..1 from default / 8 x 6"}
    refused = bench("pretraining", "--peak=2", *ON_DEVICE, *pretraining_in(tmp_path / "refused"),
                    status=1)
    assert "/schedule/peak" in refused.stderr
    assert "does not belong" in bench("pretraining", "--cycle=5", *NO_DAEMON,
                                      *pretraining_in(tmp_path / "refused"), status=1).stderr


def test_reproduction(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    bench("reproduction", *REPRODUCTION, *ON_DEVICE, f"--state={tmp_path / 'one'}",
          f"--folder={whole}")
    bench("reproduction", *REPRODUCTION, *ON_DEVICE, f"--state={tmp_path / 'two'}",
          f"--folder={parts}", "--modes", "simultaneous", "--limit-s=2", status=CUT_OFF,
          MORPHO_FAKE_DELAY_MS="400")
    assert len(rows(parts / "generations.csv")) < 4
    # In another order: the interrupted campaign is paused in the meantime.
    for modes in (("zero-shot", ), ("zero-shot", "few-shot", "simultaneous")):
        printed = bench("reproduction", *REPRODUCTION, *ON_DEVICE, f"--state={tmp_path / 'two'}",
                        f"--folder={parts}", "--modes", *modes).stdout
    assert sorted(map(str, rows(parts / "generations.csv"))) == sorted(
        map(str, rows(whole / "generations.csv")))
    kept = [
        sorted(json.loads((folder / "campaigns.json").read_text())["campaigns"],
               key=lambda entry: (entry["mode"], entry["seed"])) for folder in (whole, parts)
    ]
    assert all(entry.pop("elapsed_s") > 0 for entries in kept
               for entry in entries) and kept[0] == kept[1] and len(kept[0]) == 6
    assert len(rows(whole / "generations.csv")) == 2 * (4 + 2 + 4)
    for entry in json.loads((whole / "campaigns.json").read_text())["campaigns"]:
        assert entry["device"] == "cuda" and entry["machine"]["gpus"] and entry[
            "controller" if entry["mode"] != "simultaneous" else "mode"]
        assert [len(losses) for losses in entry["learning"]
                ] == {"zero-shot": [], "few-shot": [1, 2], "simultaneous": [1, 2, 2,
                                                                            2]}[entry["mode"]]
        for population in entry["populations"]:
            assert population["size"] == 16 and all(
                abs(sum(population[name]) - 1) < 1e-4
                for name in ("score", "footprint", "masses", "distinctiveness"))
        for champions in entry["champions"]:
            assert len(champions["designs"]) == 5 and all(
                design["genotype"].count("1") == design["voxels"]
                for design in champions["designs"])
    for name in ("performance", "operators", "bodies", "populations", "champions"):
        assert is_svg(whole / f"{name}.svg")
    for text in ("| zero-shot | paper | near optimal | 100 generations | 17 min | 8 H100 | 136 |",
                 "| simultaneous | paper |", "| few-shot | paper |",
                 "Population 16, generations 0 to 3."):
        assert text in printed
    page = tmp_path / "page.md"
    drawn = (whole / "champions.svg").read_bytes()
    (whole / "champions.svg").unlink()
    report = bench("reproduction", "--report", f"--folder={whole}", f"--markdown={page}")
    assert (whole /
            "champions.svg").read_bytes() == drawn and report.stdout.strip() in page.read_text()
    # A training run whose GPUs were lost: their number is unknown.
    (tmp_path / "p.csv").write_text(
        "recipe,device,machine,row,seed,step,loss,seconds,zeroed,skipped,standard_error\n"
        "one cosine 0.002 / 8 x 6,cuda,,step,1,1,0.5,1,0,0,\n")
    printed = bench("reproduction", "--report", f"--folder={whole}",
                    f"--pretraining={tmp_path / 'p.csv'}").stdout
    assert ("| morphod, one cosine 0.002 / 8 x 6 | training 0.500; held out – "
            "| 1 steps | 0.0 min | none | – |") in printed


def test_model_card(tmp_path):
    page = tmp_path / "walker.md"
    arguments = (f"--controller={BOOTSTRAP}", "--bodies=20", "--environments=1",
                 "--rollout-steps=20", f"--morphod={BINARY}", "--devices=none",
                 f"--state={tmp_path / 'state'}", f"--markdown={page}", "--name=walker")
    bench("model_card", *arguments)
    first = page.read_text()
    assert first.startswith(
        "# walker.safetensors\n") and "`inverse_sqrt`" in first and "| all | 20 |" in first
    assert first.count("(beyond the training)") == 2 + 4 and re.search(
        r"\| 0\.1 m \| 20 \| \d\.\d{4} \| \d\.\d{4} to \d\.\d{4} \|", first)
    page.write_text(
        first.replace("## Known limits\n",
                      "## Known limits\nIt cannot fly.\n").replace("| all | 20 |", "| all | 21 |"))
    bench("model_card", *arguments)
    assert page.read_text() == first.replace("## Known limits\n",
                                             "## Known limits\nIt cannot fly.\n")


def test_robustness(tmp_path):
    other = SOURCE / "data" / "controllers" / "phototaxis-16ms.safetensors"
    arguments = (BOOTSTRAP, other, "--bodies=3", "--rollout-steps=20", "--campaigns",
                 "--population=12", "--generations=1", "--vary=friction=0.5:1", "--aggregate=cvar",
                 f"--morphod={BINARY}", "--devices=none")

    files = (f"--state={tmp_path / 'state'}", f"--csv={tmp_path / 'r.csv'}",
             f"--svg={tmp_path / 'r.svg'}")
    bench("robustness", *arguments, *files, "--limit-s=0.5", status=CUT_OFF)
    printed = bench("robustness", *arguments, *files).stdout
    found = rows(tmp_path / "r.csv")
    assert len(found) == 2 * 2 * 18 and is_svg(tmp_path / "r.svg")
    for one, two in zip(found[::2], found[1::2]):
        assert (one["controller"], two["controller"]) == ("bootstrap", "phototaxis-16ms")
        assert float(one["difference"]) == 0 and float(two["difference"]) == pytest.approx(
            float(two["mean"]) - float(one["mean"]), abs=2e-6)
        assert (two["half_width"] == "") == (two["who"] == "champions")
    # Each kind of world has scores of its own.
    bodies = [row["mean"] for row in found if (row["who"], row["controller"]) == (
        "bodies", "bootstrap")]
    assert len(set(bodies)) == 18
    assert "| slope 10° |" in printed and "| all at once, 64 worlds |" in printed
    assert "**3 random bodies**" in printed and "The 10 best bodies" in printed
    page = tmp_path / "page.md"
    again = bench("robustness", "--report", *NO_DAEMON, *files, f"--markdown={page}").stdout
    assert again == printed and printed.strip() in page.read_text()
    refused = bench("robustness", BOOTSTRAP, BOOTSTRAP, *NO_DAEMON, *files, status=2)
    assert "have the same name" in refused.stderr
    assert "NAME=LOW:HIGH" in bench("robustness", "--vary=friction", status=2).stderr
    for ignored in ("--vary=friction=0.5:1", "--aggregate=cvar"):
        assert "add --campaigns" in bench("robustness", ignored, *NO_DAEMON, status=2).stderr


def first_address(process, folder):
    """Returns the address of the daemon of a benchmark, once it listens."""
    for _ in range(600):
        if (folder / "address").exists() and (folder / "address").read_text().strip():
            return (folder / "address").read_text().split()[0]
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    raise TimeoutError


@pytest.fixture
def long_card(tmp_path):
    """A benchmark that runs for some time, and the address of its daemon."""
    process = subprocess.Popen(
        command("model_card", f"--controller={BOOTSTRAP}", "--bodies=400", "--environments=8",
                f"--morphod={BINARY}", "--devices=none", "--workers=1",
                f"--state={tmp_path / 'state'}", f"--markdown={tmp_path / 'page.md'}"),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"MORPHOD_DRAIN_TIMEOUT": "1s"},
        # The signal is ignored if the tests run under nohup.
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL))
    try:
        address = first_address(process, tmp_path / "state")
        assert any("rollouts" in line for line in process.stderr), "it has ended"
        yield process, address
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def is_there(address):
    try:
        with urllib.request.urlopen(address + "/healthz", timeout=300) as reply:
            return reply.status == 200
    except OSError:
        return False


@pytest.mark.parametrize("number", (signal.SIGTERM, signal.SIGHUP, signal.SIGKILL))
def test_stopped_by_a_signal(long_card, number):
    process, address = long_card
    assert is_there(address)
    process.send_signal(number)
    said = process.communicate(timeout=300)
    if number == signal.SIGKILL:
        assert process.returncode == -number
        until(lambda: not is_there(address))
    else:
        assert process.returncode == CUT_OFF and not is_there(address), said


def test_evaluation_that_is_paused_by_somebody(long_card):
    process, address = long_card
    with urllib.request.urlopen(address + "/v1/jobs?state=running") as reply:
        job = json.load(reply)["items"][0]["id"]
    urllib.request.urlopen(urllib.request.Request(f"{address}/v1/jobs/{job}/pause",
                                                  method="POST")).close()
    said = process.communicate(timeout=300)
    assert process.returncode == 1 and "paused" in said[1] and not is_there(address), said


def test_daemon_that_does_not_answer(tmp_path):
    """No process is left behind."""
    deaf = tmp_path / "deaf"
    deaf.write_text(f"""#!/bin/sh
echo $$ >{tmp_path / "pid"}
for flag; do case $flag in --port-file=*) echo http://127.0.0.1:1 >"${{flag#*=}}" ;; esac; done
exec sleep 60
""")
    deaf.chmod(0o755)
    bench("model_card", f"--controller={BOOTSTRAP}", f"--morphod={deaf}",
          f"--state={tmp_path / 'state'}", f"--markdown={tmp_path / 'page.md'}", status=1)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_campaigns_report(tmp_path):
    printed = bench("campaigns", "--report", f"--csv={SOURCE / 'docs' / 'campaigns.csv'}",
                    f"--svg={tmp_path / 'c.svg'}").stdout
    assert (tmp_path / "c.svg").read_bytes() == (SOURCE / "docs" / "campaigns.svg").read_bytes()
    assert printed.split("\n\n")[0] in (SOURCE / "docs" /
                                        "evolution.md").read_text(encoding="utf-8")
