"""A proxy between a worker and its daemon that makes the worker a liar: it flips the lowest bit of
some losses. The message stays well formed, with the digest of what it became."""
import http.client
import http.server
import random
import struct
import threading

from workers import HEADER, RESULT, digest


class Liar:
    def __init__(self, address, seed, share=0.001):
        """address: host:port of the workers' server. share: of the rows."""
        self.address, self.share, self.random = address, share, random.Random(seed)
        self.rows = self.flipped = 0
        self.lock = threading.Lock()
        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), self.handler())
        self.server.handle_error = lambda *_: None  # workers that have left
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def spoil(self, message):
        """The message with its lies."""
        spoiled, at = bytearray(message), HEADER.size
        for _ in range(HEADER.unpack_from(message)[2]):
            rows = RESULT.unpack_from(message, at)[3]
            at += RESULT.size
            with self.lock:
                lies = [i for i in range(rows) if self.random.random() < self.share]
                self.rows += rows
                for i in lies:
                    if struct.unpack_from("<d", message, at + 8 * i)[0] < float("inf"):
                        spoiled[at + 8 * i] ^= 1
                        self.flipped += 1
            at += 12 * rows
        return bytes(spoiled)

    def handler(self):
        liar = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def setup(self):
                super().setup()
                self.daemon = http.client.HTTPConnection(liar.address, timeout=60)

            def pass_on(self):
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                headers = dict(self.headers.items())
                headers["Host"] = liar.address
                if self.path.endswith("/exchange"):
                    body = liar.spoil(body)
                    headers["Content-Digest"] = digest(body)
                try:
                    self.daemon.request(self.command, self.path, body or None, headers)
                    reply = self.daemon.getresponse()
                    content = reply.read()
                except (OSError, http.client.HTTPException):
                    self.close_connection = True
                    return
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
