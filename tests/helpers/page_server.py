"""The server of ``kissgs view`` in a thread, and requests to it."""

import contextlib
import http.client
import threading

from kissgs.preview import PageServer


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
