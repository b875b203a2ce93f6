from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import pytest
from naoctl.client import ApiError, Client
from naoctl.errors import CliError, ExitCode
from naoctl.policies import Trained, folder_name
from naoctl.transfer import ATTEMPTS, RemoteFile, fetch, plain_name, safe_relative

CONTENT = bytes(range(256)) * 4096


def remote(name: str = "policy.npz", content: bytes = CONTENT) -> RemoteFile:
    return RemoteFile(name, "/files/policy.npz", len(content), hashlib.sha256(content).hexdigest())


def serve(server: Any, content: bytes = CONTENT, *, ranges: bool = True, cut_after: list[int] | None = None) -> None:
    """Serve a file; each number in ``cut_after`` breaks one connection after that many bytes."""
    cuts = list(cut_after or [])

    @server.on("GET", "/files/policy.npz")
    def answer(request: Any) -> None:
        begin = 0
        asked = request.headers.get("range")
        if ranges and asked:
            begin = int(asked.removeprefix("bytes=").removesuffix("-"))
        body = content[begin:]
        request.send_response(206 if begin else 200)
        if begin:
            request.send_header("content-range", f"bytes {begin}-{len(content) - 1}/{len(content)}")
        request.send_header("content-length", str(len(body)))
        request.end_headers()
        if cuts:
            request.wfile.write(body[: cuts.pop(0)])
            request.close_connection = True
        else:
            request.wfile.write(body)


def test_a_file_arrives_whole(server: Any, client: Client, tmp_path: Path) -> None:
    serve(server)
    told: list[int] = []
    path = fetch(client, remote("sub/policy.npz"), tmp_path / "new", progress=told.append)
    assert path == tmp_path / "new" / "sub" / "policy.npz"
    assert path.read_bytes() == CONTENT
    assert told == sorted(told)
    assert told[-1] == len(CONTENT)
    assert [p.name for p in path.parent.iterdir()] == ["policy.npz"]


def test_a_lost_connection_goes_on_where_it_stopped(server: Any, client: Client, tmp_path: Path) -> None:
    serve(server, cut_after=[300_000, 200_000])
    path = fetch(client, remote(), tmp_path, sleep=lambda seconds: None)
    assert path.read_bytes() == CONTENT
    begins = [asked.headers.get("Range") for asked in server.received]
    assert begins[0] is None
    assert len(begins) == 3
    first, second = (int(begin.removeprefix("bytes=").removesuffix("-")) for begin in begins[1:])
    assert 0 < first <= 300_000 < second <= 500_000


def test_an_interrupted_download_goes_on_in_the_next_run(server: Any, client: Client, tmp_path: Path) -> None:
    serve(server)
    (tmp_path / "policy.npz.part").write_bytes(CONTENT[:1000])
    assert fetch(client, remote(), tmp_path).read_bytes() == CONTENT
    assert server.received[0].headers["Range"] == "bytes=1000-"


def test_a_service_without_ranges_starts_over(server: Any, client: Client, tmp_path: Path) -> None:
    serve(server, ranges=False)
    (tmp_path / "policy.npz.part").write_bytes(b"old")
    assert fetch(client, remote(), tmp_path).read_bytes() == CONTENT


def test_what_is_there_and_right_is_not_fetched_again(server: Any, client: Client, tmp_path: Path) -> None:
    (tmp_path / "policy.npz").write_bytes(CONTENT)
    fetch(client, remote(), tmp_path)
    assert server.received == []


def test_what_is_there_and_wrong_is_replaced(server: Any, client: Client, tmp_path: Path) -> None:
    serve(server)
    (tmp_path / "policy.npz").write_bytes(b"x" * len(CONTENT))
    assert fetch(client, remote(), tmp_path).read_bytes() == CONTENT


@pytest.mark.parametrize("sent", [CONTENT[:-1] + b"!", CONTENT + b"!"])
def test_other_bytes_than_promised_are_not_kept(server: Any, client: Client, tmp_path: Path, sent: bytes) -> None:
    serve(server, sent)
    with pytest.raises(CliError) as caught:
        fetch(client, remote(), tmp_path, sleep=lambda seconds: None)
    assert caught.value.code is ExitCode.CORRUPT
    assert len(server.received) == ATTEMPTS
    assert not (tmp_path / "policy.npz").exists()
    assert not (tmp_path / "policy.npz.part").exists()


def test_a_part_of_another_file_is_found_out(server: Any, client: Client, tmp_path: Path) -> None:
    serve(server)
    (tmp_path / "policy.npz.part").write_bytes(b"y" * 1000)
    assert fetch(client, remote(), tmp_path, sleep=lambda seconds: None).read_bytes() == CONTENT
    assert len(server.received) == 2


def test_a_store_in_trouble_for_a_moment_is_asked_again(server: Any, client: Client, tmp_path: Path) -> None:
    """A proxy's page in place of the file, a longer and a shorter one, 404, 503, and another range."""
    page, pauses = b"<html>bad gateway</html>", list[float]()
    bad = [(200, page), (200, CONTENT + b"!"), (404, page), (503, page), (206, CONTENT[5:])]

    @server.on("GET", "/files/policy.npz")
    def answer(request: Any) -> None:
        status, body = bad.pop(0) if bad else (200, CONTENT)
        request.send_response(status)
        if status == 206:
            request.send_header("content-range", f"bytes 5-{len(CONTENT) - 1}/{len(CONTENT)}")
        request.send_header("content-length", str(len(body)))
        request.end_headers()
        request.wfile.write(body)

    assert fetch(client, remote(), tmp_path, sleep=pauses.append).read_bytes() == CONTENT
    assert len(pauses) == 5
    assert sum(pauses) > 15


def test_an_empty_file(server: Any, client: Client, tmp_path: Path) -> None:
    serve(server, b"")
    assert fetch(client, remote(content=b""), tmp_path).read_bytes() == b""


def test_a_refusal_is_not_written_to_the_file(server: Any, client: Client, tmp_path: Path) -> None:
    server.on("GET", "/files/policy.npz")(lambda request: request.problem(404, "gone"))
    with pytest.raises(ApiError, match="Gone"):
        fetch(client, remote(), tmp_path, sleep=lambda seconds: None)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../x", "a/../../x", "/etc/passwd", "a\\..\\x", "C:x", "a/", "a//../b", "x\0y", "./x"]
)
def test_names_that_lead_out_of_the_folder_are_refused(name: str) -> None:
    with pytest.raises(CliError, match="outside the folder"):
        safe_relative(name)


@pytest.mark.parametrize(
    "text", ["../../x", "/etc/cron.d/x", "..", "a/../../b", "\x1b[2J", ".ssh", "x" * 300, "", "-rf"]
)
def test_a_name_from_outside_becomes_a_plain_folder(text: str) -> None:
    """A reference of a policy, a job's name and its id."""
    policy = Trained(None, {"reference": text}).folder
    for name in (policy, folder_name({"name": text, "id": text}), plain_name(text)):
        assert Path(name).parts == (name,)
        assert not name.startswith((".", "-"))
        assert len(name) <= 70
        assert name.isascii()
        assert name.isprintable()


@pytest.mark.parametrize("url", ["http://other.example/x", "//other.example/x", "https:x", "files/x", "", "\\\\x"])
def test_the_token_is_sent_to_the_service_alone(server: Any, client: Client, tmp_path: Path, url: str) -> None:
    """An address that the service names for a file is a path of its own."""
    with pytest.raises(CliError, match="not one of its own"):
        fetch(client, RemoteFile("policy.npz", url, 1, "0" * 64), tmp_path)
    for ask in (client.get, lambda path: next(client.events(path))):
        with pytest.raises(CliError, match="not one of its own"):
            ask(url)
    assert server.received == []


def test_a_store_that_cuts_is_told_from_a_service_that_is_away(server: Any, client: Client, tmp_path: Path) -> None:
    """The service answers: starting it again would not help."""
    serve(server, cut_after=[1000] * ATTEMPTS)
    with pytest.raises(CliError, match=r"policy\.npz: the connection broke 7 times") as caught:
        fetch(client, remote(), tmp_path, sleep=lambda seconds: None)
    assert caught.value.code is ExitCode.UNREACHABLE
    assert "naoctl up" not in str(caught.value)
