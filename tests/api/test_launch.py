"""The files that start workers, as morphoctl prints them, parsed the way the engines would read
them."""

import inspect
import re
import subprocess

import pytest
import yaml

from fleet_daemon import FakeDaemon, Worker
from service import BINARY, SOURCE
from ctl import MORPHOCTL


def printed(engine, *options, status=0):
    done = subprocess.run([MORPHOCTL, "fleet", engine, *options], capture_output=True, text=True)
    assert done.returncode == status, done.stderr
    return done.stdout if status == 0 else done.stderr


def test_a_slurm_job_starts_a_worker(tmp_path):
    daemon = FakeDaemon()
    script = tmp_path / "workers.sbatch"
    script.write_text(printed("slurm", f"--fleet={daemon.url}", "--workers=7", "--cpus=1",
                              "--time=30", "--idle=1s"))
    lines = script.read_text().splitlines()
    comments = [line for line in lines[1:lines.index("")]]
    assert all(line.startswith("#") for line in comments)  # Slurm reads no further
    for line in ("--array=1-7", "--cpus-per-task=1", "--time=30", "--requeue",
                 "--signal=B:USR1@30"):
        assert "#SBATCH " + line in comments
    (tmp_path / "morphod").symlink_to(BINARY)
    done = subprocess.run(["bash", script], capture_output=True, text=True, timeout=300, env={
        "PATH": f"{tmp_path}:/usr/bin:/bin", "SLURM_CPUS_PER_TASK": "1", "HOME": str(tmp_path),
        "MORPHOD_WORKER_TOKEN_FILE": "", "MORPHOD_WORKER_DEVICES": "none"})
    assert done.returncode == 0 and daemon.offers[0]["n_threads"] == 1, done.stderr
    daemon.close()


def faults_of(value, kind, place, models):
    """Returns how a document differs from Kubernetes's models."""
    if kind.startswith(("list[", "dict(")):
        inner = kind[5:-1].split(", ")[-1]
        items = value if isinstance(value, list) else list(value.values())
        return [fault for n, item in enumerate(items)
                for fault in faults_of(item, inner, f"{place}[{n}]", models)]
    model = getattr(models, kind, None)
    if not inspect.isclass(model):
        good = {"str": str, "int": int, "bool": bool, "object": object}[kind]
        return [] if isinstance(value, good) else [f"{place} is {value!r}, no {kind}"]
    names = {name: key for key, name in model.attribute_map.items()}
    return [f"{place}.{name} is unknown" for name in value if name not in names] + [
        fault for name in value if name in names
        for fault in faults_of(value[name], model.openapi_types[names[name]], f"{place}.{name}",
                               models)]


def test_a_deployment_is_one_of_kubernetes():
    models = pytest.importorskip("kubernetes.client.models")
    text = printed("kubernetes", "--fleet=https://lab:8766", "--pin=sha256//abc=", "--workers=9",
                   "--cpus=16", "--image=lab/morphod:1")
    made = yaml.safe_load(text)
    assert faults_of(made, "V1Deployment", "", models) == []
    assert len(faults_of(made | {"spec": made["spec"] | {"replica": 1}}, "V1Deployment", "",
                         models)) == 1
    pod = made["spec"]["template"]
    labels = made["spec"]["selector"]["matchLabels"].items()
    assert labels <= pod["metadata"]["labels"].items() and made["spec"]["replicas"] == 9
    worker, = pod["spec"]["containers"]
    variables = {variable["name"]: variable.get("value") for variable in worker["env"]}
    assert variables["MORPHOD_WORKER_SERVER"] == "https://lab:8766"
    assert variables["MORPHOD_WORKER_PIN"] == "sha256//abc="
    mounted, = worker["volumeMounts"]
    assert variables["MORPHOD_WORKER_TOKEN_FILE"].startswith(mounted["mountPath"])
    assert worker["resources"]["limits"]["cpu"] == "16" and worker["image"] == "lab/morphod:1"
    volume, = pod["spec"]["volumes"]
    assert volume["name"] == mounted["name"] and volume["secret"]["defaultMode"] == 0o440


def test_a_unit_has_the_requested_options():
    text = printed("systemd", "--fleet=https://lab:8766", "--cpus=3",
                   "--worker-token-file=/etc/token")
    for line in ("Environment=MORPHOD_WORKER_SERVER=https://lab:8766", "CPUQuota=300%",
                 "LoadCredential=token:/etc/token", "ExecStart=morphod worker"):
        assert line in text.splitlines()
    bare = printed("systemd")
    assert not any(word in bare for word in ("Environment=", "CPUQuota", "@PIN"))


@pytest.mark.parametrize("options", [["--fleet=https://x\" evil"], ["--cpus=0"], ["--pin=`id`"],
                                     ["--worker-token-file=a'b"], ["--image=x"]])
def test_values_that_would_break_a_file_are_refused(options):
    assert "morphoctl" in printed("slurm", *options, status=2)


def test_a_worker_says_what_it_is():
    done = subprocess.run([BINARY, "worker", "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and "--leave-when-idle" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 100
    page = (SOURCE / "docs/man/morphod.8").read_text()
    for flag in re.findall(r"^  --(\S+)", done.stdout, re.M):
        assert f"Fl -{flag} " in page or f"Fl -{flag}\n" in page, flag
    idle = Worker("http://127.0.0.1:1", "--leave-when-idle=1")
    assert idle.ends() == 0
    idle.close()
