"""Commands for the service on this machine: up, down, doctor, demo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from naoctl.config import Config
from naoctl.context import Context, DataDir, JsonFlag, context_of
from naoctl.errors import CliError, ExitCode, StackError

PortOption = Annotated[
    int | None,
    typer.Option(
        "--port", "-p", min=1, max=65535, help="Port of API and dashboard.", show_default="8000 or a free one"
    ),
]
"""Port of `naoctl up`."""


def up(
    ctx: typer.Context,
    data_dir: DataDir = None,
    port: PortOption = None,
    workers: Annotated[
        int, typer.Option("--workers", min=1, max=256, help="Number of jobs that run at the same time.")
    ] = 1,
    queues: Annotated[
        str, typer.Option("--queues", help="Simulators that jobs may use: embedded, server.")
    ] = "embedded",
    detach: Annotated[
        bool, typer.Option("--detach", "-d", help="Run in the background; `naoctl down` stops it.")
    ] = False,
    as_json: JsonFlag = False,
    ready_fd: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Run the whole service on this machine: API, dashboard, worker, Postgres, broker and artifacts.

    Needs neither containers nor root; listens on 127.0.0.1 only. All data is in one folder, so the next start has all
    jobs again. Ctrl-C stops everything; a running job saves a checkpoint and resumes at the next start.
    """
    _need_stack()
    from naoctl.stack.control import ReadyPipe, start_detached
    from naoctl.stack.layout import Layout
    from naoctl.stack.supervisor import Options, StackSupervisor

    context = context_of(ctx)
    layout = Layout.at(data_dir)
    options = Options(port, workers, queues)
    say = (lambda title, text: None) if as_json else context.say
    if detach:
        stack = start_detached(layout, options, say)
        _announce(context, layout.root, stack, as_json=as_json, detached=True)
        return
    pipe = ReadyPipe(ready_fd) if ready_fd is not None else None

    def tell(title: str, text: str) -> None:
        say(title, text)
        context.out.file.flush()
        if pipe:
            pipe.send(say=[title, text])

    supervisor = StackSupervisor(layout, options, tell)
    try:
        supervisor.run(lambda: _ready(context, supervisor.running_stack(), layout.root, pipe, as_json=as_json))
    except StackError as error:
        if pipe:
            pipe.send(error=error.message, fix=error.fix)
        raise
    finally:
        _forget(supervisor.state.url)


def _ready(context: Context, stack: object, root: Path, pipe: object, *, as_json: bool) -> None:
    from naoctl.stack.control import ReadyPipe
    from naoctl.stack.supervisor import RunningStack

    assert isinstance(stack, RunningStack)
    if isinstance(pipe, ReadyPipe):
        pipe.send(ready=True)
        pipe.close()
    else:
        _announce(context, root, stack, as_json=as_json, detached=False)


def _announce(context: Context, root: Path, stack: object, *, as_json: bool, detached: bool) -> None:
    """Print the stack's address and how to sign in, and make it the service that commands use."""
    from naoctl.stack.layout import Layout
    from naoctl.stack.supervisor import RunningStack

    assert isinstance(stack, RunningStack)
    config_path = Config.load().with_token(stack.url, stack.token).save()
    if as_json:
        context.json(
            {
                "url": stack.url,
                "pid": stack.pid,
                "data_dir": str(root),
                "sign_in": stack.sign_in_url,
                "config": str(config_path),
            }
        )
        context.out.file.flush()
        return
    context.out.print()
    context.say("Dashboard", stack.url)
    context.say("Sign in", stack.sign_in_url)
    context.say("Data", str(root))
    submit = "naoctl submit --preset fast --steps 3M --watch"
    context.say("Submit", submit if detached else f"{submit}   (in another terminal)")
    stop = Layout(root).stop_command
    context.say("Stop", stop if detached else f"Ctrl-C, or {stop}")
    context.out.file.flush()


def _forget(url: str | None) -> None:
    """Make the service that commands used before a stopped one the current one again."""
    config = Config.load()
    changed = config.stopped(url) if url else config
    if changed != config:
        changed.save()


def down(
    ctx: typer.Context,
    data_dir: DataDir = None,
    now: Annotated[bool, typer.Option("--now", help="Stop at once, without a checkpoint of the running job.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Stop the service on this machine. Also cleans up after a service that was killed."""
    _need_stack()
    from naoctl.stack import control
    from naoctl.stack.layout import Layout
    from naoctl.stack.state import StackState

    context = context_of(ctx)
    layout = Layout.at(data_dir)
    say = (lambda title, text: None) if as_json else context.say
    state = StackState.load(layout) if layout.root.exists() else None
    done = control.stop(layout, say, now=now)
    _forget(state.url if state else None)
    if as_json:
        context.json({"data_dir": str(layout.root), "stopped": done})
    else:
        context.say(
            "Stopped" if done else "Idle",
            "nothing is left running" if done else f"no stack is running on {layout.root}",
        )


def doctor(ctx: typer.Context, data_dir: DataDir = None, as_json: JsonFlag = False) -> None:
    """Check what the service needs on this machine, and the state of a running service."""
    _need_stack()
    from naoctl.stack.doctor import examine
    from naoctl.stack.layout import Layout

    context = context_of(ctx)
    findings = list(examine(Layout.at(data_dir)))
    if as_json:
        context.json([finding.as_dict() for finding in findings])
    else:
        for finding in findings:
            style = {"ok": "green", "warning": "yellow", "failed": "red"}[finding.verdict]
            context.out.print(f"[{style}]{finding.verdict:<8}[/{style}]", end=" ")
            context.out.print(f"{finding.subject:<18}{finding.text}", markup=False, soft_wrap=True)
            if finding.fix:
                context.out.print(f"{'':<27}{finding.fix}", markup=False, soft_wrap=True, style="bright_black")
    if any(finding.verdict == "failed" for finding in findings):
        raise typer.Exit(ExitCode.STACK)


def demo(
    ctx: typer.Context,
    robot: Annotated[str, typer.Option("--robot", help="Robot to train: nao-0, t1 or k1.")] = "nao-0",
    steps: Annotated[
        int | None,
        typer.Option("--steps", min=1, help="Environment steps to train for.  [default: until it runs]"),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the training.")] = 0,
    episodes: Annotated[
        int | None,
        typer.Option("--episodes", min=1, help="Episodes of the evaluation.  [default: 1000; 300 for T1 and K1]"),
    ] = None,
    data_dir: DataDir = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Folder for the policy and its results.")
    ] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep the service running at the end.")] = False,
) -> None:
    """Run a demonstration: start the service, train, evaluate and download a policy, check it, stop."""
    _need_stack()
    from naoctl.demo import ROBOTS, Demo
    from naoctl.stack.layout import Layout, default_data_dir

    if robot not in ROBOTS:
        raise CliError(f"--robot: {robot!r} is not one of {', '.join(ROBOTS)}", code=ExitCode.USAGE)
    usual = ROBOTS[robot]
    folder = data_dir or default_data_dir().with_name("naosprint-demo")
    layout = Layout.at(folder)
    Demo(context_of(ctx), layout, output or layout.root / "results").run(
        robot=robot, steps=steps or usual.steps, seed=seed, episodes=episodes or usual.episodes, keep=keep
    )


def _need_stack() -> None:
    """Raise StackError if a package that the stack needs is not installed."""
    import importlib.util

    for module, package in (("psutil", "psutil"), ("redis", "redis")):
        if importlib.util.find_spec(module) is None:
            raise StackError(f"{package} is not installed", fix="pip install 'naoctl[stack]'")


def register(app: typer.Typer) -> None:
    """Add the commands."""
    for function in (up, down, doctor, demo):
        app.command(function.__name__)(function)
