"""Settings, health, metrics, commands and names of the service; oracles: the Prometheus parser and the settings
model."""

import asyncio
import hashlib
import io
import re
import subprocess
import sys

import pytest
from helpers.data_folders import service as opened_service
from helpers.service import ROOT, SMALL
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from service import cli
from service.__main__ import main
from service.core.settings import ServiceSettings, SettingsError


@pytest.fixture
def environment(no_variables, monkeypatch):
    return monkeypatch


def test_settings_come_from_the_environment(environment):
    environment.setenv("KISSGS_MAX_UPLOAD_BYTES", "3GB")
    environment.setenv("KISSGS_KEYS", f"a:{'0' * 64} b:{'1' * 64},a:{'2' * 64}")
    environment.setenv("kissgs_port", "9000")
    environment.setenv("KISSGS_KEY", "of the client")
    settings = ServiceSettings.from_environment()
    assert (settings.max_upload_bytes, settings.port) == (3_000_000_000, 9000)
    assert [owner for owner, _ in settings.keys] == ["a", "b", "a"]


def test_all_invalid_settings_are_reported_at_once(environment):
    invalid = {
        "KISSGS_PROT": "80",
        "KISSGS_PORT": "65536",
        "KISSGS_MAX_UPLOAD_BYTES": "many",
        "KISSGS_KEYS": "alice:secret",
        "KISSGS_CORS_ORIGINS": "example.org",
        "KISSGS_JOB_MEMORY": "1MB",
        "KISSGS_JOB_SECONDS": "nan",
        "KISSGS_RUNNER": "slurm",
        "KISSGS_WORKERS": "0",
    }
    for name, value in invalid.items():
        environment.setenv(name, value)
    with pytest.raises(SettingsError) as caught:
        ServiceSettings.from_environment()
    lines = str(caught.value).splitlines()
    for name in invalid:
        assert sum(line.startswith(f"{name}: ") for line in lines) == 1, name
    assert "secret" not in str(caught.value)


@pytest.fixture
def run(environment, capsys):
    """``run(words, KISSGS_X=…)`` runs the command in this process, and returns exit code and output."""

    def begin(*words, **settings):
        environment.setattr(sys, "argv", ["kissgs-serve", *words])
        for name, value in settings.items():
            environment.setenv(name, value)
        code = 0
        try:
            cli.run()
        except SystemExit as end:
            code = end.code
        return code, "".join(capsys.readouterr())

    return begin


def test_refused_starts_end_in_a_message(run, service):
    code, said = run(KISSGS_PORT=str(service.port))
    assert code == 2
    assert said.startswith("kissgs-serve: KISSGS_HOST, KISSGS_PORT: cannot listen on 127.0.0.1:")
    assert "address already in use" in said
    code, said = run(KISSGS_PROT="80", KISSGS_WORKERS="none")
    assert (code, "KISSGS_PROT: there is no such setting" in said) == (2, True)
    assert len(said.splitlines()) == 2


def test_the_key_command(run):
    _, said = run("key", "alice")
    key = re.search(r"kissgs_[A-Za-z0-9_-]{43}", said)[0]
    assert f"alice:{hashlib.sha256(key.encode()).hexdigest()}" in said
    assert run("key", "not an owner")[0] == 2


def test_every_setting_is_listed(run):
    _, listed = run("settings")
    for name in ServiceSettings.model_fields:
        assert f"KISSGS_{name.upper()}\n" in listed


def test_the_health_command(run, service):
    code, said = run("health", KISSGS_PORT=str(service.port))
    assert (code, '"ready":true' in said) == (0, True)
    assert run("health", KISSGS_PORT="1")[0] == 1


def test_health(service):
    assert service.http.get("/livez").json() == {"ready": True, "checks": {"process": "ok"}}
    ready = service.http.get("/readyz")
    assert ready.json() == {"ready": True, "checks": {"worker": "ok", "database": "ok", "disk": "ok"}}
    assert service.http.get("/version").json()["container"] == "SOG-XT"


@pytest.mark.usefixtures("no_variables")
def test_an_ended_worker_is_not_ready(tmp_path):
    async def scenario():
        context.worker.start()
        await asyncio.sleep(0.01)
        assert context.worker.health_problem() is None
        context.worker._loops[0].cancel()
        await asyncio.sleep(0.01)
        return context.worker.health_problem()

    with opened_service(tmp_path / "data") as context:
        assert asyncio.run(scenario()) == "worker 0 has ended"


def test_metrics(start):
    service = start()
    done = service.ended(service.submit())
    service.ended(service.submit(SMALL.replace(b"vertex 300", b"vertex 299")))
    text = service.http.get("/metrics")
    assert text.headers["content-type"].startswith("application/openmetrics-text")
    values = {
        (sample.name, *sorted(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(text.text)
        for sample in family.samples
    }
    assert values["kissgs_jobs", "succeeded"] == 2
    assert values["kissgs_jobs_submitted_total", "fast"] == 2
    assert values["kissgs_upload_bytes_total",] == 2 * len(SMALL)
    assert values["kissgs_container_bytes_total",] >= done["sizes"]["container"]
    assert values["kissgs_ratio_count",] == values["kissgs_queue_seconds_count",] == 2
    assert values["kissgs_stage_seconds_count", "images"] == 2
    assert values["kissgs_disk_bytes",] > 2 * len(SMALL)
    assert values["kissgs_http_requests_total", "/v1/jobs", "202", "POST"] == 2
    assert done["id"] not in text.text


def test_requests_have_ids(service):
    assert service.http.get("/livez", headers={"X-Request-ID": "mine-1"}).headers["x-request-id"] == "mine-1"
    for unusable in ("a b", "x" * 65, "<script>"):
        assert service.http.get("/livez", headers={"X-Request-ID": unusable}).headers["x-request-id"] != unusable
    assert "mine-1" in service.log.read_text()


def test_the_page(service):
    page = service.http.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert "<script>" not in page.text  # the policy forbids it
    for path in re.findall(r'(?:href|src)="(/[^"#]*)"', page.text):
        if path != "/docs":
            assert service.http.get(path).status_code == 200, path
    assert not re.search(r'(?:src|href)="(?:https?:)?//', page.text)  # nothing from other hosts


def test_the_installed_name(tmp_path):
    """An absolute import of the service works in a checkout, and fails in a wheel, where it has another name."""
    sources = (path.relative_to(ROOT).with_suffix("") for path in (ROOT / "service").rglob("*.py"))
    imported = ", ".join(f"kissgs_{'.'.join(path.parts).removesuffix('.__init__')}" for path in sources)
    code = f"import sys, {imported}; sys.exit('service' in sys.modules)"
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, check=True)


def test_the_command_escapes_what_standard_output_cannot_encode(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "argv", ["kissgs-serve", "--help"])
    with pytest.raises(SystemExit):
        main()
    out.flush()
    assert b"KISSGS_KEYS=\\u2026" in out.buffer.getvalue()
