"""A daemon for a benchmark: it is started on a free port, used over HTTP and shut down cleanly, and
its state folder is kept.

Also provides a deadline (--limit-s, SIGTERM, SIGINT, SIGHUP) for benchmarks that may be
interrupted. It is checked only between two waits, so that a stop always finds the daemon and the
files in a consistent state."""
import argparse
import ctypes
import hashlib
import json
import math
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from datetime import datetime
from pathlib import Path

import records

SOURCE = Path(__file__).resolve().parents[1]
SHIPPED = SOURCE / "data" / "controllers" / "phototaxis-16ms.safetensors"
OF_PAPER = SHIPPED.with_name("phototaxis.safetensors")  # for the paper's physics
PR_SET_PDEATHSIG = 1
CUT_OFF = 3  # exit status: time is up; call again to continue
ENDED = ("succeeded", "failed", "cancelled")


SEEDS = ("--seeds", lambda text: [int(seed) for seed in text.split(",")], [1, 2, 3],
         "default 1,2,3")
ABOVE_BOUND = (("--rule", ("clip", "restart"), "clip", "above the bound (default clip)"),
               ("--restart-weight", float, 3.0,
                "weight of a restarted adjoint, with --rule restart (default 3)"))
ROLLOUT_STEPS = ("--rollout-steps", int, 1000,
                 "steps of 4 ms of a rollout, for trials (default 1000)")
LIMIT = ("--limit-s", float, None,
         "shut down the daemon after this many seconds and exit with 3; call again to continue")
DAEMON = (("--build", Path, Path("build"), "folder of the build (default build)"),
          ("--morphod", Path, None, "the daemon itself (default: that of the build)"),
          ("--module", Path, None, "module that computes on GPUs (default: morphod-cuda.so next to "
           "the build's daemon, if it exists)"),
          ("--devices", str, "auto", "GPUs, as morphod's --devices (default auto)"),
          ("--device", ("auto", "cpu", "cuda"), "auto", "what computes the jobs (default auto)"),
          ("--workers", int, None, "threads of the processors (default: one per processor)"))


def add_options(parser, *rows):
    """Adds options. A row has a name; a type, the allowed words, or bool for an option without a
    value; a default; and a help text."""
    for name, kind, usual, text in rows:
        if kind is bool:
            parser.add_argument(name, action="store_true", help=text)
        elif callable(kind):
            parser.add_argument(name, type=kind, default=usual, help=text)
        else:
            parser.add_argument(name, choices=kind, default=usual, help=text)


def range_of(text):
    """Returns the name and the range of NAME=LOW:HIGH."""
    name, _, ends = text.partition("=")
    low, _, high = ends.partition(":")
    try:
        return name, [float(low), float(high)]
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=LOW:HIGH") from error


def add_vary(parser, text):
    parser.add_argument("--vary", type=range_of, action="append", metavar="NAME=LOW:HIGH",
                        help=text)


def parser_of(benchmark, description):
    """Returns a parser with the options of the daemon: where it is and where it keeps its state."""
    parser = argparse.ArgumentParser(prog=f"tools/bench {benchmark}",
                                     description=description,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    state = f".morphod/bench-{benchmark}"
    add_options(parser.add_argument_group("the daemon"), *DAEMON,
                ("--state", Path, Path(state),
                 f"folder that is kept between calls (default {state})"))
    return parser


def cut_off():
    print("time is up: the daemon was shut down; call again to continue", file=sys.stderr)
    return CUT_OFF


def ended_well(kind, job):
    """Returns whether a job has succeeded. A job that failed or was stopped ends the program."""
    if job["state"] in ("failed", "cancelled", "paused"):
        sys.exit(f"{kind} {job['id']} {job['state']}: "
                 f"{job['error'] or job.get('reason') or 'on request'}")
    return job["state"] == "succeeded"


def report(arguments, name, texts, draw, table):
    """Draws the rows of --csv as --svg, prints their tables, and puts these into --markdown between
    the markers `name`. texts: columns that are text."""
    rows = records.read(arguments.csv, texts)
    if not rows:
        sys.exit(f"{arguments.csv} has no rows")
    draw(rows, arguments.svg)
    print(table(rows))
    if arguments.markdown:
        records.put_between(arguments.markdown, name, table(rows))


class Deadline:
    """When to stop: after `seconds` (None: never), or after a signal."""
    def __init__(self, seconds=None):
        self.end = math.inf if seconds is None else time.monotonic() + seconds
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            if signal.getsignal(number) != signal.SIG_IGN:  # nohup
                signal.signal(number, self.stop)

    def stop(self, *_):
        self.end = -math.inf

    def is_over(self):
        return time.monotonic() >= self.end

    def wait_s(self, most=5):
        """Returns the whole seconds that one request may wait."""
        return math.ceil(min(most, max(1, self.end - time.monotonic())))


class Daemon:
    """A daemon that keeps its state from one call to the next."""
    def __init__(self, program, state, *flags):
        state.mkdir(parents=True, exist_ok=True)
        self.jobs = state / "jobs.json"
        address = state / "address"
        address.unlink(missing_ok=True)
        self.log = open(state / "log", "a", encoding="utf-8")
        prctl = ctypes.CDLL(None).prctl
        self.process = subprocess.Popen([
            program, f"--state-dir={state / 'state'}", "--listen=127.0.0.1:0",
            f"--port-file={address}", f"--default-controller={SHIPPED}", *flags
        ],
                                        stdout=subprocess.DEVNULL,
                                        stderr=self.log,
                                        process_group=0,
                                        preexec_fn=lambda: prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
                                        )  # stops with the benchmark, even if that is killed
        self.address = None
        try:
            self.start(address)
        except BaseException:
            self.stop()
            raise

    def start(self, address):
        """Waits until the daemon accepts work."""
        for _ in range(600):
            if address.exists() and address.read_text().strip():
                self.address = address.read_text().split()[0]
                if json.loads(self.fetch("/readyz", refused=503)).get("status") == "ready":
                    return
            if self.process.poll() is not None:
                sys.exit(f"morphod did not start: see {self.log.name}")
            time.sleep(0.1)
        sys.exit(f"morphod was not ready in a minute: see {self.log.name}")

    @classmethod
    def of(cls, arguments, *flags):
        """Starts a daemon according to the options of parser_of."""
        program = arguments.morphod or arguments.build / "src/daemon/morphod"
        module = arguments.module or arguments.build / "src/compute/cuda/morphod-cuda.so"
        if arguments.module and not module.exists():
            sys.exit(f"module {module} not found")
        if not program.exists():
            sys.exit(f"program {program} not found: build it, or specify another one with "
                     "--morphod or --build")
        given = [f"--devices={arguments.devices}"
                 ] + ([f"--compute-module={module.resolve()}"] if module.exists() else [])
        given += [f"--workers={arguments.workers}"] if arguments.workers else []
        return cls(program.resolve(), arguments.state, *given, *flags)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()

    def fetch(self, path, data=None, headers=None, method=None, refused=None):
        """Returns the bytes of a reply. A refusal, except one with the status `refused`, ends the
        program with the message of the daemon."""
        request = urllib.request.Request(self.address + path, data, headers or {}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=120) as reply:
                return reply.read()
        except urllib.error.HTTPError as error:
            if error.code == refused:
                return error.read()
            sys.exit(
                f"{request.get_method()} {path}: {error.code} "
                f"{error.read().decode(errors='replace')}"
            )

    def call(self, path, body=None, headers=None, method=None):
        """Sends and receives JSON."""
        data = None if body is None else json.dumps(body).encode()
        return json.loads(
            self.fetch(path, data, {"Content-Type": "application/json", **(headers or {})}, method))

    def job_of(self, kind, body, key):
        """Returns the job with a key, and submits it if it does not exist yet. The daemon forgets a
        key after a day; here it is kept as long as the job."""
        jobs = json.loads(self.jobs.read_text()) if self.jobs.exists() else {}
        if key in jobs:
            job = json.loads(self.fetch(f"/v1/{kind}/{jobs[key]['id']}", refused=404))
            if job.get("created_at"
                       ) == jobs[key]["created_at"]:  # else the daemon's state was deleted
                return job
        job = self.call(f"/v1/{kind}", body, {"Idempotency-Key": key})
        records.replace(
            self.jobs,
            json.dumps({**jobs, key: {"id": job["id"], "created_at": job["created_at"]}}, indent=0)
            + "\n")
        return job

    def submit(self, kind, body, key=None):
        """Submits a job that runs exclusively: all other open jobs are paused until they are
        submitted again. The same body always returns the same job, which continues if it was paused
        or had failed."""
        key = key or "bench-" + hashlib.sha256(json.dumps([kind, body],
                                                          sort_keys=True).encode()).hexdigest()[:40]
        job = self.job_of(kind, body, key)
        for state in ("running", "queued"):
            for other in list(self.items(f"/v1/jobs?state={state}")):
                if other["id"] != job["id"]:
                    self.fetch(f"/v1/jobs/{other['id']}/pause", method="POST",
                               refused=409)  # 409: it has ended in the meantime
        if job["state"] in ("paused", "failed"):
            self.fetch(f"/v1/jobs/{job['id']}/resume", method="POST")
        return self.call(f"/v1/{kind}/{job['id']}")

    def look(self, kind, job, wait_s):
        return self.call(f"/v1/{kind}/{job['id']}", headers={"Prefer": f"wait={wait_s}"})

    def follow(self, kind, job, deadline, progress):
        """Waits for the end of a job, or for the deadline. Returns its current state.
        progress(job): a line about its progress."""
        while not deadline.is_over():
            job = self.look(kind, job, deadline.wait_s())
            if job["state"] in ENDED + ("paused", ):
                break
            print(progress(job), file=sys.stderr, flush=True)
        return job

    @staticmethod
    def elapsed_s(job):
        """Returns the time from the first start of a job to its end, including stops."""
        if job["started_at"] is None or job["finished_at"] is None:
            return None
        started, finished = (datetime.fromisoformat(job[key].replace("Z", "+00:00"))
                             for key in ("started_at", "finished_at"))
        return (finished - started).total_seconds()

    def items(self, path):
        """Yields all items of a list, or all rows of a curve."""
        cursor = ""
        while True:
            page = self.call(f"{path}{'&' if '?' in path else '?'}limit=1000{cursor}")
            yield from page["items"]
            if page["next_cursor"] is None:
                return
            cursor = "&cursor=" + urllib.parse.quote(page["next_cursor"])

    def put_controller(self, name, file):
        data = Path(file).read_bytes()
        return json.loads(
            self.fetch(f"/v1/controllers/{name}/file", data,
                       {"Content-Type": "application/octet-stream"}, "PUT"))

    def machine(self):
        """Returns the names of the working GPUs, and the number of threads."""
        devices = self.call("/v1/devices")["items"]
        return {
            "gpus": [device["name"] for device in devices if device["state"] == "working"],
            "workers": self.call("/v1/threads")["n_threads"]
        }

    def stop(self):
        """Sends SIGTERM, so that running work is saved. A daemon that does not stop is killed; next
        time it continues from its last checkpoint."""
        self.process.terminate()
        try:
            self.process.wait(120)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.log.close()
