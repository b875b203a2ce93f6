from __future__ import annotations

import stat
from pathlib import Path

import pytest
from naoctl.config import DEFAULT_URL, PRIVATE, Config, normal_url, resolve_target
from naoctl.errors import InvalidInput
from naospec.files import write_whole


def test_tokens_survive_a_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "config.toml"
    config = (
        Config().with_token("http://a:1", 'quo"te\\ ü\x7f').with_token("https://b.example/nao/", "two", current=False)
    )
    config.save(path)
    assert Config.load(path) == config
    assert config.current == "http://a:1"
    assert config.tokens["https://b.example/nao"] == "two"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert list(path.parent.iterdir()) == [path]


def test_a_config_that_is_missing_is_empty(tmp_path: Path) -> None:
    assert Config.load(tmp_path / "none.toml") == Config()


@pytest.mark.parametrize("text", ["current = 1", "x = ", "[servers.'http://a']\n", "[servers.'ftp://a']\ntoken='x'"])
def test_a_damaged_config_is_refused_with_a_way_out(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.toml"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=r"config.toml|http"):
        Config.load(path)


def test_forgetting_a_service(tmp_path: Path) -> None:
    config = Config().with_token("http://a:1", "x").with_token("http://b:1", "y")
    assert config.without("http://b:1/") == Config(current=None, tokens={"http://a:1": "x"})
    assert config.without("http://a:1").current == "http://b:1"


def test_flag_beats_environment_beats_file(monkeypatch: pytest.MonkeyPatch) -> None:
    config = Config().with_token("http://file:1", "of-file").with_token("http://other:2", "of-other", current=False)
    assert resolve_target(config=Config()).url == DEFAULT_URL
    assert resolve_target(config=config).token == "of-file"
    monkeypatch.setenv("NAOCTL_URL", "http://other:2/")
    assert resolve_target(config=config).token == "of-other"
    monkeypatch.setenv("NAOCTL_TOKEN", "of-environment")
    assert resolve_target(config=config).token == "of-environment"
    assert resolve_target("http://flag:3", config=config).url == "http://flag:3"


def test_a_token_is_shown_to_nobody_else() -> None:
    config = Config().with_token("http://file:1", "secret")
    assert resolve_target("http://elsewhere:1", config=config).token is None


@pytest.mark.parametrize("url", ["", "127.0.0.1:8000", "ftp://x", "http://", "http://u:p@host", "file:///x"])
def test_addresses_that_are_none(url: str) -> None:
    with pytest.raises(InvalidInput):
        normal_url(url)


def test_addresses_have_one_form() -> None:
    assert normal_url(" HTTP://Host:8000/ ") == "http://host:8000"
    assert normal_url("https://host/nao/?x=1#y") == "https://host/nao"


def test_private_files_are_private_and_whole(tmp_path: Path) -> None:
    path = tmp_path / "secret"
    write_whole(path, "one", mode=PRIVATE)
    path.chmod(0o644)
    write_whole(path, "two", mode=PRIVATE)
    assert path.read_text() == "two"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_a_stopped_service_is_not_the_current_one_if_another_was_before_it(tmp_path: Path) -> None:
    """The only one stays: nothing else could be meant."""
    first, second, third = (f"http://127.0.0.1:800{n}" for n in range(3))
    path = tmp_path / "config.toml"
    only = Config().with_token(first, "a")
    assert only.stopped(first) == only
    both = only.with_token(second, "b").with_token(second, "c")
    both.save(path)
    assert Config.load(path) == both
    assert both.stopped(first) == both
    after = both.stopped(second)
    assert (after.current, after.previous, after.tokens[second]) == (first, None, "c")
    assert after.stopped(second) == after
    assert both.without(first).stopped(second).current == second
    assert both.with_token(third, "d", current=False).current == second
    path.write_text("previous = 3\n", encoding="utf-8")
    with pytest.raises(InvalidInput, match="`current` and `previous` are strings"):
        Config.load(path)
