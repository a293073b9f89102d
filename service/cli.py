"""Start the service, ask whether it is well, make keys."""

from __future__ import annotations

import argparse
import hashlib
import logging
import re
import secrets
import signal
import subprocess
import sys
from typing import NoReturn

import kissgs

from .core.files import VENDOR_SCRIPT
from .core.settings import OWNER, ServiceSettings, SettingsError

EPILOG = """\
Settings are environment variables; `kissgs-serve settings` lists them all. The first ones to know:
  KISSGS_HOST=0.0.0.0  KISSGS_PORT=8000  KISSGS_DATA_DIR=kissgs-data  KISSGS_KEYS=…
"""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Say where settings come from: whoever writes ``--port 9000`` wants to know."""
        super().error(f"{message}; settings are environment variables, such as KISSGS_PORT=9000")


def run() -> None:
    """Do what the command line asks for. What is wrong with the settings ends in one message and exit code 2."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = _Parser("kissgs-serve", description=__doc__, epilog=EPILOG, formatter_class=raw)
    parser.add_argument("--version", action="version", version=f"kissgs {kissgs.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    commands.add_parser("run", help="serve (what happens without a command, too)")
    commands.add_parser("health", help="exit 0 if the service on this machine is ready, 1 if not")
    commands.add_parser("settings", help="list all settings")
    commands.add_parser("viewer", help="fetch what the preview page draws with, if it is not there yet")
    key = commands.add_parser("key", help="make a key for an owner")
    key.add_argument("owner", help="a name, such as that of a person or a program")
    given = parser.parse_args()
    match given.command:
        case "health":
            sys.exit(_health())
        case "viewer":
            sys.exit(subprocess.run([sys.executable, VENDOR_SCRIPT], check=False).returncode)
        case "key":
            _make_key(given.owner)
        case "settings":
            for name, field in ServiceSettings.model_fields.items():
                default = field.default if field.default not in (None, ()) else "not set"
                sys.stdout.write(f"KISSGS_{name.upper()}\n    {field.description} Default: {default}\n")
        case _:
            _run()


def _run() -> None:
    try:
        settings = ServiceSettings.from_environment()
    except SettingsError as error:
        _fail(error)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s %(message)s", stream=sys.stderr)
    from .http.app import create_app
    from .http.server import Server, allow_connections, listen

    allow_connections()
    try:
        listener = listen(settings)
        app = create_app(settings)
    except SettingsError as error:
        _fail(error)
    except KeyboardInterrupt:  # it may have been waiting for another service
        sys.exit(128 + signal.SIGINT)
    if not settings.keys and not settings.is_private:
        logging.getLogger("kissgs.service").warning(
            "no keys are set: everyone who can reach %s may use this service (see `kissgs-serve key`)", settings.host
        )
    server = Server(app, app.state.context)
    server.run(sockets=[listener])
    if not server.started:
        sys.exit(3)


def _health() -> int:
    """0 or 1, whatever is wrong: container engines keep 2 for themselves."""
    import httpx

    try:
        settings = ServiceSettings.from_environment()
    except SettingsError as error:
        sys.stderr.write(f"kissgs-serve: {error}\n")
        return 1
    host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(settings.host, settings.host)
    try:
        answer = httpx.get(f"http://{host}:{settings.port}/readyz", timeout=5, trust_env=False)
        sys.stdout.write(answer.text + "\n")
    except httpx.HTTPError as error:
        sys.stdout.write(f"no answer from {host}:{settings.port}: {error}\n")
        return 1
    return 0 if answer.status_code == httpx.codes.OK else 1


def _make_key(owner: str) -> None:
    if not re.fullmatch(OWNER, owner):
        _fail(SettingsError("an owner is 1 to 64 letters, digits, dots, dashes, underscores or @"))
    key = f"kissgs_{secrets.token_urlsafe(32)}"
    digest = hashlib.sha256(key.encode()).hexdigest()
    sys.stdout.write(
        f"give the owner, who sends it as 'Authorization: Bearer …', and keep no copy:\n  {key}\n"
        f"add to KISSGS_KEYS, which may have several of one owner while keys are exchanged:\n  {owner}:{digest}\n"
    )


def _fail(error: Exception) -> NoReturn:
    for line in str(error).splitlines():
        sys.stderr.write(f"kissgs-serve: {line}\n")
    sys.exit(2)
