"""Run `python -m naosim`."""

from __future__ import annotations

import sys

from naosim.cli import main

sys.exit(main())
