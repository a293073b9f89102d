"""The OpenAPI document, where FastAPI's own says less or other than the service does."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from service.core.problems import Problem
from service.core.schemas import JobOptions

DESCRIPTION = """\
Upload a 3D Gaussian Splatting scene (`.ply`), follow the job, download a SOG-XT container of a few megabytes.

    curl -F file=@scene.ply -F 'options={"preset": "balanced"}' localhost:8000/v1/jobs
    curl 'localhost:8000/v1/jobs/ID?wait=30'
    curl -OJ localhost:8000/v1/jobs/ID/result

Errors are RFC 9457 problem documents. `code` is stable; `detail` says how to mend it; `/v1/problems` lists all.
"""


_FOLLOWERS = ("status", "events", "cancel", "delete", "result", "file", "decoded", "source", "report")
"""Operations that take the id of a job."""


def describe(app: FastAPI, *, keys_required: bool) -> None:
    """Complete the document that ``app`` serves.

    Schemas that only errors and forms use come in, and no others; where a job is made, links say what can be done with
    it; where no keys are required, none is asked for.
    """
    app.description = DESCRIPTION
    made = app.openapi

    def completed() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = made()
            schemas = document["components"]["schemas"]
            for model in (Problem, JobOptions):
                schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
                schemas.update(schema.pop("$defs", {}))
                schemas[model.__name__] = schema
            for unused in ("HTTPValidationError", "ValidationError"):
                schemas.pop(unused, None)
            for path in document["paths"].values():
                for operation in path.values():
                    _complete(operation, keys_required)
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = completed  # type: ignore[method-assign]


def _complete(operation: dict[str, Any], keys_required: bool) -> None:
    if "security" in operation and not keys_required:
        operation["security"].append({})
    for parameter in operation.get("parameters", []):  # one that is not there is not null
        choices = [choice for choice in parameter["schema"].pop("anyOf", []) if choice != {"type": "null"}]
        parameter["schema"] |= choices[0] if choices else {}
    made = operation["responses"].get("202")
    if made is not None:
        for name in _FOLLOWERS:
            parameters = {"id": "$response.body#/id", **({"name": "meta.json"} if name == "file" else {})}
            made.setdefault("links", {})[name] = {"operationId": name, "parameters": parameters}
