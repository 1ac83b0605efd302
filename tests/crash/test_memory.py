"""Little memory: every request ends, waits with a reason, or is refused with the numbers, and the
service is not killed. A job that gets it killed anyway fails after three attempts."""
import ctypes
import json
import pathlib
import re
import struct
import signal
import time

import pytest
from daemon import CONTROLLER, ENDED, PATIENCE_S, REPOSITORY, Daemon, bodies

PRETRAINED = REPOSITORY / "data" / "controllers" / "phototaxis.safetensors"
LIMIT = 256 << 20
FULL = {"voxels": "1" * 144}


@pytest.fixture
def cgroup():
    """A cgroup of 256 MiB, below the current one. Skips the test if it cannot be made."""
    lines = [
        line.split(":", 2) for line in pathlib.Path("/proc/self/cgroup").read_text().splitlines()
    ]
    roots = {
        "": ("/sys/fs/cgroup", "memory.max", "memory.swap.max"),
        "memory": ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", None)
    }
    for _, controllers, path in sorted(lines, key=lambda line: line[1] != "memory"):
        if controllers not in roots:
            continue
        root, limit, swap = roots[controllers]
        folder = pathlib.Path(root + path) / "morphod-test"
        try:
            folder.mkdir()
        except OSError:
            continue
        try:
            (folder / limit).write_text(str(LIMIT))
            if swap is not None:
                (folder / swap).write_text("0")
        except OSError:
            folder.rmdir()
            continue
        yield folder
        for _ in range(100):
            try:
                folder.rmdir()
                return
            except OSError:
                time.sleep(0.1)
        return
    pytest.skip("no memory cgroup can be made here")


class Small(Daemon):
    """A daemon inside the cgroup."""
    def __init__(self, folder, cgroup, **settings):
        super().__init__(folder, **settings)
        self.cgroup = cgroup

    def command(self, *more):
        script = f'echo $$ > {self.cgroup}/cgroup.procs && exec "$@"'
        return ["sh", "-c", script, "sh", *super().command(*more)]


def saying(content, **said):
    """Returns the file of a controller with more metadata."""
    size = struct.unpack("<Q", content[:8])[0]
    header = json.loads(content[8:8 + size])
    header["__metadata__"].update({f"morphod.{key}": value for key, value in said.items()})
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + content[8 + size:]


def test_small_memory(folder, cgroup):
    """A matrix of jobs, one by one and all at once, where a default campaign would need more than
    the available memory."""
    with Small(f"{folder}/one", cgroup, workers=2) as one:
        def end(job):
            now = one.awaited(job, lambda now: now["state"] in ENDED, 300, 0.1)
            assert now["state"] == "succeeded" and now["attempts"] == 0, now

        def submit(kind, request):
            return f"/v1/{kind}/{one.submit(request, kind)}"

        one.put("pretrained", PRETRAINED.read_bytes())
        one.put("absurd", saying(CONTROLLER.read_bytes(), kind="pretrain", parent="random",
                                 seed="1", step="1000000", settings='{"batch":268}'))
        campaign = {
            "mode": "zero-shot", "population": 8, "generations": 3, "seed": 1,
            "physics": {"n_steps": 50}
        }
        drawless = campaign | {"exclude_pretraining": False}
        for name, least in (("pretrained", 256), ("absurd", 4000)):
            reply = one.send("/v1/campaigns", campaign | {"controller": name})
            assert reply.status_code == 422, reply.text
            assert "exclude_pretraining false" in reply.text and "max_memory" in reply.text
            needs, _, free = map(int, re.findall(r"(\d+) MiB", reply.json()["detail"]))
            assert needs > least and free < 256
            end(submit("campaigns", drawless | {"controller": name}))
        huge = one.send("/v1/trainings", {"kind": "pretrain", "steps": 30000, "batch": 8192})
        assert huge.status_code == 422, huge.text
        assert re.search(r"needs \d+ MiB .* can use only \d+ MiB", huge.text), huge.text
        jobs = [
            ("trainings", {"kind": "pretrain", "steps": 2, "batch": 32, "physics": "paper",
                           "validation": {"every_steps": 0}}),
            ("trainings", {"kind": "finetune", "designs": [FULL, *bodies(1, 200)], "steps": 2,
                           "batch": 32, "physics": {"n_steps": 300}}),
            ("campaigns", drawless | {"mode": "few-shot", "population": 32, "generations": 1,
                                      "learning": {"parent_steps": 1, "child_steps": 1}}),
            ("campaigns", drawless | {"population": 2000, "generations": 2,
                                      "physics": {"n_steps": 5}}),
            ("evaluations", {"designs": bodies(2, 10000), "physics": {"n_steps": 1},
                             "priority": "batch"}),
            ("evaluations", {"designs": [FULL], "record": ["masses"], "record_stride": 1,
                             "physics": {"n_steps": 1000}})
        ]
        for kind, request in jobs:
            end(submit(kind, request))
        again = [submit(kind, request | ({"verify": True} if kind == "evaluations" else
                                         {"seed": 2})) for kind, request in jobs]
        for job in again:
            end(job)
        assert one.stop()[0] == 0


def test_killed_repeatedly(daemon):
    """A campaign fails with an explanation if the process is killed three times while it draws
    bodies. A power cut does not count."""
    one = daemon("one").start()
    one.put("pretrained", PRETRAINED.read_bytes())
    job = one.submit({"mode": "zero-shot", "population": 8, "generations": 1,
                      "controller": "pretrained"}, "campaigns")
    path = f"/v1/campaigns/{job}"

    def await_running():
        one.awaited(path, lambda now: now["state"] == "running")

    await_running()
    one.kill()
    (one.state / "crash-marker").write_text("boot 00000000-0000-0000-0000-000000000000\n")
    one.start()
    assert one.json(path)["attempts"] == 0
    # A fault outside any job, in the main thread, is not counted against a job.
    await_running()
    ctypes.CDLL(None).tgkill(one.process.pid, one.process.pid, signal.SIGSEGV)
    one.process.wait(PATIENCE_S)
    one.start()
    assert one.json(path)["attempts"] == 0
    for attempts in (1, 2, 3):
        await_running()
        one.kill()
        one.start()
        assert one.json(path)["attempts"] == attempts
    now = one.json(path)
    assert now["state"] == "failed", now
    assert "killed while it ran this job" in now["error"]["detail"], now
    # A user may try again; an orderly stop does not count.
    one.act(job, "resume")
    await_running()
    assert one.stop()[0] == 0
    one.start()
    now = one.json(path)
    assert now["attempts"] == 0 and now["state"] in ("queued", "running")
    one.stop()


@pytest.mark.parametrize("kind, request_of, done", [
    ("campaigns", {"mode": "zero-shot", "preset": "workstation", "physics": "paper",
                   "exclude_pretraining": False},
     lambda now: now["progress"]["done"]),
    ("trainings", {"kind": "pretrain", "preset": "phototaxis", "batch": 8,
                   "physics": {"n_steps": 100}}, lambda now: now["progress"]["step"])])
def test_kills_of_a_healthy_job(daemon, kind, request_of, done):
    """Killed five times within the first generation, or before the first checkpoint is due, a job
    continues from its saved state: it does not fail."""
    one = daemon("one", workers=1).start()
    job = one.submit(request_of, kind)
    path = f"/v1/{kind}/{job}"
    reached = 0
    for _ in range(5):
        begin = time.monotonic()
        one.awaited(path, lambda now: now["state"] == "running" and done(now) > reached and
                    time.monotonic() - begin > 4)
        one.kill()
        one.start()
        now = one.json(path)
        assert now["state"] in ("queued", "running") and now["attempts"] <= 1, now
        reached = done(one.awaited(path, lambda now: now["phase"] in ("learning", "scoring")))
    assert reached > 0
    one.act(job, "cancel")
    one.stop()
