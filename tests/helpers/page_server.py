"""The server of ``kissgs view`` in a thread, and requests to it."""

import contextlib
import http.client
import json
import threading

from kissgs.io.containers import open_source, zip_bytes
from kissgs.preview import PageServer


def with_view(container, view):
    """Return a container, of either format, with another recorded view."""
    with open_source(container) as source:
        files = {name: source.read(name, 1 << 30) for name in source.names()}
    meta = json.loads(files["meta.json"])
    meta.setdefault("kissgs", {})["view"] = view
    return zip_bytes({**files, "meta.json": json.dumps(meta).encode()})


@contextlib.contextmanager
def serving(scene):
    with PageServer(scene) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def ask(server, path, method="GET", **headers):
    """Return the answer to a request, and its body."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body
