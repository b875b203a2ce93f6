"""The settings of a worker and of the child processes it starts."""

from __future__ import annotations

import os
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from naojobs.retention import Retention
from naojobs.settings import ServiceSettings
from naosim.mujoco.program import PROGRAM_VARIABLE as RCSSSERVERMJ_VARIABLE
from naosim.simspark.program import PROGRAM_VARIABLE as RCSSSERVER3D_VARIABLE
from naospec import plugins
from naosprint.matches.containers import RELAY_VARIABLE
from pydantic import Field, field_validator, model_validator
from pydantic_settings import NoDecode


class WorkerSettings(ServiceSettings):
    """Settings of a worker, read from the environment with the prefix `NAOSPRINT_`."""

    worker_queues: Annotated[tuple[str, ...], NoDecode] = Field(
        ("embedded",), description="Simulators that this worker has, comma separated, for example embedded or server."
    )
    worker_concurrency: int = Field(
        1,
        ge=1,
        le=256,
        description="Jobs that this worker runs in parallel, besides one evaluation that a user requests.",
    )
    worker_games: int | None = Field(
        None,
        ge=1,
        le=64,
        description="Games of a match that run at a time; left out: one for every two processors of each slot.",
    )
    worker_dir: Path = Field(
        default_factory=lambda: Path(tempfile.gettempdir()) / f"naosprint-{os.getuid()}",
        description="Folder for the files of running attempts; emptied attempt by attempt.",
    )
    worker_min_free_mb: int = Field(256, ge=0, description="MiB that must be free on worker_dir's disk to claim a job.")
    worker_poll_s: float = Field(
        1.0, gt=0, le=60, description="Seconds between two checks for a request to cancel or pause."
    )
    worker_reap_s: float = Field(10.0, gt=0, le=600, description="Seconds between two checks for work of lost workers.")
    worker_claim_s: float = Field(
        5.0, gt=0, le=600, description="Seconds between two checks of a free worker for waiting jobs and evaluations."
    )
    worker_preempt_by: int = Field(
        3,
        ge=0,
        le=9,
        description="A training makes room for work that waits with a priority higher by this much or more, and "
        "resumes from the same step later; 0: never.",
    )
    worker_idle_exit_s: float | None = Field(
        None,
        gt=0,
        le=86400,
        description="Seconds without work after which the worker ends, as on a cluster; left out: never.",
    )
    worker_stop_grace_s: float = Field(
        60.0, gt=0, le=3600, description="Seconds that a training has for its last checkpoint when it is stopped."
    )
    worker_orphan_grace_s: float = Field(
        10.0, ge=0, le=600, description="Seconds that a training has for its last checkpoint when its worker has died."
    )
    worker_patience_s: float = Field(
        300.0,
        gt=0,
        le=86400,
        description="Seconds for which an attempt waits for a failing database, or for a store that it reads from; "
        "checkpoints wait for the store without limit.",
    )
    worker_stall_s: float = Field(
        1800.0,
        gt=0,
        le=86400,
        description="Seconds without a step after which a training or an evaluation is killed and tried again.",
    )
    worker_stall_warn_s: float = Field(
        300.0,
        gt=0,
        le=86400,
        description="Seconds without a step after which a training or an evaluation is shown as stalled.",
    )
    worker_time_limit_s: float | None = Field(
        None,
        gt=0,
        le=30 * 86400,
        description="Seconds that one attempt at a job may take; then the job fails, and `naoctl retry` resumes it. "
        "Left out: no limit.",
    )
    worker_spool_mb: int = Field(
        256,
        ge=1,
        description="MiB of checkpoints of one training that may wait on worker_dir's disk for an unavailable store; "
        "beyond it the training waits until the store is back.",
    )
    worker_checkpoint_s: float = Field(
        10.0,
        ge=0,
        le=86_400,
        description="Minimum number of seconds between two checkpoints of a training.",
    )
    worker_flush_s: float = Field(1.0, gt=0, le=60, description="Seconds of metrics and logs in one write.")
    worker_memory_mb: int | None = Field(
        None, ge=64, description="Resident memory in MiB above which a training is ended; left out: no limit."
    )
    worker_memory_total_mb: int | None = Field(
        None,
        ge=128,
        description="Memory in MiB that this worker, all its children and their files on a tmpfs may hold together; "
        "beyond it a requested evaluation waits until there is more, and the largest training ends. "
        "Left out: 90 % of the container's limit, if it has one.",
    )
    worker_keep_last: int = Field(
        20,
        ge=0,
        description="Newest checkpoints that are kept of a job, besides its best one and those that were evaluated or "
        "that another job starts from; 0: all. At least 2, since one may be damaged.",
    )
    worker_keep_every: int | None = Field(
        None, ge=1, description="With worker_keep_last: every n-th checkpoint is kept as well; left out: no others."
    )
    worker_sweep_s: float = Field(
        21_600.0,
        gt=0,
        le=86_400,
        description="Seconds between two checks for files in the store, a day old or older, that no job refers to.",
    )
    worker_evaluation_threads: int = Field(
        2, ge=1, le=256, description="Simulator threads of an evaluation that a user requests."
    )
    worker_report: Literal["film", "pictures", "off"] = Field(
        "off",
        description="Report stored with every evaluation: film, pictures (no film, which takes longest), or off: "
        "`naoctl report` makes one on request.",
    )
    simserver: str = Field(
        "rcssserver3d",
        min_length=1,
        description="Server of the NAO: a program, `embedded` for `naosim serve`, "
        "`docker:IMAGE` for a container of that image, or `launcher:http://HOST:PORT` for one that a launcher service "
        "starts.",
    )
    rcssservermj: str = Field(
        "",
        description="Server of T1 and K1: a program, `docker:IMAGE` or `launcher:http://HOST:PORT`; "
        "left out: the server of the installed package rcsssmj.",
    )
    relay_image: str = Field(
        "",
        description="Image with Python 3 on this machine, whose containers take agents in containers to their server; "
        "left out: no team plays from a container image.",
    )
    worker_nice: int = Field(5, ge=0, le=19, description="Niceness of trainings, so that services stay responsive.")

    @field_validator("worker_queues", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value

    @field_validator("worker_queues")
    @classmethod
    def _known_queues(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        known = plugins.names(plugins.SIMULATORS)
        unknown = [queue for queue in value if queue not in known]
        if unknown or not value:
            wrong = f"unknown queue {unknown[0]!r}" if unknown else "no queue given"
            raise ValueError(f"worker_queues: {wrong}; choose from {', '.join(known)}")
        return tuple(dict.fromkeys(value))

    @field_validator("worker_report")
    @classmethod
    def _can_film(cls, value: str) -> str:
        if value == "film" and find_spec("imageio_ffmpeg") is None:
            raise ValueError(
                "worker_report: film needs imageio-ffmpeg, which is not installed; choose pictures, install "
                "naosprint[film], or build the image with WORKER_EXTRAS=film"
            )
        return value

    @model_validator(mode="after")
    def _keeps_enough(self) -> Self:
        if self.worker_keep_last == 1:
            raise ValueError("worker_keep_last: expected 0 for all, or at least 2, since one may be damaged; got 1")
        if self.worker_keep_every is not None and self.worker_keep_last == 0:
            raise ValueError("worker_keep_every: all checkpoints are kept; set worker_keep_last to at least 2")
        return self

    @model_validator(mode="after")
    def _orphans_end_within_lease(self) -> Self:
        if self.worker_orphan_grace_s >= self.lease_s:
            raise ValueError(
                "worker_orphan_grace_s: must be less than lease_s, "
                "so that a training whose worker died is gone before its job starts elsewhere"
            )
        return self

    @property
    def server_environment(self) -> dict[str, str]:
        """Return the environment variables that name the simulators' servers, and what leads agents to them."""
        return {
            RCSSSERVER3D_VARIABLE: self.simserver,
            RCSSSERVERMJ_VARIABLE: self.rcssservermj,
            RELAY_VARIABLE: self.relay_image,
        }

    @property
    def games_at_a_time(self) -> int:
        """Return how many games of a match run at a time."""
        return self.worker_games or max(1, len(os.sched_getaffinity(0)) // (2 * self.worker_concurrency))

    @property
    def retention(self) -> Retention | None:
        """Return which checkpoints of a job are kept; none for all."""
        return None if self.worker_keep_last == 0 else Retention(self.worker_keep_last, self.worker_keep_every)
