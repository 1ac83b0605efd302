"""Fixtures of tests that disturb daemons. Seeds are printed, so that a failure can be
repeated: --seed N."""
import contextlib
import os
import pathlib
import shutil
import subprocess
import tempfile
import time

import pytest
from daemon import MORPHOD, Daemon


@pytest.fixture(scope="session")
def soak(request):
    return request.config.getoption("--soak")


@pytest.fixture(scope="session")
def seed(request):
    value = request.config.getoption("--seed")
    return int(time.time()) if value is None else value


def pytest_report_header(config):
    return f"morphod: {MORPHOD}"


@pytest.fixture
def folder():
    """A folder for one test, outside the working tree so that the path of a unix socket in it stays
    short."""
    path = tempfile.mkdtemp(prefix="morphod-crash-")
    yield path
    shutil.rmtree(path, ignore_errors=True)


@pytest.fixture
def daemon(folder):
    """daemon(**settings) makes one; all are closed at the end of the test."""
    made = []

    def make(name="one", **settings):
        made.append(Daemon(f"{folder}/{name}", **settings))
        return made[-1]

    yield make
    for one in made:
        one.close()


def mounted(folder, *arguments):
    """Mounts a file system, or skips the test with the reason."""
    path = pathlib.Path(folder) / "small"
    path.mkdir()
    if os.geteuid() != 0:
        pytest.skip("mounting a small file system needs root")
    mount = subprocess.run(["mount", *arguments, path], capture_output=True, text=True)
    if mount.returncode != 0:
        pytest.skip(f"mount is not allowed here: {mount.stderr.strip()}")
    yield path
    subprocess.run(["umount", "-l", path], check=False)


@pytest.fixture
def small_disk(folder):
    yield from mounted(folder, "-t", "tmpfs", "-o", "size=24m,mode=700", "tmpfs")


@pytest.fixture
def training_disk(folder):
    """A disk with room for a few checkpoints of 12.4 MB."""
    yield from mounted(folder, "-t", "tmpfs", "-o", "size=64m,mode=700", "tmpfs")


@pytest.fixture
def small_blocks(folder):
    """An ext4 file system with blocks smaller than a page of memory."""
    image = f"{folder}/image"
    with open(image, "wb") as file:
        file.truncate(32 << 20)
    if shutil.which("mkfs.ext4") is None:
        pytest.skip("there is no mkfs.ext4")
    subprocess.run(["mkfs.ext4", "-q", "-b", "1024", "-m", "0", image], check=True)
    yield from mounted(folder, "-o", "loop", image)


def fill(path):
    """Fills the free space, and returns the file that does so."""
    filler = pathlib.Path(path) / "filler"
    with open(filler, "ab", buffering=0) as file:
        for size in (65536, 512):
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(size))
    return filler
