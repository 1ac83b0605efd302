"""morphoctl against the daemon itself. Its behavior towards servers that break is tested in
tests/unit/morphoctl."""

import fcntl
import hashlib
import json
import os
import pty
import re
import select
import shlex
import signal
import statistics
import struct
import subprocess
import termios
import time

import pytest
from archives import blocks, lies
from service import BINARY, BOOTSTRAP, DESIGN, SOURCE, run

MORPHOCTL = os.environ.get(
    "MORPHOCTL",
    os.path.join(os.path.dirname(BINARY), "..", "..", "clients", "morphoctl", "morphoctl"))
SHORT = "--physics n_steps=20"
CELLS = json.dumps(DESIGN)


@pytest.fixture(scope="module")
def ctl(service):

    def run(command, *arguments, server=None, input_text="", **variables):
        environment = {k: v for k, v in os.environ.items() if not k.startswith("MORPHOD")}
        environment.update({"MORPHOD_SERVER": server or service.addresses[0], "LC_ALL": "C.UTF-8"},
                           **variables)
        done = subprocess.run([MORPHOCTL, *shlex.split(command), *arguments],
                              input=input_text,
                              capture_output=True,
                              text=True,
                              timeout=60,
                              env=environment)
        return done.returncode, done.stdout, done.stderr

    return run


def test_named_designs(ctl):
    files = sorted(str(p) for p in (SOURCE / "data" / "designs").glob("*.json"))
    assert len(files) >= 8
    status, out, err = ctl(f"eval {SHORT}", *files)
    assert status == 0, err
    lines = out.splitlines()
    assert len(lines) == len(files) + 1
    for path, line in zip(files, lines[1:]):
        name = os.path.basename(path)[:-5]
        assert re.match(
            rf"\s*\d+\s+{name}\s+[0-9a-f]{{36}}\s+\d+\s+\d+\.\d{{4}}\s+\d+\.\d{{4}}\s+\d+\.\d{{4}}",
            line), line


def test_the_json_is_the_apis(service, ctl):
    status, out, _ = ctl(f"eval {SHORT} --json --label 'from the command line'", input_text=CELLS)
    assert status == 0
    evaluation = json.loads(out)
    assert evaluation == service.request("GET", f"/v1/evaluations/{evaluation['id']}").json()
    assert evaluation["label"] == "from the command line"


def test_a_study(ctl, tmp_path):
    status, out, err = ctl(f"campaign start study -q --population 20 {SHORT}")
    assert status == 0, err
    id = out.strip()
    assert "batch 0 is to be told" in ctl(f"campaign show {id}")[1]
    asked = ctl(f"study ask {id} 8")[1]
    assert asked.count("\n") == 8 and ctl(f"study ask {id} 8")[1] == asked
    (tmp_path / "sampler").write_bytes(bytes(range(256)))
    tell = f"study tell {id} --sampler {tmp_path}/sampler"
    status, out, err = ctl(tell, input_text=asked)
    assert status == 0 and len(out.splitlines()) == 9 and " random " in out, err
    assert ctl(tell + " --batch 0", input_text=asked)[1] == out
    status, out, err = ctl(tell + " --batch 2", input_text=CELLS)
    assert status == 3 and "1 is the next" in err, err
    assert ctl(f"study sampler {id} -o {tmp_path}/again")[0] == 0
    assert (tmp_path / "again").read_bytes() == bytes(range(256))
    mine = {"body": DESIGN, "parents": [3, 1], "operator": "mine", "measures": {"reach": 2}}
    status, out, err = ctl(f"study tell {id} --json --survivors 3,5 --on-fault skip",
                           input_text=json.dumps([mine, {"cells": []}]) + CELLS)
    told = json.loads(out)
    assert [row["child"] for row in told["children"]] == [0, 2]
    assert told["children"][0]["operator"] == "mine" and told["notes"][0]["place"] == 1
    lines = ctl(f"study ask {id} 4 --parents 3,8")[1].splitlines()
    assert {number for line in lines for number in json.loads(line)["parents"]} <= {3, 8}
    for wrong, given, status in (("--survivors 1,x", "", 2), ("", "{", 2), ("", "[1]", 6)):
        assert ctl(f"study tell {id} {wrong}", input_text=given)[0] == status, wrong
    assert ctl(f"study finish {id}")[1] == f"study {id} is succeeded, with 10 designs\n"
    assert ctl(f"study sampler {id}")[0] == 3


def test_the_same_key_is_the_same_evaluation(ctl):
    ids = {
        json.loads(ctl(f"eval {SHORT} --json --idempotency-key once", input_text=CELLS)[1])["id"]
        for _ in range(2)
    }
    assert len(ids) == 1
    status, _, err = ctl(f"eval {SHORT} --idempotency-key once", input_text='[[0,0,0]]')
    assert status == 6 and "key" in err.lower(), err


def test_faults_name_their_place(ctl):
    status, out, err = ctl("eval", input_text="[[0,0,0],[5,5,3]]\n[[1,1,1]]")
    assert (status, out) == (6, "") and "/designs/0/cells/1" in err, err
    status, _, err = ctl("eval --controller nobody", input_text=CELLS)
    assert status in (3, 6) and "nobody" in err, err
    status, _, err = ctl("eval --physics dt_s=7", input_text=CELLS)
    assert status == 6 and "/physics/dt_s" in err, err


def test_verify(ctl):
    evaluation = json.loads(ctl(f"eval {SHORT} --json", input_text=CELLS)[1])
    status, out, err = ctl(f"verify {SHORT} -", input_text=CELLS)
    assert status == 0 and "the same" in out, (out, err)
    status, out, err = ctl(f"verify --evaluation {evaluation['id']}")
    assert status == 0 and "1 the same, 0 different, 0 not stored" in out, (out, err)
    status, out, err = ctl(f"verify {SHORT} {evaluation['results'][0]['id']}")
    assert status == 0 and "the same" in out, (out, err)
    status, out, err = ctl("verify --physics n_steps=7 -", input_text=CELLS)
    assert status == 3 and "nothing" in err, (out, err)


def test_designs(ctl):
    identity = json.loads(ctl(f"eval {SHORT} --json", input_text=CELLS)[1])["results"][0]["id"]
    status, out, err = ctl(f"design show {identity}")
    assert status == 0 and identity in out and "██" in out and "z = 1" in out, (out, err)
    drawn = ctl(f"design show {identity}",
                LC_ALL="C")[1].count("##")  # once for each orientation that was scored
    assert drawn >= 4 and drawn % 4 == 0
    assert ctl(f"design show {'f' * 36}")[0] in (0, 3)
    assert ctl("design show xyz")[0] == 2
    status, out, _ = ctl("design list --all")
    assert status == 0 and identity in out
    assert json.loads(ctl(f"design show {identity} --json")[1])["id"] == identity
    ctl("eval",
        input_text=CELLS)  # the paper's test set with the default physics: what is sorted by score
    status, out, _ = ctl("design list --sort score --limit 1")
    assert status == 0 and len(out.splitlines()) == 2
    newest, oldest = (json.loads(ctl(f"design list --all --json --order {order}")[1])["items"]
                      for order in ("descending", "ascending"))
    assert newest == oldest[::-1] and len(newest) > 1


def test_made_bodies(ctl, tmp_path):
    """What these commands print, they and the others read."""
    status, random, _ = ctl("design random --count 6 --seed 3")
    assert status == 0 and len(random.splitlines()) == 6
    assert ctl("design random -n 2 --seed 3")[1] == "".join(random.splitlines(True)[:2])
    status, mutants, _ = ctl("design mutate --children 2 --rate 0.05", input_text=random)
    assert status == 0 and len({*random.splitlines(), *mutants.splitlines()}) == 18
    crossed = json.loads(ctl("design cross --json", input_text=random)[1])["items"]
    assert [item["parents"] for item in crossed] == [[0, 1], [2, 3], [4, 5]]
    assert ctl("design cross", input_text=CELLS + CELLS + CELLS)[0] == 2
    status, none, err = ctl("design cross", input_text=CELLS + CELLS)
    assert (status, none) == (0, "") and "/pairs/0: the parents are equal" in err
    ids = ctl("design canonical", input_text=CELLS)[1]
    torn = '{"cells": [[0, 0, 0], [5, 5, 3], [5, 5, 2]]}\n{"cells": [[7, 0, 0]]}\n'
    assert ctl("eval", input_text=ids + torn)[0] == 6
    rules = "--on-fault skip --repair largest"
    status, out, _ = ctl(f"eval {SHORT} {rules} --record com -o {tmp_path}", input_text=ids + torn)
    assert status == 0 and re.search("^2 .*skipped: outside the workspace", out, re.M), out
    assert len(list(tmp_path.glob("*.npy"))) == 20
    start = f"campaign start zero-shot - {rules} --population 4 --generations 0 --json"
    status, out, _ = ctl(start, input_text=torn)
    assert status == 0 and [row["place"] for row in json.loads(out)["founders"]] == [0, 1]


def test_jobs(ctl):
    status, out, _ = ctl("eval --no-wait --random 500 --seed 5 --label 'long one'")
    job = out.strip()
    assert status == 0 and job.isdigit()
    assert ctl(f"job pause {job}")[0] == 0
    assert "paused" in ctl(f"job show {job}")[1]
    assert any(line.split()[0] == job and "paused" in line
               for line in ctl("job list --state paused")[1].splitlines()[1:])
    assert [
        line.split()[0]
        for line in ctl("job list --label 'long one' --state paused")[1].splitlines()
    ] == ["job", job]
    assert ctl("job list -l 'long & two' --json")[1].startswith('{"items":[],')
    assert ctl(f"job weight {job} 2.5") == (0, f"job {job} has the weight 2.5\n", "")
    assert re.search(r"^weight +2.5$", ctl(f"job show {job}")[1], re.M)
    assert ctl(f"job weight {job} 0")[0] == 6 and ctl(f"job weight {job} 2x")[0] == 2
    assert ctl(f"job resume {job}")[0] == 0
    status, out, err = ctl(f"job cancel {job}")
    assert status == 0, err
    status, out, _ = ctl(f"watch {job}")
    assert status == 3 and "job.finished" in out and "cancelled" in out, out
    assert ctl(f"job cancel {job}")[0] == 3
    assert ctl("job show 999999")[0] == 3


def test_jobs_in_order(service, ctl):
    job = ctl(f"eval {SHORT} --random 2 --seed 3 --label 'tidy one' --experiment tidy --no-wait "
              "-q")[1].strip()
    assert ctl(f"wait {job}")[0] == 0

    def found(query):
        return [item["id"] for item in json.loads(ctl(f"job list {query} --json")[1])["items"]]

    assert found("--label 'tidy*'") == found("--experiment tidy") == [job]
    out = ctl(f"job note {job}", "a \x1b[31mred note")[1]
    assert out == f'job {job} has the note "a ?[31mred note"\n'
    shown = ctl(f"job show {job}")[1]
    assert re.search(r"^note +a \?\[31mred note$", shown, re.M) and "core time" in shown
    assert ctl(f"job label {job} new")[1] == f'job {job} has the label "new"\n'
    assert ctl(f"job note {job}")[1] == f"job {job} has no note\n"
    assert ctl(f"job archive {job}")[1] == f"job {job} is archived\n"
    assert found("--experiment tidy") == [] and found("--archived true --label new") == [job]
    assert ctl(f"job restore {job}")[0] == 0 and found("--label new") == [job]
    used = json.loads(ctl("usage --by experiment --json")[1])["items"]
    assert any(row["name"] == "tidy" and row["jobs"] == 1 for row in used)
    assert re.search(r"^tidy +1 ", ctl("usage --by experiment")[1], re.M)
    status, _, err = ctl(f"job delete {job}")
    assert status == 2 and f'evaluation {job} "new", succeeded' in err and "--yes" in err
    status, out, _ = ctl(f"job delete {job} --yes")
    assert (status, out) == (0, f"job {job} is deleted\n")
    assert ctl(f"job delete {job} -y")[0] == 3 and ctl("usage --by state")[0] == 2


def test_watch_a_job(ctl):
    job = ctl(f"eval {SHORT} --no-wait --random 20 --seed 6")[1].strip()
    status, out, err = ctl(f"watch {job}")
    assert status == 0, err
    kinds = [line.split()[2] for line in out.splitlines()]
    assert kinds[0] == "job.created" and kinds[-1] == "job.finished", out
    events = [json.loads(line) for line in ctl(f"watch {job} --json")[1].splitlines()]
    assert [int(e["id"]) for e in events] == sorted(int(e["id"]) for e in events)
    status, out, _ = ctl(f"job show {job} --results")
    assert status == 0 and "succeeded" in out and len(out.splitlines()) > 20


def test_controllers(service, ctl, tmp_path):
    assert re.search(r"^bootstrap +inverse_sqrt +620,912 +2,484,856 +20\d\d-",
                     ctl("controller list")[1], re.M)
    status, out, err = ctl(f"controller put mine {str(BOOTSTRAP)}")
    assert status == 0 and hashlib.sha256(BOOTSTRAP.read_bytes()).hexdigest() in out, err
    assert "620,912" in ctl("controller info mine")[1]
    copy = tmp_path / "copy.safetensors"
    assert ctl(f"controller get mine --output {str(copy)}")[0] == 0
    assert copy.read_bytes() == BOOTSTRAP.read_bytes()
    short = tmp_path / "short.safetensors"
    short.write_bytes(BOOTSTRAP.read_bytes()[:1000])
    assert ctl(f"controller put short {str(short)}")[0] == 6
    assert ctl("controller delete mine")[0] == 0
    assert ctl("controller info mine")[0] == 3


def test_trajectories(ctl, tmp_path):
    status, _, err = ctl(
        f"eval {SHORT} --record com,masses --record-stride 5 --output "
        f"{str(tmp_path / 'out')}",
        input_text=CELLS)
    assert status == 0, err
    files = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert len(files) == 1 + 2 * 10 and "design-0000-environment-09-masses.npy" in files
    content = (tmp_path / "out" / "design-0000-environment-00-com.npy").read_bytes()
    assert b"'shape': (5,3)" in content[:128]
    points = struct.unpack("<15f", content[128:])
    assert all(abs(p) < 10 for p in points) and points[2] > 0
    out = tmp_path / "channels"
    status, _, err = ctl(
        f"eval {SHORT} --record contacts,actuation --record-stride 1 --output", str(out),
        input_text=CELLS)
    assert status == 0, err
    for name, form in (("actuation", b"'|i1'"), ("contacts", b"'|u1'")):
        content = (out / f"design-0000-environment-03-{name}.npy").read_bytes()
        assert form in content[:128] and (len(content) - 128) % 21 == 0 and any(content[128:])
    status, _, err = ctl(f"eval {SHORT} --record pose", input_text=CELLS)
    assert status == 2 and "com, masses, actuation, contacts" in err


def test_environments_of_a_file(ctl, tmp_path):
    path = tmp_path / "environments.json"
    path.write_text(
        json.dumps([{"light_xy_m": [2.5, 4.5], "terrain_heights_m": [0.05] * 64}, {
            "light_xy_m": [4.0, 2.5], "terrain_sigma_m": 0.05, "seed": 3
        }]))
    status, out, err = ctl(f"eval {SHORT} --json --environments {str(path)}", input_text=CELLS)
    assert status == 0, err
    assert len(json.loads(out)["results"][0]["losses"]) == 2


def test_status(ctl):
    status, out, _ = ctl("status")
    assert status == 0 and re.search(r"^ready +yes", out, re.M), out
    assert json.loads(ctl("status --json")[1])["ready"] is True


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
    assert status == 0 and "Student t, 6 pairs" in out, (out, err)


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
    assert status == 6 and '/preset: must be "workstation", "phototaxis" or "paper"' in err, err
    status, _, err = ctl(f"train start finetune --random 1 --preset phototaxis {TINY}")
    assert status == 6 and "/preset: " in err, err
    status, out, _ = ctl("train start --help")
    assert status == 0 and "--preset workstation|phototaxis|paper" in out, out


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
    """What 24 lines of 80 columns show until all of `until_seen` came and Ctrl-C was pressed,
    without the escapes."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    watch = subprocess.Popen([MORPHOCTL, "--server", service.addresses[0], command, "watch", job],
                             stdin=slave,
                             stdout=slave,
                             stderr=slave,
                             env={**os.environ, "TERM": "xterm", "LC_ALL": "C.UTF-8"})
    os.close(slave)
    seen, until = b"", time.monotonic() + 60
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
    assert watch.wait(10) == 130
    view = re.sub(r"\x1b\[[0-9;]*[A-Za-z]", "", seen.decode(errors="replace").split(farewell)[0])
    assert all(len(line) <= 80 for line in re.split(r"[\r\n]+", view)), view
    return view


def test_watching_a_training_on_a_terminal(service, ctl):
    """The live view fits 80 columns with all its numbers; Ctrl-C leaves the training alone."""
    job = ctl("train start pretrain --steps 100000 --batch 2 --physics n_steps=20 "
              "--checkpoint-steps 50 --validation-designs 2")[1].strip()
    view = watch_on_a_terminal(service, "train", job, ("checkpoint of step", " left"),
                               "The training goes on.")
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
    campaign = re.match(r"campaign (\d+) is accepted: zero-shot, 6 designs, 3 generations", err)[1]
    told = service.request("GET", f"/v1/campaigns/{campaign}").json()
    assert told["label"] == "by hand" and told["settings"]["workspace"] == [5, 5, 3]
    assert told["settings"]["selection"] == {"kind": "tournament", "size": 2
                                             } and told["settings"]["initial"] != "random"
    assert json.loads(ctl(f"campaign show {campaign} --json")[1]) == told
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
        re.match(rf" {{21}}generation {i} of 5  mean ", line)
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
    """With the numbers of the definition; those that ended early are left out and named."""
    a, b = (ctl(f"campaign start zero-shot {SMALL} -n 2 --replicates 3 --seed {seed} -q")[1].split()
            for seed in (1, 11))
    assert ctl("wait", *a, *b)[0] == 0
    assert ctl(f"campaign extend {b[2]} 1000")[0] == 0 and ctl(f"job cancel {b[2]}")[0] == 0
    told = json.loads(ctl(f"campaign compare {a[1]} {b[0]} --json")[1])
    assert told["generation"] == 2 and [side["campaign"] for side in told["sides"]] == [a[1], b[0]]
    best = [[service.get(f"/v1/campaigns/{id}/generations")["items"][2]["score"]["quantiles"]["p0"]
             for id in group] for group in (a, b[:2])]
    means, other = [statistics.mean(values) for values in best], told["sides"][1]
    assert [side["best"] for side in told["sides"]] == pytest.approx(means, rel=1e-12)
    assert other["difference"] == pytest.approx(means[1] - means[0], rel=1e-12)
    assert other["low"] + other["high"] == pytest.approx(2 * other["difference"], rel=1e-9)
    assert other["replicates"] == b[1::-1] and other["left_out"] == [{"id": b[2],
                                                                      "state": "cancelled"}]
    status, out, _ = ctl(f"campaign compare {a[0]} {b[0]}")
    assert status == 0 and f"campaign {b[2]}, a replicate of {b[0]}: it was cancelled" in out
    assert "left out" in ctl(f"campaign export {b[0]} --replicates -")[2]
    out = ctl(f"campaign compare {a[0]} {a[1]}")[1]  # of one group: a campaign each
    assert "needs two replicates" in out
    assert ctl(f"campaign compare {a[0]} 999999")[0] == 3


def test_wait_over_a_restart(start, ctl, tmp_path):
    """The exit status is that of the jobs, also over a restart; then a command runs."""
    first = start(state=tmp_path)
    address, marks = first.addresses[0], tmp_path / "marks"
    job = ctl("campaign start zero-shot --preset demo -n 100000 -q", server=address)[1].strip()
    done = ctl(f"eval {SHORT} --random 3 --no-wait", server=address)[1].strip()
    assert ctl(f"wait {done} --run", "exit 5", server=address)[0] == 1
    command = [MORPHOCTL, "wait", done, job, "--server", address, "--run",
               f'echo "$MORPHOD_JOBS $MORPHOD_STATE" > {marks}']
    waiting = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert waiting.stdout.readline() == f"job {done} has succeeded\n"
    first.stop(signal.SIGKILL)
    again = start(state=tmp_path, listen=(address.removeprefix("http://"), ))
    assert waiting.poll() is None and again.act(job, "cancel").status == 200
    assert waiting.communicate(timeout=60)[0] == f"job {job} has been cancelled\n"
    assert waiting.returncode == 3 and marks.read_text() == f"{done} {job} cancelled\n"
    assert ctl("wait 999999", server=address)[0] == 3


def test_bundles(service, ctl, tmp_path):
    """By each word that names campaigns, and by one only."""
    path = str(tmp_path / "one.tar.zst")
    id = run(service, "campaigns", {
        "mode": "zero-shot", "population": 4, "generations": 1, "physics": {"n_steps": 20},
        "exclude_pretraining": False, "label": "to go", "experiment": "a bundle",
        "seed": 90})["id"]
    for which in ([id], ["--label", "to go"], ["--experiment", "a bundle"], ["--group", id]):
        status, _, err = ctl("bundle export", path, *which)
        assert status == 0, (which, err)
        status, out, err = ctl("bundle verify", path, "--json")
        assert status == 0 and [item["source"]["campaign"] for item in
                                json.loads(out)["items"]] == [id], (which, out, err)
    assert ctl("campaign champions", id, "-n", "2", "-o", str(tmp_path / "paths"))[0] == 0
    assert ctl("bundle export", path, id, "--recordings")[0] == 0
    assert "1 recorded evaluations" in ctl("bundle verify", path)[1]
    for which in ([], [id, "--label", "to go"], ["--experiment", "a bundle", "--group", id]):
        status, _, err = ctl("bundle export", path, *which)
        assert status == 2 and "--experiment or --group" in err, (which, err)


def test_scores(start, ctl, tmp_path):
    here, other, path = start(), start(), tmp_path / "scores"
    here.evaluate({"designs": [DESIGN], "physics": {"n_steps": 20}})
    there = {"server": other.addresses[0]}
    status, _, err = ctl("scores export", path, "--controller", "default", server=here.addresses[0])
    assert status == 0 and f"{path.stat().st_size} bytes" in err
    status, out, err = ctl("scores import", path, "--json", **there)
    entered = json.loads(out)
    assert status == 0 and entered["new"] > 0 == entered["known"], err
    status, out, _ = ctl("scores import", path, **there)
    assert status == 0 and f"0 rollouts are new, {entered['new']:,} were here, from store" in out
    data = path.read_bytes()
    for broken, words in ((data[:-1], "ends early, in the block at byte"), (b"", "ends early"),
                          (data[:5], "ends early"), (b"x" * 20, "no block of scores begins at"),
                          (data[:60] + b"x" + data[61:], "block at byte 0 was not entered")):
        path.write_bytes(broken)
        status, _, err = ctl("scores import", path, **there)
        assert status in (2, 6) and words in err, (words, err)
    path.write_bytes(lies(blocks(data)[0]))
    status, out, _ = ctl("scores import", path, **there)
    assert status == 3 and "1 are stored with other bits" in out and " 0.5 " in out
    assert ctl("scores export", path, "--since", "2120-01-01T00:00:00Z")[0] == 0
    assert "0 rollouts are new, 0 were here" in ctl("scores import", path, **there)[1]
    assert ctl("scores export", path, "--controller", "nobody")[0] == 3
    assert ctl("scores export", tmp_path / "no" / "folder")[0] == 1
    assert ctl("scores import", tmp_path / "none")[0] == 2


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
                             ], "id of a job"), (["extend", "1", "none"], "further generations"), ([
                                 "export", "1"
                             ], "what is to be exported"), ([
                                 "champions", "1", "-o", "x", "--generation", "0"
                             ], "newest")):
        status, _, err = ctl("campaign", *arguments)
        assert status == 2 and words in err, (arguments, err)
    assert ctl("campaign show 999999")[0] == 3 and ctl("campaign extend 999999 1")[0] == 3


def test_watching_a_campaign_on_a_terminal(service, ctl):
    """The live view fits 80 columns and 24 lines; Ctrl-C leaves the campaign alone."""
    job = ctl(f"campaign start zero-shot {SMALL} -n 100000 -q")[1].strip()
    view = watch_on_a_terminal(service, "campaign", job,
                               ("voxels", "Ctrl-C leaves", " left", "running  generation "),
                               "The campaign goes on.")
    assert re.search(r"zero-shot  running  generation [\d,]+ of 100,000   campaign",
                     view) and re.search(r"diversity +0\.\d{4}  ", view), view
    assert service.request("GET", f"/v1/campaigns/{job}").json()["state"] == "running"
    assert ctl(f"campaign pause {job}")[0] == 0 and re.search(r"^state +paused$",
                                                              ctl(f"campaign show {job}")[1], re.M)
    assert ctl(f"campaign resume {job}")[0] == 0 and ctl(f"campaign cancel {job}")[0] == 0 and ctl(
        "campaign "
        "watch "
        f"{job}")[0] == 3


def test_help_of_a_command(ctl):
    for words in (["campaign", "extend"], ["status"]):
        status, out, err = ctl("help", *words)
        assert status == 0 and err == "" and out.startswith("Usage: morphoctl " + " ".join(words))
        assert out == ctl(*words, "--help")[1]
    assert ctl("help")[1] == ctl("--help")[1]
    status, out, err = ctl("help campain")
    assert status == 2 and out == "" and "campain" in err


def test_unix_socket_and_token(start, ctl, tmp_path):
    tokens = tmp_path / "tokens"
    tokens.write_text("a-token-of-some-length\n")
    tokens.chmod(0o600)
    path = tmp_path / "s"
    service = start(f"--token-file={tokens}",
                    "--token-on-loopback=yes",
                    listen=("127.0.0.1:0", f"unix:{path}"),
                    token="a-token-of-some-length")
    tcp = next(a for a in service.addresses if a.startswith("http"))
    assert ctl("job list", server=tcp)[0] == 5
    assert ctl("job list", server=tcp, MORPHOD_TOKEN="another-token-altogether")[0] == 5
    assert ctl(f"job list --token-file {str(tokens)}", server=tcp)[0] == 0
    assert ctl("job list", server=f"unix:{path}")[0] == 0


def test_a_token_by_its_name(start, ctl, tmp_path):
    """A file of several asks whose token to use, and says no token itself."""
    tokens = tmp_path / "tokens"
    tokens.write_text("# who\nanna\tread  the-token-of-anna-here\n\n"
                      "ben submit the-token-of-ben-here # new\n")
    tokens.chmod(0o600)
    service = start(f"--token-file={tokens}", "--token-on-loopback=yes",
                    token="the-token-of-anna-here")
    server, given = service.addresses[0], f"--token-file {tokens}"
    status, _, err = ctl(f"job list {given}", server=server)
    assert status == 2 and '"anna"' in err and '"ben"' in err and "--token-name" in err
    assert "the-token" not in err
    assert ctl(f"job list {given} --token-name carl", server=server)[0] == 2
    assert ctl("job list --token-name ben", server=server)[0] == 2
    work = f"eval {SHORT} --no-wait"
    status, _, err = ctl(f"{work} {given} --token-name anna", server=server, input_text=CELLS)
    assert status == 5 and '"submit"' in err and '"anna"' in err
    assert ctl(f"{work} {given} --token-name ben", server=server, input_text=CELLS)[0] == 0
    for name, n in (("ben", 1), ("anna", 0)):
        listed = ctl(f"job list --json --submitted-by {name} {given} --token-name anna",
                     server=server)[1]
        assert len(json.loads(listed)["items"]) == n
