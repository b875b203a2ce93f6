#!/usr/bin/env python3
"""Put the digest of every image behind its version, or refresh it, by what the registry says.

    deploy/images/pin.py [--check] [--mirror HOST:PORT] [FILE ...]

It needs `docker buildx`, but no engine. A digest makes sure that a version is the same bytes everywhere and always; a
new one is due whenever the publisher has rebuilt the version, for a fix in a library below for example.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOUND = (*ROOT.glob("services/*/Dockerfile*"), *ROOT.glob("deploy/*.yml"))
"""Files that name images."""
FILES = ["docker-compose.yml", ".env.example", *(str(path.relative_to(ROOT)) for path in FOUND)]
IMAGE = re.compile(r"(?:_IMAGE(?::-|=)|\bFROM )(?!naosprint/)([a-z0-9][a-z0-9./-]*:[\w][\w.-]*)(@sha256:[0-9a-f]{64})?")
"""An image of others: repository and version, then the digest if there is one."""


def digest_of(image: str, mirror: str | None) -> str:
    """Return the digest that the registry has for an image. Raises subprocess.CalledProcessError."""
    if mirror is not None:
        image = f"{mirror}/{image if '/' in image else f'library/{image}'}"
    command = ["docker", "buildx", "imagetools", "inspect", "--format", "{{json .Manifest}}", image]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60)
    return str(json.loads(done.stdout)["digest"])


def main() -> int:
    """Refresh the files; return the exit code."""
    parser = argparse.ArgumentParser(description="Fill in and refresh the digests of images.")
    parser.add_argument("--check", action="store_true", help="only report digests that are missing or differ")
    parser.add_argument("--mirror", help="a mirror of Docker Hub, instead of the registries themselves")
    parser.add_argument("files", nargs="*", type=Path, default=[ROOT / name for name in FILES])
    arguments = parser.parse_args()
    known: dict[str, str] = {}
    different = False
    for path in arguments.files:
        text = path.read_text(encoding="utf-8")
        for image, digest in set(IMAGE.findall(text)):
            try:
                known[image] = known.get(image) or digest_of(image, arguments.mirror)
            except subprocess.CalledProcessError as error:
                sys.stderr.write(f"{image}: {error.stderr.strip().splitlines()[-1]}\n")
                return 1
            if digest != f"@{known[image]}":
                different = True
                sys.stdout.write(f"{path.name}: {image}@{known[image]}\n")
                text = text.replace(image + digest, f"{image}@{known[image]}")
        if not arguments.check:
            path.write_text(text, encoding="utf-8")
    return int(different and arguments.check)


if __name__ == "__main__":
    raise SystemExit(main())
