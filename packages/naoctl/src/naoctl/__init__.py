"""Command line of naosprint: a client of the HTTP API, and a one-machine stack that needs no container."""

from __future__ import annotations

__version__ = "0.2.0"
