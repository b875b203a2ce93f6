"""A task with n robots: actions in, observations and rewards out."""

from __future__ import annotations

from collections.abc import Iterable, Sized
from numbers import Real
from time import perf_counter
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from naosim import kinds, robots
from naosim.simulator import NativeHandle, RuntimeOptions, Simulator, Starts
from naospec.sections import require_plain_names

from naosprint import _compiled
from naosprint.tasks.base import RewardTerm, Task, get
from naosprint.tasks.disturbances import Disturbances
from naosprint.tasks.measurements import StoredNumbers, kept
from naosprint.tasks.observations import ObservationBlock, Observer, blocks, require_numbers
from naosprint.tasks.world import World
from naosprint.terms import Number
from naosprint.terms.compiled import compilable, operation

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from naospec import TaskSettings, TrainingSpec

    from naosprint.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
    from naosprint.tasks.base import End
    from naosprint.terms import Store

Part = TypeVar("Part", "RewardTerm", ObservationBlock)

SHORT_EPISODE_STEPS = 100
"""Steps after which short episodes are truncated: by then a robot runs."""

TRAINING_STARTS = 256
"""Starts that a training chooses from, if there is start noise."""

PERCEIVED = "perceived_angles"
"""Joint angles with their noise, if motors follow these."""

STORES = "stores."
"""Before the names of arrays of a state that stores keep and no list of arrays names."""


class Environment:
    """n robots that do one task, without a Python loop over them.

    Robots are started by :meth:`restart` and stepped together. A robot whose episode has ended stays where it is while
    the ``active`` mask leaves it out, until it is restarted.

    Args:
        simulator: the robots.
        task_class: the task.
        parameters: its settings.
        seed: seed of what the task draws.
        compiled: whether steps run compiled if every part of the task has a compiled form; the bits are the same.
        critic: whether observations contain those that only a critic has.

    Attributes:
        observations: (n, D) the latest observations of a policy; with those of a critic (n, D + C).
        rewards: (n,) rewards of the latest step.
        terminated: (n,) whether the latest step ended the episode by one of the task's ends, or at its horizon.
        truncated: (n,) whether the latest step truncated the episode: by a time limit that does not belong to the task,
            at the end of a short episode, or because the robot was lost.
        failed: (n,) whether it ended by a failure, after which nothing can follow.
        ends: by name of an end, (n,) whether the latest step reached it.
        lost: (n,) whether the latest step lost the robot; its observation is the one before the step.
        short: (n,) environments whose episodes are truncated after ``SHORT_EPISODE_STEPS``.
        simulator_s: seconds that steps have waited for the simulator so far.
        compiled: whether steps run compiled.

    Raises:
        ValueError: if parts of the task do not fit together; the message names the task and the part.
    """

    def __init__(
        self,
        simulator: Simulator,
        task_class: type[Task],
        parameters: TaskSettings,
        seed: int = 0,
        *,
        compiled: bool = True,
        critic: bool = False,
    ) -> None:
        simulator.require_whole()
        n = simulator.n
        self.n = n
        self.simulator = simulator
        self.world = World(simulator)
        self.actuation = self.world.actuation
        self.task = task_class(parameters, self.world, seed)
        require_plain_names("joints", self.world.robot.joint_names)
        _require_fit(self.task, self.world)
        terms = _listed(self.task, "reward_terms", RewardTerm)
        _require_terms(self.task, terms)
        self._terms = [term for term in terms if term.weight != 0.0]
        self._scale = float(parameters.reward_scale)
        self.disturbances = Disturbances(parameters, simulator, seed, self.world.streams)
        privileged: list[ObservationBlock] = []
        if critic:
            unseen = blocks(self.world, self.world.defaults.privileged)
            own = _listed(self.task, "critic_blocks", ObservationBlock)
            privileged = [*own, *self.disturbances.critic_blocks(), *unseen]
        observed = _listed(self.task, "observation_blocks", ObservationBlock)
        self.observer = Observer(n, observed, parameters.history_steps, privileged)
        require_plain_names("observations", (*self.observer.names, *self.observer.critic_names))
        _require_arrays(self.task)
        self._kept = self._kept_by_stores()
        self._new = {name: array.copy() for name, array in self._arrays.items()}
        self.rewards: FloatArray = np.zeros(n)
        self.simulator_s = 0.0
        self.terminated: BoolArray = np.zeros(n, dtype=np.bool_)
        self.truncated: BoolArray = np.zeros(n, dtype=np.bool_)
        self.failed: BoolArray = np.zeros(n, dtype=np.bool_)
        self.lost: BoolArray = np.zeros(n, dtype=np.bool_)
        self.ends: dict[str, BoolArray] = {end.name: np.zeros(n, dtype=np.bool_) for end in self.task.ends}
        self.short: BoolArray = np.zeros(n, dtype=np.bool_)
        self._targets: FloatArray = np.zeros((n, self.actuation.n_joints))
        self._program = self._compile() if compiled else None
        self.compiled = self._program is not None

    def _kept_by_stores(self) -> dict[str, AnyArray]:
        """Return the arrays in which stores keep something and which neither the task nor a block names."""
        task, world = self.task, self.world
        saved = [*task.arrays.values(), world.steps, world.actions, world.previous_actions]
        parts: list[tuple[str, Sequence[Store] | None]] = []
        if type(task).advance is not Task.advance:
            parts.append(("advance", None))
        for number, measurement in enumerate(task.measurements):
            if not isinstance(measurement, StoredNumbers) or not measurement.is_whole:
                parts.append(("measurement", None))
            if isinstance(measurement, StoredNumbers):
                parts.append((f"measurements.{number}", measurement.stores))
        for block in self.observer.blocks:
            saved += block.arrays.values()
            parts.append((f"blocks.{''.join(block.names[:1])}", block.stores))
            if block.update is not None:
                parts.append(("block", None))
        return kept(parts, saved)

    @property
    def _arrays(self) -> dict[str, AnyArray]:
        """What the task stores, by names of a state."""
        return {
            **{f"task.{name}": array for name, array in self.task.arrays.items()},
            **{f"{STORES}{name}": array for name, array in self._kept.items()},
        }

    def _compile(self) -> _compiled.Step | None:
        """Return the task's step as a compiled program; None if a part of it exists in Python only."""
        task, actuation = self.task, self.actuation
        methods = ("begin", "advance", "ended")
        own = any(getattr(type(task), name) is not getattr(Task, name) for name in methods)
        native = self.simulator.native
        measurements = [each for each in task.measurements if isinstance(each, StoredNumbers) and each.is_whole]
        observed = [(block, block.value) for block in self.observer.blocks if isinstance(block.value, Number)]
        terms = [(term, term.value) for term in self._terms if isinstance(term.value, Number)]
        whole = (len(measurements), len(observed), len(terms)) == tuple(
            map(len, (task.measurements, self.observer.blocks, self._terms))
        )
        own = own or any(block.begin or block.update for block, _ in observed)
        if own or not whole or native is None or not native.is_usable:
            return None
        stores = [store for measurement in measurements for store in measurement.stores]
        stores += [store for block, _ in observed for store in block.stores]
        numbers = [value for _, value in (*observed, *terms)]
        numbers += [each for store in stores for each in (store.begin, store.update) if each is not None]
        if not all(map(compilable, numbers)):
            return None
        names = ("rewards", "terminated", "truncated", "failed", "lost", "short")
        arrays = {
            **{name: getattr(self, name) for name in names},
            "observations": self.observer.observations,
            "values": self.observer.values,
            "steps": self.world.steps,
            "actions": self.world.actions,
            "previous_actions": self.world.previous_actions,
            "targets": self._targets,
        }
        reach = actuation.action_range_rad
        joints = (
            (actuation.index, actuation.signed_half_range, actuation.signed_low, actuation.high_rad)
            if reach is None
            else (actuation.index, reach, actuation.low_rad, actuation.high_rad)
        )
        return _compiled.Step(
            [operation(None, measurement.stores) for measurement in measurements],
            [
                (operation(value, block.stores), first, block.rates, block.angular, place)
                for (block, value), (_, first, place) in zip(observed, self.observer.places(), strict=True)
            ],
            [(operation(value), term.weight) for term, value in terms],
            [(flag, self.ends[end.name], end.failure) for end, flag in zip(task.ends, task.flags, strict=True)],
            arrays,
            self._scale,
            self.world.robot.nominal.tolist(),
            reach is not None,
            np.stack([*joints, actuation.nominal, actuation.sign], axis=1).tolist(),
            self.observer.width,
            len(self.observer.names),
        )

    @property
    def observations(self) -> FloatArray:
        """The latest (n, D) observations, or (n, D + C) with those of a critic."""
        return self.observer.observations

    @property
    def steps(self) -> IntArray:
        """(n,) steps of each robot's episode so far."""
        return self.world.steps

    def load_starts(self, starts: Starts) -> None:
        """Replace the starts.

        Raises:
            ValueError: if they are no poses of the robot, or an episode that begins with one of them ends at once.
        """
        shape, joints = np.shape(starts.poses_rad) if isinstance(starts, Starts) else (), self.actuation.n_joints
        if len(shape) != 2 or not shape[0] or shape[1] != joints or not np.isfinite(starts.poses_rad).all():
            raise ValueError(
                f"task {self.task.name}: starts: expected Starts with finite angles of shape (k, {joints}), k from 1, "
                f"got {type(starts).__name__} of shape {shape}"
            )
        starts.places()
        self.disturbances.vary()
        self.simulator.load_starts(starts)
        rows = np.arange(min(self.n, len(starts)))
        self.restart(rows, rows)
        self.simulator.require_reports()
        self.task.advance(slice(0, self.n))
        _require_arrays(self.task)
        if added := sorted(self._arrays.keys() - self._new.keys()):
            raise ValueError(
                f"task {self.task.name}: arrays: {added[0].removeprefix('task.')!r} was added after __init__; make it "
                "there, and only change its numbers afterwards"
            )
        for end, reached in self._ended(slice(0, self.n)):
            if reached[rows].any():
                raise ValueError(
                    f"task: with these settings an episode ends at its start ({end.title.lower()}); "
                    f"the torso's height is {float(self.world.position(rows)[:, 2].min()):.3f} m in the start pose"
                )

    def restart(
        self,
        rows: IntArray,
        starts: IntArray,
        following: IntArray | None = None,
        episodes: IntArray | None = None,
    ) -> None:
        """Begin a new episode with the robots ``rows`` from the starts ``starts``; the others do not change.

        Args:
            rows: (k,) robots.
            starts: (k,) starts.
            following: (k,) the starts of the episodes after these, if they are known already.
            episodes: (k,) numbers of the episodes in an evaluation: random numbers then follow from seed and episode.
                Those of a training follow from seed and robot.
        """
        if not len(rows):
            return
        world = self.world
        if episodes is not None:
            world.streams[rows] = episodes
            for name, array in self._arrays.items():
                array[rows] = self._new[name][rows]
            self.disturbances.draw_by_episode(rows)
            self.simulator.draw_by_episode(rows, episodes)
        else:
            # of an episode that is truncated to train the start no more is asked than that it does not fail
            succeeded = self.task.succeeded(rows)
            _require_flags(succeeded, len(rows), f"task {self.task.name}: succeeded")
            failed = self.failed[rows] | ~(succeeded | self.short[rows])
            self.disturbances.grow(rows, (world.steps[rows] > 0) & ~self.lost[rows], failed)
        self.simulator.start(rows, starts, following)
        self.task.place(rows)
        self.disturbances.begin(rows)
        if self._program is not None:
            self._program.begin(rows)
        else:
            world.steps[rows] = 0
            world.actions[rows] = 0.0
            world.previous_actions[rows] = 0.0
            self.task.begin(rows)
            self.observer.begin(rows)
            for flags in (self.failed, *self.ends.values()):
                flags[rows] = False
        # with a delay, the latest action of a state that an episode begins with acts until the first of its own
        entered = rows[world.actions[rows].any(axis=1)]
        if len(entered):
            self.disturbances.hold(entered, self.actuation.targets(world.actions[entered]))

    def step(self, actions: FloatArray | Float32Array, active: BoolArray | None = None) -> FloatArray:
        """Take one step of 20 ms with every active robot.

        Args:
            actions: (n, A) actions, 32 or 64 bits, clipped to [-1, 1].
            active: (n,) robots to step; None for all. The others keep what their next episode depends on; their
                attributes are meaningless.

        Returns:
            (n, D) observations after the step, the last of an episode included; overwritten by the next call.
        """
        everyone = slice(0, self.n)
        idle = np.zeros(0, np.int64) if active is None else np.flatnonzero(~active)
        lasting = (*self._arrays.values(), self.disturbances.count, self.failed) if len(idle) else ()
        remembered = [array[idle] for array in lasting]
        self.step_async(actions, everyone, active)
        self.step_wait(everyone)
        for array, values in zip(lasting, remembered, strict=True):
            array[idle] = values
        return self.observer.observations

    def step_async(self, actions: FloatArray | Float32Array, rows: slice, active: BoolArray | None = None) -> None:
        """Begin a step of one of the simulator's groups with (k, A) actions; :meth:`step_wait` finishes it."""
        world, frozen = self.world, self.task.frozen
        if self._program is not None:
            self._program.act(rows.start, actions)
        else:
            world.previous_actions[rows] = world.actions[rows]
            np.clip(actions, -1.0, 1.0, out=world.actions[rows])
        taken_over = frozen is not None and frozen[rows].any()
        if taken_over:
            self.task.take_over(rows, self.observer)
        if self._program is None or taken_over:
            targets = self.actuation.targets(world.actions[rows])
        else:
            targets = self._targets[rows]
        targets = self.disturbances.delayed(targets, rows)
        began = perf_counter()
        self.simulator.step_async(targets, rows, active)
        self.simulator_s += perf_counter() - began

    def step_wait(self, rows: slice) -> None:
        """Finish the step that :meth:`step_async` began; the group's rows of all attributes are those after it."""
        simulator, task = self.simulator, self.task
        began = perf_counter()
        simulator.step_wait(rows)
        self.simulator_s += perf_counter() - began
        self.disturbances.apply(rows)
        lost = simulator.lost[rows]
        (gone,) = lost.nonzero()
        if len(gone):
            gone = gone + rows.start
            # the last report of a failing server is not used for learning
            last_observations = self.observer.observations[gone]
            remembered = {name: array[gone] for name, array in self._arrays.items()}
        if self._program is None:
            self._step_in_python(rows, lost)
        else:
            self._program.step(
                rows.start,
                rows.stop - rows.start,
                lost if len(gone) else None,
                task.max_steps,
                SHORT_EPISODE_STEPS,
                task.horizon_is_terminal,
                NativeHandle.threads_of(simulator),
            )
        if len(gone):
            self.observer.observations[gone] = last_observations
            for name, array in self._arrays.items():
                array[gone] = remembered[name]

    def _step_in_python(self, rows: slice, lost: BoolArray) -> None:
        """Compute what follows from a step of the simulator, as packages/naosprint/cpp/program.cpp does."""
        task, world = self.task, self.world
        world.steps[rows] += 1
        task.advance(rows)
        self.observer.update(rows)
        rewards = np.zeros(rows.stop - rows.start)
        for number, term in enumerate(self._terms):
            value = self._value(term, rows)
            if term.weight != 1.0:
                value = term.weight * value
            rewards = value if number == 0 else rewards + value
        self.rewards[rows] = np.where(lost, 0.0, rewards * self._scale)
        over = np.zeros(len(lost), dtype=np.bool_)
        failed = np.zeros(len(lost), dtype=np.bool_)
        for end, reached in self._ended(rows):
            reached = reached & ~lost
            self.ends[end.name][rows] = reached
            over |= reached
            if end.failure:
                failed |= reached
        late = world.steps[rows] >= task.max_steps
        if task.horizon_is_terminal:
            terminated = (over | late) & ~lost
            truncated = lost
        else:
            terminated = over
            truncated = (late & ~over) | lost
        short = self.short[rows] & (world.steps[rows] >= SHORT_EPISODE_STEPS) & ~terminated
        self.lost[rows], self.failed[rows] = lost, failed
        self.terminated[rows], self.truncated[rows] = terminated, truncated | short

    def _value(self, term: RewardTerm, rows: slice) -> FloatArray:
        """Return the (k,) values of a reward term; the function of another package may return anything."""
        what = f"task {self.task.name}: the function of reward term {term.name!r}"
        return require_numbers(term.compute(rows), (rows.stop - rows.start,), what)

    def _ended(self, rows: slice) -> Iterator[tuple[End, BoolArray]]:
        """Return each end of the task with the robots that have reached it.

        Raises:
            ValueError: if the task returns something else than one flag for each end and robot.
        """
        task = self.task
        found = task.ended(rows)
        if type(task).ended is not Task.ended:  # flags were checked when the task was made
            _require_count(task, found, "ended returned")
            for end, reached in zip(task.ends, found, strict=True):
                _require_flags(reached, rows.stop - rows.start, f"task {task.name}: ended: end {end.name!r}")
        return zip(task.ends, found, strict=True)

    def measured(self, rows: IntArray) -> FloatArray:
        """Return the (k, M) live metrics of the episodes of the robots ``rows``, which have just ended.

        Raises:
            ValueError: if the task measures something else than one number for each of them.
        """
        task = self.task
        found = task.measure(rows)
        live = [metric.name for metric in task.metrics if metric.live]
        what = f"task {task.name}: measure, for {', '.join(live) or 'no live metric'},"
        return require_numbers(found, (len(rows), len(live)), what)

    def not_finite(self, row: int) -> str:
        """Return the name of what is not finite in the latest reward of a robot."""
        rows = slice(row, row + 1)
        found = (term.name for term in self._terms if not np.isfinite(term.weight * self._value(term, rows)).all())
        name = next(found, None)
        return f"task {self.task.name}: " + ("the reward" if name is None else f"reward term {name!r}")

    def state(self) -> dict[str, AnyArray]:
        """Return everything that the next step depends on, the simulator's state included if it has snapshots."""
        state: dict[str, AnyArray] = {f"observer.{key}": value for key, value in self.observer.state().items()}
        state.update({name: _saved(name, array) for name, array in self._arrays.items()})
        state.update({f"disturbances.{name}": array.copy() for name, array in self.disturbances.arrays.items()})
        state["steps"] = self.world.steps.copy()
        state["actions"] = self.world.actions.copy()
        state["previous_actions"] = self.world.previous_actions.copy()
        snapshot = self.simulator.snapshot()
        if snapshot is not None:
            state["simulator"] = snapshot
        if self.disturbances.moves_motors:
            state[PERCEIVED] = self.world.perceptors["joint_angles"].copy()
        return state

    def load_state(self, state: Mapping[str, AnyArray], *, new_episodes: bool = False) -> None:
        """Restore what :meth:`state` returned; the starts must have been loaded before.

        Args:
            state: arrays by name.
            new_episodes: whether to restore only what outlives episodes, such as how far a curriculum has grown; all
                robots must be restarted then.
        """
        prefix = "observer."
        self.observer.load_state({key[len(prefix) :]: state[key] for key in state if key.startswith(prefix)})
        for name, array in self._arrays.items():
            array[:] = state[name].view(array.dtype) if name.startswith(STORES) else state[name]
        self.disturbances.restore({name: state[f"disturbances.{name}"] for name in self.disturbances.arrays})
        if new_episodes:
            return
        self.world.steps[:] = state["steps"]
        self.world.actions[:] = state["actions"]
        self.world.previous_actions[:] = state["previous_actions"]
        self.simulator.restore(np.array(state["simulator"], dtype=np.uint8))
        if PERCEIVED in state:
            self.world.perceptors["joint_angles"][:] = state[PERCEIVED]
        self._freeze()

    def _freeze(self) -> None:
        """Compute in which robots another policy takes over next: it follows from what was restored."""
        frozen = self.task.frozen
        if frozen is None or any(array is frozen for array in self._arrays.values()):
            return
        stores = [store for each in self.task.measurements if isinstance(each, StoredNumbers) for store in each.stores]
        stores += [store for block in self.observer.blocks for store in block.stores]
        for store in stores:
            if store.target.array is frozen:
                store.apply(store.update, slice(0, self.n))

    def close(self) -> None:
        """Close the simulator."""
        self._program = None  # it keeps the simulator's arrays, which must be released before the interpreter exits
        self.simulator.close()


def _saved(name: str, array: AnyArray) -> AnyArray:
    """Return an array as a state has it: what only stores keep as bits, since checkpoints refuse NaN."""
    found = array.copy()
    bits = name.startswith(STORES) and found.dtype.kind == "f"
    return found.view(f"i{found.itemsize}") if bits else found


def _listed(task: Task, method: str, kind: type[Part]) -> list[Part]:
    """Return what a method of a task returned as a list of a class."""
    returned = getattr(task, method)()
    found = list(returned) if isinstance(returned, Iterable) else [returned]
    if not all(isinstance(each, kind) for each in found):
        raise ValueError(f"task {task.name}: {method} returned {found!r:.100}; a list of {kind.__name__} is needed")
    return found


def _require_fit(task: Task, world: World) -> None:
    """Check that a task has what steps compute with: its length and its flags."""
    if getattr(task, "world", None) is not world:
        raise ValueError(f"task {task.name}: its __init__ has to call super().__init__(parameters, world, seed) first")
    if not isinstance(task.max_steps, int) or task.max_steps < 1:
        raise ValueError(f"task {task.name}: max_steps is {task.max_steps!r}; a whole number from 1 is needed")
    if type(task).ended is Task.ended:
        _require_count(task, task.flags, "flags has")
        for end, flag in zip(task.ends, task.flags, strict=True):
            _require_flags(flag, task.n, f"task {task.name}: flags: end {end.name!r}")


def _require_arrays(task: Task) -> None:
    """Check that what a task stores has a row of numbers for each robot."""
    if not isinstance(task.arrays, dict):
        raise ValueError(f"task {task.name}: arrays is {type(task.arrays).__name__}; a dict of arrays is needed")
    for name, array in task.arrays.items():
        if not isinstance(array, np.ndarray) or array.shape[:1] != (task.n,) or array.dtype.kind not in "biuf":
            raise ValueError(
                f"task {task.name}: arrays: {name!r} is {type(array).__name__} of shape {np.shape(array)}; an array of "
                f"numbers with a row for each of {task.n} robots is needed"
            )


def _require_terms(task: Task, terms: Sequence[RewardTerm]) -> None:
    """Check that each reward term has a weight and one number for each robot, or a function."""
    for term in terms:
        what = f"task {task.name}: reward term {term.name!r}"
        weight: object = term.weight
        if not isinstance(weight, Real) or not np.isfinite(float(weight)):
            raise ValueError(f"{what} has weight {weight!r}; a finite number is needed")
        if not isinstance(term.value, Number) and not callable(term.value):
            raise ValueError(f"{what} has value {term.value!r:.60}; an expression or a function of rows is needed")
        if isinstance(term.value, Number) and term.value.width != 1:
            raise ValueError(
                f"{what} has {term.value.width} numbers for each robot; one is needed, such as total(...) or one of "
                "its columns"
            )


def _require_count(task: Task, flags: Sequence[BoolArray], what: str) -> None:
    count = len(flags) if isinstance(flags, Sized) else 0
    if count != len(task.ends):
        names = ", ".join(end.name for end in task.ends) or "none"
        raise ValueError(
            f"task {task.name}: {what} {count} arrays for {len(task.ends)} ends ({names}); one for each is "
            "needed, in their order"
        )


def _require_flags(flags: BoolArray, k: int, what: str) -> None:
    shape, kind = np.shape(flags), np.asarray(flags).dtype
    if shape != (k,) or kind != np.bool_:
        raise ValueError(f"{what} has {kind} of shape {shape}; a flag (bool) for each of {k} robots is needed")


def open_environment(
    spec: TrainingSpec,
    n: int,
    *,
    threads: int,
    standby_servers: bool = False,
    seed: int | None = None,
    critic: bool = False,
) -> Environment:
    """Open n environments with the task, robot and simulator of ``spec``, and no starts yet.

    Args:
        spec: what to run.
        n: number of robots.
        threads: threads of an embedded simulator.
        standby_servers: whether each robot on a server has a second one that prepares its next start.
        seed: seed of what the task draws; the specification's by default.
        critic: whether observations contain those that only a critic has.

    Raises:
        ValueError: if this machine cannot run this number of robots; the message states what to change.
        FileNotFoundError: if a simulator's program is missing.
    """
    kind, task = kinds.get(spec.simulator.name), get(spec.task.name)
    options = RuntimeOptions(
        threads=threads, standby_servers=standby_servers, max_server_failures=spec.runtime.max_server_failures
    )
    simulator = kind.open(robots.configured(spec.robot), n, spec.simulator, options, task.scene)
    if not isinstance(simulator, Simulator) or getattr(simulator, "n", None) != n:
        raise ValueError(
            f"simulator {spec.simulator.name}: open returned {type(simulator).__name__} of "
            f"{getattr(simulator, 'n', None)} robots; a Simulator of {n} is needed, made by super().__init__(robot, n)"
        )
    try:
        return Environment(simulator, task, spec.task, spec.seed if seed is None else seed, critic=critic)
    except BaseException:
        simulator.close()
        raise


def open_training_environment(spec: TrainingSpec) -> tuple[Environment, int]:
    """Open the environments that a training needs, with its starts loaded.

    Returns:
        The environments and the number of starts.
    """
    runtime = spec.runtime
    n = spec.algorithm.n_envs
    environment = open_environment(
        spec,
        n,
        threads=runtime.simulator_threads,
        standby_servers=runtime.standby_servers,
        critic=getattr(spec.algorithm, "critic_observations", False),
    )
    try:
        environment.short[: round(spec.task.start_episode_fraction * n)] = True
        starts = environment.task.starts(TRAINING_STARTS, spec.seed, spec.task.start_noise_deg)
        environment.load_starts(starts)
    except BaseException:
        environment.close()
        raise
    return environment, len(starts)
