"""morphoctl with a real daemon. tests/unit/morphoctl tests its behavior with servers that
misbehave."""

import hashlib
import json
import os
import re
import signal
import struct
import subprocess

import pytest
from archives import blocks, lies
from ctl import CELLS, MORPHOCTL, SHORT, ctl  # noqa: F401
from service import BOOTSTRAP, DESIGN, SOURCE, run

PLAIN = SOURCE / "data" / "controllers" / "bootstrap.safetensors"  # without a control period


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
            rf"\s*\d+\s+{name}\s+[0-9a-f]{{36}}@[0-7]\s+\d+"
            r"\s+\d+\.\d{4}\s+\d+\.\d{4}\s+\d+\.\d{4}", line), line


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
    assert "waiting for batch 0" in ctl(f"campaign show {id}")[1]
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
    reported = json.loads(out)
    assert [row["child"] for row in reported["children"]] == [0, 2]
    assert reported["children"][0]["operator"] == "mine" and reported["notes"][0]["place"] == 1
    lines = ctl(f"study ask {id} 4 --parents 3,8")[1].splitlines()
    assert {number for line in lines for number in json.loads(line)["parents"]} <= {3, 8}
    for wrong, given, status in (("--survivors 1,x", "", 2), ("", "{", 2), ("", "[1]", 6)):
        assert ctl(f"study tell {id} {wrong}", input_text=given)[0] == status, wrong
    assert ctl(f"study finish {id}")[1] == f"study {id} is succeeded, with 10 designs\n"
    assert ctl(f"study sampler {id}")[0] == 3


def test_a_study_with_an_own_score(ctl):
    start = "campaign start study --population 2 -q"
    status, out, err = ctl(f"{start} --own-score cost --own-score-unit J/m {SHORT}")
    assert status == 0, err
    id, plain = out.strip(), ctl(f"{start} {SHORT}")[1].strip()
    scored = [{"body": DESIGN, "score": -1.5}, {"body": {"cells": [[2, 2, 0]]}, "score": 250}]
    out = ctl(f"study tell {id}", input_text=json.dumps(scored))[1].splitlines()
    assert [line.split()[-1] for line in out[1:]] == ["-1.5000", "250.0000"]
    assert "cost in J/m, from the study's client" in ctl(f"campaign show {id}")[1]
    assert "own score" not in ctl(f"campaign show {plain}")[1]
    status, _, err = ctl(f"study tell {id}", input_text=json.dumps(DESIGN))
    assert status == 6 and "/children/0/score" in err, err
    assert ctl(f"study tell {plain}", input_text=json.dumps(DESIGN))[0] == 0
    status, _, err = ctl(f"campaign compare {id} {plain}")
    assert status == 3 and "have different settings for own_score" in err, err


def test_a_study_by_its_name(ctl):
    start = "campaign start study --label 'by name' --if-exists return -q"
    status, out, err = ctl(f"{start} --population 20 {SHORT}")
    assert status == 0 and ctl(start)[:2] == (0, out), err
    status, none, err = ctl(f"{start} --population 21 --physics n_steps=500")
    assert (status, none) == (3, ""), err
    assert "/population: got 21, but study" in err and "/physics/n_steps: got 500" in err


def test_founders_that_do_not_fit_are_counted(ctl):
    cube = json.dumps({"cells": [[x, y, z] for x in range(3) for y in range(3) for z in range(3)]})
    start = f"campaign start zero-shot --no-exclusions --generations 0 {SHORT}"
    parent = ctl(f"{start} - --population 2 -q", input_text=CELLS + cube)[1].strip()
    assert ctl(f"wait {parent}")[0] == 0
    status, out, err = ctl(f"{start} --population 4 --from {parent} --workspace 3,3,2")
    assert status == 0 and "1 of the initial designs is left out" in err, err
    assert f"design 1 of campaign {parent} does not fit the workspace of 3 × 3 × 2" in err
    status, out, err = ctl(f"{start} --population 4 --from {parent} --workspace 1,1,1")
    assert (status, out) == (6, "") and "no design of that campaign fits" in err, err


def test_the_same_key_is_the_same_evaluation(ctl):
    ids = {
        json.loads(ctl(f"eval {SHORT} --json --idempotency-key once", input_text=CELLS)[1])["id"]
        for _ in range(2)
    }
    assert len(ids) == 1
    status, _, err = ctl(f"eval {SHORT} --idempotency-key once", input_text='[[0,0,0]]')
    assert status == 6 and "key" in err.lower(), err


def test_one_is_singular(ctl, service):
    world = json.dumps([{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}])
    said = ctl(f"eval {SHORT} --environments -", *["80" + "0" * 34], input_text=world)[2]
    assert ": 1 rollout, " in said, said
    said = ctl(f"campaign start zero-shot --population 2 --generations 1 {SHORT}")[2]
    assert ": zero-shot, 2 designs, 1 generation;" in said, said
    id = ctl(f"train start finetune {'80' + '0' * 34} --steps 1 --batch 1 {SHORT}")
    assert ": 1 step of 1 robot;" in id[2], id
    work = [re.search(r"1 (\w+) ", line)[1]
            for line in ctl("job list --limit 3")[1].splitlines()[1:]]
    assert sorted(work) == ["generation", "rollout", "step"], work
    service.act(id[1].strip(), "cancel")


def test_faults_name_their_place(ctl):
    status, out, err = ctl("eval", input_text="[[0,0,0],[5,5,3]]\n[[1,1,1]]")
    assert (status, out) == (6, "") and "/designs/0/cells/1" in err, err
    status, _, err = ctl("eval --controller nobody", input_text=CELLS)
    assert status in (3, 6) and "nobody" in err, err
    status, _, err = ctl("eval --physics dt_s=7", input_text=CELLS)
    assert status == 6 and "/physics/dt_s" in err, err
    status, _, err = ctl("eval -p integrator=euler", input_text=CELLS)
    assert status == 6 and "/physics/integrator" in err and '"split"' in err, err


@pytest.mark.parametrize("given, shown", [
    ("", "integrator split, impact exact, outputs held for 0.016 s"),
    ("-p integrator=paper", "integrator paper, impact exact, outputs held for 0.016 s"),
    ("-p integrator=split -p control_period_s=0.008",
     "integrator split, impact exact, outputs held for 0.008 s"),
    ("-p impact=bisection9 --controller plain", "integrator split, impact bisection9"),
])
def test_a_job_shows_its_physics(service, ctl, given, shown):
    if "plain" in given:
        service.upload("plain", PLAIN.read_bytes())
    job = json.loads(ctl(f"eval {SHORT} {given} --json", input_text=CELLS)[1])["id"]
    facts = ctl(f"job show {job}")[1]
    assert re.search(f"^physics +20 steps of 0.002 s, {shown}$", facts, re.M), facts


def test_physics_of_the_paper(ctl):
    value = json.loads(ctl("eval -p paper --json", input_text=CELLS)[1])
    assert [value["physics"][name] for name in ("integrator", "dt_s", "n_steps")] == [
        "paper", 0.004, 1000]
    for given, said in (("-p paper -p n_steps=20", "sets everything"),
                        ("-p Paper", "must be paper or KEY=VALUE")):
        status, out, err = ctl(f"eval {given}", input_text=CELLS)
        assert (status, out) == (2, "") and said in err, err


@pytest.mark.parametrize("text, said", [
    ("[[0,3,3],[1,1,0],[4,0,0]]", 'cells [x, y, z] or EvoGym rows: write {"cells": [...]}'),
    ("[[3,3,3],[3,3,3]]", "EvoGym rows"),
    (json.dumps([[4, 4, 4]] * 200), "EvoGym rows"),
    ("[[3,3,0,3],[1,1,0,1]]", "morphod.read_bodies in the Python package"),
    ("[[[3,3],[4,0]],[[0,0],[1,2]]]", "morphod.read_bodies in the Python package"),
    ('{"grid_width": 9, "grid_height": 9, "objects": {}}', "an EvoGym world is not a design"),
    ("<VXD></VXD>", "morphod.read_bodies in the Python package"),
])
def test_bodies_of_other_programs_are_refused(ctl, text, said):
    status, out, err = ctl(f"eval {SHORT} --repair largest", input_text=text)
    assert (status, out) == (2, "") and said in err, err


def test_lists_of_cells_are_read(ctl):
    """Cells in one piece, in any order. Cells with a name, and cells that cannot be a robot, may be
    in several pieces."""
    for text in ("[[2,2,0],[3,2,0]]", "[[3,3,1],[1,3,1],[2,3,1]]", "[[4,4,3]]",
                 '{"cells": [[0,3,3],[1,1,0],[4,0,0]]}', "[[0,0,0],[1,0,0],[4,0,0]]",
                 "[[5,3,3],[1,1,0]]"):
        status, _, err = ctl(f"eval {SHORT} --repair largest", input_text=text)
        assert status == 0, err


def test_verify(ctl):
    evaluation = json.loads(ctl(f"eval {SHORT} --json", input_text=CELLS)[1])
    status, out, err = ctl(f"verify {SHORT} -", input_text=CELLS)
    assert status == 0 and "the same" in out, (out, err)
    status, out, err = ctl(f"verify --evaluation {evaluation['id']}")
    assert status == 0 and "1 the same, 0 different, 0 not stored" in out, (out, err)
    status, out, err = ctl(f"verify {SHORT} {evaluation['results'][0]['id']}")
    assert status == 0 and "the same" in out, (out, err)
    status, out, err = ctl("verify --physics n_steps=7 -", input_text=CELLS)
    assert status == 3 and "no stored scores" in err, (out, err)


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
        input_text=CELLS)  # the paper's test set with the default physics: can be sorted by score
    status, out, _ = ctl("design list --sort score --limit 1")
    assert status == 0 and len(out.splitlines()) == 2
    newest, oldest = (json.loads(ctl(f"design list --all --json --order {order}")[1])["items"]
                      for order in ("descending", "ascending"))
    assert newest == oldest[::-1] and len(newest) > 1


def test_made_bodies(ctl, tmp_path):
    """All commands can read the output of these commands."""
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
    assert ctl(f"job weight {job} 2.5") == (0, f"job {job} now has weight 2.5\n", "")
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
    assert ctl(f"job note {job}")[1] == "a ?[31mred note\n"
    assert ctl(f"job label {job}")[1] == "new\n"
    assert ctl(f"job note {job} --remove x")[0] == 2
    assert ctl(f"job note {job} --remove")[1] == f"job {job} has no note\n"
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
    kinds = [line.split()[3] for line in out.splitlines()]
    assert kinds[0] == "job.created" and kinds[-1] == "job.finished", out
    events = [json.loads(line) for line in ctl(f"watch {job} --json")[1].splitlines()]
    assert [int(e["id"]) for e in events] == sorted(int(e["id"]) for e in events)
    status, out, _ = ctl(f"job show {job} --results")
    assert status == 0 and "succeeded" in out and len(out.splitlines()) > 20


def test_controllers(service, ctl, tmp_path):
    assert re.search(rf"^bootstrap +inverse_sqrt +620,912 +{BOOTSTRAP.stat().st_size:,} +20\d\d-",
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
        "eval -p n_steps=50 --record contacts,actuation --record-stride 1 --output", str(out),
        input_text=CELLS)
    assert status == 0, err
    for name, form in (("actuation", b"'|i1'"), ("contacts", b"'|u1'")):
        content = (out / f"design-0000-environment-03-{name}.npy").read_bytes()
        assert form in content[:128] and (len(content) - 128) % 51 == 0 and any(content[128:])
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


def test_a_task_by_its_name(ctl):
    """--task TASK is short for the set of the suite."""
    one, other = (ctl(f"eval {SHORT} --json {where}", input_text=CELLS)
                  for where in ("-t walk", "-e morpho-12-walk"))
    one, other = json.loads(one[1]), json.loads(other[1])
    assert one["environments"] == "morpho-12-walk" and one["results"] == other["results"]
    status, _, err = ctl(f"eval {SHORT} --task walk -e paper-test", input_text=CELLS)
    assert status == 2 and "--task or --environments, not both" in err
    status, _, err = ctl(f"eval {SHORT} --task climb", input_text=CELLS)
    assert status == 2 and "photo, photo-auc, walk, rough" in err and "damage" in err
    status, out, err = ctl("campaign start zero-shot --task up --population 4 --generations 0 "
                           f"{SHORT} --json --no-exclusions")
    assert status == 0, err
    assert json.loads(out)["settings"]["environments"] == "morpho-12-up"


def test_status(ctl):
    status, out, _ = ctl("status")
    assert status == 0 and re.search(r"^ready +yes", out, re.M), out
    assert json.loads(ctl("status --json")[1])["ready"] is True


def test_wait_over_a_restart(start, ctl, tmp_path):
    """The exit status reflects the jobs, also across a restart. Then a command runs."""
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
    assert waiting.communicate(timeout=300)[0] == f"job {job} has been cancelled\n"
    assert waiting.returncode == 3 and marks.read_text() == f"{done} {job} cancelled\n"
    assert ctl("wait 999999", server=address)[0] == 3


def test_bundles(service, ctl, tmp_path):
    """Exports by each option that selects campaigns, but only one of them at a time."""
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
    assert "1 recorded evaluation;" in ctl("bundle verify", path)[1]
    for which in ([], [id, "--label", "to go"], ["--experiment", "a bundle", "--group", id]):
        status, _, err = ctl("bundle export", path, *which)
        assert status == 2 and "--group" in err, (which, err)


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
    assert status == 0 and f"0 rollouts are new, {entered['new']:,} were known, from store" in out
    data = path.read_bytes()
    for broken, words in ((data[:-1], "ends early, in the block at byte"), (b"", "ends early"),
                          (data[:5], "ends early"), (b"x" * 20, "no block of scores begins at"),
                          (data[:60] + b"x" + data[61:], "block at byte 0 was not imported")):
        path.write_bytes(broken)
        status, _, err = ctl("scores import", path, **there)
        assert status in (2, 6) and words in err, (words, err)
    path.write_bytes(lies(blocks(data)[0]))
    status, out, _ = ctl("scores import", path, **there)
    assert status == 3 and "1 are stored with different bits" in out and " 0.5 " in out
    assert ctl("scores export", path, "--since", "2120-01-01T00:00:00Z")[0] == 0
    assert "0 rollouts are new, 0 were known" in ctl("scores import", path, **there)[1]
    assert ctl("scores export", path, "--controller", "nobody")[0] == 3
    assert ctl("scores export", tmp_path / "no" / "folder")[0] == 1
    assert ctl("scores import", tmp_path / "none")[0] == 2


def test_help_of_a_command(ctl):
    for words in (["campaign", "extend"], ["status"]):
        status, out, err = ctl("help", *words)
        assert status == 0 and err == "" and out.startswith("Usage: morphoctl " + " ".join(words))
        assert out == ctl(*words, "--help")[1]
    assert ctl("help")[1] == ctl("--help")[1]
    for word in ("--help", "-h"):  # of a group of commands
        status, out, err = ctl("campaign", word)
        assert status == 0 and err == "" and out.startswith("  morphoctl campaign start "), out
    status, out, err = ctl("campaign nosuch")
    assert status == 2 and out == "" and "campaign has no command nosuch; the commands are" in err
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
    """With a file of several tokens, it asks for a name, and shows none of the tokens."""
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
