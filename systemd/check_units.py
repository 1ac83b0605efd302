"""Checks the units with systemd's own tools: they parse, and the services are as closed as they can
be.

Usage: check_units.py SERVICE SOCKET WORKER. Status 77 (skipped) without systemd-analyze."""
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile

# Lines that each service has, and the most exposure, in tenths.
SERVICES = {
    "morphod.service": (15, [
        "Type=notify", "WatchdogSec=", "DynamicUser=yes", "StateDirectory=morphod",
        "StateDirectoryMode=0700", "LoadCredential=token", "RestartPreventExitStatus=64 78",
        "ExecReload=kill -HUP $MAINPID"
    ]),
    "morphod-worker@.service": (20, [
        "Type=notify", "DynamicUser=yes", "LoadCredential=token", "ExecStart=morphod worker",
        "RestartPreventExitStatus=64 76 77 78", "RestartSec=30",
        "EnvironmentFile=-/etc/morphod/worker-%i.env"
    ])
}


def run(*command):
    done = subprocess.run(["systemd-analyze", *command], capture_output=True, text=True)
    return done.returncode, (done.stdout + done.stderr).strip()


def fault_of(path, folder):
    """What is wrong with a service whose other units are in the folder; None: nothing."""
    threshold, lines = SERVICES[path.name]
    text = path.read_text()
    for line in lines:
        if not re.search("^" + re.escape(line), text, re.M):
            return f"no line {line}"
    if "@" in re.search("^ExecStart=.*", text, re.M).group():
        return "ExecStart is not complete"
    # verify wants a program that exists: the one of the build is not installed yet.
    copy = pathlib.Path(folder, path.name)
    copy.write_text(re.sub("^ExecStart=.*", "ExecStart=/bin/true", text, flags=re.M))
    status, said = run("verify", "--man=no", copy, *pathlib.Path(folder).glob("*.socket"))
    if status != 0 or "morphod" in said:
        return said
    status, said = run("security", "--offline=true", f"--threshold={threshold}", "--no-pager", copy)
    print(path.name, said.splitlines()[-1])
    return "too exposed" if status != 0 else None


def main():
    if shutil.which("systemd-analyze") is None:
        print("systemd-analyze is not installed")
        return 77
    service, socket, worker = (pathlib.Path(a) for a in sys.argv[1:])
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(socket, folder)
        faults = [f"{path}: {fault}" for path in (service, worker)
                  if (fault := fault_of(path, folder)) is not None]
    print(*faults, sep="\n")
    return 1 if faults else 0


sys.exit(main())
