"""Run the command line with ``python -m naoctl``."""

from __future__ import annotations

from naoctl.cli import main

if __name__ == "__main__":
    main()
