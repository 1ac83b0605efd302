"""Workers as processes, on this machine or on a separate one of a network."""
import os
import pathlib
import signal
import subprocess

from daemon import ENDED, MORPHOD, PATIENCE_S


class Worker:
    def __init__(self, folder, address, name, *flags, binary=MORPHOD, before=()):
        """before: a command that runs the worker's command."""
        self.name = name
        self.log = pathlib.Path(folder) / f"worker-{name}.log"
        inherited = {k: v for k, v in os.environ.items() if not k.startswith(("MORPHOD", "SLURM"))}
        command = [*before, str(binary), "worker", f"--server={address}", f"--name={name}",
                   "--threads=1", "--devices=none", *flags]
        with open(self.log, "ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, env=inherited)

    def kill(self):
        self.process.kill()
        self.process.wait()

    def stop(self):
        """Sends SIGTERM and returns the exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_S)

    def ended(self, timeout_s=PATIENCE_S):
        """Returns the exit status of a worker that ends without a signal, and its log."""
        status = self.process.wait(timeout_s)
        return status, self.log.read_text(errors="replace")

    def close(self):
        if self.process.poll() is None:
            self.kill()


def fleet_address(daemon):
    """Returns the address of the server for workers: the last line of the port file."""
    return daemon.port_file.read_text().split()[-1]


def generation(daemon, job):
    """Returns the newest generation of a campaign, or the number of all generations plus one once
    it has ended."""
    now = daemon.json(f"/v1/campaigns/{job}")
    done = now["progress"]["generation"]
    return now["settings"]["generations"] + 1 if now["state"] in ENDED else \
        -1 if done is None else done



def events(daemon, *kinds):
    """Returns the events of a kind, oldest first."""
    items = daemon.json("/v1/events?format=json&after=0&limit=1000")["items"]
    return [one for one in items if one["type"] in kinds]
