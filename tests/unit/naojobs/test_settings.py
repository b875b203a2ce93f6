"""The settings: bad values are refused, and the message names the field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from naojobs.__main__ import main
from naojobs.settings import ServiceSettings, settings_words
from naosprint_api.settings import ApiSettings
from naosprint_worker.settings import WorkerSettings
from pydantic import SecretStr, ValidationError
from pydantic_settings import SettingsError

LOCAL: dict[str, Any] = {
    "mode": "local",
    "database_url": "postgresql://naosprint@/naosprint?host=/run",
    "broker_url": "redis://127.0.0.1:6379/0",
    "artifact_url": "file:///data",
}
PRODUCTION = {
    **LOCAL,
    "mode": "production",
    "database_url": "postgresql://naosprint:s3cr3t-of-my-own@db/naosprint",
    "broker_url": "redis://:another-of-my-own@broker/0",
}


@pytest.fixture(autouse=True)
def _no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    for name in list(os.environ):
        if name.startswith("NAOSPRINT_"):
            monkeypatch.delenv(name)


def test_one_machine_needs_no_secrets_and_production_does() -> None:
    assert ServiceSettings(**LOCAL).mode == "local"
    assert ServiceSettings(**PRODUCTION).mode == "production"
    with pytest.raises(ValidationError, match="database_url: its password"):
        ServiceSettings(**{**LOCAL, "mode": "production"})


def test_production_is_the_default() -> None:
    with pytest.raises(ValidationError, match="password"):
        ServiceSettings(**{name: value for name, value in LOCAL.items() if name != "mode"})


@pytest.mark.parametrize("password", ["naosprint", "changeme", "postgres", "minioadmin", ""])
@pytest.mark.parametrize("field", ["database_url", "broker_url"])
def test_well_known_passwords_are_refused(field: str, password: str) -> None:
    url = PRODUCTION[field]
    scheme, rest = url.split("://")
    host = rest.split("@")[1]
    with pytest.raises(ValidationError, match=f"{field}: its password"):
        ServiceSettings(**{**PRODUCTION, field: f"{scheme}://user:{password}@{host}"})


def test_an_own_s3_server_needs_a_secret() -> None:
    s3 = {**PRODUCTION, "artifact_url": "s3://bucket/prefix", "s3_endpoint": "http://store:8333"}
    with pytest.raises(ValidationError, match="s3_secret_access_key"):
        ServiceSettings(**s3)
    with pytest.raises(ValidationError, match="s3_secret_access_key"):
        ServiceSettings(**s3, s3_access_key_id="minio", s3_secret_access_key="minioadmin")
    ServiceSettings(**s3, s3_access_key_id="id", s3_secret_access_key="of-my-own")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("database_url", "sqlite:///x.db"),
        ("database_url", "mysql://u:p@h/d"),
        ("broker_url", "amqp://h"),
        ("artifact_url", "file://relative/path"),
        ("artifact_url", "/plain/path"),
        ("artifact_url", "s3://"),
        ("artifact_url", "memory:///"),
    ],
)
def test_strange_urls_are_refused_by_name(field: str, value: str) -> None:
    with pytest.raises(ValidationError, match=field):
        ServiceSettings(**{**LOCAL, field: value})


def test_a_lease_outlives_a_lost_heartbeat() -> None:
    with pytest.raises(ValidationError, match="heartbeat_s"):
        ServiceSettings(**LOCAL, lease_s=15, heartbeat_s=10)


def test_urls_name_the_driver_that_reads_them_and_secrets_stay_out_of_logs() -> None:
    settings = ServiceSettings(**PRODUCTION)
    assert settings.sqlalchemy_url.startswith("postgresql+psycopg://naosprint:")
    assert settings.libpq_url.startswith("postgresql://naosprint:")
    assert "of-my-own" not in repr(settings)


def test_the_environment_fills_them(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in LOCAL.items():
        monkeypatch.setenv(f"NAOSPRINT_{name.upper()}", value)
    assert ServiceSettings().artifact_url == "file:///data"  # type: ignore[call-arg]


@pytest.mark.parametrize(
    "url",
    [
        "://user:{}@host/db",
        "://user:{}/{}@host/db",
        "://user:{}#{}@host/db",
        "://user:{}?{}@host/db",
        "://user:{}@{}@host/db",
        "://user:p@host:{}/db",
        "://user:{}@[host/db",
        "://user:{}\n@host/db",
        "{}",
    ],
)
@pytest.mark.parametrize("field", ["database_url", "broker_url"])
def test_no_error_shows_a_part_of_a_secret(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], field: str, url: str
) -> None:
    """Neither of a URL that cannot be read, nor because something else is wrong."""
    scheme = "postgresql" if field == "database_url" else "redis"
    secret = "verys3cret"
    value = url.replace("{}", secret)
    environment = {**PRODUCTION, field: f"{scheme}{value}" if value[0] == ":" else value, "artifact_url": "nonsense"}
    for name, text in environment.items():
        monkeypatch.setenv(f"NAOSPRINT_{name.upper()}", text)
    assert main(["artifacts", "verify"]) == 2
    told = capsys.readouterr()
    assert secret not in told.out + told.err
    assert "NAOSPRINT_ARTIFACT_URL" in told.err
    if url not in ("://user:{}@host/db", "{}"):
        assert f"{field}: cannot be read" in told.err


@pytest.mark.parametrize("kind", [ServiceSettings, ApiSettings, WorkerSettings])
def test_every_secret_may_come_from_a_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: type[ServiceSettings]
) -> None:
    """A newline at the end of the file is not part of the secret."""
    secrets = {name for name, field in kind.model_fields.items() if "SecretStr" in str(field.annotation)}
    assert secrets >= {"database_url", "broker_url", "s3_access_key_id", "s3_secret_access_key"}
    for name in secrets:
        value = PRODUCTION.get(name, f"{name} of my own")
        (tmp_path / name).write_text(f"{value}\n")
        monkeypatch.setenv(f"NAOSPRINT_{name.upper()}_FILE", str(tmp_path / name))
    monkeypatch.setenv("NAOSPRINT_ARTIFACT_URL", "file:///data")
    settings = kind()  # type: ignore[call-arg]
    for name in secrets:
        value = getattr(settings, name)
        assert isinstance(value, SecretStr)
        assert value.get_secret_value() == PRODUCTION.get(name, f"{name} of my own")


def test_only_secrets_come_from_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "value").write_text("file:///elsewhere")
    monkeypatch.setenv("NAOSPRINT_ARTIFACT_URL_FILE", str(tmp_path / "value"))
    assert ServiceSettings(**LOCAL).artifact_url == "file:///data"


def test_a_file_and_a_variable_contradict_each_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "url").write_text(PRODUCTION["database_url"])
    monkeypatch.setenv("NAOSPRINT_DATABASE_URL", PRODUCTION["database_url"])
    monkeypatch.setenv("NAOSPRINT_DATABASE_URL_FILE", str(tmp_path / "url"))
    with pytest.raises(SettingsError, match="NAOSPRINT_DATABASE_URL and NAOSPRINT_DATABASE_URL_FILE") as caught:
        ServiceSettings()  # type: ignore[call-arg]
    assert "s3cr3t" not in settings_words(caught.value)


def test_a_file_that_cannot_be_read_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("NAOSPRINT_DATABASE_URL_FILE", str(tmp_path / "none"))
    assert main(["migrate"]) == 2
    assert capsys.readouterr().err.startswith("NAOSPRINT_DATABASE_URL_FILE: cannot read")
