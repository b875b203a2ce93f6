"""Demonstration: service, training, evaluation, download, check, and a bundled policy."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import naopolicies

from naoctl.client import Client
from naoctl.commands.artifacts import (
    fetch_artifacts,
    run_naosprint,
    show_evaluation,
    write_metrics,
    write_report,
)
from naoctl.commands.policies import evaluate
from naoctl.commands.submit import make_body
from naoctl.commands.watch import watch_job
from naoctl.config import Target
from naoctl.context import Context, find_checkpoint
from naoctl.errors import CliError, ExitCode
from naoctl.evaluations import headline, job_evaluation
from naoctl.policies import checkpoint_folder
from naoctl.render import duration
from naoctl.stack.control import start_detached, stop
from naoctl.stack.layout import Layout
from naoctl.stack.supervisor import Options, RunningStack

if TYPE_CHECKING:
    from collections.abc import Mapping

TASK = "sprint1"
"""What the demonstration trains."""

BUNDLED_EPISODES, BUNDLED_FILM_S = 20, 5
"""Episodes of the bundled policy that runs at the end, and the length of its film in seconds."""


@dataclass(frozen=True)
class Usual:
    """What the demonstration does with a robot, so that it runs in the end and the demonstration is short.

    Attributes:
        steps: steps of the training.
        episodes: episodes of its evaluation.
        settings: settings of the training besides those of preset ``fast``, by short name.
    """

    steps: int
    episodes: int
    settings: Mapping[str, str]


ROBOTS = {
    "nao-0": Usual(3_000_000, 1000, {}),
    # 2.5 m/s, see benchmarks/learning: rollouts of half the length, noise that falls faster, a short horizon early
    "t1": Usual(
        5_000_000,
        300,
        {
            "n_steps": "32",
            "batch_size": "1024",
            "n_epochs": "3",
            "gamma_steps": "1500000",
            "final_log_std": "-2.6",
            "log_std_steps": "16000000",
            "hop_penalty": "0.01",
        },
    ),
    "k1": Usual(2_500_000, 300, {}),
}


def bundled_policy(robot: str) -> str | None:
    """Return the name of the fastest bundled sprinter of a robot; None if there is none."""
    cards = {name: naopolicies.card(name) for name in naopolicies.names()}
    names = [name for name, card in cards.items() if (card["robot"], card["task"]) == (robot, TASK)]
    return min(names, key=len, default=None)


class Demo:
    """Run the demonstration.

    Args:
        context: where to print.
        layout: data folder of the service.
        output: folder for what is fetched.
    """

    def __init__(self, context: Context, layout: Layout, output: Path) -> None:
        self.context = context
        self.layout = layout
        self.output = output

    def run(self, *, robot: str, steps: int, seed: int, episodes: int, keep: bool) -> None:
        """Run all steps; stop the service in any case, unless ``keep``.

        Raises:
            CliError: when the results of the downloaded policy are not those the service reported.
            typer.Exit: when the job did not succeed.
        """
        began = time.monotonic()
        self._head("1. The service: API, worker, Postgres and broker on this machine")
        stack = start_detached(self.layout, Options(), self.context.say, tied=not keep)
        try:
            self.context.say("Dashboard", stack.url)
            self.context.say("Sign in", stack.sign_in_url)
            with Client(Target(stack.url, stack.token)) as client:
                job = self._train(client, robot, steps, seed, episodes)
                evaluation = self._show_results(client, job)
                checkpoint_folder = self._download(client, job, evaluation)
            self._verify(checkpoint_folder, evaluation)
            self._report(checkpoint_folder.parent)
            bundled = bundled_policy(robot)
            if bundled is not None:
                self.show_bundled(bundled, evaluation, self.output / bundled)
        finally:
            if not keep:
                self._head("8. Stop")
                stop(self.layout, self.context.say)
                self.context.say("Stopped", "nothing is left running")
        self._say_goodbye(stack, duration(time.monotonic() - began), keep=keep)

    def _head(self, text: str) -> None:
        self.context.out.print()
        self.context.out.print(text, style="bold", markup=False)
        self.context.out.file.flush()

    def _train(self, client: Client, robot: str, steps: int, seed: int, episodes: int) -> dict[str, Any]:
        self._head(f"2. A training job: {TASK}, robot {robot}, preset fast, {steps:,} steps")
        flags = {"task": TASK, "robot": robot, "preset": "fast", "total_steps": str(steps), "seed": str(seed)}
        body = make_body({}, {**flags, **ROBOTS[robot].settings}, {"eval_episodes": str(episodes)})
        job: dict[str, Any] = client.post("/jobs", {**body, "name": "demo", "tags": ["demo"]})
        self.context.say("Submitted", job["id"])
        watch_job(self.context, client, job, as_json=False)
        job = client.get(f"/jobs/{job['id']}")
        return job

    def _show_results(self, client: Client, job: dict[str, Any]) -> dict[str, Any]:
        self._head("3. How good the policy is")
        evaluation = job_evaluation(client, job["id"])
        if evaluation is None:
            raise CliError(f"Job {job['id']} succeeded without an evaluation", fix=f"See {self.layout.log('worker')}.")
        show_evaluation(self.context, evaluation)
        return evaluation

    def _download(self, client: Client, job: dict[str, Any], evaluation: dict[str, Any]) -> Path:
        self._head("4. The policy, on disk")
        checkpoint = find_checkpoint(client, job, evaluation["checkpoint_id"])
        folder = self.output / job["id"]
        chosen: list[tuple[str, Path, dict[str, Any]]] = [
            ("checkpoint", folder / checkpoint_folder(checkpoint["step"]), checkpoint),
            ("evaluation", folder / "evaluation", evaluation),
        ]
        for item in fetch_artifacts(self.context, client, chosen):
            self.context.say(item["kind"].capitalize(), item["path"])
        write_metrics(client, job["id"], folder / "metrics.jsonl")
        return chosen[0][1]

    def _report(self, folder: Path) -> None:
        """Write the page and the film; a failure does not end the demonstration."""
        self._head("6. A page to look at, and a film")
        try:
            page = write_report(folder, title="naosprint demo")
        except CliError as error:
            self.context.say("Report", str(error))
            return
        self.context.say("Report", page.resolve().as_uri())
        for film in sorted(page.parent.glob("*.mp4")):
            self.context.say("Film", film.resolve().as_uri())

    def show_bundled(self, name: str, evaluation: dict[str, Any], folder: Path) -> None:
        """Evaluate a bundled policy, show its results beside those of the one just trained, and film it."""
        self._head(f"7. For comparison, the bundled policy {name}")
        trained, bundled = evaluation["summary"], evaluate(name, episodes=BUNDLED_EPISODES)
        for title, summary, steps in (
            ("Trained", trained, trained["checkpoint"]["step"]),
            (name.capitalize(), bundled, naopolicies.card(name)["steps"]),
        ):
            results = ", ".join(f"{what.lower()} {text}" for what, text in headline(summary).items())
            self.context.say(title, f"{summary['episodes']:,} episodes after {steps:,} steps: {results}")
        try:
            run_naosprint("replay", name, str(folder), "--film-seconds", str(BUNDLED_FILM_S))
        except CliError as error:
            self.context.say("Film", str(error))
            return
        self.context.say("Film", (folder / "replay.mp4").resolve().as_uri())

    def _verify(self, checkpoint: Path, evaluation: dict[str, Any]) -> None:
        """Evaluate the downloaded policy again without the service, in another process, and compare every number."""
        self._head("5. The same results again, from the downloaded file alone")
        flags = []
        for name, value in evaluation["spec"].items():
            if name == "task":  # the training's
                continue
            flags += [
                f"--{name.replace('_', '-')}",
                "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value),
            ]
        self.context.say("Run", f"python -m naosprint evaluate {checkpoint}")
        again = json.loads(run_naosprint("evaluate", "--json", str(checkpoint), *flags))
        differing = differences(evaluation["summary"], again)
        if differing:
            raise CliError(
                f"{len(differing)} numbers of the downloaded policy differ from those that the service reported, "
                f"first {differing[0]}",
                code=ExitCode.FAILURE,
            )
        self.context.say("Same", f"all {count_numbers(again)} numbers are identical")

    def _say_goodbye(self, stack: RunningStack, took: str, *, keep: bool) -> None:
        self.context.out.print()
        self.context.say("Done", f"after {took}")
        self.context.say("Results", str(self.output))
        if keep:
            self.context.say("Dashboard", stack.sign_in_url)
            self.context.say("Stop", self.layout.stop_command)
        else:
            self.context.say(
                "Again", f"naoctl up --data-dir {self.layout.root}   (the job, its curves and its policy are kept)"
            )


def differences(one: Any, other: Any, path: str = "") -> list[str]:
    """Return the paths at which two JSON documents differ; numbers must be equal to the last bit."""
    if isinstance(one, dict) and isinstance(other, dict):
        keys = sorted(one.keys() | other.keys())
        missing = object()
        return [
            found
            for key in keys
            for found in differences(one.get(key, missing), other.get(key, missing), f"{path}.{key}" if path else key)
        ]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return [
            found
            for index, (a, b) in enumerate(zip(one, other, strict=True))
            for found in differences(a, b, f"{path}[{index}]")
        ]
    same = one == other or (
        isinstance(one, float) and isinstance(other, float) and math.isnan(one) and math.isnan(other)
    )
    return [] if same else [path]


def count_numbers(value: Any) -> int:
    """Return how many numbers a JSON document holds."""
    if isinstance(value, dict):
        return sum(count_numbers(item) for item in value.values())
    if isinstance(value, list):
        return sum(count_numbers(item) for item in value)
    return int(isinstance(value, int | float) and not isinstance(value, bool))
