"""Ports that are free, and that the system does not give to anybody else meanwhile."""

from __future__ import annotations

import socket
from itertools import islice
from pathlib import Path

import pytest
from naospec import ports
from naospec.ports import free_ports


def test_a_port_is_given_once_and_not_to_connections_nor_if_it_is_taken() -> None:
    first_given = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text("utf-8").split()[0])
    with socket.create_server(("127.0.0.1", next(free_ports()))) as taken:
        found = list(free_ports())
        assert taken.getsockname()[1] not in found
    assert len(set(found)) == len(found) > 1000
    assert max(found) < first_given


def test_two_choices_begin_apart() -> None:
    assert len({next(free_ports()) for _ in range(20)}) > 10


@pytest.mark.parametrize("content", ["1024\t65000\n", "20500\t65000\n"])
def test_a_system_that_gives_nearly_all_ports_chooses_them(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "range").write_text(content)
    monkeypatch.setattr(ports, "_RANGE", tmp_path / "range")
    first_given = ports._first_given()
    assert first_given == int(content.split()[0])
    for port in islice(free_ports(), 5):
        socket.create_server(("127.0.0.1", port)).close()


def test_without_the_systems_range_the_usual_one_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "_RANGE", tmp_path / "none")
    assert 20_000 <= next(free_ports()) < 32_768
