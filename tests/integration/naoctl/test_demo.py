"""The last act of the demonstration: a policy from the box runs beside the one just learnt."""

from __future__ import annotations

import io
from pathlib import Path

import naopolicies
import pytest
from naoctl import demo
from naoctl.commands.policies import judge
from naoctl.context import Context
from naoctl.stack.layout import Layout
from rich.console import Console


def test_a_policy_from_the_box_runs_beside_the_one_just_learnt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "SHIPPED_EPISODES", 4)
    monkeypatch.setattr(demo, "SHIPPED_FILM_S", 0.1)
    learnt = judge(demo.SHIPPED, episodes=2)
    out = io.StringIO()
    context = Context(out=Console(file=out, width=200))
    demo.Demo(context, Layout.at(tmp_path / "data"), tmp_path).let_shipped_run({"summary": learnt}, tmp_path / "run")
    lines = {line[:12].strip(): line[12:] for line in out.getvalue().splitlines()}
    shipped = judge(demo.SHIPPED, episodes=4)
    assert lines["Just learnt"].startswith(f"{learnt['speed_mps']['mean']:.2f} m/s")
    assert lines["Sprint"].startswith(f"{shipped['speed_mps']['mean']:.2f} m/s")
    assert f"{naopolicies.card(demo.SHIPPED)['steps']:,} steps" in lines["Sprint"]
    film = tmp_path / "run" / "replay.mp4"
    assert lines["Film"] == film.resolve().as_uri()
    assert b"ftyp" in film.read_bytes()[:12]
