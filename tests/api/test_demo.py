"""tools/demo, in a separate repository that shares data, tools and programs with this one: it
reports the controller with which it scores."""

import hashlib
import os
import subprocess

import pytest
import service as module
from ctl import MORPHOCTL

SHIPPED = module.SOURCE / "data/controllers/phototaxis-16ms.safetensors"


def hash_of(file):
    return hashlib.sha256(file.read_bytes()).hexdigest()


@pytest.fixture
def demo(tmp_path):
    """demo(option…) returns the lines that it prints."""
    for folder in ("build/src/daemon", "build/clients/morphoctl"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "build/build.ninja").write_text(
        "build build.ninja: phony\n"
        "build src/daemon/morphod clients/morphoctl/morphoctl: phony\n")
    for name, target in (("tools", module.SOURCE / "tools"), ("data", module.SOURCE / "data"),
                         ("build/src/daemon/morphod",
                          module.BINARY), ("build/clients/morphoctl/morphoctl", MORPHOCTL)):
        (tmp_path / name).symlink_to(os.path.abspath(target))

    def run(*options):
        done = subprocess.run(["bash", tmp_path / "tools/demo", "--no-install", *options],
                              capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout.splitlines()

    yield run
    run("--stop")


def short(demo):
    """Runs the demo without random designs and campaign: the lines about the controller, which
    precede the scores."""
    lines = demo("--random", "0", "--generations", "0")
    place = next(i for i, line in enumerate(lines) if line.startswith("Controller: "))
    assert any("crawler" in line
               for line in lines[place + 1:]) and not any("crawler" in line
                                                          for line in lines[:place])
    address = next(line.split()[3] for line in lines if line.startswith("The daemon serves "))
    return lines[place:place + 2], address


def test_shipped_default(demo):
    shown, _ = short(demo)
    assert shown[0] == (f"Controller: phototaxis-16ms, sha256 {hash_of(SHIPPED)[:16]}…, "
                       "the default of this daemon.")
    assert "shipped" not in shown[1]


def test_state_of_an_older_program(demo, start, tmp_path):
    """The default controller of the folder stays and is named. The printed command makes the
    shipped one the default."""
    (tmp_path / ".morphod").mkdir()
    older = start(state=tmp_path / ".morphod" / "state")
    assert older.stop() == 0
    shown, address = short(demo)
    assert shown[0] == (f"Controller: bootstrap, sha256 {hash_of(module.BOOTSTRAP)[:16]}…, "
                       "the default of this daemon.")
    words, command = shown[1].split(" by: ")
    assert words == "It is not the shipped one, phototaxis-16ms, which becomes the default"
    subprocess.run(["bash", "-c", command], cwd=tmp_path, check=True, timeout=300,
                   capture_output=True)
    shown, _ = short(demo)
    assert shown[0] == (f"Controller: phototaxis-16ms, sha256 {hash_of(SHIPPED)[:16]}…, "
                       "the default of this daemon.")
    assert "shipped" not in shown[1]
    names = subprocess.run([MORPHOCTL, "controller", "list", "--server", address], check=True,
                           capture_output=True, text=True, timeout=300).stdout
    assert hash_of(module.BOOTSTRAP) in names
