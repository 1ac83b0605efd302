"""Relays bytes between two sockets, for tests between a client and a daemon."""
import socket
import threading


def relay(one, other):
    """Copies each direction on its own thread, until that direction ends."""
    for ends in ((one, other), (other, one)):
        threading.Thread(target=copy, args=ends, daemon=True).start()


def copy(source, target):
    try:
        while piece := source.recv(65536):
            target.sendall(piece)
        target.shutdown(socket.SHUT_WR)
    except OSError:
        pass
