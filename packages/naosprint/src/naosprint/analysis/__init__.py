"""Evaluation, reports, plots, films and replays of policies."""

from __future__ import annotations
