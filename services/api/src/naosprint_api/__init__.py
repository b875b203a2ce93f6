"""The HTTP API of the job service, and the pages of its dashboard."""

from __future__ import annotations

__version__ = "0.2.0"
