"""Machines in network namespaces: a bridge with a link to each machine, which can be disconnected
or slowed down, and a proxy that delays. All of it disappears with the processes."""
import ctypes
import os
import queue
import socket
import subprocess
import threading
import time

import pytest

CLONE_NEWNET = 0x40000000
HUB = "10.77.0.1"


def run(*words):
    return subprocess.run(words, check=True, capture_output=True, text=True, timeout=300)


class Network:
    """Moves this process and those that it starts into the hub's namespace. Only a single-threaded
    process of root can do this."""

    def __init__(self):
        self.machines = []
        self.proxies = []
        self.home = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
        self.libc = ctypes.CDLL(None, use_errno=True)
        try:
            self.enter()
        except (OSError, subprocess.CalledProcessError) as error:
            self.close()
            pytest.skip("network namespaces need root and their kernel modules: "
                        f"{getattr(error, 'stderr', None) or error}")

    def enter(self):
        if self.libc.unshare(CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), "unshare")
        for words in ("link set lo up", "link add hub type bridge", f"addr add {HUB}/24 dev hub",
                      "link set hub up"):
            run("ip", *words.split())

    def add(self):
        """Adds a machine; returns its number."""
        holder = subprocess.Popen(["unshare", "--net", "sh", "-c", "echo; exec sleep 86400"],
                                  stdout=subprocess.PIPE)
        holder.stdout.readline()
        i = len(self.machines)
        self.machines.append(holder)
        for words in (f"link add v{i} type veth peer name uplink netns {holder.pid}",
                      f"link set v{i} master hub up"):
            run("ip", *words.split())
        for words in (f"addr add 10.77.0.{10 + i}/24 dev uplink", "link set uplink up"):
            run(*self.inside(i), "ip", *words.split())
        return i

    def inside(self, i):
        """Returns the command that runs a command on a machine."""
        return "nsenter", f"--net=/proc/{self.machines[i].pid}/ns/net"

    def link(self, i, state):
        run("ip", "link", "set", f"v{i}", state)

    def slow(self, i, is_slow):
        """Limits a link to 1 Mbit/s in both directions."""
        rate = "rate 1mbit burst 16kb latency 200ms".split() if is_slow else ()
        verb = "add" if is_slow else "del"
        run("tc", "qdisc", verb, "dev", f"v{i}", "root", *(("tbf", *rate) if rate else ()))
        run(*self.inside(i), "tc", "qdisc", verb, "dev", "uplink", "root",
            *(("tbf", *rate) if rate else ()))

    def delayed(self, port, delay_s):
        """Returns the port of a proxy to a port of the hub."""
        self.proxies.append(Delay(port, delay_s))
        return self.proxies[-1].port

    def close(self):
        for proxy in self.proxies:
            proxy.close()
        for holder in self.machines:
            holder.kill()
            holder.wait()
        self.libc.setns(self.home, CLONE_NEWNET)
        os.close(self.home)


class Delay:
    """A proxy in which every byte takes delay_s, half of it in each direction."""

    def __init__(self, port, delay_s, host=HUB):
        self.address, self.half_s = (host, port), delay_s / 2
        self.listener = socket.create_server((host, 0))
        self.port = self.listener.getsockname()[1]
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self):
        while True:
            try:
                client = self.listener.accept()[0]
            except OSError:
                return
            try:
                server = socket.create_connection(self.address, timeout=5)
                server.settimeout(None)
            except OSError:
                client.close()
                continue
            for one, other in ((client, server), (server, client)):
                pieces = queue.Queue()
                for target, ends in ((self.read, (one, pieces)), (self.write, (other, pieces))):
                    threading.Thread(target=target, args=ends, daemon=True).start()

    def read(self, source, pieces):
        piece = b"-"
        while piece:
            try:
                piece = source.recv(65536)
            except OSError:
                piece = b""
            pieces.put((time.monotonic() + self.half_s, piece))

    @staticmethod
    def write(target, pieces):
        try:
            while True:
                due, piece = pieces.get()
                time.sleep(max(0, due - time.monotonic()))
                if not piece:
                    break
                target.sendall(piece)
        except OSError:
            pass
        try:
            target.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass

    def close(self):
        self.listener.shutdown(socket.SHUT_RDWR)
        self.listener.close()
