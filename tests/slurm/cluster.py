"""A Slurm cluster with one controller and two nodes on this machine, for tests. Each is in a
separate network namespace; a bridge joins them. Needs root and the packages slurmctld, slurmd and
munge."""

import os
import pathlib
import shutil
import signal
import subprocess
import tempfile
import time

NODES = ("n1", "n2")
BRIDGE = "mo-slurm"
ADDRESS = "10.213.7.1"  # address of the controller and of the daemon
CONFIGURATION = """
ClusterName=test
SlurmctldHost=ctl({address})
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={base}/munge.socket
StateSaveLocation={base}/state
SlurmctldPidFile={base}/slurmctld.pid
SlurmctldLogFile={base}/slurmctld.log
SlurmdPidFile={base}/slurmd-%n.pid
SlurmdLogFile={base}/slurmd-%n.log
SlurmdSpoolDir={base}/spool-%n
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
ReturnToService=2
SlurmdTimeout=10
KillWait=5
MpiDefault=none
{nodes}
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE
"""


def missing():
    """Returns what this machine lacks, or None."""
    if os.geteuid() != 0:
        return "namespaces need root"
    lacking = [name for name in ("slurmctld", "slurmd", "munged", "ip", "nsenter")
               if shutil.which(name) is None]
    return f"{lacking} not installed" if lacking else None


def run(*command):
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


class Cluster:
    def __init__(self):
        self.folder = tempfile.TemporaryDirectory(prefix="morphod-slurm-")
        self.base = pathlib.Path(self.folder.name)
        self.base.chmod(0o755)
        self.processes = {}
        self.environment = {"PATH": os.environ["PATH"], "SLURM_CONF": str(self.base / "slurm.conf"),
                            "HOME": str(self.base), "LC_ALL": "C.UTF-8"}
        try:
            self.start()
        except BaseException:
            self.close()
            raise

    def start(self):
        key = self.base / "munge.key"
        key.write_bytes(os.urandom(64))
        key.chmod(0o600)
        run("munged", "--force", f"--key-file={key}", f"--socket={self.base}/munge.socket",
            f"--pid-file={self.base}/munge.pid", f"--log-file={self.base}/munge.log",
            f"--seed-file={self.base}/munge.seed")
        nodes = "\n".join(f"NodeName={node} NodeAddr={self.address(node)} CPUs=2 RealMemory=2000"
                          for node in NODES)
        (self.base / "slurm.conf").write_text(
            CONFIGURATION.format(base=self.base, address=ADDRESS, nodes=nodes))
        for folder in ("state", *(f"spool-{node}" for node in NODES)):
            (self.base / folder).mkdir()
        run("ip", "link", "add", BRIDGE, "type", "bridge")
        run("ip", "address", "add", f"{ADDRESS}/24", "dev", BRIDGE)
        run("ip", "link", "set", BRIDGE, "up")
        self.launch("ctl", None, "slurmctld", "-D")
        for node in NODES:
            self.connect(node)
            self.boot(node)
        self.until(lambda: self.states() == ["idle"] * len(NODES))

    @staticmethod
    def address(node):
        return f"10.213.7.{2 + NODES.index(node)}"

    def connect(self, node):
        run("ip", "netns", "add", f"mo-{node}")
        run("ip", "link", "add", f"mo-{node}", "type", "veth", "peer", "name", "eth0", "netns",
            f"mo-{node}")
        run("ip", "link", "set", f"mo-{node}", "master", BRIDGE, "up")
        for command in (["address", "add", f"{self.address(node)}/24", "dev", "eth0"],
                        ["link", "set", "eth0", "up"], ["link", "set", "lo", "up"]):
            run("ip", "-n", f"mo-{node}", *command)

    def launch(self, name, namespace, *command):
        """Starts a program with a host's name, in a namespace. It does not use `ip netns exec`,
        because that remounts /sys without the cgroups that slurmd looks for."""
        inside = ["nsenter", f"--net=/run/netns/{namespace}"] if namespace else []
        self.processes[name] = subprocess.Popen(
            [*inside, "unshare", "--uts", "sh", "-c", f"hostname {name}; exec \"$@\"", "sh",
             *command], env=self.environment, start_new_session=True,
            stdout=open(self.base / f"{name}.out", "ab"), stderr=subprocess.STDOUT)

    def boot(self, node):
        self.launch(node, f"mo-{node}", "slurmd", "-D", "-N", node)

    def crash(self, node):
        """The node disappears with everything that runs on it, without sending a packet."""
        run("ip", "link", "set", f"mo-{node}", "down")
        for process in run("ip", "netns", "pids", f"mo-{node}").split():
            os.kill(int(process), signal.SIGKILL)
        self.processes.pop(node).wait()

    def revive(self, node):
        run("ip", "link", "set", f"mo-{node}", "up")
        self.boot(node)

    def slurm(self, *command):
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True,
                              cwd=self.base)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def jobs(self, state):
        """Returns scontrol's description of the jobs in a state."""
        return "\n".join(line for line in self.slurm("scontrol", "-o", "show", "job").splitlines()
                         if f" JobState={state} " in line)

    def states(self):
        done = subprocess.run(["sinfo", "-h", "-N", "-o", "%t"], env=self.environment,
                              capture_output=True, text=True)
        return done.stdout.split()

    def until(self, holds, seconds=60):
        deadline = time.monotonic() + seconds
        while not (seen := holds()):
            assert time.monotonic() < deadline, self.logs()
            time.sleep(0.2)
        return seen

    def logs(self):
        return "\n".join(f"== {path.name}\n{path.read_text(errors='replace')[-3000:]}"
                         for path in sorted(self.base.glob("*.log")) + sorted(
                             self.base.glob("*.out")))

    def close(self):
        for node in NODES:
            done = subprocess.run(["ip", "netns", "pids", f"mo-{node}"], capture_output=True,
                                  text=True)
            for process in done.stdout.split():
                os.kill(int(process), signal.SIGKILL)
        for process in self.processes.values():
            process.kill()
            process.wait()
        pid = self.base / "munge.pid"
        if pid.exists():
            os.kill(int(pid.read_text()), signal.SIGTERM)
        for node in NODES:
            subprocess.run(["ip", "netns", "delete", f"mo-{node}"], capture_output=True)
        subprocess.run(["ip", "link", "delete", BRIDGE], capture_output=True)
        self.folder.cleanup()
