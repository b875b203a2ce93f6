"""Export of a policy for use without this package.

policy.npz      weights, standardization, and the robot's tables: all that an agent needs besides NumPy
policy.onnx     the network from raw observations to actions, standardization included
policy.h        the same as C99 without dependencies; policy_check.c compares it with values of the checkpoint
policy.json     inputs and outputs by name and unit
mujococodebase/ or FCPCodebase/  a skill for that team code, with recorded values and a check that needs only NumPy
"""

from __future__ import annotations

import keyword
import logging
import re
from typing import TYPE_CHECKING

from naosim.npz import write_npz
from naospec.files import together, write_whole
from naospec.json_text import json_text

from naosprint.export.arrays import policy_arrays
from naosprint.export.description import describe
from naosprint.export.graph import build_onnx
from naosprint.export.header import DEFAULT_NAME, build_check, build_header
from naosprint.export.skill import TARGETS, write_skill
from naosprint.rl.policy import NetworkPolicy, load_policy

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

__all__ = ["FORMATS", "build_check", "build_header", "build_onnx", "describe", "export_policy", "policy_arrays"]

FORMATS = ("numpy", "onnx", "c", "skill")
"""Formats of an exported policy."""

logger = logging.getLogger(__name__)

_NAME = re.compile(r"(?=.{1,40}$)[a-z][a-z0-9]*(_[a-z0-9]+)*")


@together()
def export_policy(
    checkpoint: Path,
    directory: Path,
    formats: Sequence[str] | None = None,
    name: str = DEFAULT_NAME,
    *,
    warn: Callable[[str], None] = logger.warning,
) -> tuple[Path, ...]:
    """Write the policy of a checkpoint to ``directory`` in some of :data:`FORMATS`, and ``policy.json``.

    Args:
        checkpoint: the checkpoint.
        directory: where the files are written.
        formats: the formats; by default all that its robot has, of which those that cannot be written are left out.
        name: name of the files, of all that ``policy.h`` defines and, after naosprint's, of the skill, so that several
            policies can be part of one program or team.
        warn: called with a sentence about each format that is left out.

    Returns:
        The paths of the files, which are replaced if they exist.

    Raises:
        CheckpointError: if the checkpoint is damaged.
        OSError: if onnx is requested and not installed.
        ValueError: if the policy is not a network, or a skill is requested and there is none for the robot or what the
            policy observes, or ``name`` is not one that C and Python accept.
    """
    if not _NAME.fullmatch(name) or keyword.iskeyword(name):
        raise ValueError(
            f"name: {name!r}: expected a letter and then letters, digits and single _ between them, all small, at most "
            "40, and no keyword of Python"
        )
    policy, manifest = load_policy(checkpoint)
    if not isinstance(policy, NetworkPolicy):
        raise ValueError(
            f"algorithm {manifest.stage_spec.algorithm.name}: its policies are {type(policy).__name__}, and only a "
            "naosprint.rl.policy.NetworkPolicy can be exported"
        )
    requested = formats is not None
    if formats is None:
        family = manifest.stage_spec.family
        formats = [each for each in FORMATS if each != "skill" or family in TARGETS]
    if "onnx" in formats:
        try:
            graph = build_onnx(policy).SerializeToString()
        except ImportError as error:
            missing = f"{name}.onnx needs onnx: pip install naosprint[export]"
            if requested:
                raise OSError(missing) from error
            warn(f"format onnx is left out: {missing}")
            formats = [each for each in formats if each != "onnx"]
    directory.mkdir(parents=True, exist_ok=True)
    written = []
    if "numpy" in formats:
        written.append(directory / f"{name}.npz")
        write_npz(written[-1], policy_arrays(policy, manifest), compressed=False)
    if "onnx" in formats:
        written.append(directory / f"{name}.onnx")
        write_whole(written[-1], graph)
    texts = {f"{name}.json": json_text(describe(policy, manifest))}
    if "c" in formats:
        texts |= {f"{name}.h": build_header(policy, manifest, name), f"{name}_check.c": build_check(policy, name)}
    for file, text in texts.items():
        written.append(directory / file)
        write_whole(written[-1], text)
    if "skill" in formats:
        try:
            written += write_skill(policy, manifest, directory, name)
        except (FileNotFoundError, ValueError) as error:  # the simulator that records the values may be missing
            if requested:
                raise
            warn(f"format skill is left out: {str(error).removeprefix('format skill: ')}")
    return tuple(written)
