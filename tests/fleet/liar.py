"""Proxies between a worker and its daemon that alter the worker's behavior: a liar flips the lowest
bit of some losses, a victim is killed by a body. Messages stay well formed, with the digest of the
altered content."""
import contextlib
import http.client
import http.server
import random
import socket
import struct
import threading

from fleet_daemon import genotype_bytes
from workers import HEADER, RESULT, digest


class Proxy:
    def __init__(self, address):
        """address: host:port of the server for workers."""
        self.address, self.lock, self.connections = address, threading.Lock(), []
        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), self.handler())
        self.server.handle_error = lambda *_: None  # workers that left
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def up(self, results):
        """Returns the altered message of results."""
        return results

    def down(self, leases):
        """Inspects a message of leases."""

    def cut(self):
        """Closes the connections to the daemon, like those of a killed worker."""
        for connection in self.connections:
            with contextlib.suppress(AttributeError, OSError):
                connection.sock.shutdown(socket.SHUT_RDWR)
        self.connections.clear()

    def handler(self):
        proxy = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def setup(self):
                super().setup()
                self.daemon = http.client.HTTPConnection(proxy.address, timeout=300)
                proxy.connections.append(self.daemon)

            def pass_on(self):
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                headers = dict(self.headers.items())
                headers["Host"] = proxy.address
                is_exchange = self.path.endswith("/exchange")
                if is_exchange:
                    body = proxy.up(body)
                    headers["Content-Digest"] = digest(body)
                try:
                    self.daemon.request(self.command, self.path, body or None, headers)
                    reply = self.daemon.getresponse()
                    content = reply.read()
                except (OSError, http.client.HTTPException):
                    self.close_connection = True
                    return
                if is_exchange:
                    proxy.down(content)
                self.send_response(reply.status)
                for name, value in reply.getheaders():
                    if name.lower() in ("content-type", "content-digest", "retry-after"):
                        self.send_header(name, value)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content)

            def finish(self):
                self.daemon.close()
                super().finish()

            def log_message(self, *_):
                pass

            do_GET = do_POST = do_DELETE = pass_on

        return Handler

    def close(self):
        self.server.shutdown()
        self.server.server_close()


class Liar(Proxy):
    def __init__(self, address, seed, share=0.001):
        """share: fraction of the rows that are falsified."""
        self.share, self.random = share, random.Random(seed)
        self.rows = self.flipped = 0
        super().__init__(address)

    def up(self, results):
        spoiled, at = bytearray(results), HEADER.size
        for _ in range(HEADER.unpack_from(results)[2]):
            rows = RESULT.unpack_from(results, at)[3]
            at += RESULT.size
            with self.lock:
                lies = [i for i in range(rows) if self.random.random() < self.share]
                self.rows += rows
                for i in lies:
                    if struct.unpack_from("<d", results, at + 8 * i)[0] < float("inf"):
                        spoiled[at + 8 * i] ^= 1
                        self.flipped += 1
            at += 12 * rows
        return bytes(spoiled)


class Victim(Proxy):
    """A proxy that kills its worker as soon as it gets a certain body, and restarts it."""

    def __init__(self, address, body, start):
        """body: the text of a genotype. start(url): starts a worker."""
        self.body, self.start, self.deaths = genotype_bytes(body), start, 0
        super().__init__(address)
        self.worker = start(self.url)

    def down(self, leases):
        with self.lock:
            if self.body in leases and self.worker is not None:
                self.worker.kill()
                self.cut()
                self.deaths += 1
                self.worker = self.start(self.url)
