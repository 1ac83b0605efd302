"""Carries bytes between two sockets, for tests that stand between a client and a daemon."""
import socket
import threading


def relay(one, other):
    """Copies each way on a thread of its own, until that way ends."""
    for ends in ((one, other), (other, one)):
        threading.Thread(target=copy, args=ends, daemon=True).start()


def copy(source, target):
    try:
        while piece := source.recv(65536):
            target.sendall(piece)
        target.shutdown(socket.SHUT_WR)
    except OSError:
        pass
