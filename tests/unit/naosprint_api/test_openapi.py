"""The API keeps its promises: what the recorded contract contains stays.

The record has every operation with its parameters, bodies and responses, and every schema with its properties, without
words. Additions pass. To accept a change that breaks clients: `python tests/unit/naosprint_api/test_openapi.py`, look
at the difference, and add it to the changelog.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from naospec.json_text import json_text
from naosprint_api.app import openapi_document

CONTRACT = Path(__file__).parent / "contract.json"
WORDS = {"description", "title", "summary", "operationId", "tags", "examples", "example"}
SCHEMA = "#/components/schemas/"


def without_words(value: Any, *, names: bool = False) -> Any:
    """Leave out texts for people; ``names`` says that the keys are names of properties, which may be such words."""
    if isinstance(value, list):
        return [without_words(item) for item in value]
    if not isinstance(value, dict):
        return value
    return {
        key: without_words(item, names=key in {"properties", "schemas"})
        for key, item in value.items()
        if names or key not in WORDS
    }


def references(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        if str(value.get("$ref", "")).startswith(SCHEMA):
            yield value["$ref"].removeprefix(SCHEMA)
        for item in value.values():
            yield from references(item)
    elif isinstance(value, list):
        for item in value:
            yield from references(item)


def contract(openapi: dict[str, Any]) -> dict[str, Any]:
    """Return operations and schemas, and which schemas requests consist of."""
    operations = {
        f"{method.upper()} {path}": {
            **without_words(operation),
            "parameters": {f"{one['in']} {one['name']}": without_words(one) for one in operation.get("parameters", [])},
            # errors all look alike, which the last test checks
            "responses": {
                status: without_words(one) for status, one in operation["responses"].items() if status.startswith("2")
            },
        }
        for path, item in openapi["paths"].items()
        for method, operation in item.items()
    }
    schemas = without_words(openapi["components"]["schemas"], names=True)
    asked, new = set[str](), {name for one in operations.values() for name in references(one.get("requestBody"))}
    while new:
        asked |= new
        new = {name for parent in new for name in references(schemas[parent])} - asked
    return {"operations": operations, "schemas": schemas, "requests": sorted(asked)}


def broken(old: Any, new: Any, where: str, *, request: bool) -> Iterator[str]:
    """Yield what a client of ``old`` would find missing or different in ``new``."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key, value in old.items():
            if key == "required" and isinstance(value, list):
                continue
            if key not in new:
                yield f"{where}.{key}: missing"
            else:
                yield from broken(value, new[key], f"{where}.{key}", request=request)
        before, after = set(_list(old, "required")), set(_list(new, "required"))
        if request:
            yield from (f"{where}.{name}: required now" for name in sorted(after - before))
        else:
            yield from (f"{where}.{name}: optional now" for name in sorted(before - after))
        if "parameters" in old:
            for name in sorted(new["parameters"].keys() - old["parameters"].keys()):
                if new["parameters"][name].get("required"):
                    yield f"{where}.{name}: required now"
    elif isinstance(old, list) and isinstance(new, list):
        for item in old:  # an alternative may grow, for example by another task
            if not any(item == other or not list(broken(item, other, where, request=request)) for other in new):
                yield f"{where}: without {json.dumps(item)}"
    elif old != new:
        yield f"{where}: {json.dumps(new)}, was {json.dumps(old)}"


def changes(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return every incompatible change, one line each."""
    lines = list(broken(old["operations"], new["operations"], "", request=True))
    for name, schema in old["schemas"].items():
        if name not in new["schemas"]:
            lines.append(f"{name}: missing")
        else:
            lines += broken(schema, new["schemas"][name], name, request=name in old["requests"])
    return lines


def _list(schema: dict[str, Any], key: str) -> list[str]:
    value = schema.get(key, [])
    return value if isinstance(value, list) else []


def test_the_api_has_everything_that_the_contract_promises() -> None:
    assert changes(json.loads(CONTRACT.read_text(encoding="utf-8")), contract(openapi_document())) == []


def _drop_operation(new: dict[str, Any]) -> None:
    del new["operations"]["POST /jobs"]


def _require_parameter(new: dict[str, Any]) -> None:
    new["operations"]["GET /jobs"]["parameters"]["query shape"] = {"required": True}


def _drop_property(new: dict[str, Any]) -> None:
    del new["schemas"]["JobPublic"]["properties"]["state"]


def _change_type(new: dict[str, Any]) -> None:
    new["schemas"]["JobPublic"]["properties"]["id"]["type"] = "integer"


def _require_field(new: dict[str, Any]) -> None:
    new["schemas"]["JobCreate"].setdefault("required", []).append("name")


def _make_optional(new: dict[str, Any]) -> None:
    new["schemas"]["JobPublic"]["required"].remove("id")


@pytest.mark.parametrize(
    "change", [_drop_operation, _require_parameter, _drop_property, _change_type, _require_field, _make_optional]
)
def test_an_incompatible_change_is_named(change: Callable[[dict[str, Any]], None]) -> None:
    old = json.loads(CONTRACT.read_text(encoding="utf-8"))
    new = copy.deepcopy(old)
    change(new)
    assert len(changes(old, new)) == 1


def test_additions_are_compatible() -> None:
    old = json.loads(CONTRACT.read_text(encoding="utf-8"))
    new = copy.deepcopy(old)
    new["operations"]["GET /new"] = {}
    new["operations"]["GET /jobs"]["parameters"]["query shape"] = {"required": False}
    new["schemas"]["JobPublic"]["properties"]["new"] = {"type": "string"}
    new["schemas"]["JobPublic"]["required"].append("new")
    new["schemas"]["JobCreate"]["properties"]["new"] = {"type": "string"}
    assert changes(old, new) == []


def test_every_operation_is_described_and_names_its_errors() -> None:
    openapi = openapi_document()
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
    CONTRACT.write_text(json_text(contract(openapi_document()), sort_keys=True), encoding="utf-8")
