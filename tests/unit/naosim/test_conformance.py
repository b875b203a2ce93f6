"""The simulators of this process conform, and the checks detect those that do not."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping
from types import ModuleType

import numpy as np
import pytest
from naosim import conformance, kinds, robots
from naosim.conformance import CHECKS, Check, Subject
from naosim.simspark import EmbeddedSimulator
from naosim.simulator import PLAIN, RobotMotion, Scene, Simulator, Starts

from .toy_simulator import CRAWLER, CRAWLING, CrawlerSimulator


def embedded(name: str, scene: Scene = PLAIN, settings: Mapping[str, object] = {}, **parameters: object) -> Subject:
    robot, kind = robots.get(name).with_parameters(parameters), kinds.get("embedded")
    chosen = kind.parameters(robot).model_validate(dict(settings))
    return Subject(lambda n: kind.open(robot, n, chosen, scene=scene), abilities=kind.abilities(robot))


SUBJECTS = {
    "nao-0": embedded("nao-0"),
    "nao-4": Subject(lambda n: EmbeddedSimulator(robots.get("nao-4"), n, sensor_digits=None, threads=2)),
    "nao-0 onboard": embedded("nao-0", onboard_sensing=True),
    "t1, fast": embedded("t1", settings={"engine": "fast"}),
    "t1, mujoco": embedded("t1", settings={"engine": "mujoco"}),
    "k1": embedded("k1"),
    "t1 with a ball": embedded("t1", Scene(ball=True)),
    "t1 with a ball, mujoco": embedded("t1", Scene(ball=True, goals=True), {"engine": "mujoco"}),
    "k1 with a ball": embedded("k1", Scene(ball=True, goals=True)),
    "k1 with bodies": embedded("k1", Scene(bodies=True)),
    "crawler": Subject(lambda n: CrawlerSimulator(CRAWLER, n)),
}


@pytest.mark.parametrize("subject", SUBJECTS.values(), ids=SUBJECTS)
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_embedded_simulators_conform(check: Check, subject: Subject) -> None:
    check(subject)


class Forgetful(CrawlerSimulator):
    """Restores everything but the torso."""

    def restore(self, state: np.ndarray) -> None:
        self.state[:, :2] = state.view(np.float64)[:, :2]
        self.sense()


class Careless(CrawlerSimulator):
    """Steps inactive robots too."""

    def step_async(self, targets_rad: np.ndarray, rows: slice, active: np.ndarray | None = None) -> None:
        super().step_async(targets_rad, rows)


class Slow(CrawlerSimulator):
    """Claims to be slower than it is."""

    latency_steps = 3


class Chatty(CrawlerSimulator):
    """Has perceptors that its robot does not have."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)
        self.perceptors["gyro"] = np.zeros((self.n, 3))


class Immortal(CrawlerSimulator):
    """Can be used after it was closed."""

    def require_open(self) -> None:
        pass


class Chaotic(CrawlerSimulator):
    """Moves at random."""

    rng = np.random.default_rng(0)

    def step_wait(self, rows: slice) -> None:
        self.state[rows, 2] += self.rng.normal()
        super().step_wait(rows)


class Negligent(CrawlerSimulator):
    """Accepts any index of a start."""

    def require_starts(self, starts: np.ndarray, loaded: int) -> None:
        starts %= max(loaded, 1)


@pytest.mark.parametrize(
    ("kind", "caught"),
    [
        (CrawlerSimulator, set()),
        (Forgetful, {"snapshots_are_complete"}),
        (Careless, {"inactive_robots_keep_still"}),
        (Slow, {"latency_is_what_it_says"}),
        (Chatty, {"arrays_match_the_robot"}),
        (Immortal, {"a_closed_simulator_refuses_use"}),
        (Negligent, {"unknown_starts_are_refused"}),
    ],
)
def test_what_does_not_conform_is_named(kind: Callable[..., Simulator], caught: set[str]) -> None:
    results = conformance.check(lambda n: kind(CRAWLER, n))
    assert {result.name for result in results if not result.passed} == caught
    assert all(result.message for result in results if not result.passed)


def test_chance_is_noticed() -> None:
    failed = {result.name for result in conformance.check(lambda n: Chaotic(CRAWLER, n)) if not result.passed}
    assert {"steps_are_deterministic", "snapshots_are_complete", "inactive_robots_keep_still"} <= failed


def test_simulators_refuse_robots_of_families_that_they_lack(monkeypatch: pytest.MonkeyPatch) -> None:
    """A family may have one of the two simulators, or none."""
    embedded, server = kinds.get("embedded"), kinds.get("server")
    assert not embedded.supports(CRAWLER)
    with pytest.raises(ValueError, match="simulator: 'embedded' cannot run crawler"):
        embedded.parameters(CRAWLER)
    module = ModuleType("crawling")
    module.EMBEDDED = CRAWLING
    monkeypatch.setitem(sys.modules, "crawling", module)
    monkeypatch.setattr(kinds, "FAMILIES", {"toy": "crawling"})
    assert embedded.supports(CRAWLER)
    assert embedded.open(CRAWLER, 2, embedded.parameters(CRAWLER)()).n == 2
    assert not server.supports(CRAWLER)
    assert not server.supports(robots.get("nao-0"))


@pytest.mark.parametrize("scene", [Scene(ball=True), Scene(goals=True), Scene(bodies=True)])
@pytest.mark.parametrize(("name", "robot"), [("embedded", "nao-0"), ("server", "nao-3"), ("crawling", "crawler")])
def test_scenes_that_a_simulator_lacks_are_refused(name: str, robot: str, scene: Scene) -> None:
    kind = CRAWLING if name == "crawling" else kinds.get(name)
    description = CRAWLER if robot == "crawler" else robots.get(robot)
    assert kind.refusal(description, PLAIN) == ""
    refusal = kind.refusal(description, scene)
    assert robot in refusal and "no ball" in refusal
    with pytest.raises(ValueError, match="no ball"):
        kind.open(description, 1, kind.parameters(description)(), scene=scene)


def test_places_of_starts_are_one_or_one_each() -> None:
    poses = np.zeros((2, 2))
    assert Starts(poses, (-3.0, 2.0), 0.5).places().tolist() == [[-3.0, 2.0, 0.5]] * 2
    assert Starts(poses, (-3.0, 2.0), 0.5).place() == (-3.0, 2.0, 0.5)
    own = Starts(poses, np.array([[0.0, 1.0], [2.0, 3.0]]), np.array([0.1, 0.2]))
    assert own.places().tolist() == [[0.0, 1.0, 0.1], [2.0, 3.0, 0.2]]
    with pytest.raises(ValueError, match="one position and heading for all starts"):
        own.place()
    for place in ((1.0,), (1.0, 2.0, 3.0)):
        with pytest.raises(ValueError, match="one for each of 2 starts"):
            Starts(np.zeros((2, 2)), place).places()  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="one for each of 2 starts"):
        Starts(poses, np.zeros((3, 2))).places()
    with pytest.raises(ValueError, match="finite"):
        Starts(poses, heading_rad=np.array([0.0, np.nan])).places()


def test_a_plain_simulator_has_no_ball_and_starts_at_rest() -> None:
    simulator = CrawlerSimulator(CRAWLER, 1)
    with pytest.raises(ValueError, match="open it with Scene"):
        simulator.place_ball(np.array([0]), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="begin at rest only"):
        simulator.motion(np.array([0]))
    motion = RobotMotion(*(np.zeros((1, width)) for width in (2, 2, 3, 4, 3, 3, 2)))
    with pytest.raises(ValueError, match="begin at rest only"):
        simulator.set_motion(np.array([0]), motion)


def test_descriptions_and_interface_need_no_simulator() -> None:
    """The API reads robots, simulators and their parameters; it has neither the compiled engine nor MuJoCo."""
    code = """
import sys
import naosim.conformance, naosim.kinds, naosim.robots, naosim.simulator
for name in naosim.robots.names():
    robot = naosim.robots.get(name)
    for kind in map(naosim.kinds.get, naosim.kinds.names()):
        if kind.supports(robot):
            kind.parameters(robot).model_json_schema()
print([name for name in ("naosim.simspark._core", "mujoco", "gymnasium", "torch") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
