"""The OpenAPI document is pinned, so that no change of the API is overlooked.

To accept a change: `python tests/unit/naosprint_api/test_openapi.py`, and look at the difference.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from naosprint_api.app import create_app
from naosprint_api.service import Service
from naosprint_api.settings import ApiSettings

SNAPSHOT = Path(__file__).parent / "openapi.json"


def document(folder: Path) -> dict[str, Any]:
    settings = ApiSettings(
        mode="local",
        database_url="postgresql:///none",
        broker_url="redis://none",
        artifact_url=(folder / "store").as_uri(),
    )
    openapi: dict[str, Any] = create_app(Service.build(settings)).openapi()
    return openapi


def text_of(openapi: dict[str, Any]) -> str:
    return json.dumps(openapi, indent=1, sort_keys=True) + "\n"


def test_the_document_is_the_pinned_one(tmp_path: Path) -> None:
    assert text_of(document(tmp_path)) == SNAPSHOT.read_text()


def test_every_operation_is_described_and_names_its_errors(tmp_path: Path) -> None:
    openapi = document(tmp_path)
    names = []
    for path, operations in openapi["paths"].items():
        for method, operation in operations.items():
            names.append(operation["operationId"])
            assert operation.get("description"), (method, path)
            for parameter in operation.get("parameters", []):
                if parameter["name"] not in {"name", "Range"}:
                    assert parameter.get("description"), (method, path, parameter["name"])
            if operation.get("security"):
                assert {"401", "429", "503"} <= set(operation["responses"]), (method, path)
            for status, response in operation["responses"].items():
                if status.startswith("4"):
                    (schema,) = response["content"].values()
                    assert schema["schema"] == {"$ref": "#/components/schemas/Problem"}, (method, path, status)
    assert len(names) == len(set(names))
    assert "HTTPValidationError" not in json.dumps(openapi)


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as temporary:
        SNAPSHOT.write_text(text_of(document(Path(temporary))))
