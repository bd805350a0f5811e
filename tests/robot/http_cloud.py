"""The cloud of tests behind real HTTP, on a port of its own."""

import json
import ssl
import threading
from collections import deque
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from fcslam.wire.batches import CORRECTION_HEADER, MEDIA_TYPE, REFUSED_HEADER, read_batch, write_batch
from tests.robot.fake_cloud import FakeCloud


class HttpCloud:
    """Answers as the contract says; ``canned`` answers (status, headers, body) come first."""

    def __init__(self, cloud=None):
        self.cloud = cloud or FakeCloud()
        self.canned = deque()
        self.requests = []
        """Method, path, headers and body of each."""
        self.url = ""

    def answer(self, method, path, headers, body):
        self.requests.append((method, path, headers, body))
        if self.canned:
            return self.canned.popleft()
        if path.endswith("/state"):
            state = self.cloud.state()
            refused = [{"epoch": e, "sequence": s, "reason": why} for (e, s), why in state.refused.items()]
            return 200, {}, json.dumps({"next": state.expected, "refused": refused}).encode()
        answer = self.cloud.send(read_batch(body), int(headers.get(CORRECTION_HEADER, -1)))
        if answer.refusal is not None:
            detail = {"error": answer.refusal[1], "index": answer.refusal[0]}
            return 400, {}, json.dumps(detail).encode()
        headers = {"Content-Type": MEDIA_TYPE, REFUSED_HEADER: str(answer.refused)}
        return 200, headers, write_batch(answer.packets)


@contextmanager
def serving(cloud=None, tls=None):
    """An HttpCloud that can be reached at its ``url``; ``tls``: the folder of its certificate."""
    http_cloud = HttpCloud(cloud)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def _any(self):
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            status, headers, content = http_cloud.answer(self.command, self.path, dict(self.headers), body)
            self.send_response(status)
            for name, value in {**headers, "Content-Length": str(len(content))}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_POST = _any

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    if tls is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(tls / "cloud.pem", tls / "cloud.key")
        server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    http_cloud.url = f"{'https' if tls else 'http'}://127.0.0.1:{server.server_port}"
    try:
        yield http_cloud
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
