"""Copy every artifact out of the store or into it, as a tar archive: `artifacts.py export >FILE`, `import <FILE`.

Which store that is say the settings of the service, so an archive also moves artifacts from one kind of store to
another.
"""

from __future__ import annotations

import hashlib
import io
import sys
import tarfile
from typing import BinaryIO

from naojobs.settings import ServiceSettings
from naojobs.store import MANIFEST_NAME, ArtifactStore, Manifest

#: Below it lies everything that rows of the database refer to.
PREFIX = "jobs"


class DamagedArchiveError(Exception):
    """Says that an archive does not hold what its manifests promise."""


def export_artifacts(store: ArtifactStore, target: BinaryIO) -> int:
    """Write everything in the store to `target`; return how many files that was."""
    keys = store.list(PREFIX)
    with tarfile.open(fileobj=target, mode="w|", format=tarfile.PAX_FORMAT) as archive:
        for key in keys:
            data = store.get_bytes(key)
            entry = tarfile.TarInfo(key)
            entry.size, entry.mode = len(data), 0o600
            archive.addfile(entry, io.BytesIO(data))
    return len(keys)


def import_artifacts(store: ArtifactStore, source: BinaryIO) -> int:
    """Write everything in `source` to the store, manifests last, and return how many files that was.

    Raises:
        DamagedArchiveError: an artifact is not what its manifest says; it has no manifest in the store then and so
            counts as not there, while all others are.
    """
    digests: dict[str, str] = {}
    manifests: dict[str, bytes] = {}
    with tarfile.open(fileobj=source, mode="r|") as archive:
        for entry in archive:
            file = archive.extractfile(entry)
            if file is None or not entry.name.startswith(f"{PREFIX}/"):
                raise DamagedArchiveError(f"{entry.name}: no file below {PREFIX}/")
            data = file.read()
            digests[entry.name] = hashlib.sha256(data).hexdigest()
            if entry.name.endswith(f"/{MANIFEST_NAME}"):
                manifests[entry.name] = data
            else:
                store.put_bytes(entry.name, data)
    damaged = []
    for key, data in manifests.items():
        folder = key.removesuffix(MANIFEST_NAME)
        if all(digests.get(folder + file.name) == file.sha256 for file in Manifest.model_validate_json(data).files):
            store.put_bytes(key, data)
        else:
            damaged.append(folder)
    if damaged:
        raise DamagedArchiveError(f"{len(damaged)} artifacts are not what their manifests say: {', '.join(damaged)}")
    return len(digests)


def main(arguments: list[str]) -> int:
    """Run one command; return the exit status."""
    if arguments not in (["export"], ["import"]):
        sys.stderr.write(f"{__doc__}\n")
        return 2
    store = ArtifactStore.from_settings(ServiceSettings())  # type: ignore[call-arg]  # the environment fills it
    if arguments == ["export"]:
        count = export_artifacts(store, sys.stdout.buffer)
    else:
        count = import_artifacts(store, sys.stdin.buffer)
    sys.stderr.write(f"{count} files {arguments[0]}ed\n")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except DamagedArchiveError as error:
        sys.exit(str(error))
