"""Corrections of the OpenAPI document that FastAPI generates."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from ..core.problems import Problem
from ..core.schemas import JobOptions

DESCRIPTION = """\
Upload a 3D Gaussian Splatting scene (`.ply`, `.sog`, `.spz`, `.splat`, `.ksplat`, `.glb`), follow the job, download a
SOG-XT container of a few megabytes.

    curl -F file=@scene.ply -F 'options={"preset": "balanced"}' localhost:8000/v1/jobs
    curl 'localhost:8000/v1/jobs/ID?wait=30'
    curl --fail -OJ localhost:8000/v1/jobs/ID/result

Errors are RFC 9457 problem documents. `code` is stable, `detail` has the remedy, and `/v1/problems` lists all codes.
"""


_JOB_OPERATIONS = ("status", "events", "cancel", "delete", "result", "file", "decoded", "source", "report")
"""Operations with the id of a job as a parameter."""


def describe(app: FastAPI, *, keys_required: bool) -> None:
    """Complete the OpenAPI document of ``app``.

    Adds the schemas of errors and of form fields, removes unused schemas, links responses that create a job to the
    operations on it, and makes authorization optional unless keys are required.
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
    for parameter in operation.get("parameters", []):  # an absent parameter is not null
        choices = [choice for choice in parameter["schema"].pop("anyOf", []) if choice != {"type": "null"}]
        parameter["schema"] |= choices[0] if choices else {}
    made = operation["responses"].get("202")
    if made is not None:
        for name in _JOB_OPERATIONS:
            parameters = {"id": "$response.body#/id", **({"name": "meta.json"} if name == "file" else {})}
            made.setdefault("links", {})[name] = {"operationId": name, "parameters": parameters}
