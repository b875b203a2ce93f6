"""The launcher service, against an engine that decodes requests as Docker's does."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import threading
import time
import unicodedata
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_network
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import parse_qs, unquote, urlsplit

import pytest
import uvicorn
from docker import APIClient
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from naosim.launchers import LauncherUnavailableError, SidecarLauncher, launcher_from_environment
from naosim.launchers.docker import LABEL
from naosim.mujoco.program import RCSSSERVERMJ
from naosim.sidecars import MOST_CONNECTIONS, Sidecars, configured, create_app, own_container
from naosim.simspark.program import RCSSSERVER3D

LAUNCHER, WORKER, STRANGER = "1" * 64, "2" * 64, "3" * 64
JOB = "job_01k0000000000000000000000a"
IMAGES = {"rcssserver3d": "test/rcssserver3d:1", "rcssservermj": "test/rcssservermj:1"}
MOST = 8
SUBNETS = list(ip_network("198.19.0.0/16").subnets(new_prefix=24))


def decode_as_go(text: bytes) -> Any:
    """Decode JSON as the engine does: names in any case and with letters that fold, the last of two counts."""

    def fold(name: str) -> str:
        return unicodedata.normalize("NFKC", name).casefold()

    def merge(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in pairs:
            name = fold(name)
            both = isinstance(value, dict) and isinstance(found.get(name), dict)
            found[name] = found[name] | value if both else value
        return found

    return json.loads(text.decode(errors="replace"), object_pairs_hook=merge)


class Engine(ThreadingHTTPServer):
    """Docker's engine as far as the launcher uses it; keeps what it decoded."""

    daemon_threads = True
    address_family = socket.AF_UNIX
    request_queue_size = 128  # on a busy machine five callers are soon waiting, and the sixth is refused

    def __init__(self, path: Path) -> None:
        self.requests: list[tuple[str, str, dict[str, list[str]], Any]] = []
        self.containers: dict[str, Any] = {}
        self.networks: dict[str, Any] = {}
        self.joined: set[tuple[str, str]] = set()
        self.fails = ""
        self.version = "1.45"
        self.foreign: set[str] = set()
        self.running = {LAUNCHER, WORKER}
        self.changed = threading.Condition()
        super().__init__(str(path), Handler)  # type: ignore[arg-type]

    def server_bind(self) -> None:
        self.socket.bind(self.server_address)  # type: ignore[arg-type]

    def wait_until_empty(self) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: not self.containers and not self.networks, 10)


class Handler(BaseHTTPRequestHandler):
    server: Engine
    protocol_version = "HTTP/1.1"

    def address_string(self) -> str:
        return "unix"

    def log_message(self, *_: Any) -> None:
        pass

    def _answer(self) -> None:
        engine, parts = self.server, urlsplit(self.path)
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        path = [unquote(part) for part in parts.path.split("/")[1:]]
        path = path[1:] if path[0].startswith("v1.") else path
        query, data = parse_qs(parts.query), decode_as_go(body) if body else None
        with engine.changed:
            engine.requests.append((self.command, "/".join(path), query, data))
            status, answer = self._do(engine, path, query, data)
            engine.changed.notify_all()
        text = b"" if status == 204 else json.dumps(answer).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)

    def _do(self, engine: Engine, path: list[str], query: dict[str, list[str]], data: Any) -> tuple[int, Any]:
        if engine.fails and engine.fails in "/".join(path):
            return 500, {"message": "engine broken"}
        match self.command, path:
            case _, ["_ping"]:
                return 200, "OK"
            case "GET", ["version"]:
                return 200, {"Version": "test", "ApiVersion": engine.version}
            case "GET", ["containers", "json"] if "all" not in query or query["all"] == ["0"]:
                return 200, [{"Id": one} for one in engine.running]
            case "GET", ["containers", "json"]:
                return 200, [
                    {"Id": name, "Names": [f"/{name}"], "Labels": one["labels"]}
                    for name, one in engine.containers.items()
                ]
            case "GET", ["networks"]:
                return 200, [{"Name": name, "Labels": one["labels"]} for name, one in engine.networks.items()]
            case "GET", ["networks", "front"]:
                members = {LAUNCHER: "127.0.0.1/8", WORKER: "127.0.0.1/8", STRANGER: "10.0.0.9/8"}
                return 200, {"Containers": {one: {"IPv4Address": address} for one, address in members.items()}}
            case "GET", ["networks", name] if name in engine.networks:
                members = {one: {} for one, network in engine.joined if network == name}
                return 200, {"Containers": members}
            case "POST", ["networks", "create"]:
                subnet = data["ipam"]["config"][0]["subnet"]
                if subnet in engine.foreign | {one["ipam"]["config"][0]["subnet"] for one in engine.networks.values()}:
                    return 403, {"message": "invalid pool request: Pool overlaps with other one on this address space"}
                engine.networks[data["name"]] = data
                return 201, {"Id": data["name"]}
            case "POST", ["networks", name, "connect" | "disconnect" as what]:
                (engine.joined.add if what == "connect" else engine.joined.discard)((data["container"], name))
                return 200, {}
            case "DELETE", ["networks", name] if name in engine.networks:
                if any(network == name for _, network in engine.joined):
                    return 403, {"message": "network has active endpoints"}
                del engine.networks[name]
                return 204, None
            case "GET", ["containers", identifier, "json"] if identifier == LAUNCHER:
                labels = {"com.docker.compose.project": "tests"}
                return 200, {
                    "Id": LAUNCHER,
                    "Config": {"Labels": labels},
                    "NetworkSettings": {"Networks": {"front": {}}},
                }
            case "GET", ["containers", name, "json"] if name in engine.containers:
                state = {"Running": True, "Status": "running", "ExitCode": 0}
                return 200, {"State": state, "Config": {"Tty": True}}
            case "GET", ["containers", name, "logs"]:
                return 200, {}
            case "POST", ["containers", "create"]:
                engine.containers[query["name"][-1]] = data
                return 201, {"Id": query["name"][-1], "Warnings": []}
            case "POST", ["containers", name, "start" | "stop"] if name in engine.containers:
                return 204, None
            case "DELETE", ["containers", name] if name in engine.containers:
                del engine.containers[name]
                return 204, None
        return 404, {"message": "no such thing"}

    do_GET = do_POST = do_DELETE = do_HEAD = do_PUT = _answer


class Service:
    """The launcher service on a port of the loopback, with its engine."""

    engine: ClassVar[Engine]

    def __init__(self, engine: Engine, socket_path: Path) -> None:
        self.engine = engine
        self.sidecars = Sidecars(APIClient(f"unix://{socket_path}", version="1.45"), IMAGES, LAUNCHER, most=MOST)
        listener = socket.create_server(("127.0.0.1", 0))
        self.port = listener.getsockname()[1]
        self.server = uvicorn.Server(configured(create_app(self.sidecars)))
        self.thread = threading.Thread(target=self.server.run, args=([listener],), daemon=True)
        self.thread.start()
        self.url = f"http://127.0.0.1:{self.port}"

    @contextlib.contextmanager
    def hold(self, body: bytes, method: str = "POST", path: str = "/servers") -> Iterator[tuple[int, bytes]]:
        """Yield status and first line of an answer; what was started lasts as long."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        with contextlib.closing(connection):
            connection.putrequest(method, path)
            connection.putheader("Content-Length", str(len(body)))
            connection.endheaders(body)
            with connection.getresponse() as response:
                yield response.status, response.readline()

    def ask(self, method: str, path: str, body: bytes = b"") -> tuple[int, bytes]:
        """Return status and first line of an answer."""
        with self.hold(body, method, path) as answer:
            return answer

    def close(self) -> None:
        self.server.should_exit = True
        self.thread.join(10)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    path = tmp_path_factory.mktemp("engine") / "s"
    engine = Engine(path)
    threading.Thread(target=engine.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
    service = Service(engine, path)
    deadline = time.monotonic() + 10
    while not service.server.started:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    yield service
    service.close()
    engine.shutdown()
    engine.server_close()


@pytest.fixture
def service(running: Service) -> Iterator[Service]:
    engine = running.engine
    engine.requests.clear()
    engine.fails, engine.running, engine.foreign = "", {LAUNCHER, WORKER}, set()
    yield running
    engine.fails = ""
    running.sidecars.close()
    running.sidecars.sweep()
    engine.wait_until_empty()


def order(**changes: Any) -> bytes:
    return json.dumps({"server": "rcssserver3d", "job": JOB, "attempt": 1, "count": 1} | changes).encode()


def expected_container(name: str, server: str, job: str, attempt: int, network: str) -> dict[str, Any]:
    """Return all that a request for a server's container may say, as the engine decodes it."""
    program = {"rcssserver3d": RCSSSERVER3D, "rcssservermj": RCSSSERVERMJ}[server]
    return {
        "image": IMAGES[server],
        "user": "10001:10001",
        "cmd": program.container_command(),
        "labels": {
            LABEL: "1",
            "job": job,
            "attempt": str(attempt),
            "naosim.deployment": "tests",
            "naosim.owner.container": WORKER,
        },
        "hostconfig": {
            "init": True,
            "memory": 512 << 20,
            "memoryswap": 512 << 20,
            "nanocpus": 1_000_000_000,
            "pidslimit": 64,
            "capdrop": ["ALL"],
            "securityopt": ["no-new-privileges"],
            "readonlyrootfs": True,
            "tmpfs": {"/tmp": "size=16m,mode=1777"},
            "logconfig": {"type": "json-file", "config": {"max-size": "1m", "max-file": "1"}},
            "networkmode": network,
        },
    }


def without_defaults(value: Any) -> Any:
    """Return a decoded request without what says nothing."""
    if isinstance(value, dict):
        found = {key: without_defaults(one) for key, one in value.items()}
        return {key: one for key, one in found.items() if one not in (None, False, "", [], {})}
    return value


def check_requests(engine: Engine) -> None:
    """Check that the engine was asked for nothing but our servers, in the one form that they have."""
    for method, path, query, data in engine.requests:
        what = path.split("/")
        if (method, path) == ("POST", "containers/create"):
            (name,) = query.pop("name")
            assert not query.keys() - {"platform"}
            labels, network = data["labels"], data["hostconfig"]["networkmode"]
            assert network.startswith("naosim-") and name.startswith("naosim-") and name != network
            server = "rcssserver3d" if "rcssserver3d" in data["image"] else "rcssservermj"
            # the SDK says a few things that are the engine's defaults
            found = without_defaults(data)
            assert found == expected_container(name, server, labels["job"], int(labels["attempt"]), network)
        elif (method, path) == ("POST", "networks/create"):
            labels = data.pop("labels")
            assert data.pop("name").startswith("naosim-")
            assert labels["naosim.owner.container"] == WORKER
            (subnet,) = data.pop("ipam")["config"]
            assert subnet.keys() == {"subnet"} and ip_network(subnet["subnet"]) in SUBNETS
            options = {"com.docker.network.bridge.inhibit_ipv4": "true"}
            assert without_defaults(data) == {"driver": "bridge", "internal": True, "options": options}
        elif what[0] == "networks" and what[-1] in ("connect", "disconnect"):
            assert what[1].startswith("naosim-") and data["container"] == WORKER
        elif method == "POST":
            assert what[0] == "containers" and what[1].startswith("naosim-") and what[2] in ("start", "stop")
        elif method == "DELETE":
            assert what[1].startswith("naosim-")
        else:
            assert method in ("GET", "HEAD")


@pytest.mark.parametrize("program", [RCSSSERVER3D, RCSSSERVERMJ], ids=lambda program: program.name)
def test_a_worker_gets_a_server_of_the_one_form_that_there_is(service: Service, program: Any) -> None:
    launcher = SidecarLauncher(program, service.url, JOB, 3)
    first, second = launcher.start(), launcher.start()
    assert first.address.host in service.engine.containers
    assert (first.address.agent_port, first.address.monitor_port) == (program.agent_port, program.monitor_port)
    (network,) = service.engine.networks
    assert service.engine.joined == {(WORKER, network)}, "servers of one attempt share a network"
    assert first.alive() and "running" in first.describe()
    first.stop()
    assert set(service.engine.containers) == {second.address.host} and network in service.engine.networks
    assert not first.alive()
    second.stop()
    assert not service.engine.containers and not service.engine.networks and not service.engine.joined
    check_requests(service.engine)


def test_servers_end_with_the_connection_of_whoever_asked_for_them(service: Service) -> None:
    with service.hold(order(count=3)) as (status, _):
        assert status == 200 and len(service.engine.containers) == 3
    service.engine.wait_until_empty()


def test_the_engine_s_refusal_leaves_nothing_and_names_the_reason(service: Service) -> None:
    service.engine.fails = "start"
    with pytest.raises(OSError, match="engine broken"):
        SidecarLauncher(RCSSSERVER3D, service.url, JOB, 1).start()
    service.engine.wait_until_empty()


def test_what_an_earlier_run_left_and_what_lost_its_worker_is_removed(service: Service) -> None:
    engine = service.engine
    labels = {LABEL: "1", "naosim.deployment": "tests", "naosim.owner.container": WORKER}
    engine.containers["naosim-left"] = {"labels": labels}
    engine.networks["naosim-left-too"] = {"labels": labels, "ipam": {"config": [{"subnet": str(SUBNETS[0])}]}}
    engine.joined.add((WORKER, "naosim-left-too"))
    with service.hold(order(count=2)):
        service.sidecars.sweep()
        assert len(engine.containers) == 2 and len(engine.networks) == 1, "what is in use stays"
        assert all(network in engine.networks for _, network in engine.joined)
        engine.running = {LAUNCHER}
        service.sidecars.sweep()
        assert not engine.containers and not engine.networks and not engine.joined


def test_networks_take_the_subnets_that_are_free(service: Service) -> None:
    engine = service.engine
    engine.foreign = {str(one) for one in SUBNETS[2:]}
    with service.hold(order(attempt=1)) as (first, _), service.hold(order(attempt=2)) as (second, _):
        assert first == second == 200
        assert {one["ipam"]["config"][0]["subnet"] for one in engine.networks.values()} == {*map(str, SUBNETS[:2])}
        status, line = service.ask("POST", "/servers", order(attempt=3))
        assert status == 500 and b"subnets for servers is in use" in line
    engine.wait_until_empty()


def test_another_error_of_a_network_is_not_tried_again(service: Service) -> None:
    service.engine.fails = "networks/create"
    assert service.ask("POST", "/servers", order())[0] == 500
    assert [path for _, path, *_ in service.engine.requests].count("networks/create") == 1


def test_an_engine_that_is_too_old_is_refused(running: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running.engine, "version", "1.9")
    with pytest.raises(OSError, match="Docker Engine test is too old; the launcher needs 25 or newer"):
        Sidecars(running.sidecars._api, IMAGES, LAUNCHER)


def test_there_is_a_limit_and_it_counts_what_runs(service: Service) -> None:
    with service.hold(order(count=MOST)) as (status, _):
        assert status == 200
        with pytest.raises(LauncherUnavailableError, match=f"{MOST} of at most {MOST} servers run"):
            SidecarLauncher(RCSSSERVER3D, service.url, JOB, 1).start()
    service.engine.wait_until_empty()
    assert service.ask("POST", "/servers", order())[0] == 200


def test_callers_are_known_by_their_address_and_reach_their_own_servers_only(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = SidecarLauncher(RCSSSERVER3D, service.url, JOB, 1).start()
    path = f"/servers/{server.address.host}"
    monkeypatch.setattr(service.sidecars, "caller", lambda _: STRANGER)
    assert service.ask("GET", path)[0] == 404
    assert service.ask("DELETE", path)[0] == 404
    monkeypatch.undo()
    assert server.alive()
    assert service.sidecars.caller("10.0.0.9") == STRANGER
    monkeypatch.setattr(service.sidecars, "_networks", [])
    status, line = service.ask("POST", "/servers", order())
    assert status == 403 and b"not a container of this deployment" in line
    monkeypatch.undo()
    server.stop()


REFUSED = {
    "another image": order(image="alpine"),
    "another server": order(server="alpine"),
    "a foreign name": order(job="naosprint-postgres-1"),
    "a path": order(job="job_01k000000000000000000000/a"),
    "a line more": order(job=JOB + "\n"),
    "too many": order(count=65),
    "none": order(count=0),
    "a number as text": order(attempt="1"),
    "a number that is large": order(attempt=10**400),
    "what the engine would read": order(HostConfig={"Privileged": True}),
    "the same beside it": order()[:-1] + b', "hostconfig": {"Binds": ["/:/host"]}}',
    "nothing": b"",
    "a list": b"[]",
    "no JSON": b"{",
    "no UTF-8": order()[:-2] + b'\xff"}',
}


@pytest.mark.parametrize("what", REFUSED)
def test_an_order_that_says_anything_else_is_refused(service: Service, what: str) -> None:
    status, line = service.ask("POST", "/servers", REFUSED[what])
    assert status == 422 and b"detail" in line, line
    assert not any(method == "POST" for method, *_ in service.engine.requests)


def test_a_large_order_is_refused_before_it_is_read(service: Service) -> None:
    assert service.ask("POST", "/servers", b" " * 2_000)[0] == 413


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("POST", "/v1.45/containers/create?name=naosim-0123456789ab"),
        ("POST", "/networks/create"),
        ("GET", "/containers/json"),
        ("GET", "/info"),
        ("POST", "/images/create?fromImage=alpine"),
        ("PUT", "/servers"),
        ("GET", "/servers/..%2f..%2finfo"),
        ("DELETE", f"/servers/{LAUNCHER}"),
        ("DELETE", "/servers/naosim-%6ceft"),
    ],
)
def test_the_service_does_not_speak_docker(service: Service, method: str, path: str) -> None:
    status, _ = service.ask(method, path, order())
    assert status in (404, 405)
    assert not any(method != "GET" for method, *_ in service.engine.requests)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=12), inner, max_size=3),
    max_leaves=6,
)
FIELDS = st.fixed_dictionaries(
    {},
    optional={
        "server": st.sampled_from(["rcssserver3d", "rcssservermj", "alpine"]) | JSON,
        "job": st.just(JOB) | st.text(max_size=40) | JSON,
        "attempt": st.integers(-1, 3) | JSON,
        "count": st.integers(-1, 3) | JSON,
    },
)
EXTRAS = st.dictionaries(
    st.sampled_from(["Image", "HostConfig", "hostconfig", "Binds", "NetworkMode", "X", "Internal", "\u017ferver"]),
    JSON,
    max_size=2,
)


@settings(max_examples=50, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
@given(
    fields=FIELDS,
    extras=EXTRAS,
    method=st.sampled_from(["POST", "PUT", "GET", "DELETE"]),
    path=st.just("/servers") | st.text("/servers.%?=&naosim-0", max_size=24).map(lambda text: "/" + text),
    broken=st.binary(max_size=8),
)
@example(
    fields={"server": "rcssservermj", "job": JOB, "attempt": 2, "count": 2},
    extras={},
    method="POST",
    path="/servers",
    broken=b"",
)
def test_whatever_a_worker_says_the_engine_is_asked_for_servers_alone(
    service: Service, fields: dict[str, Any], extras: dict[str, Any], method: str, path: str, broken: bytes
) -> None:
    status, line = service.ask(method, path, json.dumps(fields | extras).encode() + broken)
    assert status < 500, line
    service.engine.wait_until_empty()
    check_requests(service.engine)
    service.engine.requests.clear()


def test_the_environment_names_the_service(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NAOSPRINT_SIMSERVER", f"launcher:{service.url}")
    with pytest.raises(ValueError, match=r"NAOSPRINT_SIMSERVER_LABELS: .*job=ID,attempt=NUMBER"):
        launcher_from_environment("NAOSPRINT_SIMSERVER", RCSSSERVER3D)
    monkeypatch.setenv("NAOSPRINT_SIMSERVER_LABELS", f"job={JOB},attempt=2")
    server = launcher_from_environment("NAOSPRINT_SIMSERVER", RCSSSERVER3D).start()
    (container,) = service.engine.containers.values()
    assert (container["labels"]["job"], container["labels"]["attempt"]) == (JOB, "2")
    server.stop()
    with pytest.raises(ValueError, match="expected http://HOST:PORT"):
        SidecarLauncher(RCSSSERVER3D, "tcp://docker-proxy", JOB, 1)


def test_a_service_that_does_not_answer_may_come_back() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(LauncherUnavailableError):
        SidecarLauncher(RCSSSERVER3D, f"http://127.0.0.1:{port}", JOB, 1).start()


def test_a_process_finds_the_container_that_it_runs_in(tmp_path: Path) -> None:
    mounts = tmp_path / "mountinfo"
    identifier = "0123456789abcdef" * 4
    mounts.write_text(
        "700 690 0:29 / /proc rw,nosuid - proc proc rw\n"
        f"812 690 254:0 /var/lib/docker/containers/{identifier}/hostname /etc/hostname rw,relatime - ext4 /dev/vda rw\n"
    )
    assert own_container(mounts) == identifier
    mounts.write_text("700 690 254:0 / / rw,relatime - ext4 /dev/vda rw\n")
    assert own_container(mounts) is None
    assert own_container(tmp_path / "none") is None


def test_a_caller_that_holds_connections_leaves_some_to_others(running: Service) -> None:
    held = [socket.create_connection(("127.0.0.1", running.port), timeout=20) for _ in range(1024)]
    try:
        for connection in held[:MOST_CONNECTIONS]:
            connection.sendall(b"POST /servers HTTP/1.1\r\nHost: x\r\n")
        with socket.create_connection(("127.0.0.1", running.port), timeout=20) as one_more:
            assert b" 503 " in one_more.recv(4096)
        with socket.create_connection(("127.0.0.1", running.port), 20, ("127.0.0.2", 0)) as other:
            other.sendall(b"GET /health HTTP/1.1\r\nHost: x\r\n\r\n")
            assert b" 204 " in other.recv(4096)
    finally:
        for connection in held:
            connection.close()
