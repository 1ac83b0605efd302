"""README.md shows what its first command prints."""

import os
import pathlib
import re
import subprocess

import service as module
from ctl import MORPHOCTL

SHIPPED = module.SOURCE / "data/controllers/phototaxis-16ms.safetensors"
SCORES = ("score", "best", "worst")


def in_readme():
    """Returns the first command of README.md, and the lines of its output there."""
    text = (module.SOURCE / "README.md").read_text(encoding="utf-8")
    command, *lines = re.search(r"```\n\$ (.*?)```\n\(On a CPU with AVX2\.\)", text,
                                re.S)[1].splitlines()
    return command, lines


def cells(lines, leave_out=()):
    """Returns the words of each line, except those in some columns."""
    head = lines[0].split()
    return [[word for name, word in zip(head, line.split()) if name not in leave_out]
            for line in lines]


def test_first_command(start):
    """Exactly, with the instruction set that README.md names; a processor without it computes
    other last bits, which chaos enlarges, so there the scores themselves are not compared."""
    command, lines = in_readme()
    assert len(lines) == 4 and all(name in lines[0] for name in SCORES), lines
    avx2 = " avx2 " in pathlib.Path("/proc/cpuinfo").read_text().replace("\n", " ")
    running = start(f"--default-controller={SHIPPED}", "--isa=" + ("avx2" if avx2 else "auto"))
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith("MORPHO")}
    environment.update(MORPHOD_SERVER=running.addresses[0], LC_ALL="C.UTF-8",
                       PATH=f"{pathlib.Path(MORPHOCTL).resolve().parent}:{os.environ['PATH']}")
    done = subprocess.run(["bash", "-c", command], cwd=module.SOURCE, env=environment,
                          capture_output=True, text=True, timeout=module.PATIENCE_S, check=False)
    assert done.returncode == 0, done.stderr
    printed = done.stdout.splitlines()
    if avx2:
        assert [line.rstrip() for line in printed] == [line.rstrip() for line in lines]
    else:
        assert cells(printed, SCORES) == cells(lines, SCORES)
