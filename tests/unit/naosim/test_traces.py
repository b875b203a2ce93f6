"""The engine reproduces recordings of the real server."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from naosim import cli
from naosim.simspark import BatchSimulator, traces

HERE = Path(__file__).parent / "traces"
RECORDINGS = sorted(HERE.glob("*.npz"))


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_one_step_errors_are_rounding_only(path: Path) -> None:
    result = traces.check(path)
    error = result["position_error_m"]
    # the guarantee is 5e-8, 1e-5 and 1e-4; these bounds detect a change long before it is violated
    assert error["median"] <= 1e-9
    assert error["p99"] <= 5e-9
    assert error["max"] <= 1e-8
    assert result["perceptors_within_digit"] >= 0.999
    assert result["asleep_agrees"] == 1.0


def test_free_run_of_noise_stays_on_the_recorded_path() -> None:
    off = traces.free_run(traces.load(HERE / "noise-1.npz"))
    assert off.max() <= 1e-6


def test_perceptors_differ_only_in_the_first_reply() -> None:
    """The first replies describe the time before the recording, which is unknown."""
    _, perceptors, _ = traces.one_step(traces.load(HERE / "flail-1.npz"))
    for name, units in perceptors.items():
        late = units[2:]
        assert np.all(late <= 1.0 + 1e-6), name


def test_recordings_cover_sleep_stops_saturation_and_freezing() -> None:
    asleep = falls = False
    for path in RECORDINGS:
        trace = traces.load(path)
        asleep |= bool((~trace.enabled).any())
        falls |= bool((trace.state[:, 0, 2] < 0.2).any())
    assert asleep and falls


def test_legs_in_each_other_are_frozen_as_on_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the rule the recording of two tangled legs cannot be reproduced for about a second."""
    trace = traces.load(HERE / "cross-1.npz")
    assert traces.free_run(trace).max() <= 1e-6
    monkeypatch.setattr(
        traces, "BatchSimulator", lambda n, kind, digits: BatchSimulator(n, kind, digits=digits, self_collision=False)
    )
    position, _, _ = traces.one_step(trace)
    wrong = np.flatnonzero(position.max(axis=1) > 1e-4)
    assert 40 <= len(wrong) <= 51
    assert wrong[-1] - wrong[0] <= 51


def _damaged(tmp_path: Path, **changes: object) -> Path:
    with np.load(HERE / "still-0.npz") as archive:
        data = {key: archive[key] for key in archive.files}
    for key, value in changes.items():
        if value is None:
            del data[key]
        else:
            data[key] = value  # type: ignore[assignment]
    path = tmp_path / "damaged.npz"
    np.savez(path, **data)
    return path


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"command": None}, "command"),
        ({"command": np.zeros((3, 22))}, "state"),
        ({"state": np.full((121, 23, 13), np.nan)}, "state"),
        ({"meta": np.array("{")}, "meta"),
        ({"meta": np.array('{"robot_type": 9}')}, "meta"),
        ({"meta": np.array('{"joints": ["a"]}')}, "meta.joints"),
        ({"gyro": np.zeros((120, 2))}, "gyro"),
    ],
)
def test_damaged_trace_names_file_and_field(tmp_path: Path, changes: dict[str, object], field: str) -> None:
    path = _damaged(tmp_path, **changes)
    with pytest.raises(traces.NaoTraceError, match=field) as error:
        traces.load(path)
    assert "damaged.npz" in str(error.value)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"\x80\x04pickled"])
def test_unreadable_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.npz"
    path.write_bytes(content)
    with pytest.raises(traces.NaoTraceError, match=r"broken\.npz"):
        traces.load(path)


def test_pickled_arrays_are_never_loaded(tmp_path: Path) -> None:
    path = _damaged(tmp_path, extra=np.array([{"a": 1}], dtype=object))
    with pytest.raises(traces.NaoTraceError, match="plain arrays"):
        traces.load(path)


def test_command_line_prints_a_list_and_reports_bad_input(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    import json

    assert cli.main(["check", str(HERE / "still-0.npz"), "--json"]) == 0
    (result,) = json.loads(capsys.readouterr().out)
    assert result["trace"] == "still-0" and result["cycles"] == 120 and result["free_run_first_cycle_off_1mm"] is None
    assert set(result["position_error_m"]) == {"median", "p99", "max"}
    assert cli.main(["check", str(tmp_path / "none.npz")]) == 2
    assert "none.npz: no such file" in capsys.readouterr().err
